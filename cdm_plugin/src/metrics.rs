//! Metrics of depth against a reference: L1, RMSE, `AbsRel`, δ0.5, δ1, δ1.05, δ1.10, missing pixels, and the fill rate.
//!
//! With reference depth `d*` and predicted depth `d`, both in metres:
//! - a reference pixel *counts* when `d*` is finite, above 0 and within the [`DepthRange`];
//! - it is *valid* when `d` is finite and above 0 as well; there are `N` valid pixels;
//! - L1 = 1/N Σ|d − d*|, RMSE = √(1/N Σ(d − d*)²), `AbsRel` = 1/N Σ|d − d*|/d*;
//! - δt = 1/N #{max(d/d*, d*/d) < 1.25^t}, for t = 0.5 (1.118034) and t = 1 (1.25), strictly below; δ1.05 and δ1.10
//!   have the factors 1.05 and 1.10 themselves;
//! - the *strict* measures are over the pixels that count: a prediction that is missing is one of 0 m, as it is
//!   stored. Its error is `d*`, its relative error 1, and it is within no factor. Raw sensors have holes and models
//!   have none, so that comparing on valid pixels alone flatters the sensor; for the same reason `missing_percent`
//!   stands beside the others. A prediction that is not finite or not above 0 is missing as well.
//!
//! A measure over no pixels at all is NaN and [`DepthMetrics::is_empty`] says so; it is never 0, which would be
//! perfect. Everything is summed in `f64`.
//!
//! Over a dataset, the *mean of images* and the *pixel-pooled* value differ; [`Dataset`] gives both by name.

use crate::{Error, ErrorKind, Result};
use sums::{Sums, each};

mod dataset;
mod measured;
mod sums;

pub use dataset::{Dataset, DatasetMetrics};
pub use measured::{DistanceBin, ERROR_BOUNDS_M, ErrorHistogram, Measured, Rules};

/// A depth image, row by row without padding.
#[derive(Debug, Clone, Copy)]
pub enum Depth<'a> {
    /// 16-bit depth in units of `unit_m` metres; 0 is a hole.
    Units {
        /// The pixels.
        pixels: &'a [u16],
        /// Metres per unit.
        unit_m: f64,
    },
    /// Metres; NaN, infinity and values not above 0 are holes.
    Metres(&'a [f32]),
}

impl Depth<'_> {
    /// Number of pixels, holes included.
    pub const fn len(&self) -> usize {
        match self {
            Self::Units { pixels, .. } => pixels.len(),
            Self::Metres(pixels) => pixels.len(),
        }
    }

    /// Whether there are no pixels at all.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Metres at pixel `i`; `None` in a hole and outside.
    pub fn metres(&self, i: usize) -> Option<f64> {
        let d = match self {
            Self::Units { pixels, unit_m } => f64::from(*pixels.get(i)?) * unit_m,
            Self::Metres(pixels) => f64::from(*pixels.get(i)?),
        };
        (d.is_finite() && d > 0.0).then_some(d)
    }

    /// Whether pixel `i` is a number, a hole or not.
    pub(super) fn is_finite(&self, i: usize) -> bool {
        match self {
            Self::Units { .. } => true,
            Self::Metres(pixels) => pixels.get(i).is_some_and(|d| d.is_finite()),
        }
    }

    fn check(&self, what: &str) -> Result<()> {
        match self {
            Self::Units { unit_m, .. } if !(unit_m.is_finite() && *unit_m > 0.0) => Err(Error::new(
                ErrorKind::BadInput,
                format!("{what}: invalid depth unit {unit_m} m; it must be above 0, such as 0.001"),
            )),
            _ => Ok(()),
        }
    }
}

/// Share of the pixels that have a depth, 0 to 1; NaN when there are no pixels.
pub fn fill_rate(depth: &Depth<'_>) -> f64 {
    let filled = (0..depth.len()).filter(|i| depth.metres(*i).is_some()).count();
    filled as f64 / depth.len() as f64
}

/// The reference depths that count, metres, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthRange {
    /// The nearest.
    pub min_m: f64,
    /// The farthest.
    pub max_m: f64,
}

impl DepthRange {
    /// Every depth there is.
    pub const ALL: Self = Self { min_m: 0.0, max_m: f64::INFINITY };
}

/// Depth against a reference. Fractions are 0 to 1; NaN when there is nothing to divide by.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct DepthMetrics {
    /// Reference pixels that count.
    pub counted: u64,
    /// Of these, the ones where the prediction has a depth: the `N` of the plain measures.
    pub valid: u64,
    /// Mean absolute error, metres.
    pub l1_m: f64,
    /// Root of the mean squared error, metres.
    pub rmse_m: f64,
    /// Mean absolute error relative to the reference.
    pub abs_rel: f64,
    /// Share of valid pixels within a factor of 1.25^0.5.
    pub delta_05: f64,
    /// Share of valid pixels within a factor of 1.25.
    pub delta_1: f64,
    /// Share of valid pixels within a factor of 1.05.
    pub delta_105: f64,
    /// Share of valid pixels within a factor of 1.10.
    pub delta_110: f64,
    /// As `l1_m`, over all valid references; a missing pixel is off by its reference.
    pub strict_l1_m: f64,
    /// As `rmse_m`, over all valid references; a missing pixel is off by its reference.
    pub strict_rmse_m: f64,
    /// As `abs_rel`, over all valid references; a missing pixel is off by 1.
    pub strict_abs_rel: f64,
    /// As `delta_05`, over the pixels that count.
    pub strict_delta_05: f64,
    /// As `delta_1`, over the pixels that count.
    pub strict_delta_1: f64,
    /// As `delta_105`, over the pixels that count.
    pub strict_delta_105: f64,
    /// As `delta_110`, over the pixels that count.
    pub strict_delta_110: f64,
    /// Pixels that count and have no prediction, percent.
    pub missing_percent: f64,
}

impl DepthMetrics {
    /// Whether no pixel could be compared, so that the plain measures are NaN.
    pub const fn is_empty(&self) -> bool {
        self.valid == 0
    }
}

/// Compares `prediction` with `reference` where the reference lies in `range`.
///
/// # Errors
/// [`ErrorKind::SizeMismatch`] when they differ in the number of pixels, [`ErrorKind::BadInput`] for an invalid
/// unit or range.
pub fn compare(prediction: &Depth<'_>, reference: &Depth<'_>, range: DepthRange) -> Result<DepthMetrics> {
    let mut sums = Sums::default();
    each(prediction, reference, range, |_, seen, truth| sums.add(seen, truth))?;
    Ok(sums.metrics())
}

#[cfg(test)]
mod tests;
