//! Refined depth, and depth by stereo, in recordings: computed frames join the set that their source is in.
//!
//! Stereo: a frame of a pair joins the set that has the pair's rectified colour (or its left or right image); when
//! that pair was skipped, the one beside it if that was not. Stereo prefers the pairs of sets. The rest is as for refined
//! depth, of which this speaks:
//!
//! A refined frame is later than its set by the time of refining. The set goes out on the channel of sets at once.
//! On its way to the recorder it waits until the refined frame of each camera that records one is there or is known not
//! to come, in the order of the sets, and for a few sets at most: its other frames keep their slots meanwhile, and a
//! subscriber may hold sixteen. A later frame is missing from its set (`depthrig cdm relabel` adds it
//! afterwards); the live stream has it.
//!
//! Refined frames belong to sets by capture time, which is that of their depth frame: the one refined from the set's
//! own depth frame, or one less than half a refined period away from it.

use super::Inner;
use crate::camera::{Camera, State};
use crate::config::RigConfig;
use crate::status::{CameraState, RefineState, SetAccount};
use crate::stream::Stream;
use core::time::Duration;
use depthrig_bus::{Frame, HostTime, StreamId, Subscriber};
use depthrig_recorder::{RecorderOptions, live_late_ns};
use depthrig_stereo::{COLOR, SIDES};
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// How long the end of a recording waits for sets that wait; longer than any set does.
pub const TIMEOUT: Duration = Duration::from_secs(4);
/// How old a set may become while it waits, of the time that the recorder gives it: encoding and writing has the rest.
const HOLD: f64 = 0.6875;
/// Frames of one stream that a subscriber may hold, less one to read with.
const MAX_HELD: usize = 15;
/// Frames that the assembler holds.
const ASSEMBLING: usize = 3;
/// Sets that wait at most, however few the recorder holds.
const MAX_SETS: usize = 4;
/// Refined frames that wait for their set.
const MAX_WAITING: usize = 4;
/// A refined frame this much of its period away from a set's depth is that set's.
const NEAR: f64 = 0.45;

/// A set that waits.
pub struct Held {
    id: u64,
    tick: HostTime,
    since: HostTime,
    frames: Vec<(Arc<Stream>, Option<Frame>)>,
}

impl Held {
    /// A set with its frames.
    pub fn new(id: u64, tick: HostTime, frames: Vec<(Arc<Stream>, Option<Frame>)>) -> Self {
        Self { id, tick, since: HostTime::now(), frames }
    }

    /// Where in time the refined frame of `depth` is to lie.
    fn moment_of(&self, depth: &StreamId) -> i64 {
        let frame = self.frames.iter().find(|(s, _)| s.id == *depth).and_then(|(_, f)| f.as_ref());
        frame.map_or(self.tick.ns(), |f| f.header().capture_time_ns)
    }
}

/// A stream that joins.
struct LateStream {
    stream: Arc<Stream>,
    camera: Arc<Camera>,
    depth: StreamId,
    near_ns: i64,
    /// It is computed from left and right by the camera itself, so its times are those of the pair to the nanosecond.
    of_pair: bool,
    subscriber: Subscriber,
    waiting: VecDeque<Frame>,
    account: SetAccount,
    before: Option<u64>,
}

/// Result of looking for the frame of a set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Lookup {
    /// The frame at this place is it.
    At(usize),
    /// It is still to come.
    Coming,
    /// It will not come.
    Never,
}

/// The streams that join sets, and the sets that wait for them.
pub struct LateStreams {
    streams: Vec<LateStream>,
    held: VecDeque<Held>,
    max_sets: usize,
    max_age: Duration,
    hold_max: Duration,
    set_ns: i64,
}

impl LateStreams {
    /// None yet; `config` bounds how many sets may wait.
    pub fn new(config: &RigConfig) -> Self {
        let workers = match config.recording.workers {
            0 => RecorderOptions::default().workers,
            n => n,
        };
        let taken = ASSEMBLING + config.recording.queue_sets + workers;
        let max_sets = MAX_HELD.saturating_sub(taken).clamp(1, MAX_SETS);
        let max_age = Duration::from_secs_f64(max_sets as f64 / config.sets.rate_hz).min(TIMEOUT / 2);
        let set_ns = (1e9 / config.sets.rate_hz) as i64;
        Self {
            streams: Vec::new(),
            held: VecDeque::new(),
            max_sets,
            max_age,
            hold_max: Duration::from_nanos((HOLD * live_late_ns(set_ns) as f64) as u64),
            set_ns,
        }
    }

