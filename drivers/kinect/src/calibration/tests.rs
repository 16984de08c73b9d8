//! The calibration against numbers computed by hand and by OpenCV.

#![allow(clippy::unreadable_literal)] // numbers as OpenCV prints them

use super::*;
use depthrig_calib::{Camera, CameraExt};
use glam::DVec2;
use proptest::prelude::*;
use serde_json::{Value, json};

const EXAMPLE: &str = include_str!("../../../../tests/data/kinect_calibration.json");

fn example() -> Calibration {
    Calibration::parse(EXAMPLE.as_bytes()).unwrap()
}

/// The example with one thing changed.
fn changed(pointer: &str, value: Value) -> Result<Calibration> {
    let mut text: Value = serde_json::from_str(EXAMPLE).unwrap();
    *text.pointer_mut(pointer).unwrap_or_else(|| panic!("{pointer}")) = value;
    Calibration::parse(text.to_string().as_bytes())
}

const D0: &str = "/CalibrationInformation/Cameras/0";
const PV0: &str = "/CalibrationInformation/Cameras/1";

/// Points in the device's frame, and where OpenCV 5.0.0 shows them: `cv2.projectPoints` with the camera matrix of the
/// mode, `(k1, k2, p1, p2, k3, k4, k5, k6)` and, for colour, the rotation and translation of the file.
const POINTS: [[f64; 3]; 5] =
    [[0.0, 0.0, 1.0], [0.3, -0.2, 1.1], [-0.5, 0.25, 0.9], [0.7, 0.4, 1.5], [-0.9, -0.5, 2.0]];
const SEEN_COLOR_720P: [[f64; 2]; 5] = [
    [619.2287897105433, 417.2303972833963],
    [786.4924102989045, 306.76239849659316],
    [255.87857722853062, 599.8545475760794],
    [925.3425780850419, 590.7394641225957],
    [353.19265498855833, 265.63726356008175],
];
const SEEN_NFOV_UNBINNED: [[f64; 2]; 5] = [
    [332.78128, 348.82608],
    [465.6302136137377, 260.23707117305594],
    [82.83716337527483, 473.8255722759044],
    [548.233755179945, 471.98076356574995],
    [123.58462792193231, 232.58552162556157],
];
const SEEN_NFOV_BINNED: [[f64; 2]; 5] = [
    [166.14064, 174.16304],
    [232.56510680686884, 129.86853558652797],
    [41.16858168763741, 236.6627861379522],
    [273.8668775899725, 235.74038178287498],
    [61.542313960966155, 116.04276081278078],
];
const SEEN_WFOV_UNBINNED: [[f64; 2]; 5] = [
    [524.78128, 528.82608],
    [657.6302136137376, 440.23707117305594],
    [274.8371633752748, 653.8255722759044],
    [740.233755179945, 651.98076356575],
    [315.58462792193234, 412.58552162556157],
];
const SEEN_WFOV_BINNED: [[f64; 2]; 5] = [
    [262.14064, 264.16304],
    [328.5651068068688, 219.86853558652797],
    [137.1685816876374, 326.6627861379522],
    [369.8668775899725, 325.740381782875],
    [157.54231396096617, 206.04276081278078],
];

fn near(got: DVec2, wanted: [f64; 2]) {
    assert!((got - DVec2::from_array(wanted)).length() < 1e-9, "{got} is not {wanted:?}");
}

#[test]
fn the_narrow_mode_has_the_numbers_computed_by_hand() {
    let k = example().depth_intrinsics(DepthMode::NfovUnbinned);
    // 0.51297 * 1024 - 192 - 0.5, 0.51692 * 1024 - 180 - 0.5, 0.49278 * 1024, 0.4929 * 1024.
    for (got, wanted) in [(k.cx, 332.78128), (k.cy, 348.82608), (k.fx, 504.60672), (k.fy, 504.7296)] {
        assert!((got - wanted).abs() < 1e-9, "{got} {wanted}");
    }
    assert_eq!(k.distortion(), Distortion::Rational);
    assert_eq!(k.coeffs, [0.548, -0.021, 2.06e-5, -7.2e-5, -0.00265, 0.8897, 0.0861, -0.0139]);
}

