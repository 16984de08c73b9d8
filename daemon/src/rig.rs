//! A running rig: its cameras, its sets, its recording and its control, in one process.
//!
//! ```text
//! supervisor thread ── steps every camera's state machine
//! camera threads    ── driver → gate → slot on the bus
//! stage thread      ── bus → pairs of colour and depth → refine threads → bus
//! set thread        ── bus → frame sets → bus, recorder
//! signal thread     ── signals of the robot → recorder
//! housekeeping      ── once a second: dead subscribers, accounts into the file, CPU; ends a recording that is due
//! API thread        ── HTTP on the rig's socket
//! ```

mod assembly;
mod control;
mod controls;
mod inner;
mod join;
mod motion;
pub(crate) mod report;
mod signals;
mod threads;

use crate::api::{self, ServerHandle};
use crate::camera::{Camera, Shared};
use crate::config::RigConfig;
use crate::control::{Control, Shows};
use crate::family::Preparation;
use crate::hosts::{Hosts, JoinParts, Place};
use crate::link::Link;
use crate::recording::{Outside, Recording, Reports, recover_left};
use crate::ros2::Ros2;
use crate::sets::{Grid, SpreadStats};
use crate::stage::{Intake, Stage};
use crate::status::{CameraState, RigStatus, SetAccount};
use crate::wake::Wake;
use crate::{Error, Result, priority};
use assembly::Assembly;
use core::time::Duration;
use depthrig_bus::runtime::{RigLock, RuntimeDir};
use depthrig_bus::sync::lock;
use depthrig_bus::{Bus, HostTime, StreamId, UtcPair, shm, umask};
use depthrig_cdm::stage::{Installed, Refiners};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{UtcSource, live_late_ns};
use depthrig_sim::synthetic::{Drawing, DrawingProgress};
pub use join::near_pair_ns;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use threads::{housekeeping, start_thread, supervise};

/// How long the start waits for cameras that answer slowly; they come in later all the same.
const START_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a recovery of old datasets gets to end; cut off it begins anew at the next start.
const RECOVER_TIMEOUT: Duration = Duration::from_secs(2);

/// Set to end a thread.
type StopFlag = Arc<AtomicBool>;

/// Called with how far the images of synthetic cameras are rendered: camera, images done, images in all.
pub type Progress = Box<dyn Fn(&str, usize, usize) + Send + Sync>;

/// How a rig is to run.
pub struct RigOptions {
    /// Where its files are.
    pub runtime: RuntimeDir,
    /// Whether to serve the control API.
    pub serve_api: bool,
    /// Where rendered images are kept; the configuration's folder when `None`.
    pub cache_dir: Option<PathBuf>,
    /// Called during long work before the start.
    pub progress: Option<Progress>,
    /// The disk that recordings are written to; tests put one that fails or stalls here.
    pub fs: Arc<dyn Fs>,
    /// Source of UTC for recordings; tests step it.
    pub utc: UtcSource,
    /// Encoded bytes that may wait for the disk before sets are refused; the recorder's own limit when `None`.
    pub backlog_max_bytes: Option<u64>,
    /// Source of refiners; tests put something that fails or hangs here. The engines and models of this
    /// computer when `None`.
    pub refiners: Option<Arc<dyn Refiners>>,
    /// Shows datasets on the live page; without it the page has the cameras alone.
    pub shows: Option<Arc<dyn Shows>>,
    /// Joins the parts of recordings of several computers; without it they stay parts.
    pub join: Option<JoinParts>,
    /// Simulated cameras stream before their scenes are rendered, with coarse images until then.
    pub draw_while_running: bool,
}

impl RigOptions {
    /// A rig in `runtime` with its control API, on this computer's disk and clocks.
    pub fn new(runtime: RuntimeDir) -> Self {
        Self {
            runtime,
            serve_api: true,
            cache_dir: None,
            progress: None,
            fs: Arc::new(RealFs),
            utc: Arc::new(UtcPair::sample),
            backlog_max_bytes: None,
            refiners: None,
            shows: None,
            join: None,
            draw_while_running: false,
        }
    }
}

