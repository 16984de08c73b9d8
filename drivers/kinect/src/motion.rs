//! The IMU of a Kinect, attached or recorded, as the stream `imu`.
//!
//! **Frame.** Gyroscope and accelerometer have extrinsics of their own in the calibration; that of the gyroscope has no
//! place, since a rotation has none. The IMU's frame is the accelerometer's. Both are passed on bit by bit, each along
//! its own axes; how the gyroscope's are rotated in the IMU's frame is stated where the calibration is, see
//! [`gyroscope_in_unit`].
//!
//! **Time.** A sample's time is the gyroscope's, on the clock that also stamps the images, so that `device_time` of
//! both can be compared. The map to the host's clock is the IMU's own: a sample comes tens of milliseconds sooner than
//! an image of the same moment, and no time may be later than its arrival. Samples that came together are mapped by
//! their newest.
//!
//! **Numbers** are reckoned from the times, as those of the images are.

use super::calibration::Calibration;
use super::live::counter::FrameCounter;
use core::time::Duration;
use depthrig_bus::{ClockDomain, FrameFlags, HostTime, MetadataLevel, MotionSample, Pose};
use depthrig_driver::clock::{ClockConfig, ClockMap};
use depthrig_driver::motion::{self, Batcher, Mark};
use depthrig_driver::{DeviceClock, FrameSink, Result, StreamProfile};
use glam::DQuat;

/// For [`depthrig_driver::DeviceInfo::motion`]. libk4a corrects each sample when it is asked for (its `src/imu/imu.c`,
/// `imu_apply_intrinsic_calibration`), and recorders write what they were given.
pub const CORRECTED: &str = "accel_m_s2 and gyro_rad_s are corrected for bias and scale by libk4a with the factory calibration: do not \
                             correct them again";
/// Samples a second.
pub const RATE_HZ: f64 = 1600.0;
/// Samples of a batch: 40 ms of them.
pub const BATCH: u32 = 64;
/// From sample to sample, microseconds.
const PERIOD_US: u64 = 625;
/// Rotations that differ by less than this are one, radians.
const SAME_RAD: f64 = 1e-9;
/// Largest rate difference of two crystals, applied to the time between a sample and the newest of its batch.
const CRYSTALS: f64 = 100e-6;

/// A sample as the device gave it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// When the rotation was measured, nanoseconds of the device's clock.
    pub gyroscope_ns: u64,
    /// When the acceleration was measured.
    pub accelerometer_ns: u64,
    /// Rate of rotation, rad/s, along the gyroscope's axes.
    pub rotation: [f32; 3],
    /// Acceleration, m/s², along the accelerometer's axes.
    pub acceleration: [f32; 3],
    /// °C; NaN when it is not known.
    pub temperature_c: f32,
}

impl From<super::recording::MotionSample> for Measured {
    fn from(s: super::recording::MotionSample) -> Self {
        Self {
            gyroscope_ns: s.gyroscope_ns,
            accelerometer_ns: s.accelerometer_ns,
            rotation: s.rotation,
            acceleration: s.acceleration,
            temperature_c: f32::NAN,
        }
    }
}

/// The stream's one mode; at `speed` times its own rate, on `clock`.
///
/// # Errors
/// None that can happen: the name is a good one.
pub fn profile(
    calibration: Option<&Calibration>,
    speed: f64,
    clock: DeviceClock,
    metadata: MetadataLevel,
) -> Result<StreamProfile> {
    motion::profile(RATE_HZ * speed, BATCH, pose(calibration), clock, metadata)
}

/// Pose of the IMU in the device; identity when the calibration does not know it.
pub fn pose(calibration: Option<&Calibration>) -> Pose {
    use depthrig_calib::PoseExt as _;
    let sensor = calibration.and_then(|c| c.accelerometer.or(c.gyroscope));
    sensor.map_or(Pose::IDENTITY, |s| s.sensor_from_device.inverse())
}

