//! The thread of one refiner: takes the newest pairs of its cameras in turn, refines them, publishes the results.
//!
//! Nothing is allocated per frame once every camera has had one, except the counter that iceoryx2 makes for each slot
//! that it lends: scratch memory is kept, and pixels are written where subscribers read them.

use super::refinement::{Pair, Refinement, Skip};
use crate::stream::Stream;
use crate::wake::Wake;
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{FrameFlags, FrameHeader, FrameMut, HostTime, PixelFormat, Publisher, StageStep};
use depthrig_cdm::stage::{View, derived_header, pixels};
use depthrig_cdm::{Color, Error, ErrorKind, Job, Output, RawDepth, Refiner, StepTimes};
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// How long an idle worker sleeps at most.
const IDLE: Duration = Duration::from_millis(100);
/// Pairs of one batch at most.
pub const MAX_BATCH: usize = 8;
/// State that a worker shares with its supervisor. Each worker has its own, so that one that was given up can
/// do no harm.
#[derive(Debug, Default)]
pub struct Shared {
    /// Raised when a pair or a camera is there.
    pub wake: Wake,
    /// Ends the worker after the work in hand.
    pub stop: AtomicBool,
    /// The refiner is ready.
    pub open: AtomicBool,
    /// The cameras; the worker takes in those that are new.
    pub refinements: Mutex<Vec<Arc<Refinement>>>,
    /// When the work in hand began, nanoseconds of the host clock; 0 without work.
    pub busy_since: AtomicI64,
    /// The longest that work on a batch has taken, nanoseconds; 0 before the first was done.
    pub slowest_ns: AtomicU64,
}

impl Shared {
    fn begin(&self) {
        self.busy_since.store(HostTime::now().ns().max(1), Ordering::Relaxed);
    }

    fn end(&self) {
        let since = self.busy_since.swap(0, Ordering::Relaxed);
        let took = HostTime::now().ns().saturating_sub(since).max(1) as u64;
        self.slowest_ns.fetch_max(took, Ordering::Relaxed);
    }
}

/// One camera at the worker.
struct WorkerCamera {
    refinement: Arc<Refinement>,
    view: View,
    session: u64,
    aligned_session: u64,
    /// The clock map of the last frame that was published.
    epoch: Option<u32>,
}

/// A pair in work.
struct InWork {
    camera: usize,
    pair: Pair,
    out: FrameMut,
    publisher: Arc<Publisher>,
    unit_m: f64,
    began: HostTime,
    register_ns: u64,
}

/// The worker.
pub struct Worker {
    shared: Arc<Shared>,
    refiner: Box<dyn Refiner>,
    /// How the refiner differs from the settings.
    note: Option<String>,
    /// Raised after each frame: the set thread's.
    frames: Arc<Wake>,
    batch: usize,
    cameras: Vec<WorkerCamera>,
    /// The camera whose turn is next.
    turn: usize,
    work: Vec<InWork>,
    steps: Vec<StepTimes>,
    /// Empty; kept for its memory.
    jobs: Vec<Job<'static>>,
}

impl Worker {
    /// A worker of `refiner`; `note` states how it differs from the settings.
    pub fn new(
        shared: Arc<Shared>,
        refiner: Box<dyn Refiner>,
        note: Option<String>,
        frames: Arc<Wake>,
    ) -> Self {
        let batch = refiner.best_batch().clamp(1, MAX_BATCH);
        Self {
            shared,
            refiner,
            note,
            frames,
            batch,
            cameras: Vec::new(),
            turn: 0,
            work: Vec::with_capacity(batch),
            steps: Vec::with_capacity(batch),
            jobs: Vec::with_capacity(batch),
        }
    }

    /// Works until it is stopped or the refiner fails.
    ///
    /// # Errors
    /// The refiner's.
    pub fn run(mut self) -> Result<(), Error> {
        while !self.shared.stop.load(Ordering::Relaxed) {
            self.take_cameras();
            self.shared.begin();
            self.collect();
            if self.work.is_empty() {
                self.shared.busy_since.store(0, Ordering::Relaxed);
                self.shared.wake.wait(IDLE);
                continue;
            }
            let mut done = self.refine();
            if done.as_ref().is_err_and(is_of_an_image) {
                done = self.refine_one_by_one();
            }
            self.publish(done.is_ok());
            self.shared.end();
            done?;
        }
        Ok(())
    }

    fn take_cameras(&mut self) {
        let refinements = lock(&self.shared.refinements);
        for refinement in refinements.iter().skip(self.cameras.len()) {
            let description = self.refiner.describe();
            refinement.runs(&description.engine, &description.model, self.note.as_deref());
            let session = refinement.refined.books().begin_session();
            let aligned_session = refinement.aligned.as_ref().map_or(0, |s| s.books().begin_session());
            let view = View::corrected_by(refinement.correct.clone());
            self.cameras.push(WorkerCamera {
                refinement: Arc::clone(refinement),
                view,
                session,
                aligned_session,
                epoch: None,
            });
        }
    }

