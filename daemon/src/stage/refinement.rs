//! One camera's refined depth: its streams, the pair that waits for the engine, its accounts and its state.

use crate::status::{RefineState, RefineStatus};
use crate::stream::Stream;
use depthrig_bus::sync::lock;
use depthrig_bus::{CameraName, DropReason, Frame, HostTime, StageStep, Subscriber};
use depthrig_cdm::stage::{Correct, RefineConfig};
use std::sync::{Arc, Mutex, MutexGuard};

/// Frames over which the steps are measured.
const WINDOW: usize = 128;

/// One camera's refined depth.
#[derive(Debug)]
pub struct Refinement {
    /// The camera.
    pub camera: CameraName,
    /// How it is refined.
    pub config: RefineConfig,
    /// The device, as the model of the network is chosen by it.
    pub device_model: String,
    /// Refined depth.
    pub refined: Arc<Stream>,
    /// Depth in the view of colour, when that is published.
    pub aligned: Option<Arc<Stream>>,
    /// How depth is corrected first.
    pub correct: Option<Correct>,
    /// Colour and depth of one moment are at most this far apart, nanoseconds.
    pub tolerance_ns: i64,
    /// How depth frames follow each other, nanoseconds.
    pub frame_ns: i64,
    /// How colour frames do.
    pub color_ns: i64,
    work: Mutex<Work>,
    facts: Mutex<Facts>,
}

/// State shared by the thread that pairs and the one that refines.
#[derive(Debug, Default)]
pub struct Work {
    /// The ends of the channels of colour and depth, until the stage takes them. They are created before the camera's
    /// first frame: a publisher that sends while a subscriber is half made waits for it.
    pub readers: Option<Readers>,
    pending: Option<Pair>,
    /// A pair is in the hands of a worker.
    busy: bool,
}

/// The ends of the channels of a camera's colour and depth.
#[derive(Debug)]
pub struct Readers {
    /// Colour.
    pub color: Subscriber,
    /// Depth.
    pub depth: Subscriber,
}

/// Inputs of a refinement.
#[derive(Debug)]
pub struct Setup {
    /// The camera.
    pub camera: CameraName,
    /// The device, as the model of the network is chosen by it.
    pub device_model: String,
    /// How it is refined.
    pub config: RefineConfig,
    /// Refined depth.
    pub refined: Arc<Stream>,
    /// Depth in the view of colour, when that is published.
    pub aligned: Option<Arc<Stream>>,
    /// How depth is corrected first; `None`: not at all.
    pub correct: Option<Correct>,
    /// Time between colour frames, nanoseconds.
    pub color_ns: i64,
    /// Time between depth frames, nanoseconds.
    pub frame_ns: i64,
    /// Colour and depth of one moment are at most this far apart, nanoseconds.
    pub tolerance_ns: i64,
    /// The source channels.
    pub readers: Readers,
}

/// Colour and depth of one moment.
#[derive(Debug)]
pub struct Pair {
    /// Colour.
    pub color: Frame,
    /// Depth.
    pub depth: Frame,
    /// When both were there.
    pub ready: HostTime,
}

/// Why a pair of images was not refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Skip {
    /// A newer one came before the engine was free.
    Busy,
    /// No colour frame lies near enough to the depth frame.
    NoColor,
    /// Depth cannot be put into the view of colour, or the images are of no use.
    Unfit,
    /// The engine failed on it.
    Engine,
    /// The engine hangs with it.
    Hung,
    /// Subscribers hold every slot.
    NoSlot,
}

impl Skip {
    /// Every reason.
    pub const ALL: [Self; 6] =
        [Self::Busy, Self::NoColor, Self::Unfit, Self::Engine, Self::Hung, Self::NoSlot];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Busy => "busy",
            Self::NoColor => "no_color",
            Self::Unfit => "unfit",
            Self::Engine => "engine",
            Self::Hung => "hung",
            Self::NoSlot => "no_slot",
        }
    }

    /// How it stands in the accounts of the stream.
    pub const fn reason(self) -> DropReason {
        match self {
            Self::Busy => DropReason::QueueFull,
            Self::NoColor => DropReason::Incomplete,
            Self::Unfit => DropReason::WrongSize,
            Self::Engine => DropReason::DeviceError,
            Self::Hung => DropReason::Abandoned,
            Self::NoSlot => DropReason::NoSlot,
        }
    }
}

