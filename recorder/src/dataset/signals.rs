//! Counts of a signal while its samples are read.

use super::removed::{Crossing, Removed};
use depthrig_bus::{SignalSample, StreamId};

/// Silence at the end of a recording is stated if it is longer than this and ten times the usual distance of samples.
const SILENT_NS: i64 = 1_000_000_000;

/// Counts of a signal.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct SignalCount {
    /// Samples that passed.
    pub(crate) samples: u64,
    /// Samples that are missing between those, without those of removed sets.
    pub(crate) lost: u64,
    /// Number of times that another publisher took over.
    pub(crate) restarts: u64,
    /// Time without a publisher's samples at these.
    away_ns: i64,
    crossing: Crossing,
    first_ns: Option<i64>,
    last: Option<Last>,
}

#[derive(Debug, Clone, Copy)]
struct Last {
    session: u64,
    sequence: u64,
    time_ns: i64,
}

impl SignalCount {
    /// Takes the samples of a set by its log time.
    pub(crate) fn take(&mut self, samples: &[SignalSample], set_utc_ns: i64, removed: &Removed) {
        let mut crosses = self.crossing.take(set_utc_ns, removed);
        for sample in samples {
            let h = sample.header();
            self.samples += 1;
            self.first_ns.get_or_insert(h.time_ns);
            let now = Last { session: h.session, sequence: h.sequence, time_ns: h.time_ns };
            let Some(before) = self.last.replace(now) else { continue };
            if std::mem::take(&mut crosses) {
                self.crossing.pass(before.time_ns, now.time_ns);
            } else if before.session == now.session {
                let gap = now.sequence.saturating_sub(before.sequence.saturating_add(1));
                self.lost = self.lost.saturating_add(gap);
            } else {
                self.restarts += 1;
                self.lost = self.lost.saturating_add(now.sequence.saturating_sub(1));
                let away = now.time_ns.saturating_sub(before.time_ns).max(0);
                self.away_ns = self.away_ns.saturating_add(away);
            }
        }
    }

    /// Samples per second, 0 without two.
    pub(crate) fn rate_hz(&self) -> f64 {
        self.crossing.rate_hz(self.samples, self.span_ns())
    }

    fn span_ns(&self) -> i64 {
        self.last.zip(self.first_ns).map_or(0, |(last, first)| last.time_ns.saturating_sub(first))
    }

    /// The losses and pauses in words; `end_ns` is the time of the last set.
    pub(crate) fn in_words(&self, id: &StreamId, end_ns: Option<i64>) -> Vec<String> {
        let mut words = Vec::new();
        if self.lost > 0 {
            words.push(format!("{} samples of {id} were not recorded", self.lost));
        }
        if self.restarts > 0 {
            words.push(format!(
                "{id} was published anew {} times; it had no samples for {:.3} s meanwhile",
                self.restarts,
                self.away_ns as f64 / 1e9
            ));
        }
        let span_ns = self.span_ns().saturating_sub(self.crossing.away_ns);
        let period_ns = span_ns / i64::try_from(self.samples.saturating_sub(1).max(1)).unwrap_or(1);
        match (self.last, end_ns) {
            (None, _) => words.push(format!("{id} has no samples")),
            (Some(last), Some(end)) => {
                let silent = end.saturating_sub(last.time_ns);
                if silent > SILENT_NS.max(period_ns.saturating_mul(10)) {
                    let seconds = silent as f64 / 1e9;
                    words.push(format!("{id} has no samples in the last {seconds:.1} s of the recording"));
                }
            }
            (Some(_), None) => {}
        }
        words
    }
}
