//! The IMU's calibration as the flash has it.
//!
//! Layouts: librealsense `src/ds/ds-private.h` (`dm_v2_eeprom`, `dm_v2_calibration_table`; Apache-2.0). Matrices lie column
//! after column.

use super::{Flash, World};
use crate::calibration::{ImuAxes, ImuCalibration};
use depthrig_realsense::protocol::tables::Header;

/// Its number in [`crate::Fault::DamagedTable`].
const IMU: u32 = 34;

fn floats(bytes: &mut Vec<u8>, values: impl IntoIterator<Item = f32>) {
    bytes.extend(values.into_iter().flat_map(f32::to_le_bytes));
}

fn columns(rows: [f32; 9]) -> impl Iterator<Item = f32> {
    (0..9).map(move |at| rows[at % 3 * 3 + at / 3])
}

/// `dm_v2_calibration_table` without its header: 244 bytes.
fn numbers(given: &ImuCalibration, flash: &Flash) -> Vec<u8> {
    let valid = u8::from(!flash.uncalibrated);
    let mut bytes = vec![valid, valid, 0, 0];
    floats(&mut bytes, columns(given.rotation));
    floats(&mut bytes, given.translation_m);
    for ImuAxes { sensitivity, bias } in [&given.accelerometer, &given.gyroscope] {
        floats(&mut bytes, columns(*sensitivity));
        floats(&mut bytes, *bias);
    }
    bytes.resize(bytes.len() + 96, 0);
    bytes
}

/// The reply of a D400 to `MMER`: the table, then a serial number, inside two more headers.
pub(super) fn eeprom(world: &World<'_>, flash: &Flash) -> Vec<u8> {
    let Some(given) = &world.identity.calibration.imu else { return Vec::new() };
    let table = Header::close(0x20, [1, 1], 0, &numbers(given, flash));
    let serial = Header::close(0x21, [1, 1], 0, &[0; 16]);
    let module = Header::close(0x10, [1, 1], 0, &[table, serial].concat());
    damaged(Header::close(0x09, [1, 1], 0, &module), flash)
}

/// The table of an L515.
pub(super) fn l515(given: &ImuCalibration, flash: &Flash) -> Vec<u8> {
    damaged(Header::close(0x243, [5, 1], 0, &numbers(given, flash)), flash)
}

fn damaged(mut table: Vec<u8>, flash: &Flash) -> Vec<u8> {
    if flash.damaged.contains(&IMU)
        && let Some(byte) = table.last_mut()
    {
        *byte ^= 0x10;
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::Calibration;
    use crate::model::Model;

    /// Offsets counted by hand from the structures.
    #[test]
    fn the_numbers_lie_where_the_vendor_reads_them() {
        let given = Calibration::new(&Model::named("l515").unwrap(), "f0000001").imu.unwrap();
        let bytes = l515(&given, &Flash::default());
        let float = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!((bytes.len(), &bytes[..2], &bytes[16..20]), (260, &[5, 1][..], &[1, 1, 0, 0][..]));
        assert_eq!(float(24), given.rotation[3], "the second number is the first column's second row");
        assert_eq!(float(56), given.translation_m[0]);
        assert_eq!(float(68 + 4), given.accelerometer.sensitivity[3]);
        assert_eq!(float(104), given.accelerometer.bias[0]);
        assert_eq!(float(116), given.gyroscope.sensitivity[0]);
        assert_eq!(float(160), given.gyroscope.bias[2]);
    }
}
