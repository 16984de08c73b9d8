//! Camera models: from a point in the optical frame to a pixel and back.
//! A [`Camera`] is created once from [`Intrinsics`] and knows how far from its axis the lens model is valid. The
//! formulas of the lenses are in `camera/lens.rs`.

use crate::{Error, ErrorKind, Result};
use depthrig_bus::{Distortion, Intrinsics};
use glam::{DMat2, DVec2, DVec3};

mod lens;
mod radius;

pub(crate) use lens::Lens;

/// Newton steps of the inverse at the most; from the radial inverse two to four are enough.
const MAX_STEPS: usize = 30;
/// The inverse is accepted when it projects back within this distance, pixels.
const TOLERANCE_PX: f64 = 1e-10;

/// Intrinsics, ready for use.
///
/// Every lens model is a polynomial or a ratio of two that was fitted within an image. Further out it turns round and
/// would show points from far outside at a second place: [`Camera::max_radius`] is where that begins, and nothing is
/// projected to or from beyond it.
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    intrinsics: Intrinsics,
    lens: Lens,
    max_radius: f64,
}

/// A pixel with how it changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// The pixel.
    pub pixel: DVec2,
    /// Change of `u` and of `v` with the point's x, y, z: pixels per unit of the point.
    pub d_point: [DVec3; 2],
    /// Change of `u` and of `v` with `fx fy cx cy` and the eight coefficients in the order of [`Intrinsics::coeffs`];
    /// 0 for those that the model does not have.
    pub d_params: [[f64; 12]; 2],
}

/// A ray with how it changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// The direction, scaled to z = 1.
    pub direction: DVec3,
    /// Change of the direction's (x, y) with the pixel's (u, v); columns are `∂/∂u` and `∂/∂v`.
    pub d_pixel: DMat2,
}

