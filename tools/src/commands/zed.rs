//! `depthrig zed`: what is done with recordings of a ZED's two eyes.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod replay;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/zed-replay.md tells what the modes are, and what they are not: the vendor's algorithms are closed and not here.

Examples:
  depthrig zed replay data/20261121_1015_kitchen --modes performance,ultra,quality --out data/kitchen_depth";

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum ZedCommand {
    /// Make depth of recorded raw stereo, in several modes at once, as a new dataset
    #[command(after_help = replay::EXAMPLES)]
    Replay(replay::ReplayArgs),
}

/// Runs the subcommand.
pub fn run(command: &ZedCommand, context: &Context) -> Result<Exit> {
    match command {
        ZedCommand::Replay(args) => replay::run(args, context),
    }
}
