//! The thread that encodes.

use super::newest::{Newest, next_turn};
use super::thread::work_until_done;
use super::{Geometry, Head, Measured, Message, OfStream, Shared, State, Viewer, Watched, pixel};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{Bus, HostTime, StreamId};
use depthrig_recorder::preview::{Preview, measure, preview};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::PoisonError;

/// Pause between two looks at a stream whose next frame somebody waits for.
const POLL: Duration = Duration::from_millis(5);
/// Pause between two measurements of a stream.
const MEASURE_PERIOD: Duration = Duration::from_millis(200);
/// The longest wait, when no viewer has credit.
const IDLE: Duration = Duration::from_secs(1);

/// Runs until nobody watches any stream.
pub(super) fn run(shared: &Shared) {
    let open = || Bus::open(&shared.runtime, &shared.rig);
    if let Err(e) = work_until_done("viewers", open, |bus| Worker::new(bus).run(shared)) {
        let mut state = lock(&shared.state);
        for viewer in state.viewers.values_mut() {
            viewer.put(Message::Problem(e.to_string()));
        }
        state.is_running = false;
    }
}

struct Worker {
    newest: Newest,
    /// The images encoded last, for viewers that come a little later.
    encoded: BTreeMap<Size, Encoded>,
    /// The numbers measured last.
    measured: BTreeMap<StreamId, Numbers>,
}

/// Numbers of a stream's frame.
struct Numbers {
    /// Earliest time of the next measurement.
    due: HostTime,
    /// `None` if it could not be measured.
    measured: Option<Measured>,
}

/// A stream at a width.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Size {
    id: StreamId,
    width: u32,
}

struct Encoded {
    /// Of the frame.
    sequence: u64,
    /// `None` if it could not be encoded.
    image: Option<Preview>,
}

/// An image that is to be sent.
struct Job {
    viewer: u64,
    /// In the viewer's list.
    index: usize,
    id: StreamId,
    width: u32,
    due: HostTime,
    /// Whether the numbers of the full image go with it.
    measure: bool,
}

impl Worker {
    const fn new(bus: Bus) -> Self {
        Self { newest: Newest::new(bus), encoded: BTreeMap::new(), measured: BTreeMap::new() }
    }

    fn run(mut self, shared: &Shared) {
        loop {
            let watched: BTreeSet<StreamId> = {
                let mut state = lock(&shared.state);
                let all =
                    state.viewers.values().flat_map(|v| v.watched.iter().map(|w| w.id.clone())).collect();
                if BTreeSet::is_empty(&all) {
                    state.is_running = false;
                    return;
                }
                all
            };
            self.newest.keep(&watched);
            self.encoded.retain(|size, _| watched.contains(&size.id));
            self.measured.retain(|id, _| watched.contains(id));
            for id in watched {
                if let Err(e) = self.newest.take(&id) {
                    tell(shared, &id, &e);
                }
            }
            self.answer(shared);
            let jobs = self.due(&lock(&shared.state));
            let has_work = !jobs.is_empty();
            self.send(jobs, shared);
            let state = lock(&shared.state);
            let pause = if has_work { Duration::ZERO } else { pause(&state) };
            if !pause.is_zero() {
                drop(shared.changed.wait_timeout(state, pause).unwrap_or_else(PoisonError::into_inner));
            }
        }
    }

    fn answer(&self, shared: &Shared) {
        let mut state = lock(&shared.state);
        let questions: Vec<_> =
            state.viewers.iter_mut().flat_map(|(n, v)| v.questions.drain(..).map(|q| (*n, q))).collect();
        drop(state);
        for (viewer, question) in questions {
            let answer = pixel::answer(question, self.newest.frames());
            if let Some(viewer) = lock(&shared.state).viewers.get_mut(&viewer) {
                viewer.put(Message::Pixel(answer));
            }
        }
    }

    /// Images that are due and new, of viewers with credit, those that have waited longest first.
    fn due(&self, state: &State) -> Vec<Job> {
        let now = HostTime::now();
        let mut jobs = Vec::new();
        for (number, viewer) in state.viewers.iter().filter(|(_, v)| v.credits > 0) {
            for (index, watched) in viewer.watched.iter().enumerate() {
                let newest = self.newest.frames().get(&watched.id).map(|f| f.header().sequence);
                if watched.due <= now && newest.is_some() && newest != watched.sent {
                    let id = watched.id.clone();
                    let Watched { width, due, measure, .. } = *watched;
                    jobs.push(Job { viewer: *number, index, id, width, due, measure });
                }
            }
        }
        jobs.sort_by_key(|job| job.due);
        jobs
    }

