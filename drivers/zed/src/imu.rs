//! The stream `imu`: the IMU's samples out of its thread's queue, in batches.

use super::motion::{Motion, Sample};
use super::sensors::{RECORD_RATE_HZ, TICK_PS};
use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, HostTime, MetadataLevel, Pose};
use depthrig_driver::motion::{self, Batcher, Mark};
use depthrig_driver::{DeviceClock, FrameSink, Result, StreamProfile};
use std::sync::mpsc::Receiver;

/// Samples of a batch: 40 ms of them.
pub const BATCH: u32 = 16;
/// Suffix of a calibration that covers the cameras and not the IMU's pose.
pub const NO_POSE: &str = " (without the IMU's pose)";

/// For [`depthrig_driver::DeviceInfo::motion`].
pub const NOT_CORRECTED: &str =
    "accel_m_s2 and gyro_rad_s are as the unit measures them, not corrected for bias and scale";

/// The stream's one mode. Where the IMU sits in the camera is not in the factory's file, so that its pose is that of
/// the camera.
///
/// # Errors
/// None that can happen: the name is a good one.
pub fn profile() -> Result<StreamProfile> {
    let clock = DeviceClock { counter_bits: 64, tick_ps: TICK_PS, domain: ClockDomain::Device };
    motion::profile(RECORD_RATE_HZ, BATCH, Pose::IDENTITY, clock, MetadataLevel::Full)
}

/// An IMU that is delivered.
pub struct Imu {
    stream: usize,
    samples: Receiver<Sample>,
    batcher: Batcher,
    /// When the clock's quality is reported again.
    report_at: HostTime,
}

impl Imu {
    /// As stream number `stream`, of what [`Motion::start_streaming`] gives.
    pub fn new(stream: usize, profile: &StreamProfile, samples: Receiver<Sample>) -> Self {
        Self { stream, samples, batcher: Batcher::new(stream, profile), report_at: HostTime::from_ns(0) }
    }

    /// Hands on what has come, and what waited long enough. Whether a batch went.
    pub fn drain(&mut self, unit: Option<&Motion>, sink: &mut dyn FrameSink) -> bool {
        let mut went = false;
        while let Ok(sample) = self.samples.try_recv() {
            went |= self.take(&sample, sink);
        }
        let now = HostTime::now();
        went |= self.batcher.tick(now, sink);
        if went
            && now >= self.report_at
            && let Some(quality) = unit.and_then(Motion::quality)
        {
            sink.clock_quality(self.stream, &quality);
            self.report_at = now.plus(Duration::from_secs(1));
        }
        went
    }

    /// Waits at most `timeout` for a sample, for a camera of which nothing else is delivered.
    pub fn wait(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> bool {
        self.samples.recv_timeout(timeout).is_ok_and(|sample| self.take(&sample, sink))
    }

    fn take(&mut self, sample: &Sample, sink: &mut dyn FrameSink) -> bool {
        self.batcher.lose(sample.lost_before, DropReason::QueueFull, sink);
        let mark = Mark { arrival: sample.arrival, epoch: sample.epoch, flags: sample.flags };
        self.batcher.push(&sample.for_bus(), mark, sink)
    }
}
