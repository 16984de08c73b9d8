//! Rotations between rotations, held against turning about an axis.

use super::*;
use proptest::prelude::*;

/// The quaternion of a turn by `angle` about a unit axis.
fn turn(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let [x, y, z] = axis.map(|a| a * (angle / 2.0).sin());
    [x, y, z, (angle / 2.0).cos()]
}

/// `p q`, the rotation q and then p.
fn product(p: [f64; 4], q: [f64; 4]) -> [f64; 4] {
    let [a, b, c, d] = p;
    let [e, f, g, h] = q;
    [
        d * e + a * h + b * g - c * f,
        d * f - a * g + b * h + c * e,
        d * g + a * f - b * e + c * h,
        d * h - a * e - b * f - c * g,
    ]
}

/// The angle between two rotations.
fn apart(p: [f64; 4], q: [f64; 4]) -> f64 {
    let conjugate = [-q[0], -q[1], -q[2], q[3]];
    let [x, y, z, w] = product(p, conjugate);
    2.0 * (x * x + y * y + z * z).sqrt().atan2(w.abs())
}

proptest! {
    #[test]
    fn a_rotation_turns_evenly_about_one_axis(
        start in prop::array::uniform4(-1.0..1.0f64),
        axis in prop::array::uniform3(-1.0..1.0f64),
        angle in 0.0..3.1f64,
        share in 0.0..1.0f64,
        signs in any::<[bool; 2]>(),
        scale in 0.5..2.0f64,
    ) {
        prop_assume!(start.iter().map(|x| x * x).sum::<f64>() > 0.01);
        let length = axis.iter().map(|x| x * x).sum::<f64>().sqrt();
        prop_assume!(length > 0.01);
        let axis = axis.map(|x| x / length);
        let start = unit(start);
        let flip = |q: [f64; 4], negative: bool| q.map(|x| if negative { -x * scale } else { x });
        let end = product(turn(axis, angle), start);
        let got = slerp(flip(start, signs[0]), flip(end, signs[1]), share);
        let expected = product(turn(axis, angle * share), start);
        prop_assert!(apart(got, expected) < 1e-6, "{got:?} {expected:?}");
        prop_assert!((got.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
    }
}

#[test]
fn nothing_is_made_of_what_is_no_rotation() {
    let q = turn([0.0, 0.0, 1.0], 1.0);
    assert!(slerp([0.0; 4], q, 0.5).iter().all(|x| x.is_nan()));
    assert!(slerp(q, [f64::NAN; 4], 0.5).iter().all(|x| x.is_nan()));
}
