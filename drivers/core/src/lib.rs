//! The parts of every camera driver: the traits [`Backend`] → [`Device`] → [`Stream`], the gate, the clock map, and
//! the ways to unpack and read images that several families share.
//!
//! Layer 3. A driver knows its device and nothing else: no rig configuration, no channel, no other camera.
//! It hands every frame to a [`Gate`], which keeps the accounts (captured = delivered + Σ dropped), maps the
//! device's clock and asks a [`FrameSink`] for the memory that the pixels are written into, once.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod bytes;
pub mod capture;
pub mod clock;
pub mod controls;
mod device;
mod error;
pub mod file_pattern;
mod gate;
pub mod image_file;
pub mod moments;
pub mod motion;
pub mod playback_clock;
mod sink;
pub mod unpack;

pub use device::{
    Backend, Device, DeviceClock, DeviceInfo, Poll, Stream, StreamProfile, StreamRequest, choose_profiles,
};
pub use error::{Error, ErrorKind, Result};
pub use gate::{Gate, Outcome, RawFrame};
pub use sink::{FrameMeta, FrameSink, Loan, MemorySink};
