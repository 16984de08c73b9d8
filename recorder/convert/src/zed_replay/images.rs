//! From raw left and right images to rectified ones, and from disparity to the frames of a dataset.

use depthrig_bus::PixelFormat;
use depthrig_calib::stereo::{DisparityMap, Gray, StereoPair, depth_from_disparity};
use depthrig_calib::{Rectifier, View};
use depthrig_recorder::{Error, ErrorKind, Pixels, Result};
use std::sync::Arc;

/// Left and right images as they were recorded, without padding.
pub(super) struct Raw {
    pub(super) format: PixelFormat,
    pub(super) left: Vec<u8>,
    pub(super) right: Vec<u8>,
}

/// Rectified left and right images.
pub(super) struct Views {
    width: usize,
    height: usize,
    left: Vec<u8>,
    right: Vec<u8>,
    /// Left image in colour, which is recorded.
    pub(super) color: Vec<u8>,
    /// Right image in colour, for networks.
    right_color: Option<Vec<u8>>,
}

impl Views {
    /// As matchers take it.
    pub(super) fn pair(&self) -> StereoPair<'_> {
        StereoPair {
            left: Gray::packed(&self.left, self.width, self.height),
            right: Gray::packed(&self.right, self.width, self.height),
            left_rgb: Some(&self.color),
            right_rgb: self.right_color.as_deref(),
        }
    }
}

/// Frames that a mode computed from a pair.
pub(super) struct ModeFrames {
    /// In units; 0 is a hole.
    pub(super) depth: Vec<u16>,
    pub(super) confidence: Vec<u8>,
    /// Pixels; NaN is a hole. Only when it was asked for.
    pub(super) disparity: Option<Vec<f32>>,
}

/// Numbers as the bytes of a frame, which are little-endian as this computer's are.
pub(super) struct Numbers<T>(pub(super) Vec<T>);

impl<T: bytemuck::Pod + Send> Pixels for Numbers<T> {
    fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }
}

/// The colour of rectified views.
pub(super) struct Color(pub(super) Arc<Views>);

impl Pixels for Color {
    fn bytes(&self) -> &[u8] {
        &self.0.color
    }
}

/// Conversion settings, the same for all pairs.
pub(super) struct Maker {
    pub(super) rectifier: Rectifier,
    /// A network wants the right image in colour too.
    pub(super) colors: bool,
    pub(super) depth_unit_m: f64,
    pub(super) range_m: (f64, f64),
    pub(super) disparity: bool,
}

fn failed(e: depthrig_calib::Error) -> Error {
    Error::new(ErrorKind::BadInput, e.to_string()).with_source(e)
}

impl Maker {
    /// Bytes of a rectified pair with its raw images and all frames computed from it by `modes` modes.
    pub(super) fn pair_bytes(&self, modes: usize) -> u64 {
        let (w, h) = self.rectifier.size();
        let per_pixel = 2 * 3 + 2 + 2 * 3 + modes * (2 + 1 + 4 * usize::from(self.disparity));
        u64::from(w) * u64::from(h) * per_pixel as u64
    }

    /// Rectifies the left and the right image.
    pub(super) fn rectify(&self, raw: &Raw) -> Result<Views> {
        let (width, height) = self.rectifier.size();
        let width = width as usize;
        let height = height as usize;
        let rectified = |view, image: &[u8], colored: bool| {
            let mut grey = vec![0; width * height];
            let mut rgb = colored.then(|| vec![0; width * height * 3]);
            self.rectifier.rectify(view, raw.format, image, &mut grey, rgb.as_deref_mut()).map_err(failed)?;
            Ok::<_, Error>((grey, rgb))
        };
        let (left, color) = rectified(View::Left, &raw.left, true)?;
        let (right, right_color) = rectified(View::Right, &raw.right, self.colors)?;
        let color = color.unwrap_or_default();
        Ok(Views { width, height, left, right, color, right_color })
    }

    /// Depth of a disparity.
    pub(super) fn depth(&self, map: &DisparityMap) -> Result<ModeFrames> {
        let mut depth = vec![0; map.disparity.len()];
        let focal = self.rectifier.intrinsics().fx;
        let baseline = self.rectifier.baseline_m();
        depth_from_disparity(&map.disparity, focal, baseline, self.depth_unit_m, self.range_m, &mut depth)
            .map_err(failed)?;
        let disparity = self.disparity.then(|| map.disparity.clone());
        Ok(ModeFrames { depth, confidence: map.confidence.clone(), disparity })
    }
}
