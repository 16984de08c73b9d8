//! Seven cameras whose poses are known: the calibration finds them, and its uncertainty is honest.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{Random, mount, mount_cameras, mount_views};
use depthrig_calibrate::Rigid;
use depthrig_calibrate::rig::{RigOptions, RigResult, calibrate_rig};

fn calibrated(truth: &[Rigid], count: usize, random: &mut Random) -> RigResult {
    calibrate_rig(&mount_cameras(), &mount_views(truth, count, random), &RigOptions::default()).unwrap()
}

#[test]
fn poses_are_found_and_three_sigma_cover_the_truth() {
    let truth = mount();
    let seeds = 100;
    let mut covered = 0;
    let mut total = 0;
    let mut sum = 0.0;
    for seed in 0..seeds {
        let found = calibrated(&truth, 20, &mut Random(seed));
        for (i, (camera, truth)) in found.cameras.iter().zip(&truth).enumerate().skip(1) {
            let error = camera.camera_from_rig.distance(truth);
            assert!(
                error.metres < 0.5e-3 && error.radians < 0.03_f64.to_radians(),
                "seed {seed}, camera {i}: {error:?}"
            );
            // Moved by how much, in the terms of the covariance.
            let between = camera.camera_from_rig.after(&truth.inverse());
            let rotation = between.rotation_vector();
            let covariance = found.fit.solution.covariance.pose(i);
            let moved = nalgebra::Vector6::from([
                rotation.x,
                rotation.y,
                rotation.z,
                between.translation.x,
                between.translation.y,
                between.translation.z,
            ]);
            let mahalanobis = moved.dot(&(covariance.try_inverse().unwrap() * moved));
            // 3 sigma of six coordinates together: the 99.73 % quantile of chi-squared with 6 degrees of freedom.
            covered += usize::from(mahalanobis < 20.06);
            sum += mahalanobis;
            total += 1;
        }
    }
    assert!(covered as f64 >= 0.95 * f64::from(total), "{covered} of {total}");
    // An uncertainty that is too large would pass the line above: the mean of chi-squared is 6.
    let mean = sum / f64::from(total);
    println!("{covered} of {total} within 3 sigma, mean {mean:.2}");
    assert!((5.0..7.5).contains(&mean), "mean of chi-squared {mean}");
}

#[test]
fn cameras_that_share_no_view_are_named_in_their_groups() {
    let truth = mount();
    let mut views = mount_views(&truth, 12, &mut Random(1));
    // The board is never seen by one of the first three and one of the last four at once.
    for (i, view) in views.iter_mut().enumerate() {
        view.seen.retain(|s| (s.camera < 3) == (i % 2 == 0));
    }
    views.retain(|v| v.seen.len() >= 2);
    let message = calibrate_rig(&mount_cameras(), &views, &RigOptions::default()).unwrap_err().to_string();
    assert!(message.contains("[cam0, cam1, cam2] and [cam3, cam4, cam5, cam6]"), "{message}");
}

#[test]
fn a_camera_that_was_moved_during_the_capture_shows_in_the_outliers() {
    let truth = mount();
    let mut random = Random(5);
    let mut all = mount_views(&truth, 20, &mut random);
    let mut wrong = 0;
    for view in all.iter_mut().take(2) {
        for corner in view.seen.iter_mut().filter(|s| s.camera == 3).flat_map(|s| &mut s.corners) {
            corner.pixel.x += 4.0;
            wrong += 1;
        }
    }
    assert!(wrong > 50);
    let found = calibrate_rig(&mount_cameras(), &all, &RigOptions::default()).unwrap();
    assert!(found.fit.outliers.len() >= wrong * 9 / 10, "{} of {wrong}", found.fit.outliers.len());
    let error = found.cameras[3].camera_from_rig.distance(&truth[3]);
    assert!(error.metres < 0.5e-3, "{error:?}");
}

#[test]
fn corners_of_wrong_squares_are_left_out() {
    let truth = mount();
    let mut random = Random(9);
    let mut all = mount_views(&truth, 20, &mut random);
    for view in &mut all {
        for seen in &mut view.seen {
            seen.corners[5].pixel += glam::DVec2::new(15.0, -8.0);
        }
    }
    let found = calibrate_rig(&mount_cameras(), &all, &RigOptions::default()).unwrap();
    let sightings: usize = all.iter().map(|v| v.seen.len()).sum();
    assert!(found.fit.outliers.len() >= sightings, "{} of {sightings}", found.fit.outliers.len());
    assert!(found.fit.outliers.len() <= sightings + 20);
    for (camera, truth) in found.cameras.iter().zip(&truth) {
        assert!(camera.camera_from_rig.distance(truth).metres < 0.5e-3);
    }
}
