//! The lens models: how a point on the plane z = 1 is displaced, and the derivatives of that.
//!
//! With `r² = x² + y²`:
//! - **Rational** (and Brown-Conrady, whose later coefficients are 0): `s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² +
//!   k5 r⁴ + k6 r⁶)`, `x' = s x + 2 p1 x y + p2 (r² + 2 x²)`, `y' = s y + p1 (r² + 2 y²) + 2 p2 x y` (OpenCV's
//!   definition, `calib3d` module documentation; the Azure Kinect's `K4A_CALIBRATION_LENS_DISTORTION_MODEL_BROWN_CONRADY`).
//! - **Inverse Brown-Conrady**: the same with the scaled `s x`, `s y` in the tangential part, but the unscaled `r²`
//!   (librealsense `src/rs.cpp`, Apache-2.0; since 2.5x coefficients work from the point to the pixel).
//! - **Kannala-Brandt**: `θ = atan r`, `θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, `(x', y') = θ'/r (x, y)` (OpenCV's
//!   `fisheye`).

use depthrig_bus::{Distortion, Intrinsics};
use glam::{DMat2, DVec2};

/// A lens with its coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lens {
    /// No distortion.
    None,
    /// `k1 k2 p1 p2 k3 k4 k5 k6`.
    Rational([f64; 8]),
    /// `k1 k2 p1 p2 k3`.
    InverseBrownConrady([f64; 5]),
    /// `k1 k2 k3 k4`.
    KannalaBrandt([f64; 4]),
}

/// Below this radius `atan(r) / r` is its own series.
const NEAR_AXIS: f64 = 1e-4;

