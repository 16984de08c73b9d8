//! How many sets were handed over and what became of them, as far as the dataset knows.

use crate::{Outcome, SetCounts};
use serde::Serialize;
use std::collections::BTreeMap;

/// The account of the sets of a dataset: `offered = recorded + Σ dropped`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct SetsAccount {
    /// Sets handed over.
    pub offered: u64,
    /// Sets that were recorded.
    pub recorded: u64,
    /// Sets lost, by reason: that of a [`crate::SetDrop`], or `lost_in_crash`.
    pub dropped: BTreeMap<String, u64>,
}

impl SetsAccount {
    /// The best account of the sets: the last account in the file, or the outcome of the recording where that counts
    /// more. After a write that failed no account is written, and only a recovery knows what a crash took.
    pub(super) fn known(account: Option<&SetCounts>, outcome: Option<&Outcome>) -> Option<Self> {
        let written = account.map(Self::written);
        let base = written.clone().unwrap_or_default();
        // An account that does not balance is a finding of its own and stays.
        let ended = outcome.map(Self::ended).filter(|e| base.balances() && e.exceeds(&base));
        ended.or(written)
    }

    fn written(account: &SetCounts) -> Self {
        let dropped = account.dropped_by_reason().map(|(reason, n)| (reason.name().to_owned(), n));
        Self { offered: account.offered, recorded: account.recorded, dropped: dropped.collect() }
    }

    fn ended(outcome: &Outcome) -> Self {
        let dropped = outcome.sets_dropped.iter().filter(|(_, n)| **n > 0);
        let dropped = dropped.map(|(reason, n)| (reason.clone(), *n)).collect();
        let mut ended = Self { offered: 0, recorded: outcome.sets_recorded, dropped };
        // A hand-edited `session.toml` may not add up; at least as many sets were handed over as it names.
        ended.offered = outcome.sets_offered.max(ended.recorded.saturating_add(ended.dropped_total()));
        ended
    }

    fn exceeds(&self, other: &Self) -> bool {
        self.offered > other.offered || self.dropped_total() > other.dropped_total()
    }

    /// Sets lost for any reason.
    pub fn dropped_total(&self) -> u64 {
        self.dropped.values().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// Whether `offered = recorded + Σ dropped`.
    pub fn balances(&self) -> bool {
        self.offered == self.recorded.saturating_add(self.dropped_total())
    }
}
