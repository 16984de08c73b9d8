//! Contributions to the normal equations: of a frame's corners, of the cameras' calibrated poses, of the trajectory's smoothness.

use super::arrow::{Arrow, Parts};
use super::so3::{log, right_jacobian_inverse};
use super::spline::ORDER;
use super::state::{Fit, Frame};
use crate::rigid::by_motion;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector, Vector6};

/// Unknowns of the control poses that a frame depends on.
pub(super) const SPLINE: usize = 6 * ORDER;
/// Those, the camera's latency and the camera's pose.
pub(super) const LOCAL: usize = SPLINE + 7;
/// Motions of the board and of the camera, through which a frame depends on all of them.
const MOTIONS: usize = 12;

/// Standard deviation of the board's acceleration, metres and radians a second squared: far above what hands do, so that it only holds
/// control poses that no frame depends on.
const ACCELERATION: f64 = 30.0;
const ANGULAR_ACCELERATION: f64 = 300.0;

/// A frame's part of the normal equations: control poses, latency, the camera's pose.
pub(super) struct Terms {
    /// Index of the first control pose.
    pub first: usize,
    pub square: SMatrix<f64, LOCAL, LOCAL>,
    /// Half the slope of the cost.
    pub slope: SVector<f64, LOCAL>,
    /// Sum over the corners of the square of their speed in the image, pixels a second.
    pub speed_square: f64,
}

/// Huber's loss: the square up to `limit`, linear beyond it.
pub(super) fn loss(length: f64, limit: f64) -> f64 {
    if length > limit { 2.0 * limit * length - limit * limit } else { length * length }
}

/// The weight with which least squares has the slope of [`loss`].
fn weight(length: f64, limit: f64) -> f64 {
    if length > limit { limit / length } else { 1.0 }
}

impl Terms {
    pub fn new(fit: &Fit, frame: &Frame) -> Self {
        let camera = &fit.cameras[frame.camera];
        let sample = fit.trajectory.sample(frame.segment, frame.time_s - camera.latency_s);
        let rig_from_board = sample.rig_from_board;
        let board_from_rig = DMat3::from_quat(rig_from_board.rotation).transpose();
        let rig_from_camera = DMat3::from_quat(camera.camera_from_rig.rotation).transpose();
        let motion =
            Vector6::from_iterator(sample.angular.to_array().into_iter().chain(sample.linear.to_array()));
        let mut by_motions = SMatrix::<f64, MOTIONS, MOTIONS>::zeros();
        let mut slope = SVector::<f64, MOTIONS>::zeros();
        let mut speed_square = 0.0;
        for corner in &frame.corners {
            let in_camera = camera.camera_from_rig.transform(rig_from_board.transform(corner.point));
            let Some(projection) = camera.lens.project_with_jacobian(in_camera) else { continue };
            let residual: DVec2 = projection.pixel - corner.pixel;
            let weight = weight(residual.length(), fit.huber_px);
            for axis in 0..2 {
                let by_camera = projection.d_point[axis];
                let by_rig = rig_from_camera * by_camera;
                let turned = corner.point.cross(board_from_rig * by_rig);
                let of_camera = by_motion(in_camera, by_camera);
                let row = SVector::<f64, MOTIONS>::from_iterator(
                    turned.to_array().into_iter().chain(by_rig.to_array()).chain(of_camera.iter().copied()),
                );
                speed_square += row.fixed_rows::<6>(0).dot(&motion).powi(2);
                by_motions.ger(weight, &row, &row, 1.0);
                slope.axpy(weight * residual[axis], &row, 1.0);
            }
        }

        // The motions by the unknowns.
        let mut chain = SMatrix::<f64, MOTIONS, LOCAL>::zeros();
        for i in 0..ORDER {
            for row in 0..3 {
                for column in 0..3 {
                    chain[(row, 6 * i + column)] = sample.by_rotation[i].col(column)[row];
                }
                chain[(3 + row, 6 * i + 3 + row)] = sample.by_place[i];
            }
        }
        for row in 0..6 {
            // A frame was taken before its stamp by the latency.
            chain[(row, SPLINE)] = -motion[row];
            chain[(6 + row, SPLINE + 1 + row)] = 1.0;
        }
        let transposed = chain.transpose();
        Self {
            first: sample.first,
            square: transposed * by_motions * chain,
            slope: transposed * slope,
            speed_square,
        }
    }

