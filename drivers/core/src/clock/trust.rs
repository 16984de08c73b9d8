//! How far a mapped time may be off: what the map knows about its own errors.
//!
//! Two sources. Until the map has a past it is arithmetic: the mean delivery jitter over the number of frames
//! seen, and the curvature that a warming crystal has. Then the map checks itself: half a window after a stamp was
//! given, the hull on both sides of it is known, and its height there against what was published is the error
//! that was made. The largest of the last two minutes is the claim for the next frame. So heat, heavy load and a
//! slewing map all show up in the claim, with half a window of delay.

use std::collections::VecDeque;

/// Least residual that is resolved, as a power of two of nanoseconds (1 µs).
const FIRST_OCTAVE: u32 = 10;
/// Octaves of the histogram: 1 µs to 8.6 s.
const OCTAVES: u32 = 23;
/// Buckets per octave.
const FINE: u32 = 8;
/// Once so many residuals are counted, all counts are halved, so that old frames fade (about 4 min at 30 Hz).
const HALVE_AT: u32 = 8192;

/// Residuals (arrival − line) in buckets of about 9 %, the old ones fading.
#[derive(Debug, Clone)]
pub(super) struct Residuals {
    buckets: Vec<u32>,
    total: u32,
}

impl Residuals {
    pub(super) fn new() -> Self {
        Self { buckets: vec![0; (OCTAVES * FINE) as usize], total: 0 }
    }

    pub(super) fn add(&mut self, residual_ns: i64) {
        let v = residual_ns.max(0) as u64;
        let octave = (v | 1).ilog2().max(FIRST_OCTAVE);
        let fine = if v >> FIRST_OCTAVE == 0 { 0 } else { (v >> (octave - 3)) as u32 & (FINE - 1) };
        let at = ((octave - FIRST_OCTAVE) * FINE + fine).min(OCTAVES * FINE - 1);
        self.buckets[at as usize] += 1;
        self.total += 1;
        if self.total >= HALVE_AT {
            for b in &mut self.buckets {
                *b /= 2;
            }
            self.total = self.buckets.iter().sum();
        }
    }

    /// The residual that a share `q` of frames stays below, nanoseconds, as the upper end of its bucket; 0 if none.
    pub(super) fn quantile_ns(&self, q: f64) -> i64 {
        if self.total == 0 {
            return 0;
        }
        let rank = (q * f64::from(self.total)).ceil().max(1.0) as u32;
        let mut seen = 0;
        for (i, count) in self.buckets.iter().enumerate() {
            seen += count;
            if seen >= rank {
                let octave = i as u32 / FINE + FIRST_OCTAVE;
                let fine = i as u64 % u64::from(FINE);
                return ((u64::from(FINE) + fine + 1) << (octave - 3)) as i64;
            }
        }
        i64::MAX
    }
}

/// Time between two self-checks, nanoseconds of device time.
const CHECK_EVERY_NS: i64 = 1_000_000_000;
/// Self-checks remembered: two minutes.
const CHECKS: usize = 120;
/// Self-checks needed before they replace the arithmetic.
const CHECKS_NEEDED: usize = 30;
/// Stamps waiting for their self-check: half a window of 120 s at most.
const MAX_WAITING: usize = 128;

/// The map's record of its own errors.
#[derive(Debug, Clone)]
pub(super) struct Trust {
    /// Published line stamps, as (x, d), that wait until the hull around them is known.
    waiting: VecDeque<(i64, f64)>,
    /// Sizes of the errors found, nanoseconds, newest last.
    errors: VecDeque<f64>,
    largest: f64,
}

impl Trust {
    pub(super) fn new() -> Self {
        Self {
            waiting: VecDeque::with_capacity(MAX_WAITING),
            errors: VecDeque::with_capacity(CHECKS),
            largest: 0.0,
        }
    }

