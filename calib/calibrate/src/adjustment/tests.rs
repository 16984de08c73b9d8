use super::*;
use crate::adjustment::evaluate::Evaluation;
use glam::DQuat;
use proptest::prelude::*;

/// Two cameras and three views of a bent board, not at the optimum.
fn problem(model: Distortion) -> Problem {
    let intrinsics = |f: f64| Intrinsics {
        model: model as u32,
        coeffs: [-0.1, 0.03, 0.001, -0.002, 0.01, 0.0, 0.0, 0.0],
        ..Intrinsics::pinhole(f, f * 1.01, 320.0, 240.0)
    };
    let turned = |v: DVec3| DQuat::from_scaled_axis(v);
    let camera = |f, free_pose, translation| AdjustedCamera {
        intrinsics: intrinsics(f),
        camera_from_rig: Rigid { rotation: turned(DVec3::new(0.05, -0.1, 0.02)), translation },
        free_intrinsics: AdjustedCamera::all_free(model),
        free_pose,
    };
    let mut problem = Problem {
        cameras: vec![camera(500.0, false, DVec3::ZERO), camera(450.0, true, DVec3::new(-0.1, 0.02, 0.03))],
        rig_from_board: (0..3)
            .map(|i| Rigid {
                rotation: turned(DVec3::new(0.3 * f64::from(i) - 0.3, 0.2, 0.1 * f64::from(i))),
                translation: DVec3::new(-0.2, -0.15, 0.8 + 0.1 * f64::from(i)),
            })
            .collect(),
        warp: Warp { x_m: 0.002, y_m: -0.001 },
        free_warp: true,
        sightings: Vec::new(),
    };
    for view in 0..3 {
        for camera in 0..2 {
            let corners = (0..20)
                .map(|i| {
                    let point = DVec3::new(f64::from(i % 5) * 0.1, f64::from(i / 5) * 0.1, 0.0);
                    let pose = problem.cameras[camera].camera_from_rig.after(&problem.rig_from_board[view]);
                    let lens = depthrig_calib::Camera::new(&problem.cameras[camera].intrinsics).unwrap();
                    let pixel = lens.project(pose.transform(point)).unwrap();
                    Corner { point, pixel: pixel + DVec2::new(f64::from(i % 3) - 1.0, f64::from(i % 2)) }
                })
                .collect();
            problem.sightings.push(Sighting { camera, view, corners });
        }
    }
    problem
}

/// The slope of the cost along a random direction is that of the gradient, and half the Hessian along it is that of the matrix up to
/// the residuals' own curvature, which is small.
fn slope_along(problem: &Problem, seed: u64) -> [f64; 2] {
    let layout = Layout::new(problem);
    let mut state = seed;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1u32 << 31) - 0.5
    };
    let direction = normal::Step {
        shared: nalgebra::DVector::from_fn(layout.shared, |_, _| random() * 1e-3),
        views: (0..3).map(|_| nalgebra::Vector6::from_fn(|_, _| random() * 1e-4)).collect(),
    };
    let cost = |by: f64| {
        let scaled = normal::Step {
            shared: &direction.shared * by,
            views: direction.views.iter().map(|v| v * by).collect(),
        };
        Evaluation::new(&problem.moved(&layout, &scaled), None).unwrap().cost
    };
    let numeric = (cost(0.01) - cost(-0.01)) / 0.02;
    [numeric, 2.0 * Normal::new(problem, &layout, None).slope(&direction)]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn the_gradient_is_the_slope_of_the_cost(seed in any::<u64>()) {
        for model in [Distortion::BrownConrady, Distortion::Rational, Distortion::KannalaBrandt4, Distortion::InverseBrownConrady] {
            let [numeric, analytic] = slope_along(&problem(model), seed);
            prop_assert!((numeric - analytic).abs() < 1e-5 * (1.0 + numeric.abs()), "{model:?}: {numeric} {analytic}");
        }
    }
}

#[test]
fn a_board_seen_from_the_front_only_is_refused_by_name() {
    // Focal length and distance cannot be told apart.
    let mut problem = problem(Distortion::None);
    for pose in &mut problem.rig_from_board {
        pose.rotation = DQuat::IDENTITY;
    }
    problem.cameras[1].free_intrinsics = [false; INTRINSIC_PARAMETERS];
    problem.cameras[1].free_pose = false;
    problem.sightings.retain(|s| s.camera == 0);
    problem.cameras[0].camera_from_rig = Rigid::IDENTITY;
    problem.free_warp = false;
    problem.warp = Warp::default();
    let lens = depthrig_calib::Camera::new(&problem.cameras[0].intrinsics).unwrap();
    for sighting in &mut problem.sightings {
        for corner in &mut sighting.corners {
            corner.pixel =
                lens.project(problem.rig_from_board[sighting.view].transform(corner.point)).unwrap();
        }
    }
    let result = problem.solve(&Options::default());
    // Exact corners: either the matrix is singular, or the standard deviation would be infinite.
    match result {
        Err(e) => assert!(e.to_string().contains("do not determine"), "{e}"),
        Ok(s) => panic!("{:?}", s.covariance.intrinsic_sigmas(0, &problem.cameras[0].free_intrinsics)),
    }
}
