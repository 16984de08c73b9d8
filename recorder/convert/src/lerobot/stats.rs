//! Statistics as LeRobot computes them (`compute_stats.py` of lerobot 0.6.1): minimum, maximum, mean, standard deviation,
//! count and five quantiles per channel, from a sample of the images, in constant memory.
//!
//! Whole numbers are counted by value, so that everything follows exactly and parts add up. Quantiles are read
//! from 5,000 equal bins between minimum and maximum, as LeRobot reads them.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// The quantiles by name.
pub(super) const QUANTILES: [(&str, f64); 5] =
    [("q01", 0.01), ("q10", 0.10), ("q50", 0.50), ("q90", 0.90), ("q99", 0.99)];
const BINS: usize = 5000;

/// Pixel values of one image, channel by channel within a pixel.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Samples {
    U8(Vec<u8>),
    U16(Vec<u16>),
    F32(Vec<f32>),
}

/// Statistics of one channel so far.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Channel {
    /// How often each value was seen; for floats, the value of the upper 20 bits.
    counts: BTreeMap<u32, u64>,
    /// Sums and extremes; only of floats, as those of whole numbers follow from the counts.
    sum: f64,
    sum_of_squares: f64,
    min: f64,
    max: f64,
}

/// Statistics of an image feature in the making; parts can be added.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ImageStats {
    channels: Vec<Channel>,
    float: bool,
    images: u64,
}

/// Finished statistics, one value per channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Stats {
    pub(super) count: u64,
    pub(super) min: Vec<f64>,
    pub(super) max: Vec<f64>,
    pub(super) mean: Vec<f64>,
    pub(super) std: Vec<f64>,
    /// In the order of [`QUANTILES`]; empty without quantiles.
    pub(super) quantiles: Vec<Vec<f64>>,
}

/// Positive floats in 2^20 buckets of equal relative width (2^-11): their upper bits, which are in order.
const FLOAT_SHIFT: u32 = 12;

impl ImageStats {
    /// Adds one image of `channels` channels.
    pub(super) fn add(&mut self, channels: usize, samples: &Samples) {
        self.channels.resize(channels, Channel::default());
        self.images += 1;
        match samples {
            Samples::U8(v) => self.count_all(channels, v),
            Samples::U16(v) => self.count_all(channels, v),
            Samples::F32(v) => {
                self.float = true;
                // NaN is a way of saying "no depth"; one of them would make every number NaN.
                v.iter().filter(|x| x.is_finite()).for_each(|x| self.channels[0].add_float(*x));
            }
        }
    }

    fn count_all<T: Copy + Into<u32>>(&mut self, channels: usize, values: &[T]) {
        let mut seen = vec![0_u64; 1 << (8 * size_of::<T>())];
        for (c, channel) in self.channels.iter_mut().enumerate() {
            seen.fill(0);
            values.iter().skip(c).step_by(channels).for_each(|v| seen[(*v).into() as usize] += 1);
            for (value, n) in seen.iter().enumerate().filter(|(_, n)| **n > 0) {
                *channel.counts.entry(value as u32).or_default() += n;
            }
        }
    }

    /// Adds what another part found.
    pub(super) fn merge(&mut self, other: &Self) {
        if other.images == 0 {
            return;
        }
        self.channels.resize(other.channels.len(), Channel::default());
        self.float |= other.float;
        self.images += other.images;
        for (to, from) in self.channels.iter_mut().zip(&other.channels) {
            to.merge(from);
        }
    }

    /// The statistics, values divided by `divisor`; `None` when nothing was seen.
    pub(super) fn finish(&self, divisor: f64) -> Option<Stats> {
        let channels = self.channels.iter().map(|c| c.finish(self.float));
        let channels = channels.collect::<Option<Vec<_>>>().filter(|c| !c.is_empty())?;
        let each = |f: &dyn Fn(&Finished) -> f64| channels.iter().map(|c| f(c) / divisor).collect::<Vec<_>>();
        Some(Stats {
            count: self.images,
            min: each(&|c| c.min),
            max: each(&|c| c.max),
            mean: each(&|c| c.mean),
            std: each(&|c| c.std),
            quantiles: (0..QUANTILES.len()).map(|q| each(&|c| c.quantiles[q])).collect(),
        })
    }
}

