//! Recording under control of the daemon: start, stop, notes, and the numbers that go with it.

use crate::config::{RecordingConfig, RigConfig, SignalConfig};
use crate::control::{EpisodeRequest, LiveRig, RecordRequest, RecordingEpisodes};
use crate::losses::{LossHistory, Losses, RecordingLosses};
use crate::status::{RecordingStatus, SetAccount, SignalStatus};
use crate::stream::Stream;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::{DropCounts, Frame, HostTime, SignalSample, StreamId, UtcPair};
use depthrig_recorder::{
    Diagnostic, Episode, EpisodeEnd, Pixels, RecordFrame, RecordSet, Recorder, RecorderOptions, Session,
    SignalRecord, StreamAccount, Summary, UtcSource, fs,
};
use place::place;
pub use recovery::recover_left;
use spread::{max_spread_ns, reach_ns};
use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

pub mod budget;
mod closing;
mod facts;
mod motion;
mod place;
mod recovery;
mod report;
mod signals;
mod spread;
mod texts;
mod waiting;

pub use closing::{Finishing, is_due, stop, stop_when_due};
pub use facts::StreamFacts;
pub use report::Reports;

/// The recordings of a rig: at most one at a time, and the outcome of the last.
#[derive(Default)]
pub struct Recording {
    active: Option<Active>,
    last: Option<RecordingStatus>,
    summary: Option<Summary>,
    /// When the last recording, or the one that goes on, lost something.
    losses: LossHistory,
    /// Episodes of the last recording, when it has ended.
    episodes: Vec<Episode>,
    /// Accounts of IMU batches, recorded or not.
    motion: motion::Books,
    /// The signals that are published.
    signals: signals::Known,
}

/// Resources of the computer that recordings use: its disk and its clocks.
#[derive(Clone)]
pub struct Outside {
    /// Where datasets are written.
    pub fs: Arc<dyn fs::Fs>,
    /// Source of UTC for a recording.
    pub utc: UtcSource,
    /// Encoded bytes that may wait for the disk, unless the recorder's own limit is to hold.
    pub backlog_max_bytes: Option<u64>,
    /// How old a set may become before it is given up; `None` where sets wait for encoders and disk.
    pub late_after_ns: Option<i64>,
}

impl Default for Outside {
    fn default() -> Self {
        Self {
            fs: Arc::new(fs::RealFs),
            utc: Arc::new(UtcPair::sample),
            backlog_max_bytes: None,
            late_after_ns: None,
        }
    }
}

/// A recording that was created and is not yet handed any set.
pub struct Begun(Active);

struct Active {
    recorder: Recorder,
    status: RecordingStatus,
    indices: HashMap<StreamId, usize>,
    streams: Vec<Recorded>,
    motion: motion::Units,
    signals: signals::Signals,
    started: HostTime,
    /// When it ends by itself.
    ends: Option<HostTime>,
    utc: UtcSource,
}

/// A stream in a recording, with the frames it had before the first recorded set.
struct Recorded {
    stream: Arc<Stream>,
    captured: u64,
    delivered: u64,
    dropped: DropCounts,
    /// Recorded sets that lack a frame of it.
    missing: u64,
}

/// A frame's pixels where the driver wrote them; encoding reads them from there.
struct SharedPixels(Frame);

impl Pixels for SharedPixels {
    fn bytes(&self) -> &[u8] {
        self.0.pixels()
    }
}

