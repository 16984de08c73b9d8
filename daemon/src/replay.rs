//! Replay: a dataset published on the channels that it was recorded from.
//!
//! Pixels are those of the dataset and every time in a header is the original one; such frames carry
//! [`FrameFlags::REPLAYED`]. Sequence numbers are counted anew, because a channel's numbers have no gaps and a
//! dataset holds every sixth frame. What the device counted (`device_sequence`) stays.

use crate::wake::Wake;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::runtime::RigLock;
use depthrig_bus::{
    Bus, FrameFlags, FrameHeader, HostTime, MemberRecord, Publisher, RigName, RuntimeDir, SetHeader,
    SetPublisher, StreamId, shm,
};
use depthrig_recorder::{Dataset, DatasetFrame, DatasetSet, SetRange};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

/// How a dataset is to be replayed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReplayOptions {
    /// Speed against the original, 1 is the original; must be above 0.
    pub rate: f64,
    /// Begin again at the end.
    pub looped: bool,
    /// Seconds after the first set at which to begin.
    pub from_s: Option<f64>,
    /// Seconds after the first set at which to end.
    pub to_s: Option<f64>,
    /// Do not wait between sets. A subscriber that is slower than the disk misses frames then.
    pub as_fast_as_possible: bool,
}

impl Default for ReplayOptions {
    fn default() -> Self {
        Self { rate: 1.0, looped: false, from_s: None, to_s: None, as_fast_as_possible: false }
    }
}

/// How far a replay has come.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct ReplayProgress {
    /// Sets published.
    pub sets: u64,
    /// Frames published.
    pub frames: u64,
    /// Seconds of the dataset that have been replayed, in the present round.
    pub position_s: f64,
    /// Length of what is replayed, seconds.
    pub length_s: f64,
    /// Rounds begun.
    pub rounds: u64,
    /// What could not be read or published, one line each (100 at most).
    pub lost: Vec<String>,
    /// Whether it is over.
    pub done: bool,
}

/// A running replay. Dropping it stops it.
pub struct Replay {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    _lock: RigLock,
}

#[derive(Default)]
struct Shared {
    stop: AtomicBool,
    done: AtomicBool,
    wake: Wake,
    sets: AtomicU64,
    frames: AtomicU64,
    rounds: AtomicU64,
    position_ns: AtomicU64,
    length_ns: AtomicU64,
    lost: Mutex<Vec<String>>,
}

/// Lines of `lost` that are kept.
const MAX_LOST: usize = 100;

impl Shared {
    fn lose(&self, what: String) {
        tracing::error!("{what}");
        let mut lost = self.lost.lock().unwrap_or_else(PoisonError::into_inner);
        if lost.len() < MAX_LOST {
            lost.push(what);
        }
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

impl Replay {
    /// Starts to replay the dataset `path` as the rig it was recorded from, or as `rig`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when `path` is no dataset or the options make no sense,
    /// [`ErrorKind::NotFound`], [`ErrorKind::InUse`] when that rig is running, [`ErrorKind::NoSpace`].
    pub fn start(
        path: &Path,
        runtime: &RuntimeDir,
        rig: Option<RigName>,
        options: ReplayOptions,
    ) -> Result<Self> {
        if !(options.rate.is_finite() && options.rate > 0.0) {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("a replay cannot run at {} x; use a rate above 0", options.rate),
            ));
        }
        let dataset = Dataset::open(path).map_err(of_dataset)?;
        let rig = match rig {
            Some(rig) => rig,
            None => RigName::new(dataset.session().rig.as_str())?,
        };
        let range = range(&dataset, &options)?;
        let lock =
            runtime.lock(&rig, &format!("process {} (replay of {})", std::process::id(), path.display()))?;
        let bus = Bus::open(runtime, &rig)?;
        bus.clean_dead();
        let player = Player::open(bus, dataset, range, options)?;
        let shared = Arc::clone(&player.shared);
        let thread =
            std::thread::Builder::new().name("replay".into()).spawn(move || player.run()).map_err(|e| {
                Error::new(ErrorKind::Other, "the replay thread could not be started").with_source(e)
            })?;
        Ok(Self { shared, thread: Some(thread), _lock: lock })
    }