impl Camera {
    /// Makes a camera ready.
    ///
    /// # Errors
    /// [`ErrorKind::NoCalibration`] for a camera without calibration, [`ErrorKind::BadInput`] for numbers that are
    /// not finite or focal lengths that are not positive.
    pub fn new(intrinsics: &Intrinsics) -> Result<Self> {
        let k = *intrinsics;
        if !k.is_known() || k.distortion() == Distortion::Unknown {
            return Err(Error::new(
                ErrorKind::NoCalibration,
                "the camera's calibration is not known; give its intrinsics in the rig file",
            ));
        }
        let numbers = [k.fx, k.fy, k.cx, k.cy];
        if numbers.iter().chain(&k.coeffs).any(|n| !n.is_finite()) || k.fy <= 0.0 {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "invalid intrinsics fx {}, fy {}, cx {}, cy {} with coefficients {:?}",
                    k.fx, k.fy, k.cx, k.cy, k.coeffs
                ),
            ));
        }
        let lens = Lens::new(&k);
        Ok(Self { intrinsics: k, lens, max_radius: radius::monotone(&lens) })
    }

    /// The same with a smaller radius of trust, such as the `metric radius` of an Azure Kinect.
    pub fn with_max_radius(self, radius: f64) -> Self {
        Self { max_radius: self.max_radius.min(radius), ..self }
    }

    /// The camera's intrinsics.
    pub const fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    pub(crate) const fn lens(&self) -> &Lens {
        &self.lens
    }

    /// How far from the axis on the plane z = 1 a point may be; infinite for a pinhole.
    pub const fn max_radius(&self) -> f64 {
        self.max_radius
    }

    /// The pixel that sees `p` (optical frame, metres); the centre of the top-left pixel is (0, 0). `None` when `p` is
    /// not in front of the camera or beyond [`Camera::max_radius`].
    pub fn project(&self, p: DVec3) -> Option<DVec2> {
        let d = self.lens.distort(self.seen(p)?);
        Some(self.pixel(d))
    }

    /// [`Camera::project`] with its derivatives.
    pub fn project_with_jacobian(&self, p: DVec3) -> Option<Projection> {
        let at = self.seen(p)?;
        let (d, j) = self.lens.distort_with_jacobian(at);
        // A coefficient that is 0 matters too: a calibration may begin there.
        let mut by_coeffs = Lens::of_model(&self.intrinsics).by_coeffs(at);
        if self.intrinsics.distortion() == Distortion::BrownConrady {
            by_coeffs[5..].fill(DVec2::ZERO);
        }
        let Intrinsics { fx, fy, .. } = self.intrinsics;
        // (x, y) = (X, Y) / Z.
        let row = |f: f64, dx: f64, dy: f64| DVec3::new(dx, dy, -(dx * at.x + dy * at.y)) * (f / p.z);
        let mut d_params = [[0.0; 12]; 2];
        (d_params[0][0], d_params[0][2]) = (d.x, 1.0);
        (d_params[1][1], d_params[1][3]) = (d.y, 1.0);
        for (i, by) in by_coeffs.iter().enumerate() {
            d_params[0][4 + i] = fx * by.x;
            d_params[1][4 + i] = fy * by.y;
        }
        Some(Projection {
            pixel: self.pixel(d),
            d_point: [row(fx, j.x_axis.x, j.y_axis.x), row(fy, j.x_axis.y, j.y_axis.y)],
            d_params,
        })
    }

    /// The ray that `pixel` sees, scaled to z = 1: multiply by the depth to get the point. `None` when no point within
    /// [`Camera::max_radius`] is seen there.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec3> {
        self.invert(pixel).map(|(at, _)| at.extend(1.0))
    }

    /// [`Camera::unproject`] with its derivatives.
    pub fn unproject_with_jacobian(&self, pixel: DVec2) -> Option<Ray> {
        let (at, j) = self.invert(pixel)?;
        let Intrinsics { fx, fy, .. } = self.intrinsics;
        let inverse = j.inverse();
        let d_pixel = DMat2::from_cols(inverse.x_axis / fx, inverse.y_axis / fy);
        Some(Ray { direction: at.extend(1.0), d_pixel })
    }

    /// The point on the plane z = 1 that the lens shows at `pixel`, and the Jacobian of the lens there.
    fn invert(&self, pixel: DVec2) -> Option<(DVec2, DMat2)> {
        let Intrinsics { fx, fy, cx, cy, .. } = self.intrinsics;
        let shown = DVec2::new((pixel.x - cx) / fx, (pixel.y - cy) / fy);
        if !shown.is_finite() {
            return None;
        }
        if matches!(self.lens, Lens::None) {
            return Some((shown, DMat2::IDENTITY)).filter(|_| shown.length() <= self.max_radius);
        }
        let tolerance = TOLERANCE_PX / fx.max(fy);
        let mut at = self.first_guess(shown);
        let mut best: Option<(f64, DVec2, DMat2)> = None;
        for _ in 0..MAX_STEPS {
            let (d, j) = self.lens.distort_with_jacobian(at);
            let error = d - shown;
            let det = j.determinant();
            // Beyond its image circle the model folds back: there the Jacobian is singular or reversed.
            if det.is_nan() || det <= 0.0 {
                return None;
            }
            let size = error.length();
            // Steps go on while they help: the last ones are what brings a pixel back to where it was.
            if best.is_some_and(|(least, ..)| size >= least && least < tolerance) {
                break;
            }
            if best.is_none_or(|(least, ..)| size < least) {
                best = Some((size, at, j));
            }
            if size == 0.0 {
                break;
            }
            // The tangential terms change the radial inverse little; a long step leaves the valley.
            let step = j.inverse() * error;
            at -= step * (0.5 / step.length().max(0.5));
            let r = at.length();
            if r > self.max_radius {
                at *= self.max_radius / r;
            }
        }
        let (error, at, j) = best?;
        (error < tolerance && at.length() <= self.max_radius).then_some((at, j))
    }

    /// The inverse without tangential terms: on the interval where the radius grows there is exactly one.
    fn first_guess(&self, shown: DVec2) -> DVec2 {
        let wanted = shown.length();
        if wanted == 0.0 {
            return shown;
        }
        let mut low = 0.0;
        let mut high = self.max_radius;
        // Not at the end itself: there a rational lens may have its pole, and rounding decides the sign.
        let mut r = if wanted < high { wanted } else { 0.5 * high };
        let mut last = high;
        for _ in 0..100 {
            let (value, slope) = self.lens.radial(r);
            let error = value - wanted;
            if error.abs() <= 1e-9 {
                break;
            }
            if error > 0.0 {
                high = r;
            } else {
                low = r;
            }
            // Beside a pole of a rational lens Newton's steps begin tiny and double: a step that is not half of the last
            // one is replaced by halving (Press et al., Numerical Recipes 9.4).
            let step = error / slope;
            let inside = r - step > low && r - step < high;
            (r, last) = if inside && step.abs() <= 0.5 * last {
                (r - step, step.abs())
            } else {
                (0.5 * (low + high), 0.5 * (high - low))
            };
        }
        shown * (r / wanted)
    }

    fn seen(&self, p: DVec3) -> Option<DVec2> {
        let at = DVec2::new(p.x / p.z, p.y / p.z);
        // Written so that NaN is refused.
        (p.z > 0.0 && at.length() <= self.max_radius).then_some(at)
    }

    fn pixel(&self, d: DVec2) -> DVec2 {
        let Intrinsics { fx, fy, cx, cy, .. } = self.intrinsics;
        DVec2::new(fx * d.x + cx, fy * d.y + cy)
    }
}

/// Projection straight from [`Intrinsics`], for a point or two: each call creates a [`Camera`].
pub trait CameraExt {
    /// As [`Camera::project`]; `None` as well when no calibration is known.
    fn project(&self, p: DVec3) -> Option<DVec2>;

    /// As [`Camera::unproject`]; `None` as well when no calibration is known.
    fn unproject(&self, pixel: DVec2) -> Option<DVec3>;
}

impl CameraExt for Intrinsics {
    fn project(&self, p: DVec3) -> Option<DVec2> {
        Camera::new(self).ok()?.project(p)
    }

    fn unproject(&self, pixel: DVec2) -> Option<DVec3> {
        Camera::new(self).ok()?.unproject(pixel)
    }
}

#[cfg(test)]
mod tests;
