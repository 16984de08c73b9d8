//! A subscriber of the live rig: takes frame sets as a policy would, checks them and looks at their depth.

use super::{Checksums, checksum, is_depth, mode_name};
use crate::picture;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{Bus, ErrorKind, Frame, FrameHeader, MemberRecord, SetSubscriber, StreamId, Subscriber};
use depthrig_cdm::metrics::{Depth, DepthRange, compare, fill_rate};
use image::RgbImage;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};

/// Frames of a stream that are kept until the set that names them comes; the bus lets a subscriber hold 16.
const KEEP: usize = 14;
/// Depth of every so-manieth set is kept, to be compared with the truth at the end: here it would hold up frames.
const COMPARE_EVERY: u64 = 10;
/// Sets that are compared at most; each is some 25 MB.
const COMPARE_MOST: usize = 6;
/// Refined pictures of a camera that are compared at most.
const REFINED_MOST: usize = 3;
/// Frames of one moment are this close.
const SAME_MOMENT_NS: i64 = 1_000_000;
/// The same of depth and of the truth in colour's view: half of what their exposures differ by is latency that no clock
/// map can know. Simulated streams of one rate expose at the same moments, 11 ms apart at the least.
const SAME_MOMENT_IN_COLOR_NS: i64 = 5_000_000;
const PATIENCE: Duration = Duration::from_secs(5);

/// What was seen of one camera's depth.
#[derive(Debug, Clone, Default, Serialize)]
pub struct DepthSeen {
    /// Share of pixels with a depth, mean over the pictures looked at, percent.
    pub fill_percent: f64,
    /// Mean of |depth - truth| where both are, mean over the pictures, millimetres; `None` without a truth.
    pub l1_mm: Option<f64>,
    /// The same over every pixel of the truth: what is missing counts as 0, so that its whole depth is its error.
    pub strict_l1_mm: Option<f64>,
    /// Pictures looked at.
    pub pictures: u64,
    /// Pictures compared with the truth.
    pub compared: u64,
}

/// What was seen of the rig.
#[derive(Debug, Default)]
pub struct Seen {
    /// Sets that came.
    pub sets: u64,
    /// Members of sets whose frame was gone before it was read.
    pub unread: u64,
    /// Checksums of all depth pictures.
    pub checksums: Checksums,
    /// Depth by mode.
    pub depth: BTreeMap<String, DepthSeen>,
    /// Millimetres per unit of depth, by mode.
    pub units_mm: BTreeMap<String, f64>,
    /// Refined depth by camera.
    pub refined: BTreeMap<String, RefinedSeen>,
    /// The newest pictures by camera and stream: colour, each depth and refined depth, as colours.
    pub pictures: BTreeMap<String, BTreeMap<String, RgbImage>>,
}

/// What was seen of one camera's refined depth.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RefinedSeen {
    /// What refined it, as the frames say.
    pub engine: String,
    /// Frames that came.
    pub frames: u64,
    /// Against the truth in the view of colour.
    pub depth: DepthSeen,
}

/// A frame that outlives its slot.
struct Copied {
    header: FrameHeader,
    pixels: Vec<u8>,
}

impl Copied {
    fn of(frame: &Frame) -> Self {
        Self { header: *frame.header(), pixels: frame.pixels().to_vec() }
    }
}

struct Input {
    subscriber: Subscriber,
    kept: VecDeque<Frame>,
}

/// The subscriber.
pub struct Watcher {
    inputs: BTreeMap<StreamId, Input>,
    sets: SetSubscriber,
    seen: Seen,
    /// Depth and truth to be compared at the end.
    to_compare: Vec<Vec<(Copied, Option<Copied>)>>,
    /// Refined depth and truth, likewise.
    refined: Vec<(Copied, Copied)>,
}

