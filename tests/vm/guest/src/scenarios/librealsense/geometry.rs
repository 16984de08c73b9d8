//! Who a camera is, its modes, and its calibration.

use super::Subject;
use super::vendor::{entries, numbers, text, whole};
use depthrig_calib::PoseExt;
use depthrig_driver::{DeviceInfo, StreamProfile};
use glam::DVec3;
use serde_json::Value;
use std::collections::BTreeSet;

/// The streams of the driver, as the library calls them.
const STREAMS: [(&str, &str); 7] = [
    ("depth", "depth 0"),
    ("ir_left", "infrared 1"),
    ("ir_right", "infrared 2"),
    ("ir", "infrared 0"),
    ("confidence", "confidence 0"),
    ("color", "color 0"),
    ("imu", "accel 0"),
];
/// Formats that the driver leaves alone: raw images for calibration, and interleaved ones of another depth of bits.
const LEFT_ALONE: [&str; 4] = ["y16", "raw16", "uyvy", "y12i"];
/// Numbers of the tables have 32 bits: half a unit in the last place of 2048 pixels, doubled twice on the way.
const PIXELS: f64 = 1e-3;

fn vendor_name(stream: &str) -> &'static str {
    STREAMS.iter().find(|(ours, _)| *ours == stream).map_or("", |(_, theirs)| *theirs)
}

pub fn identity(subject: &mut Subject<'_>, reported: &Value, info: &DeviceInfo) {
    let said = &reported["info"];
    let serial = text(said, "serial_number");
    let ours = info.serial.as_str();
    subject.that(
        "the serial number is one",
        serial == ours && ours == subject.camera.serial(),
        format!("{serial}, {ours}"),
    );
    let theirs: String = text(said, "firmware_version")
        .split('.')
        .map(|n| n.trim_start_matches('0'))
        .map(|n| if n.is_empty() { "0" } else { n })
        .collect::<Vec<_>>()
        .join(".");
    subject.that("the firmware is one", theirs == info.firmware, format!("{theirs}, {}", info.firmware));
    let chip = text(said, "asic_serial_number");
    let given = subject.camera.usb_serial();
    subject.that("the serial number of its chip", chip == given, format!("{chip}, {given}"));
    let name = text(said, "name");
    subject.that(
        "the model is one",
        name.to_lowercase().contains(&info.model.to_lowercase()),
        format!("{name}, {}", info.model),
    );
}

/// Every mode that the driver offers is one of the library's, and the other way round but for formats that it leaves alone.
pub fn modes(subject: &mut Subject<'_>, reported: &Value, profiles: &[StreamProfile]) {
    let mut theirs = BTreeSet::new();
    for sensor in entries(&reported["sensors"]) {
        for p in entries(&sensor["profiles"]) {
            if p.get("width").is_some() && !LEFT_ALONE.contains(&text(p, "format")) {
                let stream = format!("{} {}", text(p, "stream"), whole(p, "index"));
                theirs.insert((stream, whole(p, "width"), whole(p, "height"), whole(p, "rate")));
            }
        }
    }
    let images = profiles.iter().filter(|p| !p.format.is_motion());
    let ours: BTreeSet<_> = images
        .map(|p| {
            (
                vendor_name(p.stream.as_str()).to_owned(),
                u64::from(p.width),
                u64::from(p.height),
                p.rate_hz.round() as u64,
            )
        })
        .collect();
    let only_ours: Vec<_> = ours.difference(&theirs).collect();
    let only_theirs: Vec<_> = theirs.difference(&ours).collect();
    subject.that(
        "every mode of the driver is one of the library's",
        only_ours.is_empty() && ours.len() > 20,
        format!("{} modes; not there: {only_ours:?}", ours.len()),
    );
    subject.that(
        "and the other way round",
        only_theirs.is_empty(),
        format!("{} modes; not here: {only_theirs:?}", theirs.len()),
    );
}

pub fn intrinsics(subject: &mut Subject<'_>, reported: &Value, profiles: &[StreamProfile]) {
    let mut compared = 0;
    let mut unknown = Vec::new();
    let mut off = 0.0f64;
    let mut off_coefficients = 0.0f64;
    let mut units = BTreeSet::new();
    for p in profiles.iter().filter(|p| !p.format.is_motion()) {
        let key = format!("{} {} {}", vendor_name(p.stream.as_str()), p.width, p.height);
        let found = entries(&reported["sensors"]).iter().find_map(|s| s["intrinsics"].get(&key));
        let Some(pinhole) = found.map(|i| numbers(&i["pinhole"])).filter(|n| n.len() == 4) else {
            unknown.push(key);
            continue;
        };
        let i = &p.intrinsics;
        for (ours, theirs) in [i.fx, i.fy, i.cx, i.cy].into_iter().zip(&pinhole) {
            off = off.max((ours - theirs).abs());
        }
        let coefficients = found.map(|i| numbers(&i["coefficients"])).unwrap_or_default();
        for (ours, theirs) in i.coeffs.into_iter().zip(coefficients) {
            off_coefficients = off_coefficients.max((ours - theirs).abs());
        }
        if p.stream.as_str() == "depth" {
            units.insert(p.depth_unit_m.to_bits());
        }
        compared += 1;
    }
    subject.that(
        "intrinsics are one",
        compared > 20 && off < PIXELS,
        format!("{off:.1e} px at most in {compared} modes"),
    );
    subject.that("distortion is one", off_coefficients < 1e-7, format!("{off_coefficients:.1e} at most"));
    subject.that("the library has intrinsics of every mode", unknown.is_empty(), format!("{unknown:?}"));
    let theirs =
        entries(&reported["sensors"]).iter().find_map(|s| s["depth_unit"].as_f64()).unwrap_or(f64::NAN);
    let ours: Vec<f64> = units.into_iter().map(f64::from_bits).collect();
    let holds = matches!(ours[..], [one] if (one - theirs).abs() < 1e-9);
    subject.that("the unit of depth is one", holds, format!("{ours:?}, {theirs}"));
}

/// The library says `p_camera = R p_depth + t`, column after column; the driver `p_depth = pose(p_camera)`.
pub fn poses(subject: &mut Subject<'_>, reported: &Value, profiles: &[StreamProfile]) {
    let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::new(-0.6, 0.0, 0.8)];
    let streams: BTreeSet<&str> = profiles.iter().map(|p| p.stream.as_str()).collect();
    for stream in streams {
        let pose = &reported["from_depth"][vendor_name(stream)];
        let r = numbers(&pose["rotation"]);
        let translation = DVec3::from_slice(&[numbers(&pose["translation"]), vec![f64::NAN; 3]].concat());
        if r.len() != 9 || !translation.is_finite() {
            subject.that(&format!("the library knows where {stream} is"), false, pose);
            continue;
        }
        let column = |i: usize| DVec3::new(r[3 * i], r[3 * i + 1], r[3 * i + 2]);
        let mut off = 0.0f64;
        for p in profiles.iter().filter(|p| p.stream.as_str() == stream) {
            for point in points {
                let there = column(0) * point.x + column(1) * point.y + column(2) * point.z + translation;
                off = off.max((p.pose_in_device.transform_point(there) - point).length());
            }
        }
        subject.that(&format!("the pose of {stream} is one"), off < 1e-6, format!("{off:.1e} m at 1 m"));
    }
}
