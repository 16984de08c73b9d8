//! How the board moves. Poses are of the sheet's middle in the mount's frame (x right, y down, z forward); without a turn the
//! print faces the mount.

use super::super::noise::Rolls;
use core::f64::consts::TAU;
use glam::{DAffine3, DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};

/// From one place to the next, seconds.
const MOVE_S: f64 = 0.5;
/// Places of the wall, and the nearest and the farthest of them, metres.
const WALL_PLACES: u64 = 8;
const WALL_M: [f64; 2] = [0.45, 1.6];

/// How the board moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BoardMotion {
    /// Rests at places drawn at random, and moves on.
    Steps,
    /// Moves all the time.
    Wave,
    /// Rests at eight distances from 0.45 to 1.6 m, on a wall that fills the image.
    Wall,
    /// Is not there.
    Away,
}

impl BoardMotion {
    /// Every motion.
    pub const ALL: [Self; 4] = [Self::Steps, Self::Wave, Self::Wall, Self::Away];

    /// The pose after `seconds`; `None` while it is away.
    pub(super) fn pose(self, seed: u64, hold_s: f64, seconds: f64) -> Option<DAffine3> {
        match self {
            Self::Steps => Some(rest(|k| place(seed, k), hold_s, seconds)),
            Self::Wall => Some(rest(|k| wall(seed, k), hold_s, seconds)),
            Self::Wave => Some(wave(seed, seconds)),
            Self::Away => None,
        }
    }
}

/// A place in the space in front of the mount.
#[derive(Debug, Clone, Copy)]
struct Place {
    turn: DQuat,
    at: DVec3,
}

/// Rests at each place for `hold_s` and moves on smoothly.
fn rest(places: impl Fn(u64) -> Place, hold_s: f64, seconds: f64) -> DAffine3 {
    let period = hold_s + MOVE_S;
    let k = (seconds / period) as u64;
    let s = ((seconds - k as f64 * period - hold_s) / MOVE_S).clamp(0.0, 1.0);
    let s = s * s * (3.0 - 2.0 * s);
    let from = places(k);
    let to = places(k + 1);
    DAffine3::from_rotation_translation(from.turn.slerp(to.turn, s), from.at.lerp(to.at, s))
}

/// Evenly in -1..1.
fn even(rolls: Rolls, i: u64) -> f64 {
    2.0 * rolls.unit_f64(i) - 1.0
}

fn place(seed: u64, k: u64) -> Place {
    let rolls = Rolls::new(seed, k as u32, 17, 0);
    let z = 0.6 + 0.2 * even(rolls, 2);
    // Farther away the cameras see more.
    let at = DVec3::new(0.3 * z * even(rolls, 0), 0.22 * z * even(rolls, 1), z);
    let tilt = 0.6; // radians
    let turn =
        DQuat::from_euler(EulerRot::ZYX, 0.5 * even(rolls, 5), tilt * even(rolls, 4), tilt * even(rolls, 3));
    Place { turn, at }
}

fn wall(seed: u64, k: u64) -> Place {
    let rolls = Rolls::new(seed, k as u32, 18, 0);
    let share = (k % WALL_PLACES) as f64 / (WALL_PLACES - 1) as f64;
    let z = WALL_M[0] * (WALL_M[1] / WALL_M[0]).powf(share);
    let turn = DQuat::from_euler(EulerRot::ZYX, 0.0, 0.08 * even(rolls, 1), 0.08 * even(rolls, 0));
    Place { turn, at: DVec3::new(0.0, 0.0, z) }
}

/// Sums of sines whose periods have no common multiple soon.
fn wave(seed: u64, seconds: f64) -> DAffine3 {
    let rolls = Rolls::new(seed, 0, 19, 0);
    let sway = |i: u64, size: f64, hz: f64| {
        let phase = TAU * rolls.unit_f64(i);
        size * (0.7 * (TAU * hz * seconds + phase).sin()
            + 0.3 * (TAU * 1.7 * hz * seconds + 2.0 * phase).sin())
    };
    let at = DVec3::new(sway(0, 0.13, 0.61), sway(1, 0.09, 0.73), 0.6 + sway(2, 0.06, 0.47));
    let turn = DQuat::from_euler(EulerRot::ZYX, sway(5, 0.35, 0.53), sway(4, 0.4, 0.41), sway(3, 0.4, 0.37));
    DAffine3::from_rotation_translation(turn, at)
}
