//! One refiner under supervision: opened on its own thread, watched, given up when it hangs, opened again after an error.

use super::refinement::Refinement;
use super::worker::{Shared, Worker};
use crate::priority;
use crate::status::RefineState;
use crate::wake::Wake;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use depthrig_cdm::stage::{Opened, Plan, Refiners, warm_up};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

/// The pause before a refiner that failed is opened again; it doubles up to the second.
const BACKOFF: (Duration, Duration) = (Duration::from_secs(1), Duration::from_mins(1));
/// A worker may take this many times longer than it ever took.
const SLOWER: u64 = 10;
/// Before its first result it may take this many times `hang_s`: engines compile networks then.
const FIRST: u32 = 30;
/// Workers that hang are left behind, and each keeps its memory; after so many the refiner is not started again.
const MAX_HUNG: u32 = 3;

/// Result of a worker thread.
type Ended = Arc<Mutex<Option<Result<(), String>>>>;

/// A worker thread.
struct Running {
    thread: JoinHandle<()>,
    shared: Arc<Shared>,
    ended: Ended,
}

/// A refiner and the cameras that it serves.
pub struct RefinerSupervisor {
    /// The refiner to run.
    pub plan: Plan,
    refinements: Vec<Arc<Refinement>>,
    refiners: Arc<dyn Refiners>,
    frames: Arc<Wake>,
    timeout: Duration,
    running: Option<Running>,
    state: RefineState,
    retry_at: HostTime,
    backoff: Duration,
    hung: u32,
}

impl RefinerSupervisor {
    /// A supervisor without a camera. `frames` is raised after each frame, and a worker without an answer for `timeout`
    /// is given up.
    pub fn new(plan: Plan, refiners: Arc<dyn Refiners>, frames: Arc<Wake>, timeout: Duration) -> Self {
        Self {
            plan,
            refinements: Vec::new(),
            refiners,
            frames,
            timeout,
            running: None,
            state: RefineState::Starting,
            retry_at: HostTime::from_ns(0),
            backoff: BACKOFF.0,
            hung: 0,
        }
    }

    /// Takes a camera in.
    pub fn add(&mut self, refinement: Arc<Refinement>) {
        refinement.enter(self.state, None);
        if let Some(running) = &self.running {
            lock(&running.shared.refinements).push(Arc::clone(&refinement));
        }
        self.refinements.push(refinement);
    }

    /// Wakes the worker because a pair is there.
    pub fn wake(&self) {
        if let Some(running) = &self.running {
            running.shared.wake.raise();
        }
    }

    /// Looks after the worker. Never waits for it.
    pub fn step(&mut self, now: HostTime, threads: usize) {
        let Some(running) = &self.running else {
            if now >= self.retry_at && self.hung < MAX_HUNG {
                self.start(now, threads);
            }
            return;
        };
        if running.thread.is_finished() {
            let ended = lock(&running.ended).take();
            self.running = None;
            match ended {
                Some(Ok(())) => {}
                Some(Err(why)) => self.fail(now, &why),
                None => self.fail(now, "its thread panicked"),
            }
            return;
        }
        let since = running.shared.busy_since.load(Ordering::Relaxed);
        let slowest = running.shared.slowest_ns.load(Ordering::Relaxed);
        if self.state == RefineState::Starting && running.shared.open.load(Ordering::Relaxed) {
            self.enter(RefineState::Running, None);
        }
        // One that fails at its first image again and again is not to be tried every second.
        if slowest > 0 {
            self.backoff = BACKOFF.0;
        }
        let limit = if slowest == 0 {
            self.timeout * FIRST
        } else {
            self.timeout.max(Duration::from_nanos(slowest.saturating_mul(SLOWER)))
        };
        let busy = Duration::from_nanos(now.ns().saturating_sub(since).max(0) as u64);
        if since != 0 && busy > limit {
            self.give_up(now, busy);
        }
    }

    /// Asks the worker to end, without waiting.
    pub fn request_stop(&self) {
        if let Some(running) = &self.running {
            running.shared.stop.store(true, Ordering::Relaxed);
            running.shared.wake.raise();
        }
    }

