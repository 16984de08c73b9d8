//! A subscriber of the live rig: reads frame sets as a policy would, and checks them and their depth.

use super::sheet::Shot;
use super::{Checksums, checksum, is_depth, mode_name};
use crate::image_file;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{Bus, ErrorKind, Frame, FrameHeader, MemberRecord, SetSubscriber, StreamId, Subscriber};
use depthrig_cdm::metrics::{Depth, DepthRange, compare, fill_rate};
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};

/// Frames of a stream that are kept until the set that names them comes; the bus lets a subscriber hold 16.
const KEEP: usize = 14;
/// Every n-th set's depth is kept and compared with the truth at the end: comparing at once would delay frames.
const COMPARE_EVERY: u64 = 10;
/// Sets that are compared at most; each is some 25 MB.
const COMPARE_MOST: usize = 6;
/// Refined images of a camera that are compared at most.
const REFINED_MOST: usize = 3;
/// Frames of one moment are this close.
const SAME_MOMENT_NS: i64 = 1_000_000;
/// The same of depth and of the truth in colour's view: half of what their exposures differ by is latency that no clock
/// map can know. Simulated streams of one rate expose at the same moments, 11 ms apart at the least.
const SAME_MOMENT_IN_COLOR_NS: i64 = 5_000_000;
/// Depths that are compared with the truth, metres.
const COMPARED_M: core::ops::RangeInclusive<f32> = 0.1..=5.0;
const TIMEOUT: Duration = Duration::from_secs(5);

/// Statistics of one camera's depth.
#[derive(Debug, Clone, Default, Serialize)]
pub struct DepthSeen {
    /// Share of pixels with a depth, mean over the images looked at, percent.
    pub fill_percent: f64,
    /// Mean of |depth - truth| where both are, mean over the images, millimetres; `None` without a truth.
    pub l1_mm: Option<f64>,
    /// The same over every pixel of the truth: missing depth counts as 0, so that the true depth is its error.
    pub strict_l1_mm: Option<f64>,
    /// Images looked at.
    pub images: u64,
    /// Images compared with the truth.
    pub compared: u64,
}

/// Observations of the rig.
#[derive(Debug, Default)]
pub struct Seen {
    /// Sets that came.
    pub sets: u64,
    /// Members of sets whose frame was gone before it was read.
    pub unread: u64,
    /// Checksums of all depth images.
    pub checksums: Checksums,
    /// Depth by mode.
    pub depth: BTreeMap<String, DepthSeen>,
    /// Millimetres per unit of depth, by mode.
    pub units_mm: BTreeMap<String, f64>,
    /// Refined depth by camera.
    pub refined: BTreeMap<String, RefinedSeen>,
    /// The newest images by camera and stream: colour, each depth, and depth before and after it was filled.
    pub shots: BTreeMap<String, BTreeMap<String, Shot>>,
}

/// Statistics of one camera's refined depth: before and after, in the same view, on the same pixels.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RefinedSeen {
    /// Engine, as named in the frames.
    pub engine: String,
    /// Frames that came.
    pub frames: u64,
    /// Images compared.
    pub compared: u64,
    /// Share of pixels of colour's view with a depth before, percent.
    pub before_percent: f64,
    /// Share of pixels of colour's view with a depth after, percent.
    pub after_percent: f64,
    /// Mean of |depth - truth| before, over pixels with a depth before and after, millimetres; `None` without a truth.
    pub before_mm: Option<f64>,
    /// Mean of |depth - truth| after, over the same pixels.
    pub after_mm: Option<f64>,
    /// Mean of |depth - truth| over pixels that had no depth before and have one after; `None` without a truth or a hole.
    pub holes_mm: Option<f64>,
    #[serde(skip)]
    sums: Sums,
}

/// Sums over the images compared.
#[derive(Debug, Clone, Default)]
struct Sums {
    pixels: u64,
    before: u64,
    after: u64,
    /// Pixels with a truth, and a depth before and after.
    both: u64,
    both_before_mm: f64,
    both_after_mm: f64,
    /// Pixels with a truth and a depth after alone.
    holes: u64,
    holes_mm: f64,
}

