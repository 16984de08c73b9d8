//! A lens of an Azure Kinect as its calibration gives it, and how well [`depthrig_bus::Intrinsics`] express it.

use super::super::modes::Cut;
use glam::DVec2;

/// Which formula the parameters belong to. SDK `src/transformation/intrinsic_transformation.c`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensModel {
    /// Every device that was sold: the rational model of OpenCV, whatever its name says.
    BrownConrady,
    /// Prototypes: a centre of distortion of its own, and `p1 x y` and `p2 x y` once and not twice.
    Rational6Kt,
}

/// Intrinsics for the whole sensor: lengths in widths and heights of it, the origin at the corner of the first pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawIntrinsics {
    /// The formula.
    pub model: LensModel,
    /// Principal point, widths.
    pub cx: f64,
    /// Principal point, heights.
    pub cy: f64,
    /// Focal length, widths.
    pub fx: f64,
    /// Focal length, heights.
    pub fy: f64,
    /// `k1` to `k6`.
    pub k: [f64; 6],
    /// First tangential coefficient.
    pub p1: f64,
    /// Second tangential coefficient.
    pub p2: f64,
    /// Centre of distortion on the plane z = 1.
    pub center: [f64; 2],
}

impl RawIntrinsics {
    /// Where the lens shows a point of the plane z = 1, on that plane.
    fn distort(&self, at: DVec2) -> DVec2 {
        let center = DVec2::from_array(self.center);
        let p = at - center;
        let [k1, k2, k3, k4, k5, k6] = self.k;
        let rs = p.length_squared();
        let below = 1.0 + rs * (k4 + rs * (k5 + rs * k6));
        let d = (1.0 + rs * (k1 + rs * (k2 + rs * k3))) / if below == 0.0 { 1.0 } else { below };
        let cross = p.x * p.y * if self.model == LensModel::BrownConrady { 2.0 } else { 1.0 };
        let tangential = DVec2::new(
            self.p2 * (rs + 2.0 * p.x * p.x) + self.p1 * cross,
            self.p1 * (rs + 2.0 * p.y * p.y) + self.p2 * cross,
        );
        p * d + tangential + center
    }

    /// How far the same numbers in the model of the sold devices are off within an image, pixels.
    pub(super) fn approximation_px(&self, cut: Cut, radius: f64) -> f64 {
        const STEPS: i32 = 16;
        let sold = Self { model: LensModel::BrownConrady, center: [0.0; 2], ..*self };
        let scale = DVec2::new(self.fx * f64::from(cut.sensor.0), self.fy * f64::from(cut.sensor.1));
        let middle = DVec2::new(self.cx * f64::from(cut.sensor.0), self.cy * f64::from(cut.sensor.1))
            - DVec2::new(f64::from(cut.offset.0), f64::from(cut.offset.1));
        let size = DVec2::new(f64::from(cut.size.0), f64::from(cut.size.1));
        let mut worst = 0.0_f64;
        for (ix, iy) in (-STEPS..=STEPS).flat_map(|y| (-STEPS..=STEPS).map(move |x| (x, y))) {
            let at = DVec2::new(f64::from(ix), f64::from(iy)) * (radius / f64::from(STEPS));
            let shown = self.distort(at);
            let pixel = shown * scale + middle;
            let is_seen = at.length() <= radius && pixel.cmpge(DVec2::ZERO).all() && pixel.cmple(size).all();
            if is_seen {
                worst = worst.max(((sold.distort(at) - shown) * scale).length());
            }
        }
        worst
    }
}
