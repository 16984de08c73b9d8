//! Uncertainty of projection against mrcal, whose definition it is (`mrcal_uncertainty.py` writes the reference).
#![allow(clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::Distortion;
use depthrig_calibrate::adjustment::{AdjustedCamera, Corner};
use depthrig_calibrate::intrinsics::{ImageSize, IntrinsicsOptions, calibrate};
use depthrig_calibrate::uncertainty::{Sample, projection_sigma};
use glam::{DVec2, DVec3};
use serde::Deserialize;
use std::collections::BTreeMap;

#[derive(Deserialize)]
struct Corners {
    cameras: BTreeMap<String, OfCamera>,
}

#[derive(Deserialize)]
struct OfCamera {
    corners: Vec<Vec<[f64; 2]>>,
}

#[derive(Deserialize)]
struct Mrcal {
    intrinsics: Vec<f64>,
    sigma_px: f64,
    samples: Vec<MrcalSample>,
}

#[derive(Deserialize)]
struct MrcalSample {
    pixel: [f64; 2],
    distance: Option<f64>,
    sigma_px: f64,
}

#[test]
fn uncertainty_of_projection_is_that_of_mrcal() {
    let corners: Corners = serde_json::from_str(include_str!("opencv_corners.json")).unwrap();
    let mrcal: BTreeMap<String, Mrcal> =
        serde_json::from_str(include_str!("mrcal_uncertainty.json")).unwrap();
    for (name, reference) in &mrcal {
        let corner = |(i, pixel): (usize, &[f64; 2])| Corner {
            point: DVec3::new((i % 9) as f64, (i / 9) as f64, 0.0),
            pixel: DVec2::from_array(*pixel),
        };
        let views: Vec<Vec<Corner>> = corners.cameras[name]
            .corners
            .iter()
            .map(|v| v.iter().enumerate().map(corner).collect())
            .collect();
        let options = IntrinsicsOptions {
            model: Distortion::BrownConrady,
            free: Some(AdjustedCamera::all_free(Distortion::BrownConrady)),
            reject_outliers: false,
            start: None,
        };
        let found = calibrate(ImageSize { width: 640, height: 480 }, &views, &options).unwrap();
        let k = found.camera.intrinsics;
        for (ours, theirs) in [k.fx, k.fy, k.cx, k.cy].iter().zip(&reference.intrinsics) {
            assert!((ours - theirs).abs() < 1e-3, "{name}: {ours}, mrcal {theirs}");
        }
        // mrcal divides the squares by the number of measurements, this by what unknowns leave of them.
        let solution = &found.fit.solution;
        let degrees = reference.sigma_px / solution.sigma_px;
        assert!((0.9..1.0).contains(&degrees), "{name}: {degrees}");
        let all: Vec<usize> = (0..views.len()).collect();
        for sample in &reference.samples {
            let at =
                Sample { pixel: DVec2::from_array(sample.pixel), distance_m: sample.distance.unwrap_or(1e7) };
            let ours =
                projection_sigma(&found.camera, 0, &found.camera_from_board, &all, &solution.covariance, at)
                    .unwrap()
                    .unwrap();
            let ratio = ours * degrees / sample.sigma_px;
            assert!((ratio - 1.0).abs() < 0.01, "{name}, {at:?}: {ours}, mrcal {}", sample.sigma_px);
        }
    }
}