/// Summary of a rig at its end.
#[derive(Debug, Clone, serde::Serialize)]
pub struct RigSummary {
    /// Its last status.
    pub status: RigStatus,
    /// Summary of its last recording.
    pub recording: Option<depthrig_recorder::Summary>,
    /// Losses, in words; empty when nothing was lost.
    pub lost: Vec<String>,
}

/// A running rig. Dropping it stops it.
pub struct Rig {
    inner: Arc<Inner>,
    /// Each with the flag that ends it.
    threads: Vec<(JoinHandle<()>, StopFlag)>,
    /// It reads files of others in the recording folder, so that nobody waits for it for long.
    recovery: Option<(JoinHandle<()>, StopFlag)>,
    api: Option<ServerHandle>,
    _lock: RigLock,
}

/// State that the rig's threads share.
pub struct Inner {
    config: RigConfig,
    shared: Arc<Shared>,
    cameras: Vec<Arc<Camera>>,
    stop_asked: AtomicBool,
    /// The cameras are being stopped.
    ending: AtomicBool,
    ended: Wake,
    started: HostTime,
    recording: Mutex<Recording>,
    reports: Reports,
    outside: Outside,
    starting: Mutex<()>,
    spreads: Mutex<SpreadStats>,
    /// Of each stream, in the order of the cameras.
    skews: Mutex<BTreeMap<StreamId, SpreadStats>>,
    set_accounts: Mutex<SetAccounts>,
    cpu_millicores: AtomicU64,
    /// A recording is about to end: sets assembled from now on are not part of it.
    closing: AtomicBool,
    /// Shows datasets on the live page.
    shows: Option<Arc<dyn Shows>>,
    runtime: RuntimeDir,
    /// Sets that wait for refined depth.
    held_sets: AtomicUsize,
    /// The clock of the session, in a rig of several computers.
    link: Option<Arc<Link>>,
    /// The other computers, on the one that records.
    hosts: Option<Arc<Hosts>>,
    /// The program that publishes the rig to ROS 2.
    ros2: Option<Arc<Ros2>>,
    /// Where the ticks of all computers lie.
    grid: Arc<Grid>,
}

/// The set assembler's numbers, as `status` shows them.
#[derive(Debug, Default)]
pub struct SetAccounts {
    sent: u64,
    incomplete: u64,
    streams: BTreeMap<StreamId, SetAccount>,
}

