//! One camera under supervision: opened, watched, lost, opened again. The other cameras do not notice.
//!
//! ```text
//! opening ──frame──▶ streaming ──no frame──▶ stalled ──still none──▶ reconnecting ──▶ (opened again)
//!    │                   │  ▲──────frame───────┘                          ▲
//!    └──────error────────┴──────────────────error, hang───────────────────┘
//! an error that cannot pass (wrong settings) ──▶ failed      end of the files ──▶ finished
//! ```
//!
//! "No frame" is said of each stream: one that is silent alone, while the others go on, has its camera stalled and
//! opened again all the same.

use crate::config::{BackendConfig, CameraConfig, KinectSettings, SupervisorConfig};
use crate::sink::BusSink;
use crate::stage::{Entrance, Lane};
use crate::status::CameraState;
use crate::stream::Stream;
use crate::wake::Wake;
use crate::{Error, Result, priority};
use core::time::Duration;
use depthrig_bus::{Bus, FrameHeader, HostTime, StreamId, shm};
use depthrig_calib::PoseExt;
use depthrig_drivers::capture::{Capture, End, Session, StopOutcome};
use depthrig_drivers::stereo::{Descriptions, EYES, PREFIXES, StereoOptions};
use depthrig_drivers::{Backend, DeviceInfo, ErrorKind as DriverErrorKind, StreamProfile};
use depthrig_recorder::Computed;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// How long an opening may take before its thread is given up for hung.
const OPEN_PATIENCE: Duration = Duration::from_secs(15);
/// How long a recording may be silent that waits for its modes.
const WAITS_FOR_MODES: Duration = Duration::from_mins(1);
/// A stalled camera is opened again after this many stall times without a frame.
const STALLS_UNTIL_RESTART: u32 = 4;

/// A camera and the state of its supervisor.
#[derive(Debug)]
pub struct Camera {
    /// Its part of the configuration.
    pub config: CameraConfig,
    /// What computes each mode of its stereo, once it was open.
    pub computed: Descriptions,
    state: Mutex<State>,
}

/// What is known of a camera now.
#[derive(Debug)]
pub struct State {
    /// Where its supervisor stands.
    pub phase: CameraState,
    /// Since when.
    pub since: HostTime,
    /// Why it is not streaming.
    pub message: Option<String>,
    /// The error behind the message, for whoever waits for the first opening.
    pub error: Option<Error>,
    /// What the device says of itself, once it was open.
    pub info: Option<DeviceInfo>,
    /// Its streams, once it was open; they stay the same over reconnects.
    pub streams: Vec<Arc<Stream>>,
    /// Those that are made of them.
    pub made: Vec<Arc<Stream>>,
    /// How they are made.
    pub lane: Option<Arc<Lane>>,
    /// Bytes of one frame of every stream, once it was open.
    pub set_bytes: u64,
    /// Shared memory is too small for it.
    pub short_of_memory: bool,
    /// Times that it came back.
    pub reconnects: u64,
}

impl Camera {
    /// A camera that was never opened.
    pub fn new(config: CameraConfig) -> Self {
        let state = State {
            phase: CameraState::Opening,
            since: HostTime::from_ns(0),
            message: None,
            error: None,
            info: None,
            streams: Vec::new(),
            made: Vec::new(),
            lane: None,
            set_bytes: 0,
            short_of_memory: false,
            reconnects: 0,
        };
        Self { config, computed: Descriptions::default(), state: Mutex::new(state) }
    }

    /// What computed `stream`, if it is made of the eyes: for the dataset that it is recorded in.
    pub fn computed(&self, stream: &StreamId) -> Option<Computed> {
        let all = self.computed.lock().unwrap_or_else(PoisonError::into_inner);
        let mode = PREFIXES.iter().find_map(|p| stream.stream.as_str().strip_prefix(p))?;
        let d = all.get(mode)?;
        let eye = |name: &&str| StreamId::new(stream.camera.as_str(), name).ok();
        Some(Computed {
            stream: stream.clone(),
            // It is nobody's closed algorithm, and says so.
            name: format!("mimic_{mode}"),
            producer: d.producer.clone(),
            parameters: d.parameters.clone(),
            from: EYES.iter().filter_map(eye).collect(),
        })
    }

