//! The layouts of the hand-shake as data, from which mirrors in other languages are generated and tested.

use super::{ExternalAnswer, ExternalFrame, ExternalMode, ExternalOffer};
use crate::Field;
use core::mem::offset_of;

macro_rules! fields {
    ($of:ty; $($name:literal: $($part:ident).+ => $kind:literal x $count:expr;)*) => {
        &[$(Field { name: $name, offset: offset_of!($of, $($part).+), kind: $kind, count: $count }),*]
    };
}

/// Every field of [`ExternalOffer`] in the order of its bytes, without a gap.
pub const OFFER_FIELDS: &[Field] = fields! { ExternalOffer;
    "magic": magic => "u8" x 4;
    "version": version => "u16" x 1;
    "size": size => "u16" x 1;
    "instance": instance => "u64" x 1;
    "number": number => "u64" x 1;
    "sent_ns": sent_ns => "i64" x 1;
    "session": session => "u64" x 1;
    "state": state => "u32" x 1;
    "reason": reason => "u32" x 1;
    "modes": modes => "u32" x 1;
    "pid": pid => "u32" x 1;
    "model": model => "u8" x 32;
    "serial": serial => "u8" x 32;
    "firmware": firmware => "u8" x 32;
    "port": port => "u8" x 32;
    "calibration": calibration => "u8" x 32;
    "program": program => "u8" x 32;
    "text": text => "u8" x 256;
    "reserved": reserved => "u64" x 8;
};

/// Every field of [`ExternalMode`] in the order of its bytes, without a gap.
pub const MODE_FIELDS: &[Field] = fields! { ExternalMode;
    "stream": stream => "u8" x 32;
    "rate_hz": rate_hz => "f64" x 1;
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
    "tick_ps": tick_ps => "u64" x 1;
    "format": format => "u32" x 1;
    "width": width => "u32" x 1;
    "height": height => "u32" x 1;
    "clock": clock => "u32" x 1;
    "counter_bits": counter_bits => "u32" x 1;
    "sequence_bits": sequence_bits => "u32" x 1;
    "flags": flags => "u32" x 1;
    "reserved_word": reserved_word => "u32" x 1;
    "reserved": reserved => "u64" x 9;
};

/// Every field of [`ExternalAnswer`] in the order of its bytes, without a gap.
pub const ANSWER_FIELDS: &[Field] = fields! { ExternalAnswer;
    "magic": magic => "u8" x 4;
    "version": version => "u16" x 1;
    "size": size => "u16" x 1;
    "instance": instance => "u64" x 1;
    "number": number => "u64" x 1;
    "sent_ns": sent_ns => "i64" x 1;
    "session": session => "u64" x 1;
    "want": want => "u32" x 1;
    "reason": reason => "u32" x 1;
    "modes": modes => "u32" x 1;
    "pid": pid => "u32" x 1;
    "text": text => "u8" x 256;
    "reserved": reserved => "u64" x 8;
};

/// Every field of [`ExternalFrame`] in the order of its bytes, without a gap.
pub const FRAME_FIELDS: &[Field] = fields! { ExternalFrame;
    "magic": magic => "u8" x 4;
    "version": version => "u16" x 1;
    "size": size => "u16" x 1;
    "instance": instance => "u64" x 1;
    "session": session => "u64" x 1;
    "sequence": sequence => "u64" x 1;
    "device_sequence": device_sequence => "u64" x 1;
    "device_time": device_time => "u64" x 1;
    "arrival_time_ns": arrival_time_ns => "i64" x 1;
    "exposure_ns": exposure_ns => "u64" x 1;
    "gain": gain => "f32" x 1;
    "temperature_c": temperature_c => "f32" x 1;
    "format": format => "u32" x 1;
    "width": width => "u32" x 1;
    "height": height => "u32" x 1;
    "payload_len": payload_len => "u32" x 1;
    "flags": flags => "u32" x 1;
    "reserved_word": reserved_word => "u32" x 1;
    "reserved": reserved => "u64" x 4;
};

const fn total(fields: &[Field]) -> usize {
    let mut sum = 0;
    let mut i = 0;
    while i < fields.len() {
        assert!(fields[i].offset == sum, "a gap between two fields");
        sum += fields[i].bytes();
        i += 1;
    }
    sum
}

const _: () = assert!(total(OFFER_FIELDS) == size_of::<ExternalOffer>());
const _: () = assert!(total(MODE_FIELDS) == size_of::<ExternalMode>());
const _: () = assert!(total(ANSWER_FIELDS) == size_of::<ExternalAnswer>());
const _: () = assert!(total(FRAME_FIELDS) == size_of::<ExternalFrame>());
