//! Streams from modes, and modes from streams.
#![allow(clippy::trivially_copy_pass_by_ref)] // b"Z16 " reads better than *b"Z16 "

use super::*;
use crate::models;

fn modes(sensor: Sensor, fourcc: &[u8; 4], sizes: &[(u32, u32)], rates: &[f64]) -> Vec<Mode> {
    let mode = |(width, height), rate_hz| Mode { sensor, fourcc: *fourcc, width, height, rate_hz };
    sizes.iter().flat_map(|s| rates.iter().map(|r| mode(*s, *r))).collect()
}

/// The modes of a D435 that matter here, in an order as descriptors have it.
fn d435() -> Vec<Mode> {
    let sizes = [(424, 240), (640, 480), (848, 480), (1280, 720)];
    [
        modes(Sensor::Depth, b"Z16 ", &sizes, &[90.0, 30.0, 15.0, 6.0]),
        modes(Sensor::Infrared, b"GREY", &sizes, &[30.0, 15.0, 6.0]),
        modes(Sensor::Infrared, b"Y8I ", &sizes, &[30.0, 15.0, 6.0]),
        modes(Sensor::Infrared, b"Y12I", &[(1280, 800)], &[25.0, 15.0]),
        modes(Sensor::Color, b"YUYV", &[(1920, 1080), (1280, 720), (640, 480)], &[30.0, 15.0, 6.0]),
    ]
    .concat()
}

fn offer(modes: &[Mode]) -> Vec<StreamProfile> {
    let model = models::of_product(0x0B07).unwrap();
    offered(&Basis { model, modes, calibration: None, depth_unit_m: 0.001 }).unwrap()
}

fn request(stream: &str, size: Option<(u32, u32)>) -> StreamRequest {
    StreamRequest { size, ..StreamRequest::any(Name::new(stream).unwrap()) }
}

fn planned(requests: &[StreamRequest]) -> Result<(Vec<String>, Plan)> {
    let modes = d435();
    let describe = |p: &StreamProfile| p.describe();
    let (chosen, plan) = plan("D435 1", &offer(&modes), &modes, requests)?;
    Ok((chosen.iter().map(describe).collect(), plan))
}

#[test]
fn without_wishes_depth_and_colour_are_started_at_15_hz() {
    let (chosen, plan) = planned(&[]).unwrap();
    assert_eq!(chosen, ["depth 848x480 z16 15 Hz", "color 1280x720 yuyv 15 Hz"]);
    assert_eq!(plan.streams, [(0, Unpack::Copy), (1, Unpack::Copy)]);
}

#[test]
fn on_usb_2_the_largest_common_size_is_the_default() {
    let modes = [
        modes(Sensor::Depth, b"Z16 ", &[(1280, 720)], &[6.0]),
        modes(Sensor::Depth, b"Z16 ", &[(424, 240), (640, 480)], &[30.0, 15.0]),
        modes(Sensor::Color, b"YUYV", &[(320, 240), (640, 480)], &[30.0, 15.0]),
    ]
    .concat();
    let (chosen, _) = plan("D435 1", &offer(&modes), &modes, &[]).unwrap();
    let described: Vec<_> = chosen.iter().map(StreamProfile::describe).collect();
    assert_eq!(described, ["depth 640x480 z16 15 Hz", "color 640x480 yuyv 15 Hz"]);
}

#[test]
fn the_left_imager_alone_is_grey_and_both_come_interleaved() {
    let (chosen, plan) = planned(&[request("ir_left", None)]).unwrap();
    assert_eq!(chosen, ["ir_left 848x480 mono8 15 Hz"]);
    assert_eq!((&plan.modes[0].fourcc, plan.streams.as_slice()), (b"GREY", &[(0, Unpack::Copy)][..]));
    let (chosen, plan) = planned(&[request("ir_right", None), request("ir_left", None)]).unwrap();
    assert_eq!(chosen.len(), 2);
    assert_eq!((plan.modes.len(), &plan.modes[0].fourcc), (1, b"Y8I "));
    assert_eq!(plan.streams, [(0, Unpack::Right), (0, Unpack::Left)]);
}

#[test]
fn infrared_follows_depth() {
    let (chosen, _) = planned(&[request("depth", Some((640, 480))), request("ir_left", None)]).unwrap();
    assert_eq!(chosen, ["depth 640x480 z16 15 Hz", "ir_left 640x480 mono8 15 Hz"]);
    let e = planned(&[request("depth", Some((640, 480))), request("ir_left", Some((848, 480)))]).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Unsupported);
    assert!(e.to_string().contains("the same imagers"), "{e}");
    let e = planned(&[request("ir_right", Some((640, 480))), request("ir_left", Some((848, 480)))]);
    assert!(e.unwrap_err().to_string().contains("two halves of one image"));
}

#[test]
fn what_is_only_for_calibration_is_not_offered() {
    let all = offer(&d435());
    assert!(all.iter().all(|p| (p.width, p.height) != (1280, 800)));
    let e = planned(&[request("ir_left", Some((1280, 800)))]).unwrap_err();
    assert!(e.to_string().contains("ir_left 848x480 mono8 15, 30, 6 Hz"), "it names what there is: {e}");
}

#[test]
fn only_depth_has_a_depth_unit() {
    for p in offer(&d435()) {
        assert_eq!(p.depth_unit_m > 0.0, p.stream.as_str() == "depth", "{}", p.describe());
    }
}

#[test]
fn the_granted_metadata_decides_clock_and_numbers() {
    let modes = d435();
    let granted_with = |headers: [HeaderPart; 2]| {
        let (mut chosen, plan) = plan("D435 1", &offer(&modes), &modes, &[]).unwrap();
        let sources = granted(&mut chosen, &plan, &headers);
        assert_eq!(sources.len(), 2);
        assert_eq!(sources[0].wire_bytes, 848 * 480 * 2);
        chosen.iter().map(|p| (p.metadata, p.clock.domain, p.sequence_bits)).collect::<Vec<_>>()
    };
    let full = (MetadataLevel::Full, ClockDomain::Device, 32);
    let header = (MetadataLevel::Header, ClockDomain::Device, 64);
    let none = (MetadataLevel::Kernel, ClockDomain::Kernel, 64);
    assert_eq!(granted_with([HeaderPart::Whole, HeaderPart::Standard]), [full, header]);
    assert_eq!(granted_with([HeaderPart::Nothing, HeaderPart::Whole]), [none, full]);
}
