//! Frame numbers of a camera that has none: reckoned from the device's own times.
//!
//! A Kinect takes images at a fixed rate and stamps each with its clock, so a step of the clock by several periods is
//! as many images of which all but the last were lost. The same time twice is the same image twice. A clock that
//! went back was reset, and how many images were lost by that is unknown.
//!
//! A camera that exposes for longer than a period takes fewer images, as in the dark: its period is then as many of the
//! nominal ones as the exposure takes, which the camera states with each image, and none of those between is lost.

/// Reckons the numbers of one stream.
#[derive(Debug, Clone)]
pub struct FrameCounter {
    period_us: u64,
    last: Option<(u64, u64)>,
    /// Nominal periods that the last image's exposure took.
    exposed: u64,
}

impl FrameCounter {
    /// A counter for images every `period_us` microseconds of the device's clock.
    pub const fn new(period_us: u64) -> Self {
        Self { period_us: if period_us == 0 { 1 } else { period_us }, last: None, exposed: 1 }
    }

    /// The number of the image that was taken at `device_us`, of a camera that keeps its rate.
    pub fn number(&mut self, device_us: u64) -> u64 {
        self.number_exposed(device_us, 0)
    }

    /// The number of the image that was taken at `device_us` and exposed for `exposure_us`.
    pub fn number_exposed(&mut self, device_us: u64, exposure_us: u64) -> u64 {
        // Exposures are rounded: one of two periods may be stated as a little more.
        let exposed = (exposure_us.saturating_mul(15) / 16).div_ceil(self.period_us).max(1);
        let period_us = self.period_us.saturating_mul(exposed.max(self.exposed));
        self.exposed = exposed;
        let number = match self.last {
            None => 0,
            Some((number, then)) if device_us == then => number,
            Some((number, then)) => {
                let passed = device_us.checked_sub(then).unwrap_or(period_us);
                let periods = passed.saturating_add(period_us / 2) / period_us;
                // A clock that jumped ahead by more than a day says nothing either.
                let is_lost = periods > 86_400 * 30;
                number + if is_lost { 1 } else { periods.max(1) }
            }
        };
        self.last = Some((number, device_us));
        number
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_follow_the_clock() {
        let mut counter = FrameCounter::new(33_333);
        let numbers = [1_000_000, 1_033_340, 1_066_600, 1_166_600, 1_166_600, 1_200_100];
        let numbers = numbers.map(|t| counter.number(t));
        assert_eq!(numbers, [0, 1, 2, 5, 5, 6]);
        assert_eq!(counter.number(400_000), 7, "set back");
        assert_eq!(counter.number(433_333), 8);
        assert_eq!(counter.number(u64::MAX), 9, "a jump that no frame counter could follow");
        // A camera whose clock runs a little differently never gains or loses a number.
        let mut counter = FrameCounter::new(33_333);
        for i in 0..100_000 {
            assert_eq!(counter.number(i * 33_340), i);
        }
        // Jitter of less than half a period changes nothing.
        let mut counter = FrameCounter::new(33_333);
        for i in 0..1000u64 {
            assert_eq!(counter.number(1_000_000 + i * 33_333 + (i % 3) * 5_000), i);
        }
        assert_eq!(FrameCounter::new(0).number(5), 0);
    }

    /// It gets dark and light again: the colour camera's own exposures, none of which loses an image; then one is lost
    /// at each.
    #[test]
    fn a_rate_that_long_exposures_lower_is_no_loss() {
        let mut counter = FrameCounter::new(33_333);
        let mut at = 1_000_000;
        let mut number = counter.number_exposed(at, 8_330);
        for (exposure, periods) in [(33_330, 1), (66_670, 2), (133_330, 4), (66_670, 2), (16_670, 1)] {
            for i in 0..20 {
                // The first short one may come as late as a long one, or at once.
                at += periods * 33_333 + if i % 2 == 0 { 3_000 } else { 0 };
                let next = counter.number_exposed(at, exposure);
                assert_eq!(next, number + 1, "{exposure} us, image {i}");
                number = next;
            }
            at += 2 * periods * 33_333;
            let next = counter.number_exposed(at, exposure);
            assert_eq!(next, number + 2, "one of {exposure} us is lost");
            number = next;
        }
        // Ten seconds without any, as when the process is stopped.
        let next = counter.number_exposed(at + 10_000_000, 16_670);
        assert!((next - number).abs_diff(300) <= 1, "{}", next - number);
    }
}
