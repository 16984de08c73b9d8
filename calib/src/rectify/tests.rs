//! Rectification against `OpenCV`, against the cameras' own projection, and with invalid stereo cameras.

use super::*;
use depthrig_bus::{Distortion, PixelFormat};
use glam::{DAffine3, DVec2, DVec3};
use proptest::prelude::*;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::sync::LazyLock;

#[derive(Deserialize)]
struct Reference {
    cameras: Vec<Theirs>,
}

#[derive(Deserialize)]
struct Theirs {
    name: String,
    size: (u32, u32),
    rotation_vector: [f64; 3],
    translation: [f64; 3],
    focal: f64,
    center: [f64; 2],
    baseline: f64,
    eyes: [TheirCamera; 2],
}

#[derive(Deserialize)]
struct TheirCamera {
    intrinsics: [f64; 4],
    coeffs: [f64; 8],
    rational: bool,
    rotation: [f64; 9],
    map: Vec<(u32, u32, f64, f64)>,
    pixels: BTreeMap<String, Vec<Vec<u8>>>,
}

impl Theirs {
    fn intrinsics(&self, view: View) -> Intrinsics {
        let camera = &self.eyes[view as usize];
        let [fx, fy, cx, cy] = camera.intrinsics;
        let model = if camera.rational { Distortion::Rational } else { Distortion::BrownConrady };
        Intrinsics { coeffs: camera.coeffs, model: model as u32, ..Intrinsics::pinhole(fx, fy, cx, cy) }
    }

    fn right_in_left(&self) -> Pose {
        let turn = DQuat::from_scaled_axis(DVec3::from_array(self.rotation_vector));
        let right_from_left = DAffine3::from_rotation_translation(turn, DVec3::from_array(self.translation));
        Pose::from_affine(&right_from_left.inverse())
    }

    fn rectifier(&self) -> Rectifier {
        let left = self.intrinsics(View::Left);
        let right = self.intrinsics(View::Right);
        Rectifier::new(&left, &right, &self.right_in_left(), self.size).unwrap()
    }
}

/// Numbers of `OpenCV` 4.14, which `opencv.py` wrote.
fn reference() -> Vec<Theirs> {
    serde_json::from_str::<Reference>(include_str!("opencv.json")).unwrap().cameras
}

#[test]
fn views_and_maps_are_those_of_opencv() {
    for theirs in reference() {
        let own = theirs.rectifier();
        let name = &theirs.name;
        let k = own.intrinsics();
        // `OpenCV` keeps the points from which it finds focal length and centre in single precision.
        let near =
            |a: f64, b: f64, tolerance: f64| assert!((a - b).abs() < tolerance, "{name}: {a} is not {b}");
        near(k.fx, theirs.focal, 1e-3);
        near(k.fy, theirs.focal, 1e-3);
        near(k.cx, theirs.center[0], 1e-3);
        near(k.cy, theirs.center[1], 1e-3);
        near(own.baseline_m(), theirs.baseline, 1e-9);
        for view in View::BOTH {
            let camera = &theirs.eyes[view as usize];
            for (a, b) in own.rotation(view).transpose().to_cols_array().iter().zip(camera.rotation) {
                near(*a, b, 1e-9);
            }
            for &(x, y, u, v) in &camera.map {
                let w = f64::from(theirs.size.0) - 1.0;
                let h = f64::from(theirs.size.1) - 1.0;
                let Some(at) = own.source(view, x, y) else {
                    let edge = u.min(v).min(w - u).min(h - v);
                    assert!(edge < 1e-3, "{name} {view:?}: nothing at {x}, {y}; theirs is {u}, {v}");
                    continue;
                };
                near(at.0, u, 0.5 / 256.0 + 2e-3);
                near(at.1, v, 0.5 / 256.0 + 2e-3);
            }
        }
    }
}

/// The image of `opencv.py`.
fn image((width, height): (u32, u32)) -> Vec<[u8; 3]> {
    let at = |x: u32, y: u32, c: f64| {
        let x = f64::from(x);
        let y = f64::from(y);
        (128.0 + 100.0 * (x / (11.0 + c) + y / (17.0 - c)).sin()).floor() as u8
    };
    (0..height).flat_map(|y| (0..width).map(move |x| [0.0, 1.0, 2.0].map(|c| at(x, y, c)))).collect()
}

#[test]
fn images_are_those_of_opencv() {
    for theirs in reference() {
        let own = theirs.rectifier();
        let n = (theirs.size.0 * theirs.size.1) as usize;
        let rgb = image(theirs.size);
        let yuyv: Vec<u8> =
            rgb.chunks(2).flat_map(|p| [p[0][0], p[0][1] / 4 + 96, p[1][0], p[0][2] / 4 + 96]).collect();
        let grey: Vec<u8> = rgb.iter().map(|p| p[0]).collect();
        let rgb = rgb.concat();
        for view in View::BOTH {
            let camera = &theirs.eyes[view as usize];
            let same = |what: &str, ours: &[u8], channels: usize| {
                let mut most = 0;
                for ((x, y, ..), want) in camera.map.iter().zip(&camera.pixels[what]) {
                    // At the outermost pixels `OpenCV` mixes in what lies outside of the image, which is black.
                    if *x == 0 || *y == 0 || *x == theirs.size.0 - 1 || *y == theirs.size.1 - 1 {
                        continue;
                    }
                    let at = (y * theirs.size.0 + x) as usize * channels;
                    for (a, b) in ours[at..at + channels].iter().zip(want) {
                        most = most.max(a.abs_diff(*b));
                    }
                }
                // It knows places to 1/32 pixel, this module to 1/256.
                assert!(most <= 2, "{} {view:?} {what}: {most} levels apart", theirs.name);
            };
            let mut one = vec![7; n];
            let mut three = vec![7; 3 * n];
            own.rectify(view, PixelFormat::Mono8, &grey, &mut one, None).unwrap();
            same("grey", &one, 1);
            own.rectify(view, PixelFormat::Rgb8, &rgb, &mut one, Some(&mut three)).unwrap();
            same("rgb", &three, 3);
            same("luma", &one, 1);
            own.rectify(view, PixelFormat::Yuyv, &yuyv, &mut one, Some(&mut three)).unwrap();
            same("yuyv", &three, 3);
            same("grey", &one, 1);
        }
    }
}

