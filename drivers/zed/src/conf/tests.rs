//! Against `OpenCV`, by hand, and with broken files.
#![allow(clippy::unreadable_literal)] // numbers as the files and OpenCV print them

use super::*;
use depthrig_calib::{CameraExt, PoseExt};
use glam::{DMat3, DVec2};
use proptest::prelude::*;

/// A file as the vendor delivers it, with invented numbers.
const SAMPLE: &str = include_str!("sample.conf");

fn sample() -> FactoryCalibration {
    FactoryCalibration::parse(SAMPLE, "SN12345678.conf").unwrap()
}

#[test]
fn every_number_of_the_sample_is_where_it_belongs() {
    let c = sample();
    let hd = c.at(Mode::Hd720).unwrap();
    assert_eq!([hd.left.fx, hd.left.fy, hd.left.cx, hd.left.cy], [532.41, 532.53, 636.02, 362.41]);
    assert_eq!(hd.left.coeffs, [-0.0634518, 0.0401532, -0.000375119, 0.00074809, -0.0161231, 0.0, 0.0, 0.0]);
    assert_eq!(hd.left.distortion(), Distortion::BrownConrady);
    assert_eq!([hd.right.fx, hd.right.cx, hd.right.cy], [532.63, 641.12, 375.51]);
    // In the sample this mode has no tangential terms.
    assert_eq!(
        c.at(Mode::Vga).unwrap().left.coeffs,
        [-0.0634518, 0.0401532, 0.0, 0.0, -0.0161231, 0.0, 0.0, 0.0]
    );
    assert_eq!(c.at(Mode::Vga).unwrap().left.fx, 266.205);
    for mode in Mode::ALL {
        let c = c.at(mode).unwrap();
        // |(120.14, 0.0942712, -0.234404)| mm
        assert!((c.baseline_m() - 0.1201402656577).abs() < 1e-12, "{}", c.baseline_m());
        assert!(c.right_in_left.translation_m[0] > 0.12, "the right camera is on the right");
    }
}

/// The angles of one mode do not reach another, and a mode without its own has the common ones.
#[test]
fn angles_are_those_of_the_mode_else_the_common_ones() {
    let angle = |mode: Mode| {
        let pose = sample().at(mode).unwrap().right_in_left;
        -DQuat::from_array(pose.rotation_xyzw).to_scaled_axis()
    };
    let near =
        |a: DVec3, b: [f64; 3]| assert!((a - DVec3::from_array(b)).length() < 1e-12, "{a} is not {b:?}");
    near(angle(Mode::Hd2k), [0.003_644_25, -0.003_122_88, -0.001_029_85]);
    near(angle(Mode::Hd720), [0.003_644_25, -0.004_1, -0.001_029_85]);
    near(angle(Mode::Vga), [0.003_6, -0.003_2, -0.001]);
}

/// Rectifying rotations of both cameras as `OpenCV` 4.12 gives them:
/// `cv2.stereoRectify(K1, D1, K2, D2, (1280, 720), cv2.Rodrigues(r)[0], t, alpha=0)` with `r` and `t` of [`SAMPLE`] at
/// HD720, once with `t` and once with `-t`, which gave the same to the last digit.
#[rustfmt::skip]
#[allow(clippy::excessive_precision)]
const OPENCV: [[f64; 9]; 2] = [
    [9.999800438114624e-01, 1.799927885859716e-03, -6.055760764051184e-03, -1.810957482377879e-03, 9.999967106485549e-01, -1.816349379244607e-03, 6.052471546627606e-03, 1.827279857101083e-03, 9.999800141185328e-01],
    [9.999977887707862e-01, 7.846761407109489e-04, -1.951086080237772e-03, -7.811203016809445e-04, 9.999980340124072e-01, 1.822586731801150e-03, 1.952512384749576e-03, -1.821058668696533e-03, 9.999964357140042e-01],
];

