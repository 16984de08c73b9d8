//! Whether the robot's poses and the board's belong together.

use super::{Noise, Sight, bad, closed_form};
use crate::Distance;
use depthrig_calib::Result;

/// A view's board may be this far from where the others put it (median), whatever the robot.
const FAR_M: f64 = 0.03;
const FAR_RAD: f64 = 0.09;
/// And this many of the robot's standard deviations.
const FAR_SIGMAS: f64 = 20.0;

/// For each view the closed form of the others, and how far this one's board is from theirs.
pub(super) fn held_out(sights: &[Sight]) -> Result<Vec<Distance>> {
    if sights.len() < 4 {
        return Ok(Vec::new());
    }
    (0..sights.len())
        .map(|i| {
            let others: Vec<Sight> =
                sights.iter().enumerate().filter(|(k, _)| *k != i).map(|(_, s)| *s).collect();
            let state = closed_form(&others)?;
            let seen = sights[i].motion.after(&state.camera).after(&sights[i].camera_from_board);
            Ok(seen.distance(&state.board))
        })
        .collect()
}

/// Refuses views whose poses contradict each other, and says what would make them agree.
pub(super) fn check(held_out: &[Distance], sights: &[Sight], noise: &Noise) -> Result<()> {
    let Some(found) = median(held_out) else { return Ok(()) };
    let is_far = |d: &Distance| {
        d.metres > FAR_M.max(FAR_SIGMAS * noise.robot_m)
            || d.radians > FAR_RAD.max(FAR_SIGMAS * noise.robot_rad)
    };
    if !is_far(&found) {
        return Ok(());
    }
    let cures = [
        (
            inverted(sights),
            "they would with the other arrangement (--eye-to-hand given or not), or with each pose inverted: the hand in the base is wanted",
        ),
        (shifted(sights, true), "they would with each view's pose given to the view before it"),
        (shifted(sights, false), "they would with each view's pose given to the view after it"),
    ];
    let cure = cures
        .iter()
        .find(|(sights, _)| self::held_out(sights).ok().and_then(|d| median(&d)).is_some_and(|d| !is_far(&d)))
        .map_or("check which pose belongs to which view, the poses' units, and the order of a quaternion's numbers", |c| c.1);
    Err(bad(format!(
        "the robot's poses and the board's do not belong together: a view's board is {:.0} mm and {:.0} degrees (median) from where the other \
         views put it; {cure}",
        found.metres * 1e3,
        found.radians.to_degrees()
    )))
}

/// Of millimetres and of angles.
fn median(all: &[Distance]) -> Option<Distance> {
    let of = |value: fn(&Distance) -> f64| {
        let mut all: Vec<f64> = all.iter().map(value).collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied()
    };
    Some(Distance { metres: of(|d| d.metres)?, radians: of(|d| d.radians)? })
}

fn inverted(sights: &[Sight]) -> Vec<Sight> {
    sights.iter().map(|s| Sight { motion: s.motion.inverse(), ..*s }).collect()
}

/// Each view with the motion of the one after it, or of the one before it.
fn shifted(sights: &[Sight], forward: bool) -> Vec<Sight> {
    let (images, motions) = if forward { (0, 1) } else { (1, 0) };
    sights[images..].iter().zip(&sights[motions..]).map(|(s, m)| Sight { motion: m.motion, ..*s }).collect()
}
