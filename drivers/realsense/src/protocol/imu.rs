//! The IMU of a D435i, a D455 or an L515: its calibration table, its rates and units.
//!
//! Layouts and constants: librealsense `src/ds/ds-private.h` (`dm_v2_eeprom`, `dm_v2_calibration_table`),
//! `src/ds/ds-calib-parsers.cpp` (where it sits), `src/ds/ds-motion-common.h` (selectors of rates),
//! `src/proc/motion-transform.cpp` (units, and the order of correction); Apache-2.0.

use super::hwm::{HardwareMonitor, Request};
use super::intrinsics::{rigid, rotation};
use super::protocol_error;
use super::tables::HEADER;
use depthrig_bus::Pose;
use depthrig_driver::bytes::{f32_at, u16_at, u32_at};
use depthrig_driver::{ErrorKind, Result};
use glam::{DMat3, DVec3};

/// Standard gravity, m/s².
const GRAVITY: f64 = 9.806_65;
/// Bytes of `dm_v2_calibration_table` behind its header, without what is reserved.
const NUMBERS: usize = 4 + 48 + 48 + 48;
/// No sensor's sensitivity is as far from 1, nor its bias as far from 0 (m/s² or degrees per second).
const LARGEST_SENSITIVITY: f64 = 10.0;
const LARGEST_BIAS: f64 = 100.0;
/// Versions that a table begins with: a D400's and an L515's.
const D4XX_VERSION: u16 = 0x0101;
const L515_VERSION: u16 = 0x0105;

/// The correction of one sensor's samples: `sensitivity * measured - bias`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axes {
    /// Without a unit.
    pub sensitivity: DMat3,
    /// m/s² or rad/s.
    pub bias: DVec3,
}

impl Axes {
    const NONE: Self = Self { sensitivity: DMat3::IDENTITY, bias: DVec3::ZERO };

    /// As a table has it, of the sensor `name`.
    fn checked(self, name: &str) -> Result<Self> {
        // Written so that what is not a number is refused too.
        let is_within = |values: &[f64], most: f64| values.iter().all(|v| v.abs() <= most);
        if is_within(&self.sensitivity.to_cols_array(), LARGEST_SENSITIVITY)
            && is_within(&self.bias.to_array(), LARGEST_BIAS)
        {
            return Ok(self);
        }
        Err(protocol_error(format!(
            "the IMU's table has a calibration of the {name} that no sensor has: {self}"
        )))
    }
}

/// `S = [[…], […], […]], b = […]`, S row after row, with the digits that the camera's table has.
impl core::fmt::Display for Axes {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let rows = [0, 1, 2].map(|row| self.sensitivity.row(row).as_vec3().to_array());
        write!(f, "S = {rows:?}, b = {:?}", self.bias.as_vec3().to_array())
    }
}

/// The calibration of an IMU, along the axes of the depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImuCalibration {
    /// Of acceleration.
    pub accelerometer: Axes,
    /// Of rotation.
    pub gyroscope: Axes,
    /// The IMU in the frame of the depth camera.
    pub pose: Pose,
    /// Sensitivity and bias are the camera's own; else they are those of an ideal sensor.
    pub is_calibrated: bool,
}

/// The two families, which keep the table in different places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// The memory of a D400's IMU.
    D4xx,
    /// A table of an L515.
    L515,
}

/// Where the IMU sits by the vendor's drawings, metres from the depth camera to it; by USB product number.
fn drawn(product: u16) -> DVec3 {
    match product {
        0x0B3A => DVec3::new(-0.005_52, 0.005_1, 0.011_74),
        0x0B5C => DVec3::new(-0.030_22, 0.007_4, 0.016_02),
        0x0B64 | 0x0B3D => DVec3::new(-0.012_45, 0.016_42, 0.000_57),
        _ => DVec3::ZERO,
    }
}

impl ImuCalibration {
    /// The calibration of a camera without a table: ideal sensors where the vendor's drawings have them.
    pub fn drawn(product: u16) -> Self {
        Self {
            accelerometer: Axes::NONE,
            gyroscope: Axes::NONE,
            // From the depth camera to the IMU; a pose is the other way round.
            pose: Pose { translation_m: (-drawn(product)).to_array(), ..Pose::IDENTITY },
            is_calibrated: false,
        }
    }

