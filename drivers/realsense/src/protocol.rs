//! Requests to and replies of a RealSense camera as bytes, parsed and built without any I/O.
//!
//! Everything that comes from a device is read with checks: short, damaged and contradictory bytes are errors, never
//! a panic. The replies of the emulator in `tests/vm` are built by the same types.

pub mod advanced;
#[cfg(test)]
mod fake;
pub mod firmware;
pub mod gvd;
pub mod health;
pub mod hwm;
pub mod imu;
pub mod intrinsics;
pub mod l515;
pub mod metadata;
pub mod preset;
pub mod sync;
pub mod tables;

use depthrig_driver::{Error, ErrorKind};

/// An error about bytes that are not what the protocol says they are.
pub(crate) fn protocol_error(text: impl Into<String>) -> Error {
    Error::new(ErrorKind::Protocol, text)
}
