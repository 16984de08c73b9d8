//! The solver against OpenCV on the corners of its sample images (`opencv_corners.py` writes the references).
#![allow(clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::Distortion;
use depthrig_calibrate::adjustment::{AdjustedCamera, Corner, INTRINSIC_PARAMETERS, Options};
use depthrig_calibrate::board::{Board, Pattern};
use depthrig_calibrate::detect::{GrayImage, detector};
use depthrig_calibrate::intrinsics::{ImageSize, IntrinsicsOptions, IntrinsicsResult, calibrate};
use depthrig_calibrate::rig::{RigCamera, RigOptions, RigView, Seen, calibrate_rig};
use glam::{DVec2, DVec3};
use serde::Deserialize;
use std::collections::BTreeMap;

const SIZE: ImageSize = ImageSize { width: 640, height: 480 };

#[derive(Deserialize)]
struct Reference {
    columns: usize,
    cameras: BTreeMap<String, OfCamera>,
    fixed: OfPair,
}

#[derive(Deserialize)]
struct OfCamera {
    corners: Vec<Vec<[f64; 2]>>,
    rms: f64,
    intrinsics: Vec<f64>,
    sigmas: Vec<f64>,
    without_k3: Vec<f64>,
}

#[derive(Deserialize)]
struct OfPair {
    rms: f64,
    rotation: [f64; 3],
    translation: [f64; 3],
}

fn reference() -> Reference {
    serde_json::from_str(include_str!("opencv_corners.json")).unwrap()
}

fn views(reference: &Reference, camera: &str) -> Vec<Vec<Corner>> {
    let corner = |(i, pixel): (usize, &[f64; 2])| Corner {
        point: DVec3::new((i % reference.columns) as f64, (i / reference.columns) as f64, 0.0),
        pixel: DVec2::from_array(*pixel),
    };
    let view = |v: &Vec<[f64; 2]>| v.iter().enumerate().map(corner).collect();
    reference.cameras[camera].corners.iter().map(view).collect()
}

fn solved(views: &[Vec<Corner>], free: [bool; INTRINSIC_PARAMETERS]) -> IntrinsicsResult {
    let options =
        IntrinsicsOptions { free: Some(free), reject_outliers: false, ..IntrinsicsOptions::default() };
    calibrate(SIZE, views, &options).unwrap()
}

fn numbers(found: &IntrinsicsResult) -> Vec<f64> {
    let k = found.camera.intrinsics;
    [&[k.fx, k.fy, k.cx, k.cy][..], &k.coeffs].concat()
}

#[test]
fn intrinsics_and_their_sigmas_are_those_of_opencv() {
    let reference = reference();
    for (name, camera) in &reference.cameras {
        let views = views(&reference, name);
        let all = AdjustedCamera::all_free(Distortion::BrownConrady);
        let found = solved(&views, all);
        assert!(
            (found.fit.solution.rms_px - camera.rms).abs() < 1e-5,
            "{name}: {}",
            found.fit.solution.rms_px
        );
        for (i, (ours, theirs)) in numbers(&found).iter().zip(&camera.intrinsics).enumerate() {
            let tolerance = if i < 4 { 1e-3 } else { 1e-4 };
            assert!((ours - theirs).abs() < tolerance, "{name}, parameter {i}: {ours}, OpenCV {theirs}");
        }
        for (i, (ours, theirs)) in found.sigmas().iter().zip(&camera.sigmas).enumerate() {
            assert!((ours / theirs - 1.0).abs() < 0.01, "{name}, sigma {i}: {ours}, OpenCV {theirs}");
        }

        let mut without_k3 = all;
        without_k3[8] = false;
        for (i, (ours, theirs)) in
            numbers(&solved(&views, without_k3)).iter().zip(&camera.without_k3).enumerate()
        {
            assert!((ours - theirs).abs() < 1e-3, "{name} without k3, {i}: {ours}, OpenCV {theirs}");
        }
    }
}

fn pair(reference: &Reference, free: [bool; INTRINSIC_PARAMETERS]) -> depthrig_calibrate::rig::RigResult {
    let each = ["left", "right"].map(|name| views(reference, name));
    let cameras: Vec<RigCamera> = ["left", "right"]
        .iter()
        .zip(&each)
        .map(|(name, views)| RigCamera {
            name: (*name).to_owned(),
            intrinsics: solved(views, AdjustedCamera::all_free(Distortion::BrownConrady)).camera.intrinsics,
            free_intrinsics: free,
        })
        .collect();
    let rig_views: Vec<RigView> = (0..each[0].len())
        .map(|i| RigView {
            name: i.to_string(),
            seen: each.iter().enumerate().map(|(camera, v)| Seen { camera, corners: v[i].clone() }).collect(),
        })
        .collect();
    calibrate_rig(&cameras, &rig_views, &RigOptions { free_warp: false, reject_outliers: false }).unwrap()
}