impl Rig {
    /// Starts the rig and returns when every camera streams or is known not to, after 10 s at most.
    ///
    /// # Errors
    /// [`crate::ErrorKind::InUse`] naming who runs a rig of this name, [`crate::ErrorKind::NoSpace`] when `/dev/shm` is too
    /// small, [`crate::ErrorKind::BadInput`] when a camera's settings cannot work (all such cameras are named).
    pub fn start(mut config: RigConfig, options: &RigOptions) -> Result<Self> {
        priority::raise_file_limit();
        umask::check();
        let source =
            config.path.as_deref().map_or("built-in configuration".to_owned(), |p| p.display().to_string());
        let who = format!("process {} ({source})", std::process::id());
        let lock = options.runtime.lock(&config.rig, &who)?;
        let bus = Bus::open(&options.runtime, &config.rig)?;
        bus.clean_dead();
        config.read_calibration()?;
        prepare(&mut config, options)?;
        let intake = Arc::new(Intake::default());
        let refiners = options.refiners.clone();
        let refiners = refiners.unwrap_or_else(|| Arc::new(Installed::new(config.cdm.clone())));
        let drawing = options.draw_while_running.then(Arc::<Drawing>::default);
        if let Some(drawing) = &drawing {
            plan(&config, drawing)?;
        }
        let shared = Arc::new(Shared {
            drawing,
            memory_share: shm::free_bytes(shm::SHM_DIR.as_ref())? / config.cameras.len().max(1) as u64,
            slots: config.bus.slots,
            began: HostTime::now(),
            supervisor: config.supervisor.clone(),
            frames: Arc::new(Wake::with(Arc::clone(&intake.wake))),
            stage: intake,
            bus,
        });
        let link = config.link.as_ref().map(Link::start).transpose()?.map(Arc::new);
        let grid = Arc::<Grid>::default();
        let key = link.as_ref().and_then(|link| link.key());
        let hosts = Hosts::new(&config, &options.runtime, options.join, Arc::clone(&grid), key)?;
        let ros2 = config.ros2.as_ref().map(|ros2| Arc::new(Ros2::new(ros2, &config.rig, &options.runtime)));
        let late_after_ns = live_late_ns((1e9 / config.sets.rate_hz) as i64);
        let inner = Arc::new(Inner {
            cameras: config.cameras.iter().map(|c| Arc::new(Camera::new(c.clone()))).collect(),
            config,
            shared,
            stop_asked: AtomicBool::new(false),
            ending: AtomicBool::new(false),
            ended: Wake::default(),
            started: HostTime::now(),
            recording: Mutex::default(),
            reports: Reports::default(),
            outside: Outside {
                fs: Arc::clone(&options.fs),
                utc: Arc::clone(&options.utc),
                backlog_max_bytes: options.backlog_max_bytes,
                late_after_ns: Some(late_after_ns),
            },
            starting: Mutex::default(),
            spreads: Mutex::default(),
            skews: Mutex::default(),
            set_accounts: Mutex::default(),
            cpu_millicores: AtomicU64::new(0),
            closing: AtomicBool::new(false),
            shows: options.shows.clone(),
            runtime: options.runtime.clone(),
            held_sets: AtomicUsize::new(0),
            link,
            hosts: hosts.map(Arc::new),
            ros2,
            grid,
        });
        let assembly = Assembly::new(Arc::clone(&inner))?;
        let signals = signals::Collector::new(Arc::clone(&inner))?;
        let mut rig = Self { threads: Vec::new(), recovery: None, api: None, inner, _lock: lock };
        // Before the cameras: a long start can then be asked about.
        if options.serve_api {
            let config = &rig.inner.config;
            rig.api = Some(api::serve(rig.control(), &options.runtime, &config.rig, config.control)?);
        }
        let inner = Arc::clone(&rig.inner);
        rig.spawn("supervisor", move |stop| supervise(&inner, stop))?;
        if rig.inner.config.has_refined() {
            let config = &rig.inner.config;
            let shared = &rig.inner.shared;
            let intake = Arc::clone(&shared.stage);
            let frames = Arc::clone(&shared.frames);
            let stage = Stage::new(intake, refiners, config.cdm.clone(), frames);
            rig.spawn("stage", move |stop| stage.run(stop))?;
        }
        rig.spawn("sets", move |stop| assembly.run(stop))?;
        rig.spawn("signals", move |stop| signals.run(stop))?;
        if let Some(link) = rig.inner.link.clone() {
            let publisher = link.publisher(&options.runtime)?;
            rig.spawn("link", move |stop| publisher.run(&link, stop))?;
        }
        rig.keep_hosts()?;
        rig.keep_ros2()?;
        let inner = Arc::clone(&rig.inner);
        rig.spawn("housekeeping", move |stop| housekeeping(&inner, stop))?;
        if rig.inner.config.recording.recover_on_start {
            let inner = Arc::clone(&rig.inner);
            let recover = move |stop: &AtomicBool| recover_left(&inner.config, &inner.outside.fs, stop);
            rig.recovery = Some(start_thread("recover", recover)?);
        }
        rig.draw()?;
        rig.wait_for_cameras()?;
        Ok(rig)
    }

