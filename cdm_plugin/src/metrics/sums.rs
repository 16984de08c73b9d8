//! The sums that every measure is made of.

use super::{Depth, DepthMetrics, DepthRange};
use crate::{Error, ErrorKind, Result};

/// 1.25^0.5, the threshold of δ0.5.
const DELTA_05: f64 = 1.118_033_988_749_895;
/// The threshold of δ1.
const DELTA_1: f64 = 1.25;

/// The sums that every measure is made of; those of several images add up.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Sums {
    pub(super) counted: u64,
    pub(super) valid: u64,
    within_05: u64,
    within_1: u64,
    abs_m: f64,
    square_m2: f64,
    relative: f64,
    /// Of the references whose prediction is missing: what a prediction of 0 is off by.
    missing_m: f64,
    missing_square_m2: f64,
}

impl Sums {
    /// One pixel whose reference counts.
    pub(super) fn add(&mut self, seen: Option<f64>, truth: f64) {
        self.counted += 1;
        let Some(seen) = seen else {
            self.missing_m += truth;
            self.missing_square_m2 += truth * truth;
            return;
        };
        let error = (seen - truth).abs();
        let factor = (seen / truth).max(truth / seen);
        self.valid += 1;
        self.abs_m += error;
        self.square_m2 += error * error;
        self.relative += error / truth;
        self.within_05 += u64::from(factor < DELTA_05);
        self.within_1 += u64::from(factor < DELTA_1);
    }

    pub(super) fn plus(self, other: Self) -> Self {
        Self {
            counted: self.counted + other.counted,
            valid: self.valid + other.valid,
            within_05: self.within_05 + other.within_05,
            within_1: self.within_1 + other.within_1,
            abs_m: self.abs_m + other.abs_m,
            square_m2: self.square_m2 + other.square_m2,
            relative: self.relative + other.relative,
            missing_m: self.missing_m + other.missing_m,
            missing_square_m2: self.missing_square_m2 + other.missing_square_m2,
        }
    }

    /// Division by no pixels is 0/0, and that is NaN as it should be.
    pub(super) fn metrics(&self) -> DepthMetrics {
        let n = self.valid as f64;
        let counted = self.counted as f64;
        let missing = (self.counted - self.valid) as f64;
        DepthMetrics {
            counted: self.counted,
            valid: self.valid,
            l1_m: self.abs_m / n,
            rmse_m: (self.square_m2 / n).sqrt(),
            abs_rel: self.relative / n,
            delta_05: self.within_05 as f64 / n,
            delta_1: self.within_1 as f64 / n,
            strict_l1_m: (self.abs_m + self.missing_m) / counted,
            strict_rmse_m: ((self.square_m2 + self.missing_square_m2) / counted).sqrt(),
            strict_abs_rel: (self.relative + missing) / counted,
            strict_delta_05: self.within_05 as f64 / counted,
            strict_delta_1: self.within_1 as f64 / counted,
            missing_percent: 100.0 * missing / counted,
        }
    }
}

/// Calls `pixel` with the number, the prediction and the reference of every pixel whose reference counts.
pub(super) fn each(
    prediction: &Depth<'_>,
    reference: &Depth<'_>,
    range: DepthRange,
    mut pixel: impl FnMut(usize, Option<f64>, f64),
) -> Result<()> {
    if prediction.len() != reference.len() {
        let p = prediction.len();
        let r = reference.len();
        let message =
            format!("the prediction has {p} pixels and its reference {r}; compare images of one size");
        return Err(Error::new(ErrorKind::SizeMismatch, message));
    }
    prediction.check("prediction")?;
    reference.check("reference")?;
    let DepthRange { min_m, max_m } = range;
    if min_m.is_nan() || max_m.is_nan() || min_m > max_m {
        let message = format!("invalid depth range {min_m}..={max_m} m; the nearest comes first");
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    for i in 0..reference.len() {
        if let Some(truth) = reference.metres(i).filter(|d| min_m <= *d && *d <= max_m) {
            pixel(i, prediction.metres(i), truth);
        }
    }
    Ok(())
}
