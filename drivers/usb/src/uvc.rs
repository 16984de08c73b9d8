//! The USB Video Class without I/O: shared by the kernel path and the libusb path.
//!
//! Everything here reads bytes that a device sent, so every read is checked against the length that is really there.

pub mod control;
pub mod descriptors;
pub mod formats;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
pub mod image_controls;
pub mod payload;
pub mod probe;
