//! GVD, what a camera says of itself: serial numbers, firmware, sensors.
//!
//! Offsets from the start of the reply's data: librealsense `src/ds/ds-private.h` (`gvd_fields`) for D400,
//! `src/l500/l500-private.h` for L515 (Apache-2.0). Newer firmware sends more behind them.

use super::firmware::Firmware;
use super::hwm::{HardwareMonitor, Request};
use super::protocol_error;
use depthrig_driver::Result;
use depthrig_driver::bytes::{array, put, u8_at};

/// A D400's account of itself.
#[allow(clippy::struct_excessive_bools)] // each is a byte of the reply
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Gvd {
    /// Version of this structure (byte 2).
    pub version: u8,
    /// Firmware.
    pub firmware: Firmware,
    /// Whether the camera refuses changes of its flash.
    pub locked: bool,
    /// The serial number that is printed on the camera: 12 hexadecimal digits.
    pub serial: String,
    /// The serial number of its processor, the one in the USB descriptor: 12 hexadecimal digits.
    pub asic_serial: String,
    /// Shutter of the depth sensors.
    pub shutter: Shutter,
    /// Whether there is a projector.
    pub projector: bool,
    /// Whether there is a colour sensor besides the depth sensors.
    pub color: bool,
    /// Whether there is an inertial unit.
    pub imu: bool,
    /// The chip of its accelerometer: 0xFA BMI055, 0x1F BMI085, 0x1E BMI088.
    pub accelerometer: u8,
}

/// How the depth sensors expose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Shutter {
    /// A code that is not known.
    #[default]
    Unknown,
    /// Row after row.
    Rolling,
    /// All rows at once.
    Global,
}

const VERSION: usize = 2;
const FIRMWARE: usize = 12;
const LOCKED: usize = 25;
const SERIAL: usize = 48;
const ASIC_SERIAL: usize = 64;
const SHUTTER: usize = 166;
const PROJECTOR: usize = 170;
const COLOR: usize = 174;
const IMU: usize = 178;
const ACCELEROMETER: usize = 124;

impl Gvd {
    /// Asks a D400.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&monitor.command(&Request::device_info())?)
    }

    /// Reads the data of a reply. What lies behind its end (the flags of sensors on early firmware) counts as not
    /// there.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`] without a serial number and firmware in it.
    pub fn parse(data: &[u8]) -> Result<Self> {
        let identity = (|| {
            let serial = hex(&array::<6>(data, SERIAL)?);
            Some((
                u8_at(data, VERSION)?,
                array(data, FIRMWARE)?,
                serial,
                hex(&array::<6>(data, ASIC_SERIAL)?),
            ))
        })();
        let (version, firmware, serial, asic_serial) = identity.ok_or_else(|| {
            let is = data.len();
            let must = ASIC_SERIAL + 6;
            protocol_error(format!(
                "the camera's account of itself (GVD) has {is} bytes; at least {must} are needed"
            ))
        })?;
        let set = |at| u8_at(data, at).is_some_and(|v| v != 0);
        Ok(Self {
            version,
            firmware: Firmware::from_device(firmware),
            locked: set(LOCKED),
            serial,
            asic_serial,
            shutter: match u8_at(data, SHUTTER) {
                Some(1) => Shutter::Rolling,
                Some(2) => Shutter::Global,
                _ => Shutter::Unknown,
            },
            projector: set(PROJECTOR),
            color: set(COLOR),
            imu: set(IMU),
            accelerometer: u8_at(data, ACCELEROMETER).unwrap_or(0),
        })
    }

    /// The data of a reply, 256 bytes, for an emulated camera. A serial number that is not 12 hexadecimal digits
    /// is left out.
    pub fn build(&self) -> Vec<u8> {
        let mut data = vec![0; 256];
        put(&mut data, VERSION, &[self.version]);
        put(&mut data, FIRMWARE, &self.firmware.to_device());
        put(&mut data, LOCKED, &[self.locked.into()]);
        put(&mut data, SERIAL, &unhex(&self.serial));
        put(&mut data, ASIC_SERIAL, &unhex(&self.asic_serial));
        let shutter = match self.shutter {
            Shutter::Unknown => 0,
            Shutter::Rolling => 1,
            Shutter::Global => 2,
        };
        put(&mut data, SHUTTER, &[shutter]);
        put(&mut data, PROJECTOR, &[self.projector.into()]);
        put(&mut data, COLOR, &[self.color.into()]);
        put(&mut data, IMU, &[self.imu.into()]);
        put(&mut data, ACCELEROMETER, &[self.accelerometer]);
        data
    }
}

/// An L515's account of itself.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct L515Gvd {
    /// Firmware.
    pub firmware: Firmware,
    /// Whether the camera refuses changes of its flash.
    pub locked: bool,
    /// The serial number that is printed on the camera: 8 hexadecimal digits.
    pub serial: String,
    /// The serial number of its processor: 12 hexadecimal digits.
    pub asic_serial: String,
}

const L515_LOCKED: usize = 6;
const L515_SERIAL: usize = 60;
const L515_ASIC_SERIAL: usize = 74;

impl L515Gvd {
    /// Asks an L515.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&monitor.command(&Request::device_info())?)
    }

    /// Reads the data of a reply.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`] when it is too short.
    pub fn parse(data: &[u8]) -> Result<Self> {
        let all = (|| {
            Some(Self {
                firmware: Firmware::from_device(array(data, FIRMWARE)?),
                locked: u8_at(data, L515_LOCKED)? != 0,
                serial: hex(&array::<4>(data, L515_SERIAL)?),
                asic_serial: hex(&array::<6>(data, L515_ASIC_SERIAL)?),
            })
        })();
        all.ok_or_else(|| {
            let is = data.len();
            let must = L515_ASIC_SERIAL + 6;
            protocol_error(format!(
                "the L515's account of itself (GVD) has {is} bytes; at least {must} are needed"
            ))
        })
    }

    /// The data of a reply, 256 bytes, for an emulated camera. A serial number that is not 8 (12 for the
    /// processor's) hexadecimal digits is left out.
    pub fn build(&self) -> Vec<u8> {
        let mut data = vec![0; 256];
        put(&mut data, L515_LOCKED, &[self.locked.into()]);
        put(&mut data, FIRMWARE, &self.firmware.to_device());
        put(&mut data, L515_SERIAL, &unhex(&self.serial));
        put(&mut data, L515_ASIC_SERIAL, &unhex(&self.asic_serial));
        data
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |text, b| text + &format!("{b:02x}"))
}

/// The bytes of hexadecimal digits; none when there is anything else in `text`.
fn unhex(text: &str) -> Vec<u8> {
    let digit = |c: u8| (c as char).to_digit(16).map(|d| d as u8);
    let pairs = text.as_bytes().chunks_exact(2);
    let whole = pairs.remainder().is_empty();
    let bytes: Option<Vec<u8>> = pairs.map(|p| Some(digit(p[0])? << 4 | digit(p[1])?)).collect();
    bytes.filter(|_| whole).unwrap_or_default()
}

#[cfg(test)]
mod tests;
