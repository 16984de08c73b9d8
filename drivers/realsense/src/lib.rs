//! The `realsense` backend: Intel RealSense D400 cameras, without the vendor's SDK.
//!
//! Layouts and constants: librealsense 2.58 (Apache-2.0), `src/ds` and `src/ds/d400`, unless a line says otherwise.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod account;
mod backend;
mod calibration;
pub mod config;
mod control;
mod device;
mod family;
mod find;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
pub mod iio;
mod imu;
mod kernel;
pub mod l515;
mod launch;
mod libusb;
mod memory;
pub mod models;
mod options;
mod panel;
mod profiles;
pub mod protocol;
mod stream;
pub mod transport;
mod vendor;

pub use backend::RealsenseBackend;
pub use config::RealsenseConfig;
pub use transport::Transport;
pub use vendor::VendorBulk;

/// Name of the backend in rig files.
pub const NAME: &str = "realsense";
