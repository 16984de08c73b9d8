//! The newest frames of streams that somebody looks at.

use core::time::Duration;
use depthrig_bus::{Bus, Error, ErrorKind, Frame, HostTime, StreamId, Subscriber};
use std::collections::{BTreeMap, BTreeSet};

/// Pause before a stream that does not exist is looked for again.
const RETRY: Duration = Duration::from_millis(500);

/// Subscribers of streams, and the newest frame of each.
pub(crate) struct Newest {
    bus: Bus,
    streams: BTreeMap<StreamId, Source>,
    frames: BTreeMap<StreamId, Frame>,
}

/// A watched stream.
enum Source {
    Open(Box<Subscriber>),
    /// It does not exist; when to look again.
    Missing(HostTime),
}

impl Newest {
    pub(crate) const fn new(bus: Bus) -> Self {
        Self { bus, streams: BTreeMap::new(), frames: BTreeMap::new() }
    }

    /// The newest frame of each stream.
    pub(crate) const fn frames(&self) -> &BTreeMap<StreamId, Frame> {
        &self.frames
    }

    /// Leaves all streams but these.
    pub(crate) fn keep(&mut self, watched: &BTreeSet<StreamId>) {
        self.streams.retain(|id, _| watched.contains(id));
        self.frames.retain(|id, _| watched.contains(id));
    }

    /// Takes the newest frame of a stream, and opens the stream first where needed.
    ///
    /// # Errors
    /// Why the stream cannot be read. A camera that is being opened has no channel yet; that is `Ok`.
    pub(crate) fn take(&mut self, id: &StreamId) -> Result<(), Error> {
        self.read(id, |subscriber| subscriber.latest().map(Vec::from_iter))
            .map(|frames| drop(frames.into_iter().next_back().map(|f| self.frames.insert(id.clone(), f))))
    }

    /// All frames of a stream since the last call, oldest first; of one that was not read for long the newest four.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub(crate) fn take_all(&mut self, id: &StreamId) -> Result<Vec<Frame>, Error> {
        self.read(id, |subscriber| {
            let mut frames = Vec::new();
            while let Some(frame) = subscriber.try_next()? {
                frames.push(frame);
                // A subscriber may hold sixteen, and four wait for it at the most.
                if frames.len() == depthrig_bus::SUBSCRIBER_BUFFER {
                    break;
                }
            }
            Ok(frames)
        })
    }

    fn read(
        &mut self,
        id: &StreamId,
        what: impl FnOnce(&mut Subscriber) -> Result<Vec<Frame>, Error>,
    ) -> Result<Vec<Frame>, Error> {
        let source = self.streams.entry(id.clone()).or_insert_with(|| Source::Missing(HostTime::now()));
        if let Source::Missing(again) = source
            && again.from_now().is_zero()
        {
            match self.bus.subscriber(id) {
                Ok(subscriber) => *source = Source::Open(Box::new(subscriber)),
                Err(e) => {
                    *source = Source::Missing(HostTime::now().plus(RETRY));
                    // A camera that is being opened has no channel yet; its state says so.
                    return if e.kind() == ErrorKind::NotFound { Ok(Vec::new()) } else { Err(e) };
                }
            }
        }
        let Source::Open(subscriber) = source else { return Ok(Vec::new()) };
        what(subscriber).inspect_err(|_| {
            // Its publisher may have begun anew.
            *source = Source::Missing(HostTime::now().plus(RETRY));
        })
    }
}

/// The next time at which a stream is sent with this period. It is the same for all viewers, so that an image is encoded once for all, and
/// another one for each stream, so that not all are encoded at once.
pub(crate) fn next_turn(id: &StreamId, period: Duration) -> HostTime {
    let period = period.as_nanos() as i64;
    let phase = i64::from(crc32fast::hash(id.to_string().as_bytes())) % period;
    let now = HostTime::now().ns();
    let into = (now - phase).rem_euclid(period);
    HostTime::from_ns(now - into + period)
}
