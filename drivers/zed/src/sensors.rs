//! Reports of the IMU, a HID device of its own behind the camera's hub.
//!
//! Layout and scales are those of `zed-open-capture`'s `sensorcapture_def.hpp`; all numbers are little-endian.

use depthrig_driver::{Error, ErrorKind, Result};

/// Feature report that starts and stops the records.
pub const STREAM_REPORT: u8 = 0x32;
/// Feature report that carries a request.
pub const REQUEST_REPORT: u8 = 0x21;
/// Input report with a record.
pub const RECORD_REPORT: u8 = 0x01;
/// Bytes of a record, its report number included.
pub const RECORD_BYTES: usize = 62;
/// Picoseconds per tick of a record's time.
pub const TICK_PS: u64 = 39_062_500;
/// Records per second.
pub const RECORD_RATE_HZ: f64 = 400.0;

/// Standard gravity as the firmware has it, m/s².
const GRAVITY: f64 = 9.8189;
/// Full scale 8 g.
const ACCELERATION_UNIT: f64 = 8.0 * GRAVITY / 32_768.0;
/// Full scale 1000 degrees per second.
const GYRO_UNIT_DEG_S: f64 = 1000.0 / 32_768.0;
/// Said for a temperature that is not known.
const NO_TEMPERATURE: i16 = -27_315;

/// The feature report that starts the records, or stops them.
pub const fn stream_report(on: bool) -> [u8; 2] {
    [STREAM_REPORT, on as u8]
}

/// The feature report that keeps the records coming; without one every second or so they end.
pub const fn keep_alive() -> [u8; 2] {
    [REQUEST_REPORT, 0xF2]
}

/// One record of the IMU, as it is sent 400 times a second.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Record {
    /// Acceleration and turning rate are valid.
    pub motion_valid: bool,
    /// The IMU's clock, ticks of 39.0625 µs.
    pub ticks: u64,
    /// Turning rate about the IMU's axes as it came.
    pub gyro_raw: [i16; 3],
    /// Acceleration along the IMU's axes as it came.
    pub acceleration_raw: [i16; 3],
    /// This record is the first after an image's exposure began.
    pub frame_sync: bool,
    /// The two are coupled at all.
    pub can_sync: bool,
    /// Images whose exposure began so far.
    pub frame_count: u32,
    /// Temperature of the IMU, 0.01 °C.
    pub temperature_raw: i16,
    /// Magnetic field as it came, 1/16 µT; `None` between its readings.
    pub field_raw: Option<[i16; 3]>,
    /// Air: temperature 0.01 °C, pressure, humidity as they came, whose units depend on the firmware; `None` between
    /// readings.
    pub air_raw: Option<(i16, u32, u32)>,
    /// Temperatures of the left and the right image sensor, 0.01 °C; −27315 when not known.
    pub image_sensors_raw: [i16; 2],
}

impl Record {
    /// Reads an input report, its number included.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when it is another report or too short.
    pub fn parse(report: &[u8]) -> Result<Self> {
        let Some(b) = report.first_chunk::<RECORD_BYTES>().filter(|b| b[0] == RECORD_REPORT) else {
            let first = report.first().copied().unwrap_or_default();
            let n = report.len();
            let what = format!("report {first:#04x} of {n} bytes is not a record of the IMU");
            return Err(Error::new(ErrorKind::Protocol, what));
        };
        let i16_at = |i: usize| i16::from_le_bytes([b[i], b[i + 1]]);
        let u32_at = |i: usize| u32::from_le_bytes([b[i], b[i + 1], b[i + 2], b[i + 3]]);
        let three = |i: usize| [i16_at(i), i16_at(i + 2), i16_at(i + 4)];
        Ok(Self {
            motion_valid: b[1] == 0,
            ticks: u64::from(u32_at(2)) | u64::from(u32_at(6)) << 32,
            gyro_raw: three(10),
            acceleration_raw: three(16),
            frame_sync: b[22] != 0,
            can_sync: b[23] != 0,
            frame_count: u32_at(24),
            temperature_raw: i16_at(28),
            field_raw: (b[30] == 1).then(|| three(31)),
            air_raw: (b[47] == 1).then(|| (i16_at(48), u32_at(50), u32_at(54))),
            image_sensors_raw: [i16_at(58), i16_at(60)],
        })
    }

    /// The report, for a camera that is emulated.
    pub fn build(&self) -> [u8; RECORD_BYTES] {
        let mut b = [0; RECORD_BYTES];
        let mut put = |i: usize, bytes: &[u8]| b[i..i + bytes.len()].copy_from_slice(bytes);
        put(0, &[RECORD_REPORT, u8::from(!self.motion_valid)]);
        put(2, &self.ticks.to_le_bytes());
        for (i, v) in self.gyro_raw.iter().chain(&self.acceleration_raw).enumerate() {
            put(10 + 2 * i, &v.to_le_bytes());
        }
        put(22, &[u8::from(self.frame_sync), u8::from(self.can_sync)]);
        put(24, &self.frame_count.to_le_bytes());
        put(28, &self.temperature_raw.to_le_bytes());
        if let Some(field) = self.field_raw {
            put(30, &[1]);
            for (i, v) in field.iter().enumerate() {
                put(31 + 2 * i, &v.to_le_bytes());
            }
        }
        if let Some((temperature, pressure, humidity)) = self.air_raw {
            put(47, &[1]);
            put(48, &temperature.to_le_bytes());
            put(50, &pressure.to_le_bytes());
            put(54, &humidity.to_le_bytes());
        }
        put(58, &self.image_sensors_raw[0].to_le_bytes());
        put(60, &self.image_sensors_raw[1].to_le_bytes());
        b
    }

