//! `depthrig export lerobot`.

use super::Common;
use clap::ValueEnum;
use depthrig_bus::StreamId;
use depthrig_recorder::exchange::lerobot::{Incomplete, Lerobot, LerobotOptions};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The datasets are episodes in the order given and need the same streams. Colour stays the JPEG that was recorded (PNG
where it was recorded without loss); depth is TIFF, bit by bit. Missing pictures are blank and marked in the columns
missing.CAMERA_STREAM.

Examples:
  depthrig export lerobot data/20261121_1015_kitchen lerobot/kitchen
  depthrig export lerobot data/2026* lerobot/all --task \"put the cup on the shelf\"
  depthrig export lerobot data/run lerobot/run --stream d435/color --stream d435/depth --incomplete leave-out";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    common: Common,
    /// The task of all episodes [default: each session's scene]
    #[arg(long, value_name = "TEXT")]
    task: Option<String>,
    /// Sets per second [default: as configured and recorded]
    #[arg(long, value_name = "HZ", value_parser = crate::args::rate_hz)]
    fps: Option<f64>,
    /// What to do with a set that lacks a frame
    #[arg(long, value_enum, default_value = "mark", value_name = "HOW")]
    incomplete: HowIncomplete,
    /// Export only this stream (may be given several times)
    #[arg(long = "stream", value_name = "CAMERA/STREAM")]
    streams: Vec<StreamId>,
}

/// What to do with a set that lacks a frame.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum HowIncomplete {
    /// A blank picture, marked as missing
    Mark,
    /// Leave the set out
    LeaveOut,
}

impl Args {
    /// The exporter that is asked for, and what every export has.
    pub fn exporter(&self) -> (Lerobot, &Common) {
        let options = LerobotOptions {
            task: self.task.clone(),
            fps: self.fps,
            incomplete: match self.incomplete {
                HowIncomplete::Mark => Incomplete::Mark,
                HowIncomplete::LeaveOut => Incomplete::LeaveOut,
            },
            streams: self.streams.clone(),
        };
        (Lerobot::new(options), &self.common)
    }
}
