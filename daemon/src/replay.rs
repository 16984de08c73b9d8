//! Replay: datasets published on the channels that they were recorded from, as a bench for whatever reads them.
//!
//! Pixels are those of the dataset and every time in a header is the original one; such frames carry
//! [`FrameFlags::REPLAYED`](depthrig_bus::FrameFlags::REPLAYED). Sequence numbers are counted anew, because a channel's
//! numbers have no gaps and a dataset holds every sixth frame. The device's own counter (`device_sequence`) stays.
//!
//! ```text
//! timeline   which sets of which dataset when: built from the segments' indexes
//! transport  play, pause, seek, step, rate, loop: arithmetic on times
//! source     reads a moment, wherever it lies
//! player     the thread that publishes, and hands to a recorder
//! control    the same API that a rig of cameras has
//! ```
//!
//! **By the clock** a replay behaves as the cameras did: a slow subscriber misses frames. **By its subscribers**
//! ([`ReplayOptions::as_fast_as_possible`]) it never does: a channel has then no more slots than wait unread for a
//! subscriber, so there is nothing that could replace an unread frame, and the replay waits. Two such replays give a
//! subscriber the same bytes.

mod control;
mod player;
mod refine;
mod session_clock;
mod signals;
mod source;
mod timeline;
mod transport;

use crate::api::{self, ServerHandle};
use crate::config::{
    BusConfig, ControlConfig, Port, RecordingConfig, RigConfig, SetsConfig, SupervisorConfig,
};
use crate::control::Control;
use crate::housekeeping::Housekeeping;
use crate::recording::{Outside, Recording, Reports};
use crate::rig::report;
use crate::sets::SpreadStats;
use crate::stage::{Intake, Refinement, Stage};
use crate::status::{RecordingStatus, ReplayStatus};
use crate::stream::Stream;
use crate::wake::Wake;
use crate::{Error, ErrorKind, Result, priority};
use core::time::Duration;
use depthrig_bus::runtime::RigLock;
use depthrig_bus::sync::lock;
use depthrig_bus::{
    Bus, ClockDomain, HostTime, Intrinsics, MetadataLevel, PixelFormat, RigName, RuntimeDir,
    SUBSCRIBER_BUFFER, UtcPair, shm,
};
use depthrig_cdm::stage::Installed;
use depthrig_cdm::stage::{CdmConfig, EngineChoice};
use depthrig_driver::StreamProfile;
use depthrig_recorder::{Computed, MotionRecord, StreamRecord};
use player::Player;
use source::{Moment, Sources};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use timeline::Timeline;
pub use transport::RATES;
use transport::{Begin, Transport};

/// How a replay is to begin.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(clippy::struct_excessive_bools)] // each is a choice of its own
pub struct ReplayOptions {
    /// Speed against the original, within [`RATES`]; 1 is the original.
    pub rate: f64,
    /// Begin again at the end.
    pub looped: bool,
    /// Seconds after the first set at which to begin.
    pub from_s: Option<f64>,
    /// Seconds after the first set at which to end.
    pub to_s: Option<f64>,
    /// Do not wait for the clock but for the subscribers: they miss nothing. A subscriber that never reads, or that
    /// holds more than three frames of a stream, holds the replay up.
    pub as_fast_as_possible: bool,
    /// Publish nothing until it is resumed, stepped or sought: a subscriber that is to see the first set is there then.
    pub paused: bool,
    /// Pause at the end, and do not end.
    pub hold: bool,
    /// Refine the depth of its cameras with this engine, as a rig does; not with `as_fast_as_possible`.
    pub refine: Option<EngineChoice>,
    /// Several datasets that have no clock of one session are matched by UTC; without this they are refused.
    pub by_utc: bool,
    /// Give way to everything else: threads of low priority, and the least shared memory.
    pub in_background: bool,
    /// Whether to serve the control API.
    pub serve_api: bool,
    /// Where Foxglove finds it, beside the control API.
    pub foxglove: Port,
}

impl Default for ReplayOptions {
    fn default() -> Self {
        Self {
            rate: 1.0,
            looped: false,
            from_s: None,
            to_s: None,
            as_fast_as_possible: false,
            paused: false,
            hold: false,
            refine: None,
            by_utc: true,
            in_background: false,
            serve_api: false,
            foxglove: Port::Off,
        }
    }
}

/// A running replay. Dropping it stops it.
pub struct Replay {
    inner: Arc<Inner>,
    threads: Vec<JoinHandle<()>>,
    api: Option<ServerHandle>,
    _lock: RigLock,
}

