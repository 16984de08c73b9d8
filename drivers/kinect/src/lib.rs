//! The `kinect` backend: Azure Kinect cameras, and playback of their recordings.
//!
//! [`modes`] is what the device can be set to, [`calibration`] what its factory measured, for every mode; [`live`] is a
//! camera that is attached, [`recording`] what was recorded with one, and [`playback`] plays that
//! as a camera.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod calibration;
#[doc(hidden)]
pub mod ebml;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
pub mod live;
pub mod modes;
pub mod motion;
pub mod playback;
pub mod recording;

pub use calibration::Calibration;
pub use modes::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
pub use recording::Recording;

/// The name of the backend, for an attached camera and for a recording.
pub const NAME: &str = "kinect";