    /// The published line stood at `d` over `x`; remembered once a second.
    pub(super) fn published(&mut self, x: i64, d: f64) {
        if self.waiting.back().is_none_or(|last| x - last.0 >= CHECK_EVERY_NS) {
            if self.waiting.len() == MAX_WAITING {
                self.waiting.pop_front();
            }
            self.waiting.push_back((x, d));
        }
    }

    /// The hull is now settled up to `x`; `hull_at` is its height. True when a stamp was checked.
    pub(super) fn settle(&mut self, x: i64, hull_at: impl Fn(i64) -> f64) -> bool {
        let mut checked = false;
        while let Some(&(at, d)) = self.waiting.front()
            && at <= x
        {
            self.waiting.pop_front();
            if self.errors.len() == CHECKS {
                self.errors.pop_front();
            }
            self.errors.push_back((d - hull_at(at)).abs());
            checked = true;
        }
        if checked {
            self.largest = self.errors.iter().copied().fold(0.0, f64::max);
        }
        checked
    }

    /// Half-width for the line's own error, nanoseconds: `jitter_ns` is the mean delivery jitter, `frames` and
    /// `span_ns` what the hull rests on.
    ///
    /// How near the fastest of n frames come to the true least latency depends on the jitter's shape near its
    /// least value: as 1/n when many frames are almost that fast (an exponential), as 1/√n when few are (a sum of
    /// two). The second is assumed. 2, 30 and 1e-7/s, the curvature of a camera just switched on, are fitted to the
    /// simulation of `tests.rs`, where the claim must hold for 99 % of frames in every case.
    pub(super) fn line_ns(&self, jitter_ns: f64, frames: u64, span_ns: i64) -> f64 {
        let frames = frames.max(1) as f64;
        let floor = 2.0 * jitter_ns / frames.sqrt();
        if self.errors.len() >= CHECKS_NEEDED {
            return 1.5 * self.largest + floor;
        }
        let half_s = span_ns as f64 / 2e9;
        let curvature_ns = 0.5 * 1e-7 * half_s * half_s * 1e9;
        (1.5 * self.largest).max(30.0 * jitter_ns / frames + curvature_ns) + floor
    }

    /// The epoch ended: what waits belongs to a line that is gone.
    pub(super) fn restart(&mut self) {
        self.waiting.clear();
        self.errors.clear();
        self.largest = 0.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_right_within_a_bucket() {
        let mut r = Residuals::new();
        for i in 1..=1000 {
            r.add(i * 10_000);
        }
        for q in [0.1, 0.5, 0.9, 0.99] {
            let got = r.quantile_ns(q) as f64;
            let want = q * 1e7;
            assert!(got >= want && got < want * 1.13, "p{q}: {got} against {want}");
        }
    }

    #[test]
    fn old_residuals_fade_and_wild_ones_are_kept_in_bounds() {
        let mut r = Residuals::new();
        (0..20_000).for_each(|_| r.add(1_000_000));
        (0..20_000).for_each(|_| r.add(4_000_000));
        assert!(r.quantile_ns(0.5) > 3_900_000);
        for wild in [i64::MIN, -1, 0, 1, 1023, 1024, i64::MAX] {
            r.add(wild);
        }
        assert!(r.quantile_ns(1.0) > 8_000_000_000);
        assert_eq!(Residuals::new().quantile_ns(0.5), 0);
    }

    #[test]
    fn an_error_that_was_made_is_claimed_from_then_on() {
        let mut t = Trust::new();
        for i in 0..100 {
            let x = i * CHECK_EVERY_NS;
            t.published(x, if i == 50 { 70_000.0 } else { 0.0 });
            t.settle(x, |_| 0.0);
        }
        assert!(t.line_ns(0.0, 1000, 60_000_000_000) >= 70_000.0);
        for i in 100..500 {
            t.published(i * CHECK_EVERY_NS, 0.0);
            t.settle(i * CHECK_EVERY_NS, |_| 0.0);
        }
        assert_eq!(t.line_ns(0.0, 1000, 60_000_000_000), 0.0);
    }
}
