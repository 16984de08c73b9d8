//! How fast the clock in the payload headers of a USB camera really ticks.
//!
//! A camera names the frequency of its clock in its descriptor (`dwClockFrequency`, UVC 1.5 class specification, table
//! 3-3), but not every camera keeps to it: a D400 names 48 MHz and stamps in microseconds. Mapping a clock with a wrong
//! tick would give wrong times with a good conscience. So the first few images are looked at before the stream begins,
//! and the header's clock is used only when it ticks, within a tenth, as the descriptor says or in microseconds.

use depthrig_bus::HostTime;

/// Images that are looked at, and how many where these do not suffice: while cameras open, the host may be so busy that
/// it stamps an image 10 ms late, which is a tenth of the time between the first and the last of a few.
const SAMPLES: usize = 5;
const SAMPLES_MOST: usize = 15;
/// The least time between the first and the last of them.
const SPAN_NS: i64 = 50_000_000;
/// How far the measured rate may be from the named one. The wrong rates that are known are wrong by a factor.
const TOLERANCE: f64 = 0.1;
const MICROSECONDS_HZ: u32 = 1_000_000;

/// A time stamp of the device beside one of the host.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample {
    pub(super) ticks: u32,
    pub(super) host: HostTime,
}

/// Whether looking at more images than `samples` would not help.
pub(super) fn is_settled(samples: &[Sample], named: Option<u32>) -> bool {
    samples.len() >= SAMPLES_MOST || (samples.len() >= SAMPLES && frequency_hz(samples, named).is_some())
}

/// Ticks a second in `samples`; `None` when they do not suffice.
pub(super) fn measured_hz(samples: &[Sample]) -> Option<f64> {
    let first = samples.first()?;
    let last = samples.last()?;
    let span_ns = last.host.since_ns(first.host);
    if samples.len() < 3 || span_ns < SPAN_NS {
        return None;
    }
    // Pairwise, so that a counter of 32 bits may wrap once between any two.
    let steps = samples.iter().zip(samples.get(1..)?);
    let ticks: u64 = steps.map(|(a, b)| u64::from(b.ticks.wrapping_sub(a.ticks))).sum();
    Some(ticks as f64 * 1e9 / span_ns as f64)
}

/// The frequency of the clock that gave `samples`, out of `named` and a million; `None` when it is neither, or when
/// the samples do not suffice.
pub(super) fn frequency_hz(samples: &[Sample], named: Option<u32>) -> Option<u32> {
    let measured = measured_hz(samples)?;
    let near = |hz: &u32| (measured / f64::from(*hz) - 1.0).abs() <= TOLERANCE;
    named.filter(|hz| *hz > 0).into_iter().chain([MICROSECONDS_HZ]).find(near)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn samples<const N: usize>(start: u32, hz: f64, jitter_ns: [i64; N]) -> Vec<Sample> {
        let one = |(i, jitter): (usize, i64)| {
            let ns = i as f64 * 33_366_700.0;
            Sample {
                ticks: start.wrapping_add((ns * hz / 1e9) as u64 as u32),
                host: HostTime::from_ns(7_000_000_000 + ns as i64 + jitter),
            }
        };
        jitter_ns.into_iter().enumerate().map(one).collect()
    }

    #[test]
    fn a_camera_that_keeps_to_its_descriptor_is_believed() {
        let s = samples(4_000_000_000, 48e6, [0, 2_000_000, 0, -1_000_000, 500_000]);
        assert_eq!(frequency_hz(&s, Some(48_000_000)), Some(48_000_000));
    }

    #[test]
    fn one_that_stamps_in_microseconds_is_found_out() {
        let s = samples(u32::MAX - 40_000, 1e6, [0; 5]);
        assert_eq!(frequency_hz(&s, Some(48_000_000)), Some(1_000_000));
        assert_eq!(frequency_hz(&s, None), Some(1_000_000));
    }

    #[test]
    fn another_clock_is_not_used() {
        assert_eq!(frequency_hz(&samples(5, 90e3, [0; 5]), Some(48_000_000)), None);
        assert_eq!(frequency_hz(&samples(5, 0.0, [0; 5]), Some(48_000_000)), None, "it stands still");
        assert_eq!(frequency_hz(&samples(5, 1e6, [0; 5])[..2], None), None, "too few");
        assert_eq!(frequency_hz(&[], None), None);
        let at_once = [Sample { ticks: 1, host: HostTime::from_ns(5) }; 5];
        assert_eq!(frequency_hz(&at_once, Some(1)), None, "no time between them");
    }

    proptest! {
        /// The frequency is found in spite of a busy host's stamps, as in `first_stamps`.
        #[test]
        fn stamps_that_are_20_ms_late_at_random_are_seen_through(
            start: u32, jitter in proptest::array::uniform15(0i64..20_000_000), true_hz in prop_oneof![Just(48e6), Just(1e6), Just(27e6), Just(90e3)]
        ) {
            let named = Some(48_000_000);
            let all = samples(start, true_hz, jitter);
            let enough = (0..=all.len()).find(|n| is_settled(&all[..*n], named)).unwrap();
            let found = frequency_hz(&all[..enough], named);
            prop_assert_eq!(found, [48_000_000, 1_000_000].into_iter().find(|hz| f64::from(*hz) == true_hz));
            prop_assert!(found.is_some() || enough == SAMPLES_MOST);
        }

        #[test]
        fn jitter_of_two_milliseconds_never_misleads(start: u32, jitter in proptest::array::uniform5(-2_000_000i64..2_000_000)) {
            let named = Some(48_000_000);
            prop_assert_eq!(frequency_hz(&samples(start, 48e6, jitter), named), named);
            prop_assert_eq!(frequency_hz(&samples(start, 1e6, jitter), named), Some(1_000_000));
            prop_assert_eq!(frequency_hz(&samples(start, 27e6, jitter), named), None);
        }
    }
}
