//! A robot's arm on the table of the fixed world: a base, three links and a hand of two fingers, which goes to and fro
//! between the ball and the steel plate. Its joints follow from the time on the host's clock alone, so that whoever publishes
//! them needs no word with the cameras that see it.

mod signals;

use super::motion;
use super::scene::Thing;
use super::shape::{Shape, Solid};
use super::texture::Paint;
use core::f32::consts::{FRAC_PI_2, PI};
use depthrig_bus::HostTime;
use glam::{Mat3, Vec3};

pub use signals::ArmSignals;

/// Joints in the order of [`Arm::joints_rad`].
pub const JOINTS: [&str; 4] = ["base", "shoulder", "elbow", "wrist"];
/// Places of the arm on its way, and how many it passes per second.
pub(crate) const POSES: u32 = 12;
const RATE_HZ: f64 = 6.0;

/// Middle of the base on the table, metres in the world.
const BASE: Vec3 = Vec3::new(0.44, 0.16, 0.0);
/// Height of the shoulder above the table, and lengths of upper arm, forearm and hand, metres.
const SHOULDER_M: f32 = 0.13;
const LINKS_M: [f32; 3] = [0.30, 0.28, 0.10];
const FINGER_M: f32 = 0.06;
/// Where the fingertips are at either end of the way.
const ENDS: [Vec3; 2] = [Vec3::new(-0.075, 0.0, 0.055), Vec3::new(0.27, -0.12, 0.03)];
/// Height by which the hand is lifted in the middle of the way.
const LIFT_M: f32 = 0.12;
/// Distance of the fingers at either end, metres.
const OPENING_M: [f32; 2] = [0.056, 0.02];

/// The arm at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arm {
    /// Angles of [`JOINTS`]: the base about the world's z axis from x, the shoulder up from level, elbow and wrist up from the link
    /// before.
    pub joints_rad: [f64; 4],
    /// Distance of the fingers, metres.
    pub opening_m: f64,
}

impl Arm {
    /// The arm at `t`. It moves smoothly; cameras show it at the last of [`POSES`] places that it passed.
    pub fn at(t: HostTime) -> Self {
        let last = f64::from(POSES - 1);
        let steps = t.ns().max(0) as f64 * 1e-9 * RATE_HZ % (2.0 * last);
        Self::on_way(if steps <= last { steps } else { 2.0 * last - steps } / last)
    }

    /// The arm as cameras show it in pose number `pose`.
    pub(crate) fn in_pose(pose: u32) -> Self {
        Self::on_way(f64::from(pose) / f64::from(POSES - 1))
    }

    /// The pose that is shown at `t`.
    pub(crate) fn pose_at(t: HostTime) -> u32 {
        motion::to_and_fro(motion::steps(HostTime::from_ns(0), t, RATE_HZ), POSES)
    }

    /// The arm at a share of its way; it rests at both ends.
    fn on_way(share: f64) -> Self {
        let turn = share as f32 * PI;
        let s = (1.0 - turn.cos()) / 2.0;
        let tip = ENDS[0].lerp(ENDS[1], s) + Vec3::Z * (LIFT_M * turn.sin());
        let opening = OPENING_M[0] + (OPENING_M[1] - OPENING_M[0]) * s;
        let [upper, fore, hand] = LINKS_M;
        // The hand points down, so the wrist is above the tip; two links reach it with the elbow up.
        let wrist = tip + Vec3::Z * (hand + FINGER_M) - BASE;
        let out = wrist.truncate().length();
        let up = wrist.z - SHOULDER_M;
        let far = out.hypot(up);
        let cosine = |a: f32, b: f32, c: f32| ((a * a + b * b - c * c) / (2.0 * a * b)).clamp(-1.0, 1.0);
        let shoulder = up.atan2(out) + cosine(upper, far, fore).acos();
        let elbow = cosine(upper, fore, far).acos() - PI;
        let joints = [wrist.y.atan2(wrist.x), shoulder, elbow, -FRAC_PI_2 - shoulder - elbow];
        Self { joints_rad: joints.map(f64::from), opening_m: f64::from(opening) }
    }