    /// What is known of it now.
    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Its streams and those that are made of them.
    pub fn all_streams(&self) -> impl Iterator<Item = &Arc<Stream>> {
        self.streams.iter().chain(&self.made)
    }

    fn enter(&mut self, camera: &str, state: CameraState, message: Option<String>) {
        if self.phase == state && self.message == message {
            return;
        }
        match (&message, state) {
            (Some(why), CameraState::Failed) => tracing::error!(camera, state = state.name(), "{why}"),
            (Some(why), _) => tracing::warn!(camera, state = state.name(), "{why}"),
            (None, _) => tracing::info!(camera, state = state.name(), "camera"),
        }
        if self.phase != state {
            self.since = HostTime::now();
        }
        (self.phase, self.message) = (state, message);
    }
}

/// What every camera of a rig shares.
pub struct Shared {
    /// The rig's bus.
    pub bus: Bus,
    /// Rung after every frame.
    pub frames: Arc<Wake>,
    /// Bytes of shared memory that one camera may plan with.
    pub memory_share: u64,
    /// Slots per stream when memory is plenty.
    pub slots: usize,
    /// When the rig began: the beginning of time for simulated cameras.
    pub began: HostTime,
    /// Supervision settings.
    pub supervisor: SupervisorConfig,
    /// Where depth is refined.
    pub stage: Arc<Entrance>,
}

/// A camera's driver, made at the first opening and kept for the later ones.
type SharedBackend = Arc<Mutex<Option<Box<dyn Backend>>>>;

/// Drives one [`Camera`]; owned by the rig's supervisor thread.
pub struct Supervisor {
    camera: Arc<Camera>,
    shared: Arc<Shared>,
    backend: SharedBackend,
    capture: Option<Capture>,
    opened_at: HostTime,
    retry_at: HostTime,
    backoff: Duration,
    lost: bool,
    heard: Vec<Heard>,
}

/// When a stream last announced a frame, kept or lost.
#[derive(Debug, Clone, Copy)]
struct Heard {
    captured: u64,
    at: HostTime,
}

impl Supervisor {
    /// A supervisor that opens its camera at its first [`Self::step`].
    pub fn new(camera: Arc<Camera>, shared: Arc<Shared>) -> Self {
        let backoff = Duration::from_secs_f64(shared.supervisor.backoff_min_s);
        Self {
            camera,
            shared,
            backend: SharedBackend::default(),
            capture: None,
            opened_at: HostTime::from_ns(0),
            retry_at: HostTime::from_ns(0),
            backoff,
            lost: false,
            heard: Vec::new(),
        }
    }