/// Result of a replay.
#[derive(Debug, Clone, serde::Serialize)]
pub struct ReplaySummary {
    /// Its last status.
    #[serde(flatten)]
    pub status: ReplayStatus,
    /// The last recording of it.
    pub recording: Option<RecordingStatus>,
}

/// Lines of `lost` that are kept.
const MAX_LOST: usize = 100;

/// State that the threads of a replay share.
struct Inner {
    /// The configuration of recordings of it.
    config: RigConfig,
    paths: Vec<PathBuf>,
    options: ReplayOptions,
    timeline: Arc<Timeline>,
    sources: Mutex<Sources>,
    transport: Mutex<Transport>,
    /// With `transport`: a moment was published.
    acted: Condvar,
    wake: Wake,
    ended: Wake,
    stop: AtomicBool,
    stop_asked: AtomicBool,
    done: AtomicBool,
    records: Vec<StreamRecord>,
    units: Vec<MotionRecord>,
    /// Their channels.
    unit_streams: Vec<Arc<Stream>>,
    /// The algorithms behind the computed ones.
    computed: Vec<Computed>,
    streams: Vec<Arc<Stream>>,
    /// Where depth is refined, and whose.
    intake: Arc<Intake>,
    refinements: Mutex<Vec<Arc<Refinement>>>,
    numbers: Mutex<Numbers>,
    spreads: Mutex<SpreadStats>,
    recording: Mutex<Recording>,
    reports: Reports,
    starting: Mutex<()>,
    outside: Outside,
    /// The clocks of the dataset at the last moment: a recording of this replay takes them for its own.
    clock: Arc<Mutex<UtcPair>>,
    started: HostTime,
    cpu_millicores: AtomicU64,
}

#[derive(Debug, Default)]
struct Numbers {
    sets: u64,
    incomplete: u64,
    /// The moment that was published last, and the id of its set.
    last: Option<(usize, u64)>,
    waiting_for: Option<String>,
    lost: Vec<String>,
}

/// The numbers of a set that goes out.
struct Counted {
    set: u64,
    incomplete: u64,
}

impl Replay {
    /// Starts to replay `datasets` as the rig that they were recorded from, or as `rig`. Several are one rig: see
    /// the rules for their sets at the top of `replay/timeline.rs`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when one of them is not a dataset, when they contradict each other or the options make
    /// no sense, [`ErrorKind::NotFound`], [`ErrorKind::InUse`] when that rig is running, [`ErrorKind::NoSpace`].
    pub fn start(
        datasets: &[PathBuf],
        runtime: &RuntimeDir,
        rig: Option<RigName>,
        options: ReplayOptions,
    ) -> Result<Self> {
        transport::check_rate(options.rate)?;
        depthrig_bus::umask::check();
        if options.refine.is_some() && options.as_fast_as_possible {
            return Err(Error::new(
                ErrorKind::BadInput,
                "refined depth goes with a replay by the clock: of each camera the newest pair of images wins, and the \
                 others are skipped; leave out one of the two (depthrig cdm relabel refines every frame)",
            ));
        }
        let mut sources = Sources::open(datasets, rig, options.by_utc)?;
        let timeline = Arc::new(part(&sources.timeline()?, &options)?);
        let config = recording_config(&mut sources);
        let rig = config.rig.clone();
        let names: Vec<_> = datasets.iter().map(|p| p.display().to_string()).collect();
        let who = format!("process {} (replay of {})", std::process::id(), names.join(", "));
        let held = runtime.lock(&rig, &who)?;
        let bus = Arc::new(Bus::open(runtime, &rig)?);
        bus.clean_dead();
        let inner = Arc::new(Inner::new(config, datasets, options, timeline, sources));
        let player = Player::new(Arc::clone(&inner), Arc::clone(&bus), runtime)?;
        let refinements =
            options.refine.map(|engine| refine::refinements(&inner, &bus, engine)).transpose()?;
        let mut replay = Self { inner, threads: Vec::new(), api: None, _lock: held };
        if options.serve_api {
            let ports = ControlConfig { foxglove: options.foxglove, ..replay.inner.config.control };
            replay.api = Some(api::serve(replay.control(), runtime, &rig, ports)?);
        }
        let inner = Arc::clone(&replay.inner);
        replay.spawn("housekeeping", move || housekeeping(&inner, &bus))?;
        if let Some(refinements) = refinements {
            let inner = Arc::clone(&replay.inner);
            let cdm = inner.config.cdm.clone();
            let refiners = Arc::new(Installed::new(cdm.clone()));
            let stage = Stage::new(Arc::clone(&inner.intake), refiners, cdm, Arc::default());
            refinements.iter().cloned().for_each(|refinement| inner.intake.add(refinement));
            *lock(&inner.refinements) = refinements;
            replay.spawn("stage", move || stage.run(&inner.stop))?;
        }
        replay.spawn("replay", move || {
            if options.in_background {
                priority::lower_current_thread();
            }
            player.run();
        })?;
        Ok(replay)
    }

