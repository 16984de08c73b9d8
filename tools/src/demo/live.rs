//! A subscriber of the live rig: takes frame sets as a policy would, checks them and looks at their depth.

use super::{Checksums, checksum};
use crate::picture;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{Bus, ErrorKind, Frame, HostTime, MemberRecord, SetSubscriber, StreamId, Subscriber};
use depthrig_cdm::metrics::{Depth, DepthRange, compare, fill_rate};
use image::RgbImage;
use serde::Serialize;
use std::collections::{BTreeMap, VecDeque};

/// Frames of a stream that are kept until the set that names them comes; the bus lets a subscriber hold 16.
const KEEP: usize = 14;
/// Depth is compared with the truth in every so-manieth set: it is the work of a tenth of a second.
const COMPARE_EVERY: u64 = 10;
const PATIENCE: Duration = Duration::from_secs(5);

/// What was seen of one camera's depth.
#[derive(Debug, Clone, Default, Serialize)]
pub struct DepthSeen {
    /// Share of pixels with a depth, mean over the pictures looked at, percent.
    pub fill_percent: f64,
    /// Mean of |depth - truth| where both are, mean over the pictures, millimetres; `None` without a truth.
    pub l1_mm: Option<f64>,
    /// Pictures looked at.
    pub pictures: u64,
}

/// What was seen of the rig.
#[derive(Debug, Default)]
pub struct Seen {
    /// Sets that came.
    pub sets: u64,
    /// Members of sets whose frame was gone before it was read.
    pub unread: u64,
    /// Checksums of the depth pictures of all sets.
    pub checksums: Checksums,
    /// Depth by camera.
    pub depth: BTreeMap<String, DepthSeen>,
    /// Millimetres per unit of depth, by camera.
    pub units_mm: BTreeMap<String, f64>,
    /// The newest pictures by camera: colour and depth as colours.
    pub pictures: BTreeMap<String, (Option<RgbImage>, Option<RgbImage>)>,
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
}

impl Watcher {
    /// Subscribes to `streams` and to the sets.
    pub fn new(bus: &Bus, streams: &[StreamId]) -> Result<Self> {
        let mut inputs = BTreeMap::new();
        for id in streams {
            let subscriber = bus.subscriber_within(id, PATIENCE)?;
            inputs.insert(id.clone(), Input { subscriber, kept: VecDeque::with_capacity(KEEP) });
        }
        Ok(Self { inputs, sets: bus.set_subscriber()?, seen: Seen::default() })
    }

    /// Takes frames and sets until `ended`.
    pub fn run(mut self, ended: impl Fn() -> bool) -> Result<Seen> {
        while !ended() {
            for input in self.inputs.values_mut() {
                input.pump()?;
            }
            // Frames come at up to 60 Hz and four wait unread: a look every 20 ms loses none.
            if let Some(set) = self.sets.next_timeout(Duration::from_millis(20))? {
                let members = set.members()?;
                for input in self.inputs.values_mut() {
                    input.pump()?;
                }
                self.take(&members)?;
            }
        }
        // Pictures for the report, from the last frames; nothing waits for this any more.
        for (id, input) in &self.inputs {
            let Some(frame) = input.kept.back() else { continue };
            let pictures = self.seen.pictures.entry(id.camera.to_string()).or_default();
            match id.stream.as_str() {
                "color" => pictures.0 = Some(picture::to_rgb(frame.header(), frame.pixels())?),
                "depth" => pictures.1 = Some(picture::to_rgb(frame.header(), frame.pixels())?),
                _ => {}
            }
        }
        for depth in self.seen.depth.values_mut() {
            let n = depth.pictures.max(1) as f64;
            depth.fill_percent /= n;
            depth.l1_mm = depth.l1_mm.map(|sum| sum / n);
        }
        Ok(self.seen)
    }

    fn take(&mut self, members: &[MemberRecord]) -> Result<()> {
        self.seen.sets += 1;
        let frame = |id: &StreamId| {
            let sequence = members.iter().find(|m| m.id == *id)?.sequence?;
            self.inputs.get(id)?.kept.iter().find(|f| f.header().sequence == sequence)
        };
        for member in members.iter().filter(|m| m.sequence.is_some() && m.id.stream.as_str() == "depth") {
            let Some(depth) = frame(&member.id) else {
                self.seen.unread += 1;
                continue;
            };
            let key = (member.id.clone(), depth.header().capture_time_ns);
            self.seen.checksums.insert(key, checksum(depth.pixels()));
            self.seen.units_mm.insert(member.id.camera.to_string(), depth.header().depth_unit_m * 1e3);
            if self.seen.sets % COMPARE_EVERY == 1 {
                let truth = StreamId::new(member.id.camera.as_str(), "depth_true")?;
                let seen = self.seen.depth.entry(member.id.camera.to_string()).or_default();
                seen.add(depth, frame(&truth))?;
            }
        }
        Ok(())
    }
}

impl Input {
    /// Takes what has come; the oldest are let go.
    fn pump(&mut self) -> Result<()> {
        loop {
            match self.subscriber.try_next() {
                Ok(Some(frame)) => {
                    if self.kept.len() == KEEP {
                        self.kept.pop_front();
                    }
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
    /// Sums are divided by the number of pictures at the end.
    fn add(&mut self, depth: &Frame, truth: Option<&Frame>) -> Result<()> {
        let Some(metres) = picture::depth_m(depth.header(), depth.pixels())? else { return Ok(()) };
        self.pictures += 1;
        self.fill_percent += 100.0 * fill_rate(&Depth::Metres(&metres));
        let same_moment = |t: &&Frame| {
            let apart = HostTime::from_ns(t.header().capture_time_ns)
                .since_ns(HostTime::from_ns(depth.header().capture_time_ns));
            apart.abs() < 1_000_000
        };
        if let Some(truth) = truth.filter(same_moment)
            && let Some(true_metres) = picture::depth_m(truth.header(), truth.pixels())?
        {
            let range = DepthRange { min_m: 0.1, max_m: 5.0 };
            let metrics = compare(&Depth::Metres(&metres), &Depth::Metres(&true_metres), range)?;
            if metrics.valid > 0 {
                *self.l1_mm.get_or_insert(0.0) += metrics.l1_m * 1e3;
            }
        }
        Ok(())
    }
}
