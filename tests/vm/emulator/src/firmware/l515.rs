//! The firmware of an L515: what its hardware monitor answers.
//!
//! Opcodes and structures: librealsense `src/l500/` at commit aa80741c (Apache-2.0).

use super::monitor::{NO_DATA, Request, WRONG_COMMAND, WRONG_PARAMETER};
use super::{Flash, World, imu_table, read_clock};
use crate::model::from_hex;

const CLOCK: u32 = 0x9003_021C;
/// The table of the IMU (`L515_IMU_TABLE`).
const IMU_TABLE: u32 = 0x243;
/// The receiver's gain trim on the I2C bus, which librealsense logs at the start: device, register and bytes.
const GAIN_TRIM: [u32; 3] = [0x6C, 0x2, 0x1];
/// Least, greatest, step and default of the controls, in the order of their numbers.
const CONTROLS: [[i32; 4]; 9] = [
    [0, 3, 1, 1],
    [0, 5, 1, 1],
    [0, 5, 1, 0],
    [0, 6, 1, 4],
    [0, 18, 1, 9],
    [0, 100, 1, 100],
    [95, 6000, 1, 490],
    [0, 1, 1, 0],
    [0, 1, 1, 0],
];

/// The state of the firmware since power-on: the values of its controls.
pub(crate) struct State([i32; 9]);

impl Default for State {
    fn default() -> Self {
        Self(CONTROLS.map(|[_, _, _, default]| default))
    }
}

impl State {
    /// The reply to a request; `None` for a restart.
    pub fn answer(
        &mut self,
        request: &Request<'_>,
        world: &World<'_>,
        flash: &Flash,
    ) -> Option<Result<Vec<u8>, i32>> {
        let [p1, p2, p3, _] = request.params;
        let tables = world.identity.calibration.l515.as_ref();
        let table = |read: fn(&crate::calibration::L515) -> Vec<u8>| tables.map(read).ok_or(WRONG_COMMAND);
        Some(match request.opcode {
            0x01 => read_clock(request, world, CLOCK),
            0x03 if [p1, p2, p3] == GAIN_TRIM => Ok(vec![0x12]),
            // Its log is empty.
            0x0F => Err(NO_DATA),
            0x10 => Ok(version_data(world)),
            // The trigger by cable; whether a fall switches the laser off.
            0x19 | 0x9D => Ok(Vec::new()),
            0x20 => return None,
            0x2B => self.set(p1, p2 as i32),
            0x2C => self.get(p1, p2),
            0x43 if p1 == IMU_TABLE => {
                let given = world.identity.calibration.imu.as_ref();
                given.map(|given| imu_table::l515(given, flash)).ok_or(WRONG_PARAMETER)
            }
            0x03 | 0x43 => Err(WRONG_PARAMETER),
            0x6A => {
                // Six temperatures, and from firmware 1.5.0.0 on the mean of the noise estimation (`extended_temperatures`).
                let values = [38.5f64, 36.25, 35.0, 37.75, 30.0, 38.0, 1250.0];
                Ok(values.iter().flat_map(|v| v.to_le_bytes()).collect())
            }
            0x7F => table(crate::calibration::L515::depth_table),
            0x81 => table(crate::calibration::L515::color_table),
            0x82 => table(crate::calibration::L515::extrinsics),
            _ => Err(WRONG_COMMAND),
        })
    }

    fn get(&self, control: u32, what: u32) -> Result<Vec<u8>, i32> {
        let at = control as usize;
        let (value, range) = self.0.get(at).zip(CONTROLS.get(at)).ok_or(WRONG_PARAMETER)?;
        let value = match what {
            0 => *value,
            1..=4 => range[what as usize - 1],
            _ => return Err(WRONG_PARAMETER),
        };
        Ok(value.to_le_bytes().to_vec())
    }

    fn set(&mut self, control: u32, value: i32) -> Result<Vec<u8>, i32> {
        let at = control as usize;
        let (slot, range) = self.0.get_mut(at).zip(CONTROLS.get(at)).ok_or(WRONG_PARAMETER)?;
        // -1 is the vendor's way to say "the default".
        let value = if value == -1 { range[3] } else { value };
        if !(range[0]..=range[1]).contains(&value) {
            return Err(WRONG_PARAMETER);
        }
        *slot = value;
        Ok(Vec::new())
    }
}

/// GVD of an L515: firmware at 12, lock at 6, module serial at 60 (4 bytes), serial of the chip at 74 (6 bytes).
fn version_data(world: &World<'_>) -> Vec<u8> {
    let mut data = vec![0; 240];
    let mut put = |at: usize, bytes: &[u8]| {
        if let Some(to) = data.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
        }
    };
    let [a, b, c, d] = world.model.firmware;
    put(12, &[d, c, b, a]);
    put(6, &[1]);
    put(60, &from_hex(&world.identity.serial).unwrap_or_default());
    put(74, &from_hex(&world.identity.chip_serial).unwrap_or_default());
    data
}