impl Begun {
    /// Creates the dataset for a recording of `streams` and `signals`, of about `sets_hz` sets a second.
    ///
    /// # Errors
    /// `WrongState` without a stream, `BadInput` for an invalid or existing folder name and for an invalid time,
    /// `NoSpace` when it does not fit, `PermissionDenied`.
    pub fn new(
        config: &RigConfig,
        request: &RecordRequest,
        streams: Vec<StreamFacts>,
        signals: Vec<SignalRecord>,
        sets_hz: f64,
        outside: &Outside,
    ) -> Result<Self> {
        budget::check_duration(request)?;
        texts::check(request)?;
        let (streams, others): (Vec<_>, Vec<_>) = streams.into_iter().partition(|s| s.stream.record);
        // Motion rides with the sets of the others.
        let (units, streams): (Vec<_>, Vec<_>) =
            streams.into_iter().partition(|s| s.stream.profile.format.is_motion());
        if streams.is_empty() {
            return Err(Error::new(
                ErrorKind::WrongState,
                "no camera has a stream to record yet; try again when one streams",
            ));
        }
        let utc = (outside.utc)();
        let hosts = config.link.as_ref().map_or(&[][..], |link| &link.hosts);
        let (name, path) = place(&config.recording, hosts, request, utc.utc_ns)?;
        let mut session = Session::new(&name, config.rig.as_str());
        session.scene.clone_from(&request.scene);
        session.operator.clone_from(&request.operator);
        session.started_utc_ns = utc.utc_ns;
        session.host = rustix::system::uname().nodename().to_string_lossy().into_owned();
        session.rig_config.clone_from(&config.text);
        session.calibration.clone_from(&config.calibration_text);
        session.max_spread_ns =
            max_spread_ns(streams.iter().map(|s| reach_ns(s, streams.iter().chain(&others), sets_hz)));
        let firmware = streams.iter().filter(|s| !s.firmware.is_empty());
        session.firmware = firmware.map(|s| (s.stream.id.camera.to_string(), s.firmware.clone())).collect();
        describe(&mut session, &streams, &units);
        // Those that have the name of a stream are refused when their first sample comes.
        let of_camera = |r: &SignalRecord| streams.iter().chain(&units).any(|s| s.stream.id == r.id);
        let signals: Vec<_> = signals.into_iter().filter(|r| !of_camera(r)).collect();
        session.signals.clone_from(&signals);
        let mut options = options_of(&config.recording);
        options.backlog_max_bytes = outside.backlog_max_bytes.unwrap_or(options.backlog_max_bytes);
        options.late_after_ns = outside.late_after_ns;
        let raw = streams.iter().map(|s| (s.stream.profile.format, s.stream.profile.frame_bytes()));
        let samples_hz: f64 = units.iter().map(|s| s.stream.profile.samples_hz()).sum();
        let rate =
            budget::bytes_per_s(raw, sets_hz, &config.recording) + budget::motion_bytes_per_s(samples_hz);
        let reserve = reserve_bytes(&config.recording);
        budget::check(&*outside.fs, &path, request, rate, reserve, &config.recording)?;
        let fs = Arc::clone(&outside.fs);
        let clock = Arc::clone(&outside.utc);
        let recorder = Recorder::create_with(fs, clock, &path, session, options).map_err(Error::from)?;
        if !request.notes.is_empty() {
            recorder.add_note(request.notes.as_str()).map_err(Error::from)?;
        }
        tracing::info!(path = %path.display(), streams = streams.len(), imus = units.len(), "recording");
        let status = RecordingStatus {
            active: true,
            path: path.display().to_string(),
            name,
            scene: request.scene.clone(),
            operator: request.operator.clone(),
            started_utc_ns: utc.utc_ns,
            ..RecordingStatus::default()
        };
        let recorded = |s: &StreamFacts| {
            let books = s.stream.books();
            Recorded {
                stream: Arc::clone(&s.stream),
                captured: books.delivered + books.dropped.total(),
                delivered: books.delivered,
                dropped: books.dropped,
                missing: 0,
            }
        };
        let started = HostTime::now();
        Ok(Self(Active {
            recorder,
            indices: streams.iter().enumerate().map(|(i, s)| (s.stream.id.clone(), i)).collect(),
            streams: streams.iter().map(recorded).collect(),
            motion: motion::Units::new(&units, sets_hz),
            signals: signals::Signals::new(signals),
            started,
            ends: request.max_duration_s.map(|s| started.plus(Duration::from_secs_f64(s))),
            utc: Arc::clone(&outside.utc),
            status,
        }))
    }
}

/// Lists streams and IMUs.
fn describe(session: &mut Session, streams: &[StreamFacts], units: &[StreamFacts]) {
    session.computed = streams.iter().filter_map(|s| s.computed.clone()).collect();
    session.streams = streams.iter().map(facts::record_of).collect();
    session.motion = units.iter().map(motion::record_of).collect();
}

/// The streams of a rig for viewers of its live channels, with its clocks.
pub fn live_rig(config: &RigConfig, streams: Vec<StreamFacts>, utc: UtcPair) -> LiveRig {
    let (units, streams): (Vec<_>, Vec<_>) =
        streams.into_iter().partition(|s| s.stream.profile.format.is_motion());
    let mut session = Session::new("live", config.rig.as_str());
    describe(&mut session, &streams, &units);
    LiveRig { session, options: options_of(&config.recording), utc }
}

