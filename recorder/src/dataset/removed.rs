//! Runs of sets that `prune` removed: samples that went with them are no loss.

use crate::{RemovedSets, Session};

/// Runs of sets that were removed from a dataset, in the order of their times.
#[derive(Debug, Clone, Default)]
pub(crate) struct Removed(Vec<RemovedSets>);

impl Removed {
    /// The runs that a session states.
    pub(crate) fn of(session: &Session) -> Self {
        let mut runs: Vec<_> = session.derived.iter().flat_map(|step| step.removed.iter().copied()).collect();
        runs.sort_unstable_by_key(|run| run.first_utc_ns);
        Self(runs)
    }

    /// Whether a run lies between two sets, by their log times.
    pub(crate) fn is_between(&self, before_utc_ns: i64, after_utc_ns: i64) -> bool {
        let next = self.0.partition_point(|run| run.first_utc_ns <= before_utc_ns);
        self.0.get(next).is_some_and(|run| run.last_utc_ns < after_utc_ns)
    }
}

/// Follows the sets in which a signal or an IMU has samples.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Crossing {
    last_set_utc_ns: Option<i64>,
    /// Number of runs of removed sets so far.
    pub(super) runs: u64,
    /// Time between the samples around these.
    pub(super) away_ns: i64,
}

impl Crossing {
    /// Takes a set with samples; whether sets were removed between it and the one before.
    pub(super) fn take(&mut self, set_utc_ns: i64, removed: &Removed) -> bool {
        let before = self.last_set_utc_ns.replace(set_utc_ns);
        before.is_some_and(|before| removed.is_between(before, set_utc_ns))
    }

    /// Takes the time between the samples around removed sets.
    pub(super) fn pass(&mut self, before_ns: i64, after_ns: i64) {
        self.runs += 1;
        self.away_ns = self.away_ns.saturating_add(after_ns.saturating_sub(before_ns).max(0));
    }

    /// Samples per second of `samples` samples over `span_ns`, without the time of removed sets; 0 without two samples.
    pub(super) fn rate_hz(&self, samples: u64, span_ns: i64) -> f64 {
        let span_ns = span_ns.saturating_sub(self.away_ns);
        let periods = samples.saturating_sub(1).saturating_sub(self.runs);
        if span_ns > 0 { periods as f64 * 1e9 / span_ns as f64 } else { 0.0 }
    }
}