    /// Looks at the camera and does what is due. Never blocks on the device.
    pub fn step(&mut self, now: HostTime) {
        let name = self.camera.config.name.clone();
        let Some(capture) = &self.capture else {
            let waiting =
                matches!(self.camera.state().phase, CameraState::Opening | CameraState::Reconnecting);
            if waiting && now >= self.retry_at {
                self.open(now);
            }
            return;
        };
        if capture.has_ended() {
            if let Some(StopOutcome::Ended(end)) = self.capture.take().map(|c| c.stop(Duration::ZERO)) {
                self.ended(now, end);
            }
            return;
        }
        let stall = self.stall_time();
        let heartbeat_age = Duration::from_nanos(now.since_ns(capture.heartbeat()).max(0) as u64);
        let Some(last_frame) = capture.last_frame().filter(|t| *t >= self.opened_at) else {
            // Not a frame yet: opening, or open and silent.
            let open = !self.camera.state().streams.is_empty();
            let silence = Duration::from_nanos(now.since_ns(self.opened_at).max(0) as u64);
            if heartbeat_age > open_patience(&self.camera.config.backend) {
                self.give_up(now, "the device did not come back from being opened");
            } else if open && silence > stall * STALLS_UNTIL_RESTART && heartbeat_age < stall {
                self.restart(now, &format!("open, but not one frame in {:.1} s", silence.as_secs_f64()));
            }
            return;
        };
        let silence = Duration::from_nanos(now.since_ns(last_frame).max(0) as u64);
        if heartbeat_age > stall * 2 {
            let hang = heartbeat_age.as_secs_f64();
            self.give_up(now, &format!("the driver hangs in the device for {hang:.1} s"));
        } else if silence > stall * STALLS_UNTIL_RESTART {
            self.restart(
                now,
                &format!("no frame for {:.1} s, the device is opened again", silence.as_secs_f64()),
            );
        } else if silence > stall {
            let mut state = self.camera.state();
            if state.phase != CameraState::Stalled {
                let why = format!("no frame for {:.1} s although the device answers", stall.as_secs_f64());
                state.enter(name.as_str(), CameraState::Stalled, Some(why));
            }
        } else if let Some((stream, silence)) = self.mute_stream(now).filter(|(_, silence)| *silence > stall)
        {
            let why =
                format!("no frame of {stream} for {:.1} s while other streams go on", silence.as_secs_f64());
            if silence > stall * STALLS_UNTIL_RESTART {
                self.restart(now, &format!("{why}, the device is opened again"));
            } else if self.camera.state().phase != CameraState::Stalled {
                self.camera.state().enter(name.as_str(), CameraState::Stalled, Some(why));
            }
        } else {
            let mut state = self.camera.state();
            if state.phase != CameraState::Streaming {
                if self.lost {
                    state.reconnects += 1;
                    self.lost = false;
                }
                state.enter(name.as_str(), CameraState::Streaming, None);
            }
            self.backoff = Duration::from_secs_f64(self.shared.supervisor.backoff_min_s);
        }
    }

    /// Asks the camera thread to end, without waiting.
    pub fn request_stop(&self) {
        if let Some(capture) = &self.capture {
            capture.request_stop();
        }
    }

    /// Ends the camera thread, waiting for at most `patience`.
    pub fn stop(&mut self, patience: Duration) {
        let name = self.camera.config.name.clone();
        if self.end_capture(patience) {
            tracing::warn!(camera = %name, "the device hangs; its thread is left behind");
        }
        let mut state = self.camera.state();
        if !matches!(state.phase, CameraState::Failed | CameraState::Finished) {
            state.enter(name.as_str(), CameraState::Stopped, None);
        }
    }

    /// The stream that has announced no frame for the longest, and for how long.
    fn mute_stream(&mut self, now: HostTime) -> Option<(String, Duration)> {
        let state = self.camera.state();
        let unheard = Heard { captured: u64::MAX, at: now };
        self.heard.resize(state.streams.len(), unheard);
        let mut longest = None;
        for (stream, heard) in state.streams.iter().zip(&mut self.heard) {
            // How long matching takes says nothing of the device.
            if self.camera.config.joins_late(&stream.id.stream) {
                continue;
            }
            let captured = stream.books().captured;
            // A camera that was opened again starts with all its time.
            if heard.captured != captured || heard.at < self.opened_at {
                *heard = Heard { captured, at: now };
            }
            let silence = Duration::from_nanos(now.since_ns(heard.at).max(0) as u64);
            if longest.as_ref().is_none_or(|(_, most)| silence > *most) {
                longest = Some((stream.id.stream.to_string(), silence));
            }
        }
        longest
    }

    fn stall_time(&self) -> Duration {
        // A recording that waits for its slowest mode is silent for as long as that takes.
        if self.camera.config.stereo.as_ref().is_some_and(|s| s.every_pair) {
            return WAITS_FOR_MODES;
        }
        let slowest = self.camera.state().streams.iter().map(|s| s.profile.period_ns()).max().unwrap_or(0);
        Duration::from_secs_f64(self.shared.supervisor.stall_s).max(Duration::from_nanos(3 * slowest))
    }

