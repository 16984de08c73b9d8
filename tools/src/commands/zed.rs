//! `depthrig zed`: processes recordings of a ZED's left and right images.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod replay;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/zed-replay.md describes the modes. They are not the vendor's algorithms, which are closed source.

Examples:
  depthrig zed replay data/20261121_1015_kitchen --modes performance,ultra,quality --out data/kitchen_depth";

/// Subcommands of `depthrig zed`.
#[derive(Debug, clap::Subcommand)]
pub enum ZedCommand {
    /// Recompute depth from raw stereo in several modes, as a new dataset
    #[command(after_help = replay::EXAMPLES)]
    Replay(replay::ReplayArgs),
}

/// Runs the subcommand.
pub fn run(command: &ZedCommand, context: &Context) -> Result<Exit> {
    match command {
        ZedCommand::Replay(args) => replay::run(args, context),
    }
}
