//! The IMU of a recording that is imported: its samples in batches, each with its set.
//!
//! A batch goes with the first set that is not earlier than its newest sample and was not handed on yet, and batches
//! after the last set with the last. So nothing is left out, unless a file has no image at all or none for a minute.

use depthrig_bus::{ClockDomain, DropCounts, DropReason, FrameHeader, MotionSample, PixelFormat};
use depthrig_driver::motion::LONGEST;
use depthrig_kinect::motion::{Measured, Samples, is_plausible};
use depthrig_kinect::recording::motion_samples;
use depthrig_recorder::{MotionRecord, RecordMotion, RecordSet, StreamAccount};
use std::collections::VecDeque;

/// Batches that wait for a set at the most: a minute of them.
const MOST_WAITING: usize = 1500;
/// The device's clock counts microseconds.
const UNCERTAINTY_NS: u32 = 1000;

/// The IMU, its account and the batches that wait for a set.
pub(super) struct Unit {
    record: MotionRecord,
    track: usize,
    numbers: Samples,
    /// The batch in the making.
    open: Vec<MotionSample>,
    /// The device's time of the newest sample.
    newest_ns: Option<u64>,
    waiting: VecDeque<RecordMotion>,
    batches: u64,
    samples: u64,
    left_out: u64,
    dropped: DropCounts,
}

impl Unit {
    /// The unit whose samples are on `track`.
    pub(super) fn new(record: MotionRecord, track: usize) -> Self {
        Self {
            open: Vec::with_capacity(record.batch as usize),
            record,
            track,
            numbers: Samples::default(),
            newest_ns: None,
            waiting: VecDeque::new(),
            batches: 0,
            samples: 0,
            left_out: 0,
            dropped: DropCounts::default(),
        }
    }

    /// Its part of the session.
    pub(super) const fn record(&self) -> &MotionRecord {
        &self.record
    }

    /// The track of its samples.
    pub(super) const fn track(&self) -> usize {
        self.track
    }

    /// Samples that are in sets.
    pub(super) fn samples(&self) -> u64 {
        self.samples - self.waiting_samples()
    }

    /// Samples that are in none.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out + self.waiting_samples() + self.open.len() as u64
    }

    fn waiting_samples(&self) -> u64 {
        self.waiting.iter().map(|b| b.samples.len() as u64).sum()
    }

    /// Account of its batches.
    pub(super) fn account(&self) -> StreamAccount {
        let delivered = self.batches - self.waiting.len() as u64;
        StreamAccount {
            stream: self.record.id.clone(),
            captured: delivered.saturating_add(self.dropped.total()),
            delivered,
            dropped: self.dropped,
        }
    }

    /// Takes the samples of a frame of the block at `device_us`; UTC at the device's time 0 is `origin_ns`.
    pub(super) fn take(&mut self, frame: &[u8], device_us: u64, origin_ns: i64) {
        for raw in motion_samples(frame) {
            // As images: a sample not later than the one before is left out, and one with an implausible time.
            let is_late = self.newest_ns.is_some_and(|newest| raw.gyroscope_ns < newest);
            if is_late || !is_plausible(raw.gyroscope_ns, device_us) {
                self.left_out += 1;
                continue;
            }
            self.newest_ns = Some(raw.gyroscope_ns);
            let Some(mut sample) = self.numbers.take(&Measured::from(raw)) else { continue };
            let device_ns = i64::try_from(raw.gyroscope_ns).unwrap_or(i64::MAX);
            sample.time_ns = origin_ns.saturating_add(device_ns);
            sample.uncertainty_ns = UNCERTAINTY_NS;
            let is_old = self.open.first().is_some_and(|first| {
                sample.time_ns.saturating_sub(first.time_ns) >= LONGEST.as_nanos() as i64
            });
            if is_old {
                self.close();
            }
            self.open.push(sample);
            if self.open.len() >= self.record.batch as usize {
                self.close();
            }
        }
    }

    /// Ends the batch in the making.
    fn close(&mut self) {
        let Some(newest) = self.open.last().copied() else { return };
        let samples = core::mem::replace(&mut self.open, Vec::with_capacity(self.record.batch as usize));
        if self.waiting.len() >= MOST_WAITING {
            self.left_out += samples.len() as u64;
            self.dropped.add(DropReason::QueueFull, 1);
            return;
        }
        self.batches += 1;
        self.samples += samples.len() as u64;
        let mut header = FrameHeader {
            sequence: self.batches,
            captured: self.batches.saturating_add(self.dropped.total()),
            dropped: self.dropped.0,
            device_sequence: newest.sequence,
            device_time: newest.device_time,
            device_tick_ns: 1000.0,
            capture_time_ns: newest.time_ns,
            capture_uncertainty_ns: UNCERTAINTY_NS.into(),
            arrival_time_ns: newest.time_ns,
            publish_time_ns: newest.time_ns,
            pose: self.record.pose,
            clock_domain: ClockDomain::Device as u32,
            ..FrameHeader::default()
        };
        header.set_names("rig", &self.record.id);
        header.set_device(&self.record.model, &self.record.serial);
        header.set_image(PixelFormat::Motion, samples.len() as u32, 1);
        self.waiting.push_back(RecordMotion { unit: 0, header, samples });
    }

    /// Gives `set` the batches that are not later.
    pub(super) fn hand_over(&mut self, set: &mut RecordSet) {
        let tick_ns = set.tick.ns();
        while self.waiting.front().is_some_and(|b| b.header.capture_time_ns <= tick_ns) {
            set.motion.extend(self.waiting.pop_front());
        }
    }

    /// Gives the last set the remaining batches; without one they are left out.
    pub(super) fn end(&mut self, last: Option<&mut RecordSet>) {
        self.close();
        let rest = core::mem::take(&mut self.waiting);
        if let Some(set) = last {
            set.motion.extend(rest);
            return;
        }
        for batch in rest {
            let n = batch.samples.len() as u64;
            self.samples -= n;
            self.left_out += n;
            self.batches -= 1;
            self.dropped.add(DropReason::QueueFull, 1);
        }
    }
}