    fn spawn(&mut self, name: &str, run: impl FnOnce() + Send + 'static) -> Result<()> {
        let thread = std::thread::Builder::new().name(name.to_owned()).spawn(run).map_err(|e| {
            Error::new(ErrorKind::Other, format!("the {name} thread could not be started")).with_source(e)
        })?;
        self.threads.push(thread);
        Ok(())
    }

    /// Its control, as the control API has it; [`Control::replay`] is there.
    pub fn control(&self) -> Arc<dyn Control> {
        Arc::clone(&self.inner) as Arc<dyn Control>
    }

    /// How far it has come.
    pub fn progress(&self) -> ReplayStatus {
        self.inner.replay_status()
    }

    /// Waits up to `timeout` for its end, or until somebody asks for it; says whether that is so.
    pub fn wait(&self, timeout: Duration) -> bool {
        let over =
            || self.inner.done.load(Ordering::Acquire) || self.inner.stop_asked.load(Ordering::Relaxed);
        if !over() {
            self.inner.ended.wait(timeout);
        }
        over()
    }

    /// Stops it, closes its recording, and says how far it came.
    pub fn stop(mut self) -> ReplaySummary {
        self.end();
        let recording = lock(&self.inner.recording).status();
        ReplaySummary { status: self.progress(), recording }
    }

    fn end(&mut self) {
        if let Some(api) = self.api.take() {
            api.stop();
        }
        self.inner.stop.store(true, Ordering::Relaxed);
        self.inner.wake.raise();
        for thread in self.threads.drain(..) {
            if thread.join().is_err() {
                self.inner.lose("a thread of the replay panicked".into());
            }
        }
        let active = lock(&self.inner.recording).is_active();
        if active && let Err(e) = self.inner.record_stop() {
            tracing::error!(error = %e, "the recording could not be closed");
        }
        self.inner.reports.finish();
    }
}

impl Drop for Replay {
    fn drop(&mut self) {
        self.end();
    }
}

/// The part of the timeline between `--from` and `--to`.
fn part(all: &Timeline, options: &ReplayOptions) -> Result<Timeline> {
    let bad = |what: String| Err(Error::new(ErrorKind::BadInput, what));
    let usable = |s: &f64| s.is_finite() && *s >= 0.0;
    let from = options.from_s;
    let to = options.to_s;
    if !from.iter().chain(&to).all(usable) || from > to.or(Some(f64::MAX)) {
        return bad("--from and --to are seconds after the first set, from before to".into());
    }
    let ns = |s: f64| (s * 1e9).round() as i64;
    let part = all.between(from.map_or(0, ns), to.map_or(i64::MAX, ns));
    if part.len() == 0 {
        let length = all.length_ns() as f64 / 1e9;
        return bad(format!("no set is between --from and --to; the replay is {length:.3} s long"));
    }
    Ok(part)
}

/// The configuration of recordings of the replay: as the defaults, colour and depth as the datasets have it.
fn recording_config(sources: &mut Sources) -> RigConfig {
    let (color, depth) = sources.codecs();
    let recording = RecordingConfig { color, depth, ..RecordingConfig::default() };
    RigConfig {
        rig: sources.rig().clone(),
        bus: BusConfig::default(),
        sets: SetsConfig::default(),
        recording,
        control: ControlConfig::default(),
        supervisor: SupervisorConfig::default(),
        cdm: CdmConfig::default(),
        calibration: None,
        calibration_text: sources.session().calibration.clone(),
        signals: Vec::new(),
        cameras: Vec::new(),
        link: None,
        ros2: None,
        text: sources.session().rig_config.clone(),
        path: None,
    }
}

/// Slots that each stream gets when there is memory for them.
const fn slots(options: &ReplayOptions) -> usize {
    if options.as_fast_as_possible {
        SUBSCRIBER_BUFFER
    } else if options.in_background {
        // What one subscriber leaves unread, the frame it shows and the one it takes, and one to write into.
        SUBSCRIBER_BUFFER + 4
    } else {
        shm::DEFAULT_SLOTS
    }
}