    /// Turning rate about the IMU's axes, rad/s.
    pub fn gyro_rad_s(&self) -> [f64; 3] {
        self.gyro_raw.map(|v| (f64::from(v) * GYRO_UNIT_DEG_S).to_radians())
    }

    /// Acceleration along the IMU's axes, gravity included, m/s².
    pub fn acceleration_m_s2(&self) -> [f64; 3] {
        self.acceleration_raw.map(|v| f64::from(v) * ACCELERATION_UNIT)
    }

    /// Magnetic field, tesla.
    pub fn field_t(&self) -> Option<[f64; 3]> {
        self.field_raw.map(|f| f.map(|v| f64::from(v) / 16.0 * 1e-6))
    }

    /// Temperature of the IMU, °C.
    pub fn temperature_c(&self) -> f64 {
        f64::from(self.temperature_raw) / 100.0
    }

    /// The same where it is known.
    pub fn own_c(&self) -> Option<f64> {
        (self.temperature_raw != NO_TEMPERATURE).then(|| self.temperature_c())
    }

    /// Temperatures of the left and the right image sensor, °C, where known.
    pub fn image_sensors_c(&self) -> [Option<f64>; 2] {
        self.image_sensors_raw
            .map(|v| (v != NO_TEMPERATURE && self.air_raw.is_some()).then(|| f64::from(v) / 100.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Written out by hand, offset by offset.
    #[rustfmt::skip]
    const REPORT: [u8; 62] = [
        1, 0,                                       // number, motion is valid
        0x08, 0x07, 0x06, 0x05, 0x04, 0x03, 0x02, 0x01, // ticks
        0x00, 0x40, 0x00, 0xC0, 0x01, 0x00,         // gyro 16384, -16384, 1
        0x00, 0x10, 0xFF, 0xFF, 0x00, 0x80,         // acceleration 4096, -1, -32768
        1, 2,                                       // frame sync, can sync
        0xEF, 0xBE, 0xAD, 0xDE,                     // frames
        0xC4, 0x09,                                 // 25.00 °C
        1, 0x20, 0x03, 0xE0, 0xFC, 0x10, 0x00,      // field 800, -800, 16
        0, 9, 9, 9, 9, 0, 8, 8, 8, 8,               // moving, falling
        1, 0x38, 0xFF, 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, // air
        0x10, 0x0E, 0x4D, 0x95,                     // left 36.00 °C, right not known
    ];

    #[test]
    fn a_record_by_hand() {
        let r = Record::parse(&REPORT).unwrap();
        assert!(r.motion_valid && r.frame_sync && r.can_sync);
        assert_eq!((r.ticks, r.frame_count), (0x0102_0304_0506_0708, 0xDEAD_BEEF));
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-9, "{a} is not {b}");
        near(r.gyro_rad_s()[0], 500f64.to_radians());
        near(r.gyro_rad_s()[1], -500f64.to_radians());
        near(r.acceleration_m_s2()[0], 9.8189);
        near(r.acceleration_m_s2()[2], -8.0 * 9.8189);
        near(r.field_t().unwrap()[1], -50e-6);
        near(r.temperature_c(), 25.0);
        assert_eq!(r.air_raw, Some((-200, 0x0403_0201, 0x0807_0605)));
        assert_eq!(r.image_sensors_c(), [Some(36.0), None]);
        assert_eq!(TICK_PS * 25_600, 1_000_000_000_000, "25600 ticks are a second");
    }

    #[test]
    fn requests_and_invalid_records() {
        assert_eq!(
            (stream_report(true), stream_report(false), keep_alive()),
            ([0x32, 1], [0x32, 0], [0x21, 0xF2])
        );
        let mut other = REPORT;
        other[0] = 2;
        for bad in [&other[..], &REPORT[..61], &[]] {
            assert_eq!(Record::parse(bad).unwrap_err().kind(), ErrorKind::Protocol);
        }
        assert_eq!(Record::parse(&[&REPORT[..], &[0, 0]].concat()).unwrap(), Record::parse(&REPORT).unwrap());
        let mut invalid = REPORT;
        (invalid[1], invalid[30], invalid[47]) = (1, 2, 0);
        let r = Record::parse(&invalid).unwrap();
        assert!(!r.motion_valid && r.field_raw.is_none() && r.air_raw.is_none());
        assert_eq!(r.image_sensors_c(), [None, None]);
    }

    proptest! {
        #[test]
        fn there_and_back(mut bytes in prop::array::uniform32(any::<u8>()), more in prop::array::uniform30(any::<u8>())) {
            bytes[0] = RECORD_REPORT;
            let r = Record::parse(&[&bytes[..], &more].concat()).unwrap();
            prop_assert_eq!(Record::parse(&r.build()).unwrap(), r);
        }
    }
}
