use super::*;
use crate::board::{Paper, Pattern};

fn file() -> Calibration {
    let camera = |name: &str| CalibratedCamera {
        name: name.to_owned(),
        stream: "color".to_owned(),
        serial: "123".to_owned(),
        width: 640,
        height: 480,
        source: Source::Calibrated,
        intrinsics: FileIntrinsics {
            model: Distortion::BrownConrady,
            fx: 600.125,
            fy: 601.0,
            cx: 320.5,
            cy: 239.75,
            coeffs: vec![0.1, -0.2, 0.001, 0.0, 0.03],
            sigmas: vec![0.1; 9],
        },
        pose: FilePose {
            translation_m: [0.1, 0.2, 0.3],
            rotation_xyzw: [0.0, 0.6, 0.0, 0.8],
            sigma_mm: 0.1,
            sigma_deg: 0.01,
            covariance: Vec::new(),
        },
        conditions: Conditions {
            firmware: "5.13".to_owned(),
            temperature_c: Some(31.5),
            lens_position: Some(120),
        },
        quality: Quality {
            views: 20,
            corners: 1400,
            rms_px: 0.2,
            held_out_px: Some(0.21),
            factory_px: None,
            projection_middle_px: 0.05,
            projection_worst_px: 0.4,
            halves_differ_px: Some(0.1),
            halves_differ_mm: None,
            halves_differ_deg: None,
        },
        uncertainty: (name == "right").then(|| UncertaintyMap {
            distance_m: 0.8,
            columns: 2,
            sigma_px: vec![0.3, 0.2, 0.0625, 0.4],
        }),
        latency: (name == "right").then(|| FileLatency {
            latency_ms: 4.7,
            sigma_ms: 0.02,
            reference: "left".to_owned(),
            created: "2026-11-25T04:00:00Z".to_owned(),
            dataset: "20261125_0355_wave".to_owned(),
            board: "charuco 11x8, 30 mm".to_owned(),
        }),
    };
    Calibration {
        format: FORMAT.to_owned(),
        created: "2026-11-25T03:00:00Z".to_owned(),
        by: None,
        reference: "left".to_owned(),
        rms_px: 0.2,
        board: Board::for_paper(Pattern::Charuco, 11, 8, None, Paper::parse("a4").unwrap()).unwrap(),
        cameras: vec![camera("left"), camera("right")],
        depth: vec![correction()],
    }
}

fn correction() -> DepthCorrection {
    DepthCorrection {
        camera: "left".to_owned(),
        stream: "depth".to_owned(),
        serial: "123".to_owned(),
        width: 848,
        height: 480,
        created: "2026-11-25T03:00:00Z".to_owned(),
        model: crate::depth::Model::ScaleOffset,
        scale: 0.996,
        offset_mm: -3.0,
        inverse_per_m: 0.0,
        sigma_scale: 0.0001,
        sigma_offset_mm: 0.1,
        sigma_inverse_per_m: 0.0,
        places: vec![DepthPlace {
            distance_m: 0.5,
            tilt_deg: 3.0,
            fill: 0.99,
            bias_mm: 5.0,
            sigma_mm: 0.1,
            corrected_mm: 0.0,
            plane_rms_mm: 0.7,
            subpixel_rms_px: Some(0.08),
            temporal_mm: None,
            frames: 5,
        }],
    }
}

#[test]
fn a_calibration_survives_its_file() {
    let file = file();
    let again = Calibration::from_toml(&file.to_toml().unwrap()).unwrap();
    assert_eq!(file, again);
    let right = again.of_camera("right").next().unwrap();
    assert_eq!(right.intrinsics().distortion(), Distortion::BrownConrady);
    assert_eq!(right.intrinsics().coeffs[..5], [0.1, -0.2, 0.001, 0.0, 0.03]);
}

#[test]
fn bad_files_are_refused() {
    let refused = |from: &str, to: &str| {
        let text = file().to_toml().unwrap().replacen(from, to, 1);
        Calibration::from_toml(&text).unwrap_err().to_string()
    };
    assert!(refused("calibration/1", "calibration/9").contains("this version reads"));
    assert!(refused("name = \"right\"", "name = \"left\"").contains("twice"));
    assert!(
        refused("rotation_xyzw = [0.0, 0.6, 0.0, 0.8]", "rotation_xyzw = [0.0, 0.6, 0.0, 0.9]")
            .contains("length")
    );
    assert!(refused("fx = 600.125", "fx = nan").contains("intrinsics"));
    assert!(refused("width = 640", "widht = 640").contains("widht"));
    assert!(refused("latency_ms = 4.7", "latency_ms = -1.0").contains("camera right: latency_ms = -1"));
    assert!(refused("sigma_ms = 0.02", "sigma_ms = nan").contains("out of range"));
    assert!(refused("scale = 0.996", "scale = 9.96").contains("depth of left/depth: scale is out of range"));
    assert!(refused("offset_mm = -3.0", "offset_mm = nan").contains("offset_mm is out of range"));
    let twice = Calibration { depth: vec![correction(), correction()], ..file() };
    let message = Calibration::from_toml(&twice.to_toml().unwrap()).unwrap_err().to_string();
    assert!(message.contains("depth of left/depth is there twice"), "{message}");
}

#[test]
fn a_map_of_uncertainty_is_a_grid_and_may_have_gaps() {
    let mut calibration = file();
    let map = calibration.cameras[1].uncertainty.as_mut().unwrap();
    map.sigma_px[2] = f64::NAN;
    let read = Calibration::from_toml(&calibration.to_toml().unwrap()).unwrap();
    let read = read.cameras[1].uncertainty.as_ref().unwrap();
    assert!(read.sigma_px[2].is_nan() && read.sigma_px[3] == 0.4, "{read:?}");
    for columns in [0, 3] {
        calibration.cameras[1].uncertainty.as_mut().unwrap().columns = columns;
        let error = Calibration::from_toml(&calibration.to_toml().unwrap()).unwrap_err().to_string();
        assert!(error.contains("camera right: uncertainty"), "{error}");
    }
}

#[test]
fn a_correction_fits_its_device_and_size_alone() {
    let file = file();
    let found = file.depth_of("left", "depth").unwrap();
    assert!((found.correction().apply(1.0) - 0.993).abs() < 1e-6);
    found.check_fits("123", 848, 480).unwrap();
    found.check_fits("", 848, 480).unwrap();
    let serial = found.check_fits("124", 848, 480).unwrap_err().to_string();
    assert!(serial.contains("is of serial number 123, this camera has 124"), "{serial}");
    let size = found.check_fits("123", 640, 480).unwrap_err().to_string();
    assert!(size.contains("is for 848x480, the stream has 640x480"), "{size}");
    assert!(file.depth_of("left", "depth_nfov").is_none());
}

#[test]
fn a_new_calibration_keeps_latencies_and_corrections_of_the_same_devices() {
    let before = Calibration { depth: vec![correction()], ..file() };
    let mut after = before.clone();
    after.depth.clear();
    for camera in &mut after.cameras {
        camera.latency = None;
    }
    let mut other = after.clone();
    let kept = after.keep_from(&before);
    assert_eq!(after, before);
    assert_eq!(kept, ["latency of right", "depth of left/depth"]);
    for camera in &mut other.cameras {
        camera.serial = "other".to_owned();
    }
    assert_eq!(other.keep_from(&before), [""; 0]);
}