    /// Takes in the computed streams of `camera`, once they are there.
    pub fn find(&mut self, camera: &Arc<Camera>, state: &State) {
        let source = |name: &str| state.streams.iter().find(|s| s.id.stream.as_str() == name).map(|s| &s.id);
        let late = state.streams.iter().filter(|s| camera.config.joins_late(&s.id.stream));
        for (stream, of_pair) in late.map(|s| (s, true)).chain(state.derived.iter().map(|s| (s, false))) {
            let depth = camera.config.refine.as_ref().map_or("depth", |r| r.depth.as_str());
            let depth = Some(depth).filter(|_| !of_pair).and_then(source);
            // Depth of a pair is in no set itself; depth refined from it goes by the pair.
            let depth = depth.filter(|id| !camera.config.joins_late(&id.stream));
            let Some(depth) = depth.or_else(|| [COLOR, SIDES[0], SIDES[1]].into_iter().find_map(source))
            else {
                continue;
            };
            let Some(subscriber) = stream.books().reader.take() else { continue };
            // Depth of a pair is that pair's or of the one beside it; refined depth may have a rate of its own.
            let pairs = state.streams.iter().find(|s| s.id == *depth);
            let period_ns = pairs.filter(|_| of_pair).unwrap_or(stream).profile.period_ns() as i64;
            self.streams.push(LateStream {
                near_ns: if of_pair { near_pair_ns(period_ns, self.set_ns) } else { near_ns(period_ns) },
                of_pair,
                stream: Arc::clone(stream),
                camera: Arc::clone(camera),
                depth: depth.clone(),
                subscriber,
                waiting: VecDeque::with_capacity(MAX_HELD + 1),
                account: SetAccount::default(),
                before: None,
            });
        }
    }

    /// Whether any of them is recorded.
    pub fn are_awaited(&self) -> bool {
        self.streams.iter().any(|j| j.stream.record)
    }

    /// Reads new frames.
    pub fn read(&mut self) {
        let held = &self.held;
        self.streams.iter_mut().for_each(|j| j.read(held));
    }

    /// Lets a set wait.
    pub fn hold(&mut self, set: Held) {
        self.held.push_back(set);
    }

    /// Hands on the sets that wait no longer, in their order.
    pub fn release(&mut self, inner: &Inner) {
        let recording = inner.recording().is_active();
        while let Some(first) = self.held.front() {
            let waiting = self.streams.iter().filter(|j| j.stream.record);
            let decided = waiting.map(|j| j.find(first)).all(|f| f != Lookup::Coming);
            let old = first.since.elapsed() > self.max_age || first.tick.elapsed() > self.hold_max;
            let due = old || self.held.len() > self.max_sets;
            if recording && !decided && !due {
                break;
            }
            let Some(Held { id, tick, since, mut frames }) = self.held.pop_front() else { break };
            let set = Held { id, tick, since, frames: Vec::new() };
            for late in self.streams.iter_mut().filter(|j| j.stream.record) {
                let moment = frames.iter().find(|(s, _)| s.id == late.depth).and_then(|(_, f)| f.as_ref());
                let moment = moment.map_or(set.tick.ns(), |f| f.header().capture_time_ns);
                let frame = late.take(moment);
                frames.push((Arc::clone(&late.stream), frame));
            }
            inner.recording().offer(set.id, set.tick, frames.into_iter());
        }
        if self.held.is_empty() {
            // Nothing waits, so that all but the newest frames are too old for any set to come.
            let idle = !recording || !self.are_awaited();
            self.streams.iter_mut().for_each(|j| j.keep(if idle { 0 } else { MAX_WAITING }));
        }
        inner.held_sets.store(self.held.len(), Ordering::Relaxed);
    }

    /// Accounts of the frames of each stream.
    pub fn accounts(&self) -> impl Iterator<Item = (StreamId, SetAccount)> + '_ {
        self.streams.iter().map(|j| {
            let missed = j.before.unwrap_or(0) + j.subscriber.missed();
            let pending = j.waiting.len() as u64;
            (j.stream.id.clone(), SetAccount { missed, pending, ..j.account })
        })
    }
}

impl LateStream {
    /// Reads new frames; frames that a set still waits for are kept, however many came after them.
    fn read(&mut self, held: &VecDeque<Held>) {
        while let Ok(Some(frame)) = self.subscriber.try_next() {
            self.before.get_or_insert(frame.header().sequence - 1);
            self.waiting.push_back(frame);
            let awaited = |f: &Frame| {
                let at = f.header().capture_time_ns;
                held.iter().any(|set| set.moment_of(&self.depth) == at)
            };
            // From the oldest on, so that times keep rising.
            while self.waiting.len() > MAX_WAITING {
                let Some(i) = self.waiting.iter().position(|f| !awaited(f)).filter(|_| self.of_pair) else {
                    break;
                };
                self.waiting.remove(i);
                self.account.decimated += 1;
            }
            self.keep(if self.of_pair { MAX_HELD - MAX_WAITING } else { MAX_WAITING });
        }
    }

    /// Lets go of the oldest frames until no more than `most` are left.
    fn keep(&mut self, most: usize) {
        while self.waiting.len() > most {
            self.waiting.pop_front();
            self.account.decimated += 1;
        }
    }

