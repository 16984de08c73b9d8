//! Camera geometry: poses and camera models.
//!
//! Floor 2. Pure mathematics on the types that travel in a frame header.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod camera;
mod pose;

pub use camera::CameraExt;
pub use pose::PoseExt;