    /// How far it has come.
    pub fn progress(&self) -> ReplayProgress {
        let s = &self.shared;
        ReplayProgress {
            sets: s.sets.load(Ordering::Relaxed),
            frames: s.frames.load(Ordering::Relaxed),
            position_s: s.position_ns.load(Ordering::Relaxed) as f64 / 1e9,
            length_s: s.length_ns.load(Ordering::Relaxed) as f64 / 1e9,
            rounds: s.rounds.load(Ordering::Relaxed),
            lost: s.lost.lock().unwrap_or_else(PoisonError::into_inner).clone(),
            done: s.done.load(Ordering::Acquire),
        }
    }

    /// Stops it and says how far it came.
    pub fn stop(mut self) -> ReplayProgress {
        self.end();
        self.progress()
    }

    fn end(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.wake.raise();
        if self.thread.take().is_some_and(|t| t.join().is_err()) {
            self.shared.lose("the replay thread panicked".into());
        }
    }
}

impl Drop for Replay {
    fn drop(&mut self) {
        self.end();
    }
}

/// What is left of a dataset after `--from` and `--to`.
fn range(dataset: &Dataset, options: &ReplayOptions) -> Result<SetRange> {
    let mut range = SetRange::ALL;
    let Some(first) = dataset.sets_with(range, depthrig_recorder::PixelMode::None).next() else {
        let shown = dataset.path().display();
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("{shown} holds no frame set, there is nothing to replay"),
        ));
    };
    let first = first.map_err(of_dataset)?;
    let at = |s: f64| first.utc_ns.saturating_add((s * 1e9).round() as i64);
    let usable = |s: &f64| s.is_finite() && *s >= 0.0;
    if options.from_s.iter().chain(&options.to_s).any(|s| !usable(s))
        || options.from_s > options.to_s.or(Some(f64::MAX))
    {
        return Err(Error::new(
            ErrorKind::BadInput,
            "--from and --to are seconds after the first set, from before to",
        ));
    }
    range.from_utc_ns = options.from_s.map_or(i64::MIN, at);
    range.to_utc_ns = options.to_s.map_or(i64::MAX, at);
    Ok(range)
}

/// The replay thread's state.
struct Player {
    bus: Bus,
    dataset: Dataset,
    range: SetRange,
    options: ReplayOptions,
    outputs: Vec<Output>,
    sets: SetPublisher,
    shared: Arc<Shared>,
    next_set: u64,
}

struct Output {
    id: StreamId,
    publisher: Publisher,
    sequence: u64,
}

impl Player {
    fn open(bus: Bus, dataset: Dataset, range: SetRange, options: ReplayOptions) -> Result<Self> {
        let streams = &dataset.session().streams;
        let bytes = |r: &depthrig_recorder::StreamRecord| r.format.frame_bytes(r.width, r.height);
        let set_bytes = streams.iter().map(|r| bytes(r) as u64).sum();
        let slots =
            shm::slots_that_fit(shm::DEFAULT_SLOTS, set_bytes, shm::free_bytes(shm::SHM_DIR.as_ref())?)?;
        let mut outputs = Vec::new();
        for record in streams {
            let publisher = bus.publisher(&record.id, bytes(record), slots)?;
            outputs.push(Output { id: record.id.clone(), publisher, sequence: 0 });
        }
        let sets = bus.set_publisher()?;
        Ok(Self { bus, dataset, range, options, outputs, sets, shared: Arc::default(), next_set: 1 })
    }

    fn run(mut self) {
        let length = self.length_ns();
        self.shared.length_ns.store(length, Ordering::Relaxed);
        loop {
            self.shared.rounds.fetch_add(1, Ordering::Relaxed);
            let before = self.shared.sets.load(Ordering::Relaxed);
            self.round();
            let empty = self.shared.sets.load(Ordering::Relaxed) == before;
            if !self.options.looped || empty || self.shared.stopping() {
                break;
            }
        }
        self.shared.done.store(true, Ordering::Release);
        // The channels stay until the replay is dropped, so that subscribers can read the last frames.
        while !self.shared.stopping() {
            self.shared.wake.wait(Duration::from_secs(1));
            self.bus.clean_dead();
        }
    }

