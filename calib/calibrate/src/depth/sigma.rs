//! The uncertainty of a plane from the corners of its board.

use crate::Rigid;
use crate::adjustment::Corner;
use crate::rigid::by_motion;
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::DVec3;
use nalgebra::Matrix6;

/// Standard deviation of the board's depth at the middle of its corners, metres: the covariance of the six unknowns of its pose,
/// with the corners' noise from the residuals, carried over to where the middle's ray meets the plane.
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than four corners in front of the camera, or corners on one line.
pub fn plane_sigma_m(intrinsics: &Intrinsics, corners: &[Corner], camera_from_board: &Rigid) -> Result<f64> {
    let camera = Camera::new(intrinsics)?;
    let mut normal = Matrix6::zeros();
    let mut squares = 0.0;
    let mut used = 0_usize;
    for corner in corners {
        let p = camera_from_board.transform(corner.point);
        let Some(seen) = camera.project_with_jacobian(p) else { continue };
        for d_point in seen.d_point {
            let row = by_motion(p, d_point);
            normal += row * row.transpose();
        }
        squares += (seen.pixel - corner.pixel).length_squared();
        used += 1;
    }
    let singular = || Error::new(ErrorKind::BadInput, "the corners do not fix the board's pose");
    if used < 4 {
        return Err(singular());
    }
    let variance = squares / (2 * used - 6).max(1) as f64;
    let covariance = normal.try_inverse().ok_or_else(singular)? * variance;
    let middle = corners.iter().map(|c| c.point).sum::<DVec3>() / corners.len() as f64;
    let at = camera_from_board.transform(middle);
    let facing = camera_from_board.rotation * DVec3::Z;
    // Depth along the fixed ray `at / at.z` as the plane moves.
    let gradient = by_motion(at, facing * (at.z / facing.dot(at)));
    let sigma = gradient.dot(&(covariance * gradient)).sqrt();
    if sigma.is_finite() { Ok(sigma) } else { Err(singular()) }
}
