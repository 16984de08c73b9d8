#![allow(clippy::trivially_copy_pass_by_ref)] // b"Z16 " reads better than *b"Z16 "

use super::*;
use crate::protocol::l515::{DepthLens, DepthPart, Lens};

fn lens(width: u32, height: u32) -> Lens {
    Lens { width, height, fx: width as f32, fy: width as f32, ppx: 1.0, ppy: 2.0, distortion: [0.0; 5] }
}

fn tables() -> Tables {
    let depth = |w, h| {
        let part = DepthPart { lens: lens(w, h), zero_order: [0.0; 2], z_norm: 4.0 };
        DepthLens { raw: DepthPart::default(), world: part }
    };
    let depth =
        DepthIntrinsics { sizes: vec![depth(1024, 768), depth(640, 480)], ..DepthIntrinsics::default() };
    Tables {
        depth_unit_m: depth.unit_m().unwrap(),
        depth,
        color: ColorIntrinsics { shear: 0.0, sizes: vec![lens(1920, 1080), lens(1280, 720)] },
        color_in_depth: Pose { translation_m: [0.0, 0.014, 0.0], ..Pose::IDENTITY },
    }
}

fn mode(sensor: Sensor, fourcc: &[u8; 4], width: u32, height: u32, rate_hz: f64) -> Mode {
    Mode { sensor, fourcc: *fourcc, width, height, rate_hz }
}

/// As the kernel shows them: depth, infrared and confidence turned.
fn modes() -> Vec<Mode> {
    vec![
        mode(Sensor::Depth, b"Z16 ", 768, 1024, 30.0),
        mode(Sensor::Depth, b"Z16 ", 480, 640, 30.0),
        mode(Sensor::Depth, b"Z16 ", 240, 320, 30.0),
        mode(Sensor::Infrared, b"GREY", 768, 1024, 30.0),
        mode(Sensor::Infrared, b"GREY", 480, 640, 30.0),
        mode(Sensor::Confidence, b"CNF4", 384, 1024, 30.0),
        mode(Sensor::Confidence, b"CNF4", 240, 640, 30.0),
        mode(Sensor::Color, b"NV12", 1280, 720, 30.0),
        mode(Sensor::Color, b"YUYV", 1280, 720, 15.0),
        mode(Sensor::Color, b"YUYV", 1280, 720, 30.0),
        mode(Sensor::Color, b"NV12", 1920, 1080, 30.0),
        mode(Sensor::Color, b"YUYV", 960, 540, 30.0),
    ]
}

fn request(stream: &str, size: Option<(u32, u32)>) -> StreamRequest {
    StreamRequest { size, ..StreamRequest::any(Name::new(stream).unwrap()) }
}

fn planned(requests: &[StreamRequest]) -> Result<(Vec<StreamProfile>, Plan)> {
    plan("L515 1", &offered(&tables(), &modes()).unwrap(), &modes(), requests)
}

#[test]
fn images_have_the_size_that_they_have_after_they_were_turned() {
    let all = offered(&tables(), &modes()).unwrap();
    let shown: Vec<_> = all.iter().map(StreamProfile::describe).collect();
    assert_eq!(
        shown,
        [
            "depth 640x480 z16 30 Hz",
            "depth 1024x768 z16 30 Hz",
            "color 1280x720 yuyv 30 Hz",
            "color 1280x720 nv12 30 Hz",
            "color 1280x720 yuyv 15 Hz",
            "color 1920x1080 nv12 30 Hz",
            "ir 640x480 mono8 30 Hz",
            "ir 1024x768 mono8 30 Hz",
            "confidence 640x480 confidence8 30 Hz",
            "confidence 1024x768 confidence8 30 Hz",
        ],
        "320x240 and 960x540 have no calibration"
    );
    assert!((all[0].depth_unit_m - 0.000_25).abs() < 1e-15);
    assert_eq!((all[0].intrinsics.fx, all[2].intrinsics.fx), (640.0, 1280.0));
    assert_eq!(all[2].pose_in_device.translation_m, [0.0, 0.014, 0.0]);
    assert!(all[4].depth_unit_m == 0.0 && all[6].depth_unit_m == 0.0);
    assert_eq!(offered(&tables(), &[]).unwrap_err().kind(), ErrorKind::Protocol);
}

#[test]
fn infrared_goes_along_with_depth() {
    let (chosen, plan) = planned(&[]).unwrap();
    let names: Vec<_> = chosen.iter().map(|p| p.stream.as_str().to_owned()).collect();
    assert_eq!(names, ["depth", "color"]);
    let sensors: Vec<_> = plan.modes.iter().map(|m| (m.sensor, m.width)).collect();
    assert_eq!(sensors, [(Sensor::Depth, 480), (Sensor::Color, 1280), (Sensor::Infrared, 480)]);
    assert_eq!(plan.streams, [(0, Unpack::Turn16(480)), (1, Unpack::Copy)], "infrared is not delivered");

    // Asked for, it is started once.
    let (_, plan) = planned(&[request("ir", None), request("depth", Some((1024, 768)))]).unwrap();
    assert_eq!(plan.modes.iter().map(|m| m.width).collect::<Vec<_>>(), [768, 768]);
    assert_eq!(plan.streams, [(0, Unpack::Turn8(768)), (1, Unpack::Turn16(768))]);

    let (_, plan) = planned(&[request("confidence", Some((640, 480)))]).unwrap();
    assert_eq!(plan.streams, [(0, Unpack::Confidence(240))]);
    assert_eq!(plan.modes[1], mode(Sensor::Infrared, b"GREY", 480, 640, 30.0));

    let (_, plan) = planned(&[request("color", Some((1920, 1080)))]).unwrap();
    assert_eq!((plan.modes.len(), plan.streams[0].1), (1, Unpack::Y411(1920)));
}

#[test]
fn one_sensor_has_one_size() {
    let e = planned(&[request("depth", Some((640, 480))), request("ir", Some((1024, 768)))]).unwrap_err();
    assert!(e.kind() == ErrorKind::Unsupported && e.to_string().contains("one sensor"), "{e}");
    let without: Vec<_> = modes().into_iter().filter(|m| m.sensor != Sensor::Infrared).collect();
    let e = plan("L515 1", &offered(&tables(), &without).unwrap(), &without, &[]).unwrap_err();
    assert!(e.to_string().contains("goes along"), "{e}");
}

#[test]
fn bytes_on_the_wire() {
    let bytes: Vec<_> = modes().iter().map(|m| m.wire_bytes().unwrap()).collect();
    assert_eq!(bytes[1], 640 * 480 * 2);
    assert_eq!(bytes[6], 640 * 480 / 2, "two pixels a byte");
    assert_eq!(bytes[7], 1280 * 720 * 3 / 2);
}
