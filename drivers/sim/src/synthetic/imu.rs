//! The IMU of a simulated camera: a swing that is known to the last digit at every moment.
//!
//! The unit turns to and fro about one axis that stays where it is, `θ(t) = A sin(2π t / T)` with `t` from the moment
//! at which the mount began to move, so that everything follows from the time alone ([`truth`]). It is not the motion
//! that the images show, whose mount steps from pose to pose: a step has no angular velocity.
//!
//! Its batches travel as the camera's frames do, with the same clock, transport and faults; a batch counts as one
//! frame.

use super::timeline::Boot;
use core::f64::consts::TAU;
use depthrig_bus::{
    HostTime, Intrinsics, MOTION_SAMPLE_BYTES, MetadataLevel, MotionSample, PixelFormat, Pose, StreamName,
};
use depthrig_driver::{DeviceClock, FrameMeta, StreamProfile};

/// Name of its stream.
pub const STREAM: &str = "imu";
/// Samples a second.
pub const RATE_HZ: f64 = 200.0;
/// Samples of a batch.
pub const BATCH: u32 = 8;
/// Nanoseconds from sample to sample on the unit's own clock.
const PERIOD_NS: f64 = 1e9 / RATE_HZ;
/// The axis it turns about, in its own frame and in the world's: a turn leaves its axis where it is.
const AXIS: [f64; 3] = [1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0];
/// How far it turns to either side, radians.
const SWING_RAD: f64 = 0.3;
/// From one end of the swing to the same end, seconds.
const SWING_S: f64 = 4.0;
/// Acceleration that an IMU at rest measures, along -y when it lies level as an optical frame does (ISO 80000-3:
/// standard gravity).
const UP_M_S2: [f64; 3] = [0.0, -9.806_65, 0.0];
/// Where it sits in the camera.
const POSE: Pose = Pose { translation_m: [0.012, -0.004, 0.006], ..Pose::IDENTITY };

/// True values `t_s` seconds after the mount began to move: angular velocity (rad/s) and
/// acceleration (m/s²) in its own frame.
pub fn truth(t_s: f64) -> ([f64; 3], [f64; 3]) {
    let (sin, cos) = (TAU * t_s / SWING_S).sin_cos();
    let rate = SWING_RAD * TAU / SWING_S * cos;
    // The world as the turned unit sees it is turned the other way (Rodrigues).
    let (sin, cos) = (-SWING_RAD * sin).sin_cos();
    let [a, v] = [AXIS, UP_M_S2];
    let cross = [a[1] * v[2] - a[2] * v[1], a[2] * v[0] - a[0] * v[2], a[0] * v[1] - a[1] * v[0]];
    let along = (0..3).map(|i| a[i] * v[i]).sum::<f64>();
    let accel = core::array::from_fn(|i| v[i] * cos + cross[i] * sin + a[i] * along * (1.0 - cos));
    (AXIS.map(|c| c * rate), accel)
}

/// Its one mode.
pub(crate) fn profile(stream: StreamName, counter_bits: u32) -> StreamProfile {
    StreamProfile {
        stream,
        format: PixelFormat::Motion,
        width: BATCH,
        height: 1,
        rate_hz: RATE_HZ / f64::from(BATCH),
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device: POSE,
        clock: DeviceClock::microseconds(counter_bits),
        sequence_bits: 32,
        metadata: MetadataLevel::Simulated,
    }
}

/// A batch as the device made it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Batch {
    /// Number since the boot.
    pub(crate) k: u64,
    /// The boot.
    pub(crate) boot: Boot,
    /// True time of its newest sample.
    pub(crate) capture: HostTime,
    /// When the mount began to move.
    pub(crate) world_start: HostTime,
    /// How much faster than the host's the unit's clock runs, parts per million.
    pub(crate) drift_ppm: f64,
}

/// State that the driver keeps between batches.
#[derive(Debug, Default)]
pub(crate) struct Filler {
    /// The last batch that was delivered: number of its newest sample, its mapped time, and its epoch.
    before: Option<(u64, HostTime, u32)>,
    /// The boot that is counted, what is added to its batches' numbers, and the newest sum.
    counted: (u32, u64, u64),
}

impl Filler {
    /// Number of batch `k` of a boot as the driver counts them: they go on when the device starts afresh. Batches are
    /// rare, and a counter that went back by a few of them would look like stragglers to the gate.
    pub(crate) fn count(&mut self, k: u64, boot: &Boot) -> u64 {
        let (counted, added, newest) = &mut self.counted;
        if *counted != boot.number {
            (*counted, *added) = (boot.number, (*newest + 1).saturating_sub(k));
        }
        *newest = k + *added;
        *newest
    }

