//! Hand-eye calibration of simulated robots.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{Random, charuco, intrinsics, seen};
use depthrig_calibrate::Rigid;
use depthrig_calibrate::board::Board;
use depthrig_calibrate::hand_eye::{Arrangement, HandEyeView, Noise, hand_eye};
use glam::{DQuat, DVec3};

struct Setup {
    camera: Rigid,
    board: Rigid,
}

/// The camera 6 cm from the flange, the board half a metre ahead of the robot; or the camera beside the robot and the board on the hand.
fn setup(arrangement: Arrangement) -> Setup {
    match arrangement {
        Arrangement::EyeInHand => Setup {
            camera: Rigid {
                rotation: DQuat::from_rotation_z(0.3),
                translation: DVec3::new(0.05, -0.02, 0.06),
            },
            board: Rigid { rotation: DQuat::from_rotation_z(0.1), translation: DVec3::new(0.35, -0.12, 0.0) },
        },
        Arrangement::EyeToHand => Setup {
            camera: Rigid {
                rotation: DQuat::from_rotation_y(0.4) * DQuat::from_rotation_x(0.2),
                translation: DVec3::new(-0.3, 0.1, -0.4),
            },
            board: Rigid {
                rotation: DQuat::from_rotation_z(-0.2),
                translation: DVec3::new(-0.16, -0.12, 0.03),
            },
        },
    }
}

/// Views at poses of the robot in which the board is in front of the camera, half a metre away, tilted by `tilts`.
fn views(
    arrangement: Arrangement,
    count: usize,
    corner_px: f64,
    robot: [f64; 2],
    random: &mut Random,
    one_axis: bool,
) -> Vec<HandEyeView> {
    let board = Board { square_mm: 25.0, marker_mm: Some(18.0), ..charuco() };
    let k = intrinsics(600.0);
    let setup = setup(arrangement);
    (0..count)
        .map(|i| {
            let tilt = if one_axis {
                DVec3::new(0.0, 0.0, random.between(-0.6, 0.6))
            } else {
                DVec3::new(random.between(-0.7, 0.7), random.between(-0.7, 0.7), random.between(-1.5, 1.5))
            };
            // To look aside is to turn as well.
            let aside = if one_axis { 0.0 } else { 0.05 };
            let at = DVec3::new(
                random.between(-aside, aside),
                random.between(-aside, aside),
                random.between(0.35, 0.6),
            );
            let camera_from_board = common::board_at(&board, at, tilt);
            // board = motion · camera · camera_from_board.
            let motion = setup.board.after(&setup.camera.after(&camera_from_board).inverse());
            let exact = if arrangement == Arrangement::EyeInHand { motion } else { motion.inverse() };
            let base_from_hand = Rigid {
                rotation: (DQuat::from_scaled_axis(random.normal3(robot[1])) * exact.rotation).normalize(),
                translation: exact.translation + random.normal3(robot[0]),
            };
            let corners = seen(&board, &k, &camera_from_board, corner_px, random);
            HandEyeView { name: i.to_string(), base_from_hand, corners }
        })
        .collect()
}

#[test]
fn the_camera_is_found_where_it_is_with_a_robot_that_has_noise() {
    for arrangement in [Arrangement::EyeInHand, Arrangement::EyeToHand] {
        let noise = Noise { corner_px: 0.2, robot_m: 0.1e-3, robot_rad: 0.02_f64.to_radians() };
        let mut metres = Vec::new();
        let mut radians = Vec::new();
        let mut covered = 0;
        let seeds = 60;
        for seed in 0..seeds {
            let views = views(
                arrangement,
                15,
                noise.corner_px,
                [noise.robot_m, noise.robot_rad],
                &mut Random(seed),
                false,
            );
            let found = hand_eye(arrangement, &intrinsics(600.0), &views, &noise).unwrap();
            let truth = setup(arrangement).camera;
            let error = found.camera.distance(&truth);
            metres.push(error.metres);
            radians.push(error.radians);
            let between = found.camera.after(&truth.inverse());
            let r = between.rotation_vector();
            let t = between.translation;
            let moved = nalgebra::Vector6::from([r.x, r.y, r.z, t.x, t.y, t.z]);
            covered += usize::from(moved.dot(&(found.covariance.try_inverse().unwrap() * moved)) < 20.06);
        }
        metres.sort_by(f64::total_cmp);
        radians.sort_by(f64::total_cmp);
        let median = metres[metres.len() / 2] * 1e3;
        let degrees = radians[radians.len() / 2].to_degrees();
        println!(
            "{arrangement:?}: median {median:.3} mm, {degrees:.4} degrees, {covered} of {seeds} within 3 sigma"
        );
        assert!(median <= 0.25, "{arrangement:?}: {median} mm");
        assert!(degrees <= 0.025, "{arrangement:?}: {degrees} degrees");
        assert!(covered * 100 >= seeds as usize * 95, "{arrangement:?}: {covered} of {seeds}");
    }
}

