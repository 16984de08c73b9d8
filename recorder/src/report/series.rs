//! Series of constant size: values over time in bins that are fixed before the first value, and a histogram whose
//! bins grow with the value.

use serde::Serialize;

/// Most bins of a series: about as many as a plot can show.
const BINS_MAX: i64 = 160;
/// Widths that people read well, nanoseconds: 0.1 s to a day.
const WIDTHS_S: [f64; 19] = [
    0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0,
    7200.0, 21_600.0, 86_400.0,
];

/// The time bins of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TimeBins {
    /// Width of a bin, nanoseconds.
    pub width_ns: i64,
    /// Number of bins; the last one may end after the dataset.
    pub count: usize,
    /// From the first set to the last, nanoseconds.
    pub span_ns: i64,
}

impl TimeBins {
    /// Bins for values that come every `interval_ns` on average: each has some.
    pub(super) fn new(span_ns: i64, interval_ns: i64) -> Self {
        let span_ns = span_ns.max(0);
        let least = (span_ns / BINS_MAX).max(interval_ns.saturating_mul(2)).min(span_ns);
        let width = WIDTHS_S.iter().map(|w| (w * 1e9) as i64).find(|w| *w >= least);
        let width_ns = width.unwrap_or(least + 1);
        Self { width_ns, count: (span_ns / width_ns + 1) as usize, span_ns }
    }

    /// The bin of a time since the first set; times outside belong to the first or the last.
    fn of(self, t_ns: i64) -> usize {
        usize::try_from(t_ns / self.width_ns).unwrap_or(0).min(self.count - 1)
    }

    /// Where a bin begins and ends; the first and the last reach beyond the dataset.
    const fn ends(self, bin: usize) -> (i64, i64) {
        let start = if bin == 0 { i64::MIN } else { bin as i64 * self.width_ns };
        let end = if bin + 1 == self.count { i64::MAX } else { (bin as i64 + 1) * self.width_ns };
        (start, end)
    }
}

/// Counts over time.
#[derive(Debug, Clone)]
pub(super) struct Counts(pub(super) Vec<f64>);

impl Counts {
    pub(super) fn new(bins: TimeBins) -> Self {
        Self(vec![0.0; bins.count])
    }

    pub(super) fn add(&mut self, bins: TimeBins, t_ns: i64, n: f64) {
        self.0[bins.of(t_ns)] += n;
    }

    /// Spreads `n` evenly over the time from `from_ns` to `to_ns`.
    pub(super) fn spread(&mut self, bins: TimeBins, from_ns: i64, to_ns: i64, n: f64) {
        if to_ns <= from_ns {
            return self.add(bins, to_ns, n);
        }
        let per_ns = n / (to_ns - from_ns) as f64;
        for bin in bins.of(from_ns)..=bins.of(to_ns) {
            let (start, end) = bins.ends(bin);
            self.0[bin] += per_ns * (to_ns.min(end) - from_ns.max(start)).max(0) as f64;
        }
    }

    /// Per second between two times; `None` outside, and where too little of a bin lies between them to say.
    pub(super) fn per_second(&self, bins: TimeBins, from_ns: i64, to_ns: i64) -> Vec<Option<f64>> {
        let least = (bins.width_ns / 4).min(to_ns.saturating_sub(from_ns)).max(1);
        let rate = |(bin, n): (usize, &f64)| {
            let (start, end) = bins.ends(bin);
            let covered = to_ns.min(end).saturating_sub(from_ns.max(start));
            (covered >= least).then(|| n * 1e9 / covered as f64)
        };
        self.0.iter().enumerate().map(rate).collect()
    }
}

/// Least, mean and greatest value in a bin.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Range {
    /// Least.
    pub min: f64,
    /// Mean.
    pub mean: f64,
    /// Greatest.
    pub max: f64,
}

/// Values over time.
#[derive(Debug, Clone)]
pub(super) struct Values(Vec<Option<(Range, f64)>>);

impl Values {
    pub(super) fn new(bins: TimeBins) -> Self {
        Self(vec![None; bins.count])
    }

    pub(super) fn add(&mut self, bins: TimeBins, t_ns: i64, value: f64) {
        let slot = &mut self.0[bins.of(t_ns)];
        let (range, n) = slot.get_or_insert((Range { min: value, mean: value, max: value }, 0.0));
        *n += 1.0;
        range.min = range.min.min(value);
        range.max = range.max.max(value);
        range.mean += (value - range.mean) / *n;
    }

    pub(super) fn ranges(&self) -> Vec<Option<Range>> {
        self.0.iter().map(|slot| slot.map(|(range, _)| range)).collect()
    }
}

/// Values below this have a bin each; above, each octave is divided into as many.
const SUB: u64 = 256;

/// A histogram of values of at least 0 with bins of 0.4 % of their value at most.
#[derive(Debug, Clone, Default)]
pub(super) struct Histogram {
    counts: Vec<u64>,
    total: u64,
    max: i64,
}

impl Histogram {
    pub(super) fn add(&mut self, value: i64) {
        let bin = Self::bin(value.max(0) as u64);
        if self.counts.len() <= bin {
            self.counts.resize(bin + 1, 0);
        }
        self.counts[bin] += 1;
        self.total += 1;
        self.max = self.max.max(value);
    }

    fn bin(value: u64) -> usize {
        let octave = (value / SUB).checked_ilog2().map_or(0, |e| e + 1);
        match octave {
            0 => value as usize,
            e => (u64::from(e) * SUB + (value >> (e - 1)) - SUB) as usize,
        }
    }

