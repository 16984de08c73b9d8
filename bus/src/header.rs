//! The frame header: a fixed, versioned, self-sufficient description of a frame in shared memory.
//!
//! The layout is the contract with every other process. A field is never moved or given another meaning
//! within one [`HEADER_VERSION`]; new fields take space from `reserved`. Every field lies at a multiple of
//! its size, so nothing is padded implicitly, and [`FIELDS`] lists them for mirrors in other languages.

use crate::text;
use crate::{DropCounts, Intrinsics, PixelFormat, Pose, StreamId};
use core::fmt;
use iceoryx2::prelude::ZeroCopySend;

mod fields;
pub use fields::{FIELDS, Field};

/// The version of the layout; a subscriber of another version is refused when it opens the channel.
pub const HEADER_VERSION: u16 = 1;
/// The value of the channel attribute `schema`, checked on open.
pub const SCHEMA: &str = "depthrig.frame/1";
/// Bytes of a [`FrameHeader`].
pub const HEADER_SIZE: usize = 768;
/// Pixels begin at a multiple of this many bytes in every slot: a cache line, and the widest vector of a processor.
///
/// The header is aligned to it and as long as 12 of it, and bytes follow their header at once; iceoryx2 then also begins
/// every slot at a multiple of it.
pub const PIXEL_ALIGN: usize = 64;
const MAGIC: [u8; 4] = *b"DRFH";

/// The header of one frame.
///
/// Times are nanoseconds on the host's `CLOCK_MONOTONIC` (see [`crate::clock`]). A replayed frame keeps the
/// times of its recording and carries [`FrameFlags::REPLAYED`].
///
/// Its alignment is that of the pixels behind it, [`PIXEL_ALIGN`].
#[repr(C)]
#[repr(align(64))] // a line of its own: iceoryx2's derive looks for a plain `C`
#[derive(Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("depthrig.FrameHeader.v1")]
pub struct FrameHeader {
    /// The bytes `DRFH`.
    pub magic: [u8; 4],
    /// [`HEADER_VERSION`].
    pub version: u16,
    /// [`HEADER_SIZE`].
    pub size: u16,
    /// Number of this frame on its channel: 1, 2, 3, … without a gap as published. A subscriber that sees a
    /// gap was too slow.
    pub sequence: u64,
    /// The device's own frame counter, unwrapped.
    pub device_sequence: u64,
    /// The frame set this frame belongs to; 0 on the live path, where sets are assembled after publishing.
    pub set_id: u64,
    /// Raw device time in ticks, unwrapped to 64 bits.
    pub device_time: u64,
    /// Nanoseconds per device tick.
    pub device_tick_ns: f64,
    /// Middle of the exposure on the host clock.
    pub capture_time_ns: i64,
    /// The capture time is right within this much, nanoseconds.
    pub capture_uncertainty_ns: u64,
    /// When the last byte of the frame had arrived.
    pub arrival_time_ns: i64,
    /// When the frame was published on this channel.
    pub publish_time_ns: i64,
    /// Exposure time, nanoseconds; 0 when unknown.
    pub exposure_ns: u64,
    /// Frames the device has captured on this stream so far, this one included:
    /// `captured = sequence + Σ dropped`.
    pub captured: u64,
    /// Frames lost so far, indexed by [`crate::DropReason`].
    pub dropped: [u64; 8],
    /// For a derived stream, `sequence` of its source frame (the depth frame where there are several);
    /// else 0.
    pub source_sequence: u64,
    /// Metres per unit of depth; 0 when the pixels are not depth.
    pub depth_unit_m: f64,
    /// Intrinsics of this image at this size.
    pub intrinsics: Intrinsics,
    /// Pose of this stream's optical frame on the mount: `p_mount = R p_camera + t`.
    pub pose: Pose,
    /// Which clock the capture time comes from: a [`ClockDomain`] code.
    pub clock_domain: u32,
    /// Number of the clock map in force; it changes whenever the map is restarted.
    pub clock_epoch: u32,
    /// [`FrameFlags`] bits.
    pub flags: u32,
    /// [`PixelFormat`] code.
    pub format: u32,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// Bytes of the payload.
    pub payload_len: u32,
    /// Sensor gain as the device reports it; 0 when unknown.
    pub gain: f32,
    /// Sensor temperature in °C; NaN when unknown.
    pub temperature_c: f32,
    /// Name of the rig, zero-padded UTF-8.
    pub rig: [u8; 32],
    /// Name of the camera, zero-padded UTF-8.
    pub camera: [u8; 32],
    /// Name of the stream, zero-padded UTF-8.
    pub stream: [u8; 32],
    /// Camera model, zero-padded UTF-8.
    pub model: [u8; 32],
    /// Camera serial number, zero-padded UTF-8.
    pub serial: [u8; 32],
    /// For depth computed from depth and colour, `sequence` of the colour frame; else 0.
    pub source_color_sequence: u64,
    /// Middle of the exposure of that colour frame on the host clock; else 0. `capture_time_ns` is that of the depth
    /// frame.
    pub source_color_capture_time_ns: i64,
    /// Duration of each step of computing a derived frame, nanoseconds, indexed by [`StageStep`]; else 0.
    pub stage_ns: [u64; StageStep::ALL.len()],
    /// Method that computed a derived frame, such as `fill` or `onnxruntime 1.31.1 cpu fp32`, zero-padded UTF-8.
    pub refiner: [u8; 32],
    /// The model that it used, such as `cdm-d435@1f2e3d4c`, zero-padded UTF-8; empty when it needs none.
    pub refiner_model: [u8; 32],
    /// Constant latency of the delivery that `capture_time_ns` is free of, nanoseconds; 0 when none is known. How it is known is in
    /// the flags [`FrameFlags::LATENCY_MEASURED`] and [`FrameFlags::LATENCY_CALIBRATED`].
    pub latency_ns: u64,
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 12],
}

