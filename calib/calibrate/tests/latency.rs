//! A board waved before seven cameras: latencies are found, their uncertainty is right, and recordings that do not show them are refused.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{NOISE_PX, Random, board_at, charuco, intrinsics, mount, seen};
use depthrig_calibrate::Rigid;
use depthrig_calibrate::check::KnownCamera;
use depthrig_calibrate::latency::{
    CameraLatency, Latencies, Subtracted, TimedFrame, Total, estimate, totals,
};
use glam::{DQuat, DVec3};
use nalgebra::{Matrix6, Vector6};

/// Uncertainty of the calibrated poses.
const POSE_RAD: f64 = 1e-4;
const POSE_M: f64 = 1e-4;

/// How the board is waved and seen.
#[derive(Clone)]
struct Wave {
    seconds: f64,
    rate_hz: f64,
    /// Frequency of the quickest motion.
    motion_hz: f64,
    amplitude_m: f64,
    latency_s: [f64; 7],
    noise_px: f64,
}

const WAVE: Wave = Wave {
    seconds: 8.0,
    rate_hz: 15.0,
    motion_hz: 0.8,
    amplitude_m: 0.15,
    latency_s: [0.0, 0.0, 0.0, 0.0047, 0.0, 0.0, 0.0],
    noise_px: NOISE_PX,
};

/// A sum of sines that no spline is.
struct Motion {
    terms: Vec<[f64; 8]>,
}

impl Motion {
    fn new(wave: &Wave, random: &mut Random) -> Self {
        let terms = (0..6)
            .map(|i| {
                let size = if i < 3 { wave.amplitude_m } else { 2.0 * wave.amplitude_m };
                let mut sines = [0.0; 8];
                for n in 0..2 {
                    let part = if n == 0 { 0.7 } else { 0.3 };
                    sines[n] = size * part * random.between(0.8, 1.2);
                    sines[2 + n] = wave.motion_hz * random.between(0.5, 1.0) * core::f64::consts::TAU;
                    sines[4 + n] = random.between(0.0, core::f64::consts::TAU);
                }
                sines
            })
            .collect();
        Self { terms }
    }

    fn at(&self, axis: usize, time_s: f64) -> f64 {
        let t = &self.terms[axis];
        (0..2).map(|n| t[n] * (t[2 + n] * time_s + t[4 + n]).sin()).sum()
    }

    fn rig_from_board(&self, time_s: f64) -> Rigid {
        let offset = DVec3::new(self.at(0, time_s), 0.6 * self.at(1, time_s), 0.6 * self.at(2, time_s));
        let tilt = DVec3::new(0.35, -0.3, 0.1)
            + DVec3::new(self.at(3, time_s), self.at(4, time_s), self.at(5, time_s));
        board_at(&charuco(), DVec3::new(0.3, 0.0, 0.85) + offset, tilt)
    }
}

/// The mount as it was calibrated, with the errors of that.
fn calibrated(random: &mut Random) -> Vec<KnownCamera> {
    let variances = Vector6::new(1.0, 1.0, 1.0, 0.0, 0.0, 0.0) * POSE_RAD.powi(2)
        + Vector6::new(0.0, 0.0, 0.0, 1.0, 1.0, 1.0) * POSE_M.powi(2);
    mount()
        .iter()
        .enumerate()
        .map(|(i, camera_from_rig)| {
            let is_reference = i == 0;
            let error = |sigma: f64, random: &mut Random| {
                if is_reference { DVec3::ZERO } else { random.normal3(sigma) }
            };
            let rotation = error(POSE_RAD, random);
            let place = error(POSE_M, random);
            KnownCamera {
                name: format!("cam{i}"),
                intrinsics: intrinsics(520.0),
                rig_from_camera: camera_from_rig.moved(rotation, place).inverse(),
                covariance: if is_reference { Matrix6::zeros() } else { Matrix6::from_diagonal(&variances) },
            }
        })
        .collect()
}

/// The frames of all cameras, each with a phase of its own, stamped late by its latency.
fn recorded(wave: &Wave, random: &mut Random) -> Vec<TimedFrame> {
    let motion = Motion::new(wave, random);
    let board = charuco();
    let mut frames = Vec::new();
    for (camera, camera_from_rig) in mount().iter().enumerate() {
        let phase = random.uniform();
        for i in 0..(wave.seconds * wave.rate_hz) as usize {
            let time_s = (i as f64 + phase) / wave.rate_hz;
            let pose = camera_from_rig.after(&motion.rig_from_board(time_s));
            let corners = seen(&board, &intrinsics(520.0), &pose, wave.noise_px, random);
            if corners.len() >= 12 {
                // As far from zero as a computer's uptime.
                frames.push(TimedFrame {
                    camera,
                    time_s: 86_400.0 + time_s + wave.latency_s[camera],
                    uncertainty_s: 0.0,
                    corners,
                });
            }
        }
    }
    frames
}