    /// Time from the first set to the last.
    fn length_ns(&self) -> u64 {
        let mut ticks = self
            .dataset
            .sets_with(self.range, depthrig_recorder::PixelMode::None)
            .filter_map(|s| s.ok().map(|s| s.tick));
        let first = ticks.next();
        let last = ticks.last().or(first);
        first.zip(last).map_or(0, |(a, b)| b.since_ns(a).max(0) as u64)
    }

    /// Replays the range once.
    fn round(&mut self) {
        let began = HostTime::now();
        let mut first_tick = None;
        let sets = self.dataset.sets(self.range);
        for set in sets {
            let set = match set {
                Ok(set) => set,
                Err(e) => {
                    self.shared.lose(e.to_string());
                    continue;
                }
            };
            let first = *first_tick.get_or_insert(set.tick);
            let position_ns = set.tick.since_ns(first).max(0);
            if !self.options.as_fast_as_possible {
                self.sleep_until(began.plus_ns((position_ns as f64 / self.options.rate) as i64));
            }
            if self.shared.stopping() {
                return;
            }
            self.publish(set);
            self.shared.position_ns.store(position_ns as u64, Ordering::Relaxed);
        }
    }

    fn sleep_until(&self, due: HostTime) {
        while !self.shared.stopping() {
            let left = due.from_now();
            if left.is_zero() {
                return;
            }
            self.shared.wake.wait(left);
        }
    }

    fn publish(&mut self, mut set: DatasetSet) {
        let mut members: Vec<_> = self
            .outputs
            .iter()
            .map(|o| MemberRecord { id: o.id.clone(), sequence: None, capture_time_ns: set.tick.ns() })
            .collect();
        // In the order in which they were published, as a subscriber of several streams saw them.
        set.frames.sort_by_key(|f| f.header.publish_time_ns);
        for frame in &set.frames {
            match self.publish_frame(frame) {
                Ok(sequence) => {
                    if let Some(member) = members.get_mut(frame.stream) {
                        member.sequence = Some(sequence);
                        member.capture_time_ns = frame.header.capture_time_ns;
                    }
                }
                Err(e) => self.shared.lose(format!("set {}: {e}", set.id)),
            }
        }
        let header = SetHeader {
            set_id: self.next_set,
            tick_ns: set.tick.ns(),
            spread_ns: set.spread_ns,
            ..SetHeader::default()
        };
        self.next_set += 1;
        if let Err(e) = self.sets.send(header, &members) {
            self.shared.lose(format!("set {}: {e}", set.id));
        }
        self.shared.sets.fetch_add(1, Ordering::Relaxed);
    }

    fn publish_frame(&mut self, frame: &DatasetFrame) -> Result<u64> {
        let output = self.outputs.get_mut(frame.stream).ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                format!("a frame names stream {}, which the session has not", frame.stream),
            )
        })?;
        let mut slot = output.publisher.loan(frame.pixels.len())?;
        slot.pixels_mut().copy_from_slice(&frame.pixels);
        output.sequence += 1;
        *slot.header_mut() = FrameHeader {
            sequence: output.sequence,
            captured: output.sequence + frame.header.drops().total(),
            flags: frame.header.flags | FrameFlags::REPLAYED.0,
            payload_len: frame.pixels.len() as u32,
            ..frame.header
        };
        output.publisher.send_unstamped(slot)?;
        self.shared.frames.fetch_add(1, Ordering::Relaxed);
        Ok(output.sequence)
    }
}

fn of_dataset(e: depthrig_recorder::Error) -> Error {
    use depthrig_recorder::ErrorKind as Rec;
    let kind = match e.kind() {
        Rec::NotFound => ErrorKind::NotFound,
        Rec::PermissionDenied => ErrorKind::PermissionDenied,
        Rec::NotADataset | Rec::Foreign | Rec::Version => ErrorKind::BadInput,
        _ => ErrorKind::Other,
    };
    Error::new(kind, e.to_string()).with_source(e)
}
