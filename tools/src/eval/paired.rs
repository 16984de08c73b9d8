//! Paired differences between two rows, with a confidence interval by bootstrap over sequences.
//!
//! The difference is taken image by image and averaged. Images of one sequence resemble each other, so whole sequences are
//! drawn with replacement (B. Efron and R. Tibshirani, "An Introduction to the Bootstrap", 1993: percentile interval).

use depthrig_cdm::metrics::DepthMetrics;
use serde::Serialize;
use std::collections::BTreeMap;

/// Draws of all sequences.
const DRAWS: usize = 2000;
/// Part of the draws outside of the interval at each end.
const TAIL: f64 = 0.025;
const SEED: u64 = 0x00c0_ffee;

/// Sums of the differences of one sequence.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    strict_images: f64,
    strict_m: f64,
    plain_images: f64,
    plain_m: f64,
}

/// Collects differences between a row and the first one.
#[derive(Debug, Clone, Default)]
pub struct Paired {
    sequences: BTreeMap<String, Sums>,
    images: u64,
}

/// The difference to the first row.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The row it is to.
    pub to: String,
    /// Images that both have.
    pub images: u64,
    /// Their sequences.
    pub sequences: u64,
    /// Of strict L1, metres: below 0 is better.
    pub strict_l1_m: Interval,
    /// Of L1, metres, in images where both have one.
    pub l1_m: Interval,
}

/// A mean with its 95 % interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    /// The mean over images.
    pub mean: f64,
    /// Lower end; none with a single sequence.
    pub low: Option<f64>,
    /// Upper end.
    pub high: Option<f64>,
}

impl Paired {
    /// Adds an image.
    pub fn add(&mut self, sequence: &str, row: &DepthMetrics, first: &DepthMetrics) {
        let strict = row.strict_l1_m - first.strict_l1_m;
        let plain = row.l1_m - first.l1_m;
        if strict.is_nan() {
            return;
        }
        if !self.sequences.contains_key(sequence) {
            self.sequences.insert(sequence.to_owned(), Sums::default());
        }
        let Some(sums) = self.sequences.get_mut(sequence) else { return };
        self.images += 1;
        sums.strict_images += 1.0;
        sums.strict_m += strict;
        if !plain.is_nan() {
            sums.plain_images += 1.0;
            sums.plain_m += plain;
        }
    }

    /// The difference to the row called `to`; `None` when no image has both.
    pub fn difference(&self, to: &str) -> Option<Difference> {
        if self.images == 0 {
            return None;
        }
        let of = |sum: fn(&Sums) -> f64, count: fn(&Sums) -> f64| {
            let pairs: Vec<[f64; 2]> = self.sequences.values().map(|s| [sum(s), count(s)]).collect();
            interval(&pairs)
        };
        Some(Difference {
            to: to.to_owned(),
            images: self.images,
            sequences: self.sequences.len() as u64,
            strict_l1_m: of(|s| s.strict_m, |s| s.strict_images),
            l1_m: of(|s| s.plain_m, |s| s.plain_images),
        })
    }
}

/// The mean of all and its interval, from the sum and the number of each sequence.
fn interval(sequences: &[[f64; 2]]) -> Interval {
    let mean = |of: &mut dyn Iterator<Item = [f64; 2]>| {
        let [sum, count] = of.fold([0.0, 0.0], |[a, b], [c, d]| [a + c, b + d]);
        sum / count
    };
    let whole = mean(&mut sequences.iter().copied());
    if sequences.len() < 2 || whole.is_nan() {
        return Interval { mean: whole, low: None, high: None };
    }
    let mut random = Random(SEED);
    let n = sequences.len();
    let draw = |_| mean(&mut (0..n).map(|_| sequences[random.below(n)]));
    let mut means: Vec<f64> = (0..DRAWS).map(draw).filter(|m| !m.is_nan()).collect();
    means.sort_unstable_by(f64::total_cmp);
    let cut = (means.len() as f64 * TAIL) as usize;
    let at = |i: usize| means.get(i).copied();
    Interval { mean: whole, low: at(cut), high: at(means.len().saturating_sub(cut + 1)) }
}

/// splitmix64 (S. Vigna, public domain).
struct Random(u64);

impl Random {
    /// A number below `n`.
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
        ((u128::from(z) * n as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The interval of a mean of many sequences is that of the normal distribution.
    #[test]
    fn the_interval_is_two_standard_errors_wide() {
        let mut random = Random(1);
        let values: Vec<f64> =
            (0..400).map(|_| (0..12).map(|_| random.below(1000) as f64 / 1000.0).sum()).collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let sd = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        let pairs: Vec<[f64; 2]> = values.iter().map(|v| [*v, 1.0]).collect();
        let got = interval(&pairs);
        assert!((got.mean - mean).abs() < 1e-12);
        let half = 1.96 * sd / n.sqrt();
        for end in [mean - got.low.unwrap(), got.high.unwrap() - mean] {
            assert!((end / half - 1.0).abs() < 0.12, "{end} {half}");
        }
        assert_eq!(interval(&pairs), got, "the seed is fixed");
    }

    #[test]
    fn sequences_are_drawn_and_not_images() {
        // 50 images in each of two sequences that disagree: nothing is known.
        let got = interval(&[[50.0, 50.0], [-50.0, 50.0]]);
        assert_eq!((got.mean, got.low, got.high), (0.0, Some(-1.0), Some(1.0)));
        assert_eq!(interval(&[[2.0, 4.0]]), Interval { mean: 0.5, low: None, high: None });
    }
}
