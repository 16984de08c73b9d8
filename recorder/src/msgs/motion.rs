//! IMU measurements: `depthrig_msgs/msg/MotionSamples`, a batch as its channel carried it, and
//! `sensor_msgs/msg/Imu`, each of its samples for readers that know only that.
//!
//! CDR aligns a primitive to its size and so does the sample, therefore the elements of the array are the bytes of the
//! batch; fields are still written one by one, which needs no unsafe code.

use crate::Result;
use crate::cdr::{Reader, Writer};
use depthrig_bus::MotionSample;

/// A batch as it is stored.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Batch {
    /// Time of the newest sample, UTC nanoseconds since 1970.
    pub(crate) stamp_utc_ns: i64,
    /// The batch's number on its channel.
    pub(crate) sequence: u64,
    pub(crate) samples: Vec<MotionSample>,
}

pub(crate) fn write_samples(buf: &mut Vec<u8>, stamp_utc_ns: i64, sequence: u64, samples: &[MotionSample]) {
    let mut w = Writer::new(buf);
    w.time(stamp_utc_ns).u64(sequence).u32(samples.len() as u32);
    for s in samples {
        w.i64(s.time_ns).u64(s.device_time).u64(s.sequence).u32(s.uncertainty_ns).i32(s.accel_offset_ns);
        for v in s.gyro_rad_s.iter().chain(&s.accel_m_s2) {
            w.f32(*v);
        }
        w.f32(s.temperature_c).u32(s.flags);
    }
}

pub(crate) fn read_samples(message: &[u8]) -> Result<Batch> {
    let mut r = Reader::new(message)?;
    // Fields in the order of the bytes.
    Ok(Batch {
        stamp_utc_ns: r.time()?,
        sequence: r.u64()?,
        samples: r.seq(|r| {
            Ok(MotionSample {
                time_ns: r.i64()?,
                device_time: r.u64()?,
                sequence: r.u64()?,
                uncertainty_ns: r.u32()?,
                accel_offset_ns: r.i32()?,
                gyro_rad_s: r.array(Reader::f32)?,
                accel_m_s2: r.array(Reader::f32)?,
                temperature_c: r.f32()?,
                flags: r.u32()?,
            })
        })?,
    })
}

/// A sample as `Imu` says it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Imu {
    /// UTC nanoseconds since 1970.
    pub(crate) stamp_utc_ns: i64,
    pub(crate) gyro_rad_s: [f64; 3],
    pub(crate) accel_m_s2: [f64; 3],
}

impl Imu {
    pub(crate) fn of(sample: &MotionSample, utc_offset_ns: i64) -> Self {
        Self {
            stamp_utc_ns: sample.time_ns.saturating_add(utc_offset_ns),
            gyro_rad_s: sample.gyro_rad_s.map(f64::from),
            accel_m_s2: sample.accel_m_s2.map(f64::from),
        }
    }

