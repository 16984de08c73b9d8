//! An adjustment that recognises corners which are not where they were said to be.

use crate::adjustment::{Options, Problem, Solution};
use depthrig_calib::Result;

/// A corner that the adjustment left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlier {
    /// Index of its sighting.
    pub sighting: usize,
    /// Index of the corner in the sighting as it was given.
    pub corner: usize,
    /// How far it is from its place, pixels.
    pub distance_px: f64,
}

/// An adjustment without its outliers.
#[derive(Debug, Clone, PartialEq)]
pub struct RobustSolution {
    /// Of the corners that were kept.
    pub solution: Solution,
    /// Those that were left out, worst first.
    pub outliers: Vec<Outlier>,
}

/// A residual longer than this many standard deviations is an outlier: one right corner in 270,000 is.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Median of the length of a vector of two independent normal coordinates, in standard deviations: √(2 ln 2).
const RAYLEIGH_MEDIAN: f64 = 1.177_410_022_515_474_7;
/// Rounds of leaving out.
const ROUNDS: usize = 8;

/// Solves with Huber's loss, leaves out corners far from their places, and solves again by least squares until none is left.
/// The standard deviation comes from the median of the residuals, which outliers do not move.
///
/// # Errors
/// As [`Problem::solve`].
pub fn solve(problem: &mut Problem) -> Result<RobustSolution> {
    let mut kept: Vec<Vec<usize>> =
        problem.sightings.iter().map(|s| (0..s.corners.len()).collect()).collect();
    let mut outliers = Vec::new();
    let mut solution = problem.solve(&Options { huber_px: Some(1.0), ..Options::default() })?;
    for _ in 0..ROUNDS {
        let limit = OUTLIER_SIGMAS * median_sigma(&solution);
        let before = outliers.len();
        for (index, sighting) in problem.sightings.iter_mut().enumerate() {
            for (i, residual) in solution.residuals[index].iter().enumerate().rev() {
                let distance_px = residual.length();
                if distance_px > limit {
                    sighting.corners.remove(i);
                    outliers.push(Outlier { sighting: index, corner: kept[index].remove(i), distance_px });
                }
            }
        }
        solution = problem.solve(&Options::default())?;
        if outliers.len() == before {
            break;
        }
    }
    outliers.sort_by(|a, b| b.distance_px.total_cmp(&a.distance_px));
    Ok(RobustSolution { solution, outliers })
}

/// Standard deviation of a coordinate from the median length of the residuals, pixels.
fn median_sigma(solution: &Solution) -> f64 {
    let mut lengths: Vec<f64> = solution.residuals.iter().flatten().map(|r| r.length()).collect();
    if lengths.is_empty() {
        return 0.0;
    }
    let middle = lengths.len() / 2;
    let (_, median, _) = lengths.select_nth_unstable_by(middle, f64::total_cmp);
    *median / RAYLEIGH_MEDIAN
}
