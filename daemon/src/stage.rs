//! Refined depth: a stage that makes streams of the bus into another one.
//!
//! ```text
//! stage thread   channels of colour and depth ─ pace ─ pairs ─▶ the newest pair of each camera; watches the refiners
//! refine threads one per refiner: depth into the view of colour, refine, publish depth_refined (and depth_aligned)
//! ```
//!
//! It is a subscriber like any other, so that nothing it does can hold up a camera, and its threads run below theirs.
//! Of each camera the newest pair wins; a pair that had to give way is counted. Cameras whose settings come to the same
//! refiner share it, in turn or in batches. Raw depth is never published as refined: after an error there are no frames
//! until the refiner is back, and `status` says why.
//!
//! Colour and depth are a pair when no colour frame lies nearer to the depth frame, and at most half a colour period and
//! a millisecond apart.

mod crew;
mod engines;
mod lane;
pub(crate) mod models;
mod pair;
pub(crate) mod pixels;
pub(crate) mod view;
pub(crate) mod worker;

pub use engines::{Installed, Opened, Plan, Refiners};
pub use lane::{Lane, Skip};

use crate::config::{CdmConfig, EngineChoice, RefineConfig};
use crate::status::RefineState;
use crate::wake::Wake;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use crew::Crew;
use depthrig_bus::{Frame, HostTime, PixelFormat, StreamName, Subscriber};
use depthrig_drivers::StreamProfile;
use depthrig_drivers::moments::{Pace, SetTimes};
use lane::Pair;
use pair::{Paired, Pairer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// The name of the stream of refined depth.
pub const REFINED: &str = "depth_refined";
/// The name of the stream of depth in the view of colour.
pub const ALIGNED: &str = "depth_aligned";

/// How long the stage thread sleeps at most: it watches refiners and looks for new cameras.
const LOOK: Duration = Duration::from_millis(20);
/// How long refiners get to end at least; they may be in the middle of a picture, and slow ones get twice their slowest.
const STOP_PATIENCE: Duration = Duration::from_millis(300);
/// How long the slowest of them gets.
const STOP_PATIENCE_MOST: Duration = Duration::from_secs(3);
/// A depth frame waits for its colour this many colour periods.
const COLOR_PERIODS: i64 = 3;

/// The way into the stage of a rig.
#[derive(Debug, Default)]
pub struct Entrance {
    /// Rung after every frame of a camera.
    pub bell: Arc<Wake>,
    /// Cameras that have opened, in the order in which they did.
    lanes: Mutex<Vec<Arc<Lane>>>,
    /// When frame sets are made.
    pub sets: Arc<SetTimes>,
}

impl Entrance {
    /// Lets a camera in.
    pub fn enter(&self, lane: Arc<Lane>) {
        self.lanes().push(lane);
        self.bell.raise();
    }

    fn lanes(&self) -> std::sync::MutexGuard<'_, Vec<Arc<Lane>>> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One camera at the stage thread.
struct Feed {
    lane: Arc<Lane>,
    color: Subscriber,
    depth: Subscriber,
    pace: Pace,
    pairer: Pairer<Frame>,
    /// Which crew refines it; none when it is switched off.
    crew: Option<usize>,
}

/// The stage of a rig.
pub struct Stage {
    entrance: Arc<Entrance>,
    refiners: Arc<dyn Refiners>,
    config: CdmConfig,
    /// Rung after each refined frame.
    frames: Arc<Wake>,
    /// Threads of all refiners together.
    threads: usize,
    feeds: Vec<Feed>,
    crews: Vec<Crew>,
    /// Lanes taken in so far.
    known: usize,
}

impl Stage {
    /// The stage behind `entrance`, of refiners out of `refiners`; `frames` is rung after each refined frame.
    pub fn new(
        entrance: Arc<Entrance>,
        refiners: Arc<dyn Refiners>,
        config: CdmConfig,
        frames: Arc<Wake>,
    ) -> Self {
        // Asked once: it reads files.
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let threads = if config.threads == 0 { cores.saturating_sub(1) } else { config.threads };
        let (feeds, crews) = (Vec::new(), Vec::new());
        Self { entrance, refiners, config, frames, threads, feeds, crews, known: 0 }
    }

    /// Runs until `stop` is set.
    pub fn run(mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            self.take_lanes();
            self.entrance.bell.wait(LOOK);
            let now = HostTime::now();
            for i in 0..self.feeds.len() {
                self.feed(i, now);
            }
            let threads = self.threads();
            for crew in &mut self.crews {
                crew.step(now, threads);
            }
        }
        let slowest = self.crews.iter().map(Crew::slowest).max().unwrap_or_default();
        let deadline = HostTime::now().plus((slowest * 2).clamp(STOP_PATIENCE, STOP_PATIENCE_MOST));
        self.crews.iter().for_each(Crew::request_stop);
        for crew in &mut self.crews {
            crew.stop(deadline);
        }
    }

    /// Threads of one refiner.
    fn threads(&self) -> usize {
        (self.threads / self.crews.len().max(1)).max(1)
    }

    /// Takes in the cameras that opened since the last look.
    fn take_lanes(&mut self) {
        let new: Vec<_> = self.entrance.lanes().iter().skip(self.known).cloned().collect();
        for lane in new {
            self.known += 1;
            let Some((color, depth)) = lane.work().readers.take() else { continue };
            let crew = self.crew_of(&lane);
            let period = lane.color_ns;
            // Frames of the slower of the two streams are all there is.
            let frame_ns = lane.frame_ns.max(period);
            let pace = Pace::new(lane.config.rate_hz, frame_ns);
            let pairer = Pairer::new(lane.tolerance_ns, COLOR_PERIODS * period);
            self.feeds.push(Feed { lane, color, depth, pace, pairer, crew });
        }
    }

    fn crew_of(&mut self, lane: &Arc<Lane>) -> Option<usize> {
        if lane.config.engine == EngineChoice::Off {
            lane.enter(RefineState::Off, Some("switched off in the rig file"));
            return None;
        }
        let plan = self.refiners.plan(&lane.config, &lane.device_model);
        if let Some(note) = &plan.note {
            tracing::warn!(camera = %lane.camera, "{note}");
        }
        lane.set_note(plan.note.as_deref());
        let at = self.crews.iter().position(|c| c.plan.is_as(&plan)).unwrap_or_else(|| {
            let (refiners, frames) = (Arc::clone(&self.refiners), Arc::clone(&self.frames));
            let patience = Duration::from_secs_f64(self.config.hang_s);
            self.crews.push(Crew::new(plan, refiners, frames, patience));
            self.crews.len() - 1
        });
        self.crews[at].add(Arc::clone(lane));
        Some(at)
    }

    /// Reads what came of a camera and offers what became a pair.
    fn feed(&mut self, i: usize, now: HostTime) {
        let Feed { lane, color, depth, pace, pairer, crew } = &mut self.feeds[i];
        let Some(crew) = *crew else {
            // Read all the same: a subscriber that does not would look as if it were too slow.
            while let Ok(Some(_)) = depth.try_next() {}
            while let Ok(Some(_)) = color.try_next() {}
            return;
        };
        let mut offered = false;
        let mut settle = |fate: Paired<Frame>| match fate {
            Paired::Pair { color, depth } => {
                lane.offer(Pair { color, depth, ready: now });
                offered = true;
            }
            Paired::Alone => lane.skip(Skip::NoColor),
        };
        while let Ok(Some(frame)) = depth.try_next() {
            let stamp = frame.header().capture_time_ns;
            if !pace.is_due(stamp, &self.entrance.sets) {
                lane.not_due();
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
            self.crews[crew].ring();
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
    let (color, depth) = (find("color")?, find(&refine.depth)?);
    let most = color.rate_hz.min(depth.rate_hz);
    let made = |name: &str, format: PixelFormat| -> Result<_> {
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
    let mut all = vec![(made(REFINED, refine.format)?, refine.record || listed(REFINED))];
    if refine.align {
        all.push((made(ALIGNED, PixelFormat::Z16)?, listed(ALIGNED)));
    }
    Ok(all)
}

/// Whether a stream of this name is made of others.
pub fn is_derived(stream: &StreamName) -> bool {
    [REFINED, ALIGNED].contains(&stream.as_str())
}
