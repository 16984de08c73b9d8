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
    };
    Calibration {
        format: FORMAT.to_owned(),
        created: "2026-11-25T03:00:00Z".to_owned(),
        by: None,
        reference: "left".to_owned(),
        rms_px: 0.2,
        board: Board::for_paper(Pattern::Charuco, 11, 8, None, Paper::parse("a4").unwrap()).unwrap(),
        cameras: vec![camera("left"), camera("right")],
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
}
