//! The `kinect` backend: Azure Kinect cameras and what was recorded with them.
//!
//! [`modes`] is what the device can be set to, [`calibration`] what its factory measured, for every mode.

pub mod calibration;
#[doc(hidden)]
pub mod ebml;
pub mod modes;

pub use calibration::Calibration;
pub use modes::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
