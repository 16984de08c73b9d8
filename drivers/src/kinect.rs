//! The `kinect` backend: Azure Kinect cameras and what was recorded with them.
//!
//! [`modes`] is what the device can be set to, [`calibration`] what its factory measured, for every mode; [`live`] is a
//! camera that is attached, [`recording`] what was recorded with one, and [`playback`] plays that
//! as a camera.

pub mod calibration;
#[doc(hidden)]
pub mod ebml;
pub mod live;
pub mod modes;
pub mod motion;
pub mod playback;
pub mod recording;

pub use calibration::Calibration;
pub use modes::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
pub use recording::Recording;

/// The name of the back end, of a camera that is attached and of one that was recorded.
pub const NAME: &str = "kinect";

/// Which Kinect a rig means.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant)] // one per camera of a rig
pub enum KinectConfig {
    /// One that is attached.
    Live(live::LiveConfig),
    /// One that was recorded.
    Recorded(playback::PlaybackConfig),
}
