//! Stereolabs ZED 2i as a camera of USB video, without the vendor's SDK.
//!
//! **Streams.** `left` and `right`, YUYV, each one half of the side-by-side image as the camera sends it,
//! *not rectified*; the camera's frame is that of the left camera. Intrinsics and the right camera's pose come from the
//! factory calibration, a file that must exist already: nothing is ever downloaded. Without it the camera
//! streams, its calibration is `none` and its intrinsics are unknown. The IMU, where it can be read, is the stream
//! `imu` ([`imu`]).
//!
//! **Time.** No timestamp of the camera is known, so a frame's time is the kernel's timestamp, taken when the image's
//! first bytes arrived ([`depthrig_bus::ClockDomain::Kernel`]). That is later than the middle of the exposure by half
//! of the exposure and the sensor's readout, which the camera does not report.
//!
//! The formats are documented in [`conf`] (factory calibration), [`command`] (vendor commands) and [`sensors`] (IMU).
//! Source of all three unless stated otherwise: the facts in `zed-open-capture` (stereolabs, BSD-3-Clause).
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod command;
pub mod conf;
mod config;
mod device;
pub mod find;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
pub mod hid;
pub mod imu;
mod ini;
pub mod mode;
pub mod motion;
mod profiles;
pub mod replay;
pub mod sensors;
mod settings;
mod stream;

pub use config::{CalibrationFile, ZedConfig};
pub use device::ZedBackend;
pub use profiles::STREAMS;
pub use stream::ZedStream;