/// Bouguet's rectification, from the pose alone: the rotations that make both images' rows one.
fn rectify(right_in_left: &Pose) -> [DMat3; 2] {
    let to_right = DQuat::from_array(right_in_left.rotation_xyzw).inverse();
    let half = DQuat::from_scaled_axis(to_right.to_scaled_axis() / 2.0);
    // The baseline as both half-turned cameras see it becomes the x axis.
    let x = (half * DVec3::from_array(right_in_left.translation_m)).normalize();
    let turn = DQuat::from_rotation_arc(x, DVec3::X);
    [DMat3::from_quat(turn * half), DMat3::from_quat(turn * half.inverse())]
}

#[test]
fn rectification_is_that_of_opencv() {
    let pose = sample().at(Mode::Hd720).unwrap().right_in_left;
    for (own, theirs) in rectify(&pose).into_iter().zip(OPENCV) {
        let difference = own - DMat3::from_cols_array(&theirs).transpose();
        assert!(difference.to_cols_array().iter().all(|d| d.abs() < 1e-9), "{difference}");
    }
}

/// Both images show a point on one row after rectification, further left in the right image.
#[test]
fn a_point_is_on_one_row_and_its_disparity_is_its_distance() {
    let c = *sample().at(Mode::Hd720).unwrap();
    let rotations = rectify(&c.right_in_left);
    for p in [DVec3::new(0.1, -0.2, 0.8), DVec3::new(-0.7, 0.4, 2.5), DVec3::new(0.0, 0.0, 0.4)] {
        let seen = Side::BOTH.map(|side| {
            let in_side = c.pose(side).inverse().transform_point(p);
            let pixel = c.intrinsics(side).project(in_side).unwrap();
            let ray =
                rotations[usize::from(side == Side::Right)] * c.intrinsics(side).unproject(pixel).unwrap();
            DVec2::new(ray.x / ray.z, ray.y / ray.z)
        });
        assert!((seen[0].y - seen[1].y).abs() < 1e-8, "rows {} and {}", seen[0].y, seen[1].y);
        let z = c.baseline_m() / (seen[0].x - seen[1].x);
        assert!((z - (rotations[0] * p).z).abs() < 1e-6, "{z} m, not {} m", (rotations[0] * p).z);
    }
}

#[test]
fn what_is_wrong_is_said_with_its_line() {
    let cases = [
        (
            "fx=1064.82",
            "fx=1064,82",
            "line 5: [LEFT_CAM_2K] fx = \"1064,82\" is not a number; decimals have a point",
        ),
        ("fx=1064.82", "fx=10.6482", "line 5: [LEFT_CAM_2K] fx = 10.6482 is out of range "),
        ("fx=1064.82", "gx=1064.82", "line 4: [LEFT_CAM_2K] has no fx"),
        ("cy=628.813", "cy=62881.3", "[LEFT_CAM_2K] cy = 62881.3 is out of range "),
        ("k1=-0.0634518", "k1=-63.4", "[LEFT_CAM_2K] k1 = -63.4 is out of range "),
        ("[RIGHT_CAM_2K]", "[RIGHT_CAM_4K]", "line 4: [LEFT_CAM_2K] has no [RIGHT_CAM_2K]"),
        ("[LEFT_CAM_2K]", "[LEFT_CAM_4K]", "[RIGHT_CAM_2K] has no [LEFT_CAM_2K]"),
        ("Baseline = 120.14", "Baseline = -120.14", "[STEREO] Baseline = -120.14 is negative"),
        ("Baseline = 120.14", "Baseline = 0.12014", "[STEREO] Baseline = 0.12014 is out of range 20..="),
        ("Baseline = 120.14", "", "[STEREO] has no Baseline"),
        ("TY=0.0942712", "TY=94.2712", "[STEREO] TY = 94.2712 is out of range "),
        ("RX = 0.0036", "", "[STEREO] has no RX_VGA nor RX"),
        ("CV_HD=-0.0041", "CV_HD=-0.41", "[STEREO] CV_HD = -0.41 is out of range -0.2..=0.2 (radians)"),
        ("[STEREO]", "[STEREOS]", "no section [STEREO], which has the Baseline"),
    ];
    for (from, to, wanted) in cases {
        assert_eq!(SAMPLE.matches(from).count().min(1), 1, "{from}");
        let e = FactoryCalibration::parse(&SAMPLE.replacen(from, to, 1), "SN1.conf").unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput);
        assert!(
            e.to_string().contains(wanted) && e.to_string().starts_with("SN1.conf"),
            "{e}\nnot: {wanted}"
        );
    }
    let page = FactoryCalibration::parse("<html>\n", "SN1.conf").unwrap_err().to_string();
    assert!(page.contains("line 1: neither a section"), "{page}");
    let empty = FactoryCalibration::parse("", "SN1.conf").unwrap_err().to_string();
    assert!(empty.contains("no section [LEFT_CAM_2K]"), "{empty}");
}

