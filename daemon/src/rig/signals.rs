//! Reads every signal that is published, for the recording.
//!
//! It is a reader like any other and has a thread of its own: a channel that is slow to open holds up no frame set.

use super::Inner;
use crate::status::{SignalState, SignalStatus};
use core::time::Duration;
use depthrig_bus::{ErrorKind, HostTime, SignalName, SignalSubscriber, Signals, StreamId};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// From one read to the next: a channel keeps 512 samples, which are 51 ms of 10 kHz.
const READ_EVERY: Duration = Duration::from_millis(10);
/// From one look for new signals to the next.
const LOOK_EVERY_NS: i64 = 200_000_000;
/// Samples of a signal that are handed over together.
const BATCH: usize = 512;

impl Inner {
    /// Refuses a recording while a signal that the rig requires does not come.
    ///
    /// # Errors
    /// [`crate::ErrorKind::WrongState`] naming the signals.
    pub(super) fn signals_must_come(&self) -> crate::Result<()> {
        let states = self.recording().signal_states(&self.config.signals, HostTime::now());
        let silent: Vec<_> = states.iter().filter_map(trouble).collect();
        if silent.is_empty() {
            return Ok(());
        }
        let silent = silent.join("; ");
        Err(crate::Error::new(
            crate::ErrorKind::WrongState,
            format!("{silent}; start the robot's process, or remove required = true from the rig file"),
        ))
    }
}

/// The trouble of a signal that the rig requires, in words; `None` without.
fn trouble(signal: &SignalStatus) -> Option<String> {
    let name = &signal.signal;
    match signal.state {
        _ if !signal.required => None,
        SignalState::Live => None,
        SignalState::Missing => Some(format!("nobody publishes signal {name}, which this rig requires")),
        SignalState::Silent => {
            let age_s = signal.age_s.unwrap_or_default();
            Some(format!("signal {name}, which this rig requires, has been silent for {age_s:.1} s"))
        }
    }
}

/// The thread's state.
pub struct Collector {
    inner: Arc<Inner>,
    signals: Signals,
    inputs: BTreeMap<SignalName, Input>,
    /// Signals that cannot be read, so that it is said once.
    unread: BTreeMap<SignalName, ErrorKind>,
    /// Required signals that do not come, so that it is said once.
    troubles: BTreeSet<String>,
}

/// One signal.
struct Input {
    id: StreamId,
    subscriber: SignalSubscriber,
    /// Missed samples that were handed on.
    missed: u64,
    /// Said that its samples cannot be read.
    is_unreadable: bool,
}

impl Collector {
    /// The thread of a rig.
    ///
    /// # Errors
    /// As [`Signals::open`].
    pub fn new(inner: Arc<Inner>) -> crate::Result<Self> {
        let signals = Signals::open(&inner.runtime)?;
        Ok(Self {
            inner,
            signals,
            inputs: BTreeMap::new(),
            unread: BTreeMap::new(),
            troubles: BTreeSet::new(),
        })
    }

    /// Runs until the rig stops.
    pub fn run(mut self, stop: &AtomicBool) {
        let mut next_look = HostTime::now();
        while !stop.load(Ordering::Relaxed) {
            if next_look.from_now().is_zero() {
                self.find();
                next_look = HostTime::now().plus_ns(LOOK_EVERY_NS);
            }
            self.read();
            std::thread::sleep(READ_EVERY);
        }
    }

    fn read(&mut self) {
        for input in self.inputs.values_mut() {
            input.read(&self.inner);
        }
    }

    /// Opens the signals that appeared since the last look.
    fn find(&mut self) {
        let published = self.signals.published();
        for (name, _) in &published {
            if self.inputs.contains_key(name) {
                continue;
            }
            match self.signals.subscriber(name) {
                Ok(subscriber) => {
                    let id = StreamId { camera: name.device().clone(), stream: name.signal().clone() };
                    self.unread.remove(name);
                    self.inputs
                        .insert(name.clone(), Input { id, subscriber, missed: 0, is_unreadable: false });
                    // Opening a channel takes some milliseconds: twenty of them must not make others overflow.
                    self.read();
                }
                // Its publisher is just opening the channel.
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                Err(e) => {
                    if self.unread.insert(name.clone(), e.kind()) != Some(e.kind()) {
                        tracing::error!("signal {name} is not recorded: {e}");
                    }
                }
            }
        }
        let is_published = |id: &StreamId| {
            published.iter().any(|(name, _)| (name.device(), name.signal()) == (&id.camera, &id.stream))
        };
        self.inner.recording().keep_signals(is_published);
        self.watch();
    }

    /// Logs required signals that fall silent, and those that come again.
    fn watch(&mut self) {
        if self.inner.config.signals.is_empty() {
            return;
        }
        let states = self.inner.recording().signal_states(&self.inner.config.signals, HostTime::now());
        for signal in &states {
            match trouble(signal) {
                Some(why) => {
                    if self.troubles.insert(signal.signal.clone()) {
                        tracing::error!("{why}");
                    }
                }
                None => {
                    if self.troubles.remove(&signal.signal) {
                        tracing::info!("signal {} comes again", signal.signal);
                    }
                }
            }
        }
    }
}

impl Input {
    /// Reads new samples.
    fn read(&mut self, inner: &Inner) {
        loop {
            let mut samples = Vec::new();
            let mut failed = false;
            while samples.len() < BATCH {
                match self.subscriber.try_next() {
                    Ok(Some(sample)) => samples.push(sample),
                    Ok(None) => break,
                    Err(e) => {
                        // It counts as missed.
                        if !core::mem::replace(&mut self.is_unreadable, true) {
                            tracing::error!("signal {}: a sample is not recorded: {e}", self.id);
                        }
                        failed = true;
                        break;
                    }
                }
            }
            let missed = self.subscriber.missed() - self.missed;
            let n = samples.len();
            if n == 0 && missed == 0 {
                return;
            }
            self.missed += missed;
            inner.recording().hear_signal(&self.id, samples, missed);
            if n < BATCH || failed {
                return;
            }
        }
    }
}
