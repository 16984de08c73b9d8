//! Steps of the wall clock, told from its drift by the pairs of readings that a dataset holds.

use depthrig_bus::UtcPair;

/// The fastest that NTP slews the wall clock (adjtimex(2): 500 ppm).
const SLEW_PPM: i64 = 500;
/// Below this a change of the wall clock is no step, whatever its rate, nanoseconds.
const STEP_MIN_NS: i64 = 100_000;

/// UTC minus the monotonic clock, nanoseconds.
pub(crate) fn offset_ns(pair: &UtcPair) -> i64 {
    pair.utc_ns.saturating_sub(pair.mono.ns())
}

/// How far the wall clock was set between two readings, nanoseconds; `None` when what changed can be drift.
pub(crate) fn step_ns(before: &UtcPair, after: &UtcPair) -> Option<i64> {
    let change = offset_ns(after).saturating_sub(offset_ns(before));
    let slewed = after.mono.since_ns(before.mono).max(0) / 1_000_000 * SLEW_PPM;
    let unsure = after.width_ns.max(0).saturating_add(before.width_ns.max(0));
    (change.saturating_abs() > STEP_MIN_NS.max(slewed).saturating_add(unsure)).then_some(change)
}