#[test]
fn an_exact_robot_gives_an_exact_camera() {
    let noise = Noise { corner_px: 1e-3, robot_m: 1e-6, robot_rad: 1e-6 };
    for arrangement in [Arrangement::EyeInHand, Arrangement::EyeToHand] {
        let views = views(arrangement, 8, 0.0, [0.0, 0.0], &mut Random(3), false);
        let found = hand_eye(arrangement, &intrinsics(600.0), &views, &noise).unwrap();
        let error = found.camera.distance(&setup(arrangement).camera);
        assert!(error.metres < 1e-7 && error.radians < 1e-7, "{arrangement:?}: {error:?}");
    }
}

#[test]
fn motions_that_leave_something_open_are_refused_with_what_is_missing() {
    let noise = Noise { corner_px: 0.2, robot_m: 0.1e-3, robot_rad: 0.0003 };
    let one_axis = views(Arrangement::EyeInHand, 10, 0.0, [0.0, 0.0], &mut Random(1), true);
    let few = views(Arrangement::EyeInHand, 2, 0.0, [0.0, 0.0], &mut Random(1), false);
    let still: Vec<HandEyeView> = (0..5).map(|_| few[0].clone()).collect();
    let message = |views: &[HandEyeView]| {
        hand_eye(Arrangement::EyeInHand, &intrinsics(600.0), views, &noise).unwrap_err().to_string()
    };
    assert!(message(&few).contains("three or more"), "{}", message(&few));
    assert!(message(&still).contains("turn it by 20 degrees"), "{}", message(&still));
    assert!(message(&one_axis).contains("one axis only"), "{}", message(&one_axis));
}

#[test]
fn poses_that_do_not_belong_to_their_views_are_refused_with_what_is_wrong() {
    let noise = Noise { corner_px: 0.2, robot_m: 0.2e-3, robot_rad: 0.001 };
    for arrangement in [Arrangement::EyeInHand, Arrangement::EyeToHand] {
        let good = views(arrangement, 12, 0.2, [0.2e-3, 0.001], &mut Random(5), false);
        let other = match arrangement {
            Arrangement::EyeInHand => Arrangement::EyeToHand,
            Arrangement::EyeToHand => Arrangement::EyeInHand,
        };
        let message = |arrangement, poses: &dyn Fn(usize) -> Option<Rigid>| {
            let views: Vec<HandEyeView> = (0..12)
                .filter_map(|i| {
                    poses(i).map(|base_from_hand| HandEyeView { base_from_hand, ..good[i].clone() })
                })
                .collect();
            hand_eye(arrangement, &intrinsics(600.0), &views, &noise).map(|_| ()).map_err(|e| e.to_string())
        };
        let pose = |i: usize| good.get(i).map(|v| v.base_from_hand);
        assert_eq!(message(arrangement, &pose), Ok(()));
        let said = |poses: &dyn Fn(usize) -> Option<Rigid>| message(arrangement, poses).unwrap_err();
        let text = message(other, &pose).unwrap_err();
        assert!(text.contains("--eye-to-hand"), "{text}");
        let text = said(&|i| pose(i).map(|p| p.inverse()));
        assert!(text.contains("inverted"), "{text}");
        let text = said(&|i| pose(i + 1));
        assert!(text.contains("to the view after it"), "{text}");
        let text = said(&|i| i.checked_sub(1).and_then(pose));
        assert!(text.contains("to the view before it"), "{text}");
        let text = said(&|i| pose((5 * i + 3) % 12));
        assert!(text.contains("which pose belongs to which view"), "{text}");
    }
}