    /// Shoulder, elbow, wrist and the end of the hand in the world, metres.
    pub fn places(&self) -> [Vec3; 4] {
        let [base, shoulder, elbow, wrist] = self.joints_rad.map(|a| a as f32);
        let out = Vec3::new(base.cos(), base.sin(), 0.0);
        let mut at = BASE + Vec3::Z * SHOULDER_M;
        let mut places = [at; 4];
        let mut angle = 0.0;
        for ((place, turn), length) in places[1..].iter_mut().zip([shoulder, elbow, wrist]).zip(LINKS_M) {
            angle += turn;
            at += (out * angle.cos() + Vec3::Z * angle.sin()) * length;
            *place = at;
        }
        places
    }

    /// Its solids.
    pub(crate) fn things(&self) -> Vec<Thing> {
        let [shoulder, elbow, wrist, hand] = self.places();
        let half = SHOULDER_M / 2.0;
        let stand = Shape::Cylinder { half, radius: 0.055 };
        let base = self.joints_rad[0] as f32;
        let side = Vec3::new(-base.sin(), base.cos(), 0.0);
        let palm = side * 0.032;
        let finger = |side: Vec3| {
            let from = hand + side * (self.opening_m as f32 / 2.0);
            Thing::rod(from, from - Vec3::Z * FINGER_M, 0.005, Paint::Mug)
        };
        vec![
            Thing::new(Solid::new(stand, BASE + Vec3::Z * half, Mat3::IDENTITY), Paint::DarkWood),
            Thing::rod(shoulder, elbow, 0.030, Paint::Orange),
            Thing::rod(elbow, wrist, 0.024, Paint::Mug),
            Thing::rod(wrist, hand, 0.016, Paint::Orange),
            Thing::rod(hand - palm, hand + palm, 0.010, Paint::DarkWood),
            finger(side),
            finger(-side),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fingertips_go_from_end_to_end() {
        for (share, end) in [(0.0, ENDS[0]), (1.0, ENDS[1])] {
            let hand = Arm::on_way(share).places()[3];
            let tip = hand - Vec3::Z * FINGER_M;
            assert!((tip - end).length() < 1e-4, "{tip} is not {end}");
        }
        // The links are as long as they are, and the hand points down all the way.
        for i in 0..=100 {
            let p = Arm::on_way(f64::from(i) / 100.0).places();
            for (pair, length) in p.windows(2).zip(LINKS_M) {
                assert!(((pair[1] - pair[0]).length() - length).abs() < 1e-5);
            }
            assert!(((p[2] - p[3]) - Vec3::Z * LINKS_M[2]).length() < 1e-4);
            assert!(p.iter().all(|p| p.z > 0.05), "nothing reaches into the table");
        }
    }

    #[test]
    fn it_moves_smoothly_and_cameras_are_a_step_behind_at_most() {
        let at = |ns: i64| Arm::at(HostTime::from_ns(ns));
        let step_ns = (1e9 / RATE_HZ) as i64;
        for i in 0..2_000_i64 {
            let t = i * 7_300_001;
            let pairs = at(t).joints_rad.into_iter().zip(at(t + 1_000_000).joints_rad);
            assert!(pairs.map(|(a, b)| (a - b).abs()).all(|d| d < 0.01), "a jump at {t} ns");
            let shown = Arm::in_pose(Arm::pose_at(HostTime::from_ns(t)));
            let passed = at(t / step_ns * step_ns);
            let apart = |a: Arm, b: Arm| a.places()[3].distance(b.places()[3]);
            assert!(apart(shown, passed) < 1e-3, "{t}: {shown:?} {passed:?}");
        }
    }
}