fn run(wave: &Wave, seed: u64) -> depthrig_calib::Result<Latencies> {
    let mut random = Random(seed);
    let cameras = calibrated(&mut random);
    let frames = recorded(wave, &mut random);
    estimate(&cameras, 0, &frames)
}

fn refused(wave: &Wave) -> String {
    run(wave, 1).unwrap_err().to_string()
}

#[test]
fn a_latency_of_4_7_ms_is_found_and_its_sigma_is_honest() {
    let seeds = 50;
    let found = std::thread::scope(|scope| {
        let of = |seeds: Vec<u64>| {
            scope.spawn(move || seeds.into_iter().map(|s| run(&WAVE, s).unwrap()).collect())
        };
        let even = of((0..seeds).step_by(2).collect());
        let odd = of((1..seeds).step_by(2).collect());
        let mut all: Vec<Latencies> = even.join().unwrap();
        all.extend(odd.join().unwrap());
        all
    });
    let mut worst_ms = 0.0_f64;
    let mut within = [0; 4];
    let mut count = 0;
    let mut squares = 0.0;
    let mut sigma_ms = 0.0;
    let mut knots = Vec::new();
    for result in &found {
        assert!(result.refused.is_empty(), "{:?}", result.refused);
        assert_eq!(result.found.len(), 7);
        knots.push(result.knot_s);
        for latency in &result.found[1..] {
            let error_ms = (latency.latency_s - WAVE.latency_s[latency.camera]) * 1e3;
            worst_ms = worst_ms.max(error_ms.abs());
            let in_sigmas = error_ms.abs() * 1e-3 / latency.sigma_s;
            for (sigmas, within) in within.iter_mut().enumerate() {
                *within += usize::from(in_sigmas <= sigmas as f64);
            }
            assert!(!latency.has_moved(), "{latency:?}");
            squares += in_sigmas.powi(2);
            sigma_ms += latency.sigma_s * 1e3;
            count += 1;
        }
    }
    let n = f64::from(count);
    println!(
        "{count} latencies: worst error {worst_ms:.4} ms, mean sigma {:.4} ms, mean square {:.2} sigma², within 1, 2, 3 sigma {:?}, knots {knots:?}, \
         residual {:.3} of {:.3} px",
        sigma_ms / n,
        squares / n,
        within,
        found[0].sigma_px,
        found[0].single_px,
    );
    assert!(worst_ms < 0.5, "{worst_ms}");
    assert!(within[3] * 100 >= count as usize * 95, "{within:?} of {count}");
    // And not because it is large: a sigma twice too large would give a quarter.
    assert!(squares / n > 0.25, "{}", squares / n);
}

#[test]
fn large_latencies_of_all_cameras_are_found() {
    let wave = Wave { latency_s: [0.02, -0.13, 0.0, 0.2, 0.05, -0.03, 0.11], ..WAVE };
    let result = run(&wave, 3).unwrap();
    for latency in &result.found {
        let truth = wave.latency_s[latency.camera] - wave.latency_s[0];
        assert!((latency.latency_s - truth).abs() < 0.5e-3, "{latency:?} is not {truth}");
    }
}

#[test]
fn a_camera_that_stands_elsewhere_is_named() {
    let mut random = Random(5);
    let mut cameras = calibrated(&mut random);
    let frames = recorded(&WAVE, &mut random);
    cameras[4].rig_from_camera.translation.x += 0.003;
    let result = estimate(&cameras, 0, &frames).unwrap();
    let moved: Vec<usize> = result.found.iter().filter(|l| l.has_moved()).map(|l| l.camera).collect();
    assert_eq!(moved, [4]);
}

#[test]
fn wrong_corners_do_not_matter() {
    let mut random = Random(6);
    let cameras = calibrated(&mut random);
    let mut frames = recorded(&WAVE, &mut random);
    for frame in frames.iter_mut().step_by(3) {
        let corner = &mut frame.corners[5];
        corner.pixel.x += 25.0;
    }
    for latency in estimate(&cameras, 0, &frames).unwrap().found {
        let error_s = latency.latency_s - WAVE.latency_s[latency.camera];
        assert!(error_s.abs() < 0.2e-3, "{latency:?}");
    }
}

#[test]
fn what_cannot_be_found_is_refused_with_the_cure() {
    let still = refused(&Wave { amplitude_m: 0.0005, ..WAVE });
    assert!(
        still.contains("cam3") && still.contains("px a second") && still.contains("wave it faster"),
        "{still}"
    );
    let blurred = refused(&Wave { noise_px: 1.6, ..WAVE });
    assert!(blurred.contains("wave the board more slowly or expose for less time"), "{blurred}");
    let fast = refused(&Wave { rate_hz: 5.0, motion_hz: 4.0, seconds: 20.0, ..WAVE });
    assert!(fast.contains("record more sets a second") && fast.contains("wave more slowly"), "{fast}");
    let short = refused(&Wave { seconds: 1.0, ..WAVE });
    assert!(short.contains("reference camera cam0") && short.contains("20 are needed"), "{short}");
}

