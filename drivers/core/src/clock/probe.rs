//! Two-way probes of a device clock: they measure the least latency, which one-way arrivals cannot reveal.

use super::hull::Line;
use std::collections::VecDeque;

/// Probes remembered.
const KEPT: usize = 64;
/// Probes that count while the slope of the line is a guess.
const NEWEST: usize = 3;

/// One probe: the device read its clock at `x` at some moment in a host interval.
#[derive(Debug, Clone, Copy, Default)]
struct Probe {
    /// Device time, nanoseconds since the epoch's first frame.
    x: i64,
    /// Middle of the interval on the host's clock, since the arrival of that frame, less `x`.
    offset_ns: i64,
    /// Height of the map's line (arrival of the fastest frame) over the middle of the interval, nanoseconds.
    latency_ns: i64,
    width_ns: i64,
}

/// The latency as the probes see it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Latency {
    pub ns: i64,
    /// Largest error that the probes used can have: half the widest.
    pub bound_ns: i64,
}

/// The last probes of a device.
#[derive(Debug, Clone, Default)]
pub(super) struct Probes(VecDeque<Probe>);

impl Probes {
    /// Takes a probe whose middle lies `offset_ns` above device time `x`, while the map's line is as `line` says, and
    /// returns the latency.
    pub(super) fn add(&mut self, x: i64, offset_ns: i64, width_ns: i64, line: Line) -> Latency {
        if self.0.len() == KEPT {
            self.0.pop_front();
        }
        let latency_ns = (line.at(x) as i64).saturating_sub(offset_ns);
        self.0.push_back(Probe { x, offset_ns, latency_ns, width_ns });
        self.latency()
    }

    /// Whether no probe was taken.
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Measures every probe against a line that has moved since; `None` without a probe. While the line's slope
    /// is a guess, the newest probes alone are near enough to now, and how they differ says how wrong the slope is.
    pub(super) fn measure_again(&mut self, line: Line) -> Option<Latency> {
        for p in &mut self.0 {
            p.latency_ns = (line.at(p.x) as i64).saturating_sub(p.offset_ns);
        }
        (!self.0.is_empty()).then(|| {
            let newest = self.median_of(NEWEST);
            let bound_ns = newest.latency.bound_ns.saturating_add(newest.spread_ns + newest.spread_ns / 2);
            Latency { bound_ns, ..newest.latency }
        })
    }

    /// The median of the probes at most 1.5 times as wide as the tightest. The tightest is that of the last 64, so a
    /// device that became slower is believed after a while.
    fn latency(&self) -> Latency {
        self.median_of(KEPT).latency
    }

    /// The same of the newest `most` of them.
    fn median_of(&self, most: usize) -> Median {
        let tightest = self.0.iter().map(|p| p.width_ns).min().unwrap_or(0);
        let limit = tightest.saturating_add(tightest / 2);
        let mut good = [0; KEPT];
        let mut n = 0;
        let mut widest = 0;
        for p in self.0.iter().rev().filter(|p| p.width_ns <= limit).take(most.min(KEPT)) {
            good[n] = p.latency_ns;
            n += 1;
            widest = widest.max(p.width_ns);
        }
        let good = &mut good[..n];
        good.sort_unstable();
        let ns = good.get(n / 2).map_or(0, |ns| *ns);
        let spread_ns = good.iter().map(|l| l.saturating_sub(ns).saturating_abs()).max().unwrap_or(0);
        Median { latency: Latency { ns: ns.max(0), bound_ns: widest / 2 + 1 }, spread_ns }
    }
}

/// The value that some probes agree on, and how far the one that agrees least is off.
struct Median {
    latency: Latency,
    spread_ns: i64,
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEVEL: Line = Line { x0: 0, d0: 0, slope: 0.0 };

    #[test]
    fn wide_probes_do_not_count() {
        let mut probes = Probes::default();
        for (latency, width) in [(3_000, 100), (9_000, 151), (3_040, 140), (2_980, 120), (-50_000, 900_000)] {
            probes.add(0, -latency, width, LEVEL);
        }
        assert_eq!(probes.add(0, -3_010, 110, LEVEL), Latency { ns: 3_010, bound_ns: 71 });
    }

    #[test]
    fn a_device_that_became_slower_is_believed_in_the_end() {
        let mut probes = Probes::default();
        probes.add(0, -1_000, 10, LEVEL);
        for _ in 0..KEPT {
            probes.add(0, -5_000, 400, LEVEL);
        }
        assert_eq!(probes.add(0, -5_000, 400, LEVEL), Latency { ns: 5_000, bound_ns: 201 });
    }

    #[test]
    fn a_line_that_moved_is_measured_anew() {
        let mut probes = Probes::default();
        assert_eq!(probes.measure_again(LEVEL), None);
        probes.add(1_000_000, -7_000, 100, LEVEL);
        probes.add(2_000_000, -7_000, 100, LEVEL);
        let risen = Line { x0: 0, d0: 500, slope: 0.001 };
        assert_eq!(probes.measure_again(risen), Some(Latency { ns: 9_500, bound_ns: 51 + 1500 }));
    }
}
