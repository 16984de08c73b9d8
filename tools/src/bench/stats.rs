//! Order statistics of measured durations.

use serde::Serialize;

/// Quantiles of a sample of durations, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Quantiles {
    /// Number of durations.
    pub n: usize,
    /// Median.
    pub p50_us: f64,
    /// 99th percentile.
    pub p99_us: f64,
    /// Greatest.
    pub max_us: f64,
}

impl Quantiles {
    /// Of durations in nanoseconds; all zero for an empty sample.
    pub fn of_ns(samples: &[i64]) -> Self {
        let mut sorted = samples.to_vec();
        sorted.sort_unstable();
        let us = |q| quantile(&sorted, q).unwrap_or(0) as f64 / 1e3;
        Self { n: sorted.len(), p50_us: us(0.5), p99_us: us(0.99), max_us: us(1.0) }
    }
}

/// The `q`-quantile of a sorted sample by the nearest-rank rule; `None` for an empty sample.
pub fn quantile<T: Copy>(sorted: &[T], q: f64) -> Option<T> {
    let rank = (q * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// The median of `values`, the lower one of two; NaN for an empty slice.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    quantile(&sorted, 0.5).unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_rank() {
        let hundred: Vec<i64> = (1..=100).map(|i| i * 1000).collect();
        let q = Quantiles::of_ns(&hundred);
        assert_eq!((q.n, q.p50_us, q.p99_us, q.max_us), (100, 50.0, 99.0, 100.0));
        assert_eq!(Quantiles::of_ns(&[7000]), Quantiles { n: 1, p50_us: 7.0, p99_us: 7.0, max_us: 7.0 });
        assert_eq!(Quantiles::of_ns(&[]).n, 0);
    }

    #[test]
    fn median_of_few() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), 2.0);
        assert!(median(&[]).is_nan());
    }
}
