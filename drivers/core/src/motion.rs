//! Batches of IMU samples, shared by the drivers of IMUs.
//!
//! An IMU measures hundreds of times a second, so that its stream carries batches ([`depthrig_bus::MotionSample`]). A
//! driver maps each sample's time and pushes it; the [`Batcher`] keeps the samples of one batch and hands them on,
//! copied once into lent memory, when the batch is full, when it is [`LONGEST`] old, or when the clock's map changes,
//! so that a batch has one epoch. It allocates nothing after its construction.
//!
//! **Accounts** count batches, as those of an image stream count images: `captured = delivered + Σ dropped` after every
//! call. A batch without memory for it is dropped (`no_slot`), and its samples are a gap in the samples' numbers.

use crate::{DeviceClock, Error, ErrorKind, FrameMeta, FrameSink, Result, StreamProfile};
use core::time::Duration;
use depthrig_bus::{
    ClockDomain, DropReason, FrameFlags, HostTime, Intrinsics, MOTION_SAMPLE_BYTES, MetadataLevel,
    MotionSample, Name, PixelFormat, Pose,
};

/// Name of the stream of an IMU.
pub const IMU: &str = "imu";
/// The longest that a sample waits for its batch to become full.
pub const LONGEST: Duration = Duration::from_millis(100);

/// The profile of an IMU that measures `samples_hz` times a second, `batch` samples to a frame.
///
/// # Errors
/// None that can happen: the name is a good one.
pub fn profile(
    samples_hz: f64,
    batch: u32,
    pose_in_device: Pose,
    clock: DeviceClock,
    metadata: MetadataLevel,
) -> Result<StreamProfile> {
    let stream = Name::new(IMU)
        .map_err(|e| Error::new(ErrorKind::BadInput, format!("stream {IMU}")).with_source(e))?;
    Ok(StreamProfile {
        stream,
        format: PixelFormat::Motion,
        width: batch,
        height: 1,
        rate_hz: samples_hz / f64::from(batch),
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device,
        clock,
        sequence_bits: 64,
        metadata,
    })
}

/// Metadata of a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mark {
    /// When it had arrived.
    pub arrival: HostTime,
    /// The clock map in force.
    pub epoch: u32,
    /// Facts about its time (`TIME_UNCERTAIN`, `CLOCK_WARMUP`, `EPOCH_CHANGED`, `LATE`). A batch has those of all its
    /// samples.
    pub flags: FrameFlags,
}

/// Makes batches of one stream's samples.
#[derive(Debug)]
pub struct Batcher {
    stream: usize,
    domain: ClockDomain,
    /// Flags of every batch.
    flags: FrameFlags,
    /// The samples of the current batch, and how many.
    bytes: Box<[u8]>,
    len: usize,
    capacity: usize,
    newest: MotionSample,
    mark: Mark,
    /// When the batch is [`LONGEST`] old.
    due: HostTime,
    captured: u64,
    delivered: u64,
}

impl Batcher {
    /// Batches of stream number `stream`, of at most the profile's width.
    pub fn new(stream: usize, profile: &StreamProfile) -> Self {
        let capacity = (profile.width as usize).max(1);
        let start = HostTime::from_ns(0);
        Self {
            stream,
            domain: profile.clock.domain,
            flags: profile.metadata.flags(),
            bytes: vec![0; capacity * MOTION_SAMPLE_BYTES].into(),
            len: 0,
            capacity,
            newest: MotionSample::default(),
            mark: Mark { arrival: start, epoch: 0, flags: FrameFlags(0) },
            due: start,
            captured: 0,
            delivered: 0,
        }
    }

    /// Batches made or lost so far.
    pub const fn captured(&self) -> u64 {
        self.captured
    }

    /// Batches published so far.
    pub const fn delivered(&self) -> u64 {
        self.delivered
    }

    /// When the current batch must be handed on; `None` without one.
    pub const fn due(&self) -> Option<HostTime> {
        if self.len == 0 { None } else { Some(self.due) }
    }

    /// Takes a sample; samples come in the order of their numbers. Whether a batch went out or was dropped.
    pub fn push(&mut self, sample: &MotionSample, mark: Mark, sink: &mut dyn FrameSink) -> bool {
        let mut went = self.tick(mark.arrival, sink);
        if self.len > 0 && mark.epoch != self.mark.epoch {
            went |= self.flush(sink);
        }
        if self.len == 0 {
            self.due = mark.arrival.plus(LONGEST);
            self.mark.flags = FrameFlags(0);
        }
        let at = self.len * MOTION_SAMPLE_BYTES;
        if let Some(to) = self.bytes.get_mut(at..at + MOTION_SAMPLE_BYTES) {
            to.copy_from_slice(&sample.to_bytes());
            self.len += 1;
        }
        self.newest = *sample;
        self.mark = Mark { flags: self.mark.flags.with(mark.flags), ..mark };
        if self.len == self.capacity {
            went |= self.flush(sink);
        }
        went
    }

    /// Sends the current batch if it is [`LONGEST`] old. Whether it went out or was dropped.
    pub fn tick(&mut self, now: HostTime, sink: &mut dyn FrameSink) -> bool {
        self.len > 0 && now >= self.due && self.flush(sink)
    }

    /// Sends the current batch, whatever its age. Whether there was one.
    pub fn flush(&mut self, sink: &mut dyn FrameSink) -> bool {
        if self.len == 0 {
            return false;
        }
        let used = core::mem::take(&mut self.len) * MOTION_SAMPLE_BYTES;
        self.captured += 1;
        sink.captured(self.stream, 1);
        let samples = self.bytes.get(..used).unwrap_or_default();
        let Some(memory) = sink.loan(self.stream, used) else {
            sink.dropped(self.stream, DropReason::NoSlot, 1);
            return true;
        };
        memory.copy_from_slice(samples);
        self.delivered += 1;
        let Self { newest, mark, .. } = *self;
        let uncertainty =
            if newest.uncertainty_ns == u32::MAX { u64::MAX >> 1 } else { newest.uncertainty_ns.into() };
        sink.commit(
            self.stream,
            &FrameMeta {
                device_sequence: newest.sequence,
                device_time: newest.device_time,
                capture_time: newest.time(),
                capture_uncertainty_ns: uncertainty,
                clock_epoch: mark.epoch,
                clock_domain: self.domain,
                arrival: mark.arrival,
                flags: mark.flags.with(self.flags),
                captured: self.captured,
                exposure_ns: 0,
                gain: 0.0,
                temperature_c: newest.temperature_c,
                latency_ns: 0,
            },
        );
        true
    }

    /// Says that `samples` samples, those after the last one that was pushed, were lost for `reason` on this computer:
    /// counted as the batches that they would have filled.
    pub fn lose(&mut self, samples: u64, reason: DropReason, sink: &mut dyn FrameSink) {
        if samples == 0 {
            return;
        }
        self.flush(sink);
        let batches = samples.div_ceil(self.capacity as u64);
        self.captured += batches;
        sink.captured(self.stream, batches);
        sink.dropped(self.stream, reason, batches);
    }
}

#[cfg(test)]
mod tests;