#[test]
fn a_stereo_pair_is_that_of_opencv() {
    let reference = reference();
    let found = pair(&reference, [false; INTRINSIC_PARAMETERS]);
    let pose = found.cameras[1].camera_from_rig;
    // OpenCV counts both cameras' corners.
    assert!((found.fit.solution.rms_px - reference.fixed.rms).abs() < 1e-5, "{}", found.fit.solution.rms_px);
    assert!((pose.translation - DVec3::from_array(reference.fixed.translation)).length() < 1e-4, "{pose:?}");
    assert!(
        (pose.rotation_vector() - DVec3::from_array(reference.fixed.rotation)).length() < 1e-5,
        "{pose:?}"
    );
}

/// OpenCV 4.12 ends at 0.21528, before the optimum; two other solvers and OpenCV 5 end at 0.215046.
#[test]
fn a_stereo_pair_with_its_intrinsics_is_that_of_other_solvers() {
    let found = pair(&reference(), AdjustedCamera::all_free(Distortion::BrownConrady));
    let translation = found.cameras[1].camera_from_rig.translation;
    assert!((found.fit.solution.rms_px - 0.215_046).abs() < 2e-6, "{}", found.fit.solution.rms_px);
    assert!((translation - DVec3::new(-3.32705, 0.03679, -0.00472)).length() < 1e-4, "{translation}");
    assert!((found.cameras[0].intrinsics.fx - 533.4167).abs() < 2e-3);
}

#[test]
fn fewer_measurements_than_unknowns_are_refused() {
    let reference = reference();
    let few: Vec<Vec<Corner>> =
        views(&reference, "left").iter().take(3).map(|v| [v[0], v[8], v[45], v[53]].to_vec()).collect();
    let options = IntrinsicsOptions {
        free: Some(AdjustedCamera::all_free(Distortion::BrownConrady)),
        ..IntrinsicsOptions::default()
    };
    let message = calibrate(SIZE, &few, &options).unwrap_err().to_string();
    assert!(message.contains("take more views"), "{message}");
    assert!(Options::default().huber_px.is_none());
}

#[derive(Deserialize)]
struct Charuco {
    corners: BTreeMap<usize, [f64; 2]>,
    truth: Vec<[f64; 2]>,
}

#[test]
fn a_charuco_board_that_opencv_drew_is_found_as_opencv_finds_it_and_more_exactly() {
    let theirs: Charuco = serde_json::from_str(include_str!("opencv_charuco.json")).unwrap();
    let image = image::load_from_memory(include_bytes!("opencv_charuco.png")).unwrap().to_luma8();
    let board = Board {
        pattern: Pattern::Charuco,
        columns: 11,
        rows: 8,
        square_mm: 30.0,
        marker_mm: Some(22.0),
        dictionary: Some("DICT_4X4_50".to_owned()),
        ruler_mm: 100.0,
        measured_ruler_mm: None,
    };
    let found = detector(&board).unwrap().detect(&GrayImage::new(640, 480, image.as_raw()).unwrap());
    let ours: BTreeMap<usize, DVec2> = found.corners.iter().map(|c| (c.id, c.pixel)).collect();
    // Something covers a part of the board.
    assert!(theirs.corners.len() < board.corner_count());
    let both: Vec<usize> = theirs.corners.keys().filter(|id| ours.contains_key(id)).copied().collect();
    assert!(both.len() * 100 >= theirs.corners.len() * 95, "{} of {}", both.len(), theirs.corners.len());
    let median = |places: &dyn Fn(usize) -> DVec2| {
        let mut errors: Vec<f64> =
            both.iter().map(|id| (places(*id) - DVec2::from_array(theirs.truth[*id])).length()).collect();
        errors.sort_by(f64::total_cmp);
        assert!(errors[errors.len() - 1] < 1.0, "a corner has another's number");
        errors[errors.len() / 2]
    };
    let our_error = median(&|id| ours[&id]);
    let their_error = median(&|id| DVec2::from_array(theirs.corners[&id]));
    println!("median error {our_error:.3} px, OpenCV's {their_error:.3} px");
    assert!(our_error < 0.1 && our_error <= their_error, "{our_error} px, OpenCV's {their_error} px");
}
