//! Emulated USB cameras, served to this machine's own kernel over USB/IP through a socket pair: `vhci-hcd`, then the
//! real `uvcvideo`, `usbhid` and usbfs take it from there.
//!
//! A [`Camera`] is plugged in from a [`Model`], which is data (`models/*.toml`). It has a serial, calibration numbers
//! that follow from it, a clock of its own, and [`Fault`]s on demand; its [`Accounts`] count what it sent, and the
//! contents of each frame can be queried afterwards.

pub mod accounts;
pub mod calibration;
pub mod camera;
pub mod clock;
pub mod console;
pub mod content;
mod control;
mod descriptors;
mod device;
pub mod fault;
mod firmware;
pub mod model;
mod options;
mod payload;
mod pump;
mod shared;
pub mod usbip;
mod vhci;

pub use accounts::Accounts;
pub use calibration::Calibration;
pub use camera::{Camera, Hub};
pub use content::Stamp;
pub use fault::{Damage, Fault, WrongReply};
pub use firmware::Asked;
pub use firmware::imu::{ImuSample, ImuSensor};
pub use model::Model;
pub use options::{Options, Speed};

/// An error of the emulator itself.
#[derive(Debug)]
pub struct Error(String);

impl Error {
    pub(crate) fn new(text: impl Into<String>) -> Self {
        Self(text.into())
    }
}

impl core::fmt::Display for Error {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(&self.0)
    }
}

impl core::error::Error for Error {}

/// A result with the emulator's [`Error`].
pub type Result<T> = core::result::Result<T, Error>;
