//! Metrics by distance and material, and the histogram of errors.

use super::sums::{Sums, each};
use super::{Depth, DepthMetrics, DepthRange};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Bounds of the bins of [`ErrorHistogram`], metres: a third of a decade each.
pub const ERROR_BOUNDS_M: [f64; 13] =
    [0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0];

/// How many errors lie where.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
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

/// Everything that is measured of one image, or of several. In a file it is exact: what is read is what was written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    pub(super) sums: Sums,
    /// By number of the bin; those without a reference are left out.
    bins: BTreeMap<usize, Sums>,
    materials: BTreeMap<u8, Sums>,
    errors: ErrorHistogram,
    /// Pixels of the prediction that have a depth, and all of them.
    filled: (u64, u64),
    /// Pixels with a reference in range whose prediction is NaN or infinite.
    not_finite: u64,
}

/// Rules of a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rules {
    /// References that count.
    pub range: DepthRange,
    /// Width of a bin of distance, metres.
    pub bin_m: f64,
    /// Number of bins; the last one holds everything beyond.
    pub bins: usize,
    /// Leave out pixels whose prediction is NaN or infinite; otherwise it is missing.
    pub skip_not_finite: bool,
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
    /// Nothing yet.
    pub fn nothing() -> Self {
        Self {
            sums: Sums::default(),
            bins: BTreeMap::new(),
            materials: BTreeMap::new(),
            errors: ErrorHistogram::default(),
            filled: (0, 0),
            not_finite: 0,
        }
    }

    /// Measures `prediction` against `reference`; `material` has a number for each pixel.
    ///
    /// # Errors
    /// Those of [`super::compare`].
    pub fn of(
        prediction: &Depth<'_>,
        reference: &Depth<'_>,
        material: Option<&[u8]>,
        rules: &Rules,
    ) -> Result<Self> {
        if let Some(n) = material.map(<[u8]>::len).filter(|n| *n != reference.len()) {
            let r = reference.len();
            let message =
                format!("the materials have {n} pixels and the reference {r}; give images of one size");
            return Err(Error::new(ErrorKind::SizeMismatch, message));
        }
        let mut m = Self::nothing();
        let last = rules.bins.max(1) - 1;
        each(prediction, reference, rules.range, |i, seen, truth| {
            if !prediction.is_finite(i) {
                m.not_finite += 1;
                if rules.skip_not_finite {
                    return;
                }
            }
            m.sums.add(seen, truth);
            let bin = ((truth / rules.bin_m) as usize).min(last);
            m.bins.entry(bin).or_default().add(seen, truth);
            if let Some(material) = material {
                m.materials.entry(material[i]).or_default().add(seen, truth);
            }
            m.errors.add(seen, truth);
        })?;
        let filled = (0..prediction.len()).filter(|i| prediction.metres(*i).is_some()).count();
        m.filled = (filled as u64, prediction.len() as u64);
        Ok(m)
    }

    /// Both together, as if all pixels were of one image. The rules must be the same.
    pub fn plus(&mut self, other: &Self) {
        self.sums = self.sums.plus(other.sums);
        for (bin, sums) in &other.bins {
            let mine = self.bins.entry(*bin).or_default();
            *mine = mine.plus(*sums);
        }
        for (material, sums) in &other.materials {
            let mine = self.materials.entry(*material).or_default();
            *mine = mine.plus(*sums);
        }
        self.errors = self.errors.plus(&other.errors);
        self.filled = (self.filled.0 + other.filled.0, self.filled.1 + other.filled.1);
        self.not_finite += other.not_finite;
    }

    /// The measures of all pixels.
    pub fn metrics(&self) -> DepthMetrics {
        self.sums.metrics()
    }

    /// The measures by distance of the reference, nearest first; all bins of `rules`.
    pub fn by_distance(&self, rules: &Rules) -> Vec<DistanceBin> {
        let bin = |i: usize| DistanceBin {
            from_m: i as f64 * rules.bin_m,
            to_m: (i + 1) as f64 * rules.bin_m,
            metrics: self.bins.get(&i).copied().unwrap_or_default().metrics(),
        };
        (0..rules.bins.max(1)).map(bin).collect()
    }

    /// The measures by number of the material.
    pub fn by_material(&self) -> BTreeMap<u8, DepthMetrics> {
        self.materials.iter().map(|(number, sums)| (*number, sums.metrics())).collect()
    }

    /// Pixels with a reference in range whose prediction is NaN or infinite.
    pub const fn not_finite(&self) -> u64 {
        self.not_finite
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
