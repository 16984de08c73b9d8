//! A set on its way: the workers fill its slots in any order, the writer takes tickets in order.

use crate::encode::EncodedFrame;
use crate::frame::{RecordFrame, RecordMotion, RecordSet};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FrameHeader, HostTime, UtcPair};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How full the two queues are.
#[derive(Debug, Default)]
pub(super) struct Load {
    /// Sets that wait for an encoder.
    pub(super) unencoded: AtomicUsize,
    /// Encoded bytes that are not written yet.
    pub(super) backlog_bytes: AtomicU64,
}

pub(super) struct Ticket {
    pub(super) id: u64,
    pub(super) tick: HostTime,
    pub(super) utc: UtcPair,
    /// Added to a monotonic time of this recording to place it in UTC.
    pub(super) utc_offset_ns: i64,
    pub(super) log_time: i64,
    pub(super) spread_ns: i64,
    pub(super) offered: u64,
    pub(super) missing: Vec<usize>,
    /// Stream and header of each frame, `set_id` filled in.
    pub(super) frames: Vec<(usize, FrameHeader)>,
    /// The batches of the motion units, `set_id` filled in.
    pub(super) motion: Vec<RecordMotion>,
    slots: Mutex<Slots>,
    ready: Condvar,
    load: Arc<Load>,
}

struct Slots {
    left: usize,
    bytes: u64,
    done: Vec<Option<Result<EncodedFrame>>>,
}

/// One frame to be encoded into its slot.
pub(super) struct Job {
    ticket: Arc<Ticket>,
    slot: usize,
    frame: Option<RecordFrame>,
}

impl Ticket {
    pub(super) fn new(
        set: RecordSet,
        anchor: &UtcPair,
        log_time: i64,
        offered: u64,
        load: &Arc<Load>,
    ) -> (Self, Vec<RecordFrame>) {
        let mut frames = set.frames;
        for f in &mut frames {
            f.header.set_id = set.id;
        }
        let mut motion = set.motion;
        for batch in &mut motion {
            batch.header.set_id = set.id;
        }
        // Samples wait for the writer as encoded pictures do.
        let bytes = motion.iter().map(RecordMotion::stored_bytes).sum();
        load.backlog_bytes.fetch_add(bytes, Ordering::Relaxed);
        let done = frames.iter().map(|_| None).collect();
        let ticket = Self {
            id: set.id,
            tick: set.tick,
            utc: set.utc,
            utc_offset_ns: anchor.utc_ns.saturating_sub(anchor.mono.ns()),
            log_time,
            spread_ns: set.spread_ns,
            offered,
            missing: set.missing,
            slots: Mutex::new(Slots { left: frames.len(), bytes, done }),
            frames: frames.iter().map(|f| (f.stream, f.header)).collect(),
            motion,
            ready: Condvar::new(),
            load: Arc::clone(load),
        };
        (ticket, frames)
    }

    /// A monotonic time of this recording as UTC.
    pub(super) const fn utc_ns(&self, mono_ns: i64) -> i64 {
        mono_ns.saturating_add(self.utc_offset_ns)
    }

    /// The encoded frames once all are there; `None` when they are not after `patience`.
    pub(super) fn wait(&self, patience: Duration) -> Option<Result<Vec<EncodedFrame>>> {
        let slots = self.lock();
        let waited = self.ready.wait_timeout_while(slots, patience, |s| s.left > 0);
        let mut slots = waited.unwrap_or_else(PoisonError::into_inner).0;
        (slots.left == 0).then(|| slots.done.drain(..).flatten().collect())
    }

    fn lock(&self) -> MutexGuard<'_, Slots> {
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What this set added to [`Load::backlog_bytes`].
    pub(super) fn taken_bytes(&self) -> u64 {
        self.lock().bytes
    }

    /// Fills a slot, once; the last one makes the ticket ready.
    fn fill(&self, slot: usize, result: Result<EncodedFrame>) {
        let mut slots = self.lock();
        let Some(place) = slots.done.get_mut(slot).filter(|p| p.is_none()) else { return };
        let bytes = result.as_ref().map_or(0, |f| f.chunk.len());
        self.load.backlog_bytes.fetch_add(bytes, Ordering::Relaxed);
        *place = Some(result);
        slots.bytes += bytes;
        slots.left -= 1;
        if slots.left == 0 {
            self.load.unencoded.fetch_sub(1, Ordering::Relaxed);
            self.ready.notify_all();
        }
    }
}

impl Job {
    pub(super) fn new(ticket: Arc<Ticket>, slot: usize, frame: RecordFrame) -> Self {
        Self { ticket, slot, frame: Some(frame) }
    }

    pub(super) fn ticket(&self) -> &Arc<Ticket> {
        &self.ticket
    }

    /// Encodes the frame, which lets go of its pixels unless they may wait, and only then fills the slot.
    pub(super) fn run(mut self, encode: impl FnOnce(RecordFrame) -> Result<EncodedFrame>) {
        let Some(frame) = self.frame.take() else { return };
        let result = encode(frame);
        self.ticket.fill(self.slot, result);
    }
}

impl Drop for Job {
    /// A job that was not run fails its set instead of leaving the writer waiting.
    fn drop(&mut self) {
        self.ticket.fill(self.slot, Err(Error::new(ErrorKind::Codec, "a frame was given up by its encoder")));
    }
}
