//! Derivatives against differences, and the arrow-shaped system against a dense one.

use super::arrow::{Arrow, Parts};
use super::so3::{exp, log, right_jacobian, right_jacobian_inverse};
use super::spline::{ORDER, Segment, Trajectory, moved};
use super::state::{Fit, FitCamera, Frame};
use crate::Rigid;
use crate::adjustment::Corner;
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::Camera;
use glam::{DQuat, DVec2, DVec3};
use nalgebra::{DMatrix, DVector, Matrix6};

/// Random numbers that are the same on each run (`splitmix64`).
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
    }

    fn vector(&mut self, size: f64) -> DVec3 {
        DVec3::new(self.uniform(), self.uniform(), self.uniform()) * size
    }
}

fn trajectory(random: &mut Random) -> Trajectory {
    let spans = 6;
    let controls = (0..spans + ORDER - 1)
        .map(|_| Rigid { rotation: exp(random.vector(1.2)), translation: random.vector(0.2) + DVec3::Z })
        .collect();
    Trajectory { knot_s: 0.1, segments: vec![Segment { start_s: 3.0, first: 0, spans }], controls }
}

fn near(a: DVec3, b: DVec3, tolerance: f64, what: &str) {
    assert!((a - b).length() < tolerance * (1.0 + b.length()), "{what}: {a} is not {b}");
}

#[test]
fn jacobians_of_rotations_are_their_differences() {
    let mut random = Random(1);
    for size in [1e-9, 1e-4, 0.9e-3, 1.1e-3, 0.3, 3.0, 5.0] {
        let v = random.vector(size);
        let step = random.vector(1e-6);
        let by_exp = log(exp(v).conjugate() * exp(v + step));
        near(by_exp, right_jacobian(v) * step, 1e-10, "right Jacobian");
        let by_log = log(exp(v) * exp(step)) - v;
        near(by_log, right_jacobian_inverse(v) * step, 1e-10, "its inverse");
        let from_left = log(exp(step) * exp(v)) - v;
        near(from_left, right_jacobian_inverse(v).transpose() * step, 1e-10, "from the left");
    }
}

#[test]
fn a_sample_has_the_derivatives_of_its_pose() {
    let mut random = Random(2);
    let base = trajectory(&mut random);
    let step = 1e-6;
    for time_s in [2.95, 3.0, 3.123, 3.2, 3.57, 3.64] {
        let at = base.sample(0, time_s);
        let before = base.sample(0, time_s - step).rig_from_board;
        let after = base.sample(0, time_s + step).rig_from_board;
        let turned = log(before.rotation.conjugate() * after.rotation) / (2.0 * step);
        near(turned, at.angular, 1e-6, "angular velocity");
        near((after.translation - before.translation) / (2.0 * step), at.linear, 1e-6, "velocity");
        for i in 0..ORDER {
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let sample = |by: f64| {
                    let mut other = base.clone();
                    let control = &mut other.controls[at.first + i];
                    *control = moved(control, axis * by, axis * by);
                    other.sample(0, time_s).rig_from_board
                };
                let low = sample(-step);
                let high = sample(step);
                let turned = log(low.rotation.conjugate() * high.rotation) / (2.0 * step);
                near(turned, at.by_rotation[i] * axis, 1e-7, "rotation by a control pose");
                let shifted = (high.translation - low.translation) / (2.0 * step);
                near(shifted, axis * at.by_place[i], 1e-7, "place by a control pose");
            }
        }
    }
}

#[test]
fn a_trajectory_is_smooth_across_knots() {
    let mut random = Random(3);
    let trajectory = trajectory(&mut random);
    for knot in 1..6 {
        let time_s = 3.0 + 0.1 * f64::from(knot);
        let before = trajectory.sample(0, time_s - 1e-9);
        let after = trajectory.sample(0, time_s + 1e-9);
        near(after.angular, before.angular, 1e-5, "angular velocity");
        near(after.linear, before.linear, 1e-5, "velocity");
        near(after.rig_from_board.translation, before.rig_from_board.translation, 1e-7, "place");
    }
}

/// Two cameras, one of them free with a prior, whose corners do not fit.
fn fit(huber_px: f64) -> Fit {
    let mut random = Random(4);
    let lens = |focal: f64| {
        let intrinsics = Intrinsics {
            model: Distortion::BrownConrady as u32,
            coeffs: [0.1, -0.2, 0.001, -0.001, 0.0, 0.0, 0.0, 0.0],
            ..Intrinsics::pinhole(focal, focal, 320.0, 240.0)
        };
        Camera::new(&intrinsics).unwrap()
    };
    let place = Rigid { rotation: DQuat::from_rotation_y(0.1), translation: DVec3::new(-0.1, 0.0, 0.05) };
    let covariance = Matrix6::from_fn(|i, j| if i == j { 1e-6 * (1.0 + i as f64) } else { 1e-7 });
    let camera = |information: Option<Matrix6<f64>>, is_free: bool| FitCamera {
        lens: lens(500.0),
        camera_from_rig: if is_free {
            place.moved(DVec3::splat(1e-3), DVec3::splat(2e-3))
        } else {
            Rigid::IDENTITY
        },
        calibrated: if is_free { place } else { Rigid::IDENTITY },
        information,
        latency_s: if is_free { 0.012 } else { 0.0 },
        is_free,
    };
    let cameras = vec![camera(None, false), camera(covariance.try_inverse(), true)];
    let trajectory = trajectory(&mut random);
    let frames = (0..12)
        .map(|i| Frame {
            camera: i % 2,
            segment: 0,
            time_s: 3.01 + 0.05 * i as f64,
            corners: (0..9)
                .map(|c| Corner {
                    point: DVec3::new(0.03 * f64::from(c % 3), 0.03 * f64::from(c / 3), 0.0),
                    pixel: DVec2::new(320.0 + 60.0 * random.uniform(), 240.0 + 60.0 * random.uniform()),
                })
                .collect(),
        })
        .collect();
    Fit { trajectory, cameras, frames, huber_px, noise_px: 0.3 }
}

