//! Motion units: batches whole and in their order, and the single samples beside them.

use super::segment::Pass;
use super::sets::Walk;
use super::{Findings, Severity};
use crate::container::scan::Message;
use crate::dataset::{Kind, MotionCount};
use crate::msgs::frame_info;
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::motion::{Batch, Imu, read_samples};
use crate::msgs::tf::unit_frame;
use crate::recorder::topics::{MOTION_CODEC, check_batch};
use crate::{Error, ErrorKind, RecordMotion, Result, SET_MOTION_MAX_BYTES, Session};
use depthrig_bus::{FrameFlags, FrameHeader, StreamId};
use std::collections::BTreeMap;

/// The messages of motion units since the last commit mark.
#[derive(Default)]
pub(super) struct Messages {
    /// Bytes of all of them.
    bytes: u64,
    batches: Vec<Waiting>,
    /// Samples without a header before them, by unit.
    stray: BTreeMap<StreamId, u64>,
    /// Of each unit.
    single: BTreeMap<StreamId, Single>,
}

/// A batch that waits for its set's mark.
struct Waiting {
    unit: StreamId,
    log_time: u64,
    header: Box<FrameHeader>,
    stamp_utc_ns: i64,
    /// Frame and codec are those of a motion unit.
    is_named: bool,
    samples: Option<Batch>,
}

/// The single samples of a unit.
#[derive(Default)]
struct Single {
    count: u64,
    /// What they say, with the name of their frame and the time that their records have; with decoding only.
    values: Vec<(Imu, u64)>,
    frame_id: String,
    /// They are not all of one frame.
    frames_differ: bool,
}

impl Messages {
    /// Takes a message of a motion unit; whether it is one. More than a set may have is not kept.
    pub(super) fn take(&mut self, kind: &Kind, m: &Message<'_>, decode: bool) -> Result<bool> {
        if kind.is_motion() {
            self.bytes = self.bytes.saturating_add(m.data.len() as u64);
            if self.bytes > SET_MOTION_MAX_BYTES {
                *self = Self::default();
                let what =
                    format!("a set has more than {SET_MOTION_MAX_BYTES} bytes of motion before its mark");
                return Err(Error::new(ErrorKind::Corrupt, what));
            }
        }
        match kind {
            Kind::UnitInfo(unit) => {
                let (header, extra) = frame_info::read(m.data)?;
                self.batches.push(Waiting {
                    unit: unit.clone(),
                    log_time: m.log_time,
                    header: Box::new(header),
                    stamp_utc_ns: extra.stamp_utc_ns,
                    is_named: extra.codec == MOTION_CODEC && extra.frame_id == unit_frame(unit),
                    samples: None,
                });
            }
            Kind::Samples(unit) => {
                let samples = read_samples(m.data)?;
                let last = self.batches.iter_mut().rfind(|b| b.unit == *unit);
                match last.filter(|b| b.samples.is_none() && b.log_time == m.log_time) {
                    Some(batch) => batch.samples = Some(samples),
                    None => *self.stray.entry(unit.clone()).or_default() += 1,
                }
            }
            Kind::Imu(unit) => {
                let single = self.single.entry(unit.clone()).or_default();
                single.count += 1;
                if decode {
                    let (imu, frame_id) = Imu::read(m.data)?;
                    single.values.push((imu, m.publish_time));
                    single.frames_differ |= single.count > 1 && single.frame_id != frame_id;
                    frame_id.clone_into(&mut single.frame_id);
                }
            }
            _ => return Ok(false),
        }
        Ok(true)
    }
}

/// What is carried from batch to batch of a unit.
#[derive(Clone, Default)]
pub(super) struct Unit {
    /// Most samples of one batch, as the session says.
    most: u32,
    count: MotionCount,
    /// Number and time of the last sample, and the clock's epoch of its batch.
    last: Option<Last>,
}

#[derive(Clone, Copy)]
struct Last {
    batch: u64,
    number: u64,
    time_ns: i64,
    epoch: u32,
}

/// The motion units of a session.
#[derive(Clone, Default)]
pub(super) struct Units(BTreeMap<StreamId, Unit>);

impl Units {
    pub(super) fn new(session: &Session) -> Self {
        let unit = |most| Unit { most, ..Unit::default() };
        Self(session.motion.iter().map(|u| (u.id.clone(), unit(u.batch))).collect())
    }

    /// Samples so far.
    pub(super) fn samples(&self) -> u64 {
        self.0.values().map(|u| u.count.samples).sum()
    }

    /// What the channels of a segment have too much or too little.
    pub(super) fn channels<'a>(&self, kinds: &(impl Iterator<Item = &'a Kind> + Clone)) -> Vec<String> {
        let ids = |of: fn(&Kind) -> Option<&StreamId>| kinds.clone().filter_map(of).collect::<Vec<_>>();
        let all: [(&str, Vec<&StreamId>); 3] = [
            ("frame_info", ids(|k| if let Kind::UnitInfo(id) = k { Some(id) } else { None })),
            ("samples", ids(|k| if let Kind::Samples(id) = k { Some(id) } else { None })),
            ("data_raw", ids(|k| if let Kind::Imu(id) = k { Some(id) } else { None })),
        ];
        let mut problems = Vec::new();
        for (topic, there) in &all {
            for id in there.iter().filter(|id| !self.0.contains_key(**id)) {
                problems.push(format!("{id}/{topic} is of a motion unit that is not in the session"));
            }
            for id in self.0.keys().filter(|id| !there.contains(id)) {
                problems.push(format!("the motion unit {id} has no channel {topic}"));
            }
        }
        problems
    }

    /// What is to be said at the end. A gap is a note, as frames are that were lost live: the numbers show it, and what was
    /// handed to the recorder and is not here is said of its set.
    pub(super) fn finish(&self, findings: &mut Findings) {
        for (id, unit) in &self.0 {
            if unit.count.lost_batches > 0 {
                let what = format!("{} batches of {id} were not recorded", unit.count.lost_batches);
                findings.add(Severity::Note, crate::SESSION_FILE, None, what);
            }
            if unit.count.never_given > 0 {
                let what = format!(
                    "{} samples of {id} are missing: the device never gave them",
                    unit.count.never_given
                );
                findings.add(Severity::Note, crate::SESSION_FILE, None, what);
            }
        }
    }
}

