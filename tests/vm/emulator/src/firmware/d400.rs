//! The firmware of a D400: what its hardware monitor answers.
//!
//! Opcodes and structures: librealsense `src/ds/d400/d400-private.h` and `src/ds/ds-private.h` (Apache-2.0).

use super::monitor::{EMPTY_TABLE, NO_DATA, NOT_READY, Request, UNSUPPORTED, WRONG_COMMAND, WRONG_PARAMETER};
use super::{Flash, World, imu_table as imu, read_clock};
use crate::model::{ImuChip, Model, from_hex};
use depthrig_realsense::protocol::advanced::Group;
use depthrig_realsense::protocol::tables::{self, Pinhole, RectifiedItem, SIZES};

const CLOCK: u32 = 0x0001_613C;
const D405: u16 = 0x0B5B;
const D415: u16 = 0x0AD3;

/// The state of the firmware since power-on.
pub(crate) struct State {
    /// The groups of advanced mode.
    groups: Vec<Vec<u8>>,
    sync: u32,
    depth_roi: [u16; 4],
    color_roi: [u16; 4],
    limits: Limits,
    laser_constant: u32,
    /// The sub-preset that was downloaded; empty: none.
    sub_preset: Vec<u8>,
}

/// The limits of auto-exposure; 0 means unlimited.
#[derive(Debug, Clone, Copy, Default)]
struct Limits {
    least_exposure: u32,
    most_exposure: u32,
    least_gain: u32,
    most_gain: u32,
}

impl State {
    pub fn new(model: &Model) -> Self {
        let mut groups: Vec<Vec<u8>> = Group::ALL.iter().map(|group| vec![0; group.bytes()]).collect();
        let depth = [model.depth_unit_um as u32, 0, 65_535, 0, 0];
        if let Some(group) = groups.get_mut(Group::DepthTable as usize) {
            *group = depth.iter().flat_map(|v| v.to_le_bytes()).collect();
        }
        let whole = [0, 719, 0, 1279];
        Self {
            groups,
            sync: 0,
            depth_roi: whole,
            color_roi: whole,
            limits: Limits::default(),
            laser_constant: 0,
            sub_preset: Vec::new(),
        }
    }

    /// The reply to a request; `None` for a restart.
    pub fn answer(
        &mut self,
        request: &Request<'_>,
        world: &World<'_>,
        flash: &Flash,
    ) -> Option<Result<Vec<u8>, i32>> {
        let [p1, p2, ..] = request.params;
        Some(match request.opcode {
            0x01 => read_clock(request, world, CLOCK),
            0x09 => Ok(vec![0xFF; p2.min(1000) as usize]),
            0x0F => Err(NO_DATA),
            0x10 => Ok(version_data(world)),
            0x15 => table(p1, world, flash),
            0x20 => return None,
            // Its data begin with the temperature in °C.
            0x2A => Ok(vec![if world.streaming { 41 } else { 29 }, 0, 0, 0]),
            0x2B => self.set_group(request, world),
            0x2C => self.group(p1, p2),
            0x2D => Ok(Vec::new()),
            0x30 => Ok(vec![1, 0, 0, 0]),
            0x44 => set_roi(&mut self.depth_roi, request),
            0x45 => Ok(words16(self.depth_roi)),
            0x4F if world.model.imu.is_some() => Ok(imu::eeprom(world, flash)),
            0x4F => Err(EMPTY_TABLE),
            0x69 | 0x6A if world.model.product_id == D405 => Err(UNSUPPORTED),
            0x69 if world.streaming => Err(NOT_READY),
            0x69 => {
                self.sync = p1;
                Ok(Vec::new())
            }
            0x6A => Ok(self.sync.to_le_bytes().to_vec()),
            0x75 => set_roi(&mut self.color_roi, request),
            0x76 => Ok(words16(self.color_roi)),
            0x7B => {
                self.sub_preset = request.data.to_vec();
                Ok(Vec::new())
            }
            0x7C | 0x7D if self.sub_preset.is_empty() => Err(NO_DATA),
            0x7C => Ok(self.sub_preset.clone()),
            // The id is the second byte of its header (`src/hdr-config.h`, `SubPresetHeader`).
            0x7D => Ok(vec![self.sub_preset.get(1).copied().unwrap_or(0), 0, 0, 0]),
            0x7E => Ok(RectifiedItem::build_all(&rectified(world, flash))),
            0x7F if p1 == 2 => Ok(self.laser_constant.to_le_bytes().to_vec()),
            0x7F => {
                self.laser_constant = p1;
                Ok(Vec::new())
            }
            // The order of the reply is not that of the request (`src/ds/d400/d400-options.cpp`).
            0x89 => {
                let Limits { least_exposure, most_exposure, least_gain, most_gain } = self.limits;
                let words = [least_exposure, least_gain, most_exposure, most_gain];
                Ok(words.iter().flat_map(|v| v.to_le_bytes()).collect())
            }
            0x8A => {
                let [least_exposure, most_exposure, least_gain, most_gain] = request.params;
                self.limits = Limits { least_exposure, most_exposure, least_gain, most_gain };
                Ok(Vec::new())
            }
            _ => Err(WRONG_COMMAND),
        })
    }

