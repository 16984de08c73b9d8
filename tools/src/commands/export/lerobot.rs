//! `depthrig export lerobot`.

use super::Common;
use clap::ValueEnum;
use depthrig_bus::StreamId;
use depthrig_convert::{Gaps, Incomplete, RowOptions, VectorOptions};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The datasets become episodes in the given order and must have the same streams. Colour stays the recorded JPEG (PNG if
it was recorded losslessly); depth is lossless TIFF. Missing images are blank and marked in the columns
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
    /// Task of all episodes [default: each session's scene]
    #[arg(long, value_name = "TEXT")]
    task: Option<String>,
    /// Sets per second [default: as recorded]
    #[arg(long, value_name = "HZ", value_parser = crate::args::rate_hz)]
    fps: Option<f64>,
    /// Handling of sets that lack a frame
    #[arg(long, value_enum, default_value = "mark", value_name = "HOW")]
    incomplete: HowIncomplete,
    /// Export only this stream; repeatable
    #[arg(long = "stream", value_name = "CAMERA/STREAM")]
    streams: Vec<StreamId>,
    /// Put this signal into the state; repeatable [default: all but actions]
    #[arg(long, value_name = "DEVICE/SIGNAL")]
    state: Vec<StreamId>,
    /// Put this signal into the action; repeatable [default: those named action or action_…]
    #[arg(long, value_name = "DEVICE/SIGNAL")]
    action: Vec<StreamId>,
    /// Longest distance of two samples to interpolate between
    #[arg(long, value_name = "TIME", default_value = "0.2s", value_parser = crate::args::duration_s)]
    max_gap: f64,
    /// Handling of longer gaps
    #[arg(long, value_enum, default_value = "refuse", value_name = "HOW")]
    gaps: HowGaps,
}

/// Handling of gaps in signals.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum HowGaps {
    /// Export nothing, and say where they are
    Refuse,
    /// Hold the last value, marked as missing
    Mask,
}

/// Handling of sets that lack a frame.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum HowIncomplete {
    /// Insert a blank image, marked as missing
    Mark,
    /// Leave the set out
    LeaveOut,
}

impl Args {
    /// The options of the exporter, and the common ones.
    pub fn options(&self) -> (RowOptions, &Common) {
        let options = RowOptions {
            task: self.task.clone(),
            fps: self.fps,
            incomplete: match self.incomplete {
                HowIncomplete::Mark => Incomplete::Mark,
                HowIncomplete::LeaveOut => Incomplete::LeaveOut,
            },
            streams: self.streams.clone(),
            signals: VectorOptions {
                state: self.state.clone(),
                action: self.action.clone(),
                max_gap_ns: (self.max_gap * 1e9) as u64,
                gaps: match self.gaps {
                    HowGaps::Refuse => Gaps::Refuse,
                    HowGaps::Mask => Gaps::Mask,
                },
            },
        };
        (options, &self.common)
    }
}