struct Finished {
    min: f64,
    max: f64,
    mean: f64,
    std: f64,
    quantiles: [f64; QUANTILES.len()],
}

impl Channel {
    fn add_float(&mut self, value: f32) {
        let first = self.counts.is_empty();
        let v = f64::from(value);
        self.min = if first { v } else { self.min.min(v) };
        self.max = if first { v } else { self.max.max(v) };
        self.sum += v;
        self.sum_of_squares += v * v;
        // Below zero there is no depth; such values share the lowest bucket.
        *self.counts.entry(value.max(0.0).to_bits() >> FLOAT_SHIFT).or_default() += 1;
    }

    fn merge(&mut self, other: &Self) {
        if other.counts.is_empty() {
            return;
        }
        let first = self.counts.is_empty();
        self.min = if first { other.min } else { self.min.min(other.min) };
        self.max = if first { other.max } else { self.max.max(other.max) };
        self.sum += other.sum;
        self.sum_of_squares += other.sum_of_squares;
        for (value, n) in &other.counts {
            *self.counts.entry(*value).or_default() += n;
        }
    }

    fn finish(&self, float: bool) -> Option<Finished> {
        let value = |key: u32| {
            if float { f64::from(f32::from_bits(key << FLOAT_SHIFT)) } else { f64::from(key) }
        };
        let lowest = *self.counts.first_key_value()?.0;
        let highest = *self.counts.last_key_value()?.0;
        let n: u64 = self.counts.values().sum();
        let (min, max, sum, squares) = if float {
            (self.min, self.max, self.sum, self.sum_of_squares)
        } else {
            // Exact: 2^53 is beyond any sum of 16-bit values that a session can hold; squares are not, so
            // the variance is summed around the mean below.
            let sum = self.counts.iter().map(|(v, n)| value(*v) * *n as f64).sum();
            (value(lowest), value(highest), sum, 0.0)
        };
        let mean = sum / n as f64;
        let variance = if float {
            (squares / n as f64 - mean * mean).max(0.0)
        } else {
            self.counts.iter().map(|(v, n)| (value(*v) - mean).powi(2) * *n as f64).sum::<f64>() / n as f64
        };
        let mut bins = vec![0_u64; BINS];
        let width = (max - min) / BINS as f64;
        for (key, n) in &self.counts {
            let bin = if width > 0.0 { ((value(*key) - min) / width) as usize } else { 0 };
            bins[bin.min(BINS - 1)] += n;
        }
        let quantiles = QUANTILES.map(|(_, q)| quantile(&bins, min, width, q * n as f64));
        Some(Finished { min, max, mean, std: variance.sqrt(), quantiles })
    }
}

/// The value below which `target` of the counted ones lie, taken as spread evenly within a bin.
fn quantile(bins: &[u64], min: f64, width: f64, target: f64) -> f64 {
    let mut before = 0.0;
    for (i, n) in bins.iter().enumerate() {
        let n = *n as f64;
        if before + n >= target {
            // LeRobot takes the lower edge of the very first bin.
            let within = if i == 0 || n == 0.0 { 0.0 } else { (target - before) / n };
            return min + (i as f64 + within) * width;
        }
        before += n;
    }
    min + bins.len() as f64 * width
}

/// Statistics of a column of numbers, in constant memory. Quantiles are known where the values are in order and
/// their number was known before: they are the values of certain rows.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct NumberStats {
    n: u64,
    min: f64,
    max: f64,
    mean: f64,
    /// Sum of squared differences from the mean.
    m2: f64,
    /// Row and value, where a quantile lies.
    at: BTreeMap<u64, f64>,
}