    /// The longest that work on a batch has taken so far.
    pub fn slowest(&self) -> Duration {
        let slowest = self.running.as_ref().map_or(0, |r| r.shared.slowest_ns.load(Ordering::Relaxed));
        Duration::from_nanos(slowest)
    }

    /// Waits for the worker's end until `deadline`; one that does not answer is left behind.
    pub fn stop(&mut self, deadline: HostTime) {
        let Some(running) = self.running.take() else { return };
        while !running.thread.is_finished() && !deadline.from_now().is_zero() {
            std::thread::sleep(Duration::from_millis(2));
        }
        if running.thread.is_finished() {
            if running.thread.join().is_err() {
                tracing::error!("the thread of a refiner panicked");
            }
        } else {
            tracing::warn!(refiner = self.plan.describe(), "it is busy; its thread is left behind");
            self.refinements.iter().for_each(|refinement| refinement.abandon());
        }
        self.refinements.iter().for_each(|refinement| refinement.clear());
    }

    fn start(&mut self, now: HostTime, threads: usize) {
        let shared = Arc::new(Shared::default());
        let ended = Ended::default();
        // Opening counts as work: it may hang like any other.
        shared.busy_since.store(now.ns().max(1), Ordering::Relaxed);
        let theirs = Arc::clone(&shared);
        let result = Arc::clone(&ended);
        let plan = self.plan.clone();
        let refiners = Arc::clone(&self.refiners);
        let frames = Arc::clone(&self.frames);
        lock(&shared.refinements).extend(self.refinements.iter().cloned());
        let run = move || {
            // Before the engine makes threads of its own, which inherit it.
            priority::lower_current_thread();
            let opened = refiners.open(&plan, threads).map_err(|e| e.to_string());
            let opened = opened.and_then(|mut opened| {
                let sizes: Vec<_> = lock(&theirs.refinements).iter().map(|r| r.image_size()).collect();
                warm_up(&mut *opened.refiner, &sizes).map_err(|e| e.to_string())?;
                Ok(opened)
            });
            let worked = opened.and_then(|Opened { refiner, note }| {
                let description = refiner.describe().clone();
                tracing::info!(
                    engine = description.engine,
                    model = description.model,
                    "a refiner of depth is ready"
                );
                if let Some(note) = &note {
                    tracing::warn!("{note}");
                }
                theirs.busy_since.store(0, Ordering::Relaxed);
                theirs.open.store(true, Ordering::Relaxed);
                Worker::new(theirs, refiner, note, frames).run().map_err(|e| e.to_string())
            });
            *lock(&result) = Some(worked);
        };
        self.enter(RefineState::Starting, None);
        match std::thread::Builder::new().name("refine".into()).spawn(run) {
            Ok(thread) => self.running = Some(Running { thread, shared, ended }),
            Err(e) => self.fail(now, &format!("its thread could not be started: {e}")),
        }
    }

    fn fail(&mut self, now: HostTime, why: &str) {
        let pause = self.backoff;
        self.backoff = (self.backoff * 2).min(BACKOFF.1);
        self.retry_at = now.plus(pause);
        let message = format!("{why}; tried again in {:.0} s", pause.as_secs_f64());
        tracing::error!(refiner = self.plan.describe(), "no refined depth: {message}");
        self.enter(RefineState::Failed, Some(&message));
    }

    fn give_up(&mut self, now: HostTime, busy: Duration) {
        let Some(running) = self.running.take() else { return };
        running.shared.stop.store(true, Ordering::Relaxed);
        self.refinements.iter().for_each(|refinement| refinement.abandon());
        self.hung += 1;
        let why = format!("{} hangs for {:.1} s", self.plan.describe(), busy.as_secs_f64());
        if self.hung < MAX_HUNG {
            self.fail(now, &why);
        } else {
            let why = format!("{why}, for the {MAX_HUNG}rd time; it is not tried again, restart the daemon");
            tracing::error!("no refined depth: {why}");
            self.enter(RefineState::Failed, Some(&why));
        }
    }

    fn enter(&mut self, state: RefineState, message: Option<&str>) {
        self.state = state;
        self.refinements.iter().for_each(|refinement| refinement.enter(state, message));
    }
}
