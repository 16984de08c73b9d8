//! Rotations as vectors along their axes (radians), with the derivatives that a spline of rotations needs.
//!
//! Formulas: Solà, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, section IV and appendix B.

use glam::{DMat3, DQuat, DVec3};

/// Below this angle the series replace the quotients.
const SMALL: f64 = 1e-3;

/// The matrix `[v]×` with `[v]× w = v × w`.
pub(super) fn skew(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// The rotation about `v` by its length.
pub(super) fn exp(v: DVec3) -> DQuat {
    DQuat::from_scaled_axis(v)
}

/// The vector of a rotation, not longer than π. (That of `glam` is zero below 1e-8.)
pub(super) fn log(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let sine = q.xyz().length();
    let scale = if sine > 1e-9 { 2.0 * sine.atan2(q.w) / sine } else { 2.0 };
    q.xyz() * scale
}

/// The right Jacobian: `exp(v + d) ≈ exp(v) exp(J d)`.
pub(super) fn right_jacobian(v: DVec3) -> DMat3 {
    let angle = v.length();
    let square = angle * angle;
    let mut by_first = 0.5 - square / 24.0;
    let mut by_second = 1.0 / 6.0 - square / 120.0;
    if angle > SMALL {
        by_first = (1.0 - angle.cos()) / square;
        by_second = (angle - angle.sin()) / (square * angle);
    }
    let cross = skew(v);
    DMat3::IDENTITY - cross * by_first + cross * cross * by_second
}

/// The inverse of [`right_jacobian`]: `log(exp(v) exp(d)) ≈ v + J⁻¹ d`. Its transpose belongs to a motion from the left.
pub(super) fn right_jacobian_inverse(v: DVec3) -> DMat3 {
    let angle = v.length();
    let square = angle * angle;
    let mut by_second = 1.0 / 12.0 + square / 720.0;
    if angle > SMALL {
        by_second = 1.0 / square - (1.0 + angle.cos()) / (2.0 * angle * angle.sin());
    }
    let cross = skew(v);
    DMat3::IDENTITY + cross * 0.5 + cross * cross * by_second
}
