//! The layout of the header as data, from which mirrors in other languages are generated and tested.

use super::{FrameHeader, StageStep};
use crate::{Intrinsics, Pose};
use core::mem::offset_of;
use serde::Serialize;

/// One field of the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Field {
    /// Its name; fields of the nested structures are written `intrinsics.fx`.
    pub name: &'static str,
    /// Bytes from the start of the header.
    pub offset: usize,
    /// Element type: `u8`, `u16`, `u32`, `u64`, `i64`, `f32` or `f64`.
    pub kind: &'static str,
    /// Elements; 1 for a plain field.
    pub count: usize,
}

/// Bytes of one element of `kind`.
const fn width(kind: &str) -> usize {
    match kind.as_bytes() {
        [_, b'8'] => 1,
        [_, b'1', b'6'] => 2,
        [_, b'3', b'2'] => 4,
        _ => 8,
    }
}

impl Field {
    /// Bytes that the field takes.
    pub const fn bytes(&self) -> usize {
        width(self.kind) * self.count
    }
}

macro_rules! fields {
    ($($name:literal: $($part:ident).+ => $kind:literal x $count:expr;)*) => {
        &[$(Field { name: $name, offset: offset_of!(FrameHeader, $($part).+), kind: $kind, count: $count }),*]
    };
}

/// Every field of [`FrameHeader`] in the order of its bytes, without a gap.
pub const FIELDS: &[Field] = fields! {
    "magic": magic => "u8" x 4;
    "version": version => "u16" x 1;
    "size": size => "u16" x 1;
    "sequence": sequence => "u64" x 1;
    "device_sequence": device_sequence => "u64" x 1;
    "set_id": set_id => "u64" x 1;
    "device_time": device_time => "u64" x 1;
    "device_tick_ns": device_tick_ns => "f64" x 1;
    "capture_time_ns": capture_time_ns => "i64" x 1;
    "capture_uncertainty_ns": capture_uncertainty_ns => "u64" x 1;
    "arrival_time_ns": arrival_time_ns => "i64" x 1;
    "publish_time_ns": publish_time_ns => "i64" x 1;
    "exposure_ns": exposure_ns => "u64" x 1;
    "captured": captured => "u64" x 1;
    "dropped": dropped => "u64" x 8;
    "source_sequence": source_sequence => "u64" x 1;
    "depth_unit_m": depth_unit_m => "f64" x 1;
    "intrinsics.fx": intrinsics.fx => "f64" x 1;
    "intrinsics.fy": intrinsics.fy => "f64" x 1;
    "intrinsics.cx": intrinsics.cx => "f64" x 1;
    "intrinsics.cy": intrinsics.cy => "f64" x 1;
    "intrinsics.coeffs": intrinsics.coeffs => "f64" x 8;
    "intrinsics.model": intrinsics.model => "u32" x 1;
    "intrinsics.reserved": intrinsics.reserved => "u32" x 1;
    "pose.translation_m": pose.translation_m => "f64" x 3;
    "pose.rotation_xyzw": pose.rotation_xyzw => "f64" x 4;
    "clock_domain": clock_domain => "u32" x 1;
    "clock_epoch": clock_epoch => "u32" x 1;
    "flags": flags => "u32" x 1;
    "format": format => "u32" x 1;
    "width": width => "u32" x 1;
    "height": height => "u32" x 1;
    "stride": stride => "u32" x 1;
    "payload_len": payload_len => "u32" x 1;
    "gain": gain => "f32" x 1;
    "temperature_c": temperature_c => "f32" x 1;
    "rig": rig => "u8" x 32;
    "camera": camera => "u8" x 32;
    "stream": stream => "u8" x 32;
    "model": model => "u8" x 32;
    "serial": serial => "u8" x 32;
    "source_color_sequence": source_color_sequence => "u64" x 1;
    "source_color_capture_time_ns": source_color_capture_time_ns => "i64" x 1;
    "stage_ns": stage_ns => "u64" x StageStep::ALL.len();
    "refiner": refiner => "u8" x 32;
    "refiner_model": refiner_model => "u8" x 32;
    "latency_ns": latency_ns => "u64" x 1;
    "reserved": reserved => "u64" x 12;
};

const _: () = assert!(size_of::<Intrinsics>() == 104 && size_of::<Pose>() == 56);