/// Refined depth with its inputs, and the ground truth if available.
struct Refined {
    before: Copied,
    after: Copied,
    truth: Option<Copied>,
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
    /// Refined depth, likewise.
    refined: Vec<Refined>,
}

impl Watcher {
    /// Subscribes to `streams` and to the sets.
    pub fn new(bus: &Bus, streams: &[StreamId]) -> Result<Self> {
        let mut inputs = BTreeMap::new();
        for id in streams {
            let subscriber = bus.subscriber_within(id, TIMEOUT)?;
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
            // Frames come at up to 60 Hz and four are buffered: polling every 20 ms loses none.
            if let Some(set) = self.sets.next_timeout(Duration::from_millis(20))? {
                let members = set.members()?;
                self.pump()?;
                self.take(&members)?;
            }
        }
        self.look_at_late_modes();
        // Images for the report, from the last frames; no frame is delayed any more.
        for (id, input) in &self.inputs {
            let Some(frame) = input.kept.back() else { continue };
            let stream = id.stream.as_str();
            if ["color", "depth_refined", "depth_aligned"].contains(&stream) || is_depth(stream) {
                let header = frame.header();
                let shot = match image_file::depth_m(header, frame.pixels())? {
                    Some(metres) => Shot::Depth { width: header.width, height: header.height, metres },
                    None => Shot::Color(image_file::to_rgb(header, frame.pixels())?),
                };
                let shots = self.seen.shots.entry(id.camera.to_string()).or_default();
                shots.insert(stream.to_owned(), shot);
            }
        }
        for refined in &self.refined {
            let seen = self.seen.refined.entry(refined.after.header.camera().to_owned()).or_default();
            seen.add(refined)?;
        }
        for (depth, truth) in self.to_compare.iter().flatten() {
            let mode = mode_name(depth.header.camera(), depth.header.stream());
            let seen = self.seen.depth.entry(mode).or_default();
            seen.add(depth, truth.as_ref(), SAME_MOMENT_NS)?;
        }
        for depth in self.seen.depth.values_mut() {
            depth.fill_percent /= depth.images.max(1) as f64;
            let mean = |sum: f64| sum / depth.compared.max(1) as f64;
            depth.l1_mm = depth.l1_mm.map(mean);
            depth.strict_l1_mm = depth.strict_l1_mm.map(mean);
        }
        Ok(self.seen)
    }

    /// Examines the newest image of each depth mode that is too late for the sets of the bus.
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

    /// Reads all pending frames. Every depth image is recorded at once: a set that waits for a slow mode is announced
    /// only after the frames of fast cameras are gone.
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

