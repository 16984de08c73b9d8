//! A set on its way: the workers fill its slots in any order, the writer takes tickets in order.
//!
//! Where a set has a deadline, frames whose turn comes in the second half of the time until then are encoded with the
//! least effort, which makes encoders that are behind several times faster. When that is not enough, they must not
//! work on sets that miss their deadline: a set is given up before its first frame is encoded if even the least effort
//! would take longer than it has left, and whenever its deadline passes.

use crate::encode::{Effort, EncodedFrame};
use crate::frame::{RecordFrame, RecordMotion, RecordSet, RecordSignal};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameHeader, HostTime, UtcPair};
use std::sync::atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Fill levels of the two queues.
#[derive(Debug, Default)]
pub(super) struct Load {
    /// Sets that wait for an encoder.
    pub(super) unencoded: AtomicUsize,
    /// Encoded bytes that are not written yet.
    pub(super) backlog_bytes: AtomicU64,
    /// How long encoding a set with the least effort takes at present, from its first frame to its last.
    hurried_ns: AtomicI64,
    /// Frames encoded with the least effort.
    pub(super) hurried: AtomicU64,
}

/// The outcome of encoding a set.
pub(super) enum Encoded {
    /// Its frames.
    Frames(Vec<EncodedFrame>),
    /// A frame could not be encoded.
    Failed(Error),
    /// It was given up: the encoders were behind.
    Late,
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
    /// The batches of the IMUs, `set_id` filled in.
    pub(super) motion: Vec<RecordMotion>,
    /// The samples of the signals.
    pub(super) signals: Vec<RecordSignal>,
    /// When it is given up.
    pub(super) due: Option<HostTime>,
    pushed: HostTime,
    slots: Mutex<Slots>,
    ready: Condvar,
    load: Arc<Load>,
}

struct Slots {
    left: usize,
    bytes: u64,
    done: Vec<Option<Result<EncodedFrame>>>,
    begun: Option<Begun>,
    given_up: bool,
}

/// When the first frame went to an encoder, and how.
#[derive(Clone, Copy)]
struct Begun {
    at: HostTime,
    effort: Effort,
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
        late_after_ns: Option<i64>,
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
        // Samples wait for the writer as encoded images do.
        let of_motion: u64 = motion.iter().map(RecordMotion::stored_bytes).sum();
        let bytes = of_motion + set.signals.iter().map(RecordSignal::stored_bytes).sum::<u64>();
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
            due: late_after_ns.map(|ns| set.tick.plus_ns(ns)),
            pushed: HostTime::now(),
            slots: Mutex::new(Slots { left: frames.len(), bytes, done, begun: None, given_up: false }),
            frames: frames.iter().map(|f| (f.stream, f.header)).collect(),
            motion,
            signals: set.signals,
            ready: Condvar::new(),
            load: Arc::clone(load),
        };
        (ticket, frames)
    }

    /// A monotonic time of this recording as UTC.
    pub(super) const fn utc_ns(&self, mono_ns: i64) -> i64 {
        mono_ns.saturating_add(self.utc_offset_ns)
    }

    /// Waits for its frames to be encoded; `None` if they are not after `timeout`.
    pub(super) fn wait(&self, timeout: Duration) -> Option<Encoded> {
        let slots = self.lock();
        let waited = self.ready.wait_timeout_while(slots, timeout, |s| s.left > 0 && !s.given_up);
        let mut slots = waited.unwrap_or_else(PoisonError::into_inner).0;
        if slots.given_up {
            return Some(Encoded::Late);
        }
        (slots.left == 0).then(|| {
            let frames: Result<_> = slots.done.drain(..).flatten().collect();
            frames.map_or_else(Encoded::Failed, Encoded::Frames)
        })
    }

    /// Whether its deadline has passed.
    pub(super) fn is_late(&self, now: HostTime) -> bool {
        self.due.is_some_and(|due| now > due)
    }

    /// Gives the set up unless all its frames are encoded.
    pub(super) fn give_up(&self) {
        let mut slots = self.lock();
        if slots.left > 0 {
            self.give_up_locked(&mut slots);
        }
    }

    fn give_up_locked(&self, slots: &mut Slots) {
        slots.given_up = true;
        // Frames already encoded are of no use any more.
        slots.done.iter_mut().filter(|d| d.is_some()).for_each(|d| *d = Some(Err(given_up())));
        self.ready.notify_all();
    }

    /// How to encode a frame of the set now; `None` if the set is given up. That is decided with its first frame: a set
    /// that is expected to miss its deadline leaves its turn to the next one.
    fn admit(&self) -> Option<Effort> {
        let mut slots = self.lock();
        if slots.given_up {
            return None;
        }
        let now = HostTime::now();
        let Some(due) = self.due else { return Some(Effort::Full) };
        let budget = due.since_ns(self.pushed);
        let left = due.since_ns(now);
        let effort = if left > budget / 2 { Effort::Full } else { Effort::Least };
        if slots.begun.is_none() {
            let expected = self.load.hurried_ns.load(Ordering::Relaxed);
            if effort == Effort::Least && expected > left {
                // So that a set is tried again in the end, however slow the last ones were.
                self.load.hurried_ns.store(expected / 8 * 7, Ordering::Relaxed);
                self.give_up_locked(&mut slots);
                return None;
            }
            slots.begun = Some(Begun { at: now, effort });
        }
        self.load.hurried.fetch_add(u64::from(effort == Effort::Least), Ordering::Relaxed);
        Some(effort)
    }

    fn lock(&self) -> MutexGuard<'_, Slots> {
        lock(&self.slots)
    }

    /// The bytes that this set added to [`Load::backlog_bytes`].
    pub(super) fn taken_bytes(&self) -> u64 {
        self.lock().bytes
    }

    /// Fills a slot, once; the last one makes the ticket ready.
    fn fill(&self, slot: usize, result: Result<EncodedFrame>) {
        let mut slots = self.lock();
        let given_up_now = slots.given_up;
        let Some(place) = slots.done.get_mut(slot).filter(|p| p.is_none()) else { return };
        let result = if given_up_now { Err(given_up()) } else { result };
        let bytes = result.as_ref().map_or(0, |f| f.chunk.len());
        self.load.backlog_bytes.fetch_add(bytes, Ordering::Relaxed);
        *place = Some(result);
        slots.bytes += bytes;
        slots.left -= 1;
        if slots.left == 0 {
            self.load.unencoded.fetch_sub(1, Ordering::Relaxed);
            if let Some(Begun { at, effort: Effort::Least }) = slots.begun {
                let took = HostTime::now().since_ns(at);
                let before = self.load.hurried_ns.load(Ordering::Relaxed);
                self.load.hurried_ns.store(before / 4 * 3 + took / 4, Ordering::Relaxed);
            }
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
    pub(super) fn run(mut self, encode: impl FnOnce(RecordFrame, Effort) -> Result<EncodedFrame>) {
        let Some(frame) = self.frame.take() else { return };
        let result = if let Some(effort) = self.ticket.admit() {
            encode(frame, effort)
        } else {
            drop(frame);
            Err(given_up())
        };
        self.ticket.fill(self.slot, result);
    }
}

fn given_up() -> Error {
    Error::new(ErrorKind::Codec, "the set was given up")
}

impl Drop for Job {
    /// A job that was not run fails its set instead of leaving the writer waiting.
    fn drop(&mut self) {
        self.ticket.fill(self.slot, Err(Error::new(ErrorKind::Codec, "a frame was given up by its encoder")));
    }
}