/// Present state and counters.
#[derive(Debug)]
struct Facts {
    /// Of its engine.
    state: RefineState,
    since: HostTime,
    message: Option<String>,
    /// Why this camera alone cannot be refined although its engine runs.
    obstacle: Option<String>,
    /// How it differs from the settings, though it runs.
    note: Option<String>,
    /// Why this engine was chosen for it.
    plan_note: Option<String>,
    engine: String,
    model: String,
    skipped: [u64; Skip::ALL.len()],
    /// Depth frames beyond the rate.
    not_due: u64,
    /// Its engine failed and does not run again yet.
    has_failed: bool,
    restarts: u64,
    steps: [[u64; StageStep::ALL.len()]; WINDOW],
    /// Frames in `steps` so far.
    measured: usize,
}

impl Refinement {
    /// A refinement whose engine has not started.
    pub fn new(setup: Setup) -> Self {
        let Setup {
            camera,
            device_model,
            config,
            refined,
            aligned,
            correct,
            color_ns,
            frame_ns,
            tolerance_ns,
            readers,
        } = setup;
        let facts = Facts {
            state: RefineState::Starting,
            since: HostTime::now(),
            message: None,
            obstacle: None,
            note: None,
            plan_note: None,
            engine: String::new(),
            model: String::new(),
            skipped: [0; Skip::ALL.len()],
            not_due: 0,
            has_failed: false,
            restarts: 0,
            steps: [[0; StageStep::ALL.len()]; WINDOW],
            measured: 0,
        };
        let work = Work { readers: Some(readers), ..Work::default() };
        let work = Mutex::new(work);
        let facts = Mutex::new(facts);
        Self {
            camera,
            config,
            device_model,
            refined,
            aligned,
            correct,
            tolerance_ns,
            frame_ns,
            color_ns,
            work,
            facts,
        }
    }

    /// Width and height of the images that it refines.
    pub fn image_size(&self) -> (usize, usize) {
        (self.refined.profile.width as usize, self.refined.profile.height as usize)
    }

    /// Its streams.
    pub fn streams(&self) -> impl Iterator<Item = &Arc<Stream>> {
        core::iter::once(&self.refined).chain(&self.aligned)
    }

