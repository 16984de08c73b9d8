//! Decides when sensors that fell silent are switched off and on again: a limited number of times, with growing pauses.

use core::time::Duration;
use depthrig_bus::HostTime;

/// Silence of either sensor after which both are switched off and on. They measure every 16 ms at least.
const SILENCE: Duration = Duration::from_secs(2);
/// The longest pause between two tries.
const LONGEST: Duration = Duration::from_mins(1);
/// Tries after which they are given up: seven minutes of them.
const TRIES: u32 = 10;
/// Time of measuring after which the next silence is another one.
const SOUND: Duration = Duration::from_secs(10);

/// The next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// Nothing.
    Wait,
    /// The sensors are to be switched off and on, for the n-th time.
    Restart(u32),
    /// They measure again, after n tries.
    Revived(u32),
    /// They are silent after n tries.
    GiveUp(u32),
}

/// Looks after two sensors.
#[derive(Debug)]
pub(super) struct Revival {
    /// Silence before the first try; the pauses after the tries grow from it.
    silence: Duration,
    tries: u32,
    on_at: HostTime,
    /// When they were last silent for that long.
    silent_at: HostTime,
}

impl Revival {
    pub(super) const fn new(now: HostTime) -> Self {
        Self { silence: SILENCE, tries: 0, on_at: now, silent_at: now }
    }

    #[cfg(test)]
    pub(super) const fn with_silence(mut self, silence: Duration) -> Self {
        self.silence = silence;
        self
    }

    /// The sensors were switched on, or that failed.
    pub(super) const fn switched(&mut self, now: HostTime) {
        self.on_at = now;
    }

    /// Silence that is left alone after so many tries.
    fn timeout(&self) -> Duration {
        let doublings = self.tries.saturating_sub(1).min(16);
        (self.silence * (1 << doublings)).min(LONGEST.max(self.silence))
    }

    /// The next step if the sensor that has been silent for longer was last heard at `heard`.
    pub(super) fn step(&mut self, now: HostTime, heard: HostTime) -> Step {
        let since = |then: HostTime| Duration::from_nanos(now.since_ns(then).max(0) as u64);
        let silence = since(heard.max(self.on_at));
        if silence >= self.silence {
            self.silent_at = now;
        }
        if silence >= self.timeout() {
            if self.tries >= TRIES {
                return Step::GiveUp(self.tries);
            }
            self.tries += 1;
            return Step::Restart(self.tries);
        }
        if self.tries > 0 && since(self.silent_at.max(self.on_at)) >= SOUND {
            return Step::Revived(core::mem::take(&mut self.tries));
        }
        Step::Wait
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(s: f64) -> HostTime {
        HostTime::from_ns((s * 1e9) as i64)
    }

    /// Steps every 0.1 s; each switching takes a second. Times and steps, without the waiting.
    fn run(until_s: u32, heard: impl Fn(f64, u32) -> bool) -> Vec<(f64, Step)> {
        let mut revival = Revival::new(at(0.0));
        let mut steps = Vec::new();
        let mut last = 0.0;
        let mut on_at = 0.0;
        for tick in 0..until_s * 10 {
            let now = f64::from(tick) / 10.0;
            if now < on_at {
                continue;
            }
            if now == on_at {
                revival.switched(at(now));
            }
            if heard(now, revival.tries) {
                last = now;
            }
            let step = revival.step(at(now), at(last));
            if step != Step::Wait {
                steps.push((now, step));
            }
            match step {
                Step::Restart(_) => on_at = now + 1.0,
                Step::GiveUp(_) => break,
                _ => {}
            }
        }
        steps
    }

    #[test]
    fn silent_sensors_are_tried_again_ever_more_rarely_and_then_given_up() {
        let steps = run(3600, |_, _| false);
        let tries: Vec<Step> = steps.iter().map(|(_, step)| *step).collect();
        let expected: Vec<Step> = (1..=TRIES).map(Step::Restart).chain([Step::GiveUp(TRIES)]).collect();
        assert_eq!(tries, expected);
        let pauses: Vec<f64> = steps.windows(2).map(|pair| (pair[1].0 - pair[0].0 - 1.0).round()).collect();
        assert_eq!(pauses, [2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0, 60.0, 60.0]);
        assert!((1.9..2.2).contains(&steps[0].0), "{steps:?}");
    }

    #[test]
    fn sensors_that_measure_are_left_alone() {
        assert_eq!(run(100, |_, _| true), []);
    }

    #[test]
    fn a_second_silence_begins_with_the_short_pause_again() {
        // Silent from 5 s on until the second try, then until 100 s not, then for good.
        let is_back = core::cell::Cell::new(false);
        let steps = run(103, |now, tries| {
            is_back.set(is_back.get() || tries == 2);
            now < 5.0 || (is_back.get() && now < 100.0)
        });
        let tries: Vec<Step> = steps.iter().map(|(_, step)| *step).collect();
        assert_eq!(tries, [Step::Restart(1), Step::Restart(2), Step::Revived(2), Step::Restart(1)]);
        assert!((101.8..102.1).contains(&steps[3].0), "{steps:?}");
    }

    #[test]
    fn sensors_that_measure_for_moments_only_are_in_the_same_silence() {
        // Half a second of samples in seven.
        let steps = run(3600, |now, _| now % 7.0 < 0.5);
        let expected: Vec<Step> = (1..=steps.len() as u32).map(Step::Restart).collect();
        assert_eq!(steps.iter().map(|(_, step)| *step).collect::<Vec<_>>(), expected);
        assert!(
            (2..=4).contains(&steps.len()),
            "a pause that is longer than their silence is the end: {steps:?}"
        );
    }
}
