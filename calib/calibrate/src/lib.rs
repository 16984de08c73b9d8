//! Calibration of cameras and of the mount: from corners of a board to intrinsics and poses, with their uncertainty.
//!
//! Layer 2. Mathematics; no I/O.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod adjustment;
pub mod align;
pub mod board;
mod board_pose;
pub mod capture;
pub mod check;
pub mod depth;
pub mod detect;
pub mod difference;
pub mod file;
pub mod hand_eye;
pub mod homography;
pub mod intrinsics;
pub mod latency;
pub mod mount;
pub mod rig;
mod rigid;
pub mod robust;
pub mod uncertainty;

pub use board_pose::{BoardPose, board_pose};
pub use rigid::{Distance, Rigid};
