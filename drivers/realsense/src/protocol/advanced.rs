//! Advanced mode of a D400: groups of raw settings of its stereo processor, and the depth unit among them.

use super::hwm::{HardwareMonitor, Request};
use super::protocol_error;
use depthrig_driver::bytes::{i32_at, put, u32_at};
use depthrig_driver::{Error, ErrorKind, Result};

/// A group of settings (librealsense `src/core/advanced_mode.h`, `EtAdvancedModeRegGroup`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u32)]
pub enum Group {
    /// Thresholds of depth.
    DepthControl = 0,
    /// Removal of small mismatches.
    Rsm = 1,
    /// Support vectors.
    RauSupportVector = 2,
    /// Which steps use colour.
    ColorControl = 3,
    /// Thresholds of colour of the support vectors.
    RauColorThresholds = 4,
    /// Thresholds of colour of the scanline optimisation.
    SloColorThresholds = 5,
    /// Penalties of the scanline optimisation.
    SloPenalty = 6,
    /// Weights of the matching cost.
    Hdad = 7,
    /// Colour correction.
    ColorCorrection = 8,
    /// Unit and clamps of depth, disparity shift.
    DepthTable = 9,
    /// Set point of auto-exposure.
    AeControl = 10,
    /// Radius of the census transform.
    CensusRadius = 11,
    /// Amplitude factor.
    AmplitudeFactor = 12,
}

impl Group {
    /// Every group, in the order of their numbers.
    pub const ALL: [Self; 13] = [
        Self::DepthControl,
        Self::Rsm,
        Self::RauSupportVector,
        Self::ColorControl,
        Self::RauColorThresholds,
        Self::SloColorThresholds,
        Self::SloPenalty,
        Self::Hdad,
        Self::ColorCorrection,
        Self::DepthTable,
        Self::AeControl,
        Self::CensusRadius,
        Self::AmplitudeFactor,
    ];

    /// The name in a preset file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DepthControl => "depth_control",
            Self::Rsm => "rsm",
            Self::RauSupportVector => "rau_support_vector",
            Self::ColorControl => "color_control",
            Self::RauColorThresholds => "rau_color_thresholds",
            Self::SloColorThresholds => "slo_color_thresholds",
            Self::SloPenalty => "slo_penalty",
            Self::Hdad => "hdad",
            Self::ColorCorrection => "color_correction",
            Self::DepthTable => "depth_table",
            Self::AeControl => "ae_control",
            Self::CensusRadius => "census_radius",
            Self::AmplitudeFactor => "amplitude_factor",
        }
    }

    /// The group with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|g| g.name() == name)
    }

    /// Its 32-bit values (librealsense `include/librealsense2/h/rs_advanced_mode_command.h`).
    pub const fn values(self) -> usize {
        match self {
            Self::DepthControl => 10,
            Self::Rsm => 4,
            Self::RauSupportVector => 8,
            Self::ColorControl | Self::DepthTable => 5,
            Self::RauColorThresholds | Self::SloColorThresholds | Self::Hdad => 3,
            Self::SloPenalty => 6,
            Self::ColorCorrection => 12,
            Self::AeControl | Self::AmplitudeFactor => 1,
            Self::CensusRadius => 2,
        }
    }

    /// Its bytes.
    pub const fn bytes(self) -> usize {
        self.values() * 4
    }
}

/// Which value of a group is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Bound {
    /// The value in force.
    Current = 0,
    /// The least.
    Least = 1,
    /// The greatest.
    Greatest = 2,
}

/// Whether advanced mode is on. Where it is off the camera refuses the rest of this module; it is switched on for
/// good with the vendor's viewer, because that writes the camera's flash.
///
/// # Errors
/// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when the reply is empty.
pub fn is_on(monitor: &mut dyn HardwareMonitor) -> Result<bool> {
    let reply = monitor.command(&Request::advanced_status())?;
    reply.first().map(|v| *v != 0).ok_or_else(|| protocol_error("the reply about advanced mode is empty"))
}

/// Reads a group, cut to its bytes.
///
/// # Errors
/// Those of [`HardwareMonitor::command`]; [`ErrorKind::Protocol`] when fewer bytes came than the group has.
pub fn get(monitor: &mut dyn HardwareMonitor, group: Group, bound: Bound) -> Result<Vec<u8>> {
    let mut reply = monitor.command(&Request::get_advanced(group as u32, bound as u32))?;
    if reply.len() < group.bytes() {
        return Err(protocol_error(format!(
            "advanced-mode group {} came with {} bytes; it has {}",
            group.name(),
            reply.len(),
            group.bytes()
        )));
    }
    reply.truncate(group.bytes());
    Ok(reply)
}

/// Writes a group. It holds until the camera restarts. Not while it streams: pixels on their way would change their
/// meaning.
///
/// # Errors
/// Those of [`HardwareMonitor::command`]; [`ErrorKind::BadInput`] when `data` has not the group's length.
pub fn set(monitor: &mut dyn HardwareMonitor, group: Group, data: &[u8]) -> Result<()> {
    if data.len() != group.bytes() {
        let is = data.len();
        let must = group.bytes();
        let text = format!("advanced-mode group {} has {must} bytes, not {is}", group.name());
        return Err(Error::new(ErrorKind::BadInput, text));
    }
    monitor.command(&Request::set_advanced(group as u32, data)?)?;
    Ok(())
}