    /// How far the scenes of simulated cameras are rendered; `None` when there is nothing to render.
    pub fn drawing(&self) -> Option<DrawingProgress> {
        self.inner.drawing()
    }

    /// The port of the live page, if one is served.
    pub fn port(&self) -> Option<SocketAddr> {
        self.api.as_ref().and_then(ServerHandle::tcp)
    }

    /// The rig's control.
    pub fn control(&self) -> Arc<dyn Control> {
        Arc::clone(&self.inner) as Arc<dyn Control>
    }

    /// Whether somebody asked the rig to stop.
    pub fn is_stop_asked(&self) -> bool {
        self.inner.stop_asked.load(Ordering::Relaxed)
    }

    /// Waits until somebody asks the rig to stop, until `deadline`, or until every camera is done (at the end of
    /// its files, or failed). Returns whether there is more to wait for.
    pub fn wait(&self, deadline: Option<HostTime>) -> bool {
        const LOOK: Duration = Duration::from_millis(50);
        loop {
            let left = deadline.map_or(LOOK, HostTime::from_now);
            if self.inner.stop_asked.load(Ordering::Relaxed) || left.is_zero() || self.inner.all_done() {
                return false;
            }
            self.inner.ended.wait(left.min(LOOK));
        }
    }

    /// Stops the rig: closes the recording, ends the cameras, and reports losses.
    pub fn stop(mut self) -> RigSummary {
        // The recording first: its last sets are still being assembled.
        let active = lock(&self.inner.recording).is_active();
        if active && let Err(e) = self.inner.record_stop() {
            tracing::error!(error = %e, "the recording could not be closed");
        }
        // Why a camera is away is forgotten when it is stopped.
        let mut lost = report::silent(&self.inner.status());
        self.end_threads();
        self.finish_reports();
        let status = self.inner.status();
        let recording = lock(&self.inner.recording).summary().cloned();
        lost.extend(report::lost(&status));
        RigSummary { status, recording, lost }
    }

    /// Waits for the reports of recordings that have ended, for some seconds at most.
    pub fn finish_reports(&self) {
        self.inner.reports.finish();
    }

    fn end_threads(&mut self) {
        if let Some(api) = self.api.take() {
            api.stop();
        }
        self.inner.ending.store(true, Ordering::Relaxed);
        if let Some((_, stop)) = &self.recovery {
            stop.store(true, Ordering::Relaxed);
        }
        // In the order of `spawn`: the cameras end first, then the set thread reads their last frames.
        for (thread, stop) in self.threads.drain(..) {
            stop.store(true, Ordering::Relaxed);
            self.inner.shared.frames.raise();
            if thread.join().is_err() {
                tracing::error!("a thread of the rig panicked");
            }
        }
        let Some((recovery, _)) = self.recovery.take() else { return };
        let deadline = HostTime::now().plus(RECOVER_TIMEOUT);
        while !recovery.is_finished() && !deadline.from_now().is_zero() {
            std::thread::sleep(Duration::from_millis(5));
        }
        if !recovery.is_finished() {
            let folder = self.inner.config.recording.directory.display();
            tracing::warn!("the recovery of old datasets in {folder} does not end and is left behind");
        }
    }

    fn spawn(&mut self, name: &str, run: impl FnOnce(&AtomicBool) + Send + 'static) -> Result<()> {
        self.threads.push(start_thread(name, run)?);
        Ok(())
    }