/// Whether a sample of a recorded block at `device_us` can have been measured at `gyroscope_ns`: blocks hold some
/// milliseconds, and what lies a minute later is damaged. Believed, it would hold up all samples after it.
pub const fn is_plausible(gyroscope_ns: u64, device_us: u64) -> bool {
    gyroscope_ns <= device_us.saturating_mul(1000).saturating_add(60_000_000_000)
}

/// The rotation of a gyroscope's axes in its IMU's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GyroscopeRotation {
    /// Unit quaternion x, y, z, w: `v_unit = q v_gyroscope`.
    pub xyzw: [f64; 4],
}

impl core::fmt::Display for GyroscopeRotation {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let degrees = DQuat::from_array(self.xyzw).angle_between(DQuat::IDENTITY).to_degrees();
        let [x, y, z, w] = self.xyzw;
        write!(
            f,
            "gyro_rad_s is along the gyroscope's own axes, rotated by {degrees:.2} degrees in the unit's frame: \
             v_unit = q v_gyroscope, q = [{x}, {y}, {z}, {w}] (x, y, z, w)"
        )
    }
}

/// How the gyroscope's axes lie in the IMU's frame; `None` if they coincide or the rotation is unknown.
pub fn gyroscope_in_unit(calibration: Option<&Calibration>) -> Option<GyroscopeRotation> {
    let rotation = |p: Pose| DQuat::from_array(p.rotation_xyzw);
    let calibration = calibration?;
    let accelerometer = rotation(calibration.accelerometer?.sensor_from_device);
    let gyroscope = rotation(calibration.gyroscope?.sensor_from_device);
    let turn = (accelerometer * gyroscope.inverse()).normalize();
    let differs = turn.angle_between(DQuat::IDENTITY) > SAME_RAD;
    differs.then(|| GyroscopeRotation { xyzw: turn.to_array() })
}

/// Where a calibration comes from, `origin`, with the rotation of the gyroscope where there is one.
pub fn stated(origin: &str, calibration: Option<&Calibration>) -> String {
    gyroscope_in_unit(calibration).map_or_else(|| origin.to_owned(), |r| format!("{origin}; {r}"))
}

/// Numbers samples.
#[derive(Debug, Clone)]
pub struct Samples {
    counter: FrameCounter,
    last_us: Option<u64>,
}

impl Default for Samples {
    fn default() -> Self {
        Self { counter: FrameCounter::new(PERIOD_US), last_us: None }
    }
}

impl Samples {
    /// The sample as the bus carries it, all but its time; `None` for one that was there before.
    pub fn take(&mut self, s: &Measured) -> Option<MotionSample> {
        let us = s.gyroscope_ns / 1000;
        if self.last_us.replace(us) == Some(us) {
            return None;
        }
        let offset_ns = i128::from(s.accelerometer_ns) - i128::from(s.gyroscope_ns);
        Some(MotionSample {
            device_time: us,
            sequence: self.counter.number(us),
            accel_offset_ns: offset_ns.clamp(i32::MIN.into(), i32::MAX.into()) as i32,
            gyro_rad_s: s.rotation,
            accel_m_s2: s.acceleration,
            temperature_c: s.temperature_c,
            ..MotionSample::default()
        })
    }
}

/// Delivers the samples of a running device.
#[derive(Debug)]
pub struct Unit {
    stream: usize,
    samples: Samples,
    batcher: Batcher,
    clock: ClockMap,
    domain: ClockDomain,
    /// Seconds of the device per second.
    speed: f64,
    /// Epoch and reported time of the newest sample of the current epoch.
    last: Option<(u32, HostTime)>,
    tell_at: HostTime,
}

impl Unit {
    /// As stream number `stream`, which is `profile`, at `speed` times its own rate.
    pub fn new(stream: usize, profile: &StreamProfile, speed: f64) -> Self {
        let period_ns = (PERIOD_US * 1000) as f64 / speed;
        let clock = ClockConfig {
            bunch: BATCH,
            ..ClockConfig::new(profile.clock.counter_bits, profile.clock.tick_ns(), period_ns.round() as u64)
        };
        Self {
            stream,
            samples: Samples::default(),
            batcher: Batcher::new(stream, profile),
            clock: ClockMap::new(clock),
            domain: profile.clock.domain,
            speed,
            last: None,
            tell_at: HostTime::from_ns(0),
        }
    }