    /// Writes the samples of a batch whose newest is of `meta`'s time, and puts the newest one's number into `meta`.
    ///
    /// The samples between two batches lie evenly in the time between them, so that times rise however the map moves.
    pub(crate) fn fill(&mut self, batch: &Batch, meta: &mut FrameMeta, memory: &mut [u8]) {
        let newest = batch.newest();
        let at = meta.capture_time;
        let period_ns = self.period_ns(newest, at, meta.clock_epoch);
        let true_period_ns = PERIOD_NS / (1.0 + batch.drift_ppm * 1e-6);
        let (samples, _) = memory.as_chunks_mut::<MOTION_SAMPLE_BYTES>();
        let last = samples.len().saturating_sub(1);
        for (i, bytes) in samples.iter_mut().enumerate() {
            let back = (last - i) as f64;
            let exposed = batch.capture.plus_ns(-(back * true_period_ns).round() as i64);
            let (gyro, accel) = truth(exposed.since_ns(batch.world_start) as f64 * 1e-9);
            let sample = MotionSample {
                time_ns: at.plus_ns(-(back * period_ns).round() as i64).ns(),
                device_time: meta.device_time.saturating_sub((back * PERIOD_NS / 1e3).round() as u64),
                sequence: newest.saturating_sub((last - i) as u64),
                uncertainty_ns: u32::try_from(meta.capture_uncertainty_ns).unwrap_or(u32::MAX),
                accel_offset_ns: 0,
                gyro_rad_s: gyro.map(|v| v as f32),
                accel_m_s2: accel.map(|v| v as f32),
                temperature_c: meta.temperature_c,
                flags: 0,
            };
            *bytes = sample.to_bytes();
        }
        meta.device_sequence = newest;
        self.before = Some((newest, at, meta.clock_epoch));
    }

    /// From sample to sample as the host sees it.
    fn period_ns(&self, newest: u64, at: HostTime, epoch: u32) -> f64 {
        let seen = self.before.filter(|(n, t, e)| *e == epoch && *n < newest && *t < at);
        let seen = seen.map(|(n, t, _)| at.since_ns(t) as f64 / (newest - n) as f64);
        // The samples lie in the time since the batch before; a map that has just begun may have moved by much of it.
        seen.map_or(PERIOD_NS, |ns| ns.min(PERIOD_NS * 1.2))
    }
}

impl Batch {
    /// Number of its newest sample. Numbers go on rising when the device starts afresh: those that it would have made
    /// meanwhile are left out.
    fn newest(&self) -> u64 {
        let before = self.boot.at.since_ns(self.world_start).max(0) as f64 * (1.0 + self.drift_ppm * 1e-6);
        let before = (before / PERIOD_NS).ceil() as u64 + u64::from(BATCH + 2) * u64::from(self.boot.number);
        before + (self.k + 1) * u64::from(BATCH) - 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_truth_is_a_turn_that_gravity_agrees_with() {
        // d/dt of a constant vector seen from a frame that turns with ω is -ω × it.
        for i in 0..400 {
            let t = f64::from(i) * 0.01;
            let h = 1e-5;
            let (w, a) = truth(t);
            let before = truth(t - h).1;
            let after = truth(t + h).1;
            let turned = [w[1] * a[2] - w[2] * a[1], w[2] * a[0] - w[0] * a[2], w[0] * a[1] - w[1] * a[0]];
            for c in 0..3 {
                let slope = (after[c] - before[c]) / (2.0 * h);
                assert!((slope + turned[c]).abs() < 1e-6, "{t} {c}: {slope} {}", turned[c]);
            }
            let length = a.iter().map(|v| v * v).sum::<f64>().sqrt();
            assert!((length - 9.806_65).abs() < 1e-9, "{t}: {length}");
        }
        assert!(truth(1.0).0.iter().all(|w| w.abs() < 1e-12), "it rests at the end of the swing");
    }

    #[test]
    fn numbers_rise_over_every_new_start() {
        let world_start = HostTime::from_ns(7_000_000_000);
        for drift_ppm in [-10_000.0, 0.0, 10_000.0] {
            let mut newest = 0;
            for number in 0..50 {
                let life_ns = 130_777_777;
                let at = world_start.plus_ns(i64::from(number) * life_ns);
                let boot = Boot { number, at, set_back_us: 0 };
                // Samples until the next start.
                for k in 0..(life_ns as f64 * (1.0 + drift_ppm * 1e-6) / PERIOD_NS / 8.0) as u64 {
                    let batch = Batch { k, boot, capture: at, world_start, drift_ppm };
                    let oldest = batch.newest() + 1 - u64::from(BATCH);
                    assert!(
                        (number, k) == (0, 0) || oldest > newest,
                        "boot {number}: {oldest} after {newest}"
                    );
                    newest = batch.newest();
                }
            }
        }
    }
}