/// The depth table, group 9.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DepthTable {
    /// Micrometres per unit of depth.
    pub unit_um: u32,
    /// Least depth, in units.
    pub clamp_min: i32,
    /// Greatest depth, in units.
    pub clamp_max: i32,
    /// Whether disparity is sent instead of depth.
    pub disparity_mode: i32,
    /// Shift of the searched disparities, pixels.
    pub disparity_shift: i32,
}

impl DepthTable {
    /// Reads the group's bytes; `None` when they are too few.
    pub fn parse(data: &[u8]) -> Option<Self> {
        Some(Self {
            unit_um: u32_at(data, 0)?,
            clamp_min: i32_at(data, 4)?,
            clamp_max: i32_at(data, 8)?,
            disparity_mode: i32_at(data, 12)?,
            disparity_shift: i32_at(data, 16)?,
        })
    }

    /// The group's bytes.
    pub fn build(&self) -> [u8; 20] {
        let mut data = [0; 20];
        put(&mut data, 0, &self.unit_um.to_le_bytes());
        put(&mut data, 4, &self.clamp_min.to_le_bytes());
        put(&mut data, 8, &self.clamp_max.to_le_bytes());
        put(&mut data, 12, &self.disparity_mode.to_le_bytes());
        put(&mut data, 16, &self.disparity_shift.to_le_bytes());
        data
    }

    fn read(monitor: &mut dyn HardwareMonitor, bound: Bound) -> Result<Self> {
        let data = get(monitor, Group::DepthTable, bound)?;
        Self::parse(&data).ok_or_else(|| protocol_error("the depth table is too short"))
    }
}

/// Where a depth unit comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnitOrigin {
    /// The camera says so.
    Camera,
    /// The camera cannot be asked, because advanced mode is off: what the model has from the factory.
    Model,
}

/// Metres per unit of depth of a camera that cannot be asked (librealsense `src/ds/d400/d400-device.cpp`).
pub const fn default_depth_unit_m(product_id: u16) -> f64 {
    match product_id {
        0x0B5B => 0.0001, // D405
        _ => 0.001,
    }
}

/// Metres per unit of depth of the D400 with the USB product id `product_id`.
///
/// # Errors
/// Those of [`get`]; [`ErrorKind::Protocol`] when the camera says 0 or more than 1 m.
pub fn depth_unit_m(monitor: &mut dyn HardwareMonitor, product_id: u16) -> Result<(f64, UnitOrigin)> {
    if !is_on(monitor)? {
        return Ok((default_depth_unit_m(product_id), UnitOrigin::Model));
    }
    match DepthTable::read(monitor, Bound::Current)?.unit_um {
        um @ 1..=1_000_000 => Ok((f64::from(um) / 1e6, UnitOrigin::Camera)),
        um => Err(protocol_error(format!("the camera reports a depth unit of {um} µm"))),
    }
}

/// Sets metres per unit of depth, rounded to micrometres; the rest of the depth table stays. Gives what it was.
/// Never while the camera streams: pixels on their way would change their meaning.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when advanced mode is off, [`ErrorKind::BadInput`] outside of what the camera allows,
/// else those of [`get`] and [`set`].
pub fn set_depth_unit_m(monitor: &mut dyn HardwareMonitor, unit_m: f64) -> Result<f64> {
    require_on(monitor, "its unit of depth cannot be changed")?;
    let least = DepthTable::read(monitor, Bound::Least)?.unit_um;
    let greatest = DepthTable::read(monitor, Bound::Greatest)?.unit_um;
    let um = (unit_m * 1e6).round();
    if !(f64::from(least.max(1))..=f64::from(greatest)).contains(&um) {
        let text = format!("a depth unit of {unit_m} m: the camera has {least} to {greatest} µm");
        return Err(Error::new(ErrorKind::BadInput, text));
    }
    let before = DepthTable::read(monitor, Bound::Current)?;
    let table = DepthTable { unit_um: um as u32, ..before };
    set(monitor, Group::DepthTable, &table.build())?;
    let after = DepthTable::read(monitor, Bound::Current)?;
    if after.unit_um != table.unit_um {
        let is = after.unit_um;
        let must = table.unit_um;
        return Err(protocol_error(format!(
            "the depth unit was set to {must} µm and the camera reports {is} µm"
        )));
    }
    Ok(f64::from(before.unit_um) / 1e6)
}

/// An error that says how to switch advanced mode on, where it is off.
pub(super) fn require_on(monitor: &mut dyn HardwareMonitor, why: &str) -> Result<()> {
    if is_on(monitor)? {
        return Ok(());
    }
    let text =
        format!("advanced mode of the camera is off, so {why}; switch it on once with the vendor's viewer");
    Err(Error::new(ErrorKind::Unsupported, text))
}

#[cfg(test)]
mod tests;
