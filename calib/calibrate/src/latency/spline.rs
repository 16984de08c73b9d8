//! The board's way through space: a uniform cubic B-spline of poses, cumulative, rotation and place apart.
//!
//! Sommer, Usenko, Schubert, Demmel and Cremers, Efficient Derivative Computation for Cumulative B-Splines on Lie Groups, CVPR
//! 2020. The spline has continuous acceleration, and a pose depends on four control poses.

use super::so3::{exp, log, right_jacobian, right_jacobian_inverse};
use crate::Rigid;
use glam::{DMat3, DQuat, DVec3};

/// Control poses that a pose depends on.
pub(super) const ORDER: usize = 4;

/// A time during which the board is seen without a long pause.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Segment {
    /// When its first span begins, seconds.
    pub start_s: f64,
    /// Index of its first control pose.
    pub first: usize,
    /// Spans between knots; it has three control poses more.
    pub spans: usize,
}

/// Splines of several segments.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Trajectory {
    /// Time between knots, seconds.
    pub knot_s: f64,
    pub segments: Vec<Segment>,
    /// Control poses of all segments: from the board's coordinates to the rig's.
    pub controls: Vec<Rigid>,
}

/// The pose at one moment, with its derivatives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    /// Index of the first of the four control poses.
    pub first: usize,
    pub rig_from_board: Rigid,
    /// Angular velocity in the board's coordinates, radians a second.
    pub angular: DVec3,
    /// Velocity of the board's origin in the rig's coordinates, metres a second.
    pub linear: DVec3,
    /// Rotation of the board, in its own coordinates, by the rotation of each control pose in its own.
    pub by_rotation: [DMat3; ORDER],
    /// Motion of the board's origin by that of each control pose.
    pub by_place: [f64; ORDER],
}

/// Values of the cumulative basis over a span, 0..=1, and their derivatives by it.
struct Basis {
    value: [f64; ORDER - 1],
    slope: [f64; ORDER - 1],
}

impl Basis {
    fn at(u: f64) -> Self {
        let square = u * u;
        Self {
            value: [
                (5.0 + 3.0 * u - 3.0 * square + square * u) / 6.0,
                (1.0 + 3.0 * u + 3.0 * square - 2.0 * square * u) / 6.0,
                square * u / 6.0,
            ],
            slope: [(1.0 - 2.0 * u + square) * 0.5, (1.0 + 2.0 * u - 2.0 * square) * 0.5, square * 0.5],
        }
    }
}

impl Trajectory {
    /// The pose at a time. Outside the segment the first or last span goes on.
    pub fn sample(&self, segment: usize, time_s: f64) -> Sample {
        let Segment { start_s, first, spans } = self.segments[segment];
        let along = (time_s - start_s) / self.knot_s;
        let span = along.floor().clamp(0.0, (spans - 1) as f64);
        let basis = Basis::at(along - span);
        let first = first + span as usize;
        let controls = &self.controls[first..first + ORDER];

        let mut linear = DVec3::ZERO;
        let mut place = controls[0].translation;
        let mut by_place = [1.0, 0.0, 0.0, 0.0];
        let mut steps = [DVec3::ZERO; ORDER - 1];
        let mut turns = [DQuat::IDENTITY; ORDER - 1];
        for i in 0..ORDER - 1 {
            let moved = controls[i + 1].translation - controls[i].translation;
            place += moved * basis.value[i];
            linear += moved * (basis.slope[i] / self.knot_s);
            by_place[i] -= basis.value[i];
            by_place[i + 1] += basis.value[i];
            steps[i] = log(controls[i].rotation.conjugate() * controls[i + 1].rotation);
            turns[i] = exp(steps[i] * basis.value[i]);
        }

        // From the last factor to the first: `after` turns what lies before a factor into the board's coordinates.
        let mut after = DMat3::IDENTITY;
        let mut angular = DVec3::ZERO;
        let mut by_rotation = [DMat3::ZERO; ORDER];
        for i in (0..ORDER - 1).rev() {
            angular += after * (steps[i] * (basis.slope[i] / self.knot_s));
            let by_step = after * right_jacobian(steps[i] * basis.value[i]) * basis.value[i];
            let inverse = right_jacobian_inverse(steps[i]);
            by_rotation[i + 1] += by_step * inverse;
            by_rotation[i] -= by_step * inverse.transpose();
            after *= DMat3::from_quat(turns[i].conjugate());
        }
        by_rotation[0] += after;
        let rotation = controls[0].rotation * turns[0] * turns[1] * turns[2];
        Sample {
            first,
            rig_from_board: Rigid { rotation: rotation.normalize(), translation: place },
            angular,
            linear,
            by_rotation,
            by_place,
        }
    }

    /// The time in the middle of the influence of a segment's control pose `index`, seconds.
    pub fn control_time_s(&self, segment: &Segment, index: usize) -> f64 {
        segment.start_s + (index as f64 - 1.0) * self.knot_s
    }
}

/// A control pose moved: rotated in its own coordinates, shifted in the rig's.
pub(super) fn moved(control: &Rigid, rotation: DVec3, shift: DVec3) -> Rigid {
    Rigid {
        rotation: (control.rotation * exp(rotation)).normalize(),
        translation: control.translation + shift,
    }
}