    /// Counts refined frames, and keeps some with their inputs and the ground truth at that time.
    fn take_refined(&mut self) -> Result<()> {
        for (id, input) in self.inputs.iter().filter(|(id, _)| id.stream.as_str() == "depth_refined") {
            let Some(frame) = input.kept.back() else { continue };
            let seen = self.seen.refined.entry(id.camera.to_string()).or_default();
            let last = core::mem::replace(&mut seen.frames, frame.header().sequence);
            if last == seen.frames {
                continue;
            }
            frame.header().refiner().clone_into(&mut seen.engine);
            let at = frame.header().capture_time_ns;
            let kept = |stream: &str, within_ns: i64| -> Result<Option<Copied>> {
                let id = StreamId::new(id.camera.as_str(), stream)?;
                let same = |f: &&Frame| (f.header().capture_time_ns - at).abs() < within_ns;
                Ok(self.inputs.get(&id).and_then(|i| i.kept.iter().find(same)).map(Copied::of))
            };
            let of_camera = |r: &&Refined| r.after.header.camera() == id.camera.as_str();
            if self.refined.iter().filter(of_camera).count() == REFINED_MOST {
                continue;
            }
            if let Some(before) = kept("depth_aligned", SAME_MOMENT_NS)? {
                let truth = kept("depth_true_color", SAME_MOMENT_IN_COLOR_NS)?;
                // Wait for the ground truth if the camera has one.
                let has_truth =
                    self.inputs.contains_key(&StreamId::new(id.camera.as_str(), "depth_true_color")?);
                if truth.is_some() || !has_truth {
                    self.refined.push(Refined { before, after: Copied::of(frame), truth });
                }
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
    /// Reads all pending frames and passes them to `look`; the oldest are released.
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

impl RefinedSeen {
    /// Adds an image to the sums and brings the means up to date.
    fn add(&mut self, refined: &Refined) -> Result<()> {
        let metres = |c: &Copied| image_file::depth_m(&c.header, &c.pixels);
        let (Some(before), Some(after)) = (metres(&refined.before)?, metres(&refined.after)?) else {
            return Ok(());
        };
        let truth = refined.truth.as_ref().map(metres).transpose()?.flatten().unwrap_or_default();
        self.compared += 1;
        self.sums.add(&before, &after, &truth);
        let s = &self.sums;
        let percent = |n: u64| 100.0 * n as f64 / s.pixels.max(1) as f64;
        self.before_percent = percent(s.before);
        self.after_percent = percent(s.after);
        let mean = |sum: f64, n: u64| (n > 0).then(|| sum / n as f64);
        self.before_mm = mean(s.both_before_mm, s.both);
        self.after_mm = mean(s.both_after_mm, s.both);
        self.holes_mm = mean(s.holes_mm, s.holes);
        Ok(())
    }
}

impl Sums {
    /// Adds one image; `truth` may be empty.
    fn add(&mut self, before: &[f32], after: &[f32], truth: &[f32]) {
        let is_depth = |z: f32| z.is_finite() && z > 0.0;
        for (i, (before, after)) in before.iter().zip(after).enumerate() {
            let was = is_depth(*before);
            let is = is_depth(*after);
            self.pixels += 1;
            self.before += u64::from(was);
            self.after += u64::from(is);
            let Some(truth) = truth.get(i).copied().filter(|z| COMPARED_M.contains(z)) else { continue };
            let off_mm = |z: f32| f64::from((z - truth).abs()) * 1e3;
            if was && is {
                self.both += 1;
                self.both_before_mm += off_mm(*before);
                self.both_after_mm += off_mm(*after);
            } else if is {
                self.holes += 1;
                self.holes_mm += off_mm(*after);
            }
        }
    }
}

impl DepthSeen {
    /// Sums are divided by the number of images at the end. The truth counts when it is `within` nanoseconds of `depth`.
    fn add(&mut self, depth: &Copied, truth: Option<&Copied>, within: i64) -> Result<()> {
        let Some(metres) = image_file::depth_m(&depth.header, &depth.pixels)? else { return Ok(()) };
        self.images += 1;
        self.fill_percent += 100.0 * fill_rate(&Depth::Metres(&metres));
        let same_moment =
            |t: &&Copied| (t.header.capture_time_ns - depth.header.capture_time_ns).abs() < within;
        if let Some(truth) = truth.filter(same_moment)
            && let Some(true_metres) = image_file::depth_m(&truth.header, &truth.pixels)?
        {
            let range = DepthRange { min_m: (*COMPARED_M.start()).into(), max_m: (*COMPARED_M.end()).into() };
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Filling that adds worse depth where there was none does not make the depth that was there look worse.
    #[test]
    fn before_and_after_are_told_on_the_same_pixels() {
        let truth = [1.0, 1.0, 1.0, 2.0, 0.0];
        let before = [1.1, 0.9, 0.0, 0.0, 1.0];
        let after = [1.05, 0.9, 1.5, 0.0, 1.0];
        let mut sums = Sums::default();
        sums.add(&before, &after, &truth);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-3;
        assert_eq!((sums.pixels, sums.before, sums.after, sums.both, sums.holes), (5, 3, 4, 2, 1));
        assert!(near(sums.both_before_mm, 200.0) && near(sums.both_after_mm, 150.0), "{sums:?}");
        assert!(near(sums.holes_mm, 500.0), "{sums:?}");
        sums.add(&before, &after, &[]);
        assert_eq!((sums.pixels, sums.both), (10, 2), "nothing is compared without a truth");
    }
}
