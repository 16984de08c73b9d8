//! The systematic error of a depth camera, from a board on a wall at several distances.
//!
//! The truth is the plane of the board, from its corners in a calibrated image of the same camera. [`PlaneMeter`] compares
//! depth frames of one place with it, [`choose`] finds the correction that explains all places.

mod correction;
mod fit;
mod plane;
mod sigma;
#[cfg(test)]
mod tests;

pub use correction::{Correction, Model};
pub use fit::{Candidate, Choice, Observation, choose};
pub use plane::{Measured, PlaneMeter};
pub use sigma::plane_sigma_m;

/// Distances that a correction needs at least.
pub const MIN_DISTANCES: usize = 5;
/// Two places whose distances differ by less than this share are one distance.
const SAME_DISTANCE: f64 = 0.04;

/// Number of distances that are really different.
pub fn distinct(distances_m: impl IntoIterator<Item = f64>) -> usize {
    let mut sorted: Vec<f64> = distances_m.into_iter().filter(|d| d.is_finite() && *d > 0.0).collect();
    sorted.sort_by(f64::total_cmp);
    let mut last = 0.0;
    let mut count = 0;
    for distance in sorted {
        if distance > last * (1.0 + SAME_DISTANCE) {
            count += 1;
            last = distance;
        }
    }
    count
}
