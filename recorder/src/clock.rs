//! The wall clock: its time as text, and its steps, distinguished from drift by the clock pairs in a dataset.

use depthrig_bus::UtcPair;
use time::OffsetDateTime;

/// The fastest that NTP slews the wall clock (adjtimex(2): 500 ppm).
const SLEW_PPM: i64 = 500;
/// A smaller change of the wall clock does not count as a step, whatever its rate, nanoseconds.
const STEP_MIN_NS: i64 = 100_000;

/// UTC minus the monotonic clock, nanoseconds.
pub(crate) fn offset_ns(pair: &UtcPair) -> i64 {
    pair.utc_ns.saturating_sub(pair.mono.ns())
}

/// Size of a step of the wall clock between two readings, nanoseconds; `None` if the change can be drift.
pub(crate) fn step_ns(before: &UtcPair, after: &UtcPair) -> Option<i64> {
    let change = offset_ns(after).saturating_sub(offset_ns(before));
    let slewed = after.mono.since_ns(before.mono).max(0) / 1_000_000 * SLEW_PPM;
    let unsure = after.width_ns.max(0).saturating_add(before.width_ns.max(0));
    (change.saturating_abs() > STEP_MIN_NS.max(slewed).saturating_add(unsure)).then_some(change)
}

/// `2026-08-21 14:05:09 UTC` from nanoseconds since 1970.
pub fn utc_text(ns: i64) -> String {
    // Every 64-bit number is a time between the years 1677 and 2262.
    let t = OffsetDateTime::from_unix_timestamp_nanos(i128::from(ns)).unwrap_or(OffsetDateTime::UNIX_EPOCH);
    let (h, m, s) = t.to_hms();
    format!("{:04}-{:02}-{:02} {h:02}:{m:02}:{s:02} UTC", t.year(), u8::from(t.month()), t.day())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates() {
        assert_eq!(utc_text(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(utc_text(1_709_210_096_789_000_000), "2024-02-29 12:34:56 UTC");
        assert_eq!(utc_text(-1), "1969-12-31 23:59:59 UTC");
        assert_eq!(utc_text(4_102_444_800_000_000_000), "2100-01-01 00:00:00 UTC");
    }
}