impl Recording {
    /// Refuses when a recording is going on.
    ///
    /// # Errors
    /// `InUse` naming the recording.
    pub fn must_be_idle(&self) -> Result<()> {
        let Some(active) = &self.active else { return Ok(()) };
        let path = &active.status.path;
        Err(Error::new(
            ErrorKind::InUse,
            format!("a recording is going on already ({path}); stop it first (depthrig record stop)"),
        ))
    }

    /// From now on sets go to `begun`.
    pub fn begin(&mut self, begun: Begun) -> RecordingStatus {
        let active = self.active.insert(begun.0);
        active.motion.begin();
        self.signals.begin(&mut active.signals, &active.recorder);
        active.refresh();
        self.summary = None;
        self.losses = LossHistory::default();
        self.last.insert(active.status.clone()).clone()
    }

    /// Takes in a batch of the IMU `id`, before which `missed` batches were replaced on the channel. While a
    /// recording runs it waits for the next set.
    pub fn hear_motion(&mut self, id: &StreamId, frame: &Frame, missed: u64) {
        self.motion.hear(self.active.as_mut().map(|a| &mut a.motion), id, frame, missed);
    }

    /// Accounts of the batches of each IMU that was heard: `used` went with sets, `overflow` waited too long,
    /// `decimated` came while nothing was recorded or after a recording's last set.
    pub fn motion_accounts(&self) -> Vec<(StreamId, SetAccount)> {
        self.motion.accounts().map(|(id, account)| (id.clone(), account)).collect()
    }

    /// Takes in samples of the signal `id`, before which `missed` were replaced on the channel. While a recording runs
    /// they wait for the next set.
    pub fn hear_signal(&mut self, id: &StreamId, samples: Vec<SignalSample>, missed: u64) {
        let recording = self.active.as_mut().map(|a| (&mut a.signals, &a.recorder));
        self.signals.hear(recording, id, samples, missed);
    }

    /// Forgets the signals that nobody publishes any more: a recording that begins does not list them.
    pub fn keep_signals(&mut self, is_published: impl Fn(&StreamId) -> bool) {
        self.signals.keep(is_published);
    }

    /// The signals at `now`: those that `named` lists in its order, then others.
    pub fn signal_states(&self, named: &[SignalConfig], now: HostTime) -> Vec<SignalStatus> {
        self.signals.states(named, now)
    }

    /// The signals that are published, for a recording that begins.
    pub fn signals(&self) -> Vec<SignalRecord> {
        self.signals.records()
    }

    /// Hands a set to the recorder, with motion and signals since the set before, if a recording is running. Never blocks.
    pub fn offer(
        &mut self,
        id: u64,
        tick: HostTime,
        frames: impl Iterator<Item = (Arc<Stream>, Option<Frame>)>,
    ) {
        let Some(active) = &mut self.active else { return };
        let mut present = Vec::new();
        let mut missing = Vec::new();
        for (stream, frame) in frames {
            let Some(&index) = active.indices.get(&stream.id) else { continue };
            match frame {
                Some(frame) => present.push(RecordFrame {
                    stream: index,
                    header: *frame.header(),
                    pixels: Box::new(SharedPixels(frame)),
                }),
                None => missing.push(index),
            }
        }
        // Of recorded streams: the set may have others.
        let times = present.iter().map(|f| f.header.capture_time_ns);
        let spread_ns = times.clone().max().unwrap_or(0) - times.min().unwrap_or(0);
        let utc = (active.utc)();
        let motion = self.motion.take(&mut active.motion);
        let signals = active.signals.take();
        self.push(RecordSet { id, tick, utc, frames: present, missing, motion, signals, spread_ns });
    }

    /// Hands a set to the recorder, if one is running; its streams and IMUs are those that the recording was begun
    /// with, in their order. Never blocks.
    pub fn push(&mut self, set: RecordSet) {
        let Some(active) = &mut self.active else { return };
        active.motion.hand_over(&set.motion);
        active.signals.hand_over(&set.signals);
        let missing = set.missing.clone();
        // A set that is refused is counted and logged by the recorder.
        if active.recorder.push(set).is_ok() {
            for stream in missing {
                if let Some(recorded) = active.streams.get_mut(stream) {
                    recorded.missing += 1;
                }
            }
        }
    }