impl NumberStats {
    /// Adds the value of row `row` of `rows`.
    pub(super) fn add(&mut self, value: f64, row: u64, rows: u64) {
        self.min = if self.n == 0 { value } else { self.min.min(value) };
        self.max = if self.n == 0 { value } else { self.max.max(value) };
        self.n += 1;
        let delta = value - self.mean;
        self.mean += delta / self.n as f64;
        self.m2 += delta * (value - self.mean);
        if QUANTILES.iter().any(|(_, q)| quantile_row(*q, rows) == row) {
            self.at.insert(row, value);
        }
    }

    /// Adds what another part found (Chan's parallel variance).
    pub(super) fn merge(&mut self, other: &Self) {
        if other.n == 0 {
            return;
        }
        if self.n == 0 {
            *self = other.clone();
            return;
        }
        let a = self.n as f64;
        let b = other.n as f64;
        let delta = other.mean - self.mean;
        self.mean += delta * b / (a + b);
        self.m2 += other.m2 + delta * delta * a * b / (a + b);
        self.n += other.n;
        self.min = self.min.min(other.min);
        self.max = self.max.max(other.max);
        self.at.extend(&other.at);
    }

    /// The statistics; `ordered` says that the column never falls, so that its quantiles are known.
    pub(super) fn finish(&self, ordered: bool) -> Option<Stats> {
        (self.n > 0).then(|| {
            let at = |q: f64| self.at.get(&quantile_row(q, self.n)).map(|v| vec![*v]);
            let quantiles =
                QUANTILES.iter().filter(|_| ordered).map_while(|(_, q)| at(*q)).collect::<Vec<_>>();
            Stats {
                count: self.n,
                min: vec![self.min],
                max: vec![self.max],
                mean: vec![self.mean],
                std: vec![(self.m2 / self.n as f64).sqrt()],
                quantiles: if quantiles.len() == QUANTILES.len() { quantiles } else { Vec::new() },
            }
        })
    }
}

/// The row where a column in order reaches the quantile.
fn quantile_row(q: f64, rows: u64) -> u64 {
    ((q * rows as f64).ceil() as u64).clamp(1, rows.max(1)) - 1
}

