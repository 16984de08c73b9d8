//! Options of `depthrig export bytecameradepth`.

use super::Common;
use anyhow::Result;
use clap::ValueEnum;
use depthrig_recorder::exchange::{ByteCameraExport, CameraNames};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Writes OUT/YYYYMMDD_HHMM/camera_<model>/ with depth_N.png (16 bits, in the unit that
calibration.json names; 0 is no depth), color_N.png, ir_N.png, raw_depth_N.npy (metres), and
frames.csv and calibration.json beside the cameras. N counts the sets from 0: the same N is the same
set in every folder, and a number that is not there is a frame that the set has not. OUT is new, or
holds the same export unfinished, which then goes on.

Exit codes: 0 all, 1 failed or ended before all was done, 2 wrong usage, 3 exported, but some sets,
frames or pixels could not be.

Examples:
  depthrig export bytecameradepth data/20261121_1015_kitchen paper
  depthrig export bytecameradepth data/* paper --names long --depth-unit 0.001";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    common: Common,
    /// How cameras are spelled: camera_d455 or camera_realsense_455
    #[arg(long, value_enum, default_value = "short")]
    names: Names,
    /// Rescale 16-bit depth to this unit instead of the camera's own; 0.001 is a millimetre
    #[arg(long, value_name = "METRES", value_parser = crate::args::depth_unit_m)]
    depth_unit: Option<f64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Names {
    /// camera_d455
    Short,
    /// camera_realsense_455
    Long,
}

impl Args {
    /// The exporter, and what every export has.
    pub fn exporter(&self) -> Result<(ByteCameraExport, &Common)> {
        let names = match self.names {
            Names::Short => CameraNames::Short,
            Names::Long => CameraNames::Long,
        };
        let exporter = ByteCameraExport::new(names, self.depth_unit).map_err(super::usage)?;
        Ok((exporter, &self.common))
    }
}