#[test]
fn cameras_that_cannot_be_compared_are_named_and_the_others_are_found() {
    let mut random = Random(7);
    let cameras = calibrated(&mut random);
    let mut frames = recorded(&Wave { seconds: 10.0, ..WAVE }, &mut random);
    // Camera 5 sees the board later than all others, camera 6 hardly at all, camera 2 not together with the reference, but with camera 1.
    let start = frames.iter().map(|f| f.time_s).fold(f64::INFINITY, f64::min);
    for frame in &mut frames {
        if frame.camera == 5 {
            frame.time_s += 20.0;
        }
    }
    frames.retain(|f| {
        let since = f.time_s - start;
        match f.camera {
            0 => since < 5.0,
            2 => since > 5.5,
            6 => since < 0.5,
            _ => true,
        }
    });
    let result = estimate(&cameras, 0, &frames).unwrap();
    let names: Vec<usize> = result.found.iter().map(|l| l.camera).collect();
    assert_eq!(names, [0, 1, 2, 3, 4]);
    let second = &result.found[2];
    assert!(second.latency_s.abs() < 0.5e-3, "{second:?}");
    let refused: Vec<usize> = result.refused.iter().map(|r| r.camera).collect();
    assert_eq!(refused, [5, 6]);
    assert!(result.refused[0].why.contains("shares no moment with cam0"), "{:?}", result.refused[0]);
    assert!(result.refused[1].why.contains("20 are needed"), "{:?}", result.refused[1]);
}

#[test]
fn a_bad_pose_is_not_taken_for_a_latency() {
    // Turned by two degrees: no calibration is so far off, and nothing fits any more.
    let mut random = Random(8);
    let mut cameras = calibrated(&mut random);
    let frames = recorded(&WAVE, &mut random);
    for camera in &mut cameras {
        camera.covariance = Matrix6::zeros();
    }
    let turned = &mut cameras[3].rig_from_camera;
    turned.rotation = (turned.rotation * DQuat::from_rotation_y(0.035)).normalize();
    let result = estimate(&cameras, 0, &frames).unwrap();
    let refused: Vec<usize> = result.refused.iter().map(|r| r.camera).collect();
    assert_eq!(refused, [3]);
    let why = &result.refused[0].why;
    assert!(why.contains("px off") && why.contains("does not stand where it was calibrated"), "{why}");
}

#[test]
fn totals_count_nothing_twice() {
    let found = |latency_ms: [f64; 3]| -> Vec<CameraLatency> {
        latency_ms
            .iter()
            .enumerate()
            .map(|(camera, ms)| CameraLatency {
                camera,
                latency_s: ms * 1e-3,
                sigma_s: 0.0,
                frames: 100,
                corners: 1000,
                speed_px_s: 200.0,
                sigma_px: 0.2,
                displaced: None,
            })
            .collect()
    };
    let before = |ms: [f64; 3], measured: [bool; 3]| -> Vec<Subtracted> {
        (0..3).map(|i| Subtracted { latency_s: ms[i] * 1e-3, is_measured: measured[i] }).collect()
    };
    let ms =
        |totals: &[Total]| -> Vec<f64> { totals.iter().map(|t| (t.latency_s * 1e6).round() / 1e3).collect() };
    // Nothing subtracted: the fastest camera becomes zero, and it need not be the reference.
    let none = before([0.0; 3], [false; 3]);
    assert_eq!(ms(&totals(&found([0.0, 4.7, -1.3]), &none)), [1.3, 6.0, 0.0]);
    // The same again, once it is applied.
    let applied = before([1.3, 6.0, 0.0], [false; 3]);
    assert_eq!(ms(&totals(&found([0.0, 0.0, 0.0]), &applied)), [1.3, 6.0, 0.0]);
    // A camera that was asked for its clock fixes the zero and keeps its own latency.
    let measured = before([0.0, 12.0, 0.0], [false, true, false]);
    let all = totals(&found([0.0, -3.0, 2.0]), &measured);
    assert_eq!(ms(&all), [3.0, 12.0, 5.0]);
    assert_eq!(all.iter().map(|t| t.is_measured).collect::<Vec<_>>(), [false, true, false]);
    let early = totals(&found([0.0, 3.0, 4.0]), &measured);
    assert_eq!(ms(&early), [0.0, 12.0, 1.0]);
    assert!((early[0].below_zero_s - 3e-3).abs() < 1e-12);
}
