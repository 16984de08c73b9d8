//! Whether the board stands still.

use crate::rig::Seen;
use std::collections::VecDeque;

/// The board stands still while no corner moves further than this, pixels.
pub const STILL_PX: f64 = 0.3;
/// Rounds in a row without motion.
pub const STILL_ROUNDS: usize = 3;
/// Share of the corners that may move further: one at a reflection does not hold everything up.
const STRAY: f64 = 0.05;

/// Follows the board from round to round.
#[derive(Debug, Clone, Default)]
pub(super) struct Stillness {
    rounds: VecDeque<Vec<Seen>>,
}

/// Result of [`Stillness`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Motion {
    /// No camera sees the board.
    Unseen,
    /// It moves, or has not been looked at long enough.
    Moving,
    /// It moved a round ago at the latest, and does not now.
    Settling,
    /// It stands still.
    Still,
}

impl Stillness {
    /// Looks at the next round.
    pub(super) fn look(&mut self, seen: &[Seen]) -> Motion {
        self.rounds.push_back(seen.to_vec());
        while self.rounds.len() > STILL_ROUNDS {
            self.rounds.pop_front();
        }
        if seen.is_empty() {
            return Motion::Unseen;
        }
        // Against the newest round, so that a slow drift is not taken for rest.
        let mut unmoved = 1;
        for earlier in self.rounds.iter().rev().skip(1) {
            match motion(earlier, seen) {
                Some(moved) if moved <= STILL_PX => unmoved += 1,
                _ => break,
            }
        }
        match unmoved {
            STILL_ROUNDS => Motion::Still,
            1 => Motion::Moving,
            _ => Motion::Settling,
        }
    }

    /// Of the newest round the cameras that have seen the board in every round: what flickers is not measured.
    pub(super) fn steady(&self) -> Vec<Seen> {
        let newest = self.rounds.back().map_or(&[][..], Vec::as_slice);
        let always =
            |camera: usize| self.rounds.iter().all(|round| round.iter().any(|seen| seen.camera == camera));
        newest.iter().filter(|seen| always(seen.camera)).cloned().collect()
    }
}

/// How far corners moved, pixels: in the camera in which most of them moved furthest, without the stray ones. `None` where no corner is in both.
pub(super) fn motion(before: &[Seen], after: &[Seen]) -> Option<f64> {
    let of_camera = |seen: &Seen| {
        let earlier = before.iter().find(|b| b.camera == seen.camera)?;
        let mut moved = displacements(earlier, seen);
        moved.sort_by(f64::total_cmp);
        let stray = (moved.len() as f64 * STRAY) as usize;
        moved.get(moved.len().checked_sub(stray + 1)?).copied()
    };
    after.iter().filter_map(of_camera).max_by(f64::total_cmp)
}

/// How far each corner that is in both moved, pixels.
pub(super) fn displacements(before: &Seen, after: &Seen) -> Vec<f64> {
    let of_corner = |corner: &crate::adjustment::Corner| {
        let same = before.corners.iter().find(|c| c.point == corner.point)?;
        Some((same.pixel - corner.pixel).length())
    };
    after.corners.iter().filter_map(of_corner).collect()
}
