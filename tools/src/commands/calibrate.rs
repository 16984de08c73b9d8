//! `depthrig calibrate`: boards, and the calibration of cameras and of the mount.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod board;
pub mod check;
pub mod hand_eye;
pub mod solve;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/calibration.md goes from a printed board to a calibrated mount and explains each number.

Exit codes: 0 success, 1 failure, 2 wrong usage or configuration, 3 calibrated, but some views were left out.

Examples:
  depthrig calibrate board --paper a3
  depthrig calibrate solve data/20261125_1015_board --board board.toml
  depthrig calibrate solve --images left=left_images --images right=right_images --board board.toml
  depthrig calibrate check data/20261126_0900 --calibration calibration.toml
  depthrig calibrate hand-eye wrist=images --board board.toml --poses poses.csv --calibration calibration.toml";

/// Subcommands of `depthrig calibrate`.
#[derive(Debug, clap::Subcommand)]
pub enum CalibrateCommand {
    /// Draw a board to print, and write its description
    #[command(after_help = board::EXAMPLES)]
    Board(board::BoardArgs),
    /// Calibrate intrinsics and poses from a dataset or from folders of images
    #[command(after_help = solve::EXAMPLES)]
    Solve(solve::SolveArgs),
    /// Check whether a camera has moved since the calibration
    #[command(after_help = check::EXAMPLES)]
    Check(check::CheckArgs),
    /// Find where a camera sits on a robot's hand or beside the robot
    #[command(after_help = hand_eye::EXAMPLES)]
    HandEye(hand_eye::HandEyeArgs),
}

/// Runs the subcommand.
pub fn run(command: &CalibrateCommand, context: &Context) -> Result<Exit> {
    match command {
        CalibrateCommand::Board(args) => board::run(args),
        CalibrateCommand::Solve(args) => solve::run(args, context),
        CalibrateCommand::Check(args) => check::run(args, context),
        CalibrateCommand::HandEye(args) => hand_eye::run(args, context),
    }
}
