//! The signals of a replay: published on their channels with the times of the recording.

use super::Inner;
use depthrig_bus::{RuntimeDir, SignalFlags, SignalHeader, SignalPublisher, SignalSample, Signals, Stamp};
use depthrig_recorder::{RecordSignal, SignalRecord};

/// The channels of the signals.
pub(super) struct Outputs {
    /// It holds the channels open.
    _place: Option<Signals>,
    /// Of each signal; `None` for one that somebody else publishes.
    publishers: Vec<Option<SignalPublisher>>,
    /// Samples that were published, and go into the next set that is recorded.
    carried: Vec<RecordSignal>,
}

impl Outputs {
    /// Opens the channels of `signals`. One that a process publishes already is left to it, and stated as lost.
    ///
    /// # Errors
    /// As [`Signals::open`].
    pub(super) fn open(inner: &Inner, runtime: &RuntimeDir, signals: &[SignalRecord]) -> crate::Result<Self> {
        // A dataset that the live page shows is not a robot.
        if signals.is_empty() || inner.options.in_background {
            return Ok(Self { _place: None, publishers: Vec::new(), carried: Vec::new() });
        }
        let place = Signals::open(runtime)?;
        let open = |signal: &SignalRecord| match place.publisher(&signal.description) {
            Ok(publisher) => Some(publisher),
            Err(e) => {
                inner.lose(format!("signal {} is not replayed: {e}", signal.id));
                None
            }
        };
        let publishers = signals.iter().map(open).collect();
        Ok(Self { _place: Some(place), publishers, carried: Vec::new() })
    }

    /// Publishes the samples before a set; they are kept for the recording of the replay, if there is one.
    pub(super) fn publish(&mut self, inner: &Inner, parts: Vec<RecordSignal>, is_recording: bool) {
        if !is_recording {
            self.carried.clear();
        }
        for mut part in parts {
            if let Some(Some(publisher)) = self.publishers.get_mut(part.signal) {
                for sample in &part.samples {
                    let h = sample.header();
                    let stamp = Stamp {
                        time: sample.time(),
                        uncertainty_ns: h.uncertainty_ns,
                        flags: SignalFlags(h.flags | SignalFlags::REPLAYED.0),
                    };
                    if let Err(e) = publisher.publish_at(&stamp, sample.values()) {
                        inner.lose(format!("a sample is not replayed: {e}"));
                    }
                }
            }
            if is_recording {
                let replayed = |h: &mut SignalHeader| h.flags |= SignalFlags::REPLAYED.0;
                part.samples = part.samples.iter().filter_map(|s| changed(s, replayed)).collect();
                self.carried.push(part);
            }
        }
    }

    /// Has subscribers that came meanwhile see the last samples.
    pub(super) fn welcome(&self) {
        self.publishers.iter().flatten().for_each(SignalPublisher::welcome);
    }

    /// The samples that go into the next set that is recorded.
    pub(super) fn take(&mut self) -> Vec<RecordSignal> {
        core::mem::take(&mut self.carried)
    }
}

/// The same sample with another header.
pub(super) fn changed(sample: &SignalSample, change: impl FnOnce(&mut SignalHeader)) -> Option<SignalSample> {
    let mut header = *sample.header();
    change(&mut header);
    SignalSample::new(header, sample.description(), sample.bytes().to_vec()).ok()
}

/// The same sample on a clock that is `shift_ns` ahead. Its publisher is known by a time of that clock as well, which is `session_shift_ns`
/// ahead for all of its samples. `after` is the time of the sample before it, and stays before it although the shift may shrink.
pub(super) fn shifted(
    sample: &SignalSample,
    shift_ns: i64,
    session_shift_ns: i64,
    after: &mut Option<(u64, i64)>,
) -> Option<SignalSample> {
    if shift_ns == 0 && session_shift_ns == 0 {
        return Some(sample.clone());
    }
    changed(sample, |h| {
        h.session = h.session.saturating_add_signed(session_shift_ns).max(1);
        h.time_ns = h.time_ns.saturating_add(shift_ns);
        if let Some((session, time_ns)) = *after
            && session == h.session
        {
            h.time_ns = h.time_ns.max(time_ns.saturating_add(1));
        }
        h.publish_time_ns = h.publish_time_ns.saturating_add(shift_ns);
        *after = Some((h.session, h.time_ns));
    })
}
