//! Uncertainty of projection: how far a calibration may put a point from where the camera would see it.
//!
//! The definition of mrcal (Kogan, "projection uncertainty", method `mean-pcam`): noise of the corners moves the intrinsics
//! and the boards' poses. A point, fixed to the boards, moves with them; the mean over boards is where the camera then is. Where the
//! board was never seen the uncertainty is large, however small the residuals are.

use crate::Rigid;
use crate::adjustment::{AdjustedCamera, Covariance, INTRINSIC_PARAMETERS};
use crate::rigid::by_motion;
use depthrig_calib::{Camera, Result};
use glam::{DMat3, DVec2};
use nalgebra::{Const, Dyn, Matrix2, OMatrix, SMatrix};

/// Estimates the standard deviation of the projection at `pixel` in its worst direction, pixels, for points at
/// `distance_m` from the camera; `None` where the lens model shows nothing.
///
/// `views` are the boards that this camera saw: indices into `rig_from_board`.
///
/// # Errors
/// As [`Camera::new`].
pub fn projection_sigma(
    camera: &AdjustedCamera,
    index: usize,
    rig_from_board: &[Rigid],
    views: &[usize],
    covariance: &Covariance,
    at: Sample,
) -> Result<Option<f64>> {
    let lens = Camera::new(&camera.intrinsics)?;
    let Some(ray) = lens.unproject(at.pixel) else { return Ok(None) };
    let in_camera = ray.normalize() * at.distance_m;
    let Some(projection) = lens.project_with_jacobian(in_camera) else { return Ok(None) };
    let place = covariance.layout().cameras[index];
    let mut shared: OMatrix<f64, Const<2>, Dyn> =
        OMatrix::<f64, Const<2>, Dyn>::zeros(covariance.layout().shared);
    let free = (0..INTRINSIC_PARAMETERS).filter(|i| camera.free_intrinsics[*i]);
    for (k, parameter) in free.enumerate() {
        for axis in 0..2 {
            shared[(axis, place.start + k)] = projection.d_params[axis][parameter];
        }
    }
    let rotation = DMat3::from_quat(camera.camera_from_rig.rotation);
    let in_rig = camera.camera_from_rig.inverse().transform(in_camera);
    let mut of_views = vec![SMatrix::<f64, 2, 6>::zeros(); rig_from_board.len()];
    let share = 1.0 / views.len().max(1) as f64;
    for axis in 0..2 {
        let d_camera = projection.d_point[axis];
        if camera.free_pose {
            let by = by_motion(in_camera, d_camera);
            for k in 0..6 {
                shared[(axis, place.pose + k)] = by[k];
            }
        }
        let d_rig = rotation.transpose() * d_camera;
        for view in views {
            let by = by_motion(in_rig, d_rig);
            for k in 0..6 {
                of_views[*view][(axis, k)] = by[k] * share;
            }
        }
    }
    let covariance = covariance.of_pixel(&shared, &of_views);
    Ok(Some(largest_eigenvalue(&covariance).max(0.0).sqrt()))
}

/// Where the uncertainty is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// The pixel.
    pub pixel: DVec2,
    /// Distance of the point from the camera.
    pub distance_m: f64,
}

fn largest_eigenvalue(m: &Matrix2<f64>) -> f64 {
    let half = 0.5 * (m[(0, 0)] + m[(1, 1)]);
    let difference = 0.5 * (m[(0, 0)] - m[(1, 1)]);
    half + difference.hypot(m[(0, 1)])
}