impl Inner {
    fn new(
        config: RigConfig,
        datasets: &[PathBuf],
        options: ReplayOptions,
        timeline: Arc<Timeline>,
        sources: Sources,
    ) -> Self {
        let slots = slots(&options);
        let stream = |r: &StreamRecord| Arc::new(Stream::new(r.id.clone(), profile(r), true, slots));
        let unit = |r: &MotionRecord| Arc::new(Stream::new(r.id.clone(), unit_profile(r), true, slots));
        let begin = Begin {
            by_clock: !options.as_fast_as_possible,
            rate: options.rate,
            looped: options.looped,
            hold: options.hold,
            paused: options.paused,
        };
        let now = HostTime::now();
        let clock = Arc::new(Mutex::new(UtcPair::sample()));
        let theirs = Arc::clone(&clock);
        Self {
            config,
            paths: datasets.to_vec(),
            options,
            transport: Mutex::new(Transport::new(Arc::clone(&timeline), begin, now)),
            timeline,
            acted: Condvar::new(),
            wake: Wake::default(),
            ended: Wake::default(),
            stop: AtomicBool::new(false),
            stop_asked: AtomicBool::new(false),
            done: AtomicBool::new(false),
            records: sources.streams().to_vec(),
            units: sources.units().to_vec(),
            unit_streams: sources.units().iter().map(unit).collect(),
            computed: sources.computed(),
            streams: sources.streams().iter().map(stream).collect(),
            intake: Arc::default(),
            refinements: Mutex::default(),
            numbers: Mutex::new(Numbers {
                lost: sources.problems().take(MAX_LOST).cloned().collect(),
                ..Numbers::default()
            }),
            sources: Mutex::new(sources),
            spreads: Mutex::default(),
            recording: Mutex::default(),
            reports: Reports::default(),
            starting: Mutex::default(),
            outside: Outside { utc: Arc::new(move || *lock(&theirs)), ..Outside::default() },
            clock,
            started: now,
            cpu_millicores: AtomicU64::new(0),
        }
    }

    const fn lossless(&self) -> bool {
        self.options.as_fast_as_possible
    }

    /// Slots that each stream gets when there is memory for them.
    const fn slots(&self) -> usize {
        slots(&self.options)
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn set_done(&self, done: bool) {
        if self.done.swap(done, Ordering::Release) != done && done {
            self.ended.raise();
            self.acted.notify_all();
        }
    }

    fn set_waiting_for(&self, channel: Option<&str>) {
        lock(&self.numbers).waiting_for = channel.map(str::to_owned);
    }

    fn lose(&self, what: String) {
        tracing::error!("{what}");
        let lost = &mut lock(&self.numbers).lost;
        if lost.len() < MAX_LOST {
            lost.push(what);
        }
    }

    /// Counts a set that goes out.
    fn count(&self, number: usize, moment: &Moment, incomplete: bool) -> Counted {
        lock(&self.spreads).add(moment.spread_ns);
        let mut numbers = lock(&self.numbers);
        numbers.sets += 1;
        numbers.incomplete += u64::from(incomplete);
        numbers.last = Some((number, moment.id));
        Counted { set: numbers.sets, incomplete: numbers.incomplete }
    }
}

/// A stream's mode, as a driver would say it. The device's clock is behind the frames and not asked any more.
fn profile(r: &StreamRecord) -> StreamProfile {
    StreamProfile {
        stream: r.id.stream.clone(),
        format: r.format,
        width: r.width,
        height: r.height,
        rate_hz: r.rate_hz,
        depth_unit_m: r.depth_unit_m,
        intrinsics: r.intrinsics,
        pose_in_device: r.pose,
        clock: depthrig_driver::DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Device },
        sequence_bits: 64,
        metadata: MetadataLevel::Full,
    }
}

/// The same of an IMU.
fn unit_profile(r: &MotionRecord) -> StreamProfile {
    StreamProfile {
        stream: r.id.stream.clone(),
        format: PixelFormat::Motion,
        width: r.batch,
        height: 1,
        rate_hz: r.rate_hz / f64::from(r.batch.max(1)),
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device: r.pose,
        clock: depthrig_driver::DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Device },
        sequence_bits: 64,
        metadata: MetadataLevel::Full,
    }
}

/// Periodic housekeeping, on a thread of its own.
fn housekeeping(inner: &Inner, bus: &Bus) {
    let housekeeping = Housekeeping {
        recording: &inner.recording,
        reports: &inner.reports,
        bus,
        cpu_millicores: &inner.cpu_millicores,
    };
    housekeeping.run(|| inner.stopping(), || report::diagnostics(&inner.status()));
}