    /// Whether the next set would find room, or needs none.
    pub fn has_room(&self) -> bool {
        self.active.as_ref().is_none_or(|active| active.recorder.has_room())
    }

    /// Adds a note to the recording.
    ///
    /// # Errors
    /// `WrongState` when none is going on, `BadInput` for an empty note.
    pub fn note(&mut self, text: &str) -> Result<()> {
        let active = self.active.as_ref().ok_or_else(none_active)?;
        if text.trim().is_empty() {
            return Err(Error::new(ErrorKind::BadInput, "the note is empty"));
        }
        active.recorder.add_note(text).map_err(Error::from)
    }

    /// Begins, ends or judges an episode.
    ///
    /// # Errors
    /// `WrongState` when no recording is going on, and when an episode is begun twice or ended without one, `NotFound` for an unknown
    /// one, `BadInput` for a task that is too long.
    pub fn episode(&mut self, request: &EpisodeRequest) -> Result<Episode> {
        let recorder = &self.active.as_ref().ok_or_else(none_active)?.recorder;
        let is_running = recorder.progress().episodes.last.is_some_and(|e| e.is_open());
        let done = match request {
            EpisodeRequest::Start { task } => recorder.start_episode(task.trim()),
            EpisodeRequest::Stop { .. } if !is_running => {
                return Err(Error::new(
                    ErrorKind::WrongState,
                    "no episode is running; start one with: depthrig episode start",
                ));
            }
            EpisodeRequest::Stop { outcome } => recorder.end_episode(EpisodeEnd::Kept(*outcome)),
            EpisodeRequest::Discard { number } => recorder.judge_episode(*number, EpisodeEnd::Discarded),
            EpisodeRequest::Mark { outcome, number } => {
                recorder.judge_episode(*number, EpisodeEnd::Kept(*outcome))
            }
        };
        self.refresh();
        done.map_err(Error::from)
    }

    /// Takes the recorder out, to be finished without keeping others waiting.
    ///
    /// # Errors
    /// `WrongState` when no recording is going on.
    pub fn take(&mut self) -> Result<Finishing> {
        if let Some(active) = &self.active {
            // None is running, mostly. The status has it as it will be in the dataset.
            let _ = active.recorder.end_episode(EpisodeEnd::Kept(None));
        }
        self.refresh();
        let mut active = self.active.take().ok_or_else(none_active)?;
        self.episodes = active.recorder.episodes();
        self.motion.end(&mut active.motion);
        active.hand_over_accounts();
        if let Some(last) = &mut self.last {
            last.closing = true;
        }
        Ok(Finishing { active })
    }

    /// Whether a recording is going on.
    pub const fn is_active(&self) -> bool {
        self.active.is_some()
    }

    /// The folder that is being recorded into.
    pub fn active_path(&self) -> Option<PathBuf> {
        self.active.as_ref().map(|active| PathBuf::from(&active.status.path))
    }

    /// Whether a recording is going on that has lasted as long as it was to.
    fn is_due(&self) -> bool {
        self.active.as_ref().and_then(|a| a.ends).is_some_and(|ends| ends.from_now().is_zero())
    }

    /// Keeps the numbers of a finished recording.
    pub fn keep(&mut self, status: RecordingStatus, summary: Option<Summary>) {
        // Sets that were lost while it was closed are lost at its end.
        let end_s = self.last.as_ref().map_or(0.0, |last| last.duration_s);
        self.losses.note(ns(end_s), &losses_of(&status));
        self.last = Some(status);
        self.summary = summary;
    }

    /// The recording in progress, or the last one.
    pub fn status(&mut self) -> Option<RecordingStatus> {
        self.refresh();
        self.last.clone()
    }

    /// When the recording in progress, or the last one, lost something.
    pub fn losses(&mut self) -> Option<RecordingLosses> {
        self.refresh();
        let last = self.last.as_ref()?;
        let (bucket_s, buckets) = self.losses.buckets();
        Some(RecordingLosses { path: last.path.clone(), duration_s: last.duration_s, bucket_s, buckets })
    }

    /// Episodes of the recording in progress, or of the last one.
    pub fn episodes(&self) -> Option<RecordingEpisodes> {
        let path = self.last.as_ref()?.path.clone();
        let episodes = match &self.active {
            Some(active) => active.recorder.episodes(),
            None => self.episodes.clone(),
        };
        Some(RecordingEpisodes { path, episodes })
    }

