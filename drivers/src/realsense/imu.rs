//! The stream `imu` of a D435i, a D455 or an L515: accelerometer and gyroscope behind the kernel's industrial I/O.
//!
//! **Samples.** Each sample of rotation is one of the stream's; a sample of acceleration goes along with the first sample of
//! rotation that is not before it, and says by how much it was earlier. Acceleration is never measured more often, so
//! none is lost. Both are corrected by the camera's calibration and turned to the axes of the depth camera, as the
//! vendor's software does it.
//!
//! **Time.** Both sensors have the microseconds of the camera's clock, whose two-way readings reach this map as they reach
//! those of the images.
//!
//! **Numbers.** There is no counter. Samples are numbered by the clock, so that one that never came is a gap.
//!
//! **Switching.** The kernel takes seconds to switch a sensor on, so a thread does it while images come already, and switches it
//! off when the stream has ended.

mod merge;
mod unit;

use super::control::Probe;
use super::protocol::imu::{ImuCalibration, Rates};
use crate::clock::{ClockConfig, ClockMap};
use crate::iio::{Scan, Sensor};
use crate::motion::{Batcher, Mark};
use crate::{Error, FrameSink, StreamProfile};
use depthrig_bus::{HostTime, MotionSample};
use merge::{Merge, Reading};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
pub(super) use unit::{Opening, Unit, choose_imu, separated};

/// Samples of a batch: 40 ms of them at 400 Hz.
pub(super) const BATCH: u32 = 16;
/// Between two statements of how the clock's map is doing.
const QUALITY: core::time::Duration = core::time::Duration::from_secs(1);

/// The sensors, once they are on.
#[derive(Debug)]
pub(super) struct Sensors {
    accelerometer: Sensor,
    gyroscope: Sensor,
}

/// A streaming IMU. Dropping it switches the sensors off.
#[derive(Debug)]
pub(super) struct Imu {
    stream: usize,
    label: String,
    calibration: ImuCalibration,
    starting: Receiver<crate::Result<Sensors>>,
    sensors: Option<Sensors>,
    /// Ends the thread that switches.
    _stop: SyncSender<()>,
    is_over: bool,
    clock: ClockMap,
    merge: Merge,
    batcher: Batcher,
    last: Option<(u32, HostTime)>,
    tell_at: HostTime,
    scans: Vec<Scan>,
}

impl Imu {
    fn new(stream: usize, profile: &StreamProfile, opening: Opening) -> Self {
        let Opening { label, calibration, rates, starting, stop } = opening;
        let Rates { gyro_hz, .. } = rates;
        let period_ns = (1e9 / gyro_hz) as u64;
        let mut clock = ClockMap::new(ClockConfig::new(32, 1000.0, period_ns));
        clock.expect_probes();
        Self {
            stream,
            label,
            calibration,
            starting,
            sensors: None,
            _stop: stop,
            is_over: false,
            clock,
            merge: Merge::new(period_ns / 1000),
            batcher: Batcher::new(stream, profile),
            last: None,
            tell_at: HostTime::from_ns(0),
            scans: Vec::with_capacity(1024),
        }
    }

    /// Takes a reading of the camera's clock.
    pub(super) fn probe(&mut self, probe: Probe) {
        self.clock.probe(probe.before, probe.ticks.into(), probe.after);
    }

    /// Hands on what has come, and what waited long enough. Whether a batch went.
    pub(super) fn drain(&mut self, sink: &mut dyn FrameSink) -> bool {
        if self.is_over {
            return self.batcher.tick(HostTime::now(), sink);
        }
        if self.sensors.is_none() {
            match self.starting.try_recv() {
                Ok(Ok(sensors)) => self.sensors = Some(sensors),
                Ok(Err(e)) => self.end(&e),
                Err(TryRecvError::Empty) => {}
                Err(TryRecvError::Disconnected) => self.is_over = true,
            }
        }
        let mut went = false;
        if let Err(e) = self.read(&mut went, sink) {
            self.end(&e);
        }
        let now = HostTime::now();
        went |= self.batcher.tick(now, sink);
        if went && now >= self.tell_at {
            sink.clock_quality(self.stream, &self.clock.quality());
            self.tell_at = now.plus(QUALITY);
        }
        went
    }

    /// Images go on without it; a camera that is gone says so by its images.
    fn end(&mut self, e: &Error) {
        tracing::warn!(camera = %self.label, error = %e, "the IMU is no longer read");
        self.is_over = true;
        self.sensors = None;
    }

    fn read(&mut self, went: &mut bool, sink: &mut dyn FrameSink) -> crate::Result<()> {
        let Some(Sensors { accelerometer, gyroscope }) = &mut self.sensors else { return Ok(()) };
        // Acceleration first: what was measured before a rotation has come before it.
        accelerometer.drain(|scan| {
            let value = self.calibration.acceleration_m_s2(scan.axes);
            self.merge.acceleration(Reading { ticks: ticks(&scan), value });
        })?;
        let bits = gyroscope.bits();
        self.scans.clear();
        gyroscope.drain(|scan| self.scans.push(scan))?;
        let arrival = HostTime::now();
        for scan in &self.scans {
            let rotation =
                Reading { ticks: ticks(scan), value: self.calibration.rotation_rad_s(scan.axes, bits) };
            let merged = self.merge.rotation(&rotation);
            let mapped = self.clock.observe(rotation.ticks.into(), merged.sequence, arrival);
            // Ticks that stand still are another sample all the same, and samples of an epoch rise.
            let time = match self.last {
                Some((epoch, last)) if epoch == mapped.epoch && mapped.capture_time <= last => {
                    last.plus_ns(1)
                }
                _ => mapped.capture_time,
            };
            self.last = Some((mapped.epoch, time));
            let acceleration = merged.acceleration;
            let sample = MotionSample {
                time_ns: time.ns(),
                device_time: mapped.device_time,
                sequence: merged.sequence,
                uncertainty_ns: u32::try_from(mapped.uncertainty_ns).unwrap_or(u32::MAX),
                accel_offset_ns: acceleration.map_or(0, |a| a.offset_ns),
                gyro_rad_s: rotation.value,
                accel_m_s2: acceleration.map_or([f32::NAN; 3], |a| a.value),
                ..MotionSample::default()
            };
            let mark = Mark { arrival, epoch: mapped.epoch, flags: mapped.flags };
            *went |= self.batcher.push(&sample, mark, sink);
        }
        Ok(())
    }
}

/// Microseconds of the camera's clock, which has 32 bits of them; the kernel multiplies them by 1000.
const fn ticks(scan: &Scan) -> u32 {
    (scan.time_ns / 1000) as u32
}
