//! A correction of depth and its application to pixels.

use depthrig_bus::{PixelFormat, Sample};
use depthrig_calib::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// The form of a correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// No error that is larger than its uncertainty.
    None,
    /// The same distance everywhere.
    Offset,
    /// A factor.
    Scale,
    /// A factor and a distance.
    ScaleOffset,
    /// A constant error of a stereo camera's disparity, which grows with the square of the distance.
    Disparity,
}

impl Model {
    /// Number of its parameters.
    pub const fn parameters(self) -> usize {
        match self {
            Self::None => 0,
            Self::Offset | Self::Scale | Self::Disparity => 1,
            Self::ScaleOffset => 2,
        }
    }

    /// Its name in files and tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Offset => "offset",
            Self::Scale => "scale",
            Self::ScaleOffset => "scale_offset",
            Self::Disparity => "disparity",
        }
    }
}

/// From sensed depth to corrected depth: `s = scale * z + offset_m`, then `s / (1 + s * inverse_per_m)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correction {
    /// The factor; 1 without one.
    pub scale: f64,
    /// Added after the factor, metres.
    pub offset_m: f64,
    /// Added to the inverse of the depth, 1/m: the error of the disparity in pixels over focal length (pixels) times baseline (m).
    pub inverse_per_m: f64,
}

impl Correction {
    /// Changes nothing.
    pub const NONE: Self = Self { scale: 1.0, offset_m: 0.0, inverse_per_m: 0.0 };

    /// The corrected depth, metres; 0 for no depth, and where nothing in front of the camera is left.
    pub fn apply(&self, z_m: f32) -> f32 {
        // A hole stays one; a comparison with NaN is false.
        if z_m > 0.0 { self.moved(f64::from(z_m)) as f32 } else { z_m }
    }

    fn moved(&self, z_m: f64) -> f64 {
        let s = self.scale * z_m + self.offset_m;
        let corrected = s / (1.0 + s * self.inverse_per_m);
        if corrected > 0.0 { corrected } else { 0.0 }
    }

    /// Corrects the pixels of a depth frame in place, with any padding of rows. 16-bit depth is rounded to its unit, and becomes 0
    /// where the result does not fit.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a format that is not depth in 16 bits or floats, or a unit that is not positive.
    pub fn apply_to_pixels(&self, format: PixelFormat, unit_m: f64, pixels: &mut [u8]) -> Result<()> {
        let bad = |why: String| Err(Error::new(ErrorKind::BadInput, why));
        if *self == Self::NONE && format.is_depth() {
            return Ok(());
        }
        match format.sample() {
            Sample::U16 if format.is_depth() => {
                if !(unit_m.is_finite() && unit_m > 0.0) {
                    return bad(format!("invalid depth unit {unit_m} m"));
                }
                for count in pixels.as_chunks_mut::<2>().0 {
                    let raw = u16::from_le_bytes(*count);
                    *count = self.corrected_count(raw, unit_m).to_le_bytes();
                }
                Ok(())
            }
            Sample::F32 if format.is_depth() => {
                for value in pixels.as_chunks_mut::<4>().0 {
                    *value = self.apply(f32::from_le_bytes(*value)).to_le_bytes();
                }
                Ok(())
            }
            _ => bad(format!("{} frames have no depth to correct", format.name())),
        }
    }

    /// Corrects counts of depth in a unit, metres, in place; the result is as of [`Self::apply_to_pixels`].
    pub fn apply_to_counts(&self, unit_m: f64, counts: &mut [u16]) {
        for count in counts {
            *count = self.corrected_count(*count, unit_m);
        }
    }

    fn corrected_count(&self, raw: u16, unit_m: f64) -> u16 {
        if raw == 0 {
            return 0;
        }
        let count = (self.moved(f64::from(raw) * unit_m) / unit_m).round();
        if count <= f64::from(u16::MAX) { count as u16 } else { 0 }
    }
}