    /// Reads the table of a camera. One that was never written is [`Self::drawn`], as in the vendor's software.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when the table is damaged; those of the hardware monitor.
    pub fn read(monitor: &mut dyn HardwareMonitor, place: Place, product: u16) -> Result<Self> {
        let request = match place {
            Place::D4xx => Request::imu_memory(),
            Place::L515 => Request::l515_imu_table(),
        };
        match monitor.command(&request) {
            Ok(data) => Self::parse(&data, product),
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::Unsupported) => {
                Ok(Self::drawn(product))
            }
            Err(e) => Err(e),
        }
    }

    /// Takes the reply of either family apart.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when it is short, of an unknown version, fails its checksum, or holds numbers that no
    /// sensor has.
    pub fn parse(data: &[u8], product: u16) -> Result<Self> {
        let payload = data.get(HEADER..).unwrap_or_default();
        let start = match u16_at(data, 0) {
            // The memory of a D400 has the table inside two more headers.
            Some(D4XX_VERSION) => 3 * HEADER,
            Some(L515_VERSION) => HEADER,
            version => {
                return Err(protocol_error(format!(
                    "the IMU's table has {} bytes and the unknown version {version:04x?}",
                    data.len()
                )));
            }
        };
        let stated = u32_at(data, 12).unwrap_or_default();
        // Firmware may send what lies behind the table too, which its checksum leaves out.
        let size = u32_at(data, 4).map_or(0, |n| n as usize);
        let sums = [payload, payload.get(..size).unwrap_or(payload)].map(crc32fast::hash);
        if !sums.contains(&stated) {
            return Err(protocol_error(format!(
                "the IMU's table is damaged: its checksum is {:08x} and should be {stated:08x}",
                sums[0]
            )));
        }
        let numbers = data.get(start..start + NUMBERS).ok_or_else(|| {
            protocol_error(format!("the IMU's table has {} bytes, which is too few", data.len()))
        })?;
        let has_extrinsics = numbers.first() == Some(&1);
        let has_intrinsics = numbers.get(1) == Some(&1);
        let float = |at: usize| f64::from(f32_at(numbers, 4 + 4 * at).unwrap_or_default());
        // Matrices lie column after column.
        let matrix = |at: usize| DMat3::from_cols_array(&core::array::from_fn(|i| float(at + i)));
        let vector = |at: usize| DVec3::new(float(at), float(at + 1), float(at + 2));
        let mut calibration = Self::drawn(product);
        if has_extrinsics {
            // The table says `p_imu = R p_depth + t`; its columns, read as rows, are the rotation back.
            let back = rotation(core::array::from_fn(|at| float(at) as f32))?;
            calibration.pose = rigid(back, -(back * vector(9)))?;
        }
        if has_intrinsics {
            calibration.accelerometer =
                Axes { sensitivity: matrix(12), bias: vector(21) }.checked("accelerometer")?;
            let Axes { sensitivity, bias } =
                Axes { sensitivity: matrix(24), bias: vector(33) }.checked("gyroscope")?;
            // The table has degrees per second.
            calibration.gyroscope = Axes { sensitivity, bias: bias * 1f64.to_radians() };
        }
        calibration.is_calibrated = has_intrinsics;
        Ok(calibration)
    }

    /// Whether samples are corrected, and with which numbers: for [`depthrig_driver::DeviceInfo::motion`].
    pub fn stated(&self) -> String {
        if !self.is_calibrated {
            return "accel_m_s2 and gyro_rad_s are not corrected for bias and scale: the camera has no calibration of its IMU"
                .to_owned();
        }
        let Self { accelerometer, gyroscope, .. } = self;
        format!(
            "accel_m_s2 and gyro_rad_s are corrected with the camera's factory calibration, v = S m - b: do not correct them again; \
             of accel_m_s2 {accelerometer} m/s^2, of gyro_rad_s {gyroscope} rad/s"
        )
    }

    /// Acceleration of counts along the sensor's own axes, m/s² along those of the depth camera.
    pub fn acceleration_m_s2(&self, counts: [i32; 3]) -> [f32; 3] {
        corrected(&self.accelerometer, turned(counts) * (0.001 * GRAVITY))
    }

    /// Rotation of counts, `bits` of which mean something, rad/s.
    pub fn rotation_rad_s(&self, counts: [i32; 3], bits: u32) -> [f32; 3] {
        // Firmware that sends 32 bits counts ten-thousandths of a degree per second, older firmware tenths.
        let degrees: f64 = if bits > 16 { 0.0001 } else { 0.1 };
        corrected(&self.gyroscope, turned(counts) * degrees.to_radians())
    }
}

/// The IMU of every model sits turned by half a turn about y.
fn turned([x, y, z]: [i32; 3]) -> DVec3 {
    DVec3::new(-f64::from(x), f64::from(y), -f64::from(z))
}

fn corrected(axes: &Axes, measured: DVec3) -> [f32; 3] {
    (axes.sensitivity * measured - axes.bias).to_array().map(|v| v as f32)
}

/// Two rates that go together, and what the kernel's sampling frequency is set to for them: the firmware takes it for a
/// selector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Samples of rotation a second.
    pub gyro_hz: f64,
    /// The value that selects this rate.
    pub gyro_selector: &'static str,
    /// Samples of acceleration a second, never more than of rotation.
    pub accel_hz: f64,
    /// The value that selects this rate.
    pub accel_selector: &'static str,
}

const fn rates(
    gyro_hz: f64,
    gyro_selector: &'static str,
    accel_hz: f64,
    accel_selector: &'static str,
) -> Rates {
    Rates { gyro_hz, gyro_selector, accel_hz, accel_selector }
}

const BMI055: [Rates; 2] = [rates(400.0, "4", 250.0, "3"), rates(200.0, "2", 62.5, "1")];
const BMI085: [Rates; 2] = [rates(400.0, "4", 400.0, "4"), rates(200.0, "2", 200.0, "2")];
const L515: [Rates; 3] =
    [rates(400.0, "4", 400.0, "4"), rates(200.0, "2", 200.0, "2"), rates(100.0, "1", 100.0, "1")];

/// The rates of a camera, the default first. `chip` is what a D400 says of its accelerometer.
pub fn rates_of(place: Place, chip: u8) -> &'static [Rates] {
    match (place, chip) {
        (Place::L515, _) => &L515,
        // BMI085 and BMI088.
        (Place::D4xx, 0x1F | 0x1E) => &BMI085,
        // A BMI055 says 0xFA; others are taken for one, as in the vendor's software.
        (Place::D4xx, _) => &BMI055,
    }
}

#[cfg(test)]
mod tests;
