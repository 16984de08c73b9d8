//! Options of `depthrig export bytecameradepth`.

use super::Common;
use anyhow::Result;
use clap::ValueEnum;
use depthrig_convert::{ByteCameraExport, CameraNames};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Writes OUT/YYYYMMDD_HHMM/camera_<model>/ with depth_N.png (16 bits, in the unit given in
calibration.json; 0 is no depth), color_N.png, ir_N.png and raw_depth_N.npy (metres), and
frames.csv and calibration.json beside the camera folders. N counts the sets from 0: the same N is
the same set in every folder; a missing number means that the set lacks this frame. OUT is new, or
an unfinished export with the same options, which is resumed.

Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage, 3 exported, but some sets, frames or
pixels could not be.

Examples:
  depthrig export bytecameradepth data/20261121_1015_kitchen paper
  depthrig export bytecameradepth data/* paper --names long --depth-unit 0.001";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    common: Common,
    /// Style of the camera folder names
    #[arg(long, value_enum, default_value = "short")]
    names: Names,
    /// Rescale 16-bit depth to this unit, metres [default: the camera's unit]
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
    /// Builds the exporter, and returns it with the common options.
    pub fn exporter(&self) -> Result<(ByteCameraExport, &Common)> {
        let names = match self.names {
            Names::Short => CameraNames::Short,
            Names::Long => CameraNames::Long,
        };
        let exporter = ByteCameraExport::new(names, self.depth_unit).map_err(super::usage)?;
        Ok((exporter, &self.common))
    }
}