    /// The state shared by the two threads.
    pub fn work(&self) -> MutexGuard<'_, Work> {
        lock(&self.work)
    }

    fn facts(&self) -> MutexGuard<'_, Facts> {
        lock(&self.facts)
    }

    /// Puts a pair where the engine finds it; an older one that is still there is skipped.
    pub fn offer(&self, pair: Pair) {
        let older = self.work().pending.replace(pair);
        if older.is_some() {
            self.skip(Skip::Busy);
        }
    }

    /// The newest pair, to be refined now.
    pub fn take(&self) -> Option<Pair> {
        let mut work = self.work();
        let pair = work.pending.take();
        work.busy |= pair.is_some();
        pair
    }

    /// Whether a pair waits.
    pub fn has_work(&self) -> bool {
        self.work().pending.is_some()
    }

    /// The pair in work is refined or skipped.
    pub fn finished(&self) {
        self.work().busy = false;
    }

    /// Gives up a pair that is in the hands of a worker that hangs.
    pub fn abandon(&self) {
        let was = core::mem::take(&mut self.work().busy);
        for stream in self.streams() {
            // Later reports of that worker are ignored.
            stream.books().begin_session();
        }
        if was {
            self.skip(Skip::Hung);
        }
    }

    /// Lets go of the frames that wait: nobody will refine them.
    pub fn clear(&self) {
        let waiting = self.work().pending.take();
        if waiting.is_some() {
            self.skip(Skip::Busy);
        }
    }

    /// Counts a pair that is not refined. `captured` counts pairs with a known fate, so that the accounts balance.
    pub fn skip(&self, why: Skip) {
        self.facts().skipped[why as usize] += 1;
        let mut books = self.refined.books();
        books.captured += 1;
        books.dropped.add(why.reason(), 1);
    }

    /// Counts a depth frame beyond the rate.
    pub fn not_due(&self) {
        self.facts().not_due += 1;
    }

    /// Notes how long the steps of a published frame took, nanoseconds.
    pub fn measured(&self, steps: [u64; StageStep::ALL.len()]) {
        let mut facts = self.facts();
        let at = facts.measured % WINDOW;
        facts.steps[at] = steps;
        facts.measured += 1;
    }

    /// Enters a state of its engine.
    pub fn enter(&self, state: RefineState, message: Option<&str>) {
        let mut facts = self.facts();
        if facts.state != state {
            facts.since = HostTime::now();
        }
        match state {
            RefineState::Failed => facts.has_failed = true,
            RefineState::Running => facts.restarts += u64::from(core::mem::take(&mut facts.has_failed)),
            RefineState::Starting | RefineState::Off => {}
        }
        facts.state = state;
        facts.message = message.map(str::to_owned);
    }

    /// Notes why the engine is not the expected one.
    pub fn set_note(&self, note: Option<&str>) {
        self.facts().plan_note = note.map(str::to_owned);
    }

    /// Notes the running engine, and how it differs from the settings.
    pub fn runs(&self, engine: &str, model: &str, note: Option<&str>) {
        let mut facts = self.facts();
        (facts.engine, facts.model) = (engine.to_owned(), model.to_owned());
        facts.note = note.map(str::to_owned);
    }

    /// Whether this camera can be refined at all, and why not. Said in the log when it changes.
    pub fn obstacle(&self, why: Option<&str>) {
        let mut facts = self.facts();
        if facts.obstacle.as_deref() == why {
            return;
        }
        if let Some(why) = why {
            tracing::error!(camera = %self.camera, "no refined depth: {why}");
        } else {
            tracing::info!(camera = %self.camera, "depth is refined again");
        }
        facts.since = HostTime::now();
        facts.obstacle = why.map(str::to_owned);
    }

    /// Where its engine stands.
    pub fn state(&self) -> RefineState {
        self.facts().state
    }

    /// Everything there is to know of it.
    pub fn status(&self) -> RefineStatus {
        let rate_hz = self.refined.books().rate_hz(HostTime::now());
        let facts = self.facts();
        let blocked = facts.obstacle.is_some() && facts.state == RefineState::Running;
        let newest = &facts.steps[..facts.measured.min(WINDOW)];
        let quantile = |step: StageStep, q: f64| {
            let mut all: Vec<u64> = newest.iter().map(|s| s[step as usize]).collect();
            let at = (all.len().saturating_sub(1) as f64 * q).round() as usize;
            if all.is_empty() { 0.0 } else { *all.select_nth_unstable(at).1 as f64 / 1e6 }
        };
        let skipped = Skip::ALL.iter().map(|s| (s.name().to_owned(), facts.skipped[*s as usize]));
        let steps = |q| StageStep::ALL.iter().map(|s| (s.name().to_owned(), quantile(*s, q))).collect();
        RefineStatus {
            state: if blocked { RefineState::Failed } else { facts.state },
            state_for_s: facts.since.elapsed().as_secs_f64(),
            message: if blocked {
                facts.obstacle.clone()
            } else {
                facts.message.clone().or_else(|| facts.note.clone()).or_else(|| facts.plan_note.clone())
            },
            engine: facts.engine.clone(),
            model: facts.model.clone(),
            nominal_hz: self.refined.profile.rate_hz,
            rate_hz,
            skipped: skipped.filter(|(_, n)| *n > 0).collect(),
            not_due: facts.not_due,
            restarts: facts.restarts,
            steps_p50_ms: steps(0.5),
            steps_p99_ms: steps(0.99),
        }
    }
}