impl Watcher {
    /// Subscribes to `streams` and to the sets.
    pub fn new(bus: &Bus, streams: &[StreamId]) -> Result<Self> {
        let mut inputs = BTreeMap::new();
        for id in streams {
            let subscriber = bus.subscriber_within(id, PATIENCE)?;
            inputs.insert(id.clone(), Input { subscriber, kept: VecDeque::with_capacity(KEEP) });
        }
        Ok(Self {
            inputs,
            sets: bus.set_subscriber()?,
            seen: Seen::default(),
            to_compare: Vec::new(),
            refined: Vec::new(),
        })
    }

    /// Takes frames and sets until `ended`.
    pub fn run(mut self, ended: impl Fn() -> bool) -> Result<Seen> {
        while !ended() {
            self.pump()?;
            self.take_refined()?;
            // Frames come at up to 60 Hz and four wait unread: a look every 20 ms loses none.
            if let Some(set) = self.sets.next_timeout(Duration::from_millis(20))? {
                let members = set.members()?;
                self.pump()?;
                self.take(&members)?;
            }
        }
        self.look_at_late_modes();
        // Pictures for the report, from the last frames; nothing waits for this any more.
        for (id, input) in &self.inputs {
            let Some(frame) = input.kept.back() else { continue };
            let stream = id.stream.as_str();
            if stream == "color" || stream == "depth_refined" || is_depth(stream) {
                let picture = picture::to_rgb(frame.header(), frame.pixels())?;
                let pictures = self.seen.pictures.entry(id.camera.to_string()).or_default();
                pictures.insert(stream.to_owned(), picture);
            }
        }
        for (refined, truth) in &self.refined {
            let seen = self.seen.refined.entry(refined.header.camera().to_owned()).or_default();
            seen.depth.add(refined, Some(truth), SAME_MOMENT_IN_COLOR_NS)?;
        }
        for (depth, truth) in self.to_compare.iter().flatten() {
            let mode = mode_name(depth.header.camera(), depth.header.stream());
            let seen = self.seen.depth.entry(mode).or_default();
            seen.add(depth, truth.as_ref(), SAME_MOMENT_NS)?;
        }
        for depth in self.seen.depth.values_mut().chain(self.seen.refined.values_mut().map(|r| &mut r.depth))
        {
            depth.fill_percent /= depth.pictures.max(1) as f64;
            let mean = |sum: f64| sum / depth.compared.max(1) as f64;
            depth.l1_mm = depth.l1_mm.map(mean);
            depth.strict_l1_mm = depth.strict_l1_mm.map(mean);
        }
        Ok(self.seen)
    }

    /// Has the newest picture of each depth mode looked at that comes too late for the sets of the bus.
    fn look_at_late_modes(&mut self) {
        let looked_at = |id: &StreamId| {
            let same = |(depth, _): &(Copied, Option<Copied>)| depth.header.stream_id().as_ref() == Some(id);
            self.to_compare.iter().flatten().any(same)
        };
        let late = self.inputs.iter().filter(|(id, _)| is_depth(id.stream.as_str()) && !looked_at(id));
        let newest = late.filter_map(|(_, input)| Some((Copied::of(input.kept.back()?), None)));
        let newest: Vec<_> = newest.collect();
        self.to_compare.push(newest);
    }

    /// Takes what has come. Every depth picture is noted at once: a set that waits for a slow mode is told of when the
    /// frames of fast cameras are gone.
    fn pump(&mut self) -> Result<()> {
        for (id, input) in &mut self.inputs {
            if !is_depth(id.stream.as_str()) {
                input.pump(|_| ())?;
                continue;
            }
            let Seen { checksums, units_mm, .. } = &mut self.seen;
            let unit = units_mm.entry(mode_name(id.camera.as_str(), id.stream.as_str())).or_default();
            input.pump(|frame| {
                *unit = frame.header().depth_unit_m * 1e3;
                checksums.insert((id.clone(), frame.header().capture_time_ns), checksum(frame.pixels()));
            })?;
        }
        Ok(())
    }