#[test]
fn every_color_resolution_is_a_crop_of_the_same_view() {
    let c = example();
    let p = DVec3::new(0.21, -0.13, 1.0);
    let whole = c.color_intrinsics(ColorResolution::P3072).project(p).unwrap();
    for resolution in ColorResolution::ALL {
        let Cut { sensor, offset, .. } = resolution.cut();
        let scale = f64::from(sensor.0) / 4096.0;
        // Corners and not centres are what scales.
        let wanted = (whole + 0.5) * scale - 0.5 - DVec2::new(f64::from(offset.0), f64::from(offset.1));
        near(c.color_intrinsics(resolution).project(p).unwrap(), wanted.to_array());
    }
    // Rows of the whole sensor at each width, and those above the image: half of what 16:9 leaves of 4:3.
    for (resolution, rows, above) in [
        (ColorResolution::P720, 960.0, 120.0),
        (ColorResolution::P1080, 1440.0, 180.0),
        (ColorResolution::P1440, 1920.0, 240.0),
        (ColorResolution::P1536, 1536.0, 0.0),
        (ColorResolution::P2160, 2880.0, 360.0),
        (ColorResolution::P3072, 3072.0, 0.0),
    ] {
        let k = c.color_intrinsics(resolution);
        let raw = c.color.intrinsics;
        assert!((k.cy - (raw.cy * rows - above - 0.5)).abs() < 1e-9, "{resolution:?}: {}", k.cy);
        assert!((k.fy - raw.fy * rows).abs() < 1e-9, "{resolution:?}: {}", k.fy);
    }
    let k = c.color_intrinsics(ColorResolution::P1080);
    // 0.49985 * 1920 - 0.5, 0.50662 * 1440 - 180 - 0.5, 0.47797 * 1920, 0.63742 * 1440.
    for (got, wanted) in [(k.cx, 959.212), (k.cy, 549.0328), (k.fx, 917.7024), (k.fy, 917.8848)] {
        assert!((got - wanted).abs() < 1e-9, "{got} {wanted}");
    }
}

#[test]
fn points_are_seen_where_opencv_sees_them() {
    let c = example();
    for (mode, seen) in [
        (DepthMode::Nfov2x2Binned, SEEN_NFOV_BINNED),
        (DepthMode::NfovUnbinned, SEEN_NFOV_UNBINNED),
        (DepthMode::Wfov2x2Binned, SEEN_WFOV_BINNED),
        (DepthMode::WfovUnbinned, SEEN_WFOV_UNBINNED),
        (DepthMode::PassiveIr, SEEN_WFOV_UNBINNED),
    ] {
        let k = c.depth_intrinsics(mode);
        for (p, wanted) in POINTS.into_iter().zip(seen) {
            near(k.project(DVec3::from_array(p)).unwrap(), wanted);
        }
    }
    let k = c.color_intrinsics(ColorResolution::P720);
    let color_from_depth = c.color_from_depth();
    for (p, wanted) in POINTS.into_iter().zip(SEEN_COLOR_720P) {
        let p = color_from_depth.transform_point(DVec3::from_array(p));
        near(k.project(p).unwrap(), wanted);
    }
}

#[test]
fn poses_are_those_of_the_cameras_in_the_device() {
    let c = example();
    assert_eq!(c.depth_in_device(), Pose::IDENTITY);
    // The colour camera is 32 mm to the right of the depth camera as seen from behind.
    assert!((c.color_in_device().translation_m[0] - 0.032).abs() < 0.001, "{:?}", c.color_in_device());
    let there_and_back = c.color_from_depth().compose(&c.color_in_device());
    assert!(DVec3::from_array(there_and_back.translation_m).length() < 1e-12);
    let accelerometer = c.accelerometer.unwrap().sensor_from_device;
    assert_eq!(accelerometer.translation_m, [-0.051, 0.0034, 0.0015]);
    let axis = c.gyroscope.unwrap().sensor_from_device.transform_point(DVec3::X);
    assert!((axis - DVec3::Z).length() < 1e-12, "the first column, rows first: {axis}");
}

#[test]
fn a_depth_camera_that_is_not_at_the_origin_counts() {
    let moved = changed(&format!("{D0}/Rt/Translation"), json!([0.01, 0.02, 0.03])).unwrap();
    let by = example().color_from_depth().transform_point(-DVec3::new(0.01, 0.02, 0.03));
    let got = moved.color_from_depth().transform_point(DVec3::ZERO);
    assert!((got - by).length() < 1e-12, "{got} {by}");
    assert_eq!(moved.depth_in_device().translation_m, [-0.01, -0.02, -0.03]);
}

#[test]
fn a_device_that_was_calibrated_in_16_to_9_sees_the_same() {
    let c = example();
    let k = c.color.intrinsics;
    // The same lens in the rows 384 to 2688 of 3072.
    let cy = (k.cy * 3072.0 - 384.0) / 2304.0;
    let fy = k.fy * 3072.0 / 2304.0;
    let early = Calibration {
        color: CameraCalibration {
            intrinsics: RawIntrinsics { cy, fy, ..k },
            sensor: (4096, 2304),
            ..c.color
        },
        ..c
    };
    let early = Calibration::parse(early.build().as_bytes()).unwrap();
    for resolution in ColorResolution::ALL {
        let a = early.color_intrinsics(resolution);
        let b = c.color_intrinsics(resolution);
        for (a, b) in [(a.fx, b.fx), (a.fy, b.fy), (a.cx, b.cx), (a.cy, b.cy)] {
            assert!((a - b).abs() < 1e-9, "{resolution:?}: {a} {b}");
        }
    }
}