    fn send(&mut self, jobs: Vec<Job>, shared: &Shared) {
        for job in jobs {
            // Without credit it is not encoded.
            if lock(&shared.state).viewers.get(&job.viewer).is_none_or(|v| v.credits == 0) {
                continue;
            }
            let Some(frame) = self.newest.frames().get(&job.id) else { continue };
            let header = frame.header();
            let size = Size { id: job.id.clone(), width: job.width };
            if self.encoded.get(&size).is_none_or(|e| e.sequence != header.sequence) {
                let made = preview(header, frame.pixels(), job.width);
                let image = made.map_err(|e| tell(shared, &job.id, &e)).ok();
                self.encoded.insert(size.clone(), Encoded { sequence: header.sequence, image });
            }
            if job.measure {
                self.measure(&job.id, shared);
            }
            let Some(frame) = self.newest.frames().get(&job.id) else { continue };
            let header = frame.header();
            let image = self.encoded.get(&size).and_then(|e| e.image.as_ref());
            let mut state = lock(&shared.state);
            let Some(viewer) = state.viewers.get_mut(&job.viewer) else { continue };
            let generation = viewer.generation;
            // The viewer may have asked for something else since the job was found.
            let is_wanted = |w: &&mut Watched| w.id == job.id && w.width == job.width;
            let Some(watched) = viewer.watched.get_mut(job.index).filter(is_wanted) else { continue };
            watched.sent = Some(header.sequence);
            watched.due = next_turn(&watched.id, watched.period);
            let Some(image) = image else { continue };
            self.describe(viewer, &job);
            let head = Head {
                kind: image.kind,
                index: job.index as u16,
                step: image.step,
                width: image.width,
                height: image.height,
                full_width: header.width as u16,
                full_height: header.height as u16,
                sequence: header.sequence,
                capture_time_ns: header.capture_time_ns,
                age_ns: HostTime::now().ns() - header.capture_time_ns,
                depth_unit_m: image.depth_unit_m,
                generation,
            };
            if viewer.put(Message::Image(head.message(&image.bytes))) {
                viewer.credits -= 1;
            }
        }
    }

    /// Measures the newest frame of a stream, unless that was done a moment ago.
    fn measure(&mut self, id: &StreamId, shared: &Shared) {
        let Some(frame) = self.newest.frames().get(id) else { return };
        let now = HostTime::now();
        if self.measured.get(id).is_some_and(|m| m.due > now) {
            return;
        }
        let header = frame.header();
        let numbers = measure(header, frame.pixels()).map_err(|e| tell(shared, id, &e)).ok();
        let measured = numbers.map(|numbers| Measured { sequence: header.sequence, numbers });
        self.measured.insert(id.clone(), Numbers { due: now.plus(MEASURE_PERIOD), measured });
    }

    /// Sends what goes with an image: the geometry, when it is new to the viewer, and the numbers.
    fn describe(&self, viewer: &mut Viewer, job: &Job) {
        let Some(frame) = self.newest.frames().get(&job.id) else { return };
        let index = job.index;
        let geometry = Geometry::of(frame.header());
        if viewer.watched[index].geometry != Some(geometry) {
            let message = OfStream { stream: job.id.clone(), what: geometry };
            if viewer.put(Message::Geometry(message.into())) {
                viewer.watched[index].geometry = Some(geometry);
            }
        }
        let numbers = self.measured.get(&job.id).and_then(|m| m.measured.as_ref());
        if let Some(numbers) = numbers
            && viewer.watched[index].measure
            && viewer.watched[index].measured != Some(numbers.sequence)
        {
            let message = OfStream { stream: job.id.clone(), what: numbers.clone() };
            if viewer.put(Message::Measure(message.into())) {
                viewer.watched[index].measured = Some(numbers.sequence);
            }
        }
    }
}

/// Until the next image is due, or a frame may have come for one that is.
fn pause(state: &State) -> Duration {
    let mut pause = IDLE;
    for viewer in state.viewers.values() {
        if !viewer.questions.is_empty() {
            return Duration::ZERO;
        }
        if viewer.credits > 0 {
            for watched in &viewer.watched {
                pause = pause.min(watched.due.from_now().max(POLL));
            }
        }
    }
    pause
}

/// Says to all who watch a stream why it is not shown.
fn tell(shared: &Shared, id: &StreamId, why: &impl core::fmt::Display) {
    for viewer in lock(&shared.state).viewers.values_mut() {
        if viewer.watched.iter().any(|w| w.id == *id) {
            viewer.put(Message::Problem(format!("{id}: {why}")));
        }
    }
}