    /// Whether both measured the same; NaN equals NaN.
    pub(crate) fn same_values(&self, other: &Self) -> bool {
        let same = |a: &[f64; 3], b: &[f64; 3]| {
            a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()))
        };
        same(&self.gyro_rad_s, &other.gyro_rad_s) && same(&self.accel_m_s2, &other.accel_m_s2)
    }

    /// Appends the message. The unit knows no orientation, which the message says with -1 in place of the first
    /// covariance; what a sample lacks is said in the same way; other covariances are 0, unknown (`sensor_msgs/Imu`).
    pub(crate) fn write(&self, buf: &mut Vec<u8>, frame_id: &str) {
        let covariance = |w: &mut Writer<'_>, known: bool| {
            w.f64(if known { 0.0 } else { -1.0 }).f64s(&[0.0; 8]);
        };
        let mut w = Writer::new(buf);
        w.header(self.stamp_utc_ns, frame_id).f64s(&[0.0, 0.0, 0.0, 1.0]);
        covariance(&mut w, false);
        for values in [&self.gyro_rad_s, &self.accel_m_s2] {
            w.f64s(values);
            covariance(&mut w, !values.iter().all(|v| v.is_nan()));
        }
    }

    /// Reads a message and the name of its frame.
    pub(crate) fn read(message: &[u8]) -> Result<(Self, &str)> {
        let mut r = Reader::new(message)?;
        let stamp_utc_ns = r.time()?;
        let frame_id = r.str()?;
        r.array::<_, 4>(Reader::f64)?;
        r.array::<_, 9>(Reader::f64)?;
        let gyro_rad_s = r.array(Reader::f64)?;
        r.array::<_, 9>(Reader::f64)?;
        let accel_m_s2 = r.array(Reader::f64)?;
        r.array::<_, 9>(Reader::f64)?;
        Ok((Self { stamp_utc_ns, gyro_rad_s, accel_m_s2 }, frame_id))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::MOTION_SAMPLE_BYTES;
    use proptest::prelude::*;

    fn any_sample() -> impl Strategy<Value = MotionSample> {
        proptest::array::uniform32(any::<u8>()).prop_flat_map(|a| {
            proptest::array::uniform32(any::<u8>()).prop_map(move |b| {
                let mut bytes = [0; MOTION_SAMPLE_BYTES];
                bytes[..32].copy_from_slice(&a);
                bytes[32..].copy_from_slice(&b);
                MotionSample::from_bytes(&bytes)
            })
        })
    }

    proptest! {
        #[test]
        fn the_array_is_the_bytes_of_the_batch(
            samples in proptest::collection::vec(any_sample(), 1..5), sequence: u64, lead in 0..9_usize
        ) {
            let mut buf = vec![7; lead];
            write_samples(&mut buf, 5_000_000_009, sequence, &samples);
            let message = &buf[lead..];
            let bytes: Vec<u8> = samples.iter().flat_map(MotionSample::to_bytes).collect();
            prop_assert_eq!(&message[4 + 24..], &bytes[..]);
            let back = read_samples(message).unwrap();
            prop_assert_eq!((back.stamp_utc_ns, back.sequence), (5_000_000_009, sequence));
            let again: Vec<u8> = back.samples.iter().flat_map(MotionSample::to_bytes).collect();
            prop_assert_eq!(again, bytes);
            for cut in 0..message.len() {
                prop_assert!(read_samples(&message[..cut]).is_err(), "cut at {}", cut);
            }
        }

        #[test]
        fn an_imu_message_says_what_the_sample_does(sample in any_sample()) {
            let sample = MotionSample { time_ns: sample.time_ns >> 3, ..sample };
            let offset = 1_700_000_000_000_000_000 - sample.time_ns;
            let imu = Imu::of(&sample, offset);
            let mut buf = Vec::new();
            imu.write(&mut buf, "zed_imu_frame");
            let (back, frame_id) = Imu::read(&buf).unwrap();
            prop_assert_eq!(frame_id, "zed_imu_frame");
            prop_assert!(back.same_values(&imu) && back.stamp_utc_ns == 1_700_000_000_000_000_000);
            for (f, d) in sample.gyro_rad_s.iter().chain(&sample.accel_m_s2)
                .zip(back.gyro_rad_s.iter().chain(&back.accel_m_s2)) {
                prop_assert!((*d as f32).to_bits() == f.to_bits() || f.is_nan());
            }
        }
    }

    #[test]
    fn what_is_unknown_is_said_as_ros_does() {
        let sample = MotionSample { gyro_rad_s: [1.0, 2.0, 3.0], ..MotionSample::default() };
        let mut buf = Vec::new();
        Imu::of(&sample, 0).write(&mut buf, "f");
        // Header of 14 bytes, padding, quaternion; then each covariance after its values.
        let f64_at = |i: usize| f64::from_le_bytes(buf[4 + 16 + 8 * i..][..8].try_into().unwrap());
        assert_eq!([0, 1, 2, 3].map(f64_at), [0.0, 0.0, 0.0, 1.0]);
        assert_eq!(f64_at(4).to_bits(), (-1.0f64).to_bits(), "no orientation");
        assert_eq!([13, 14, 15].map(f64_at), [1.0, 2.0, 3.0]);
        assert_eq!(f64_at(16).to_bits(), 0.0f64.to_bits(), "the covariance is not known");
        assert!(f64_at(25).is_nan());
        assert_eq!(f64_at(28).to_bits(), (-1.0f64).to_bits(), "no acceleration");
        assert_eq!(buf.len(), 4 + 16 + 8 * 37);
    }
}
