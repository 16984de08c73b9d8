//! Reference for stereo depth: computed again from the images that were recorded with it, one step after the other.

use anyhow::Context;
use depthrig_bus::PixelFormat;
use depthrig_calib::stereo::{DisparityMap, Gray, Matcher, Preset, StereoPair, depth_from_disparity};
use depthrig_calib::{Rectifier, View};
use depthrig_stereo::{Geometry, StereoMode, StereoOptions};
use depthrig_zed::conf::FactoryCalibration;
use depthrig_zed::mode::Mode;

/// Computes depth from a ZED's pairs.
pub struct StereoReference {
    rectifier: Rectifier,
    matcher: Box<dyn Matcher>,
    geometry: Geometry,
    range_m: (f64, f64),
}

impl StereoReference {
    /// By the factory calibration `conf` at `mode`, with a preset that sees what is `near_m` away.
    ///
    /// # Errors
    /// When the calibration cannot be used.
    pub fn new(conf: &str, mode: Mode, preset: Preset, near_m: f64) -> anyhow::Result<Self> {
        let calibration = FactoryCalibration::parse(conf, "the emulator's")?;
        let c = calibration.at(mode).context("a mode without calibration")?;
        let rectifier = Rectifier::new(&c.left, &c.right, &c.right_in_left, mode.image_size())?;
        let (width, height) = rectifier.size();
        let geometry = Geometry {
            width: width as usize,
            height: height as usize,
            focal_px: rectifier.intrinsics().fx,
            baseline_m: rectifier.baseline_m(),
        };
        let matcher = (StereoMode::preset(preset, near_m, 1).make)(&geometry)?;
        let range_m = (near_m, StereoOptions::default().range_m.1);
        Ok(Self { rectifier, matcher, geometry, range_m })
    }

    /// The depth image of a pair of YUYV images, and how many of its pixels have depth.
    ///
    /// # Errors
    /// For images of another size.
    pub fn depth(&mut self, left: &[u8], right: &[u8]) -> anyhow::Result<(Vec<u8>, usize)> {
        let Geometry { width, height, focal_px, baseline_m } = self.geometry;
        let mut l = vec![0; width * height];
        let mut r = vec![0; width * height];
        self.rectifier.rectify(View::Left, PixelFormat::Yuyv, left, &mut l, None)?;
        self.rectifier.rectify(View::Right, PixelFormat::Yuyv, right, &mut r, None)?;
        let pair = StereoPair {
            left: Gray::packed(&l, width, height),
            right: Gray::packed(&r, width, height),
            left_rgb: None,
            right_rgb: None,
        };
        let mut map = DisparityMap::default();
        self.matcher.run(&pair, &mut map)?;
        let mut depth = vec![0; width * height];
        let unit_m = StereoOptions::default().depth_unit_m;
        depth_from_disparity(&map.disparity, focal_px, baseline_m, unit_m, self.range_m, &mut depth)?;
        let seen = depth.iter().filter(|d| **d > 0).count();
        Ok((depth.iter().flat_map(|d| d.to_le_bytes()).collect(), seen))
    }
}
