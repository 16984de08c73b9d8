//! Two sensors of different rates as one sequence of samples.

use std::collections::VecDeque;

/// Samples of acceleration that wait for their rotation: half a second of them.
const WAITING: usize = 256;
/// Samples that may be missing at once, ten minutes of them; more means that the clock jumped.
const JUMP: u64 = 600 * 400;

/// A measurement of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Reading {
    /// Microseconds of the camera's clock.
    pub(super) ticks: u32,
    pub(super) value: [f32; 3],
}

/// Acceleration beside a rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Beside {
    pub(super) value: [f32; 3],
    /// From the rotation to it, nanoseconds.
    pub(super) offset_ns: i32,
}

/// The data that accompanies a rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Merged {
    /// Its number by the camera's clock, from 1.
    pub(super) sequence: u64,
    pub(super) acceleration: Option<Beside>,
}

/// Puts rotation and acceleration together.
#[derive(Debug)]
pub(super) struct Merge {
    period_us: u64,
    waiting: VecDeque<Reading>,
    last: Option<u32>,
    sequence: u64,
}

impl Merge {
    pub(super) fn new(period_us: u64) -> Self {
        Self {
            period_us: period_us.max(1),
            waiting: VecDeque::with_capacity(WAITING),
            last: None,
            sequence: 0,
        }
    }

    /// Takes a sample of acceleration; of too many the oldest go, since no rotation comes for them.
    pub(super) fn acceleration(&mut self, reading: Reading) {
        if self.waiting.len() == WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back(reading);
    }

    /// Takes a sample of rotation.
    pub(super) fn rotation(&mut self, reading: &Reading) -> Merged {
        let steps = self.last.map_or(1, |last| {
            let gone = u64::from(reading.ticks.wrapping_sub(last));
            let steps = (gone + self.period_us / 2) / self.period_us;
            if (1..=JUMP).contains(&steps) { steps } else { 1 }
        });
        self.last = Some(reading.ticks);
        self.sequence += steps;
        // The clock wraps: a difference that is negative in 32 bits is one to the past.
        let offset = |a: &Reading| a.ticks.wrapping_sub(reading.ticks).cast_signed();
        let is_before = self.waiting.front().is_some_and(|a| offset(a) <= 0);
        let acceleration = if is_before { self.waiting.pop_front() } else { None };
        let acceleration =
            acceleration.map(|a| Beside { value: a.value, offset_ns: offset(&a).saturating_mul(1000) });
        Merged { sequence: self.sequence, acceleration }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn at(ticks: u32) -> Reading {
        Reading { ticks, value: [ticks as f32, 0.0, 0.0] }
    }

    #[test]
    fn a_sample_that_never_came_is_a_gap_and_a_jump_is_none() {
        let mut merge = Merge::new(2500);
        let numbers: Vec<u64> = [0, 2490, 5010, 12_500, 3_000_000_000, 3_000_002_500]
            .map(|t| merge.rotation(&at(t)).sequence)
            .into();
        assert_eq!(numbers, [1, 2, 3, 6, 7, 8]);
    }

    proptest! {
        /// No acceleration is lost, none is early, and their order stays, also when the clock wraps.
        #[test]
        fn every_acceleration_goes_along_with_one_rotation(start: u32, accel_period in 2500u32..20_000, phase in 0u32..2500) {
            let mut merge = Merge::new(2500);
            let mut sent = Vec::new();
            let mut got = Vec::new();
            let mut next = phase;
            for k in 0..400u32 {
                let now = k * 2500;
                while next <= now {
                    sent.push(start.wrapping_add(next));
                    merge.acceleration(at(start.wrapping_add(next)));
                    next += accel_period;
                }
                if let Some(beside) = merge.rotation(&at(start.wrapping_add(now))).acceleration {
                    prop_assert!((-3_000_000..=0).contains(&beside.offset_ns), "{}", beside.offset_ns);
                    got.push(start.wrapping_add(now).wrapping_add_signed(beside.offset_ns / 1000));
                }
            }
            prop_assert_eq!(got, sent);
        }
    }
}