    /// Two threads for each other computer, one for each of their streams that come here, and one that joins what they recorded.
    fn keep_hosts(&mut self) -> Result<()> {
        let Some(hosts) = self.inner.hosts.clone() else { return Ok(()) };
        for number in 0..hosts.count() {
            let inner = Arc::clone(&self.inner);
            let hosts = Arc::clone(&hosts);
            self.spawn("host", move |stop| {
                let place = Place { bus: &inner.shared.bus, intake: &inner.shared.stage };
                let kept = hosts.keep(number, &|| inner.recording().active_path(), place, stop);
                if let Err(e) = kept {
                    tracing::error!("{e}");
                }
            })?;
        }
        for number in 0..hosts.count() {
            let hosts = Arc::clone(&hosts);
            self.spawn("pull", move |stop| {
                if let Err(e) = hosts.pull(number, stop) {
                    tracing::error!("{e}");
                }
            })?;
        }
        for number in 0..hosts.mirrored() {
            let hosts = Arc::clone(&hosts);
            let wake = Arc::clone(&self.inner.shared.stage.wake);
            self.spawn("mirror", move |stop| {
                if let Err(e) = hosts.mirror(number, &wake, stop) {
                    tracing::error!("{e}");
                }
            })?;
        }
        self.spawn("join", move |stop| hosts.join_complete(stop))
    }

    fn keep_ros2(&mut self) -> Result<()> {
        let Some(ros2) = self.inner.ros2.clone() else { return Ok(()) };
        self.spawn("ros2", move |stop| ros2.run(stop))
    }

    /// Renders the scenes of simulated cameras, if that is left for the time after the start.
    fn draw(&mut self) -> Result<()> {
        let Some(drawing) = self.inner.shared.drawing.clone() else { return Ok(()) };
        self.spawn("draw", move |stop| {
            if let Err(e) = drawing.run(stop) {
                tracing::error!("the images of synthetic cameras stay coarse: {e}");
            }
        })
    }

    /// Reports too little shared memory once, for all cameras together.
    fn check_memory(&self) -> Result<()> {
        let cameras = &self.inner.cameras;
        if !cameras.iter().any(|c| c.state().short_of_memory) {
            return Ok(());
        }
        let set_bytes: u64 = cameras.iter().map(|c| c.state().set_bytes).sum();
        let free = self.inner.shared.memory_share * cameras.len() as u64;
        shm::slots_that_fit(shm::MIN_SLOTS, set_bytes, free)?;
        Ok(()) // enough if the cameras were alike; each reports its own lack
    }

    /// Waits for the first word of every camera. One whose settings cannot work fails the start: better now
    /// than after an hour of recording without it.
    fn wait_for_cameras(&self) -> Result<()> {
        let deadline = HostTime::now().plus(START_TIMEOUT);
        while !deadline.from_now().is_zero()
            && self.inner.cameras.iter().any(|c| c.state().phase == CameraState::Opening)
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        self.check_memory()?;
        let mut failed: Vec<Error> = Vec::new();
        for camera in &self.inner.cameras {
            let mut state = camera.state();
            if state.phase == CameraState::Failed {
                failed.extend(state.error.take());
            }
        }
        match failed.len() {
            0 => Ok(()),
            1 => Err(failed.remove(0)),
            n => {
                let all: Vec<_> = failed.iter().map(ToString::to_string).collect();
                Err(Error::new(failed[0].kind(), format!("{n} cameras cannot work:\n  {}", all.join("\n  "))))
            }
        }
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        self.end_threads();
    }
}

/// Adds the scenes of all cameras to the shared drawing.
fn plan(config: &RigConfig, drawing: &Drawing) -> Result<()> {
    for camera in &config.cameras {
        camera.backend.add_to_drawing(drawing)?;
    }
    Ok(())
}

/// Prepares every camera; scenes are rendered now unless that is to be done while they stream.
fn prepare(config: &mut RigConfig, options: &RigOptions) -> Result<()> {
    for camera in &mut config.cameras {
        let name = camera.name.as_str();
        let render = |done, total| {
            if let Some(progress) = &options.progress {
                progress(name, done, total);
            }
        };
        camera.backend.prepare(&Preparation {
            pose: camera.pose,
            cache_dir: options.cache_dir.as_deref(),
            render: (!options.draw_while_running).then_some(&render),
        })?;
    }
    Ok(())
}
