//! Quantiles of the newest spreads (or skews) in constant memory, for status reports.

use std::collections::VecDeque;

/// Values kept: 5 minutes at 5 Hz.
const WINDOW: usize = 1500;

/// The newest 1500 durations: spreads of sets, or sizes of one stream's skew.
#[derive(Debug, Clone, Default)]
pub struct SpreadStats {
    newest: VecDeque<i64>,
}

impl SpreadStats {
    /// Nothing seen yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a duration, nanoseconds; its sign does not count.
    pub fn add(&mut self, ns: i64) {
        if self.newest.len() == WINDOW {
            self.newest.pop_front();
        }
        self.newest.push_back(ns.saturating_abs());
    }

    /// Values in the window.
    pub fn len(&self) -> usize {
        self.newest.len()
    }

    /// Whether nothing was seen yet.
    pub fn is_empty(&self) -> bool {
        self.newest.is_empty()
    }

    /// The value that a share `q` of the window does not exceed, nanoseconds; 0 when nothing was seen.
    pub fn quantile_ns(&self, q: f64) -> i64 {
        let mut sorted: Vec<i64> = self.newest.iter().copied().collect();
        let rank = (q.clamp(0.0, 1.0) * sorted.len() as f64).ceil() as usize;
        let at = rank.clamp(1, sorted.len().max(1)) - 1;
        if sorted.is_empty() { 0 } else { *sorted.select_nth_unstable(at).1 }
    }

    /// The greatest of the window, nanoseconds; 0 when nothing was seen.
    pub fn max_ns(&self) -> i64 {
        self.newest.iter().copied().max().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_the_window() {
        let mut s = SpreadStats::new();
        assert_eq!((s.quantile_ns(0.5), s.max_ns(), s.is_empty()), (0, 0, true));
        s.add(1_000_000);
        for i in 1..=WINDOW as i64 {
            s.add(if i % 2 == 0 { i } else { -i });
        }
        let quantiles = [0.0, 0.5, 0.99, 1.0].map(|q| s.quantile_ns(q));
        assert_eq!((quantiles, s.max_ns(), s.len()), ([1, 750, 1485, 1500], 1500, WINDOW));
        s.add(i64::MIN);
        assert_eq!(s.max_ns(), i64::MAX);
    }
}