const _: () = assert!(size_of::<FrameHeader>() == HEADER_SIZE, "the header's size is part of the contract");
const _: () = assert!(align_of::<FrameHeader>() == PIXEL_ALIGN && HEADER_SIZE.is_multiple_of(PIXEL_ALIGN));

impl Default for FrameHeader {
    fn default() -> Self {
        Self {
            magic: MAGIC,
            version: HEADER_VERSION,
            size: HEADER_SIZE as u16,
            sequence: 0,
            device_sequence: 0,
            set_id: 0,
            device_time: 0,
            device_tick_ns: 1.0,
            capture_time_ns: 0,
            capture_uncertainty_ns: 0,
            arrival_time_ns: 0,
            publish_time_ns: 0,
            exposure_ns: 0,
            captured: 0,
            dropped: [0; 8],
            source_sequence: 0,
            depth_unit_m: 0.0,
            intrinsics: Intrinsics::default(),
            pose: Pose::IDENTITY,
            clock_domain: ClockDomain::Arrival as u32,
            clock_epoch: 0,
            flags: 0,
            format: 0,
            width: 0,
            height: 0,
            stride: 0,
            payload_len: 0,
            gain: 0.0,
            temperature_c: f32::NAN,
            rig: [0; 32],
            camera: [0; 32],
            stream: [0; 32],
            model: [0; 32],
            serial: [0; 32],
            source_color_sequence: 0,
            source_color_capture_time_ns: 0,
            stage_ns: [0; StageStep::ALL.len()],
            refiner: [0; 32],
            refiner_model: [0; 32],
            latency_ns: 0,
            reserved: [0; 12],
        }
    }
}

impl FrameHeader {
    /// Whether this is a header of the version that this build speaks.
    pub fn is_valid(&self) -> bool {
        self.magic == MAGIC && self.version == HEADER_VERSION && self.size as usize == HEADER_SIZE
    }

    /// The header of these bytes, whatever they are: [`Self::is_valid`] says whether they are one.
    #[allow(unsafe_code)]
    pub const fn from_bytes(bytes: &[u8; HEADER_SIZE]) -> Self {
        // SAFETY: all fields are integers, floats and arrays of them, for which every bit pattern is a value; the sizes are equal or this
        // would not compile.
        unsafe { core::mem::transmute::<[u8; HEADER_SIZE], Self>(*bytes) }
    }

