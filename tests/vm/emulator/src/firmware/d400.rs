//! The firmware of a D400: what its hardware monitor answers.

use super::World;
use super::monitor::{Request, WRONG_COMMAND, WRONG_PARAMETER};
use crate::model::{Model, from_hex};

/// The state of the firmware since power-on.
pub(crate) struct State {}

impl State {
    pub fn new(_model: &Model) -> Self {
        Self {}
    }

    /// What a request is answered; `None`: with a restart.
    pub fn answer(&mut self, request: &Request<'_>, world: &World<'_>) -> Option<Result<Vec<u8>, i32>> {
        Some(match request.opcode {
            0x01 => read_memory(request, world),
            0x10 => Ok(version_data(world)),
            0x20 => return None,
            _ => Err(WRONG_COMMAND),
        })
    }
}

/// The clock is the only memory that can be read.
fn read_memory(request: &Request<'_>, world: &World<'_>) -> Result<Vec<u8>, i32> {
    if request.params[..2] != [0x0001_613C, 0x0001_6140] {
        return Err(WRONG_PARAMETER);
    }
    let us = world.clock.shown_us(world.clock.running_ns(world.now));
    Ok(us.to_le_bytes().to_vec())
}

/// GVD: who the camera is and what it has.
fn version_data(world: &World<'_>) -> Vec<u8> {
    let mut data = vec![0; 256];
    let mut put = |at: usize, bytes: &[u8]| {
        if let Some(to) = data.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
        }
    };
    let [a, b, c, d] = world.model.firmware;
    put(2, &[3]);
    put(12, &[d, c, b, a]);
    put(25, &[1]);
    put(48, &from_hex(&world.identity.serial).unwrap_or_default());
    put(64, &from_hex(&world.identity.chip_serial).unwrap_or_default());
    let has_color = world.model.functions.len() > 1;
    let global_shutter = world.model.product_id != 0x0AD3;
    put(166, &[if global_shutter { 2 } else { 1 }]);
    put(170, &[(world.model.product_id != 0x0B5B).into()]);
    put(174, &[has_color.into()]);
    put(178, &[world.model.imu.into()]);
    if world.model.imu {
        put(124, &[0x1F]);
        put(212, &[5, 12, 1, 0]);
    }
    data
}