impl Lens {
    /// The lens of `k`, [`Lens::None`] when it bends nothing.
    pub(crate) fn new(k: &Intrinsics) -> Self {
        match Self::of_model(k) {
            Self::Rational([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            | Self::InverseBrownConrady([0.0, 0.0, 0.0, 0.0, 0.0]) => Self::None,
            // Without coefficients a fisheye is still one.
            lens => lens,
        }
    }

    /// The lens of `k`, whatever its coefficients. Those that the model does not have are ignored, whatever they hold.
    pub(crate) fn of_model(k: &Intrinsics) -> Self {
        let [k1, k2, p1, p2, k3, ..] = k.coeffs;
        match k.distortion() {
            Distortion::BrownConrady => Self::Rational([k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]),
            Distortion::InverseBrownConrady => Self::InverseBrownConrady([k1, k2, p1, p2, k3]),
            Distortion::Rational => Self::Rational(k.coeffs),
            Distortion::KannalaBrandt4 => Self::KannalaBrandt([k1, k2, p1, p2]),
            _ => Self::None,
        }
    }

    /// Where the lens shows the point `p`.
    pub(crate) fn distort(&self, p: DVec2) -> DVec2 {
        self.distort_with_jacobian(p).0
    }

    /// The same with its Jacobian; columns are `∂/∂x` and `∂/∂y`.
    pub(crate) fn distort_with_jacobian(&self, p: DVec2) -> (DVec2, DMat2) {
        match self {
            Self::None => (p, DMat2::IDENTITY),
            Self::Rational(c) => {
                let (s, slope) = scale(c, p.length_squared());
                let (q, j) = scaled(p, s, slope);
                let (t, tj) = tangential(c[2], c[3], p, p.length_squared());
                // With r² of the same point: its gradient is 2 p.
                let grad = DMat2::from_cols(
                    tj.x_axis + DVec2::new(c[3], c[2]) * (2.0 * p.x),
                    tj.y_axis + DVec2::new(c[3], c[2]) * (2.0 * p.y),
                );
                (q + t, j + grad)
            }
            Self::InverseBrownConrady(c) => {
                let r2 = p.length_squared();
                let (s, slope) = scale(&[c[0], c[1], 0.0, 0.0, c[4], 0.0, 0.0, 0.0], r2);
                let (q, j) = scaled(p, s, slope);
                let (t, tj) = tangential(c[2], c[3], q, r2);
                let by_r2 = DVec2::new(c[3], c[2]);
                let grad = tj * j + DMat2::from_cols(by_r2 * (2.0 * p.x), by_r2 * (2.0 * p.y));
                (q + t, j + grad)
            }
            Self::KannalaBrandt(_) => {
                let r = p.length();
                let (value, slope) = self.radial(r);
                if r < NEAR_AXIS {
                    return (p * ratio(value, r), DMat2::IDENTITY * slope);
                }
                let s = value / r;
                // ds/d(r²) = (slope − s) / (2 r²).
                scaled(p, s, (slope - s) / (2.0 * r * r))
            }
        }
    }

    /// Without tangential terms: the radius shown for radius `r`, and its slope.
    pub(crate) fn radial(&self, r: f64) -> (f64, f64) {
        match self {
            Self::None => (r, 1.0),
            Self::Rational(c) => {
                let (s, slope) = scale(c, r * r);
                (r * s, s + 2.0 * r * r * slope)
            }
            Self::InverseBrownConrady(c) => {
                let (s, slope) = scale(&[c[0], c[1], 0.0, 0.0, c[4], 0.0, 0.0, 0.0], r * r);
                (r * s, s + 2.0 * r * r * slope)
            }
            Self::KannalaBrandt([k1, k2, k3, k4]) => {
                let theta = r.atan();
                let t2 = theta * theta;
                let value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                let slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
                (value, slope / (1.0 + r * r))
            }
        }
    }

    /// How the shown point changes with each coefficient, in the order of [`Intrinsics::coeffs`].
    pub(crate) fn by_coeffs(&self, p: DVec2) -> [DVec2; 8] {
        let r2 = p.length_squared();
        let powers = [r2, r2 * r2, r2 * r2 * r2];
        let mut by = [DVec2::ZERO; 8];
        match self {
            Self::None => {}
            Self::Rational(c) => {
                let bottom = 1.0 + r2 * (c[5] + r2 * (c[6] + r2 * c[7]));
                let (s, _) = scale(c, r2);
                for (i, power) in powers.iter().enumerate() {
                    by[[0, 1, 4][i]] = p * (power / bottom);
                    by[5 + i] = -p * (s * power / bottom);
                }
                by[2] = DVec2::new(2.0 * p.x * p.y, r2 + 2.0 * p.y * p.y);
                by[3] = DVec2::new(r2 + 2.0 * p.x * p.x, 2.0 * p.x * p.y);
            }
            Self::InverseBrownConrady(c) => {
                let (s, _) = scale(&[c[0], c[1], 0.0, 0.0, c[4], 0.0, 0.0, 0.0], r2);
                let q = p * s;
                let (_, tj) = tangential(c[2], c[3], q, r2);
                for (i, power) in powers.iter().enumerate() {
                    by[[0, 1, 4][i]] = (p + tj * p) * *power;
                }
                by[2] = DVec2::new(2.0 * q.x * q.y, r2 + 2.0 * q.y * q.y);
                by[3] = DVec2::new(r2 + 2.0 * q.x * q.x, 2.0 * q.x * q.y);
            }
            Self::KannalaBrandt(_) => {
                let r = p.length();
                let theta = r.atan();
                let mut power = p * ratio(theta, r);
                for by in &mut by[..4] {
                    power *= theta * theta;
                    *by = power;
                }
            }
        }
        by
    }
}

/// `value / r` where both go to 0 together with slope 1.
fn ratio(value: f64, r: f64) -> f64 {
    if r > 0.0 { value / r } else { 1.0 }
}

/// The radial factor and its derivative by `r²`.
fn scale([k1, k2, _, _, k3, k4, k5, k6]: &[f64; 8], r2: f64) -> (f64, f64) {
    let bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let s = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / bottom;
    let top_slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let bottom_slope = k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6);
    (s, (top_slope - s * bottom_slope) / bottom)
}

/// `s p` and its Jacobian, where `s` changes with `r²` by `slope`.
fn scaled(p: DVec2, s: f64, slope: f64) -> (DVec2, DMat2) {
    let cross = 2.0 * slope * p.x * p.y;
    let j = DMat2::from_cols(
        DVec2::new(s + 2.0 * slope * p.x * p.x, cross),
        DVec2::new(cross, s + 2.0 * slope * p.y * p.y),
    );
    (p * s, j)
}

/// The tangential part at `q`, and its Jacobian by `q` with `r2` held.
fn tangential(p1: f64, p2: f64, q: DVec2, r2: f64) -> (DVec2, DMat2) {
    let DVec2 { x, y } = q;
    let t =
        DVec2::new(2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y));
    let j = DMat2::from_cols(
        DVec2::new(2.0 * p1 * y + 4.0 * p2 * x, 2.0 * p2 * y),
        DVec2::new(2.0 * p1 * x, 2.0 * p2 * x + 4.0 * p1 * y),
    );
    (t, j)
}
