//! Limits how many frames of a process are copied: a flood costs the daemon no more than twice what was announced.

use core::time::Duration;
use depthrig_bus::HostTime;

/// Frames that may come at once after a pause: as many as wait unread, twice.
const BURST: f64 = 8.0;

/// The allowance of one stream, as a token bucket.
#[derive(Debug)]
pub(super) struct RateLimiter {
    per_ns: f64,
    allowed: f64,
    at: HostTime,
}

impl RateLimiter {
    /// The limiter of a stream of `rate_hz`.
    pub(super) fn new(rate_hz: f64) -> Self {
        Self { per_ns: 2.0 * rate_hz / 1e9, allowed: BURST, at: HostTime::now() }
    }

    /// Whether a frame that comes at `now` may be copied; it counts if so.
    pub(super) fn takes(&mut self, now: HostTime) -> bool {
        let since = now.since_ns(self.at).max(0) as f64;
        self.at = self.at.max(now);
        self.allowed = (self.allowed + since * self.per_ns).min(BURST);
        let takes = self.allowed >= 1.0;
        if takes {
            self.allowed -= 1.0;
        }
        takes
    }

    /// How long until the next one may.
    pub(super) fn wait(&self) -> Duration {
        let missing = (1.0 - self.allowed).max(0.0) / self.per_ns;
        Duration::from_nanos(missing.min(1e9) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(limiter: &mut RateLimiter, from: HostTime, every_ns: i64, n: i64) -> i64 {
        (0..n).filter(|i| limiter.takes(from.plus_ns(i * every_ns))).count() as i64
    }

    #[test]
    fn what_was_announced_passes_and_a_flood_does_not() {
        let mut limiter = RateLimiter::new(30.0);
        let start = limiter.at;
        assert_eq!(taken(&mut limiter, start, 33_333_333, 300), 300);
        let mut limiter = RateLimiter::new(30.0);
        let start = limiter.at;
        let passed = taken(&mut limiter, start, 10_000, 100_000); // a second of 100 kHz
        assert!((66..=70).contains(&passed), "{passed}");
        assert!(
            limiter.wait() > Duration::ZERO && limiter.wait() <= Duration::from_millis(17),
            "{:?}",
            limiter.wait()
        );
    }

    #[test]
    fn a_pause_allows_a_burst_and_no_more() {
        let mut limiter = RateLimiter::new(30.0);
        let start = limiter.at;
        assert_eq!(taken(&mut limiter, start, 0, 100), 8);
        assert_eq!(taken(&mut limiter, start.plus(Duration::from_mins(1)), 0, 100), 8);
    }
}
