//! Two-way probes of a device clock: what one-way arrivals can never tell, the least latency itself.

use std::collections::VecDeque;

/// Probes remembered.
const KEPT: usize = 64;

/// One probe: the device read its clock at `x` at some moment in a host interval.
#[derive(Debug, Clone, Copy)]
struct Probe {
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
    /// Takes a probe and returns the latency: the median of the probes at most 1.5 times as wide as the tightest.
    /// The tightest is that of the last 64, so a device that became slower is believed after a while.
    pub(super) fn add(&mut self, latency_ns: i64, width_ns: i64) -> Latency {
        if self.0.len() == KEPT {
            self.0.pop_front();
        }
        self.0.push_back(Probe { latency_ns, width_ns });
        let tightest = self.0.iter().map(|p| p.width_ns).min().unwrap_or(width_ns);
        let limit = tightest.saturating_add(tightest / 2);
        let mut good: Vec<Probe> = self.0.iter().copied().filter(|p| p.width_ns <= limit).collect();
        good.sort_unstable_by_key(|p| p.latency_ns);
        let widest = good.iter().map(|p| p.width_ns).max().unwrap_or(width_ns);
        let ns = good.get(good.len() / 2).map_or(0, |p| p.latency_ns);
        Latency { ns: ns.max(0), bound_ns: widest / 2 + 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wide_probes_do_not_count() {
        let mut probes = Probes::default();
        for (latency, width) in [(3_000, 100), (9_000, 151), (3_040, 140), (2_980, 120), (-50_000, 900_000)] {
            probes.add(latency, width);
        }
        assert_eq!(probes.add(3_010, 110), Latency { ns: 3_010, bound_ns: 71 });
    }

    #[test]
    fn a_device_that_became_slower_is_believed_in_the_end() {
        let mut probes = Probes::default();
        probes.add(1_000, 10);
        for _ in 0..KEPT {
            probes.add(5_000, 400);
        }
        assert_eq!(probes.add(5_000, 400), Latency { ns: 5_000, bound_ns: 201 });
    }
}
