//! Playing pictures that were taken before: when each is due, without accumulating error.

use depthrig_bus::HostTime;

/// When each frame is due: so long after the first as it was taken after it, or on a grid of equal periods.
pub(crate) struct Pace {
    period_ns: f64,
    /// A moment, and how far into the recording the frame is that is due then.
    origin: Option<(HostTime, i64)>,
    /// Times that the schedule had to move.
    moved: u64,
}

impl Pace {
    /// A schedule of frames at `rate_hz`.
    pub(crate) fn new(rate_hz: f64) -> Self {
        Self { period_ns: 1e9 / rate_hz, origin: None, moved: 0 }
    }

    /// When frame `k` of a grid is due.
    pub(crate) fn due(&mut self, k: u64, now: HostTime) -> HostTime {
        self.due_at((k as f64 * self.period_ns).round() as i64, now)
    }

    /// When the frame is due that lies `offset_ns` into the recording. A host that is more than a period late moves the
    /// schedule rather than lose pictures or send them in a burst.
    pub(crate) fn due_at(&mut self, offset_ns: i64, now: HostTime) -> HostTime {
        let (origin, first) = *self.origin.get_or_insert((now, offset_ns));
        let due = origin.plus_ns(offset_ns.saturating_sub(first));
        if now.since_ns(due) as f64 <= self.period_ns {
            return due;
        }
        self.moved += 1;
        if self.moved.is_power_of_two() {
            tracing::warn!(
                "pictures play late: one was due {:.1} ms ago (the {}. time); a lower rate_hz helps, and where pictures \
                 are kept, a larger cache_mb",
                now.since_ns(due) as f64 / 1e6,
                self.moved
            );
        }
        self.origin = Some((now, offset_ns));
        now
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T0: HostTime = HostTime::from_ns(1_000_000_000);

    #[test]
    fn frames_are_due_on_an_exact_grid() {
        let mut pace = Pace::new(30.0);
        assert_eq!(pace.due(0, T0), T0);
        for k in [1u64, 2, 3, 1_000_000, 3_000_000_000] {
            let exact = T0.ns() + (k as i128 * 1_000_000_000 / 30) as i64;
            let late = HostTime::from_ns(exact + 30_000_000);
            assert!((pace.due(k, late).ns() - exact).abs() <= 1, "frame {k}");
        }
        assert_eq!(pace.moved, 0);
    }

    #[test]
    fn a_late_host_moves_the_schedule() {
        let mut pace = Pace::new(10.0);
        pace.due(0, T0);
        let late = T0.plus_ns(250_000_000);
        assert_eq!(pace.due(1, late), late, "150 ms after its time");
        assert_eq!(pace.due(2, late), late.plus_ns(100_000_000), "the next ones follow from there");
        assert_eq!(pace.moved, 1);
    }

    #[test]
    fn asking_twice_changes_nothing() {
        let mut pace = Pace::new(10.0);
        pace.due(0, T0);
        let first = pace.due(1, T0);
        assert_eq!(pace.due(1, first.plus_ns(-1)), first);
    }
}
