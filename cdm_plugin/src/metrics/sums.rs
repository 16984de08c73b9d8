//! The sums that every measure is made of.

use super::{Depth, DepthMetrics, DepthRange};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// The factors of δ0.5 (1.25^0.5), δ1, δ1.05 and δ1.10.
const FACTORS: [f64; 4] = [1.118_033_988_749_895, 1.25, 1.05, 1.10];

/// The sums that every measure is made of; those of several images add up.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(try_from = "Flat", into = "Flat")]
pub(super) struct Sums {
    pub(super) counted: u64,
    pub(super) valid: u64,
    /// Pixels within each of [`FACTORS`].
    within: [u64; 4],
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
        for (n, limit) in self.within.iter_mut().zip(FACTORS) {
            *n += u64::from(factor < limit);
        }
    }

    pub(super) fn plus(self, other: Self) -> Self {
        Self {
            counted: self.counted + other.counted,
            valid: self.valid + other.valid,
            within: core::array::from_fn(|i| self.within[i] + other.within[i]),
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
        let [delta_05, delta_1, delta_105, delta_110] = self.within.map(|w| w as f64 / n);
        let strict = self.within.map(|w| w as f64 / counted);
        DepthMetrics {
            counted: self.counted,
            valid: self.valid,
            l1_m: self.abs_m / n,
            rmse_m: (self.square_m2 / n).sqrt(),
            abs_rel: self.relative / n,
            delta_05,
            delta_1,
            delta_105,
            delta_110,
            strict_l1_m: (self.abs_m + self.missing_m) / counted,
            strict_rmse_m: ((self.square_m2 + self.missing_square_m2) / counted).sqrt(),
            strict_abs_rel: (self.relative + missing) / counted,
            strict_delta_05: strict[0],
            strict_delta_1: strict[1],
            strict_delta_105: strict[2],
            strict_delta_110: strict[3],
            missing_percent: 100.0 * missing / counted,
        }
    }
}

/// [`Sums`] in a file: counts as numbers, sums as text, because a reader of JSON may round a number.
#[derive(Serialize, Deserialize)]
struct Flat([u64; 6], [String; 5]);

impl From<Sums> for Flat {
    fn from(s: Sums) -> Self {
        let [a, b, c, d] = s.within;
        let sums = [s.abs_m, s.square_m2, s.relative, s.missing_m, s.missing_square_m2];
        // The shortest text that is read as the same number.
        Self([s.counted, s.valid, a, b, c, d], sums.map(|v| v.to_string()))
    }
}

impl TryFrom<Flat> for Sums {
    type Error = String;

    fn try_from(Flat([counted, valid, a, b, c, d], sums): Flat) -> core::result::Result<Self, String> {
        let mut numbers = [0.0; 5];
        for (number, text) in numbers.iter_mut().zip(&sums) {
            *number = text.parse().map_err(|_| format!("{text} is not a sum"))?;
        }
        let [abs_m, square_m2, relative, missing_m, missing_square_m2] = numbers;
        if valid > counted {
            return Err(format!("{valid} valid pixels of {counted}"));
        }
        let within = [a, b, c, d];
        Ok(Self { counted, valid, within, abs_m, square_m2, relative, missing_m, missing_square_m2 })
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
