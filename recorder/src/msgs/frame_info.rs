//! `depthrig_msgs/msg/FrameInfo`: the whole header of a frame, so that a replay restores it bit by bit.
//!
//! CDR aligns a primitive to its size and so does the header, therefore the first 768 bytes of the message
//! are the header's bytes; fields are still written one by one, which needs no unsafe code.

use crate::Result;
use crate::cdr::{Reader, Writer};
use depthrig_bus::{FrameHeader, Intrinsics, Pose};

/// Fields of a message beside the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Extra<'a> {
    pub(crate) stamp_utc_ns: i64,
    pub(crate) frame_id: &'a str,
    pub(crate) codec: &'a str,
}

pub(crate) fn write(buf: &mut Vec<u8>, h: &FrameHeader, extra: &Extra<'_>) {
    let mut w = Writer::new(buf);
    w.raw(&h.magic).u16(h.version).u16(h.size);
    w.u64(h.sequence).u64(h.device_sequence).u64(h.set_id).u64(h.device_time).f64(h.device_tick_ns);
    w.i64(h.capture_time_ns).u64(h.capture_uncertainty_ns).i64(h.arrival_time_ns).i64(h.publish_time_ns);
    w.u64(h.exposure_ns).u64(h.captured).u64s(&h.dropped).u64(h.source_sequence).f64(h.depth_unit_m);
    let i = &h.intrinsics;
    w.f64(i.fx).f64(i.fy).f64(i.cx).f64(i.cy).f64s(&i.coeffs).u32(i.model).u32(i.reserved);
    w.f64s(&h.pose.translation_m).f64s(&h.pose.rotation_xyzw);
    w.u32(h.clock_domain).u32(h.clock_epoch).u32(h.flags).u32(h.format);
    w.u32(h.width).u32(h.height).u32(h.stride).u32(h.payload_len);
    w.f32(h.gain).f32(h.temperature_c);
    w.raw(&h.rig).raw(&h.camera).raw(&h.stream).raw(&h.model).raw(&h.serial);
    w.u64(h.source_color_sequence).i64(h.source_color_capture_time_ns).u64s(&h.stage_ns);
    w.raw(&h.refiner).raw(&h.refiner_model).u64(h.latency_ns).u64s(&h.reserved);
    w.time(extra.stamp_utc_ns).str(extra.frame_id).str(extra.codec);
}

pub(crate) fn read(message: &[u8]) -> Result<(FrameHeader, Extra<'_>)> {
    let mut r = Reader::new(message)?;
    // Fields in the order of the bytes: a struct literal is evaluated from top to bottom.
    let header = FrameHeader {
        magic: r.array(Reader::u8)?,
        version: r.u16()?,
        size: r.u16()?,
        sequence: r.u64()?,
        device_sequence: r.u64()?,
        set_id: r.u64()?,
        device_time: r.u64()?,
        device_tick_ns: r.f64()?,
        capture_time_ns: r.i64()?,
        capture_uncertainty_ns: r.u64()?,
        arrival_time_ns: r.i64()?,
        publish_time_ns: r.i64()?,
        exposure_ns: r.u64()?,
        captured: r.u64()?,
        dropped: r.array(Reader::u64)?,
        source_sequence: r.u64()?,
        depth_unit_m: r.f64()?,
        intrinsics: Intrinsics {
            fx: r.f64()?,
            fy: r.f64()?,
            cx: r.f64()?,
            cy: r.f64()?,
            coeffs: r.array(Reader::f64)?,
            model: r.u32()?,
            reserved: r.u32()?,
        },
        pose: Pose { translation_m: r.array(Reader::f64)?, rotation_xyzw: r.array(Reader::f64)? },
        clock_domain: r.u32()?,
        clock_epoch: r.u32()?,
        flags: r.u32()?,
        format: r.u32()?,
        width: r.u32()?,
        height: r.u32()?,
        stride: r.u32()?,
        payload_len: r.u32()?,
        gain: r.f32()?,
        temperature_c: r.f32()?,
        rig: r.array(Reader::u8)?,
        camera: r.array(Reader::u8)?,
        stream: r.array(Reader::u8)?,
        model: r.array(Reader::u8)?,
        serial: r.array(Reader::u8)?,
        source_color_sequence: r.u64()?,
        source_color_capture_time_ns: r.i64()?,
        stage_ns: r.array(Reader::u64)?,
        refiner: r.array(Reader::u8)?,
        refiner_model: r.array(Reader::u8)?,
        latency_ns: r.u64()?,
        reserved: r.array(Reader::u64)?,
    };
    let extra = Extra { stamp_utc_ns: r.time()?, frame_id: r.str()?, codec: r.str()? };
    Ok((header, extra))
}

#[cfg(test)]
#[allow(unsafe_code)]
pub(crate) mod tests {
    use super::*;
    use depthrig_bus::HEADER_SIZE;
    use proptest::prelude::*;

    pub(crate) use crate::testing::header_bytes as memory;

    /// A header of any bits at all.
    pub(crate) fn any_header() -> impl Strategy<Value = FrameHeader> {
        proptest::collection::vec(any::<u8>(), HEADER_SIZE)
            .prop_map(|bytes| crate::testing::header_of(bytes.try_into().unwrap()))
    }

    proptest! {
        #[test]
        fn the_message_begins_with_the_bytes_of_the_header(h in any_header(), stamp in 0..i64::from(i32::MAX)) {
            let mut buf = Vec::new();
            let extra = Extra { stamp_utc_ns: stamp * 1_000_000_000 + 7, frame_id: "a_depth", codec: "raw" };
            write(&mut buf, &h, &extra);
            prop_assert_eq!(&buf[4..4 + HEADER_SIZE], &memory(&h)[..]);
            let (back, extra_back) = read(&buf).unwrap();
            prop_assert_eq!(memory(&back), memory(&h));
            prop_assert_eq!(extra_back, extra);
        }
    }
}
