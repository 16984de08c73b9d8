//! When each frame of a recording is due, without accumulating error.

use core::time::Duration;
use depthrig_bus::HostTime;

/// A player that comes to a frame so much later than it was due did not run meanwhile: its process was stopped, or the
/// computer slept. A real camera would have gone on, so that time is a gap; a recording that is merely slow to read
/// only plays slower.
pub const STOPPED: Duration = Duration::from_secs(1);

/// Distinguishes time in which a player did not run from time in which nobody asked it for a frame, for which a
/// recording can wait.
#[derive(Debug, Default)]
pub struct Attendance {
    left: Option<HostTime>,
    /// Time that nobody asked in since the schedule was last looked at, nanoseconds.
    unasked_ns: i64,
}

impl Attendance {
    /// The player is asked for a frame.
    pub fn enter(&mut self, now: HostTime) {
        self.unasked_ns += self.left.take().map_or(0, |left| now.since_ns(left).max(0));
    }

    /// The player returns to whoever asked it.
    pub const fn leave(&mut self, now: HostTime) {
        self.left = Some(now);
    }

    /// A frame was handed over: what happened before it makes no later one late.
    pub const fn delivered(&mut self) {
        self.unasked_ns = 0;
    }

    /// Of `late_ns` those nanoseconds in which the player did not run, if they are a stop; else 0.
    pub fn stopped_ns(&self, late_ns: i64) -> i64 {
        let stopped_ns = late_ns.saturating_sub(self.unasked_ns);
        if stopped_ns > STOPPED.as_nanos() as i64 { stopped_ns } else { 0 }
    }
}

/// When each frame is due: so long after the first as it was taken after it, or on a grid of equal periods.
pub struct PlaybackClock {
    period_ns: f64,
    /// A moment, and how far into the recording the frame is that is due then.
    origin: Option<(HostTime, i64)>,
    /// Times that the schedule had to move.
    moved: u64,
    /// When the player was asked for frames.
    pub attendance: Attendance,
    /// Periods that passed while the player was stopped.
    missed: u64,
}

impl PlaybackClock {
    /// A schedule of frames at `rate_hz`.
    pub fn new(rate_hz: f64) -> Self {
        Self {
            period_ns: 1e9 / rate_hz,
            origin: None,
            moved: 0,
            attendance: Attendance::default(),
            missed: 0,
        }
    }

    /// Frames that a camera would have taken while the player was stopped: what frame numbers are ahead of the images.
    pub const fn missed(&self) -> u64 {
        self.missed
    }

    /// When frame `k` of a grid is due.
    pub fn due(&mut self, k: u64, now: HostTime) -> HostTime {
        self.due_at((k as f64 * self.period_ns).round() as i64, now)
    }

    /// When the frame is due that lies `offset_ns` into the recording. A host that is more than a period late moves the
    /// schedule rather than lose images or send them in a burst.
    pub fn due_at(&mut self, offset_ns: i64, now: HostTime) -> HostTime {
        let (origin, first) = *self.origin.get_or_insert((now, offset_ns));
        let due = origin.plus_ns(offset_ns.saturating_sub(first));
        if now.since_ns(due) as f64 <= self.period_ns {
            return due;
        }
        let stopped_ns = self.attendance.stopped_ns(now.since_ns(due));
        if stopped_ns > 0 {
            let periods = (stopped_ns as f64 / self.period_ns).round() as u64;
            self.missed += periods;
            self.origin = Some((now, offset_ns));
            tracing::warn!(
                "a player did not run for {:.1} s; {periods} frames of that time are counted as lost",
                stopped_ns as f64 / 1e9
            );
            return now;
        }
        self.moved += 1;
        if self.moved.is_power_of_two() {
            tracing::warn!(
                "images play late: one was due {:.1} ms ago (the {}. time); a lower rate_hz helps, and where images \
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
        let mut clock = PlaybackClock::new(30.0);
        assert_eq!(clock.due(0, T0), T0);
        for k in [1u64, 2, 3, 1_000_000, 3_000_000_000] {
            let exact = T0.ns() + (k as i128 * 1_000_000_000 / 30) as i64;
            let late = HostTime::from_ns(exact + 30_000_000);
            assert!((clock.due(k, late).ns() - exact).abs() <= 1, "frame {k}");
        }
        assert_eq!(clock.moved, 0);
    }

    #[test]
    fn a_late_host_moves_the_schedule() {
        let mut clock = PlaybackClock::new(10.0);
        clock.due(0, T0);
        let late = T0.plus_ns(250_000_000);
        assert_eq!(clock.due(1, late), late, "150 ms after its time");
        assert_eq!(clock.due(2, late), late.plus_ns(100_000_000), "the next ones follow from there");
        assert_eq!(clock.moved, 1);
    }

    #[test]
    fn asking_twice_changes_nothing() {
        let mut clock = PlaybackClock::new(10.0);
        clock.due(0, T0);
        let first = clock.due(1, T0);
        assert_eq!(clock.due(1, first.plus_ns(-1)), first);
    }

    /// Frames that a camera would have taken while the process was stopped are missing; frames that nobody asked for,
    /// slow reading and jitter cost none.
    #[test]
    fn a_stop_is_a_gap_and_waiting_is_none() {
        let ms = |n: i64| T0.plus_ns(n * 1_000_000);
        for (rate_hz, stop_ms) in [(5.0, 2_000), (15.0, 10_000), (30.0, 10_000), (90.0, 1_777)] {
            let mut clock = PlaybackClock::new(rate_hz);
            clock.attendance.enter(T0);
            clock.due(0, T0);
            clock.attendance.delivered();
            let next = (1000.0 / rate_hz) as i64;
            clock.due(1, ms(next + stop_ms));
            let exact = stop_ms as f64 * rate_hz / 1000.0;
            assert!(
                (clock.missed() as f64 - exact).abs() <= 1.0,
                "{rate_hz} Hz: {} of {exact}",
                clock.missed()
            );
        }
        let mut clock = PlaybackClock::new(30.0);
        clock.attendance.enter(T0);
        clock.due(0, T0);
        clock.attendance.delivered();
        // Nobody asked for ten seconds.
        clock.attendance.leave(ms(1));
        clock.attendance.enter(ms(10_001));
        assert_eq!((clock.due(1, ms(10_001)), clock.missed()), (ms(10_001), 0));
        clock.attendance.delivered();
        // Slow to read, time after time.
        for k in 2..20_u64 {
            let now = ms(10_001 + 900 * (k as i64 - 1));
            clock.due(k, now);
            clock.attendance.delivered();
        }
        assert_eq!(clock.missed(), 0);
    }
}
