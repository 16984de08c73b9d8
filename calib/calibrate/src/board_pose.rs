//! The pose of a flat board from the corners that one camera sees.

use crate::Rigid;
use crate::adjustment::{AdjustedCamera, Corner, INTRINSIC_PARAMETERS, Options, Problem, Sighting, Warp};
use crate::homography::{Pair, homography};
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

/// A board's pose and how well it explains the corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardPose {
    /// From the board's coordinates to the camera's optical frame.
    pub camera_from_board: Rigid,
    /// Root mean square of the residuals' lengths, pixels.
    pub rms_px: f64,
    /// The same for the other pose that a plane seen from afar may have, tilted the opposite way; a value near `rms_px` says that
    /// this view does not decide which one is right.
    pub other_rms_px: f64,
}

/// Estimates the pose of the board by least squares, from the homography and from its mirror image in depth (Schweighofer and
/// Pinz, Robust Pose Estimation from a Planar Target, 2006, on why there are two).
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than four corners, corners on one line, or corners that the lens cannot show.
pub fn board_pose(intrinsics: &Intrinsics, corners: &[Corner]) -> Result<BoardPose> {
    let camera = Camera::new(intrinsics)?;
    let pairs: Vec<Pair> = corners
        .iter()
        .filter_map(|c| {
            let ray = camera.unproject(c.pixel)?;
            Some(Pair { plane: c.point.truncate(), image: ray.truncate() })
        })
        .collect();
    let h = homography(&pairs)?;
    let scale = 2.0 / (h.x_axis.length() + h.y_axis.length());
    let scale = if h.z_axis.z < 0.0 { -scale } else { scale };
    let x = h.x_axis * scale;
    let y = h.y_axis * scale;
    let rotation = nearest_rotation(DMat3::from_cols(x, y, x.cross(y)))
        .ok_or_else(|| Error::new(ErrorKind::BadInput, "the corners lie on one line"))?;
    let first = Rigid::from_matrix(rotation, h.z_axis * scale);
    let refined = refine(intrinsics, corners, first)?;
    let other = refine(intrinsics, corners, tilted_back(&refined.camera_from_board, corners));
    Ok(match other {
        Ok(other) if other.rms_px < refined.rms_px => BoardPose { other_rms_px: refined.rms_px, ..other },
        Ok(other) => BoardPose { other_rms_px: other.rms_px, ..refined },
        Err(_) => refined,
    })
}

/// The pose whose normal is mirrored at the ray to the board's middle.
fn tilted_back(pose: &Rigid, corners: &[Corner]) -> Rigid {
    let middle = corners.iter().map(|c| c.point).sum::<DVec3>() / corners.len() as f64;
    let at = pose.transform(middle);
    let ray = at.normalize();
    let normal = pose.rotation * DVec3::Z;
    let mirrored = 2.0 * ray.dot(normal) * ray - normal;
    let rotation = (DQuat::from_rotation_arc(normal, mirrored) * pose.rotation).normalize();
    Rigid { rotation, translation: at - rotation * middle }
}

fn refine(intrinsics: &Intrinsics, corners: &[Corner], start: Rigid) -> Result<BoardPose> {
    let camera = AdjustedCamera {
        intrinsics: *intrinsics,
        camera_from_rig: Rigid::IDENTITY,
        free_intrinsics: [false; INTRINSIC_PARAMETERS],
        free_pose: false,
    };
    let mut problem = Problem {
        cameras: vec![camera],
        rig_from_board: vec![start],
        warp: Warp::default(),
        free_warp: false,
        sightings: vec![Sighting { camera: 0, view: 0, corners: corners.to_vec() }],
    };
    let solution = problem.solve(&Options { max_steps: 30, ..Options::default() })?;
    Ok(BoardPose {
        camera_from_board: problem.rig_from_board[0],
        rms_px: solution.rms_px,
        other_rms_px: f64::INFINITY,
    })
}

/// The rotation nearest to a matrix by the sum of squares (Kabsch).
pub(crate) fn nearest_rotation(m: DMat3) -> Option<DMat3> {
    let svd = Matrix3::from_column_slice(&m.to_cols_array()).svd(true, true);
    let u = svd.u?;
    let v_t = svd.v_t?;
    let mut fix = Matrix3::identity();
    fix[(2, 2)] = (u * v_t).determinant().signum();
    let r = u * fix * v_t;
    let columns: [f64; 9] = core::array::from_fn(|i| r.as_slice()[i]);
    columns.iter().all(|c| c.is_finite()).then(|| DMat3::from_cols_array(&columns))
}
