//! The synthetic backend: simulated cameras behind the traits of every other one.

use super::board::{Moment, Painter};
use super::config::{FaultKind, GAINS, SyntheticConfig};
use super::drawing::Drawing;
use super::gain::{self, Panel};
use super::imu::{Batch, Filler};
use super::pattern::Pattern;
use super::profiles::Content;
use super::queue::{Queue, Waiting};
use super::render::{self, Images};
use super::unit::{DueFault, SimFrame, SimTruth, Unit};
use super::view::Rays;
use super::{NAME, noise, overlay};
use core::sync::atomic::Ordering;
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime};
use depthrig_calib::PoseExt;
use depthrig_driver::controls::ControlPanel;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream,
    StreamProfile, StreamRequest, choose_profiles,
};
use std::sync::{Arc, Weak};

/// The longest that a poll sleeps at a stretch, so that a fault injected meanwhile is noticed.
const NAP: Duration = Duration::from_millis(20);

/// Simulated cameras on one mount in one world.
#[derive(Debug)]
pub struct SyntheticBackend {
    units: Vec<Arc<Unit>>,
}

impl SyntheticBackend {
    /// Plugs the cameras in; the mount begins to move now.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] or [`ErrorKind::Unsupported`] when a configuration is impossible, also when two
    /// have the same serial number.
    pub fn new(configs: Vec<SyntheticConfig>) -> Result<Self> {
        Self::starting_at(configs, HostTime::now())
    }

    /// The same with the moment at which the mount begins to move, which makes cameras of several backends
    /// show one world.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn starting_at(configs: Vec<SyntheticConfig>, world_start: HostTime) -> Result<Self> {
        Self::with_drawing(configs, world_start, None)
    }

    /// The same with what renders scenes while the cameras stream; without it they wait for their scenes.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_drawing(
        configs: Vec<SyntheticConfig>,
        world_start: HostTime,
        drawing: Option<&Arc<Drawing>>,
    ) -> Result<Self> {
        let mut units: Vec<Arc<Unit>> = Vec::new();
        for config in configs {
            let unit = Unit::new(config, world_start, drawing.cloned())?;
            if units.iter().any(|u| u.info.serial == unit.info.serial) {
                let message = format!(
                    "two synthetic cameras have the serial number \"{}\"; give each its own",
                    unit.info.serial
                );
                return Err(Error::new(ErrorKind::BadInput, message));
            }
            units.push(Arc::new(unit));
        }
        Ok(Self { units })
    }

    /// Ground truth of the camera with this serial number.
    pub fn truth(&self, serial: &str) -> Option<SimTruth> {
        self.units.iter().find(|u| u.info.serial == serial).map(|u| SimTruth(Arc::clone(u)))
    }
}

impl Backend for SyntheticBackend {
    fn name(&self) -> &'static str {
        NAME
    }

    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let present = self.units.iter().filter(|u| SimTruth(Arc::clone(u)).is_present());
        Ok(present.map(|u| u.info.clone()).collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let known = || self.units.iter().map(|u| u.info.serial.as_str()).collect::<Vec<_>>().join(", ");
        let unit = match (serial, self.units.as_slice()) {
            (Some(serial), units) => units.iter().find(|u| u.info.serial == serial).ok_or_else(|| {
                format!(
                    "there is no synthetic camera with the serial number \"{serial}\"; there are: {}",
                    known()
                )
            }),
            (None, [one]) => Ok(one),
            (None, []) => Err("no synthetic camera is configured".to_owned()),
            (None, _) => {
                Err(format!("there are several synthetic cameras, so name one by its serial: {}", known()))
            }
        };
        let unit = unit.map_err(|message| Error::new(ErrorKind::NotFound, message))?;
        unit.open()?;
        Ok(Box::new(SyntheticDevice { hold: Hold(Arc::clone(unit)) }))
    }
}

/// The unit as long as a driver has it; letting go of it gives it back.
#[derive(Debug)]
struct Hold(Arc<Unit>);

impl Drop for Hold {
    fn drop(&mut self) {
        self.0.release();
    }
}

#[derive(Debug)]
struct SyntheticDevice {
    hold: Hold,
}