#[test]
fn files_that_cannot_be_read_say_why() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("SN1.conf");
    assert_eq!(FactoryCalibration::load(&path).unwrap_err().kind(), ErrorKind::NotFound);
    std::fs::write(&path, [0xFF, 0xFE, 0x00]).unwrap();
    assert!(FactoryCalibration::load(&path).unwrap_err().to_string().contains("is not UTF-8 text"));
    std::fs::write(&path, SAMPLE).unwrap();
    assert_eq!(FactoryCalibration::load(&path).unwrap(), sample());
    std::fs::File::create(&path).unwrap().set_len(2 << 20).unwrap();
    assert!(FactoryCalibration::load(&path).unwrap_err().to_string().contains("2097152 bytes"));
}

#[test]
fn the_known_paths_are_those_of_the_vendor() {
    let paths = known_paths("22456", Some(Path::new("/home/a")));
    let expected =
        ["/usr/local/zed/settings/SN22456.conf", "/home/a/zed/settings/SN22456.conf"].map(PathBuf::from);
    assert_eq!(paths, expected);
    assert!(how_to_get("22456").contains("https://calib.stereolabs.com/?SN=22456"));
}

proptest! {
    /// Whatever a calibration holds, its text has it.
    #[test]
    fn text_and_back(
        angles in prop::array::uniform3(-0.15f64..0.15),
        baseline in 25.0f64..290.0,
        off in prop::array::uniform2(-2.0f64..2.0),
        k in prop::array::uniform5(-1.0f64..1.0),
        focal in 0.25f64..2.5,
        which in 1usize..16,
    ) {
        let to_right = DQuat::from_scaled_axis(DVec3::from_array(angles));
        let t = DVec3::new(baseline, off[0], off[1]) / 1000.0;
        let pose = Pose {
            translation_m: (to_right.inverse() * t).to_array(),
            rotation_xyzw: to_right.inverse().to_array(),
        };
        let modes = core::array::from_fn(|i| {
            let (w, h) = Mode::ALL[i].image_size();
            let w = f64::from(w);
            let h = f64::from(h);
            let [k1, k2, p1, p2, k3] = k;
            let mut left = Intrinsics::pinhole(focal * w, focal * w * 1.01, 0.4 * w, 0.6 * h);
            left.model = Distortion::BrownConrady as u32;
            left.coeffs = [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0];
            let right = Intrinsics { cx: 0.51 * w, ..left };
            (which >> i & 1 == 1).then_some(StereoCalibration { left, right, right_in_left: pose })
        });
        let built = FactoryCalibration { modes };
        let read = FactoryCalibration::parse(&built.build(), "built").unwrap();
        for mode in Mode::ALL {
            let (Some(a), Some(b)) = (built.at(mode), read.at(mode)) else {
                prop_assert_eq!(built.at(mode).is_some(), read.at(mode).is_some());
                continue;
            };
            prop_assert_eq!((a.left, a.right), (b.left, b.right));
            let apart = a.right_in_left.to_affine().inverse() * b.right_in_left.to_affine();
            prop_assert!(apart.translation.length() < 1e-12);
            prop_assert!((apart.matrix3 - DMat3::IDENTITY).to_cols_array().iter().all(|d| d.abs() < 1e-12));
        }
    }

    #[test]
    fn no_text_makes_it_panic(text in "(\\[?[A-Z_2 ]{0,14}[\\]= \n,.0-9e+-]{0,12}){0,20}") {
        let _ = FactoryCalibration::parse(&text, "any");
    }
}
