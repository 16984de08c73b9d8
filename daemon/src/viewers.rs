//! Images for those who look at the rig: each is encoded once, for all who wait for it, and only if somebody does.
//!
//! A viewer says which streams it watches and how often, and has credits; an image takes one, and the viewer gives it back when it has drawn the image. Of each
//! stream only the newest frame is sent, so a viewer that is slow sees fewer images and never old ones. One thread encodes, below the priority of
//! everything that captures; it exists while somebody watches.

mod geometry;
mod newest;
mod pixel;
mod signals;
mod thread;
mod worker;

use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, RigName, RuntimeDir, StreamId};
use depthrig_recorder::preview::{Measure, PreviewKind};
pub(crate) use geometry::Geometry;
use hyper::body::Bytes;
pub(crate) use newest::{Newest, next_turn};
pub(crate) use pixel::{PixelAnswer, PixelQuestion};
use serde::Serialize;
pub(crate) use signals::{News, Shown as ShownSignal, SignalFeed, SignalPlace};
use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex};
pub(crate) use thread::work_until_done;
use tokio::sync::mpsc;

/// Viewers at once.
pub const MAX_VIEWERS: usize = 8;
/// Streams that a viewer may watch.
pub(crate) const MAX_WATCHED: usize = 64;
/// Images that a viewer may be sent before it has drawn one of them.
pub(crate) const CREDITS: u32 = 4;
/// Images a second of a stream that a viewer may ask for.
const MAX_RATE_HZ: f64 = 60.0;
/// Questions about pixels that may wait; a pointer that moves asks again.
const MAX_QUESTIONS: usize = 4;
/// Messages to a viewer that may wait: its images, each with its geometry and its numbers, and the answers to its questions.
const MAX_MESSAGES: usize = 3 * CREDITS as usize + 2 * MAX_QUESTIONS;

/// A stream that a viewer watches.
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Watch {
    /// Its name, `camera/stream`.
    pub stream: String,
    /// Columns of its images at the most; 0: as many as it has.
    pub width: u32,
    /// Images a second at the most.
    pub rate_hz: f64,
    /// Whether numbers of the full image come with it.
    #[serde(default)]
    pub measure: bool,
}

/// An answer for a viewer.
#[derive(Debug, Clone)]
pub(crate) enum Message {
    /// An image with its head.
    Image(Bytes),
    /// Where the pixels of a stream are.
    Geometry(Box<OfStream<Geometry>>),
    /// Numbers of an image.
    Measure(Box<OfStream<Measured>>),
    /// The depth and the place of a pixel.
    Pixel(PixelAnswer),
    /// Why a stream is not shown.
    Problem(String),
}

/// Something of a stream.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct OfStream<T> {
    /// Its name, `camera/stream`.
    pub stream: StreamId,
    #[serde(flatten)]
    pub what: T,
}

/// Numbers of a frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(crate) struct Measured {
    /// Of the frame.
    pub sequence: u64,
    #[serde(flatten)]
    pub numbers: Measure,
}

/// Viewers of one rig.
#[derive(Debug, Clone)]
pub(crate) struct Viewers {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    runtime: RuntimeDir,
    rig: RigName,
    state: Mutex<State>,
    /// Something in the state changed.
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    next: u64,
    viewers: BTreeMap<u64, Viewer>,
    /// Whether the thread runs.
    is_running: bool,
}

#[derive(Debug)]
struct Viewer {
    watched: Vec<Watched>,
    /// Number of the message that asked for them.
    generation: u32,
    credits: u32,
    questions: Vec<PixelQuestion>,
    to: mpsc::Sender<Message>,
    /// Messages that found no room, since their number was last reported to it.
    lost: u64,
}

impl Viewer {
    /// Sends a message if there is room, and before it the number of those that found none. Returns whether it was sent.
    fn put(&mut self, message: Message) -> bool {
        if self.lost > 0 {
            let text = format!("{} messages were lost: they come faster than this page reads", self.lost);
            if self.to.try_send(Message::Problem(text)).is_ok() {
                self.lost = 0;
            }
        }
        let is_sent = self.to.try_send(message).is_ok();
        self.lost += u64::from(!is_sent);
        is_sent
    }
}

#[derive(Debug)]
struct Watched {
    id: StreamId,
    width: u32,
    period: Duration,
    /// When the next image may be sent.
    due: HostTime,
    /// Frame that was sent last.
    sent: Option<u64>,
    /// The geometry that was sent last.
    geometry: Option<Geometry>,
    /// Whether numbers of the full image are wanted.
    measure: bool,
    /// Frame whose numbers were sent last.
    measured: Option<u64>,
}

/// A place among the viewers; dropping it frees the place.
#[derive(Debug)]
pub(crate) struct Place {
    viewers: Viewers,
    number: u64,
}

impl Viewers {
    pub(crate) fn new(runtime: RuntimeDir, rig: RigName) -> Self {
        let state = Mutex::default();
        Self { shared: Arc::new(Shared { runtime, rig, state, changed: Condvar::new() }) }
    }

    /// The rig that they look at.
    pub(crate) fn rig(&self) -> &RigName {
        &self.shared.rig
    }