    fn ended(&mut self, now: HostTime, end: End) {
        let name = self.camera.config.name.as_str();
        match end {
            End::Failed(e) if e.kind().is_transient() && !self.never_will(&e) => {
                self.lose(now, &e.to_string(), Some(e));
            }
            End::Failed(e) => {
                let mut state = self.camera.state();
                state.enter(name, CameraState::Failed, Some(e.to_string()));
                state.error = Some(e.into());
            }
            End::Finished => {
                self.camera.state().enter(
                    name,
                    CameraState::Finished,
                    Some("the files are at their end".into()),
                );
            }
            End::Stopped => self.camera.state().enter(name, CameraState::Stopped, None),
        }
    }

    /// Whether an opening failed for good: files that are not there are a mistake, not an unplugged camera.
    fn never_will(&self, e: &depthrig_drivers::Error) -> bool {
        e.kind() == DriverErrorKind::NotFound
            && matches!(
                self.camera.config.backend,
                BackendConfig::Files(_)
                    | BackendConfig::ZedReplay(_)
                    | BackendConfig::Kinect(KinectSettings::Recorded(_))
            )
            && self.camera.state().streams.is_empty()
    }

    /// The camera is lost; it is tried again after a pause.
    fn lose(&mut self, now: HostTime, why: &str, error: Option<depthrig_drivers::Error>) {
        let mut state = self.camera.state();
        self.lost |= state.phase != CameraState::Opening;
        state.enter(self.camera.config.name.as_str(), CameraState::Reconnecting, Some(why.to_owned()));
        state.error = error.map(Into::into);
        drop(state);
        self.retry_at = now.plus(self.backoff);
        self.backoff = (self.backoff * 2).min(Duration::from_secs_f64(self.shared.supervisor.backoff_max_s));
    }

    /// Ends a thread that still answers, then opens the device again.
    fn restart(&mut self, now: HostTime, why: &str) {
        self.end_capture(Duration::from_millis(200));
        self.lose(now, why, None);
    }

    /// Leaves a hung thread behind.
    fn give_up(&mut self, now: HostTime, why: &str) {
        self.end_capture(Duration::ZERO);
        self.lose(now, why, None);
    }

    /// Ends the camera thread if there is one; whether it had to be left behind.
    fn end_capture(&mut self, patience: Duration) -> bool {
        let abandoned =
            self.capture.take().is_some_and(|c| matches!(c.stop(patience), StopOutcome::Abandoned));
        if abandoned {
            for stream in &self.camera.state().streams {
                stream.books().close();
            }
        }
        abandoned
    }

    fn open(&mut self, now: HostTime) {
        self.opened_at = now;
        let (camera, shared) = (Arc::clone(&self.camera), Arc::clone(&self.shared));
        let backend = Arc::clone(&self.backend);
        let opening = Capture::spawn(self.camera.config.name.as_str(), move || {
            // Ordinary until it streams: opening is work, and must not keep other cameras' threads from theirs.
            let session = open_session(&camera, &shared, &backend)?;
            if shared.supervisor.raise_priority {
                priority::raise_current_thread();
            }
            Ok(session)
        });
        match opening {
            Ok(capture) => self.capture = Some(capture),
            Err(e) => self.lose(now, &e.to_string(), Some(e)),
        }
    }
}

