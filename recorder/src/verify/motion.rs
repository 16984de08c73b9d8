//! IMUs: complete batches in their order, and the single samples beside them.

mod set;

use super::{Findings, Severity};
use crate::container::scan::Message;
use crate::dataset::{Kind, MotionCount, Removed};
use crate::msgs::frame_info;
use crate::msgs::motion::{Batch, Imu, read_samples};
use crate::msgs::tf::unit_frame;
use crate::recorder::topics::MOTION_CODEC;
use crate::{RecordMotion, Result, Session};
use depthrig_bus::{FrameFlags, FrameHeader, StreamId};
use std::collections::BTreeMap;

pub(super) use set::set;

/// The messages of IMUs since the last commit mark.
#[derive(Default)]
pub(super) struct Messages {
    batches: Vec<Waiting>,
    /// Samples without a header before them, by IMU.
    stray: BTreeMap<StreamId, u64>,
    /// Of each IMU.
    single: BTreeMap<StreamId, Single>,
}

/// A batch that waits for its set's mark.
struct Waiting {
    unit: StreamId,
    log_time: u64,
    header: Box<FrameHeader>,
    stamp_utc_ns: i64,
    /// Frame and codec are those of an IMU.
    is_named: bool,
    samples: Option<Batch>,
}

/// The single samples of an IMU.
#[derive(Default)]
struct Single {
    count: u64,
    /// Their values, each with the time of its record; only when decoding.
    values: Vec<(Imu, u64)>,
    frame_id: String,
    /// They are not all of one frame.
    frames_differ: bool,
}

impl Messages {
    /// Takes a message of an IMU; whether it is one.
    pub(super) fn take(&mut self, kind: &Kind, m: &Message<'_>, decode: bool) -> Result<bool> {
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

/// State kept from batch to batch of an IMU.
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

/// The IMUs of a session.
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

    /// IMU channels that a segment has too many or too few.
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
                problems.push(format!("{id}/{topic} is of an IMU that is not in the session"));
            }
            for id in self.0.keys().filter(|id| !there.contains(id)) {
                problems.push(format!("the IMU {id} has no channel {topic}"));
            }
        }
        problems
    }

    /// Adds the findings at the end. A gap is a note, like frames lost live: the numbers show it, and losses after the
    /// hand-over to the recorder are findings of their set.
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
    /// Checks a batch against the one before; the problems in words.
    fn follow(
        &mut self,
        header: &FrameHeader,
        batch: Batch,
        set_utc_ns: i64,
        removed: &Removed,
    ) -> Vec<String> {
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
            // An IMU that was restarted may count from the beginning.
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
        let batch = RecordMotion { unit: 0, header: *header, samples: batch.samples };
        self.count.take(&batch, set_utc_ns, removed);
        // One line is enough for a batch whose samples are all out of order.
        problems.truncate(3);
        problems
    }
}