    fn group(&self, number: u32, bound: u32) -> Result<Vec<u8>, i32> {
        let group = self.groups.get(number as usize).ok_or(WRONG_PARAMETER)?;
        match bound {
            0 => Ok(group.clone()),
            1 | 2 if number == Group::DepthTable as u32 => Ok(depth_table_bound(bound == 2)),
            1 => Ok(vec![0; group.len()]),
            2 => Ok(vec![0x7F; group.len()]),
            _ => Err(WRONG_PARAMETER),
        }
    }

    fn set_group(&mut self, request: &Request<'_>, world: &World<'_>) -> Result<Vec<u8>, i32> {
        let group = self.groups.get_mut(request.params[0] as usize).ok_or(WRONG_PARAMETER)?;
        if request.data.len() != group.len() {
            return Err(WRONG_PARAMETER);
        }
        if world.streaming && request.params[0] == Group::DepthTable as u32 {
            return Err(NOT_READY);
        }
        group.copy_from_slice(request.data);
        Ok(Vec::new())
    }
}

/// The least or the greatest values of the depth table. Units are 100 to 10000 um, which is what librealsense reports of
/// a D400 (its issue 5587); what the firmware allows for the others is not documented: all of their types.
fn depth_table_bound(most: bool) -> Vec<u8> {
    let words = if most { [10_000, 65_535, 65_535, 1, 65_535] } else { [100, 0, 0, 0, 0] };
    words.iter().flat_map(|v: &u32| v.to_le_bytes()).collect()
}

fn words16(values: [u16; 4]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn set_roi(roi: &mut [u16; 4], request: &Request<'_>) -> Result<Vec<u8>, i32> {
    let [min_y, max_y, min_x, max_x] = request.params;
    if min_y >= max_y || min_x >= max_x {
        return Err(WRONG_PARAMETER);
    }
    *roi = request.params.map(|v| v as u16);
    Ok(Vec::new())
}

/// A calibration table, as the flash has it.
fn table(id: u32, world: &World<'_>, flash: &Flash) -> Result<Vec<u8>, i32> {
    let calibration = &world.identity.calibration;
    let mut table = match id {
        25 => {
            let mut coefficients = calibration.coefficients.clone().ok_or(EMPTY_TABLE)?;
            if flash.uncalibrated {
                coefficients.rectified = [UNCALIBRATED; 16];
            }
            coefficients.build()
        }
        32 => calibration.rgb.as_ref().ok_or(EMPTY_TABLE)?.build(),
        31 | 33..=36 => return Err(EMPTY_TABLE),
        _ => return Err(WRONG_PARAMETER),
    };
    if flash.damaged.contains(&id)
        && let Some(byte) = table.get_mut(tables::HEADER + 40)
    {
        *byte ^= 0x10;
    }
    Ok(table)
}

/// Intrinsics of a unit that was never calibrated: equal focal lengths, and equal coordinates of the principal point.
const UNCALIBRATED: Pinhole = Pinhole { fx: 1.0, fy: 1.0, ppx: 0.0, ppy: 0.0 };

fn rectified(world: &World<'_>, flash: &Flash) -> Vec<RectifiedItem> {
    let Some(coefficients) = &world.identity.calibration.coefficients else { return Vec::new() };
    let item = |(size, pinhole): (Option<(u32, u32)>, &Pinhole)| {
        let (width, height) = size?;
        let pinhole = if flash.uncalibrated { UNCALIBRATED } else { *pinhole };
        Some(RectifiedItem { width: width as u16, height: height as u16, pinhole })
    };
    SIZES.into_iter().zip(&coefficients.rectified).filter_map(item).collect()
}

/// GVD: identity and features of the camera.
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
    // No fisheye, and no version of one.
    put(112, &[0xFF, 0xFF]);
    put(166, &[if world.model.product_id == D415 { 1 } else { 2 }]);
    put(170, &[(world.model.product_id != D405).into()]);
    put(174, &[(world.model.functions.len() > 1).into()]);
    put(178, &[world.model.imu.is_some().into()]);
    if let Some(chip) = world.model.imu {
        put(124, &[if chip == ImuChip::Bmi055 { 0xFA } else { 0x1F }]);
        put(212, &[5, 12, 1, 0]);
    }
    data
}
