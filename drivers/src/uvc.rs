//! What the USB Video Class says, without doing I/O: shared by the kernel path and the libusb path.
//!
//! Everything here reads bytes that a device sent, so every read is checked against the length that is really there.

pub mod control;
pub mod descriptors;
pub mod formats;
pub mod payload;
pub mod probe;

/// The 16-bit number at `at`, little-endian; `None` past the end.
fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    let b = bytes.get(at..at.checked_add(2)?)?;
    Some(u16::from_le_bytes(b.try_into().ok()?))
}

/// The 32-bit number at `at`, little-endian; `None` past the end.
fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    let b = bytes.get(at..at.checked_add(4)?)?;
    Some(u32::from_le_bytes(b.try_into().ok()?))
}
