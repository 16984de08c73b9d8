//! What the USB Video Class says, without doing I/O: shared by the kernel path and the libusb path.
//!
//! Everything here reads bytes that a device sent, so every read is checked against the length that is really there.

pub mod control;
pub mod descriptors;
pub mod formats;
#[doc(hidden)]
pub mod fuzzing;
pub mod payload;
pub mod picture;
pub mod probe;
