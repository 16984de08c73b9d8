//! The metadata that a recovery adds to a segment.

use std::collections::BTreeMap;

/// Its name.
pub(crate) const RECOVERED_METADATA: &str = "depthrig.recovered";

/// The most sets that the recovery may have lost.
pub(crate) fn sets_lost(recovered: &BTreeMap<String, String>) -> u64 {
    recovered.get("sets_lost").and_then(|n| n.parse().ok()).unwrap_or(0)
}
