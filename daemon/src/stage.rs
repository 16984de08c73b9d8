//! Refined depth: a stage that makes streams of the bus into another one.
//!
//! ```text
//! stage thread   channels of colour and depth ─ rate ─ pairs ─▶ the newest pair of each camera; watches the refiners
//! refine threads one per refiner: depth into the view of colour, refine, publish depth_refined (and depth_aligned)
//! ```
//!
//! It is a subscriber like any other, so that nothing it does can hold up a camera, and its threads run below theirs.
//! Of each camera the newest pair wins; superseded pairs are counted. Cameras whose settings select the same
//! refiner share it, in turn or in batches. Raw depth is never published as refined: after an error there are no frames
//! until the refiner is back, and `status` says why.
//!
//! Colour and depth are a pair when no colour frame lies nearer to the depth frame, and at most half a colour period and
//! a millisecond apart.

mod pair;
mod refinement;
mod supervisor;
mod worker;

pub use refinement::{Readers, Refinement, Setup, Skip};

use crate::status::RefineState;
use crate::wake::Wake;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{Frame, HostTime, PixelFormat, StreamName, Subscriber};
use depthrig_cdm::stage::{ALIGNED, REFINED, Refiners, pixels};
use depthrig_cdm::stage::{CdmConfig, EngineChoice, RefineConfig};
use depthrig_driver::StreamProfile;
use depthrig_driver::moments::{FrameSchedule, SetTimes};
use pair::{Paired, Pairer};
use refinement::Pair;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use supervisor::RefinerSupervisor;

/// How long the stage thread sleeps at most: it watches refiners and looks for new cameras.
const LOOK: Duration = Duration::from_millis(20);
/// How long refiners get to end at least; they may be in the middle of an image, and slow ones get twice their slowest.
const STOP_TIMEOUT: Duration = Duration::from_millis(300);
/// How long the slowest of them gets.
const STOP_TIMEOUT_MOST: Duration = Duration::from_secs(3);
/// A depth frame waits for its colour this many colour periods.
const COLOR_PERIODS: i64 = 3;

/// Queue of cameras for the stage of a rig.
#[derive(Debug, Default)]
pub struct Intake {
    /// Raised after every frame of a camera.
    pub wake: Arc<Wake>,
    /// Cameras that have opened, in the order in which they did.
    refinements: Mutex<Vec<Arc<Refinement>>>,
    /// When frame sets are assembled.
    pub sets: Arc<SetTimes>,
}

impl Intake {
    /// Adds a camera.
    pub fn add(&self, refinement: Arc<Refinement>) {
        self.refinements().push(refinement);
        self.wake.raise();
    }

    fn refinements(&self) -> std::sync::MutexGuard<'_, Vec<Arc<Refinement>>> {
        lock(&self.refinements)
    }
}

/// One camera at the stage thread.
struct Feed {
    refinement: Arc<Refinement>,
    color: Subscriber,
    depth: Subscriber,
    schedule: FrameSchedule,
    pairer: Pairer<Frame>,
    /// Which supervisor refines it; `None` when it is switched off.
    supervisor: Option<usize>,
}

/// The stage of a rig.
pub struct Stage {
    intake: Arc<Intake>,
    refiners: Arc<dyn Refiners>,
    config: CdmConfig,
    /// Raised after each refined frame.
    frames: Arc<Wake>,
    /// Threads of all refiners together.
    threads: usize,
    feeds: Vec<Feed>,
    supervisors: Vec<RefinerSupervisor>,
    /// Cameras taken in so far.
    known: usize,
}

impl Stage {
    /// The stage behind `intake`, of refiners out of `refiners`; `frames` is raised after each refined frame.
    pub fn new(
        intake: Arc<Intake>,
        refiners: Arc<dyn Refiners>,
        config: CdmConfig,
        frames: Arc<Wake>,
    ) -> Self {
        // Asked once: it reads files.
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let threads = if config.threads == 0 { cores.saturating_sub(1) } else { config.threads };
        let feeds = Vec::new();
        let supervisors = Vec::new();
        Self { intake, refiners, config, frames, threads, feeds, supervisors, known: 0 }
    }

