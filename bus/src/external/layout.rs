//! The bytes of the hand-shake with a camera that another process serves. docs/external.md defines the protocol.
//!
//! As in [`crate::FrameHeader`]: a field is never moved or given another meaning within one [`VERSION`], new fields take
//! space from `reserved`, and every field lies at a multiple of its size, so nothing is padded implicitly.

use super::{OFFER_MAGIC, TEXT_BYTES, VERSION};
use crate::{Intrinsics, Pose};
use iceoryx2::prelude::ZeroCopySend;

/// The process's message: the camera that it serves, and its state. Sent with every change and every heartbeat; the
/// payload is [`ExternalOffer::modes`] records of [`ExternalMode`].
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend)]
#[type_name("depthrig.ExternalOffer.v1")]
pub struct ExternalOffer {
    /// The bytes `DREO`.
    pub magic: [u8; 4],
    /// Version of the hand-shake.
    pub version: u16,
    /// Bytes of this header.
    pub size: u16,
    /// A number that every start of the process chooses anew; never 0.
    pub instance: u64,
    /// Number of this message: 1, 2, 3, … A heartbeat is a message with a higher number.
    pub number: u64,
    /// When it was sent, nanoseconds of the host's `CLOCK_MONOTONIC`.
    pub sent_ns: i64,
    /// The session that `state` is about: the last one that the process has taken up; 0 before the first.
    pub session: u64,
    /// State of the process: an `ExternalState` code.
    pub state: u32,
    /// Why it refuses or ends: an `ExternalReason` code; 0 otherwise.
    pub reason: u32,
    /// Records in the payload, 1 to 64. They stay the same for as long as the process runs.
    pub modes: u32,
    /// Process number, for messages.
    pub pid: u32,
    /// Camera model, zero-padded UTF-8.
    pub model: [u8; 32],
    /// Camera serial number, zero-padded UTF-8.
    pub serial: [u8; 32],
    /// Firmware version, zero-padded UTF-8; empty if the camera has none.
    pub firmware: [u8; 32],
    /// Where the camera is attached, such as a USB port path, zero-padded UTF-8; empty if unknown.
    pub port: [u8; 32],
    /// Where the calibration comes from, such as `factory` or `none`, zero-padded UTF-8.
    pub calibration: [u8; 32],
    /// The program that serves the camera, zero-padded UTF-8.
    pub program: [u8; 32],
    /// Why it refuses or ends, in words, zero-padded UTF-8; empty otherwise.
    pub text: [u8; 256],
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 8],
}

/// One mode that a stream can run in: a record in the payload of an offer. The first one of a stream is its default.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("depthrig.ExternalMode.v1")]
pub struct ExternalMode {
    /// Name of the stream, such as `color` or `depth`, zero-padded: 1 to 31 of `a-z`, `0-9` and `_`, a letter first.
    pub stream: [u8; 32],
    /// Frames per second, above 0, at most 1000.
    pub rate_hz: f64,
    /// Metres per unit of `z16` depth; 1 for `depth_f32`, 0 when the pixels are not depth.
    pub depth_unit_m: f64,
    /// Intrinsics of this image at this size; all zero when no calibration is known.
    pub intrinsics: Intrinsics,
    /// Pose of this stream's optical frame in the camera's frame: `p_device = R p_stream + t`.
    pub pose: Pose,
    /// Picoseconds per tick of the device's clock; 1000 when the clock is the host's.
    pub tick_ps: u64,
    /// Pixel format: a `PixelFormat` code.
    pub format: u32,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Which clock stamps the frames: an `ExternalClock` code.
    pub clock: u32,
    /// Bits of the device's clock before it starts again at 0, 8 to 64; 64 when the clock is the host's.
    pub counter_bits: u32,
    /// Bits of the device's frame counter, 8 to 64; 0 when it has none.
    pub sequence_bits: u32,
    /// `ExternalModeFlags` bits.
    pub flags: u32,
    /// Zero.
    pub reserved_word: u32,
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 9],
}

/// The daemon's message to the process. Sent with every change and every heartbeat while the daemon uses the camera;
/// the payload has one byte for each mode of the offer, 1 for a mode to run and 0 otherwise.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend)]
#[type_name("depthrig.ExternalAnswer.v1")]
pub struct ExternalAnswer {
    /// The bytes `DREA`.
    pub magic: [u8; 4],
    /// Version of the hand-shake.
    pub version: u16,
    /// Bytes of this header.
    pub size: u16,
    /// The `instance` of the offer that this answers; a process ignores answers to another one.
    pub instance: u64,
    /// Number of this message, rising.
    pub number: u64,
    /// When it was sent, nanoseconds of the host's `CLOCK_MONOTONIC`.
    pub sent_ns: i64,
    /// Number of the session: a new one, higher than all before it, for every start of the camera. 0 when the offer itself
    /// is refused.
    pub session: u64,
    /// The request: an `ExternalWant` code.
    pub want: u32,
    /// Why the offer or its frames are refused: an `ExternalReason` code; 0 otherwise.
    pub reason: u32,
    /// Bytes of the payload: modes of the offer.
    pub modes: u32,
    /// Process number of the daemon, for messages.
    pub pid: u32,
    /// Why it is refused, in words, zero-padded UTF-8; empty otherwise.
    pub text: [u8; 256],
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 8],
}

