//! Samples of signals on their way into a recording: they wait for the next set that is handed over, as IMU batches do.
//!
//! All of them together take no more than one set may hold; the oldest of a signal that exceeds its share go first, and
//! are counted. A signal that appears while a recording goes on is recorded from then on. One whose publisher comes back
//! with other fields is not, until the next recording: the fields of a channel stay the same over a dataset.

use super::waiting::Waiting;
use crate::config::SignalConfig;
use crate::status::{SignalState, SignalStatus};
use depthrig_bus::{DropCounts, DropReason, HostTime, SignalSample, StreamId};
use depthrig_recorder::{RecordSignal, Recorder, SET_SIGNALS_MAX_BYTES, SignalRecord, StreamAccount};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

/// A recording begins with the samples of so long before: the first set has a moment before the recording began.
const BEFORE_NS: i64 = 1_000_000_000;
/// So many of a signal at most.
const BEFORE_SAMPLES: usize = 512;

/// The signals that are published now, as far as a sample of them was read.
#[derive(Default)]
pub(super) struct Known(BTreeMap<StreamId, Published>);

struct Published {
    record: SignalRecord,
    /// When the last sample was read.
    heard: HostTime,
    samples: u64,
    missed: u64,
    /// The last samples while nothing is recorded.
    before: VecDeque<SignalSample>,
}

impl Known {
    /// Takes in samples of the signal `id`, before which `missed` were replaced on the channel; they go to the recording, if
    /// there is one.
    pub(super) fn hear(
        &mut self,
        recording: Option<(&mut Signals, &Recorder)>,
        id: &StreamId,
        samples: Vec<SignalSample>,
        missed: u64,
    ) {
        if let Some(newest) = samples.last() {
            let description = newest.description();
            let is_known = self.0.get(id).is_some_and(|p| Arc::ptr_eq(&p.record.description, description));
            if !is_known {
                let record = SignalRecord::new(description);
                let fresh = Published {
                    record,
                    heard: HostTime::now(),
                    samples: 0,
                    missed: 0,
                    before: VecDeque::new(),
                };
                self.0.insert(id.clone(), fresh);
            }
        }
        if let Some(published) = self.0.get_mut(id) {
            published.missed += missed;
            published.samples += samples.len() as u64;
            if !samples.is_empty() {
                published.heard = HostTime::now();
            }
        }
        if let Some((signals, recorder)) = recording {
            signals.hear(recorder, id, samples, missed);
        } else if let Some(Published { record, before, .. }) = self.0.get_mut(id) {
            before.extend(samples.into_iter().filter(|s| *s.description() == record.description));
            before.drain(..before.len().saturating_sub(BEFORE_SAMPLES));
        }
    }

    /// Hands the samples of the last second, and the last one however old, to a recording that begins.
    pub(super) fn begin(&mut self, signals: &mut Signals, recorder: &Recorder) {
        let since = HostTime::now().plus_ns(-BEFORE_NS);
        for (id, Published { before, .. }) in &mut self.0 {
            let last = before.len().saturating_sub(1);
            let old = before.iter().take(last).take_while(|s| s.time() < since).count();
            let samples = before.drain(..).skip(old).collect();
            signals.hear(recorder, id, samples, 0);
        }
    }

    /// Forgets the signals that nobody publishes any more.
    pub(super) fn keep(&mut self, is_published: impl Fn(&StreamId) -> bool) {
        self.0.retain(|id, _| is_published(id));
    }

    /// Their states at `now`: those that `named` lists in its order, then others.
    pub(super) fn states(&self, named: &[SignalConfig], now: HostTime) -> Vec<SignalStatus> {
        let id_of =
            |c: &SignalConfig| StreamId { camera: c.name.device().clone(), stream: c.name.signal().clone() };
        let state = |id: &StreamId, config: Option<&SignalConfig>| {
            let found = self.0.get(id);
            let age_s = found.map(|p| now.since_ns(p.heard).max(0) as f64 / 1e9);
            let silent_s = config.map_or(f64::INFINITY, |c| c.silent_s);
            SignalStatus {
                signal: id.to_string(),
                required: config.is_some_and(|c| c.required),
                state: match age_s {
                    None => SignalState::Missing,
                    Some(age) if age > silent_s => SignalState::Silent,
                    Some(_) => SignalState::Live,
                },
                age_s,
                samples: found.map_or(0, |p| p.samples),
                missed: found.map_or(0, |p| p.missed),
            }
        };
        let configured: Vec<_> = named.iter().map(id_of).collect();
        let others = self.0.keys().filter(|id| !configured.contains(id)).map(|id| state(id, None));
        configured.iter().zip(named).map(|(id, c)| state(id, Some(c))).chain(others).collect()
    }