    /// A place, and what is sent to it; `None` if all are taken.
    pub(crate) fn enter(&self) -> Option<(Place, mpsc::Receiver<Message>)> {
        let mut state = lock(&self.shared.state);
        if state.viewers.len() >= MAX_VIEWERS {
            return None;
        }
        let (to, messages) = mpsc::channel(MAX_MESSAGES);
        let number = state.next;
        state.next += 1;
        let viewer = Viewer {
            watched: Vec::new(),
            generation: 0,
            credits: CREDITS,
            questions: Vec::new(),
            to,
            lost: 0,
        };
        state.viewers.insert(number, viewer);
        Some((Place { viewers: self.clone(), number }, messages))
    }
}

impl Place {
    /// Watches these streams and no others.
    ///
    /// # Errors
    /// `BadInput` for too many, for an invalid name, and for a rate out of range; the streams stay as they were.
    pub(crate) fn watch(&self, wanted: &[Watch]) -> Result<()> {
        let bad = |what: String| Err(Error::new(ErrorKind::BadInput, what));
        if wanted.len() > MAX_WATCHED {
            return bad(format!("{} streams are out of range 0..={MAX_WATCHED}", wanted.len()));
        }
        let now = HostTime::now();
        let mut watched = Vec::with_capacity(wanted.len());
        for Watch { stream, width, rate_hz, measure } in wanted {
            let Ok(id) = stream.parse::<StreamId>() else {
                return bad(format!("invalid stream name \"{stream}\"; write camera/stream"));
            };
            if !(*rate_hz > 0.0 && *rate_hz <= MAX_RATE_HZ) {
                return bad(format!("rate_hz = {rate_hz} is out of range 0..={MAX_RATE_HZ}"));
            }
            let period = Duration::from_secs_f64(1.0 / rate_hz);
            watched.push(Watched {
                id,
                width: *width,
                period,
                due: now,
                sent: None,
                geometry: None,
                measure: *measure,
                measured: None,
            });
        }
        self.change(|viewer| {
            viewer.watched = watched;
            viewer.generation += 1;
        });
        self.start()
    }

    /// Gives credits back.
    pub(crate) fn credit(&self, images: u32) {
        self.change(|viewer| viewer.credits = viewer.credits.saturating_add(images).min(CREDITS));
    }

    /// Asks about a pixel; of many questions the newest are answered.
    pub(crate) fn ask(&self, question: PixelQuestion) {
        self.change(|viewer| {
            if viewer.questions.len() == MAX_QUESTIONS {
                viewer.questions.remove(0);
            }
            viewer.questions.push(question);
        });
    }

    fn change(&self, what: impl FnOnce(&mut Viewer)) {
        let shared = &self.viewers.shared;
        if let Some(viewer) = lock(&shared.state).viewers.get_mut(&self.number) {
            what(viewer);
        }
        shared.changed.notify_all();
    }

    /// Starts the thread if it does not run.
    fn start(&self) -> Result<()> {
        let shared = &self.viewers.shared;
        let mut state = lock(&shared.state);
        if state.is_running || state.viewers.values().all(|v| v.watched.is_empty()) {
            return Ok(());
        }
        let of_thread = Arc::clone(shared);
        let run = move || worker::run(&of_thread);
        std::thread::Builder::new().name("viewers".into()).spawn(run).map_err(|e| {
            Error::new(ErrorKind::Other, "the thread for viewers cannot be started").with_source(e)
        })?;
        state.is_running = true;
        Ok(())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let shared = &self.viewers.shared;
        lock(&shared.state).viewers.remove(&self.number);
        shared.changed.notify_all();
    }
}

/// Bytes before an image.
pub(crate) const HEAD_BYTES: usize = 48;
/// The version of messages in both directions.
pub(crate) const PROTOCOL: u16 = 1;

/// The head of an image; docs/live-page.md has the table.
#[derive(Debug, Clone, Copy)]
struct Head {
    kind: PreviewKind,
    index: u16,
    step: u16,
    width: u16,
    height: u16,
    full_width: u16,
    full_height: u16,
    sequence: u64,
    capture_time_ns: i64,
    age_ns: i64,
    depth_unit_m: f32,
    generation: u32,
}

impl Head {
    /// Head and image in one message.
    fn message(&self, image: &[u8]) -> Bytes {
        let kind = match self.kind {
            PreviewKind::Jpeg => 1,
            PreviewKind::Depth => 2,
        };
        let mut out = Vec::with_capacity(HEAD_BYTES + image.len());
        out.extend(PROTOCOL.to_le_bytes());
        out.extend([kind, 0]);
        for value in [self.index, self.step, self.width, self.height, self.full_width, self.full_height] {
            out.extend(value.to_le_bytes());
        }
        out.extend(self.sequence.to_le_bytes());
        out.extend(self.capture_time_ns.to_le_bytes());
        out.extend(self.age_ns.to_le_bytes());
        out.extend(self.depth_unit_m.to_le_bytes());
        out.extend(self.generation.to_le_bytes());
        out.extend_from_slice(image);
        out.into()
    }
}