impl Device for SyntheticDevice {
    fn info(&self) -> &DeviceInfo {
        &self.hold.0.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.hold.0.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let unit = &self.hold.0;
        let config = &unit.config;
        let profiles = choose_profiles(&config.label(), &unit.profiles, requests)?;
        let mut sources = Vec::new();
        for p in &profiles {
            sources.push(if p.format.is_motion() {
                Source::Motion(Filler::default())
            } else if config.cheap {
                Source::Pattern(Pattern::new(config.seed, p.stream.as_str(), p.format, p.width, p.height))
            } else if let Some(drawing) = &unit.drawing {
                Source::Images(drawing.images(config, p)?)
            } else {
                Source::Images(render::images(config, p, &|_, _| ())?)
            });
        }
        let began = unit.begin_session(profiles.len());
        let boot = unit.state().boot;
        let streams = profiles.iter().zip(sources).enumerate().map(|(i, (p, source))| {
            let content = Content::of(&p.stream).unwrap_or(Content::Color);
            let motion = p.format.is_motion();
            let exposure_ns =
                if motion { 0 } else { unit.model.exposure_ns[usize::from(!content.is_color_view())] };
            StreamState {
                gate: Gate::new(i, p),
                queue: Queue::new(
                    i,
                    p.rate_hz,
                    exposure_ns,
                    config.ring_frames as usize,
                    &unit.timeline,
                    boot,
                    began,
                ),
                source,
                width: p.width,
                frame_bytes: p.frame_bytes(),
                has_strip: content == Content::Color && !motion,
                content,
                board: (!motion && !config.cheap).then(|| painter(config, p)).flatten(),
            }
        });
        let streams = streams.collect();
        let panel = Arc::new(Panel(Arc::clone(unit)));
        Ok(Box::new(SyntheticStream { streams, profiles, hold: self.hold, panel, is_gone: false }))
    }
}

/// Where the pixels of a stream come from, or its samples.
#[derive(Debug)]
enum Source {
    Pattern(Pattern),
    Images(Images),
    Motion(Filler),
}

/// One stream of a running camera.
#[derive(Debug)]
struct StreamState {
    gate: Gate,
    queue: Queue,
    source: Source,
    width: u32,
    frame_bytes: usize,
    has_strip: bool,
    content: Content,
    board: Option<Painter>,
}

#[derive(Debug)]
struct SyntheticStream {
    streams: Vec<StreamState>,
    profiles: Vec<StreamProfile>,
    hold: Hold,
    panel: Arc<Panel>,
    is_gone: bool,
}

impl Stream for SyntheticStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            let now = HostTime::now();
            if let Some(hang_until) = self.let_time_pass(now)? {
                // As a system call that does not return: the timeout means nothing to it.
                std::thread::sleep(hang_until.from_now());
                continue;
            }
            let mut any = false;
            while let Some((i, waiting)) = self.next_arrived(now) {
                self.hand_over(i, &waiting, sink);
                any = true;
            }
            if any {
                return Ok(Poll::Frame);
            }
            let now = HostTime::now();
            if now >= deadline {
                return Ok(Poll::Idle);
            }
            let unit = &self.hold.0;
            let next = self
                .streams
                .iter()
                .map(|l| l.queue.next_arrival(&unit.timeline))
                .chain(unit.state().next_fault());
            let wake = next.min().map_or(deadline, |t| t.min(deadline));
            std::thread::sleep(wake.from_now().min(NAP));
        }
    }

    fn controls(&self) -> Option<Weak<dyn ControlPanel>> {
        let panel = Arc::downgrade(&self.panel);
        Some(panel)
    }
}

impl SyntheticStream {
    /// Lets the device live until `now`: it exposes frames, and the faults that are due happen. Yields until
    /// when it hangs, if it does.
    fn let_time_pass(&mut self, now: HostTime) -> Result<Option<HostTime>> {
        loop {
            if self.is_gone {
                return Err(Error::new(
                    ErrorKind::Disconnected,
                    format!(
                        "{} was unplugged; plug it in again and open it anew",
                        self.hold.0.config.label()
                    ),
                ));
            }
            let unit = &self.hold.0;
            let mut state = unit.state();
            let due = state.take_due(now);
            let until = due.as_ref().map_or(now, |f| f.at);
            for stream in &mut self.streams {
                stream.queue.expose_until(until, &unit.timeline, state.boot);
            }
            let Some(fault) = due else { return Ok(None) };
            state.apply_to_unit(&fault);
            drop(state);
            match fault.kind {
                FaultKind::Unplug => self.is_gone = true,
                FaultKind::Hang => return Ok(Some(fault.until)),
                _ => self.streams.iter_mut().for_each(|stream| suffer(&mut stream.queue, &fault)),
            }
        }
    }