    /// Takes pairs, one of each camera at most, beginning with the one whose turn it is.
    fn collect(&mut self) {
        let cameras = self.cameras.len();
        for i in 0..cameras {
            if self.work.len() == self.batch {
                break;
            }
            let at = (self.turn + i) % cameras;
            let camera = &mut self.cameras[at];
            let Some(pair) = camera.refinement.take() else { continue };
            match camera.prepare(at, pair) {
                Ok(work) => self.work.push(work),
                Err(why) => camera.finished(Some(why)),
            }
        }
        // Whoever was served last comes last.
        if let Some(last) = self.work.last() {
            self.turn = (last.camera + 1) % cameras.max(1);
        }
    }

    fn refine(&mut self) -> Result<(), Error> {
        let Self { refiner, cameras, work, steps, jobs, .. } = self;
        let mut list: Vec<Job<'_>> = recycle(core::mem::take(jobs));
        let listed = work.iter_mut().try_for_each(|w| w.job(&cameras[w.camera]).map(|job| list.push(job)));
        let done = listed.and_then(|()| refiner.refine(&mut list));
        steps.clear();
        steps.extend(list.iter().map(|j| j.steps));
        *jobs = recycle(list);
        done
    }

    /// Refines one by one the pairs of a batch that the refiner refused. The images of one camera must not cost the
    /// others theirs: only pairs that are refused alone, too, leave the work.
    fn refine_one_by_one(&mut self) -> Result<(), Error> {
        let Self { refiner, cameras, work, steps, .. } = self;
        steps.clear();
        let mut at = 0;
        while let Some(w) = work.get_mut(at) {
            let camera = &cameras[w.camera];
            let done = w.job(camera).and_then(|mut job| {
                refiner.refine(core::slice::from_mut(&mut job))?;
                Ok(job.steps)
            });
            match done {
                Ok(took) => {
                    steps.push(took);
                    at += 1;
                }
                Err(e) if is_of_an_image(&e) => {
                    camera.refinement.obstacle(Some(&e.to_string()));
                    camera.finished(Some(Skip::Unfit));
                    work.remove(at);
                }
                Err(e) => return Err(e),
            }
        }
        Ok(())
    }

    fn publish(&mut self, good: bool) {
        let description = self.refiner.describe();
        for (i, work) in self.work.drain(..).enumerate() {
            let camera = &mut self.cameras[work.camera];
            let steps = self.steps.get(i).copied().unwrap_or_default();
            let skipped = if good {
                camera.publish(work, steps, &description.engine, &description.model).err().flatten()
            } else {
                Some(Skip::Engine)
            };
            camera.finished(skipped);
        }
        self.frames.raise();
    }
}

/// Whether it is a pair of images that a refiner cannot use, and not the refiner itself that failed.
const fn is_of_an_image(e: &Error) -> bool {
    matches!(e.kind(), ErrorKind::BadInput | ErrorKind::SizeMismatch)
}

/// The memory of an emptied list for another list; the compiler reuses it in place.
#[allow(clippy::unnecessary_filter_map)] // `filter` would keep the old list's lifetime
fn recycle<'b>(mut list: Vec<Job<'_>>) -> Vec<Job<'b>> {
    list.clear();
    list.into_iter().filter_map(|_| None).collect()
}

impl InWork {
    fn job<'a>(&'a mut self, camera: &'a WorkerCamera) -> Result<Job<'a>, Error> {
        let bad = |what: String| Error::new(ErrorKind::BadInput, what);
        let color = &self.pair.color;
        let depth = &self.pair.depth;
        let color: Color<'_> =
            pixels::color(color.header(), color.pixels()).map_err(|e| bad(e.to_string()))?;
        let registered = camera.view.last(depth.header(), depth.pixels());
        let registered = registered.ok_or_else(|| bad("depth is not in the view of colour".to_owned()))?;
        let out = self.out.pixels_mut();
        let unaligned = |_| bad("a slot of shared memory is not aligned".to_owned());
        let out = if camera.refinement.config.format == PixelFormat::DepthF32 {
            Output::Metres(bytemuck::try_cast_slice_mut(out).map_err(unaligned)?)
        } else {
            let pixels = bytemuck::try_cast_slice_mut(out).map_err(unaligned)?;
            Output::Units { pixels, unit_m: self.unit_m }
        };
        let depth = RawDepth { pixels: registered, unit_m: self.unit_m };
        Ok(Job { color, depth, out, steps: StepTimes::default() })
    }
}

