//! Quantiles of the newest spreads (or skews) in constant memory, for status reports.

use std::collections::VecDeque;

/// Values kept: 5 minutes at 5 Hz.
const WINDOW: usize = 1500;

/// The newest 1500 durations: spreads of sets, or one stream's skews.
#[derive(Debug, Clone, Default)]
pub struct SpreadStats {
    newest: VecDeque<i64>,
}

impl SpreadStats {
    /// Nothing seen yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes a duration, nanoseconds.
    pub fn add(&mut self, ns: i64) {
        if self.newest.len() == WINDOW {
            self.newest.pop_front();
        }
        self.newest.push_back(ns);
    }

    /// Values in the window.
    pub fn len(&self) -> usize {
        self.newest.len()
    }

    /// Whether nothing was seen yet.
    pub fn is_empty(&self) -> bool {
        self.newest.is_empty()
    }

    /// The size that a share `q` of the window does not exceed, nanoseconds; 0 when nothing was seen.
    pub fn quantile_ns(&self, q: f64) -> i64 {
        let mut sorted: Vec<i64> = self.newest.iter().map(|ns| ns.saturating_abs()).collect();
        let rank = (q.clamp(0.0, 1.0) * sorted.len() as f64).ceil() as usize;
        let at = rank.clamp(1, sorted.len().max(1)) - 1;
        if sorted.is_empty() { 0 } else { *sorted.select_nth_unstable(at).1 }
    }

    /// The value in the middle of the window, with its sign; 0 when nothing was seen.
    pub fn median_ns(&self) -> i64 {
        let mut sorted: Vec<i64> = self.newest.iter().copied().collect();
        if sorted.is_empty() {
            return 0;
        }
        let middle = (sorted.len() - 1) / 2;
        *sorted.select_nth_unstable(middle).1
    }

    /// The greatest size of the window, nanoseconds; 0 when nothing was seen.
    pub fn max_ns(&self) -> i64 {
        self.newest.iter().map(|ns| ns.saturating_abs()).max().unwrap_or(0)
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
        // From -1499 by odd numbers, then to 1500 by even ones.
        assert_eq!(s.median_ns(), -1);
        s.add(i64::MIN);
        assert_eq!(s.max_ns(), i64::MAX);
    }
}