    /// Counts refined frames, and keeps some with the truth of their moment.
    fn take_refined(&mut self) -> Result<()> {
        for (id, input) in self.inputs.iter().filter(|(id, _)| id.stream.as_str() == "depth_refined") {
            let Some(frame) = input.kept.back() else { continue };
            let seen = self.seen.refined.entry(id.camera.to_string()).or_default();
            let before = core::mem::replace(&mut seen.frames, frame.header().sequence);
            if before == seen.frames {
                continue;
            }
            frame.header().refiner().clone_into(&mut seen.engine);
            let truth = StreamId::new(id.camera.as_str(), "depth_true_color")?;
            let at = frame.header().capture_time_ns;
            let same = |f: &&Frame| (f.header().capture_time_ns - at).abs() < SAME_MOMENT_IN_COLOR_NS;
            let truth = self.inputs.get(&truth).and_then(|i| i.kept.iter().find(same));
            let kept = self.refined.iter().filter(|(r, _)| r.header.camera() == id.camera.as_str()).count();
            if let Some(truth) = truth.filter(|_| kept < REFINED_MOST) {
                self.refined.push((Copied::of(frame), Copied::of(truth)));
            }
        }
        Ok(())
    }

    fn take(&mut self, members: &[MemberRecord]) -> Result<()> {
        self.seen.sets += 1;
        let compare = self.seen.sets % COMPARE_EVERY == 2 && self.to_compare.len() < COMPARE_MOST;
        let mut pairs = Vec::new();
        let frame = |id: &StreamId| {
            let sequence = members.iter().find(|m| m.id == *id)?.sequence?;
            self.inputs.get(id)?.kept.iter().find(|f| f.header().sequence == sequence)
        };
        for member in members.iter().filter(|m| m.sequence.is_some() && is_depth(m.id.stream.as_str())) {
            let Some(depth) = frame(&member.id) else {
                self.seen.unread += 1;
                continue;
            };
            if compare {
                let truth = StreamId::new(member.id.camera.as_str(), "depth_true")?;
                pairs.push((Copied::of(depth), frame(&truth).map(Copied::of)));
            }
        }
        if compare {
            self.to_compare.push(pairs);
        }
        Ok(())
    }
}

impl Input {
    /// Takes what has come, and shows it to `look`; the oldest are let go.
    fn pump(&mut self, mut look: impl FnMut(&Frame)) -> Result<()> {
        loop {
            match self.subscriber.try_next() {
                Ok(Some(frame)) => {
                    if self.kept.len() == KEEP {
                        self.kept.pop_front();
                    }
                    look(&frame);
                    self.kept.push_back(frame);
                }
                Ok(None) => return Ok(()),
                Err(e) if e.kind() == ErrorKind::LimitReached => {
                    self.kept.pop_front();
                }
                Err(e) => return Err(e.into()),
            }
        }
    }
}

impl DepthSeen {
    /// Sums are divided by the number of pictures at the end. The truth counts when it is `within` nanoseconds of `depth`.
    fn add(&mut self, depth: &Copied, truth: Option<&Copied>, within: i64) -> Result<()> {
        let Some(metres) = picture::depth_m(&depth.header, &depth.pixels)? else { return Ok(()) };
        self.pictures += 1;
        self.fill_percent += 100.0 * fill_rate(&Depth::Metres(&metres));
        let same_moment =
            |t: &&Copied| (t.header.capture_time_ns - depth.header.capture_time_ns).abs() < within;
        if let Some(truth) = truth.filter(same_moment)
            && let Some(true_metres) = picture::depth_m(&truth.header, &truth.pixels)?
        {
            let range = DepthRange { min_m: 0.1, max_m: 5.0 };
            let metrics = compare(&Depth::Metres(&metres), &Depth::Metres(&true_metres), range)?;
            if metrics.valid > 0 {
                self.compared += 1;
                *self.l1_mm.get_or_insert(0.0) += metrics.l1_m * 1e3;
                *self.strict_l1_mm.get_or_insert(0.0) += metrics.strict_l1_m * 1e3;
            }
        }
        Ok(())
    }
}