/// The slope of the cost as the system has it equals differences of the cost, for every unknown.
#[test]
fn the_slope_of_the_cost_is_its_difference() {
    for huber_px in [1e6, 20.0] {
        let fit = fit(huber_px);
        let (_, slope) = fit.system();
        let zero = Parts { band: slope.band.clone() * 0.0, corner: slope.corner.clone() * 0.0 };
        let check = |name: &str, i: usize, stated: f64, step: f64, set: &dyn Fn(&mut Parts, f64)| {
            let cost = |by: f64| {
                let mut parts = zero.clone();
                set(&mut parts, by);
                fit.moved(&parts).cost()
            };
            let numeric = (cost(step) - cost(-step)) / (4.0 * step);
            let tolerance = 1e-4 * (numeric.abs() + slope.band.amax() * 1e-3);
            assert!((numeric - stated).abs() < tolerance, "{name} {i}: {stated} is not {numeric}");
        };
        for i in 0..slope.band.len() {
            check("trajectory", i, slope.band[i], 1e-6, &|parts, by| parts.band[i] = by);
        }
        assert_eq!(slope.corner.len(), 7);
        for i in 0..slope.corner.len() {
            check("camera", i, slope.corner[i], 1e-6, &|parts, by| parts.corner[i] = by);
        }
    }
}

/// Near a perfect fit the matrix is the second derivative of the cost; here its product with a step against the change of the slope.
#[test]
fn the_matrix_is_the_change_of_the_slope() {
    let mut fit = fit(1e6);
    for index in 0..fit.frames.len() {
        let frame = fit.frames[index].clone();
        let camera = &fit.cameras[frame.camera];
        let pose = fit.trajectory.sample(0, frame.time_s - camera.latency_s).rig_from_board;
        for corner in &mut fit.frames[index].corners {
            let seen = camera.camera_from_rig.transform(pose.transform(corner.point));
            corner.pixel = camera.lens.project(seen).unwrap();
        }
    }
    fit.noise_px = 0.0;
    let (system, _) = fit.system();
    let dense = dense(&system, 6 * fit.trajectory.controls.len());
    let mut random = Random(9);
    let mut step = DVector::from_fn(dense.nrows(), |_, _| random.uniform() * 1e-7);
    let band = dense.nrows() - 7;
    step[band] *= 1e-2;
    let parts = Parts { band: step.rows(0, band).into(), corner: step.rows(band, 7).into() };
    let (_, slope) = fit.moved(&parts).system();
    let predicted = &dense * &step;
    let changed =
        DVector::from_iterator(dense.nrows(), slope.band.iter().chain(slope.corner.iter()).copied());
    assert!((&changed - &predicted).norm() < 1e-3 * predicted.norm(), "{}", (changed - predicted).norm());
}

/// The whole matrix of an arrow.
fn dense(system: &Arrow, band: usize) -> DMatrix<f64> {
    let corner = system.corner.nrows();
    let mut all = DMatrix::zeros(band + corner, band + corner);
    for row in 0..band {
        for column in row.saturating_sub(super::arrow::BAND - 1)..=row {
            all[(row, column)] = system.band(row, column);
            all[(column, row)] = system.band(row, column);
        }
    }
    all.view_mut((0, band), (band, corner)).copy_from(&system.cross);
    all.view_mut((band, 0), (corner, band)).copy_from(&system.cross.transpose());
    all.view_mut((band, band), (corner, corner)).copy_from(&system.corner);
    all
}

#[test]
fn an_arrow_is_solved_as_the_matrix_that_it_is() {
    let fit = fit(1e6);
    let (system, slope) = fit.system();
    let band = slope.band.len();
    let dense = dense(&system, band);
    let all = DVector::from_iterator(band + 7, slope.band.iter().chain(slope.corner.iter()).copied());
    let reference = dense.clone().cholesky().unwrap();
    let expected = reference.solve(&all);
    let factors = system.factors(0.0).unwrap();
    let solved = factors.solve(&slope);
    let got = DVector::from_iterator(band + 7, solved.band.iter().chain(solved.corner.iter()).copied());
    assert!((&got - &expected).norm() < 1e-6 * expected.norm());
    let inverse = reference.inverse();
    let corner = inverse.view((band, band), (7, 7)).into_owned();
    assert!((factors.corner_inverse() - &corner).norm() < 1e-6 * corner.norm());
}