    /// The bytes of the header, as they lie in shared memory.
    #[allow(unsafe_code)]
    pub const fn to_bytes(&self) -> [u8; HEADER_SIZE] {
        // SAFETY: the type is `#[repr(C)]` and its fields cover every byte ([`FIELDS`] has no gap, which a test holds), so no byte is
        // uninitialised padding; the sizes are equal or this would not compile.
        unsafe { core::mem::transmute::<Self, [u8; HEADER_SIZE]>(*self) }
    }

    /// The pixel format, if this version knows it.
    pub fn pixel_format(&self) -> Option<PixelFormat> {
        PixelFormat::from_code(self.format)
    }

    /// Sets format, size, a stride without padding, and the payload length of such an image.
    pub fn set_image(&mut self, format: PixelFormat, width: u32, height: u32) {
        self.format = format as u32;
        (self.width, self.height) = (width, height);
        self.stride = format.row_bytes(width);
        self.payload_len = format.frame_bytes(width, height) as u32;
    }

    /// Frames lost so far, by reason.
    pub const fn drops(&self) -> DropCounts {
        DropCounts(self.dropped)
    }

    /// Whether all bits of `flag` are set.
    pub const fn has(&self, flag: FrameFlags) -> bool {
        self.flags & flag.0 == flag.0
    }

    /// The stream this frame is of, if the names are valid ones.
    pub fn stream_id(&self) -> Option<StreamId> {
        StreamId::new(text::valid_part(&self.camera), text::valid_part(&self.stream)).ok()
    }

    /// Writes the names of rig and stream.
    pub fn set_names(&mut self, rig: &str, id: &StreamId) {
        text::set(&mut self.rig, rig);
        text::set(&mut self.camera, id.camera.as_str());
        text::set(&mut self.stream, id.stream.as_str());
    }

    /// Writes model and serial number; what does not fit in 31 bytes is cut at a character boundary.
    pub fn set_device(&mut self, model: &str, serial: &str) {
        text::set(&mut self.model, model);
        text::set(&mut self.serial, serial);
    }

    /// Writes the method and the model of a derived frame; each is cut to 31 bytes at a character boundary.
    pub fn set_refiner(&mut self, refiner: &str, model: &str) {
        text::set(&mut self.refiner, refiner);
        text::set(&mut self.refiner_model, model);
    }

    /// Names the stream alone.
    pub fn set_stream(&mut self, stream: &crate::StreamName) {
        text::set(&mut self.stream, stream.as_str());
    }

    /// Method that computed this frame, such as `fill`; empty when it was captured.
    pub fn refiner(&self) -> &str {
        text::valid_part(&self.refiner)
    }

    /// The model that it used; empty when it needs none.
    pub fn refiner_model(&self) -> &str {
        text::valid_part(&self.refiner_model)
    }

    /// Duration of `step` of computing this frame, nanoseconds.
    pub const fn step_ns(&self, step: StageStep) -> u64 {
        self.stage_ns[step as usize]
    }

    /// The rig's name.
    pub fn rig(&self) -> &str {
        text::valid_part(&self.rig)
    }

    /// The camera's name.
    pub fn camera(&self) -> &str {
        text::valid_part(&self.camera)
    }

    /// The stream's name.
    pub fn stream(&self) -> &str {
        text::valid_part(&self.stream)
    }

    /// The camera's model.
    pub fn model(&self) -> &str {
        text::valid_part(&self.model)
    }

    /// The camera's serial number.
    pub fn serial(&self) -> &str {
        text::valid_part(&self.serial)
    }
}

impl fmt::Debug for FrameHeader {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "FrameHeader({}/{} #{} {}x{} {} capture {} ns ±{} flags {:#x})",
            self.camera(),
            self.stream(),
            self.sequence,
            self.width,
            self.height,
            self.pixel_format().map_or("?", PixelFormat::name),
            self.capture_time_ns,
            self.capture_uncertainty_ns,
            self.flags
        )
    }
}

