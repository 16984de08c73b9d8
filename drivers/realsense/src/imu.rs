//! The stream `imu` of a D435i, a D455 or an L515: accelerometer and gyroscope behind the kernel's industrial I/O.
//!
//! **Samples.** Each sample of rotation is one of the stream's; a sample of acceleration goes along with the first
//! sample of rotation that is not before it, and says by how much it was earlier. Acceleration is never measured more
//! often, so none is lost. Both are corrected by the camera's calibration and turned to the axes of the depth camera,
//! as the vendor's software does it.
//!
//! **Time.** Both sensors have the microseconds of the camera's clock, whose two-way readings reach this map as they
//! reach those of the images.
//!
//! **Numbers.** The sensors have no counter. Samples are numbered by the clock, so that a missing one is a gap.
//!
//! **Switching.** The kernel takes seconds to switch a sensor on, so a thread does it while images come already, and
//! switches it off when the stream has ended.
//!
//! **Silence.** When a sensor falls silent, both are switched off and on again, with growing pauses, and are given up
//! after a number of tries. Images go on meanwhile.

#[cfg(test)]
pub(super) mod fake;
mod merge;
mod revival;
mod switch;
mod unit;

use super::control::Probe;
use super::protocol::imu::{ImuCalibration, Rates};
use crate::iio::{Scan, Sensor};
use depthrig_bus::{HostTime, MotionSample};
use depthrig_driver::clock::{ClockConfig, ClockMap};
use depthrig_driver::motion::{Batcher, Mark};
use depthrig_driver::{Error, ErrorKind, FrameSink, Result, StreamProfile};
use merge::{Merge, Reading};
use revival::{Revival, Step};
use switch::Switcher;
pub(super) use unit::{Opening, Unit, choose_imu, separated};

/// Samples of a batch: 40 ms of them at 400 Hz.
pub(super) const BATCH: u32 = 16;
/// Between two statements of how the clock's map is doing.
const QUALITY: core::time::Duration = core::time::Duration::from_secs(1);

/// The sensors, which only one process can read.
#[derive(Debug)]
pub(super) struct Sensors {
    accelerometer: Sensor,
    gyroscope: Sensor,
}

/// The sensors while they are looked after.
#[derive(Debug)]
struct Running {
    sensors: Sensors,
    switcher: Switcher,
    revival: Revival,
    /// They are being switched on or off.
    is_switching: bool,
    /// They were on at least once: before that, they hold samples that another process left unread.
    was_on: bool,
    /// When the accelerometer and the gyroscope last measured.
    heard: [HostTime; 2],
    /// Why they could not be switched on last.
    refusal: Option<Error>,
}

/// A streaming IMU. Dropping it switches the sensors off.
#[derive(Debug)]
pub(super) struct Imu {
    stream: usize,
    label: String,
    calibration: ImuCalibration,
    /// `None` when they were given up.
    running: Option<Running>,
    /// Why they were given up, until it is taken.
    ended: Option<Error>,
    clock: ClockMap,
    merge: Merge,
    batcher: Batcher,
    last: Option<(u32, HostTime)>,
    tell_at: HostTime,
    scans: Vec<Scan>,
}

impl Imu {
    fn new(stream: usize, profile: &StreamProfile, opening: Opening) -> Self {
        let Opening { label, calibration, rates, sensors, switcher, revival } = opening;
        let Rates { gyro_hz, .. } = rates;
        let period_ns = (1e9 / gyro_hz) as u64;
        let mut clock = ClockMap::new(ClockConfig::new(32, 1000.0, period_ns));
        clock.expect_probes();
        let heard = [HostTime::now(); 2];
        let running =
            Running { sensors, switcher, revival, is_switching: true, was_on: false, heard, refusal: None };
        Self {
            stream,
            label,
            calibration,
            running: Some(running),
            ended: None,
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

    /// Why the sensors were given up, once.
    pub(super) const fn take_end(&mut self) -> Option<Error> {
        self.ended.take()
    }

    /// Hands on what has come, and what waited long enough. Whether a batch went.
    pub(super) fn drain(&mut self, sink: &mut dyn FrameSink) -> bool {
        let mut went = false;
        if let Err(e) = self.read(&mut went, sink).and_then(|()| self.look_after()) {
            // Images go on without it; a camera that is gone says so by its images.
            tracing::warn!(camera = %self.label, error = %e, "the IMU is no longer read");
            self.running = None;
            self.ended = Some(e);
        }
        let now = HostTime::now();
        went |= self.batcher.tick(now, sink);
        if went && now >= self.tell_at {
            sink.clock_quality(self.stream, &self.clock.quality());
            self.tell_at = now.plus(QUALITY);
        }
        went
    }

    /// Sees to it that the sensors are on and measure.
    fn look_after(&mut self) -> Result<()> {
        let Some(running) = &mut self.running else { return Ok(()) };
        let now = HostTime::now();
        if running.is_switching {
            let Some(outcome) = running.switcher.outcome() else { return Ok(()) };
            running.is_switching = false;
            running.revival.switched(now);
            running.refusal = match outcome {
                Ok(()) => {
                    running.was_on = true;
                    None
                }
                Err(e) if matches!(e.kind(), ErrorKind::Disconnected | ErrorKind::PermissionDenied) => {
                    return Err(e);
                }
                Err(e) => Some(e),
            };
        }
        let [accelerometer, gyroscope] = running.heard;
        let why = || match &running.refusal {
            Some(e) => e.to_string(),
            None if accelerometer < gyroscope => "its accelerometer is silent".to_owned(),
            None => "its gyroscope is silent".to_owned(),
        };
        match running.revival.step(now, accelerometer.min(gyroscope)) {
            Step::Wait => return Ok(()),
            Step::Revived(tries) => {
                tracing::info!(camera = %self.label, tries, "its IMU measures again");
                return Ok(());
            }
            Step::GiveUp(tries) => {
                let text = format!(
                    "{}, although it was switched off and on {tries} times; plug the camera in anew",
                    why()
                );
                return Err(Error::new(ErrorKind::Stalled, text));
            }
            Step::Restart(1) => {
                let why = why();
                tracing::warn!(camera = %self.label, "{why}; the IMU is switched off and on until it measures");
            }
            Step::Restart(tries) => tracing::debug!(camera = %self.label, tries, "{}", why()),
        }
        running.switcher.restart();
        running.is_switching = true;
        Ok(())
    }

    fn read(&mut self, went: &mut bool, sink: &mut dyn FrameSink) -> Result<()> {
        let Some(running) = &mut self.running else { return Ok(()) };
        let Running { sensors: Sensors { accelerometer, gyroscope }, was_on, heard, .. } = running;
        if !*was_on {
            accelerometer.drain(|_| {})?;
            return gyroscope.drain(|_| {});
        }
        let mut is_accelerometer_heard = false;
        // Acceleration first: what was measured before a rotation has come before it.
        accelerometer.drain(|scan| {
            is_accelerometer_heard = true;
            let value = self.calibration.acceleration_m_s2(scan.axes);
            self.merge.acceleration(Reading { ticks: ticks(&scan), value });
        })?;
        let bits = gyroscope.bits();
        self.scans.clear();
        gyroscope.drain(|scan| self.scans.push(scan))?;
        let arrival = HostTime::now();
        let is_heard = [is_accelerometer_heard, !self.scans.is_empty()];
        for (heard, _) in heard.iter_mut().zip(is_heard).filter(|(_, is_heard)| *is_heard) {
            *heard = arrival;
        }
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

#[cfg(test)]
mod tests;
