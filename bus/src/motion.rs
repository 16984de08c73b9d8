//! IMU samples, which a frame of format [`PixelFormat::Motion`](crate::PixelFormat::Motion) holds instead of pixels.
//! An IMU measures hundreds of times a second, so its frames are batches: `width` samples in one row, in the order of
//! their times. The header's times are those of the newest sample, its pose is that of the IMU, and it counts batches
//! as it counts images; samples have numbers of their own, whose gaps are samples that the device never gave, or that
//! were lost with a batch.

use crate::{Field, HostTime};
use core::mem::offset_of;

/// Bytes of one [`MotionSample`].
pub const MOTION_SAMPLE_BYTES: usize = 64;

/// One sample: angular velocity and acceleration in the IMU's own frame.
///
/// Its layout is the contract with every other process, as that of the header is; all numbers are little-endian.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSample {
    /// When the rotation was measured, nanoseconds on the host clock.
    pub time_ns: i64,
    /// The same on the IMU's clock, ticks, unwrapped.
    pub device_time: u64,
    /// Number of the sample; a gap is samples that the device never gave, or that were lost with a batch.
    pub sequence: u64,
    /// The time is right within this much, nanoseconds; [`u32::MAX`] is that or more.
    pub uncertainty_ns: u32,
    /// When the acceleration was measured, after `time_ns`, nanoseconds.
    pub accel_offset_ns: i32,
    /// Angular velocity about x, y and z, rad/s; NaN where the sample has none.
    pub gyro_rad_s: [f32; 3],
    /// Acceleration along x, y and z, m/s²; an IMU at rest measures 9.8 upwards. NaN where the sample has none.
    pub accel_m_s2: [f32; 3],
    /// Temperature of the IMU, °C; NaN when unknown.
    pub temperature_c: f32,
    /// [`MotionFlags`] bits.
    pub flags: u32,
}

/// Facts about a sample, as bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MotionFlags(pub u32);

impl MotionFlags {
    /// The first sample after an exposure of the camera's began.
    pub const FRAME_SYNC: Self = Self(1);
    /// The acceleration reached the end of its range.
    pub const ACCEL_CLIPPED: Self = Self(2);
    /// The angular velocity reached the end of its range.
    pub const GYRO_CLIPPED: Self = Self(4);

    /// Whether all bits of `flag` are set.
    pub const fn has(self, flag: Self) -> bool {
        self.0 & flag.0 == flag.0
    }

    /// Both.
    #[must_use]
    pub const fn with(self, flag: Self) -> Self {
        Self(self.0 | flag.0)
    }
}

macro_rules! fields {
    ($($name:ident => $kind:literal x $count:expr;)*) => {
        &[$(Field { name: stringify!($name), offset: offset_of!(MotionSample, $name), kind: $kind, count: $count }),*]
    };
}

/// Every field of [`MotionSample`] in the order of its bytes, without a gap.
pub const MOTION_FIELDS: &[Field] = fields! {
    time_ns => "i64" x 1;
    device_time => "u64" x 1;
    sequence => "u64" x 1;
    uncertainty_ns => "u32" x 1;
    accel_offset_ns => "i32" x 1;
    gyro_rad_s => "f32" x 3;
    accel_m_s2 => "f32" x 3;
    temperature_c => "f32" x 1;
    flags => "u32" x 1;
};

const _: () = assert!(size_of::<MotionSample>() == MOTION_SAMPLE_BYTES, "the size is part of the contract");

impl Default for MotionSample {
    fn default() -> Self {
        Self {
            time_ns: 0,
            device_time: 0,
            sequence: 0,
            uncertainty_ns: 0,
            accel_offset_ns: 0,
            gyro_rad_s: [f32::NAN; 3],
            accel_m_s2: [f32::NAN; 3],
            temperature_c: f32::NAN,
            flags: 0,
        }
    }
}