/// Facts about a frame, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct FrameFlags(pub u32);

impl FrameFlags {
    /// Published by a replay; the times are those of the recording.
    pub const REPLAYED: Self = Self(1);
    /// The capture time may be wrong by more than its uncertainty: a clock restart is being decided, or the device was
    /// asked for its clock and has not answered yet.
    pub const TIME_UNCERTAIN: Self = Self(1 << 1);
    /// The clock map has less than 5 s of history.
    pub const CLOCK_WARMUP: Self = Self(1 << 2);
    /// First frame of a new clock epoch.
    pub const EPOCH_CHANGED: Self = Self(1 << 3);
    /// Computed from other frames, not captured.
    pub const DERIVED: Self = Self(1 << 4);
    /// Captured on a hardware trigger.
    pub const HARDWARE_TRIGGERED: Self = Self(1 << 5);
    /// Arrived more than two frame periods after its capture.
    pub const LATE: Self = Self(1 << 6);
    /// Generated by a simulated camera.
    pub const SYNTHETIC: Self = Self(1 << 7);
    /// The device time is that of the transport's header, which is later than mid-exposure.
    pub const HEADER_TIME: Self = Self(1 << 8);
    /// The metadata of this frame alone did not come: its device time is reckoned from when it arrived.
    pub const METADATA_LOST: Self = Self(1 << 9);
    /// `latency_ns` was measured by asking the device for its clock: the capture time is free of the delivery's latency.
    pub const LATENCY_MEASURED: Self = Self(1 << 10);
    /// `latency_ns` comes from a calibration of the mount: the capture time is comparable with those of its other cameras.
    pub const LATENCY_CALIBRATED: Self = Self(1 << 11);

    /// Every flag with its name.
    pub const ALL: [(&'static str, Self); 12] = [
        ("replayed", Self::REPLAYED),
        ("time_uncertain", Self::TIME_UNCERTAIN),
        ("clock_warmup", Self::CLOCK_WARMUP),
        ("epoch_changed", Self::EPOCH_CHANGED),
        ("derived", Self::DERIVED),
        ("hardware_triggered", Self::HARDWARE_TRIGGERED),
        ("late", Self::LATE),
        ("synthetic", Self::SYNTHETIC),
        ("header_time", Self::HEADER_TIME),
        ("metadata_lost", Self::METADATA_LOST),
        ("latency_measured", Self::LATENCY_MEASURED),
        ("latency_calibrated", Self::LATENCY_CALIBRATED),
    ];

    /// Whether all bits of `flag` are set.
    pub const fn has(self, flag: Self) -> bool {
        self.0 & flag.0 == flag.0
    }

    /// Both sets of flags together.
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

/// A step of computing a derived frame. The discriminant is the index into `FrameHeader::stage_ns`; it is part of the
/// wire format and never changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
#[non_exhaustive]
pub enum StageStep {
    /// From when both frames were there until work on them began.
    Wait = 0,
    /// Registration of depth to the colour image.
    Register = 1,
    /// Preparation of the engine's input from the images.
    Prepare = 2,
    /// Inference.
    Infer = 3,
    /// From the engine's output to the pixels of this frame.
    Finish = 4,
    /// All of it, from when both frames were there until this one was published.
    Total = 5,
}

impl StageStep {
    /// Every step, in wire order.
    pub const ALL: [Self; 6] =
        [Self::Wait, Self::Register, Self::Prepare, Self::Infer, Self::Finish, Self::Total];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Wait => "wait",
            Self::Register => "register",
            Self::Prepare => "prepare",
            Self::Infer => "infer",
            Self::Finish => "finish",
            Self::Total => "total",
        }
    }
}

/// Where a capture time comes from. The discriminant is part of the wire format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u32)]
#[non_exhaustive]
pub enum ClockDomain {
    /// The host's clock when the bytes arrived: late by the transport's latency.
    Arrival = 0,
    /// The device's clock, mapped to the host's.
    Device = 1,
    /// A stamp that the kernel took.
    Kernel = 2,
}

#[cfg(test)]
mod tests;