    /// Adds them to the whole system. `corner` has the places of latency and pose; those that are not estimated have none.
    pub fn add(&self, corner: &[Option<usize>; 7], system: &mut Arrow, slope: &mut Parts) {
        let band = 6 * self.first;
        for row in 0..SPLINE {
            slope.band[band + row] += self.slope[row];
            for column in 0..=row {
                system.add_band(band + row, band + column, self.square[(row, column)]);
            }
        }
        for (i, at) in corner.iter().enumerate() {
            let Some(at) = *at else { continue };
            slope.corner[at] += self.slope[SPLINE + i];
            for row in 0..SPLINE {
                system.cross[(band + row, at)] += self.square[(row, SPLINE + i)];
            }
            for (j, other) in corner.iter().enumerate() {
                if let Some(other) = *other {
                    system.corner[(at, other)] += self.square[(SPLINE + i, SPLINE + j)];
                }
            }
        }
    }
}

/// Three control poses in a row whose motion should be smooth.
struct Bend {
    place: DVec3,
    rotation: DVec3,
    /// Steps of the rotation before and after the middle one.
    steps: [DVec3; 2],
}

impl Bend {
    fn new(fit: &Fit, middle: usize) -> Self {
        let [before, at, after] = [middle - 1, middle, middle + 1].map(|i| fit.trajectory.controls[i]);
        let steps =
            [log(before.rotation.conjugate() * at.rotation), log(at.rotation.conjugate() * after.rotation)];
        Self {
            place: before.translation - at.translation * 2.0 + after.translation,
            rotation: steps[1] - steps[0],
            steps,
        }
    }
}

/// Weights of the squares of [`Bend::place`] and [`Bend::rotation`].
fn smoothness(fit: &Fit) -> (f64, f64) {
    let scale = (fit.noise_px / fit.trajectory.knot_s.powi(2)).powi(2);
    (scale / ACCELERATION.powi(2), scale / ANGULAR_ACCELERATION.powi(2))
}

/// Middle ones of three control poses in a row.
fn middles(fit: &Fit) -> impl Iterator<Item = usize> + '_ {
    fit.trajectory.segments.iter().flat_map(|s| s.first + 1..s.first + s.spans + ORDER - 2)
}

/// Cost of bends and of cameras that stand elsewhere than they were calibrated.
pub(super) fn prior_cost(fit: &Fit) -> f64 {
    let (place, rotation) = smoothness(fit);
    let bends = middles(fit).map(|middle| {
        let bend = Bend::new(fit, middle);
        place * bend.place.length_squared() + rotation * bend.rotation.length_squared()
    });
    let cameras = fit.cameras.iter().filter_map(|camera| {
        let motion = camera.motion();
        Some(fit.noise_px.powi(2) * motion.dot(&(camera.information.as_ref()? * motion)))
    });
    bends.sum::<f64>() + cameras.sum::<f64>()
}

/// Adds both to the system.
pub(super) fn add_priors(fit: &Fit, system: &mut Arrow, slope: &mut Parts) {
    let (place, rotation) = smoothness(fit);
    for middle in middles(fit) {
        let bend = Bend::new(fit, middle);
        let [before, after] = bend.steps.map(right_jacobian_inverse);
        let by_rotation = [before.transpose(), -after.transpose() - before, after];
        let by_place = [1.0, -2.0, 1.0];
        for i in 0..3 {
            let row = 6 * (middle - 1 + i);
            let turned = by_rotation[i].transpose() * bend.rotation * rotation;
            let shifted = bend.place * (by_place[i] * place);
            for axis in 0..3 {
                slope.band[row + axis] += turned[axis];
                slope.band[row + 3 + axis] += shifted[axis];
            }
            for j in 0..=i {
                let column = 6 * (middle - 1 + j);
                let square = by_rotation[i].transpose() * by_rotation[j] * rotation;
                for a in 0..3 {
                    system.add_band(row + 3 + a, column + 3 + a, by_place[i] * by_place[j] * place);
                    for b in 0..3 {
                        if i > j || a >= b {
                            system.add_band(row + a, column + b, square.col(b)[a]);
                        }
                    }
                }
            }
        }
    }
    for (index, camera) in fit.cameras.iter().enumerate() {
        let (Some(information), Some(at)) = (&camera.information, fit.layout(index)[1]) else { continue };
        let information = information * fit.noise_px.powi(2);
        let by = information * camera.motion();
        for i in 0..6 {
            slope.corner[at + i] += by[i];
            for j in 0..6 {
                system.corner[(at + i, at + j)] += information[(i, j)];
            }
        }
    }
}