/// The header of one frame on its way from the process to the daemon. The payload is its pixels, rows without padding.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("depthrig.ExternalFrame.v1")]
pub struct ExternalFrame {
    /// The bytes `DREF`.
    pub magic: [u8; 4],
    /// Version of the hand-shake.
    pub version: u16,
    /// Bytes of this header.
    pub size: u16,
    /// The `instance` of the process's offer.
    pub instance: u64,
    /// The session of the frame; the daemon ignores frames of another one.
    pub session: u64,
    /// Number of this frame of the stream in the session: 1, 2, 3, … counting every frame that the process received
    /// from the device, including those that it could not send. A gap is counted as `queue_full`.
    pub sequence: u64,
    /// The device's own frame counter, unmodified; ignored when the mode has none. A gap that `sequence` does not
    /// explain is counted as `device_gap`.
    pub device_sequence: u64,
    /// Time of mid-exposure: unmodified ticks of the device's clock, or nanoseconds of `CLOCK_MONOTONIC`, by the mode's
    /// clock.
    pub device_time: u64,
    /// When the process had the last byte, nanoseconds of `CLOCK_MONOTONIC`; 0 if unknown, then the time at which the
    /// daemon read it counts.
    pub arrival_time_ns: i64,
    /// Exposure time, nanoseconds; 0 when unknown.
    pub exposure_ns: u64,
    /// Sensor gain; 0 when unknown.
    pub gain: f32,
    /// Sensor temperature in °C; NaN when unknown.
    pub temperature_c: f32,
    /// Pixel format: a `PixelFormat` code.
    pub format: u32,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes of the payload.
    pub payload_len: u32,
    /// `ExternalFrameFlags` bits.
    pub flags: u32,
    /// Zero.
    pub reserved_word: u32,
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 4],
}

const _: () = assert!(size_of::<ExternalOffer>() == 568 && align_of::<ExternalOffer>() == 8);
const _: () = assert!(size_of::<ExternalMode>() == 320 && align_of::<ExternalMode>() == 8);
const _: () = assert!(size_of::<ExternalAnswer>() == 376 && align_of::<ExternalAnswer>() == 8);
const _: () = assert!(size_of::<ExternalFrame>() == 128 && align_of::<ExternalFrame>() == 8);

impl Default for ExternalOffer {
    fn default() -> Self {
        Self {
            magic: OFFER_MAGIC,
            version: VERSION,
            size: size_of::<Self>() as u16,
            instance: 0,
            number: 0,
            sent_ns: 0,
            session: 0,
            state: 0,
            reason: 0,
            modes: 0,
            pid: 0,
            model: [0; 32],
            serial: [0; 32],
            firmware: [0; 32],
            port: [0; 32],
            calibration: [0; 32],
            program: [0; 32],
            text: [0; TEXT_BYTES],
            reserved: [0; 8],
        }
    }
}

impl Default for ExternalMode {
    fn default() -> Self {
        Self {
            stream: [0; 32],
            rate_hz: 0.0,
            depth_unit_m: 0.0,
            intrinsics: Intrinsics::default(),
            pose: Pose::IDENTITY,
            tick_ps: 1000,
            format: 0,
            width: 0,
            height: 0,
            clock: 0,
            counter_bits: 64,
            sequence_bits: 0,
            flags: 0,
            reserved_word: 0,
            reserved: [0; 9],
        }
    }
}

impl Default for ExternalAnswer {
    fn default() -> Self {
        Self {
            magic: super::ANSWER_MAGIC,
            version: VERSION,
            size: size_of::<Self>() as u16,
            instance: 0,
            number: 0,
            sent_ns: 0,
            session: 0,
            want: 0,
            reason: 0,
            modes: 0,
            pid: 0,
            text: [0; TEXT_BYTES],
            reserved: [0; 8],
        }
    }
}

impl Default for ExternalFrame {
    fn default() -> Self {
        Self {
            magic: super::FRAME_MAGIC,
            version: VERSION,
            size: size_of::<Self>() as u16,
            instance: 0,
            session: 0,
            sequence: 0,
            device_sequence: 0,
            device_time: 0,
            arrival_time_ns: 0,
            exposure_ns: 0,
            gain: 0.0,
            temperature_c: f32::NAN,
            format: 0,
            width: 0,
            height: 0,
            payload_len: 0,
            flags: 0,
            reserved_word: 0,
            reserved: [0; 4],
        }
    }
}
