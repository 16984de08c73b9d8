//! A sample of an IMU as a row.

use crate::dataset::DatasetSet;
use depthrig_bus::{MOTION_FIELDS, MotionSample};
use serde::Serialize;

/// One sample: a line of the file, or a JSON object with the same names.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[non_exhaustive]
pub struct MotionRow {
    /// Id of the set that it came with.
    pub set: u64,
    /// When the rotation was measured, UTC nanoseconds since 1970.
    pub utc_ns: i64,
    /// When the rotation was measured, nanoseconds on the host's monotonic clock.
    pub time_ns: i64,
    /// The same on the unit's clock, ticks.
    pub device_time: u64,
    /// Number of the sample.
    pub sequence: u64,
    /// The time is right within this much, nanoseconds.
    pub uncertainty_ns: u32,
    /// When the acceleration was measured, after `time_ns`, nanoseconds.
    pub accel_offset_ns: i32,
    /// Angular velocity about x, rad/s.
    pub gyro_x_rad_s: Option<f32>,
    /// About y.
    pub gyro_y_rad_s: Option<f32>,
    /// About z.
    pub gyro_z_rad_s: Option<f32>,
    /// Acceleration along x, m/s².
    pub accel_x_m_s2: Option<f32>,
    /// Along y.
    pub accel_y_m_s2: Option<f32>,
    /// Along z.
    pub accel_z_m_s2: Option<f32>,
    /// Temperature of the unit, °C.
    pub temperature_c: Option<f32>,
    /// [`MotionFlags`](depthrig_bus::MotionFlags) bits.
    pub flags: u32,
}

impl MotionRow {
    /// The names of the columns.
    pub const COLUMNS: [&'static str; 15] = [
        "set",
        "utc_ns",
        "time_ns",
        "device_time",
        "sequence",
        "uncertainty_ns",
        "accel_offset_ns",
        "gyro_x_rad_s",
        "gyro_y_rad_s",
        "gyro_z_rad_s",
        "accel_x_m_s2",
        "accel_y_m_s2",
        "accel_z_m_s2",
        "temperature_c",
        "flags",
    ];

    pub(super) fn new(set: &DatasetSet, s: &MotionSample) -> Self {
        let known = |v: f32| v.is_finite().then_some(v);
        let [gx, gy, gz] = s.gyro_rad_s.map(known);
        let [ax, ay, az] = s.accel_m_s2.map(known);
        Self {
            set: set.id,
            utc_ns: s.time_ns.saturating_add(set.utc_offset_ns),
            time_ns: s.time_ns,
            device_time: s.device_time,
            sequence: s.sequence,
            uncertainty_ns: s.uncertainty_ns,
            accel_offset_ns: s.accel_offset_ns,
            gyro_x_rad_s: gx,
            gyro_y_rad_s: gy,
            gyro_z_rad_s: gz,
            accel_x_m_s2: ax,
            accel_y_m_s2: ay,
            accel_z_m_s2: az,
            temperature_c: known(s.temperature_c),
            flags: s.flags,
        }
    }

    /// The row as a line. A number of 32 bits is written with as many digits as give its bits back.
    pub fn csv(&self) -> String {
        let float = |v: Option<f32>| v.map_or_else(String::new, |v| v.to_string());
        let [gyro, accel] = [
            [self.gyro_x_rad_s, self.gyro_y_rad_s, self.gyro_z_rad_s],
            [self.accel_x_m_s2, self.accel_y_m_s2, self.accel_z_m_s2],
        ]
        .map(|three| three.map(float).join(","));
        format!(
            "{},{},{},{},{},{},{},{gyro},{accel},{},{}",
            self.set,
            self.utc_ns,
            self.time_ns,
            self.device_time,
            self.sequence,
            self.uncertainty_ns,
            self.accel_offset_ns,
            float(self.temperature_c),
            self.flags
        )
    }
}

/// The columns of the NPY file with NumPy's names of their kinds: set and UTC, then the fields of a sample.
pub(super) fn columns() -> Vec<(&'static str, &'static str, usize)> {
    let of = |f: &depthrig_bus::Field| {
        let kind = match f.kind {
            "i64" => "<i8",
            "u64" => "<u8",
            "i32" => "<i4",
            "u32" => "<u4",
            _ => "<f4",
        };
        (f.name, kind, f.count)
    };
    [("set", "<u8", 1), ("utc_ns", "<i8", 1)].into_iter().chain(MOTION_FIELDS.iter().map(of)).collect()
}