    /// Summary of the last finished recording.
    pub fn summary(&self) -> Option<&Summary> {
        self.summary.as_ref()
    }

    /// Once a second: accounts and diagnostics into the file.
    pub fn housekeeping(&mut self, diagnostics: Vec<Diagnostic>) {
        self.refresh();
        if let Some(active) = &self.active {
            active.hand_over_accounts();
            active.recorder.diagnostics(diagnostics);
        }
    }

    fn refresh(&mut self) {
        let Some(active) = &mut self.active else { return };
        active.refresh();
        self.losses.note(ns(active.status.duration_s), &losses_of(&active.status));
        self.last = Some(active.status.clone());
    }
}

/// A length in nanoseconds.
fn ns(seconds: f64) -> u64 {
    (seconds.max(0.0) * 1e9) as u64
}

/// Everything that the recording lost so far.
fn losses_of(status: &RecordingStatus) -> Losses {
    Losses {
        sets: status.dropped.clone(),
        missing: status.missing.clone(),
        frames: status.frames_dropped.clone(),
    }
}

impl Active {
    fn refresh(&mut self) {
        let progress = self.recorder.progress();
        let mut dropped = DropCounts::default();
        for account in self.accounts() {
            dropped.0.iter_mut().zip(account.dropped.0).for_each(|(sum, n)| *sum += n);
        }
        let status = &mut self.status;
        status.duration_s = self.started.elapsed().as_secs_f64();
        status.sets = progress.sets.recorded;
        status.dropped = progress.sets.dropped_by_reason().map(|(r, n)| (r.name().to_owned(), n)).collect();
        let missing = self.streams.iter().filter(|r| r.missing > 0);
        status.missing = missing.map(|r| (r.stream.id.to_string(), r.missing)).collect();
        status.frames_dropped = dropped.nonzero().map(|(r, n)| (r.name().to_owned(), n)).collect();
        status.episodes = progress.episodes.kept;
        status.episodes_discarded = progress.episodes.discarded;
        status.episode = progress.episodes.last;
        status.frames = progress.frames;
        status.bytes = progress.bytes;
        status.encode_queue = progress.encode_queue as u64;
        status.backlog_bytes = progress.backlog_bytes;
        status.segments = u64::from(progress.segments);
        status.error = progress.error.map(|e| e.to_string());
        // As the disk guard knows it: asking here could wait for a disk that stalls.
        status.disk_free_bytes = progress.disk.free_bytes;
        status.disk_seconds_left = progress.disk.seconds_left;
        status.warning = progress.disk.warning;
    }

    /// Hands over the cameras' accounts.
    fn hand_over_accounts(&self) {
        self.recorder.update_accounts(self.accounts().collect());
    }

    /// The cameras' accounts since the recording began.
    fn accounts(&self) -> impl Iterator<Item = StreamAccount> + '_ {
        let account = |r: &Recorded| {
            let books = r.stream.books();
            // A frame that is being written this moment is not accounted for before its fate is known.
            let captured = books.delivered + books.dropped.total();
            let mut dropped = books.dropped;
            for (now, before) in dropped.0.iter_mut().zip(r.dropped.0) {
                *now -= before;
            }
            StreamAccount {
                stream: r.stream.id.clone(),
                captured: captured - r.captured,
                delivered: books.delivered - r.delivered,
                dropped,
            }
        };
        self.streams.iter().map(account).chain(self.motion.accounts()).chain(self.signals.accounts())
    }
}

fn none_active() -> Error {
    Error::new(ErrorKind::WrongState, "no recording is going on; start one with: depthrig record start")
}

/// Bytes of its disk that a recording never uses.
pub fn reserve_bytes(config: &RecordingConfig) -> u64 {
    let options = options_of(config);
    options.min_free_bytes.saturating_add(options.reserve_bytes)
}

fn options_of(config: &RecordingConfig) -> RecorderOptions {
    let mut options = RecorderOptions {
        jpeg_quality: config.jpeg_quality,
        color: config.color,
        depth: config.depth,
        segment_max_bytes: config.segment_max_mb << 20,
        segment_max_ns: config.segment_max_s as i64 * 1_000_000_000,
        queue_sets: config.queue_sets,
        min_free_bytes: config.reserve_mb << 20,
        ..RecorderOptions::default()
    };
    if config.workers > 0 {
        options.workers = config.workers;
    }
    options
}
