//! Corrections of depth in `calibration.toml`.

use crate::depth::{Correction, Model};
use depthrig_calib::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// The correction of one depth stream. The depth that is recorded and published is never changed by it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthCorrection {
    /// The camera's name in the rig.
    pub camera: String,
    /// The depth stream.
    pub stream: String,
    /// Serial number of the device; empty if it was not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub serial: String,
    /// Columns of its images.
    pub width: u32,
    /// Rows of its images.
    pub height: u32,
    /// When it was made, RFC 3339 in UTC.
    pub created: String,
    /// Its form.
    pub model: Model,
    /// `corrected = scale * sensed + offset`; 1 without a factor.
    #[serde(default = "one")]
    pub scale: f64,
    /// Millimetres.
    #[serde(default)]
    pub offset_mm: f64,
    /// `1 / corrected = 1 / sensed + inverse_per_m`; 0 without an error of disparity.
    #[serde(default)]
    pub inverse_per_m: f64,
    /// Standard deviation of `scale`.
    #[serde(default)]
    pub sigma_scale: f64,
    /// Standard deviation of `offset_mm`.
    #[serde(default)]
    pub sigma_offset_mm: f64,
    /// Standard deviation of `inverse_per_m`.
    #[serde(default)]
    pub sigma_inverse_per_m: f64,
    /// The places at which it was measured.
    #[serde(rename = "place", default, skip_serializing_if = "Vec::is_empty")]
    pub places: Vec<DepthPlace>,
}

/// Depth of the board at one place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthPlace {
    /// Depth of the board's plane, metres.
    pub distance_m: f64,
    /// Angle between the board's normal and the optical axis, degrees.
    pub tilt_deg: f64,
    /// Share of the board's pixels that have depth.
    pub fill: f64,
    /// Median of sensed minus true depth, millimetres.
    pub bias_mm: f64,
    /// Its standard deviation, millimetres.
    pub sigma_mm: f64,
    /// The same median after the correction, millimetres.
    pub corrected_mm: f64,
    /// Root mean square distance from the plane that fits the frame itself, millimetres.
    pub plane_rms_mm: f64,
    /// The same of the disparity, pixels; missing for cameras without a known baseline.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub subpixel_rms_px: Option<f64>,
    /// Standard deviation of a pixel from frame to frame, millimetres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub temporal_mm: Option<f64>,
    /// Frames.
    pub frames: usize,
}

const fn one() -> f64 {
    1.0
}

impl core::fmt::Display for DepthCorrection {
    /// For the provenance of what is made with it.
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(
            f,
            "{} corrected {}: scale {}, offset {} mm, inverse {} / m",
            self.stream, self.created, self.scale, self.offset_mm, self.inverse_per_m
        )
    }
}

impl DepthCorrection {
    /// The correction.
    pub const fn correction(&self) -> Correction {
        Correction { scale: self.scale, offset_m: self.offset_mm * 1e-3, inverse_per_m: self.inverse_per_m }
    }

    /// Refuses another device or another size of image.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with what differs. An empty serial number fits all.
    pub fn check_fits(&self, serial: &str, width: u32, height: u32) -> Result<()> {
        let refused = |why: String| {
            Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "the depth correction of {}/{} {why}; run `depthrig calibrate depth` for the camera as it is used",
                    self.camera, self.stream
                ),
            ))
        };
        if !self.serial.is_empty() && !serial.is_empty() && self.serial != serial {
            return refused(format!("is of serial number {}, this camera has {serial}", self.serial));
        }
        if (self.width, self.height) != (width, height) {
            return refused(format!(
                "is for {}x{}, the stream has {width}x{height}",
                self.width, self.height
            ));
        }
        Ok(())
    }

    pub(super) fn check(&self) -> Result<()> {
        let bad = |why: &str| {
            let name = format!("depth of {}/{}", self.camera, self.stream);
            Err(Error::new(ErrorKind::BadInput, format!("{name}: {why}")))
        };
        if self.camera.is_empty() || self.stream.is_empty() || self.width == 0 || self.height == 0 {
            return bad("camera, stream, width and height are needed");
        }
        if !(0.5..=2.0).contains(&self.scale) {
            return bad("scale is out of range 0.5..=2");
        }
        if !(-1000.0..=1000.0).contains(&self.offset_mm) {
            return bad("offset_mm is out of range -1000..=1000");
        }
        if !(-1.0..=1.0).contains(&self.inverse_per_m) {
            return bad("inverse_per_m is out of range -1..=1");
        }
        Ok(())
    }
}
