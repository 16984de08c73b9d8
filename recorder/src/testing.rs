//! Test doubles for the tests of this crate and of those above.
#![allow(unsafe_code)] // a header is looked at as the bytes that it is

use crate::StreamRecord;
use depthrig_bus::{FrameHeader, Intrinsics, PixelFormat, Pose, StreamId};

/// The bytes of a header.
pub const HEADER_BYTES: usize = size_of::<FrameHeader>();

/// The header as it lies in memory.
pub fn header_bytes(h: &FrameHeader) -> [u8; HEADER_BYTES] {
    // SAFETY: `FrameHeader` is `repr(C)` without padding (asserted in the bus), and any bytes are a valid array.
    unsafe { core::mem::transmute::<FrameHeader, [u8; HEADER_BYTES]>(*h) }
}

/// The header of any bits at all.
pub fn header_of(bytes: [u8; HEADER_BYTES]) -> FrameHeader {
    // SAFETY: every field is a plain number or an array of such, valid for all bits.
    unsafe { core::mem::transmute::<[u8; HEADER_BYTES], FrameHeader>(bytes) }
}

/// A stream of a small camera.
pub fn stream(id: StreamId, model: String, format: PixelFormat) -> StreamRecord {
    StreamRecord {
        id,
        model,
        serial: "1".to_owned(),
        format,
        width: 4,
        height: 4,
        rate_hz: 30.0,
        depth_unit_m: if format.is_depth() { 0.001 } else { 0.0 },
        calibration: String::new(),
        intrinsics: Intrinsics::default(),
        pose: Pose::IDENTITY,
    }
}
