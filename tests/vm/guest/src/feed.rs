//! A subscriber of every stream of the rig that counts every frame, and reads the stamp that the emulator put into it.

use anyhow::Context;
use depthrig_bus::{Bus, FrameHeader, RigName, RuntimeDir, StreamId, Subscriber};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// A channel keeps four unread frames; at 30 frames/s that is 130 ms.
const PAUSE: Duration = Duration::from_millis(10);
/// How long a channel may take to be made.
const TIMEOUT: Duration = Duration::from_secs(5);

/// A frame as a subscriber saw it.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    /// Its number on the channel.
    pub sequence: u64,
    /// Frames that the device had captured by then.
    pub captured: u64,
    /// Frames that were lost by then, for any reason.
    pub dropped: u64,
    /// The index that the emulator stamped into it; `None` when the stamp is missing or damaged.
    pub index: Option<u64>,
}

/// Frames seen of one stream.
#[derive(Debug, Clone)]
pub struct Watched {
    /// The stream.
    pub id: StreamId,
    /// Every frame in order.
    pub frames: Vec<Seen>,
    /// Frames that were replaced before this subscriber read them.
    pub missed: u64,
}

impl Watched {
    /// Frames between the first and the last one seen that were sent by the camera and are not here, by their stamps.
    pub fn lost(&self) -> u64 {
        let indexes = || self.frames.iter().filter_map(|f| f.index);
        match (indexes().next(), indexes().next_back()) {
            (Some(first), Some(last)) => (last - first + 1).saturating_sub(indexes().count() as u64),
            _ => 0,
        }
    }

    /// Whether each stamp is greater than the one before and none is missing or damaged.
    pub fn in_order(&self) -> bool {
        self.frames.iter().all(|f| f.index.is_some())
            && self.frames.windows(2).all(|w| w[0].index < w[1].index && w[0].sequence + 1 == w[1].sequence)
    }
}

/// A thread that reads; [`Feed::end`] returns the frames it read.
pub struct Feed {
    stop: Arc<AtomicBool>,
    reader: JoinHandle<anyhow::Result<Vec<Watched>>>,
}

impl Feed {
    /// Subscribes to `streams` of the rig; `index` reads the stamp of a frame.
    ///
    /// # Errors
    /// When a stream is not there.
    pub fn start(
        runtime: &RuntimeDir,
        streams: &[StreamId],
        index: fn(&FrameHeader, &[u8]) -> Option<u64>,
    ) -> anyhow::Result<Self> {
        let bus = Bus::open(runtime, &RigName::new(crate::daemon::RIG)?)?;
        let mut channels = Vec::new();
        for id in streams {
            let subscriber = bus.subscriber_within(id, TIMEOUT)?;
            channels.push((subscriber, Watched { id: id.clone(), frames: Vec::new(), missed: 0 }));
        }
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let reader = std::thread::spawn(move || {
            let _bus = bus;
            loop {
                // Read before looking, so that what came before the end is read as well.
                let last = stopped.load(Ordering::Relaxed);
                for (subscriber, watched) in &mut channels {
                    read(subscriber, watched, index)?;
                }
                if last {
                    return Ok(channels.into_iter().map(|(_, watched)| watched).collect());
                }
                std::thread::sleep(PAUSE);
            }
        });
        Ok(Self { stop, reader })
    }

    /// Frames seen until now.
    ///
    /// # Errors
    /// When a stream could not be read.
    pub fn end(self) -> anyhow::Result<Vec<Watched>> {
        self.stop.store(true, Ordering::Relaxed);
        let read = self.reader.join();
        read.ok().context("the subscriber panicked")?
    }
}

fn read(
    subscriber: &mut Subscriber,
    watched: &mut Watched,
    index: fn(&FrameHeader, &[u8]) -> Option<u64>,
) -> anyhow::Result<()> {
    while let Some(frame) = subscriber.try_next()? {
        let header = frame.header();
        watched.frames.push(Seen {
            sequence: header.sequence,
            captured: header.captured,
            dropped: header.dropped.iter().sum(),
            index: index(header, frame.pixels()),
        });
    }
    watched.missed = subscriber.missed();
    Ok(())
}