#[test]
fn prototypes_say_how_far_off_their_lens_is() {
    let c = example();
    let off =
        |c: &Calibration| c.approximation_px(Some(DepthMode::NfovUnbinned), Some(ColorResolution::P720));
    assert_eq!(off(&c), 0.0);
    let rational = "CALIBRATION_LensDistortionModelRational6KT";
    let prototype = changed(&format!("{D0}/Intrinsics/ModelType"), json!(rational)).unwrap();
    // p1 and p2 are a few 1e-5: x y p is at most 0.4 * 7e-5 of 505 px.
    assert!((0.001..0.05).contains(&off(&prototype)), "{}", off(&prototype));
    let shifted = changed(&format!("{PV0}/Intrinsics/ModelParameters/10"), json!(0.01)).unwrap();
    assert!(off(&shifted) > 0.01, "{}", off(&shifted));
}

#[test]
fn pixels_come_back_through_the_inverse() {
    let c = example();
    let depth = Camera::new(&c.depth_intrinsics(DepthMode::WfovUnbinned)).unwrap();
    let depth = depth.with_max_radius(c.depth.metric_radius);
    assert!(depth.max_radius() <= 1.74);
    let mut seen = 0;
    for (x, y) in (0..1024).step_by(32).flat_map(|y| (0..1024).step_by(32).map(move |x| (x, y))) {
        let pixel = DVec2::new(f64::from(x), f64::from(y));
        let Some(ray) = depth.unproject(pixel) else { continue };
        assert!((depth.project(ray * 2.5).unwrap() - pixel).length() < 1e-6, "{pixel}");
        seen += 1;
    }
    assert!((700..1024).contains(&seen), "{seen} of 1024: the corners lie beyond the metric radius");
}

#[test]
fn what_is_written_is_read_back() {
    let c = example();
    let again = Calibration::parse(c.build().as_bytes()).unwrap();
    assert_eq!((again.depth.intrinsics, again.color.intrinsics), (c.depth.intrinsics, c.color.intrinsics));
    assert_eq!(again.color.metric_radius, 1.7, "0 in the file");
    let off = again.color_from_depth().compose(&c.color_from_depth().inverse());
    assert!(
        DVec3::from_array(off.translation_m).length() < 1e-12
            && (off.rotation_xyzw[3].abs() - 1.0).abs() < 1e-12
    );
    let with_zero = [EXAMPLE.as_bytes(), b"\0"].concat();
    assert_eq!(Calibration::parse(&with_zero).unwrap(), c, "as the device sends it");
}

#[test]
fn what_cannot_be_is_refused_by_name() {
    let refused = |pointer: &str, value: Value, wanted: &str| {
        let e = changed(pointer, value).unwrap_err();
        assert!(e.to_string().contains(wanted) && e.kind() == ErrorKind::BadInput, "{pointer}: {e}");
    };
    refused("/CalibrationInformation", json!(3), "no object CalibrationInformation");
    refused("/CalibrationInformation/Cameras", json!({}), "no list Cameras");
    refused(
        &format!("{PV0}/Location"),
        json!("elsewhere"),
        "no camera with \"Location\": \"CALIBRATION_CameraLocationPV0\"",
    );
    refused(
        &format!("{D0}/Intrinsics/ModelType"),
        json!("Fisheye"),
        "\"Fisheye\" is not one that Kinects have",
    );
    refused(&format!("{D0}/Intrinsics/ModelParameters"), json!([1, 2, 3]), "3 numbers, not 14");
    refused(&format!("{D0}/Intrinsics/ModelParameters/2"), json!(0), "fx = 0 is out of range");
    refused(
        &format!("{D0}/Intrinsics/ModelParameters/4"),
        json!("x"),
        "\"x\" in ModelParameters is not a number",
    );
    refused(&format!("{D0}/Intrinsics/ModelParameterCount"), json!(1e9), "ModelParameterCount = 1000000000");
    refused(&format!("{PV0}/Rt/Rotation/0"), json!(0.5), "is not a rotation");
    refused(&format!("{PV0}/Rt/Translation/2"), json!(32.1), "more than a metre");
    refused(&format!("{PV0}/MetricRadius"), json!(null), "no number MetricRadius");
    refused(&format!("{D0}/SensorWidth"), json!(2048), "(2048, 1024)");
    refused(&format!("{PV0}/SensorWidth"), json!(4000), "neither 4:3 nor 16:9");
    let mirrored = json!([-1, 0, 0, 0, 1, 0, 0, 0, 1]);
    refused(&format!("{D0}/Rt/Rotation"), mirrored, "is not a rotation");
    assert!(Calibration::parse(b"<html>").unwrap_err().to_string().contains("no JSON"));
    assert!(Calibration::parse(&vec![b' '; 2 << 20]).unwrap_err().to_string().contains("2097152 bytes"));
}

proptest! {
    #[test]
    fn damaged_text_is_refused_or_sound(at in 0usize..2400, byte: u8, cut in 0usize..2400) {
        let mut text = EXAMPLE.as_bytes().to_vec();
        let n = text.len();
        text[at % n] = byte;
        if cut.is_multiple_of(3) {
            text.truncate(cut % n);
        }
        if let Ok(c) = Calibration::parse(&text) {
            for mode in DepthMode::ALL {
                prop_assert!(Camera::new(&c.depth_intrinsics(mode)).is_ok());
            }
        }
    }
}