impl WorkerCamera {
    /// Puts depth into the view of colour and gets the memory for the result.
    fn prepare(&mut self, at: usize, pair: Pair) -> Result<InWork, Skip> {
        let began = HostTime::now();
        let color = *pair.color.header();
        let depth = *pair.depth.header();
        let profile = &self.refinement.refined.profile;
        let seen = if (profile.width, profile.height) == (color.width, color.height) {
            self.view.depth(&self.refinement.config, &color, &depth, pair.depth.pixels())
        } else {
            Err(format!("colour became {}x{}; restart the daemon", color.width, color.height))
        };
        let (registered, unit_m) = match seen {
            Ok(seen) => seen,
            Err(why) => {
                self.refinement.obstacle(Some(&why));
                return Err(Skip::Unfit);
            }
        };
        let register_ns = began.elapsed().as_nanos() as u64;
        if let Some(stream) = &self.refinement.aligned {
            let steps = [began.since_ns(pair.ready).max(0) as u64, register_ns, 0, 0, 0, 0];
            let header = derived_header(
                pair.color.header(),
                pair.depth.header(),
                PixelFormat::Z16,
                unit_m,
                steps,
                self.epoch,
            );
            let publisher = stream.books().publisher.clone();
            let loan = publisher.and_then(|p| Some((p.loan(registered.len() * 2).ok()?, p)));
            let sent = loan.ok_or(Some(Skip::NoSlot)).and_then(|(mut out, publisher)| {
                out.pixels_mut().copy_from_slice(bytemuck::cast_slice(registered));
                publish_on(stream, self.aligned_session, &publisher, out, header, pair.ready)
            });
            if let Err(Some(why)) = sent {
                let mut books = stream.books();
                books.captured += 1;
                books.dropped.add(why.reason(), 1);
            }
        }
        let publisher = self.refinement.refined.books().publisher.clone().ok_or(Skip::NoSlot)?;
        let out = publisher.loan(self.refinement.refined.profile.frame_bytes()).map_err(|e| {
            tracing::debug!(stream = %self.refinement.refined.id, error = %e, "no slot");
            Skip::NoSlot
        })?;
        Ok(InWork { camera: at, pair, out, publisher, unit_m, began, register_ns })
    }

    /// Publishes the refined pair; returns why it was not, if that is still to be counted.
    fn publish(
        &mut self,
        work: InWork,
        steps: StepTimes,
        engine: &str,
        model: &str,
    ) -> Result<(), Option<Skip>> {
        let InWork { pair, out, publisher, unit_m, began, register_ns, .. } = work;
        // Not before: a pair that the refiner refuses is an obstacle as well.
        self.refinement.obstacle(None);
        let wait_ns = began.since_ns(pair.ready).max(0) as u64;
        let steps = [wait_ns, register_ns, steps.prepare_ns, steps.infer_ns, steps.finish_ns, 0];
        let format = self.refinement.refined.profile.format;
        let unit_m = if format == PixelFormat::DepthF32 { 1.0 } else { unit_m };
        let mut header =
            derived_header(pair.color.header(), pair.depth.header(), format, unit_m, steps, self.epoch);
        header.set_refiner(engine, model);
        let total = publish_on(&self.refinement.refined, self.session, &publisher, out, header, pair.ready)?;
        self.epoch = Some(header.clock_epoch);
        let [wait, register, prepare, infer, finish, _] = steps;
        self.refinement.measured([wait, register, prepare, infer, finish, total]);
        Ok(())
    }

    /// A pair has met its fate; `skipped` says why it was not refined.
    fn finished(&self, skipped: Option<Skip>) {
        // Of a worker that was given up everything is counted already.
        if self.refinement.refined.books().session != self.session {
            return;
        }
        self.refinement.finished();
        if let Some(why) = skipped {
            self.refinement.skip(why);
        }
    }
}

/// Numbers and publishes a frame on `stream` and says how long it took since `ready`, nanoseconds. `Err(None)`: this
/// worker was given up meanwhile, and everything is counted.
fn publish_on(
    stream: &Stream,
    session: u64,
    publisher: &Publisher,
    mut out: FrameMut,
    mut header: FrameHeader,
    ready: HostTime,
) -> Result<u64, Option<Skip>> {
    let mut books = stream.books();
    if books.session != session {
        return Err(None);
    }
    header.set_stream(&stream.id.stream);
    header.sequence = books.delivered + 1;
    header.dropped = books.dropped.0;
    header.captured = header.sequence + books.dropped.total();
    let total = ready.elapsed().as_nanos() as u64;
    header.stage_ns[StageStep::Total as usize] = total;
    // Of a replay everything is as long ago as it was; so is the refined frame.
    let replayed = header.has(FrameFlags::REPLAYED);
    let published =
        if replayed { header.publish_time_ns.saturating_add(total as i64) } else { HostTime::now().ns() };
    header.publish_time_ns = published;
    *out.header_mut() = header;
    if let Err(e) = publisher.send_unstamped(out) {
        tracing::error!(stream = %stream.id, error = %e, "a frame was lost on its way to the subscribers");
        return Err(Some(Skip::NoSlot));
    }
    books.captured += 1;
    books.published(&header, published.saturating_sub(header.capture_time_ns));
    Ok(total)
}
