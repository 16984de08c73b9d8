//! Camera models: from a point in the optical frame to a pixel and back.
//!
//! One formula serves the pinhole, Brown-Conrady and rational models: with `r² = x² + y²`,
//! `s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)`,
//! `x' = s x + 2 p1 x y + p2 (r² + 2 x²)`, `y' = s y + p1 (r² + 2 y²) + 2 p2 x y` (`OpenCV`'s definition,
//! `calib3d` module documentation); the shorter models leave the later coefficients zero.

use depthrig_bus::{Distortion, Intrinsics};
use glam::{DVec2, DVec3};

/// Newton steps of the inverse at the most; lenses up to 120° need about six.
const MAX_STEPS: usize = 30;
/// The inverse is accepted when it projects back within this distance on the plane z = 1.
const TOLERANCE: f64 = 1e-9;

/// Projection by [`Intrinsics`].
pub trait CameraExt {
    /// The pixel that sees `p` (optical frame, metres); the centre of the top-left pixel is (0, 0).
    /// `None` when `p` is not in front of the camera or the distortion model is not supported.
    fn project(&self, p: DVec3) -> Option<DVec2>;

    /// The ray that `pixel` sees, scaled to z = 1: multiply by the depth to get the point. `None` when the
    /// model cannot be inverted there (beyond the lens' image circle) or is not supported.
    fn unproject(&self, pixel: DVec2) -> Option<DVec3>;
}

impl CameraExt for Intrinsics {
    fn project(&self, p: DVec3) -> Option<DVec2> {
        if p.z <= 0.0 || !is_supported(self) {
            return None;
        }
        let d = distort(&self.coeffs, DVec2::new(p.x / p.z, p.y / p.z)).0;
        Some(DVec2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    fn unproject(&self, pixel: DVec2) -> Option<DVec3> {
        if !is_supported(self) {
            return None;
        }
        let seen = DVec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        if self.distortion() == Distortion::None {
            return Some(seen.extend(1.0));
        }
        // Newton with the analytic Jacobian; steps are shortened so that a wide lens does not overshoot.
        let mut at = seen;
        for _ in 0..MAX_STEPS {
            let (d, [xx, xy, yx, yy]) = distort(&self.coeffs, at);
            let error = d - seen;
            if error.length() < TOLERANCE {
                return Some(at.extend(1.0));
            }
            let det = xx * yy - xy * yx;
            // The model folds back beyond its image circle: there the Jacobian is singular or reversed.
            if det <= 1e-9 {
                return None;
            }
            let step = DVec2::new(yy * error.x - xy * error.y, xx * error.y - yx * error.x) / det;
            at -= step * (0.5 / step.length().max(0.5));
        }
        None
    }
}

fn is_supported(k: &Intrinsics) -> bool {
    k.is_known()
        && matches!(k.distortion(), Distortion::None | Distortion::BrownConrady | Distortion::Rational)
}

/// The distorted point and its Jacobian `[∂x'/∂x, ∂x'/∂y, ∂y'/∂x, ∂y'/∂y]`.
fn distort(c: &[f64; 8], p: DVec2) -> (DVec2, [f64; 4]) {
    let [k1, k2, p1, p2, k3, k4, k5, k6] = *c;
    let DVec2 { x, y } = p;
    let r2 = x * x + y * y;
    let top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let s = top / bottom;
    let top_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let bottom_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    let slope = (top_slope - s * bottom_slope) / bottom; // ds/d(r²)
    let to = DVec2::new(
        s * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        s * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    let cross = 2.0 * slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y;
    let xx = s + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x;
    let yy = s + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x;
    (to, [xx, cross, cross, yy])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn with(model: Distortion, coeffs: [f64; 8]) -> Intrinsics {
        Intrinsics { coeffs, model: model as u32, ..Intrinsics::pinhole(600.0, 610.0, 320.5, 239.0) }
    }

    /// A lens of the Azure Kinect's wide mode: 120° across.
    fn wide() -> Intrinsics {
        let c = [1.147, 0.2557, 2.5e-5, 7.5e-5, 0.00358, 1.4849, 0.5187, 0.0451];
        Intrinsics {
            coeffs: c,
            model: Distortion::Rational as u32,
            ..Intrinsics::pinhole(504.0, 504.0, 512.0, 512.0)
        }
    }

    #[test]
    fn pinhole_by_hand() {
        let k = with(Distortion::None, [0.0; 8]);
        assert_eq!(k.project(DVec3::new(0.2, -0.1, 2.0)).unwrap(), DVec2::new(380.5, 208.5));
        assert_eq!(k.unproject(DVec2::new(380.5, 208.5)).unwrap(), DVec3::new(0.1, -0.05, 1.0));
        assert_eq!(k.project(DVec3::new(0.2, -0.1, 0.0)), None);
        assert_eq!(Intrinsics::default().project(DVec3::Z), None);
    }

    #[test]
    fn brown_conrady_by_hand() {
        let k = with(Distortion::BrownConrady, [-0.28, 0.025, 0.001_2, -0.000_136, 0.16, 0.0, 0.0, 0.0]);
        let px = k.project(DVec3::new(0.3, -0.2, 1.0)).unwrap();
        // By the formula on paper: r² = 0.13, s = 1 − 0.0364 + 0.0004225 + 0.00035152 = 0.96437402.
        let x = 0.964_374_02 * 0.3 + 2.0 * 0.0012 * 0.3 * -0.2 - 0.000_136 * (0.13 + 2.0 * 0.09);
        let y = 0.964_374_02 * -0.2 + 0.0012 * (0.13 + 2.0 * 0.04) - 2.0 * 0.000_136 * 0.3 * -0.2;
        assert!((px - DVec2::new(600.0 * x + 320.5, 610.0 * y + 239.0)).length() < 1e-6, "{px}");
    }

    proptest! {
        #[test]
        fn there_and_back(x in -1.2f64..1.2, y in -1.2f64..1.2, z in 0.1f64..8.0) {
            let p = DVec3::new(x, y, 1.0) * z;
            let px = wide().project(p).unwrap();
            prop_assert!((wide().unproject(px).unwrap() * z - p).length() < 1e-6 * z);
            let k = with(Distortion::BrownConrady, [-0.05, 0.01, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0]);
            prop_assert!((k.unproject(k.project(p).unwrap()).unwrap() * z - p).length() < 1e-6 * z);
        }
    }

    #[test]
    fn beyond_the_image_circle_there_is_no_ray() {
        // A barrel so strong that the picture folds back at r = 0.91 on the plane z = 1.
        let k = with(Distortion::BrownConrady, [-0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(k.unproject(DVec2::new(320.5 + 600.0, 239.0)), None);
        assert!(k.unproject(DVec2::new(320.5 + 300.0, 239.0)).is_some());
    }
}
