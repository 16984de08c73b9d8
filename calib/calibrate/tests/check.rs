//! A camera of the mount that was bumped is found, and one that was not is left alone.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{Random, mount, mount_cameras, mount_views};
use depthrig_calibrate::Rigid;
use depthrig_calibrate::check::{KnownCamera, check};
use depthrig_calibrate::rig::{RigOptions, calibrate_rig};
use glam::{DQuat, DVec3};

/// The mount as a calibration from twenty views finds it.
fn calibrated(seed: u64) -> Vec<KnownCamera> {
    let truth = mount();
    let found =
        calibrate_rig(&mount_cameras(), &mount_views(&truth, 20, &mut Random(seed)), &RigOptions::default())
            .unwrap();
    found
        .cameras
        .iter()
        .enumerate()
        .map(|(i, camera)| KnownCamera {
            name: format!("cam{i}"),
            intrinsics: camera.intrinsics,
            rig_from_camera: camera.camera_from_rig.inverse(),
            covariance: found.fit.solution.covariance.pose(i),
        })
        .collect()
}

/// A direction.
fn unit(random: &mut Random) -> DVec3 {
    random.normal3(1.0).normalize()
}

#[test]
fn a_bumped_camera_is_found_and_false_alarms_are_rare() {
    let trials = 100;
    let mut false_alarms = 0;
    let mut found = 0;
    let mut wrong = 0;
    for seed in 0..trials {
        let known = calibrated(seed);
        let mut random = Random(10_000 + seed);
        let quiet = check(&known, &mount_views(&mount(), 8, &mut random)).unwrap();
        false_alarms += usize::from(!quiet.moved.is_empty());

        // By 2 mm, or by 0.2 degrees; every camera has its turn, the reference too.
        let bumped = seed as usize % 7;
        let mut now = mount();
        let camera = now[bumped];
        now[bumped] = if seed % 2 == 0 {
            Rigid { translation: camera.translation + unit(&mut random) * 2e-3, ..camera }
        } else {
            let by = DQuat::from_axis_angle(unit(&mut random), 0.2_f64.to_radians());
            Rigid { rotation: (by * camera.rotation).normalize(), translation: by * camera.translation }
        };
        let checked = check(&known, &mount_views(&now, 8, &mut random)).unwrap();
        match checked.moved.first() {
            Some(motion) if motion.camera == bumped => {
                found += 1;
                if seed % 2 == 0 {
                    assert!(
                        (motion.by.metres - 2e-3).abs() < 5.0 * motion.sigma.metres.max(1e-4),
                        "{motion:?}"
                    );
                }
            }
            Some(_) => wrong += 1,
            None => {}
        }
    }
    println!("found {found} of {trials}, {wrong} times another camera, {false_alarms} false alarms");
    assert!(found >= 99, "found {found} of {trials}, {wrong} times another camera");
    assert!(false_alarms <= 1, "{false_alarms} false alarms in {trials}");
}

#[test]
fn two_bumped_cameras_are_both_found() {
    let known = calibrated(1);
    let mut now = mount();
    now[2].translation.x += 3e-3;
    now[5].translation.y -= 4e-3;
    let checked = check(&known, &mount_views(&now, 8, &mut Random(77))).unwrap();
    let mut cameras: Vec<usize> = checked.moved.iter().map(|m| m.camera).collect();
    cameras.sort_unstable();
    assert_eq!(cameras, [2, 5]);
    assert_eq!(checked.unmoved.len(), 5);
}

#[test]
fn a_camera_that_sees_the_board_alone_is_named_as_unchecked() {
    let known = calibrated(1);
    let mut views = mount_views(&mount(), 6, &mut Random(3));
    for view in &mut views {
        view.seen.retain(|s| s.camera != 6);
    }
    assert_eq!(check(&known, &views).unwrap().unchecked, [6]);
    for view in &mut views {
        view.seen.truncate(1);
    }
    let message = check(&known, &views).unwrap_err().to_string();
    assert!(message.contains("two cameras at once"), "{message}");
}
