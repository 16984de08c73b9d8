//! Selects the frames to compute on when that happens at a rate: refined depth, or depth by stereo.
//!
//! The frame nearest to each of equally spaced moments. The moments follow the ticks of the frame sets where the two
//! rates divide each other: then it is the frame of a set that is used, and the recording has both.

use super::SetTimes;

/// Decides for each frame whether it is due.
#[derive(Debug, Clone)]
pub struct FrameSchedule {
    /// Between two moments; `None`: every frame is due.
    period_ns: Option<i64>,
    /// Half of the time between two frames.
    half_frame_ns: i64,
    next: Option<i64>,
}

impl FrameSchedule {
    /// A schedule of `rate_hz` (0: every frame) for frames that come `frame_ns` apart.
    pub fn new(rate_hz: f64, frame_ns: i64) -> Self {
        let period = (rate_hz > 0.0).then(|| (1e9 / rate_hz).round() as i64);
        // A rate that the frames do not reach lets all of them through, whatever their jitter.
        let period_ns = period.filter(|p| *p > frame_ns + frame_ns / 4);
        Self { period_ns, half_frame_ns: frame_ns / 2, next: None }
    }

    /// From one frame that is due to the next; `None`: every frame is due.
    pub const fn period_ns(&self) -> Option<i64> {
        self.period_ns
    }

    /// Whether the frame stamped `stamp`, nanoseconds, is due beside these sets.
    pub fn is_due(&mut self, stamp: i64, sets: &SetTimes) -> bool {
        let Some(period) = self.period_ns else { return true };
        // After a pause, and after times that go back, it begins anew.
        let lost = self.next.is_none_or(|n| n.abs_diff(stamp) > 4 * period as u64);
        let next = if lost { aligned(stamp, period, sets) } else { self.next.unwrap_or(stamp) };
        let due = stamp >= next - self.half_frame_ns;
        let mut after = next;
        if due {
            let passed = (stamp + self.half_frame_ns - next).max(0) / period;
            after = aligned(next + (passed + 1) * period, period, sets);
            // Moving onto the ticks must not make this frame's moment come again.
            if after <= stamp + self.half_frame_ns {
                after += period;
            }
        }
        self.next = Some(after);
        due
    }
}

/// `moment` moved onto the nearest set, or part of the time between two, if the rates divide each other.
fn aligned(moment: i64, period: i64, sets: &SetTimes) -> i64 {
    let Some(tick) = sets.newest() else { return moment };
    let least = period.min(sets.period_ns());
    let most = period.max(sets.period_ns());
    let ratio = most as f64 / least as f64;
    if (ratio - ratio.round()).abs() > 1e-3 {
        return moment;
    }
    let off = (tick.ns() - moment).rem_euclid(least);
    moment + if off > least / 2 { off - least } else { off }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::HostTime;

    const MS: i64 = 1_000_000;
    const SETS: i64 = 200 * MS;

    /// Stamps of the frames that were due, in milliseconds.
    fn due(
        schedule: &mut FrameSchedule,
        stamps: impl Iterator<Item = i64>,
        tick: impl Fn(i64) -> Option<i64>,
    ) -> Vec<i64> {
        let sets = SetTimes::default();
        let mut is_due = |s: i64| {
            if let Some(tick) = tick(s * MS) {
                sets.note(HostTime::from_ns(tick), SETS);
            }
            schedule.is_due(s * MS, &sets)
        };
        stamps.filter(|s| is_due(*s)).collect()
    }

    #[test]
    fn five_of_thirty_are_due_and_those_nearest_to_the_ticks() {
        let mut schedule = FrameSchedule::new(5.0, 33_333_333);
        // Sets at 90, 290, 490 …; frames at 0, 33, 67, 100: the one at 100 is nearest to 90, and so on.
        let last_tick = |s: i64| (s > 95 * MS).then(|| (s - 95 * MS) / SETS * SETS + 90 * MS);
        let frames = || (0..120).map(|i| i * 100 / 3);
        let seen = due(&mut schedule, frames(), last_tick);
        for pair in seen[2..].windows(2) {
            assert_eq!((pair[1] - pair[0] + 2) / 5 * 5, 200, "{seen:?}");
        }
        let nearest = |tick: i64| frames().min_by_key(|f| (f - tick).abs()).unwrap();
        assert!(seen.contains(&nearest(2090)) && seen.contains(&nearest(3090)), "{seen:?}");
    }

    #[test]
    fn every_frame_is_due_at_no_rate_and_at_one_that_is_not_reached() {
        for rate in [0.0, 30.0, 100.0] {
            let mut schedule = FrameSchedule::new(rate, 33_333_333);
            assert_eq!(due(&mut schedule, (0..30).map(|i| i * 33), |_| None).len(), 30, "{rate}");
        }
    }

    #[test]
    fn a_rate_beside_that_of_the_sets_keeps_its_own_time() {
        let mut schedule = FrameSchedule::new(7.0, 33_333_333);
        let seen = due(&mut schedule, (0..300).map(|i| i * 100 / 3), |s| Some(s / SETS * SETS + 1));
        assert!((69..=71).contains(&seen.len()), "{} in 10 s", seen.len());
    }

    #[test]
    fn a_pause_costs_no_burst_and_time_may_start_again() {
        let mut schedule = FrameSchedule::new(5.0, 33_333_333);
        let mut is_due = |ms: i64| schedule.is_due(ms * MS, &SetTimes::default());
        for start in [0, 60_000, 5] {
            assert!(is_due(start) && !is_due(start + 33), "{start}");
        }
    }
}