impl Unit {
    /// What is wrong with a batch after the one before, in words.
    fn follow(&mut self, header: &FrameHeader, batch: Batch) -> Vec<String> {
        let mut problems = Vec::new();
        let replayed = header.flags & FrameFlags::REPLAYED.0 != 0;
        let before = self.last;
        for sample in &batch.samples {
            let last = Last {
                batch: header.sequence,
                number: sample.sequence,
                time_ns: sample.time_ns,
                epoch: header.clock_epoch,
            };
            let Some(before) = self.last.replace(last) else { continue };
            // A recorded replay may begin again at any batch.
            if replayed && before.batch != header.sequence {
                continue;
            }
            let same_epoch = before.epoch == header.clock_epoch;
            // A unit that was started anew may count anew.
            if sample.sequence <= before.number && same_epoch {
                problems.push(format!("sample {} follows sample {}", sample.sequence, before.number));
            }
            if sample.time_ns <= before.time_ns && same_epoch {
                let what = format!("the time of sample {} is not later than that before it", sample.sequence);
                problems.push(what);
            }
        }
        if self.last.is_some_and(|last| last.time_ns != header.capture_time_ns) && !batch.samples.is_empty() {
            problems.push("its time is not that of its newest sample".to_owned());
        }
        if before.is_some_and(|b| header.sequence <= b.batch) {
            problems.push("its number is not greater than that of the batch before".to_owned());
        }
        self.count.take(&RecordMotion { unit: 0, header: *header, samples: batch.samples });
        // One line is enough for a batch whose samples are all out of order.
        problems.truncate(3);
        problems
    }
}

/// Takes the motion of a set by its mark, which lies in the chunk at `offset`.
pub(super) fn set(walk: &mut Walk, pass: &mut Pass<'_>, set: &FrameSetMsg, log_time: u64, offset: u64) {
    let Messages { batches, stray, mut single, .. } = std::mem::take(&mut pass.motion);
    let mut problems = Vec::new();
    for (unit, n) in stray {
        problems.push(format!("{n} batches of {unit} have no frame_info"));
    }
    let mut expected: BTreeMap<StreamId, Vec<Imu>> = BTreeMap::new();
    for batch in batches {
        let Waiting { unit: id, log_time: at, header, stamp_utc_ns, is_named, samples } = batch;
        let mut say = |what: &str| problems.push(format!("batch {} of {id}: {what}", header.sequence));
        if at != log_time {
            say("it has another log time than its set");
            continue;
        }
        if !is_named {
            say("its frame_info names another frame or codec than a motion unit's");
        }
        if header.set_id != set.id {
            say("its frame_info is of another set");
        }
        let stamp = header.capture_time_ns.saturating_add(set.utc_offset_ns);
        if stamp_utc_ns != stamp || samples.as_ref().is_some_and(|s| s.stamp_utc_ns != stamp) {
            say("its stamp is not its time");
        }
        if let Some(what) = walk.header(&id, &header) {
            say(&what);
        }
        let Some(samples) = samples else {
            say("it has no samples");
            continue;
        };
        // Said of its channels already.
        let Some(unit) = walk.units.0.get_mut(&id) else { continue };
        if samples.sequence != header.sequence {
            say(&format!("its samples are those of batch {}", samples.sequence));
        }
        if let Err(what) = check_batch(&header, samples.samples.len(), unit.most) {
            say(&what);
        }
        let single = samples.samples.iter().map(|s| Imu::of(s, set.utc_offset_ns));
        expected.entry(id.clone()).or_default().extend(single);
        unit.follow(&header, samples).iter().for_each(|what| say(what));
    }
    for (id, expected) in expected {
        let got = single.remove(&id).unwrap_or_default();
        problems.extend(differing(&id, &expected, &got, walk.compares_singles));
    }
    for (id, got) in single {
        problems.push(format!("{} single samples of {id} belong to no batch", got.count));
    }
    for problem in problems {
        pass.broken(Some(offset), format!("set {}: {problem}", set.id));
    }
}

/// What the single samples of a unit in a set say otherwise than its batches.
fn differing(id: &StreamId, expected: &[Imu], got: &Single, decode: bool) -> Option<String> {
    if got.count != expected.len() as u64 {
        return Some(format!(
            "{id} has {} samples in its batches, {} single ones",
            expected.len(),
            got.count
        ));
    }
    if !decode {
        return None;
    }
    let frame_id = crate::msgs::tf::unit_frame(id);
    if got.frames_differ || got.frame_id != frame_id {
        return Some(format!("a single sample of {id} is of another frame than {frame_id}"));
    }
    let mut pairs = expected.iter().zip(&got.values);
    let at = pairs.position(|(e, (g, time))| {
        let same_time =
            e.stamp_utc_ns == g.stamp_utc_ns && u64::try_from(e.stamp_utc_ns).unwrap_or(0) == *time;
        !(same_time && e.same_values(g))
    });
    at.map(|at| format!("single sample {} of {id} says otherwise than its batch", at + 1))
}
