//! A counter of a few bits, made to run on for ever.

/// How a device counts: the width of its counter and the length of a tick.
#[derive(Debug, Clone, Copy)]
pub(super) struct Counter {
    bits: u32,
    tick_ns: f64,
    /// Time in which the counter comes round, nanoseconds.
    range_ns: f64,
}

impl Counter {
    pub(super) fn new(bits: u32, tick_ns: f64) -> Self {
        Self { bits, tick_ns, range_ns: tick_ns * 2f64.powi(bits as i32) }
    }

    /// Ticks from reading `before` to reading `raw`, the host having seen `host_gap_ns` pass between them.
    ///
    /// The shorter way round is taken, so a small step back stays a small step back. After a pause long enough
    /// for that to be a guess (40 % of the range; 28 minutes for 32-bit microseconds) the host's clock says how
    /// often the counter came round.
    pub(super) fn delta(self, before: u64, raw: u64, host_gap_ns: i64) -> i64 {
        let unused = 64 - self.bits;
        let shortest = ((raw.wrapping_sub(before) << unused) as i64) >> unused;
        let gap_ns = host_gap_ns as f64;
        if gap_ns <= 0.4 * self.range_ns {
            return shortest;
        }
        let rounds = ((gap_ns - shortest as f64 * self.tick_ns) / self.range_ns).round();
        let ticks = i128::from(shortest) + ((rounds as i128) << self.bits.min(63));
        ticks.clamp(i128::from(i64::MIN), i128::from(i64::MAX)) as i64
    }

    /// `ticks` in nanoseconds, kept far from the ends of `i64` so that sums of a few cannot overflow.
    pub(super) fn ns(self, ticks: i64) -> i64 {
        const FAR: f64 = 1e18; // 31 years
        (ticks as f64 * self.tick_ns).round().clamp(-FAR, FAR) as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_steps_either_way_cross_the_wrap() {
        let us = Counter::new(32, 1000.0);
        let top = (1u64 << 32) - 10;
        assert_eq!(us.delta(top, 23, 33_000_000), 33);
        assert_eq!(us.delta(23, top, 33_000_000), -33);
        assert_eq!(Counter::new(64, 1.0).delta(u64::MAX, 4, 1), 5);
        assert_eq!(Counter::new(8, 1e6).delta(250, 3, 9_000_000), 9);
    }

    #[test]
    fn bits_above_the_counter_are_ignored() {
        assert_eq!(Counter::new(32, 1000.0).delta(5, (7 << 32) + 38, 33_000_000), 33);
    }

    #[test]
    fn a_long_pause_is_counted_in_whole_rounds() {
        let us = Counter::new(32, 1000.0);
        for pause_s in [1000i64, 1800, 3600, 5000, 9000, 100_000] {
            let raw = (500 + pause_s as u64 * 1_000_000) & 0xffff_ffff;
            let seen_ns = pause_s * 1_000_000_000 + 150_000_000; // the frame also arrived 150 ms late
            assert_eq!(us.delta(500, raw, seen_ns), pause_s * 1_000_000, "{pause_s} s");
        }
    }

    #[test]
    fn absurd_counters_saturate() {
        assert_eq!(Counter::new(64, 1e9).ns(i64::MAX), 1_000_000_000_000_000_000);
        assert_eq!(Counter::new(64, 1e9).delta(0, 1 << 63, i64::MAX), i64::MIN);
        assert!(Counter::new(8, 1e-6).delta(0, 255, i64::MAX) > 0);
    }
}
