//! Metrics by distance, and the histogram of errors.

use super::sums::{Sums, each};
use super::{Depth, DepthMetrics, DepthRange};
use crate::Result;

/// Bounds of the bins of [`ErrorHistogram`], metres: a third of a decade each.
pub const ERROR_BOUNDS_M: [f64; 13] =
    [0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0];

/// How many errors lie where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ErrorHistogram {
    /// Errors below the first bound, between each bound and the next, and from the last on.
    pub counts: [u64; ERROR_BOUNDS_M.len() + 1],
    /// Pixels that count and have no prediction.
    pub missing: u64,
}

impl ErrorHistogram {
    fn add(&mut self, seen: Option<f64>, truth: f64) {
        match seen {
            None => self.missing += 1,
            Some(seen) => {
                let error = (seen - truth).abs();
                self.counts[ERROR_BOUNDS_M.partition_point(|b| *b <= error)] += 1;
            }
        }
    }

    fn plus(mut self, other: &Self) -> Self {
        for (a, b) in self.counts.iter_mut().zip(other.counts) {
            *a += b;
        }
        self.missing += other.missing;
        self
    }
}

/// Everything that is measured of one image, or of several.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    pub(super) sums: Sums,
    /// Width of a bin of distance, metres.
    bin_m: f64,
    bins: Vec<Sums>,
    errors: ErrorHistogram,
    /// Pixels of the prediction that have a depth, and all of them.
    filled: (u64, u64),
}

/// The measures of the references within a distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DistanceBin {
    /// The nearest, metres, included.
    pub from_m: f64,
    /// The farthest, metres, not included but in the last bin, which holds all that is farther as well.
    pub to_m: f64,
    /// The measures.
    pub metrics: DepthMetrics,
}

impl Measured {
    /// Nothing yet, for `bins` bins of `bin_m` metres from 0 on.
    pub fn nothing(bin_m: f64, bins: usize) -> Self {
        Self {
            sums: Sums::default(),
            bin_m,
            bins: vec![Sums::default(); bins.max(1)],
            errors: ErrorHistogram::default(),
            filled: (0, 0),
        }
    }

    /// Measures `prediction` against `reference` where the reference lies in `range`.
    ///
    /// # Errors
    /// Those of [`super::compare`].
    pub fn of(
        prediction: &Depth<'_>,
        reference: &Depth<'_>,
        range: DepthRange,
        (bin_m, bins): (f64, usize),
    ) -> Result<Self> {
        let mut m = Self::nothing(bin_m, bins);
        let last = m.bins.len() - 1;
        each(prediction, reference, range, |_, seen, truth| {
            m.sums.add(seen, truth);
            m.bins[((truth / bin_m) as usize).min(last)].add(seen, truth);
            m.errors.add(seen, truth);
        })?;
        let filled = (0..prediction.len()).filter(|i| prediction.metres(*i).is_some()).count();
        m.filled = (filled as u64, prediction.len() as u64);
        Ok(m)
    }

    /// Both together, as if all pixels were of one image. The bins must be the same.
    pub fn plus(&mut self, other: &Self) {
        self.sums = self.sums.plus(other.sums);
        for (a, b) in self.bins.iter_mut().zip(&other.bins) {
            *a = a.plus(*b);
        }
        self.errors = self.errors.plus(&other.errors);
        self.filled = (self.filled.0 + other.filled.0, self.filled.1 + other.filled.1);
    }

    /// The measures of all pixels.
    pub fn metrics(&self) -> DepthMetrics {
        self.sums.metrics()
    }

    /// The measures by distance of the reference, nearest first.
    pub fn by_distance(&self) -> Vec<DistanceBin> {
        let bin = |(i, sums): (usize, &Sums)| DistanceBin {
            from_m: i as f64 * self.bin_m,
            to_m: (i + 1) as f64 * self.bin_m,
            metrics: sums.metrics(),
        };
        self.bins.iter().enumerate().map(bin).collect()
    }

    /// How large the errors are.
    pub const fn errors(&self) -> &ErrorHistogram {
        &self.errors
    }

    /// Share of the pixels of the prediction that have a depth, whether or not there is a reference, 0 to 1; NaN when
    /// there are no pixels.
    pub fn fill_rate(&self) -> f64 {
        self.filled.0 as f64 / self.filled.1 as f64
    }
}
