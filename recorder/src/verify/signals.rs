//! Signals: their samples in order, and the single samples beside them.

mod set;

use super::{Findings, Severity};
use crate::container::scan::Message;
use crate::dataset::{Kind, Removed, SignalCount};
use crate::{Session, SignalRecord};
use depthrig_bus::{SignalFlags, SignalSample, StreamId};
use std::collections::BTreeMap;

pub(super) use set::set;

/// The messages of signals since the last commit mark.
#[derive(Default)]
pub(super) struct Messages {
    parts: Vec<Part>,
    /// Of each signal.
    single: BTreeMap<StreamId, Vec<Single>>,
}

/// Samples of a signal that wait for their set's mark.
struct Part {
    signal: StreamId,
    log_time: u64,
    message: Vec<u8>,
}

/// A single sample: its time and the checksum of its message.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Single {
    publish_time: u64,
    crc32: u32,
}

impl Messages {
    /// Takes a message of a signal; whether it is one.
    pub(super) fn take(&mut self, kind: &Kind, m: &Message<'_>) -> bool {
        match kind {
            Kind::Signal(id) => {
                let message = m.data.to_vec();
                self.parts.push(Part { signal: id.clone(), log_time: m.log_time, message });
            }
            Kind::SignalSingle(id) => {
                let single = Single { publish_time: m.publish_time, crc32: crc32fast::hash(m.data) };
                self.single.entry(id.clone()).or_default().push(single);
            }
            _ => return false,
        }
        true
    }
}

/// State kept from set to set of a signal.
#[derive(Clone)]
struct Signal {
    record: SignalRecord,
    count: SignalCount,
    last: Option<Last>,
}

#[derive(Clone, Copy)]
struct Last {
    session: u64,
    sequence: u64,
    time_ns: i64,
}

/// The signals of a session.
#[derive(Clone, Default)]
pub(super) struct Signals(BTreeMap<StreamId, Signal>);

impl Signals {
    pub(super) fn new(session: &Session) -> Self {
        let signal = |record: &SignalRecord| {
            (record.id.clone(), Signal { record: record.clone(), count: SignalCount::default(), last: None })
        };
        Self(session.signals.iter().map(signal).collect())
    }

    /// Samples so far.
    pub(super) fn samples(&self) -> u64 {
        self.0.values().map(|s| s.count.samples).sum()
    }

    /// Whether `id` is a signal.
    pub(super) fn has(&self, id: &StreamId) -> bool {
        self.0.contains_key(id)
    }

    /// Channels of signals that a segment has too many, or one without the other. Signals that appeared later have none.
    pub(super) fn channels<'a>(&self, kinds: &(impl Iterator<Item = &'a Kind> + Clone)) -> Vec<String> {
        let ids = |of: fn(&Kind) -> Option<&StreamId>| kinds.clone().filter_map(of).collect::<Vec<_>>();
        let samples = ids(|k| if let Kind::Signal(id) = k { Some(id) } else { None });
        let single = ids(|k| if let Kind::SignalSingle(id) = k { Some(id) } else { None });
        let mut problems = Vec::new();
        for (there, others) in [(&samples, &single), (&single, &samples)] {
            for id in there {
                if !self.has(id) {
                    problems.push(format!("{id} is a signal that is not in the session"));
                } else if !others.contains(id) {
                    problems.push(format!("the signal {id} has one channel, not two"));
                }
            }
        }
        problems
    }

    /// Adds the findings at the end. What is missing was lost live, as with IMUs; samples of
    /// removed sets are not missing.
    pub(super) fn finish(&self, end_ns: Option<i64>, findings: &mut Findings) {
        for (id, signal) in &self.0 {
            for what in signal.count.in_words(id, end_ns) {
                findings.add(Severity::Note, crate::SESSION_FILE, None, what);
            }
        }
    }
}

impl Signal {
    /// Checks samples against those before; the problems in words.
    fn follow(&mut self, samples: &[SignalSample], set_utc_ns: i64, removed: &Removed) -> Vec<String> {
        let mut problems = Vec::new();
        for sample in samples {
            let h = sample.header();
            let now = Last { session: h.session, sequence: h.sequence, time_ns: h.time_ns };
            let Some(before) = self.last.replace(now) else { continue };
            let number = h.sequence;
            if (now.session, number) <= (before.session, before.sequence) {
                problems.push(format!("sample {number} follows sample {}", before.sequence));
            }
            // A recorded replay may begin again at any sample.
            let same = now.session == before.session && !sample.has(SignalFlags::REPLAYED);
            if same && now.time_ns <= before.time_ns {
                problems.push(format!("the time of sample {number} is not later than that before it"));
            }
        }
        self.count.take(samples, set_utc_ns, removed);
        problems.truncate(3);
        problems
    }
}