    /// Takes samples in the order in which they were measured, all of which had arrived at `arrival`. `ticks` is the
    /// device's clock as the stream has it, of microseconds of the device's own. Whether a batch went.
    pub fn take(
        &mut self,
        measured: &[Measured],
        arrival: HostTime,
        ticks: impl Fn(u64) -> u64,
        sink: &mut dyn FrameSink,
    ) -> bool {
        let mut rest = measured;
        let mut went = false;
        while !rest.is_empty() {
            // A clock that was set back starts a new count.
            let ends = rest.windows(2).position(|w| w[1].gyroscope_ns < w[0].gyroscope_ns);
            let (run, later) = rest.split_at(ends.map_or(rest.len(), |last| last + 1));
            went |= self.take_run(run, arrival, &ticks, sink);
            rest = later;
        }
        let now = HostTime::now();
        went |= self.batcher.tick(now, sink);
        if went && self.domain == ClockDomain::Device && now >= self.tell_at {
            sink.clock_quality(self.stream, &self.clock.quality());
            self.tell_at = now.plus(Duration::from_secs(1));
        }
        went
    }

    /// Samples whose times rise.
    fn take_run(
        &mut self,
        run: &[Measured],
        arrival: HostTime,
        ticks: &impl Fn(u64) -> u64,
        sink: &mut dyn FrameSink,
    ) -> bool {
        let Some(newest) = run.last() else { return false };
        let newest_ticks = ticks(newest.gyroscope_ns / 1000);
        let mut mark = Mark { arrival, epoch: 0, flags: FrameFlags(0) };
        let mut base = arrival;
        let mut uncertainty_ns = 0;
        let mut newest_time = newest_ticks;
        let mut rate = 1.0;
        if self.domain == ClockDomain::Device {
            // Of samples that came together the newest says the most of when they came.
            let number = (newest.gyroscope_ns / 1000 + PERIOD_US / 2) / PERIOD_US;
            let mapped = self.clock.observe(newest_ticks, number, arrival);
            (mark.epoch, mark.flags, base) = (mapped.epoch, mapped.flags, mapped.capture_time);
            (uncertainty_ns, newest_time) = (mapped.uncertainty_ns, mapped.device_time);
            rate += self.clock.rate();
        }
        let mut went = false;
        for s in run {
            let Some(mut sample) = self.samples.take(s) else { continue };
            let before_ns = (newest.gyroscope_ns - s.gyroscope_ns) as f64 / self.speed * rate;
            let wish = base.plus_ns(-(before_ns.round() as i64));
            let time = match self.last {
                Some((epoch, last)) if epoch == mark.epoch && wish <= last => last.plus_ns(1),
                _ => wish,
            };
            self.last = Some((mark.epoch, time));
            let forced_ns = time.since_ns(wish).unsigned_abs();
            let within_ns = uncertainty_ns + forced_ns + (before_ns * CRYSTALS) as u64;
            sample.time_ns = time.ns();
            sample.device_time =
                newest_time.saturating_sub(newest_ticks.saturating_sub(ticks(s.gyroscope_ns / 1000)));
            sample.uncertainty_ns = u32::try_from(within_ns).unwrap_or(u32::MAX);
            went |= self.batcher.push(&sample, mark, sink);
            // Said once of the samples that it is true of.
            mark.flags = FrameFlags(mark.flags.0 & !FrameFlags::EPOCH_CHANGED.0);
        }
        went
    }

    /// Hands on what is left, at the end of a recording.
    pub fn end(&mut self, sink: &mut dyn FrameSink) -> bool {
        self.batcher.flush(sink)
    }
}

#[cfg(test)]
mod tests;