    /// Runs until `stop` is set.
    pub fn run(mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            self.take_refinements();
            self.intake.wake.wait(LOOK);
            let now = HostTime::now();
            for i in 0..self.feeds.len() {
                self.feed(i, now);
            }
            let threads = self.threads();
            for supervisor in &mut self.supervisors {
                supervisor.step(now, threads);
            }
        }
        let slowest = self.supervisors.iter().map(RefinerSupervisor::slowest).max().unwrap_or_default();
        let deadline = HostTime::now().plus((slowest * 2).clamp(STOP_TIMEOUT, STOP_TIMEOUT_MOST));
        self.supervisors.iter().for_each(RefinerSupervisor::request_stop);
        for supervisor in &mut self.supervisors {
            supervisor.stop(deadline);
        }
    }

    /// Threads of one refiner.
    fn threads(&self) -> usize {
        (self.threads / self.supervisors.len().max(1)).max(1)
    }

    /// Takes in the cameras that opened since the last look.
    fn take_refinements(&mut self) {
        let new: Vec<_> = self.intake.refinements().iter().skip(self.known).cloned().collect();
        for refinement in new {
            self.known += 1;
            let Some(Readers { color, depth }) = refinement.work().readers.take() else { continue };
            let supervisor = self.supervisor_of(&refinement);
            let period = refinement.color_ns;
            // Frames of the slower of the two streams are all there is.
            let frame_ns = refinement.frame_ns.max(period);
            let schedule = FrameSchedule::new(refinement.config.rate_hz, frame_ns);
            let pairer = Pairer::new(refinement.tolerance_ns, COLOR_PERIODS * period);
            self.feeds.push(Feed { refinement, color, depth, schedule, pairer, supervisor });
        }
    }

    fn supervisor_of(&mut self, refinement: &Arc<Refinement>) -> Option<usize> {
        if refinement.config.engine == EngineChoice::Off {
            refinement.enter(RefineState::Off, Some("switched off in the rig file"));
            return None;
        }
        let plan = self.refiners.plan(&refinement.config, &refinement.device_model);
        if let Some(note) = &plan.note {
            tracing::warn!(camera = %refinement.camera, "{note}");
        }
        refinement.set_note(plan.note.as_deref());
        let at = self.supervisors.iter().position(|c| c.plan.is_as(&plan)).unwrap_or_else(|| {
            let refiners = Arc::clone(&self.refiners);
            let frames = Arc::clone(&self.frames);
            let timeout = Duration::from_secs_f64(self.config.hang_s);
            self.supervisors.push(RefinerSupervisor::new(plan, refiners, frames, timeout));
            self.supervisors.len() - 1
        });
        self.supervisors[at].add(Arc::clone(refinement));
        Some(at)
    }

    /// Reads new frames of a camera and offers new pairs.
    fn feed(&mut self, i: usize, now: HostTime) {
        let Feed { refinement, color, depth, schedule, pairer, supervisor } = &mut self.feeds[i];
        let Some(supervisor) = *supervisor else {
            // Read all the same: a subscriber that does not would look as if it were too slow.
            while let Ok(Some(_)) = depth.try_next() {}
            while let Ok(Some(_)) = color.try_next() {}
            return;
        };
        let mut offered = false;
        let mut settle = |fate: Paired<Frame>| match fate {
            Paired::Pair { color, depth } => {
                refinement.offer(Pair { color, depth, ready: now });
                offered = true;
            }
            Paired::Alone => refinement.skip(Skip::NoColor),
        };
        while let Ok(Some(frame)) = depth.try_next() {
            let stamp = frame.header().capture_time_ns;
            if !schedule.is_due(stamp, &self.intake.sets) {
                refinement.not_due();
            } else if let Some(fate) = pairer.depth(stamp, now.ns(), frame) {
                settle(fate);
            }
        }
        while let Ok(Some(frame)) = color.try_next() {
            pairer.color(frame.header().capture_time_ns, frame);
            while let Some(fate) = pairer.poll(now.ns()) {
                settle(fate);
            }
        }
        while let Some(fate) = pairer.poll(now.ns()) {
            settle(fate);
        }
        if offered {
            self.supervisors[supervisor].wake();
        }
    }
}

/// The streams that a camera with these settings makes of its streams `color` and `depth`, and which of them are recorded:
/// those that the settings say or that are among `listed`.
///
/// # Errors
/// `BadInput` when one of the two is missing.
pub fn profiles(
    refine: Option<&RefineConfig>,
    listed: Option<&[StreamName]>,
    profiles: &[StreamProfile],
) -> Result<Vec<(StreamProfile, bool)>> {
    let Some(refine) = refine else { return Ok(Vec::new()) };
    let find = |name: &str| {
        profiles.iter().find(|p| p.stream.as_str() == name).ok_or_else(|| {
            let has: Vec<_> = profiles.iter().map(|p| p.stream.to_string()).collect();
            let text = format!(
                "[camera.refine] needs the streams color and {}; it has {}: ask for both in [[camera.stream]] tables, \
                 or remove [camera.refine]",
                refine.depth,
                has.join(", ")
            );
            Error::new(ErrorKind::BadInput, text)
        })
    };
    let color = find("color")?;
    let depth = find(&refine.depth)?;
    let most = color.rate_hz.min(depth.rate_hz);
    let profile = |name: &str, format: PixelFormat| -> Result<_> {
        Ok(StreamProfile {
            stream: StreamName::new(name)?,
            format,
            width: color.width,
            height: color.height,
            rate_hz: if refine.rate_hz > 0.0 { refine.rate_hz.min(most) } else { most },
            depth_unit_m: match (format, depth.format) {
                (PixelFormat::DepthF32, _) => 1.0,
                (_, PixelFormat::DepthF32) => pixels::UNIT_OF_METRES,
                _ => depth.depth_unit_m,
            },
            intrinsics: color.intrinsics,
            pose_in_device: color.pose_in_device,
            ..depth.clone()
        })
    };
    let listed = |name: &str| listed.unwrap_or_default().iter().any(|r| r.as_str() == name);
    let mut all = vec![(profile(REFINED, refine.format)?, refine.record || listed(REFINED))];
    if refine.align {
        all.push((profile(ALIGNED, PixelFormat::Z16)?, listed(ALIGNED)));
    }
    Ok(all)
}