    fn find(&self, set: &Held) -> Lookup {
        let stamps = self.waiting.iter().map(|f| f.header().capture_time_ns);
        let runs = || {
            let state = self.camera.state();
            if self.of_pair {
                return matches!(state.phase, CameraState::Opening | CameraState::Streaming);
            }
            state.refinement.as_ref().is_some_and(|refinement| refinement.state() == RefineState::Running)
        };
        let moment = set.moment_of(&self.depth);
        let found = if self.of_pair {
            of_pair(stamps, moment, self.near_ns)
        } else {
            nearest(stamps, moment, self.near_ns)
        };
        match found {
            Lookup::Coming if !runs() => Lookup::Never,
            found => found,
        }
    }

    /// The frame of the set whose depth is of `moment`; older ones are let go.
    fn take(&mut self, moment: i64) -> Option<Frame> {
        let stamps = self.waiting.iter().map(|f| f.header().capture_time_ns);
        let Lookup::At(i) = nearest(stamps, moment, self.near_ns) else { return None };
        self.account.decimated += i as u64;
        self.account.used += 1;
        self.waiting.drain(..i);
        self.waiting.pop_front()
    }
}

/// How far from a set's depth its refined frame may be when these are `period_ns` apart.
fn near_ns(period_ns: i64) -> i64 {
    (period_ns as f64 * NEAR) as i64
}

/// How far from a set's pair the one may be whose depth stands in for it, when pairs are `period_ns` apart and sets
/// `set_ns`: it is the pair beside it, and not one of another set.
pub fn near_pair_ns(period_ns: i64, set_ns: i64) -> i64 {
    (period_ns + period_ns / 10).min(near_ns(set_ns))
}

/// Which of the frames with these rising `stamps` is the one for `moment`.
fn nearest(stamps: impl Iterator<Item = i64>, moment: i64, near_ns: i64) -> Lookup {
    let mut later = false;
    let mut best = None;
    for (i, stamp) in stamps.enumerate() {
        let apart = (stamp - moment).abs();
        if apart <= near_ns && best.is_none_or(|(_, least)| apart < least) {
            best = Some((i, apart));
        }
        later |= stamp > moment;
    }
    match best {
        Some((i, _)) => Lookup::At(i),
        None if later => Lookup::Never,
        None => Lookup::Coming,
    }
}

/// The same for frames that are of `moment` itself, or whose pair was skipped: then one later than it comes.
fn of_pair(stamps: impl Iterator<Item = i64> + Clone, moment: i64, near_ns: i64) -> Lookup {
    if let Some(i) = stamps.clone().position(|stamp| stamp == moment) {
        return Lookup::At(i);
    }
    let later = stamps.clone().any(|stamp| stamp > moment);
    if later { nearest(stamps, moment, near_ns) } else { Lookup::Coming }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_of_a_pair_is_that_pairs_unless_it_was_skipped() {
        let find = |stamps: &[i64], moment| of_pair(stamps.iter().copied(), moment, 90);
        assert_eq!(find(&[967], 1000), Lookup::Coming, "the one before is not it");
        assert_eq!(find(&[967, 1000, 1033], 1000), Lookup::At(1));
        assert_eq!(find(&[967, 1060], 1000), Lookup::At(0), "it was skipped");
        assert_eq!(find(&[800, 1200], 1000), Lookup::Never);
    }

    #[test]
    fn the_pair_beside_stands_in_and_the_one_of_another_set_does_not() {
        let sets = 200_000_000;
        let frame = 33_333_333;
        assert!((frame..2 * frame).contains(&near_pair_ns(frame, sets)));
        assert!(near_pair_ns(sets, sets) < sets / 2, "pairs as rare as sets");
    }

    #[test]
    fn a_set_takes_its_own_refined_frame_waits_for_it_and_knows_when_it_will_not_come() {
        let find = |stamps: &[i64], moment| nearest(stamps.iter().copied(), moment, 90);
        assert_eq!(find(&[], 1000), Lookup::Coming);
        assert_eq!(find(&[800], 1000), Lookup::Coming, "of the set before");
        assert_eq!(find(&[800, 1000, 1200], 1000), Lookup::At(1));
        assert_eq!(find(&[967], 1000), Lookup::At(0), "of the depth frame beside it");
        assert_eq!(find(&[800, 1200], 1000), Lookup::Never, "a later one has come");
    }

    #[test]
    fn a_refined_frame_is_of_one_set_and_of_the_depth_frames_beside_it() {
        let period = 200_000_000;
        let beside = 2 * 33_333_334;
        let find = |stamp, moment| nearest(core::iter::once(stamp), moment, near_ns(period));
        for off in [-beside, 0, beside] {
            assert_eq!(find(10 * period + off, 10 * period), Lookup::At(0), "{off}");
        }
        // No stamp lies near two sets.
        for stamp in (10 * period..=11 * period).step_by(1_000_000) {
            let near = [10, 11].map(|set| matches!(find(stamp, set * period), Lookup::At(_)));
            assert!(near != [true, true], "{stamp}");
        }
    }
}
