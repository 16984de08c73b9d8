//! A batch of an IMU, as a line for people and as JSON.

use depthrig_bus::{Frame, FrameHeader, MotionFlags, MotionSample};
use serde::Serialize;

/// An IMU batch with all of its samples.
#[derive(Debug, Serialize)]
pub struct Batch {
    /// `camera/stream`.
    stream: String,
    /// Number of the batch.
    sequence: u64,
    clock_epoch: u32,
    /// Batches captured so far, and lost.
    captured: u64,
    dropped: u64,
    samples: Vec<Sample>,
}

/// A sample; a missing value is `null`.
#[derive(Debug, Serialize)]
struct Sample {
    sequence: u64,
    time_ns: i64,
    device_time: u64,
    uncertainty_ns: u32,
    accel_offset_ns: i32,
    gyro_rad_s: [f32; 3],
    accel_m_s2: [f32; 3],
    temperature_c: f32,
    frame_sync: bool,
    accel_clipped: bool,
    gyro_clipped: bool,
}

impl Batch {
    /// Reads the batch of an IMU frame.
    pub fn of(frame: &Frame) -> Self {
        Self::new(frame.header(), frame.motion())
    }

    fn new(h: &FrameHeader, samples: impl Iterator<Item = MotionSample>) -> Self {
        let sample = |s: MotionSample| Sample {
            sequence: s.sequence,
            time_ns: s.time_ns,
            device_time: s.device_time,
            uncertainty_ns: s.uncertainty_ns,
            accel_offset_ns: s.accel_offset_ns,
            gyro_rad_s: s.gyro_rad_s,
            accel_m_s2: s.accel_m_s2,
            temperature_c: s.temperature_c,
            frame_sync: s.has(MotionFlags::FRAME_SYNC),
            accel_clipped: s.has(MotionFlags::ACCEL_CLIPPED),
            gyro_clipped: s.has(MotionFlags::GYRO_CLIPPED),
        };
        Self {
            stream: format!("{}/{}", h.camera(), h.stream()),
            sequence: h.sequence,
            clock_epoch: h.clock_epoch,
            captured: h.captured,
            dropped: h.drops().total(),
            samples: samples.map(sample).collect(),
        }
    }
}

/// Describes a batch on one line: newest sample, rate and time uncertainty. `before` is the sample before this
/// batch, and becomes its newest.
pub fn describe(frame: &Frame, before: &mut Option<MotionSample>) -> String {
    line(frame.header(), frame.motion(), before)
}

fn line(
    h: &FrameHeader,
    samples: impl ExactSizeIterator<Item = MotionSample>,
    before: &mut Option<MotionSample>,
) -> String {
    let n = samples.len();
    let mut oldest = *before;
    let mut newest = None::<MotionSample>;
    let mut worst_ns = 0;
    let mut gaps = 0;
    for s in samples {
        if let Some(last) = newest.or(*before) {
            gaps += s.sequence.saturating_sub(last.sequence + 1);
        }
        worst_ns = worst_ns.max(s.uncertainty_ns);
        oldest = oldest.or(Some(s));
        newest = Some(s);
    }
    let Some(newest) = newest else {
        return format!("{}/{} #{} no sample", h.camera(), h.stream(), h.sequence);
    };
    *before = Some(newest);
    let rate = oldest.and_then(|first| {
        let samples = newest.sequence.checked_sub(first.sequence)?;
        let ns = newest.time_ns - first.time_ns;
        (samples > 0 && ns > 0).then(|| format!("{:.1} Hz", samples as f64 * 1e9 / ns as f64))
    });
    let three = |v: [f32; 3]| {
        if v.iter().all(|c| c.is_nan()) {
            "-".to_owned()
        } else {
            format!("{:+.3} {:+.3} {:+.3}", v[0], v[1], v[2])
        }
    };
    let lost = if gaps > 0 { format!(", {gaps} never came") } else { String::new() };
    format!(
        "{}/{} #{} {n} samples{lost} {} newest {:.3} ms ±{:.3} at most gyro {} rad/s accel {} m/s² epoch {} dropped {} flags {}",
        h.camera(),
        h.stream(),
        h.sequence,
        rate.as_deref().unwrap_or("- Hz"),
        newest.time_ns as f64 / 1e6,
        f64::from(worst_ns) / 1e6,
        three(newest.gyro_rad_s),
        three(newest.accel_m_s2),
        h.clock_epoch,
        super::drops(h),
        super::flags(h),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::{PixelFormat, StreamId};

    fn batch(first: u64) -> (FrameHeader, Vec<MotionSample>) {
        let mut h = FrameHeader { sequence: 3, captured: 4, ..FrameHeader::default() };
        h.set_image(PixelFormat::Motion, 2, 1);
        h.set_names("mount", &StreamId::new("zed", "imu").unwrap());
        h.dropped[0] = 1;
        let sample = |i: u64| MotionSample {
            sequence: first + i,
            time_ns: 1_000_000_000 + (first + i) as i64 * 2_500_000,
            uncertainty_ns: 250_000 - 1000 * i as u32,
            gyro_rad_s: [0.5, -0.25, 0.0],
            accel_m_s2: if i == 0 { [f32::NAN; 3] } else { [0.0, -9.75, 1.0] },
            flags: 1,
            ..MotionSample::default()
        };
        (h, (0..2).map(sample).collect())
    }

    #[test]
    fn a_line_says_the_newest_sample_the_rate_and_the_worst_uncertainty() {
        let mut before = None;
        let (h, samples) = batch(10);
        assert_eq!(
            line(&h, samples.into_iter(), &mut before),
            "zed/imu #3 2 samples 400.0 Hz newest 1027.500 ms ±0.250 at most gyro +0.500 -0.250 +0.000 rad/s \
             accel +0.000 -9.750 +1.000 m/s² epoch 0 dropped device_gap 1 flags -"
        );
        let (h, samples) = batch(15);
        let said = line(&h, samples.into_iter(), &mut before);
        assert!(said.contains("2 samples, 3 never came 400.0 Hz"), "{said}");
    }

    #[test]
    fn json_has_every_sample_and_null_for_what_it_lacks() {
        let (h, samples) = batch(10);
        let json = serde_json::to_value(Batch::new(&h, samples.into_iter())).unwrap();
        assert_eq!((&json["stream"], &json["sequence"]), (&"zed/imu".into(), &3.into()));
        let first = &json["samples"][0];
        assert_eq!((&first["gyro_rad_s"][1], &first["sequence"]), (&(-0.25).into(), &10.into()));
        assert!(first["accel_m_s2"][0].is_null() && first["temperature_c"].is_null());
        assert_eq!(json["samples"][1]["accel_m_s2"][1], -9.75);
        assert_eq!((&first["frame_sync"], &first["gyro_clipped"]), (&true.into(), &false.into()));
    }
}