    /// All of them.
    pub(super) fn records(&self) -> Vec<SignalRecord> {
        self.0.values().map(|p| p.record.clone()).collect()
    }
}

/// The signals of one recording.
pub(super) struct Signals {
    sources: Vec<Source>,
    waiting: Waiting<SignalSample>,
    /// Signals that cannot be recorded, so that it is said once.
    refused: BTreeSet<StreamId>,
}

struct Source {
    record: SignalRecord,
    /// Samples that went to the recorder with sets.
    handed: u64,
    /// Samples that were lost on the way here: replaced on the channel, pushed out while they waited, or of other fields.
    lost: u64,
    /// Said that its fields changed.
    is_changed: bool,
}

impl Signals {
    /// Those that the recording begins with, in the order of its session.
    pub(super) fn new(records: Vec<SignalRecord>) -> Self {
        let mut signals = Self { sources: Vec::new(), waiting: Waiting::new(), refused: BTreeSet::new() };
        for record in records {
            signals.add(record);
        }
        signals
    }

    fn add(&mut self, record: SignalRecord) {
        self.sources.push(Source { record, handed: 0, lost: 0, is_changed: false });
        let share = SET_SIGNALS_MAX_BYTES / 2 / self.sources.len() as u64;
        self.waiting.add_source(share);
        for (index, source) in self.sources.iter_mut().enumerate() {
            source.lost += self.waiting.limit(index, share);
        }
    }

    /// Takes in samples of one signal, before which `missed` were replaced on the channel.
    pub(super) fn hear(
        &mut self,
        recorder: &Recorder,
        id: &StreamId,
        samples: Vec<SignalSample>,
        missed: u64,
    ) {
        let index = match self.sources.iter().position(|s| s.record.id == *id) {
            Some(index) => index,
            None => match samples.first() {
                Some(sample) if !self.refused.contains(id) => {
                    let record = SignalRecord::new(sample.description());
                    if let Err(e) = recorder.add_signal(record.clone()) {
                        tracing::error!("{e}");
                        self.refused.insert(id.clone());
                        return;
                    }
                    self.add(record);
                    self.sources.len() - 1
                }
                _ => return,
            },
        };
        let source = &mut self.sources[index];
        source.lost += missed;
        for sample in samples {
            if sample.description() != &source.record.description {
                source.lost += 1;
                if !core::mem::replace(&mut source.is_changed, true) {
                    tracing::error!(
                        "signal {id} has other fields than when the recording began: its samples are not recorded and \
                         count as lost; stop the recording and start another one"
                    );
                }
                continue;
            }
            let bytes = RecordSignal::sample_bytes(sample.description(), sample.bytes().len());
            source.lost += self.waiting.push(index, bytes, sample);
        }
    }

    /// Everything that waits, for the set that is handed over now.
    pub(super) fn take(&mut self) -> Vec<RecordSignal> {
        let mut parts: Vec<RecordSignal> = Vec::new();
        for signal in 0..self.sources.len() {
            let mut session = None;
            for sample in self.waiting.take(signal) {
                let of = Some(sample.header().session);
                match parts.last_mut().filter(|_| session == of) {
                    Some(part) => part.samples.push(sample),
                    None => parts.push(RecordSignal { signal, samples: vec![sample] }),
                }
                session = of;
            }
        }
        parts
    }

    /// Counts the samples that go to the recorder with a set.
    pub(super) fn hand_over(&mut self, parts: &[RecordSignal]) {
        for part in parts {
            if let Some(source) = self.sources.get_mut(part.signal) {
                source.handed += part.samples.len() as u64;
            }
        }
    }

    /// Accounts of the signals since the recording began, except for samples that wait.
    pub(super) fn accounts(&self) -> impl Iterator<Item = StreamAccount> + '_ {
        self.sources.iter().map(|s| {
            let mut dropped = DropCounts::default();
            dropped.add(DropReason::QueueFull, s.lost);
            let stream = s.record.id.clone();
            StreamAccount { stream, captured: s.handed + s.lost, delivered: s.handed, dropped }
        })
    }
}
