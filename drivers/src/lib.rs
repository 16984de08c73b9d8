//! Camera drivers: one folder per camera family behind the [`Backend`] → [`Device`] → [`Stream`] traits.
//!
//! Layer 3. A driver knows its device and nothing else: no rig configuration, no channel, no other camera.
//! It hands every frame to a [`Gate`], which keeps the accounts (captured = delivered + Σ dropped), maps the
//! device's clock and asks a [`FrameSink`] for the memory that the pixels are written into, once.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod bytes;
pub mod capture;
pub mod clock;
#[doc(hidden)]
pub mod conformance;
mod device;
mod error;
pub mod external;
pub mod files;
#[doc(hidden)]
pub mod fuzzing;
mod gate;
pub mod iio;
pub mod kinect;
pub mod libusb;
pub mod moments;
pub mod motion;
mod playback_clock;
pub mod realsense;
mod sink;
pub mod stereo;
pub mod synthetic;
pub mod unpack;
pub mod usb;
pub mod uvc;
pub mod v4l2;
pub mod video;
pub mod zed;

pub use device::{
    Backend, Device, DeviceClock, DeviceInfo, Poll, Stream, StreamProfile, StreamRequest, choose_profiles,
};
pub use error::{Error, ErrorKind, Result};
pub use gate::{Gate, Outcome, RawFrame};
pub use sink::{FrameMeta, FrameSink, Loan, MemorySink};