proptest! {
    /// A point that both cameras see lies in one row of both views, at the disparity of its depth: by the cameras' own
    /// projection, which knows nothing of rectification.
    #[test]
    fn points_have_one_row_and_the_disparity_of_their_depth(
        which in 0usize..3, u in 0.1f64..0.9, v in 0.05f64..0.95, z in 0.5f64..20.0,
    ) {
        static CAMERAS: LazyLock<Vec<(Theirs, Rectifier)>> =
            LazyLock::new(|| reference().into_iter().map(|t| (t.rectifier(), t)).map(|(r, t)| (t, r)).collect());
        let (theirs, own) = &CAMERAS[which];
        let k = *own.intrinsics();
        let at = DVec2::new(u * f64::from(theirs.size.0), v * f64::from(theirs.size.1)).round();
        let disparity = k.fx * own.baseline_m() / z;
        let p = DVec3::new((at.x - k.cx) / k.fx, (at.y - k.cy) / k.fy, 1.0) * z;
        let in_left = own.rotation(View::Left).transpose() * p;
        let in_right = theirs.right_in_left().to_affine().inverse().transform_point3(in_left);
        let left = Camera::new(&theirs.intrinsics(View::Left)).unwrap().project(in_left).unwrap();
        let seen = own.source(View::Left, at.x as u32, at.y as u32).unwrap();
        prop_assert!((left - DVec2::from(seen)).length() < 0.004);
        let x = at.x - disparity;
        prop_assume!(x >= 1.0);
        let right = Camera::new(&theirs.intrinsics(View::Right)).unwrap().project(in_right).unwrap();
        // Between the two pixels of the row, since the disparity is fractional.
        let a = x.floor() as u32;
        let b = x.floor() as u32 + 1;
        let a = own.source(View::Right, a, at.y as u32).unwrap();
        let b = own.source(View::Right, b, at.y as u32).unwrap();
        let between = DVec2::from(a).lerp(DVec2::from(b), x.fract());
        prop_assert!((right - between).length() < 0.006, "{right} is not {between}");
    }
}

#[test]
fn the_pose_of_the_left_view_is_a_rotation_alone() {
    let theirs = reference().remove(1);
    let own = theirs.rectifier();
    let pose = own.left_view_in_left();
    assert_eq!(pose.translation_m, [0.0; 3]);
    let turned = pose.transform_point(own.rotation(View::Left) * DVec3::new(0.1, -0.2, 1.0));
    assert!((turned - DVec3::new(0.1, -0.2, 1.0)).length() < 1e-9);
}

#[test]
fn invalid_stereo_cameras_are_refused() {
    let theirs = reference().remove(0);
    let left = theirs.intrinsics(View::Left);
    let right = theirs.intrinsics(View::Right);
    let pose = theirs.right_in_left();
    let size = theirs.size;
    let message = |left: &Intrinsics, pose: &Pose, size| {
        let e = Rectifier::new(left, &right, pose, size).unwrap_err();
        (e.kind(), e.to_string())
    };
    let said = |(kind, text): (ErrorKind, String), wanted: &str| {
        assert!(kind == ErrorKind::BadInput && text.contains(wanted), "{kind:?}: {text}");
    };
    said(message(&left, &pose.inverse(), size), "left and right are swapped: the right camera is 120.");
    let above = Pose { translation_m: [0.001, 0.12, 0.0], ..pose };
    said(message(&left, &above, size), "above each other");
    said(message(&left, &Pose::IDENTITY, size), "invalid baseline");
    said(message(&left, &pose, (1, 720)), "invalid stereo image size 1x720");
    said(message(&left, &pose, (1_000_000, 720)), "invalid stereo image size");
    assert_eq!(message(&Intrinsics::default(), &pose, size).0, ErrorKind::NoCalibration);
    let own = theirs.rectifier();
    let n = 1280 * 720;
    let refused = |format, bytes: usize, grey: usize, rgb: usize| {
        let mut grey = vec![0; grey];
        let mut rgb = vec![0; rgb];
        own.rectify(View::Left, format, &vec![0; bytes], &mut grey, Some(&mut rgb)).unwrap_err().kind()
    };
    for (bytes, grey, rgb) in [(100, n, 3 * n), (n, n - 1, 3 * n), (n, n, 3 * n + 1)] {
        assert_eq!(refused(PixelFormat::Mono8, bytes, grey, rgb), ErrorKind::SizeMismatch);
    }
    assert_eq!(refused(PixelFormat::Z16, 2 * n, n, 3 * n), ErrorKind::BadInput);
    let odd = Rectifier::new(&left, &right, &pose, (1279, 720)).unwrap();
    let n = 1279 * 720;
    let e = odd.rectify(View::Left, PixelFormat::Yuyv, &vec![0; n * 2], &mut vec![0; n], None).unwrap_err();
    assert!(e.to_string().contains("the width is odd"), "{e}");
    odd.rectify(View::Left, PixelFormat::Mono8, &vec![9; n], &mut vec![0; n], None).unwrap();
}
