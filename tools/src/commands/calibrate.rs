//! `depthrig calibrate`: boards, and the calibration of cameras and of the mount.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod align;
pub mod board;
pub mod capture;
pub mod check;
pub mod depth;
pub mod hand_eye;
pub mod solve;
pub mod time;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/calibration.md goes from a printed board to a calibrated mount and explains each number.

Exit codes: 0 success, 1 failure, 2 wrong usage or configuration, 3 calibrated, but some views were left out.

Examples:
  depthrig calibrate board --paper a3
  depthrig calibrate capture mount --out views
  depthrig calibrate solve views
  depthrig calibrate solve data/20261125_1015_board --board board.toml
  depthrig calibrate solve --images left=left_images --images right=right_images --board board.toml
  depthrig calibrate check data/20261126_0900 --calibration calibration.toml
  depthrig calibrate time data/20261126_1030_wave -o calibration.toml --overwrite
  depthrig calibrate depth data/20261126_1000_wall --board board.toml --calibration calibration.toml --out with_depth.toml
  depthrig calibrate hand-eye wrist=images --board board.toml --poses poses.csv --calibration calibration.toml
  depthrig calibrate align --camera front --urdf ur5.urdf --joints joints.csv --masks masks --start '1.2 0 0.6 -1.9 0 1.6'";

/// Subcommands of `depthrig calibrate`.
#[derive(Debug, clap::Subcommand)]
pub enum CalibrateCommand {
    /// Draw a board to print, and write its description
    #[command(after_help = board::EXAMPLES)]
    Board(board::BoardArgs),
    /// Take views of the board from the running rig or from a dataset
    #[command(after_help = capture::EXAMPLES)]
    Capture(capture::CaptureArgs),
    /// Calibrate intrinsics and poses from a dataset or from folders of images
    #[command(after_help = solve::EXAMPLES)]
    Solve(solve::SolveArgs),
    /// Check whether a camera has moved since the calibration
    #[command(after_help = check::EXAMPLES)]
    Check(check::CheckArgs),
    /// Measure the error of depth on a wall, and find its correction
    #[command(after_help = depth::EXAMPLES)]
    Depth(depth::DepthArgs),
    /// Find where a camera sits on a robot's hand or beside the robot
    #[command(after_help = hand_eye::EXAMPLES)]
    HandEye(hand_eye::HandEyeArgs),
    /// Find how late each camera's frames are stamped
    #[command(after_help = time::EXAMPLES)]
    Time(time::TimeArgs),
    /// Find where a camera sits beside a robot from masks of its arm
    #[command(after_help = align::EXAMPLES)]
    Align(Box<align::AlignArgs>),
}

/// Runs the subcommand.
pub fn run(command: &CalibrateCommand, context: &Context) -> Result<Exit> {
    match command {
        CalibrateCommand::Board(args) => board::run(args),
        CalibrateCommand::Capture(args) => capture::run(args, context),
        CalibrateCommand::Solve(args) => solve::run(args, context),
        CalibrateCommand::Check(args) => check::run(args, context),
        CalibrateCommand::Depth(args) => depth::run(args, context),
        CalibrateCommand::HandEye(args) => hand_eye::run(args, context),
        CalibrateCommand::Time(args) => time::run(args, context),
        CalibrateCommand::Align(args) => align::run(args),
    }
}