/// Opens the device and its channels; runs on the camera's own thread.
fn open_session(
    camera: &Camera,
    shared: &Shared,
    backend: &Mutex<Option<Box<dyn Backend>>>,
) -> Result<Session, depthrig_drivers::Error> {
    let name = &camera.config.name;
    let in_camera = |e: depthrig_drivers::Error| {
        depthrig_drivers::Error::new(e.kind(), format!("camera \"{name}\": {e}")).with_source(e)
    };
    let device = {
        // Held for the opening alone; a thread that hangs in it keeps its successors waiting, not the rig.
        let mut backend = backend.lock().unwrap_or_else(PoisonError::into_inner);
        let backend = match backend.as_ref() {
            Some(backend) => backend,
            None => backend.insert(make_backend(camera, shared).map_err(in_camera)?),
        };
        backend.open(None).map_err(in_camera)?
    };
    let info = device.info().clone();
    let stream = device.start(&camera.config.streams).map_err(in_camera)?;
    let streams = adopt(camera, shared, stream.profiles(), &info).map_err(in_camera)?;
    let mut ports = Vec::new();
    for s in streams {
        let mut header = FrameHeader::default();
        header.set_picture(s.profile.format, s.profile.width, s.profile.height);
        header.set_names(shared.bus.rig().as_str(), &s.id);
        header.set_device(&info.model, &info.serial);
        header.depth_unit_m = s.profile.depth_unit_m;
        header.device_tick_ns = s.profile.clock.tick_ns();
        header.intrinsics = s.profile.intrinsics;
        header.pose = camera.config.pose.compose(&s.profile.pose_in_device);
        let publisher = publisher_of(shared, &s).map_err(|e| {
            let kind = match e.kind() {
                crate::ErrorKind::NoSpace => DriverErrorKind::Unsupported,
                _ => DriverErrorKind::Io,
            };
            in_camera(depthrig_drivers::Error::new(kind, e.to_string()).with_source(e))
        })?;
        ports.push((s, publisher, header));
    }
    open_lane(camera, shared, &info).map_err(|e| {
        in_camera(depthrig_drivers::Error::new(DriverErrorKind::Io, e.to_string()).with_source(e))
    })?;
    Ok(Session { info, stream, sink: Box::new(BusSink::new(ports, Arc::clone(&shared.frames))) })
}

/// Opens the way from the camera's streams to those that are made of them, at its first opening. All of it is there
/// before the first frame, so that no publisher waits for a subscriber that is half made.
fn open_lane(camera: &Camera, shared: &Shared, info: &DeviceInfo) -> Result<()> {
    let Some(config) = &camera.config.refine else { return Ok(()) };
    let (streams, made, begun) = {
        let state = camera.state();
        (state.streams.clone(), state.made.clone(), state.lane.is_some())
    };
    let find = |name: &str| streams.iter().find(|s| s.id.stream.as_str() == name);
    let (Some(color), Some(depth)) = (find("color"), find(&config.depth)) else { return Ok(()) };
    let [refined, aligned @ ..] = made.as_slice() else { return Ok(()) };
    if begun {
        return Ok(());
    }
    for stream in &made {
        publisher_of(shared, stream)?;
    }
    let readers = (shared.bus.subscriber(&color.id)?, shared.bus.subscriber(&depth.id)?);
    let color_ns = color.profile.period_ns() as i64;
    let lane = Arc::new(Lane::new(
        (camera.config.name.clone(), info.model.clone()),
        config.clone(),
        (Arc::clone(refined), aligned.first().cloned()),
        (color_ns, depth.profile.period_ns() as i64),
        color_ns / 2 + 1_000_000,
        readers,
    ));
    camera.state().lane = Some(Arc::clone(&lane));
    shared.stage.enter(lane);
    Ok(())
}

/// How long opening this camera may take. The driver of another process's camera waits for the process, for its first
/// message and for its first frame, each with a limit of its own that the rig file sets.
fn open_patience(backend: &BackendConfig) -> Duration {
    match backend {
        BackendConfig::External(c) => OPEN_PATIENCE + c.start_timeout * 2 + c.heartbeat_timeout,
        _ => OPEN_PATIENCE,
    }
}