impl MotionSample {
    /// The sample's bytes.
    pub fn to_bytes(&self) -> [u8; MOTION_SAMPLE_BYTES] {
        let mut out = [0; MOTION_SAMPLE_BYTES];
        out[0..8].copy_from_slice(&self.time_ns.to_le_bytes());
        out[8..16].copy_from_slice(&self.device_time.to_le_bytes());
        out[16..24].copy_from_slice(&self.sequence.to_le_bytes());
        out[24..28].copy_from_slice(&self.uncertainty_ns.to_le_bytes());
        out[28..32].copy_from_slice(&self.accel_offset_ns.to_le_bytes());
        for (at, value) in self.gyro_rad_s.iter().chain(&self.accel_m_s2).enumerate() {
            out[32 + 4 * at..36 + 4 * at].copy_from_slice(&value.to_le_bytes());
        }
        out[56..60].copy_from_slice(&self.temperature_c.to_le_bytes());
        out[60..64].copy_from_slice(&self.flags.to_le_bytes());
        out
    }

    /// The sample of these bytes, whatever they are.
    pub fn from_bytes(bytes: &[u8; MOTION_SAMPLE_BYTES]) -> Self {
        let four = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        let eight = |at: usize| {
            let [a, b, c, d] = four(at);
            let [e, f, g, h] = four(at + 4);
            [a, b, c, d, e, f, g, h]
        };
        let three = |at: usize| [0, 4, 8].map(|i| f32::from_le_bytes(four(at + i)));
        Self {
            time_ns: i64::from_le_bytes(eight(0)),
            device_time: u64::from_le_bytes(eight(8)),
            sequence: u64::from_le_bytes(eight(16)),
            uncertainty_ns: u32::from_le_bytes(four(24)),
            accel_offset_ns: i32::from_le_bytes(four(28)),
            gyro_rad_s: three(32),
            accel_m_s2: three(44),
            temperature_c: f32::from_le_bytes(four(56)),
            flags: u32::from_le_bytes(four(60)),
        }
    }

    /// When the rotation was measured.
    pub const fn time(&self) -> HostTime {
        HostTime::from_ns(self.time_ns)
    }

    /// Whether all bits of `flag` are set.
    pub const fn has(&self, flag: MotionFlags) -> bool {
        MotionFlags(self.flags).has(flag)
    }

    /// The samples in `payload`, the payload of a motion frame; bytes after the last complete one are left out.
    pub fn all_in(payload: &[u8]) -> impl ExactSizeIterator<Item = Self> + '_ {
        payload.as_chunks::<MOTION_SAMPLE_BYTES>().0.iter().map(Self::from_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fields_lie_as_the_bytes_say() {
        let mut at = 0;
        for f in MOTION_FIELDS {
            assert_eq!(f.offset, at, "{}", f.name);
            at += f.bytes();
        }
        assert_eq!(at, MOTION_SAMPLE_BYTES);
        let sample = MotionSample {
            time_ns: -2,
            device_time: 3,
            sequence: u64::MAX - 4,
            uncertainty_ns: 5,
            accel_offset_ns: -6,
            gyro_rad_s: [0.5, -1.5, 2.5],
            accel_m_s2: [9.75, -0.125, 4.0],
            temperature_c: 40.25,
            flags: MotionFlags::FRAME_SYNC.with(MotionFlags::GYRO_CLIPPED).0,
        };
        let bytes = sample.to_bytes();
        let field = |name: &str| {
            let f = MOTION_FIELDS.iter().find(|f| f.name == name).unwrap();
            &bytes[f.offset..f.offset + f.bytes()]
        };
        assert_eq!(field("time_ns"), (-2i64).to_le_bytes());
        assert_eq!(field("accel_offset_ns"), (-6i32).to_le_bytes());
        assert_eq!(field("gyro_rad_s")[4..8], (-1.5f32).to_le_bytes());
        assert_eq!(field("accel_m_s2")[8..12], 4.0f32.to_le_bytes());
        assert_eq!(field("temperature_c"), 40.25f32.to_le_bytes());
        assert_eq!(field("flags"), 5u32.to_le_bytes());
        assert_eq!(MotionSample::from_bytes(&bytes), sample);
        let mut two = [bytes, bytes].concat();
        let mut read = Vec::new();
        two.extend([1; 9]);
        read.extend(MotionSample::all_in(&two));
        assert_eq!(read, [sample; 2], "an incomplete sample is left out");
        assert!(sample.has(MotionFlags::FRAME_SYNC) && !sample.has(MotionFlags::ACCEL_CLIPPED));
    }
}