    /// The least value of a bin.
    fn low(bin: usize) -> u64 {
        let octave = bin as u64 / SUB;
        let rest = bin as u64 % SUB;
        if octave == 0 { rest } else { (SUB + rest) << (octave - 1) }
    }

    pub(super) const fn total(&self) -> u64 {
        self.total
    }

    pub(super) fn quantiles(&self) -> Quantiles {
        Quantiles {
            p50: self.quantile(50, 100),
            p95: self.quantile(95, 100),
            p99: self.quantile(99, 100),
            max: self.max,
        }
    }

    /// Nearest rank, as the middle of its bin.
    pub(super) fn quantile(&self, share: u64, of: u64) -> i64 {
        let rank = (self.total.saturating_mul(share)).div_ceil(of).max(1);
        let mut seen = 0;
        for (bin, n) in self.counts.iter().enumerate() {
            seen += n;
            if seen >= rank {
                let low = Self::low(bin);
                let high = Self::low(bin + 1);
                return (low.midpoint(high - 1) as i64).min(self.max);
            }
        }
        0
    }

    /// The counts in `count` bins of equal width from 0, and how many lie beyond.
    pub(super) fn linear(&self, width: i64, count: usize) -> (Vec<u64>, u64) {
        let mut bins = vec![0; count];
        let mut beyond = 0;
        for (bin, n) in self.counts.iter().enumerate().filter(|(_, n)| **n > 0) {
            let middle = Self::low(bin).midpoint(Self::low(bin + 1) - 1) as i64;
            match bins.get_mut((middle.min(self.max) / width.max(1)) as usize) {
                Some(slot) => *slot += n,
                None => beyond += n,
            }
        }
        (bins, beyond)
    }
}

/// How values are distributed; 0 without values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Quantiles {
    /// Half of the values are within.
    pub p50: i64,
    /// 95 % are within.
    pub p95: i64,
    /// 99 % are within.
    pub p99: i64,
    /// All are within.
    pub max: i64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn bins_are_few_and_have_readable_widths() {
        for (span_s, sets, width_s) in [
            (0.0, 1.0, 0.1),
            (0.8, 5.0, 0.5),
            (16.0, 81.0, 0.5),
            (16.0, 1601.0, 0.1),
            (600.0, 3000.0, 5.0),
            (36_000.0, 180_000.0, 300.0),
            (86_400.0, 2.0, 86_400.0),
        ] {
            let interval_s = if sets > 1.0 { span_s / (sets - 1.0) } else { 0.0 };
            let bins = TimeBins::new((span_s * 1e9) as i64, (interval_s * 1e9) as i64);
            assert_eq!(bins.width_ns, (width_s * 1e9) as i64, "{span_s} s");
            assert!(bins.count <= BINS_MAX as usize + 1);
        }
        assert!(TimeBins::new(i64::MAX, 1).count <= BINS_MAX as usize + 1);
    }

    proptest! {
        #[test]
        fn quantiles_are_within_half_a_percent(mut values in proptest::collection::vec(0i64..1 << 40, 1..300)) {
            let mut h = Histogram::default();
            for v in &values {
                h.add(*v);
            }
            values.sort_unstable();
            for percent in [1u64, 50, 95, 99, 100] {
                let rank = (values.len() as u64 * percent).div_ceil(100).max(1) as usize - 1;
                let truth = values[rank] as f64;
                let said = h.quantile(percent, 100) as f64;
                prop_assert!((said - truth).abs() <= truth / 250.0 + 1.0, "{percent} %: {said}, not {truth}");
            }
            let (bins, beyond) = h.linear(1 << 33, 100);
            prop_assert_eq!(bins.iter().sum::<u64>() + beyond, values.len() as u64);
        }

        /// Spreading a count over time keeps its sum, wherever the span begins and ends.
        #[test]
        fn nothing_is_lost_by_spreading(from in -50i64..3000, len in 0i64..4000, span in 1i64..3000) {
            let bins = TimeBins::new(span * 1_000_000, 0);
            let mut c = Counts::new(bins);
            c.spread(bins, from * 1_000_000, (from + len) * 1_000_000, 7.0);
            prop_assert!((c.0.iter().sum::<f64>() - 7.0).abs() < 1e-9);
        }
    }

    /// 30 Hz, counted every fifth of a second, first before the first set: even in every bin, the last part one too.
    #[test]
    fn an_even_rate_is_even_in_every_bin() {
        let bins = TimeBins::new(9_730_000_000, 200_000_000);
        let mut c = Counts::new(bins);
        let at = |i: i64| i * 200_000_000 - 40_000_000;
        for i in 0..49 {
            c.spread(bins, at(i), at(i + 1), 6.0);
        }
        let rates = c.per_second(bins, at(0), at(49));
        assert!(rates.iter().all(|r| (r.unwrap() - 30.0).abs() < 1e-6), "{rates:?}");
        assert_eq!(c.per_second(bins, at(0), 20_000_000_000).last().unwrap().map(f64::round), Some(1.0));
    }

    #[test]
    fn values_keep_their_extremes() {
        let bins = TimeBins::new(1_000_000_000, 0);
        let mut v = Values::new(bins);
        for x in [3.0, 1.0, 8.0] {
            v.add(bins, 950_000_000, x);
        }
        let ranges = v.ranges();
        assert_eq!(ranges[9], Some(Range { min: 1.0, mean: 4.0, max: 8.0 }));
        assert!(ranges[..9].iter().all(Option::is_none));
    }
}