    /// Takes the frame that arrived first of all that have arrived.
    fn next_arrived(&mut self, now: HostTime) -> Option<(usize, Waiting)> {
        let first = |(i, l): (usize, &StreamState)| l.queue.front_arrival(now).map(|at| (at, i));
        let (_, i) = self.streams.iter().enumerate().filter_map(first).min()?;
        Some((i, self.streams[i].queue.pop()?))
    }

    /// Passes a frame through the gate, as a driver does with what its device sent.
    fn hand_over(&mut self, i: usize, waiting: &Waiting, sink: &mut dyn FrameSink) {
        let unit = &self.hold.0;
        let stream = &mut self.streams[i];
        let config = &unit.config;
        let pose = config.pose_at(unit.world_start, waiting.capture);
        let counted = match &mut stream.source {
            Source::Motion(filler) => filler.count(waiting.k, &waiting.boot),
            _ => waiting.k,
        };
        let sequence = counted & 0xFFFF_FFFF;
        let whole = stream.frame_bytes;
        let bytes = match waiting.fault {
            Some(FaultKind::HalfFrame) => whole / 2,
            Some(FaultKind::WrongSize) => whole + 64,
            _ => whole,
        };
        let mut raw = RawFrame::new(sequence, waiting.ticks, waiting.arrival, bytes);
        raw.damaged = waiting.fault == Some(FaultKind::Damaged);
        raw.exposure_ns = waiting.exposure_ns;
        let gain =
            if stream.content == Content::Color { unit.gain.load(Ordering::Relaxed) } else { *GAINS.start() };
        raw.gain = if matches!(stream.source, Source::Motion(_)) { 0.0 } else { gain as f32 };
        let warm_s = waiting.capture.since_ns(unit.world_start) as f32 * 1e-9;
        raw.temperature_c = 38.0 - 8.0 * (-warm_s / 300.0).exp();
        raw.flags = FrameFlags::SYNTHETIC;
        let Waiting { capture, arrival, fault, lost_before, .. } = *waiting;
        unit.state().book(SimFrame { stream: i, sequence, capture, arrival, pose, fault }, lost_before);
        let width = stream.width;
        let has_strip = stream.has_strip;
        let batch = Batch {
            k: waiting.k,
            boot: waiting.boot,
            capture,
            world_start: unit.world_start,
            drift_ppm: config.clock.drift_ppm,
        };
        let source = &mut stream.source;
        let board = &stream.board;
        let content = stream.content;
        stream.gate.deliver_timed(&raw, sink, |memory, meta| {
            match source {
                Source::Motion(filler) => filler.fill(&batch, meta, memory),
                Source::Pattern(pattern) => {
                    pattern.fill(sequence, memory);
                    gain::amplify(memory, gain);
                }
                Source::Images(images) => {
                    let image = images.get(pose);
                    if image.len() != memory.len() {
                        return Err(DropReason::WrongSize);
                    }
                    memory.copy_from_slice(image);
                    if let Some(board) = board {
                        let moment = Moment { world_start: unit.world_start, capture, frame: sequence };
                        match content {
                            Content::Color => board.color(memory, moment),
                            Content::Depth => board.depth(memory, unit.model, false, moment),
                            Content::DepthTrue | Content::DepthTrueColor => {
                                board.depth(memory, unit.model, true, moment);
                            }
                        }
                    }
                    gain::amplify(memory, gain);
                    if has_strip {
                        overlay::draw(memory, width, sequence as u32);
                    }
                }
            }
            Ok(())
        });
    }
}

/// The painter of the board into the images of a stream.
fn painter(config: &SyntheticConfig, p: &StreamProfile) -> Option<Painter> {
    let board = config.board.as_ref()?;
    let rays = Rays::new(&p.intrinsics, p.width, p.height);
    let sensor = config.true_pose().compose(&p.pose_in_device);
    let seed = noise::text_seed(config.seed, &config.serial_or_default());
    Some(Painter::new(board, rays, &sensor, seed))
}

/// Does what a fault does to the frames of one stream.
fn suffer(queue: &mut Queue, fault: &DueFault) {
    match fault.kind {
        FaultKind::Stall => queue.stall(fault.at, fault.until),
        FaultKind::HalfFrame
        | FaultKind::WrongSize
        | FaultKind::Damaged
        | FaultKind::Repeated
        | FaultKind::Skip => queue.spoil(fault.kind, fault.count),
        _ => {}
    }
}
