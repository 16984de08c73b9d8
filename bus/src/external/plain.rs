//! Mode records as bytes and back: the payload of an offer is bytes, so that each record is checked before it is used.
#![allow(unsafe_code)] // two transmutes between a record and its bytes

use super::{ExternalMode, MODE_BYTES};

/// The bytes of a record.
pub fn bytes_of(mode: &ExternalMode) -> [u8; MODE_BYTES] {
    // SAFETY: the type is `#[repr(C)]` and its fields cover every byte (checked at compile time in `fields`), so no byte
    // is uninitialised padding; the sizes are equal or this would not compile.
    unsafe { core::mem::transmute::<ExternalMode, [u8; MODE_BYTES]>(*mode) }
}

/// The record of these bytes, whatever they are.
pub fn mode_of(bytes: &[u8; MODE_BYTES]) -> ExternalMode {
    // SAFETY: all fields are integers, floats and arrays of them, for which every bit pattern is a value.
    unsafe { core::mem::transmute::<[u8; MODE_BYTES], ExternalMode>(*bytes) }
}