/// The driver of a camera.
fn make_backend(camera: &Camera, shared: &Shared) -> Result<Box<dyn Backend>, depthrig_drivers::Error> {
    use depthrig_drivers::{
        external::{ExternalBackend, Place},
        files::FilesBackend,
        kinect::{KinectConfig, live::LiveBackend, playback::PlaybackBackend},
        realsense::RealsenseBackend,
        realsense::l515::L515Backend,
        stereo::StereoBackend,
        synthetic::SyntheticBackend,
        v4l2::V4l2Backend,
        zed::{ZedBackend, replay::ReplayBackend},
    };
    let backend: Box<dyn Backend> = match &camera.config.backend {
        // One beginning for all cameras of the rig, or each would see the world at another moment.
        BackendConfig::Synthetic(c) => {
            Box::new(SyntheticBackend::starting_at(vec![c.clone()], shared.began)?)
        }
        BackendConfig::Files(c) => Box::new(FilesBackend::new(c.clone())),
        BackendConfig::L515(c) => Box::new(L515Backend::new(c.clone())),
        BackendConfig::Realsense(c) => Box::new(RealsenseBackend::new(c.clone())),
        BackendConfig::V4l2(c) => Box::new(V4l2Backend::new(c.clone())),
        BackendConfig::Zed(c) => Box::new(ZedBackend::new(c.clone())),
        BackendConfig::ZedReplay(c) => Box::new(ReplayBackend::new(c.clone())),
        BackendConfig::External(c) => {
            let (runtime, rig) = (shared.bus.runtime().clone(), shared.bus.rig().clone());
            let place = Place { runtime, rig, camera: camera.config.name.clone() };
            Box::new(ExternalBackend::new(c.clone(), place))
        }
        BackendConfig::Kinect(KinectConfig::Live(c)) => Box::new(LiveBackend::new(c.clone())),
        BackendConfig::Kinect(KinectConfig::Recorded(c)) => Box::new(PlaybackBackend::new(c.clone())),
    };
    Ok(match &camera.config.stereo {
        Some(stereo) => {
            let options = StereoOptions {
                computed: Arc::clone(&camera.computed),
                sets: Arc::clone(&shared.stage.sets),
                ..stereo.options()
            };
            Box::new(StereoBackend::new(backend, options))
        }
        None => backend,
    })
}

fn publisher_of(shared: &Shared, stream: &Stream) -> Result<Arc<depthrig_bus::Publisher>> {
    let mut books = stream.books();
    if let Some(publisher) = &books.publisher {
        return Ok(Arc::clone(publisher));
    }
    let publisher = Arc::new(shared.bus.publisher(&stream.id, stream.profile.frame_bytes(), stream.slots)?);
    if books.session == 0 {
        books.reader = Some(shared.bus.subscriber(&stream.id)?);
    }
    books.publisher = Some(Arc::clone(&publisher));
    Ok(publisher)
}

/// Makes the camera's streams at its first opening, and holds later openings to them.
fn adopt(
    camera: &Camera,
    shared: &Shared,
    profiles: &[StreamProfile],
    info: &DeviceInfo,
) -> Result<Vec<Arc<Stream>>, depthrig_drivers::Error> {
    let mut state = camera.state();
    state.info = Some(info.clone());
    if state.streams.is_empty() {
        let made = camera.config.makes(profiles).map_err(|e| {
            depthrig_drivers::Error::new(DriverErrorKind::BadInput, e.to_string()).with_source(e)
        })?;
        let all = profiles.iter().chain(made.iter().map(|(p, _)| p));
        state.set_bytes = all.map(|p| p.frame_bytes() as u64).sum();
        let slots = shm::slots_that_fit(shared.slots, state.set_bytes, shared.memory_share);
        state.short_of_memory = slots.is_err();
        let slots = slots.map_err(|e| {
            depthrig_drivers::Error::new(DriverErrorKind::Unsupported, e.to_string()).with_source(e)
        })?;
        let stream = |p: &StreamProfile, record: bool| {
            let id = StreamId { camera: camera.config.name.clone(), stream: p.stream.clone() };
            Arc::new(Stream::new(id, p.clone(), record, slots))
        };
        state.streams = profiles.iter().map(|p| stream(p, camera.config.records(&p.stream))).collect();
        state.made = made.iter().map(|(p, record)| stream(p, *record)).collect();
    } else if state.streams.len() != profiles.len()
        || state.streams.iter().zip(profiles).any(|(s, p)| !same_mode(&s.profile, p))
    {
        let had: Vec<_> = state.streams.iter().map(|s| s.profile.describe()).collect();
        let has: Vec<_> = profiles.iter().map(StreamProfile::describe).collect();
        return Err(depthrig_drivers::Error::new(
            DriverErrorKind::Unsupported,
            format!(
                "it came back with other modes: had {}, has {}; restart the daemon to use them",
                had.join(", "),
                has.join(", ")
            ),
        ));
    }
    Ok(state.streams.clone())
}

fn same_mode(a: &StreamProfile, b: &StreamProfile) -> bool {
    a.stream == b.stream && a.format == b.format && (a.width, a.height) == (b.width, b.height)
}
