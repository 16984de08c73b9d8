//! Camera geometry: lens models, poses, and images of one camera in the view of another.
//!
//! Layer 2. Mathematics on the types that travel in a frame header; no I/O. Start at [`Camera`] (maps a point to a
//! pixel and back) and [`Registration`] (depth in the view of colour). [`Deprojection`] makes point clouds,
//! [`Undistortion`] other images of the same view; [`Rectifier`] makes the two images of a stereo camera a pair in
//! which [`stereo`] finds depth.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod camera;
mod cloud;
mod error;
mod pose;
mod rectify;
mod registration;
mod simd;
pub mod stereo;
mod undistort;

pub use camera::{Camera, CameraExt, Projection, Ray};
pub use cloud::{Agreement, Deprojection, DepthView, PointCloud, agreement, write_pcd, write_ply};
pub use error::{Error, ErrorKind, Result};
pub use pose::PoseExt;
pub use rectify::{Rectifier, RowCorrector, View};
pub use registration::{Registration, same_view};
pub use undistort::Undistortion;