impl Stats {
    /// Those of each element of vectors, which are all there at once: a quantile lies on a line between two of them, as
    /// NumPy's does. `None` without a vector.
    pub(super) fn of_vectors(rows: &[&[f32]]) -> Option<Self> {
        let n = rows.len() as f64;
        let elements: Vec<Vec<f64>> = (0..rows.first()?.len())
            .map(|i| {
                let mut values: Vec<_> = rows.iter().map(|r| f64::from(r[i])).collect();
                values.sort_by(f64::total_cmp);
                values
            })
            .collect();
        let each = |f: &dyn Fn(&[f64]) -> f64| elements.iter().map(|v| f(v)).collect::<Vec<_>>();
        let mean_of = |v: &[f64]| v.iter().sum::<f64>() / n;
        let quantile_of = |v: &[f64], q: f64| {
            let at = q * (n - 1.0);
            let low = v[at.floor() as usize];
            low + (v[at.ceil() as usize] - low) * at.fract()
        };
        Some(Self {
            count: rows.len() as u64,
            min: each(&|v| v[0]),
            max: each(&|v| v[v.len() - 1]),
            mean: each(&mean_of),
            std: each(&|v| {
                let mean = mean_of(v);
                (v.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
            }),
            quantiles: QUANTILES.iter().map(|(_, q)| each(&|v| quantile_of(v, *q))).collect(),
        })
    }

    /// One set of statistics from those of all episodes, weighted by count, as LeRobot aggregates them.
    pub(super) fn aggregate(all: &[&Self]) -> Option<Self> {
        let first = all.first()?;
        let count: u64 = all.iter().map(|s| s.count).sum();
        let channels = 0..first.mean.len();
        let weighted =
            |f: &dyn Fn(&Self) -> f64| all.iter().map(|s| f(s) * s.count as f64).sum::<f64>() / count as f64;
        let mean: Vec<f64> = channels.clone().map(|c| weighted(&|s| s.mean[c])).collect();
        let std =
            channels.clone().map(|c| weighted(&|s| s.std[c].powi(2) + (s.mean[c] - mean[c]).powi(2)).sqrt());
        let quantiles = if all.iter().all(|s| s.quantiles.len() == QUANTILES.len()) {
            (0..QUANTILES.len())
                .map(|q| channels.clone().map(|c| weighted(&|s| s.quantiles[q][c])).collect())
                .collect()
        } else {
            Vec::new()
        };
        let fold = |f: fn(f64, f64) -> f64, of: &dyn Fn(&Self, usize) -> f64| {
            channels.clone().map(|c| all.iter().map(|s| of(s, c)).fold(of(first, c), f)).collect()
        };
        Some(Self {
            count,
            min: fold(f64::min, &|s, c| s.min[c]),
            max: fold(f64::max, &|s, c| s.max[c]),
            std: std.collect(),
            mean,
            quantiles,
        })
    }

    /// Name and value per channel of every statistic but the count.
    pub(super) fn entries(&self) -> impl Iterator<Item = (&'static str, &[f64])> {
        let named = [("min", &self.min), ("max", &self.max), ("mean", &self.mean), ("std", &self.std)];
        let quantiles = QUANTILES.iter().map(|(name, _)| *name).zip(&self.quantiles);
        named.into_iter().chain(quantiles).map(|(name, values)| (name, values.as_slice()))
    }

    /// As `stats.json` has it: shape (channels, 1, 1) for images, (1) for numbers.
    pub(super) fn to_json(&self, image: bool) -> Value {
        let shaped = |values: &[f64]| -> Value {
            values.iter().map(|v| if image { json!([[v]]) } else { json!(v) }).collect()
        };
        let mut out: serde_json::Map<_, _> =
            self.entries().map(|(name, values)| (name.to_owned(), shaped(values))).collect();
        out.insert("count".to_owned(), json!([self.count]));
        Value::Object(out)
    }
}

/// Which rows of an episode of `rows` the image statistics look at, as LeRobot chooses them: all up to 100, then
/// ever fewer of them, evenly spread.
pub(super) fn sampled(row: u64, rows: u64) -> bool {
    let wanted = ((rows as f64).powf(0.75) as u64).min(10_000).max(100.min(rows));
    if wanted <= 1 {
        return row == 0;
    }
    // The i-th of them is at i * step, rounded; only the nearest i can hit this row.
    let step = (rows - 1) as f64 / (wanted - 1) as f64;
    let i = (row as f64 / step).round();
    i < wanted as f64 && (i * step).round_ties_even() as u64 == row
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn close(a: f64, b: f64, within: f64) -> bool {
        (a - b).abs() <= within + 1e-9 * b.abs()
    }

    /// Minimum, maximum, mean and standard deviation, and the values in order.
    fn slow(values: &[f64]) -> ([f64; 4], Vec<f64>) {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        ([sorted[0], sorted[sorted.len() - 1], mean, variance.sqrt()], sorted)
    }

    fn check(s: &Stats, channel: usize, values: &[f64], slack: f64) {
        let ([min, max, mean, std], sorted) = slow(values);
        assert_eq!((s.min[channel], s.max[channel]), (min, max));
        assert!(close(s.mean[channel], mean, 1e-6 * max), "mean {} {mean}", s.mean[channel]);
        assert!(close(s.std[channel], std, 1e-4 * max), "std {} {std}", s.std[channel]);
        let bin = (max - min) / BINS as f64 + slack;
        for (q, (name, share)) in QUANTILES.into_iter().enumerate() {
            // Between the two values that have the quantile between them, and within a bin of that.
            let at = share * sorted.len() as f64;
            let low = sorted[(at.ceil() as usize).max(1) - 1];
            let high = sorted[(at as usize).min(sorted.len() - 1)];
            let found = s.quantiles[q][channel];
            assert!(
                found >= low - bin && found <= high + bin,
                "{name}: {found} is not in {low}..{high} by {bin}"
            );
        }
    }

    proptest! {
        #[test]
        fn parts_of_images_add_up(
            images in prop::collection::vec(prop::collection::vec(any::<u16>(), 3..60), 1..6),
            at in 0_usize..6,
        ) {
            let samples: Vec<_> = images.iter().map(|p| Samples::U16(p.clone())).collect();
            let mut left = ImageStats::default();
            let mut right = ImageStats::default();
            for (i, s) in samples.iter().enumerate() {
                if i < at { left.add(1, s) } else { right.add(1, s) }
            }
            left.merge(&right);
            let stats = left.finish(1.0).unwrap();
            prop_assert_eq!(stats.count, images.len() as u64);
            let all: Vec<f64> = images.concat().into_iter().map(f64::from).collect();
            check(&stats, 0, &all, 0.0);
        }

        #[test]
        fn channels_are_kept_apart(pixels in prop::collection::vec(any::<[u8; 3]>(), 1..200)) {
            let mut stats = ImageStats::default();
            stats.add(3, &Samples::U8(pixels.concat()));
            let stats = stats.finish(1.0).unwrap();
            for c in 0..3 {
                let values: Vec<_> = pixels.iter().map(|p| f64::from(p[c])).collect();
                check(&stats, c, &values, 0.0);
            }
        }

        #[test]
        fn floats_are_within_a_bucket(values in prop::collection::vec(0.0_f32..100.0, 1..300)) {
            let mut stats = ImageStats::default();
            let with_holes = values.iter().flat_map(|v| [*v, f32::NAN]).collect();
            stats.add(1, &Samples::F32(with_holes));
            let all: Vec<_> = values.iter().map(|v| f64::from(*v)).collect();
            check(&stats.finish(1.0).unwrap(), 0, &all, 100.0 / 2048.0);
        }

        #[test]
        fn parts_of_columns_add_up(steps in prop::collection::vec(0_u16..1000, 1..200), at in 0_usize..200) {
            let values: Vec<f64> = steps.iter().scan(1.7e9, |v, s| { *v += f64::from(*s); Some(*v) }).collect();
            let mut left = NumberStats::default();
            let mut right = NumberStats::default();
            for (i, v) in values.iter().enumerate() {
                let part = if i < at { &mut left } else { &mut right };
                part.add(*v, i as u64, values.len() as u64);
            }
            left.merge(&right);
            check(&left.finish(true).unwrap(), 0, &values, 0.0);
        }

        #[test]
        fn as_many_rows_are_sampled_as_lerobot_samples(rows in 1_u64..30_000) {
            let found = (0..rows).filter(|r| sampled(*r, rows)).count() as u64;
            let wanted = ((rows as f64).powf(0.75) as u64).min(10_000).max(100.min(rows));
            prop_assert_eq!(found, wanted);
            prop_assert!(sampled(0, rows) && (rows == 1 || sampled(rows - 1, rows)));
        }
    }

    #[test]
    fn episodes_are_weighted_by_their_images() {
        let of = |values: &[u16]| {
            let mut s = ImageStats::default();
            for v in values {
                s.add(1, &Samples::U16(vec![*v]));
            }
            s.finish(1.0).unwrap()
        };
        let a = of(&[10, 20, 30]);
        let b = of(&[100]);
        let all = Stats::aggregate(&[&a, &b]).unwrap();
        let ([min, max, mean, std], _) = slow(&[10.0, 20.0, 30.0, 100.0]);
        assert_eq!((all.count, all.min[0], all.max[0]), (4, min, max));
        assert!(close(all.mean[0], mean, 1e-9) && close(all.std[0], std, 1e-9));
    }
}
