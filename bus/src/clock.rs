//! The only clock: `CLOCK_MONOTONIC` in nanoseconds, and its pairing with UTC for files and reports.
//!
//! Nothing else in depthrig reads a clock; `clippy.toml` forbids `Instant::now` and `SystemTime::now`.

use core::time::Duration;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// A point on the host's `CLOCK_MONOTONIC`, in nanoseconds.
///
/// Signed, because a mapped capture time may lie before the boot of a machine whose clock just restarted
/// and because differences are taken all the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct HostTime(i64);

impl HostTime {
    /// The current time.
    pub fn now() -> Self {
        Self(read_ns(ClockId::Monotonic))
    }

    /// A time `ns` nanoseconds after the clock's zero.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Nanoseconds since the clock's zero.
    pub const fn ns(self) -> i64 {
        self.0
    }

    /// `self - earlier` in nanoseconds; negative when `earlier` is later.
    pub const fn since_ns(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }

    /// This time moved by `ns` nanoseconds.
    pub const fn plus_ns(self, ns: i64) -> Self {
        Self(self.0.saturating_add(ns))
    }

    /// This time moved forward by `d`.
    pub fn plus(self, d: Duration) -> Self {
        self.plus_ns(i64::try_from(d.as_nanos()).unwrap_or(i64::MAX))
    }

    /// How long from now until this time; zero when it is past.
    pub fn from_now(self) -> Duration {
        Duration::from_nanos(u64::try_from(self.since_ns(Self::now())).unwrap_or(0))
    }

    /// How long ago this time was; zero when it is still to come.
    pub fn elapsed(self) -> Duration {
        Duration::from_nanos(u64::try_from(Self::now().since_ns(self)).unwrap_or(0))
    }
}

/// One reading of both clocks: what turns a [`HostTime`] into UTC when something is written out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct UtcPair {
    /// The monotonic side.
    pub mono: HostTime,
    /// `CLOCK_REALTIME` at that moment, nanoseconds since 1970-01-01T00:00:00Z.
    pub utc_ns: i64,
    /// Width of the reading: the two clocks agree within half of this, nanoseconds.
    pub width_ns: i64,
}

impl UtcPair {
    /// Samples the pair: monotonic, real-time, monotonic; the tightest of eight readings is kept.
    pub fn sample() -> Self {
        let mut best = Self { width_ns: i64::MAX, ..Self::default() };
        for _ in 0..8 {
            let before = read_ns(ClockId::Monotonic);
            let utc_ns = read_ns(ClockId::Realtime);
            let width_ns = read_ns(ClockId::Monotonic) - before;
            if width_ns < best.width_ns {
                best = Self { mono: HostTime(before + width_ns / 2), utc_ns, width_ns };
            }
        }
        best
    }

    /// UTC of `t` in nanoseconds since 1970, as this pair sees it.
    pub const fn utc_ns(&self, t: HostTime) -> i64 {
        self.utc_ns.saturating_add(t.since_ns(self.mono))
    }
}

/// CPU time that this process has used so far, all threads, nanoseconds.
pub fn process_cpu_ns() -> i64 {
    read_ns(ClockId::ProcessCPUTime)
}

/// CPU time that the calling thread has used so far, nanoseconds.
pub fn thread_cpu_ns() -> i64 {
    read_ns(ClockId::ThreadCPUTime)
}

fn read_ns(id: ClockId) -> i64 {
    let t = clock_gettime(id);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utc_pair_agrees_with_itself_across_time() {
        let a = UtcPair::sample();
        std::thread::sleep(Duration::from_millis(5));
        let b = UtcPair::sample();
        assert!(b.mono > a.mono && b.utc_ns > a.utc_ns);
        let apart = (a.utc_ns(b.mono) - b.utc_ns).abs();
        assert!(apart < 5_000_000, "the two pairs place one moment {apart} ns apart");
    }

    #[test]
    fn host_time_arithmetic_saturates() {
        assert_eq!(HostTime::from_ns(i64::MAX).plus(Duration::from_secs(1)).ns(), i64::MAX);
        assert_eq!(HostTime::from_ns(5).since_ns(HostTime::from_ns(8)), -3);
        assert_eq!(HostTime::from_ns(0).from_now(), Duration::ZERO);
    }
}
