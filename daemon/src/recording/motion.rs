//! IMU batches on their way into a recording: they wait for the next set that is handed over, in the order in which
//! they came.
//!
//! Of an IMU at most [`TIMEOUT_S`] of batches wait, or those of two sets where sets are rarer than that, but no more
//! than its share of what one set may hold; the oldest go first, and are counted. Batches that still wait when a
//! recording ends came after its last set and are not recorded.

use super::StreamFacts;
use super::waiting::Waiting;
use crate::status::SetAccount;
use crate::stream::Stream;
use depthrig_bus::{DropCounts, DropReason, Frame, StreamId};
use depthrig_calib::PoseExt;
use depthrig_recorder::{MotionRecord, RecordMotion, SET_MOTION_MAX_BYTES, StreamAccount};
use std::collections::BTreeMap;
use std::sync::Arc;

/// How long batches wait for a set, seconds.
const TIMEOUT_S: f64 = 4.0;
/// Batches a second of a unit whose batches are sent before they are full: none waits for more than 100 ms.
const LEAST_HZ: f64 = 10.0;

/// The IMUs of one recording.
pub(super) struct Units {
    units: Vec<Unit>,
    waiting: Waiting<RecordMotion>,
}

struct Unit {
    stream: Arc<Stream>,
    /// Batches that went to the recorder with sets.
    handed: u64,
    /// Batches that were lost on the way here: replaced on the channel, or pushed out while they waited.
    lost: u64,
    /// Losses before the recording.
    dropped: DropCounts,
}

/// Fate of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Heard {
    /// It waits for the next set.
    Waits,
    /// So it does, and the oldest batch of its unit was pushed out for it.
    PushedOut,
    /// Nobody records it.
    NotRecorded,
}

impl Units {
    /// The units among the streams of a recording of about `sets_hz` sets a second.
    pub(super) fn new(units: &[StreamFacts], sets_hz: f64) -> Self {
        let share = SET_MOTION_MAX_BYTES / units.len().max(1) as u64;
        let most = |s: &StreamFacts| {
            let profile = &s.stream.profile;
            let of_sets = (profile.rate_hz.max(LEAST_HZ) * TIMEOUT_S.max(2.0 / sets_hz)).ceil();
            let fit = share / RecordMotion::stored_bytes_of(profile.width.into());
            (of_sets as u64).min(fit).max(1)
        };
        let unit = |s: &StreamFacts| Unit {
            stream: Arc::clone(&s.stream),
            handed: 0,
            lost: 0,
            dropped: DropCounts::default(),
        };
        let mut waiting = Waiting::new();
        for unit in units {
            waiting.add_source(most(unit));
        }
        Self { units: units.iter().map(unit).collect(), waiting }
    }

    /// The recording begins now: losses from here on are its own.
    pub(super) fn begin(&mut self) {
        for unit in &mut self.units {
            unit.dropped = unit.stream.books().dropped;
        }
    }

    /// Takes in a batch, before which `missed` were replaced on the channel.
    fn hear(&mut self, id: &StreamId, frame: &Frame, missed: u64) -> Heard {
        let Some(index) = self.units.iter().position(|u| u.stream.id == *id) else {
            return Heard::NotRecorded;
        };
        let unit = &mut self.units[index];
        unit.lost += missed;
        let samples = frame.motion().collect();
        let batch = RecordMotion { unit: index, header: *frame.header(), samples };
        let gone = self.waiting.push(index, 1, batch);
        unit.lost += gone;
        if gone > 0 { Heard::PushedOut } else { Heard::Waits }
    }

    /// Everything that waits.
    fn take(&mut self) -> Vec<RecordMotion> {
        self.waiting.take_all()
    }

    /// Counts the batches that go to the recorder with a set.
    pub(super) fn hand_over(&mut self, motion: &[RecordMotion]) {
        for batch in motion {
            if let Some(unit) = self.units.get_mut(batch.unit) {
                unit.handed += 1;
            }
        }
    }

    /// Accounts of the IMUs since the recording began, except for batches that wait.
    pub(super) fn accounts(&self) -> impl Iterator<Item = StreamAccount> + '_ {
        self.units.iter().map(|u| {
            let mut dropped = u.stream.books().dropped;
            for (now, before) in dropped.0.iter_mut().zip(u.dropped.0) {
                *now -= before;
            }
            dropped.add(DropReason::QueueFull, u.lost);
            StreamAccount {
                stream: u.stream.id.clone(),
                captured: u.handed + dropped.total(),
                delivered: u.handed,
                dropped,
            }
        })
    }
}

/// Accounts of every IMU's batches over all recordings and between them.
#[derive(Default)]
pub(super) struct Books(BTreeMap<StreamId, SetAccount>);

impl Books {
    /// Takes in a batch of `id`, before which `missed` were replaced on the channel; it goes to `recording`, if there is one.
    pub(super) fn hear(&mut self, recording: Option<&mut Units>, id: &StreamId, frame: &Frame, missed: u64) {
        let account = match self.0.get_mut(id) {
            Some(account) => account,
            None => self.0.entry(id.clone()).or_default(),
        };
        account.missed += missed;
        match recording.map_or(Heard::NotRecorded, |units| units.hear(id, frame, missed)) {
            Heard::Waits => account.pending += 1,
            Heard::PushedOut => account.overflow += 1,
            Heard::NotRecorded => account.decimated += 1,
        }
    }

    /// Everything that waits in `units`, for the set that is handed over now.
    pub(super) fn take(&mut self, units: &mut Units) -> Vec<RecordMotion> {
        for (index, unit) in units.units.iter().enumerate() {
            if let Some(account) = self.0.get_mut(&unit.stream.id) {
                let waiting = units.waiting.count(index) as u64;
                account.pending -= waiting;
                account.used += waiting;
            }
        }
        units.take()
    }

    /// The recording of `units` ends: waiting batches came after its last set.
    pub(super) fn end(&mut self, units: &mut Units) {
        for (index, unit) in units.units.iter().enumerate() {
            let left = units.waiting.take(index).count() as u64;
            if let Some(account) = self.0.get_mut(&unit.stream.id) {
                account.pending -= left;
                account.decimated += left;
            }
        }
    }

    /// The accounts, unit by unit.
    pub(super) fn accounts(&self) -> impl Iterator<Item = (&StreamId, SetAccount)> {
        self.0.iter().map(|(id, account)| (id, *account))
    }
}

/// How `session.toml` lists a unit.
pub(super) fn record_of(s: &StreamFacts) -> MotionRecord {
    let p = &s.stream.profile;
    MotionRecord {
        id: s.stream.id.clone(),
        model: s.model.clone(),
        serial: s.serial.clone(),
        rate_hz: p.samples_hz(),
        batch: p.width,
        calibration: s.calibration.clone(),
        pose: s.camera_pose.compose(&p.pose_in_device),
    }
}

#[cfg(test)]
mod tests;
