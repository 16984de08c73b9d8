use super::*;
use crate::Rigid;
use crate::adjustment::Corner;
use crate::board::{Board, Paper, Pattern};
use crate::intrinsics::{IntrinsicsOptions, calibrate};
use crate::mount::{MountOptions, calibrate_mount};
use depthrig_bus::HostTime;
use depthrig_calib::Camera;
use glam::{DQuat, DVec2, DVec3};
use proptest::prelude::*;

const SIZE: ImageSize = ImageSize { width: 640, height: 480 };

/// Numbers that look random (xorshift).
struct Draw(u64);

impl Draw {
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A normal number (Box and Muller).
    fn normal(&mut self) -> f64 {
        (-2.0 * self.unit().max(1e-12).ln()).sqrt() * (core::f64::consts::TAU * self.unit()).cos()
    }
}

fn board(pattern: Pattern) -> Board {
    let (columns, rows) = if pattern == Pattern::Aprilgrid { (6, 5) } else { (10, 7) };
    Board::for_paper(pattern, columns, rows, None, Paper::parse("a3").unwrap()).unwrap()
}

fn truth() -> Intrinsics {
    let mut k = Intrinsics::pinhole(520.0, 521.0, 325.0, 236.0);
    k.model = Distortion::BrownConrady as u32;
    k.coeffs[..4].copy_from_slice(&[-0.12, 0.05, 0.0005, -0.0003]);
    k
}

/// Cameras of a mount, side by side and turned.
fn mount(n: usize) -> Vec<Rigid> {
    (0..n)
        .map(|i| {
            let x = i as f64;
            Rigid {
                rotation: DQuat::from_rotation_y(-0.15 * x),
                translation: DVec3::new(0.12 * x, 0.01 * x, 0.0),
            }
            .inverse()
        })
        .collect()
}

fn cameras(n: usize) -> Vec<CaptureCamera> {
    (0..n).map(|i| CaptureCamera { name: format!("c{i}"), size: SIZE, factory: None }).collect()
}

/// Corners of a board that the cameras see, with noise.
fn seen(
    points: &Points,
    mount: &[Rigid],
    rig_from_board: &Rigid,
    noise_px: f64,
    draw: &mut Draw,
) -> Vec<Seen> {
    let lens = Camera::new(&truth()).unwrap();
    let mut all = Vec::new();
    for (camera, pose) in mount.iter().enumerate() {
        let Some(mut corners) = points.seen_by(&lens, SIZE, &pose.after(rig_from_board)) else { continue };
        for corner in &mut corners {
            corner.pixel += DVec2::new(draw.normal(), draw.normal()) * noise_px;
        }
        all.push(Seen { camera, corners });
    }
    all
}

/// A pose as somebody without a hint would hold the board: anywhere in the image, at any distance, tilted at random.
fn anywhere(points: &Points, draw: &mut Draw) -> Rigid {
    let lens = Camera::new(&truth()).unwrap();
    let candidates = points.candidates(&lens, SIZE);
    loop {
        let at = &candidates[(draw.unit() * candidates.len() as f64) as usize];
        let shaken = shaken(&at.camera_from_board, draw, 0.3);
        if points.seen_by(&lens, SIZE, &shaken).is_some() {
            return shaken;
        }
    }
}

/// A hand does not hold a board exactly where it is asked to.
fn shaken(pose: &Rigid, draw: &mut Draw, by: f64) -> Rigid {
    let rotation = DVec3::new(draw.normal(), draw.normal(), draw.normal()) * (0.5 * by);
    let translation = pose.translation.length() * by * 0.3;
    let step = DVec3::new(draw.normal(), draw.normal(), draw.normal()) * translation;
    Rigid {
        rotation: (pose.rotation * DQuat::from_scaled_axis(rotation)).normalize(),
        translation: pose.translation + step,
    }
}

/// Three rounds of rest, after which a view is taken or not.
fn rest(capture: &mut Capture, points: &Points, mount: &[Rigid], board: &Rigid, draw: &mut Draw) -> Step {
    for _ in 1..STILL_ROUNDS {
        let now = seen(points, mount, board, 0.03, draw);
        assert_eq!(capture.look(&now).view, None);
    }
    capture.look(&seen(points, mount, board, 0.03, draw))
}

fn at(x: f64, y: f64, z: f64) -> Rigid {
    Rigid { rotation: DQuat::from_rotation_x(0.4), translation: DVec3::new(x, y, z) }
}

#[test]
fn a_view_is_taken_in_the_third_round_of_rest_and_once() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut capture = Capture::new(cameras(2), &board).unwrap();
    let mut draw = Draw(7);
    let here = at(-0.2, -0.15, 0.9);
    let mut states = Vec::new();
    for round in 0..6 {
        let step = capture.look(&seen(&points, &mount(2), &here, 0.03, &mut draw));
        assert_eq!(step.view.is_some(), round == 2, "round {round}");
        states.push(step.state);
    }
    assert_eq!(
        states,
        [State::Moving, State::HoldStill, State::Taken, State::Taken, State::Taken, State::Taken]
    );
    assert_eq!(capture.views().len(), 1);
    // Moved a little, and at rest again: known.
    let near = at(-0.198, -0.15, 0.9);
    assert_eq!(rest(&mut capture, &points, &mount(2), &near, &mut draw).state, State::Known);
    let elsewhere = at(-0.1, -0.15, 0.9);
    assert_eq!(rest(&mut capture, &points, &mount(2), &elsewhere, &mut draw).state, State::Taken);
    assert_eq!(capture.look(&[]).state, State::Searching);
}

#[test]
fn a_board_that_drifts_is_never_taken() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut capture = Capture::new(cameras(1), &board).unwrap();
    let mut draw = Draw(3);
    for round in 0..30 {
        // 0.2 px a round: less than the limit from one round to the next, more over three.
        let drift = at(-0.2 + 0.0004 * f64::from(round), -0.15, 0.9);
        let step = capture.look(&seen(&points, &mount(1), &drift, 0.0, &mut draw));
        assert_eq!(step.view, None, "round {round}: {:?}", step.state);
    }
}

#[test]
fn a_camera_that_flickers_is_left_out_of_the_view() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut capture = Capture::new(cameras(2), &board).unwrap();
    let mut draw = Draw(5);
    let here = at(-0.2, -0.15, 0.9);
    for round in 0..2 {
        let mut now = seen(&points, &mount(2), &here, 0.03, &mut draw);
        assert_eq!(now.len(), 2, "both cameras see the board");
        now.truncate(1 + round);
        capture.look(&now);
    }
    let step = capture.look(&seen(&points, &mount(2), &here, 0.03, &mut draw));
    assert_eq!(step.view.unwrap().seen.len(), 1);
    // Now that the other one sees it steadily the view is new: it joins two cameras.
    let step = capture.look(&seen(&points, &mount(2), &here, 0.03, &mut draw));
    assert_eq!(step.view.map(|v| v.seen.len()), Some(2));
}

#[test]
fn what_is_missing_is_named_per_camera_and_pair() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut capture = Capture::new(cameras(3), &board).unwrap();
    let mut draw = Draw(11);
    assert!(!capture.is_enough());
    let here = at(-0.1, -0.15, 0.9);
    let two = mount(2);
    rest(&mut capture, &points, &two, &here, &mut draw);
    let progress = capture.progress();
    assert_eq!(progress.views, 1);
    assert_eq!(progress.cameras[2].missing, ["0 of 10 views"]);
    assert!(progress.cameras[0].missing.contains(&"1 of 3 views together with another camera".to_owned()));
    assert_eq!(progress.pairs.len(), 1);
    assert_eq!((progress.pairs[0].shared, progress.pairs[0].missing), (1, 2));
    assert!(progress.missing.iter().any(|m| m.contains("[c0] and [c1] and [c2]")), "{:?}", progress.missing);
    let hint = progress.hint.unwrap();
    assert_eq!(hint.text, "hold the board where c2 and one of c0, c1 see it at once");
    // Numbers as sent are those that are read.
    let text = serde_json::to_string(&capture.progress()).unwrap();
    assert_eq!(serde_json::from_str::<Progress>(&text).unwrap(), capture.progress());
}

#[test]
fn a_capture_that_goes_on_knows_what_was_taken() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut first = Capture::new(cameras(2), &board).unwrap();
    let mut draw = Draw(13);
    for i in 0..4 {
        let place = at(-0.25 + 0.06 * f64::from(i), -0.15, 0.9);
        assert_eq!(rest(&mut first, &points, &mount(2), &place, &mut draw).state, State::Taken);
        first.look(&[]);
    }
    let mut second = Capture::new(cameras(2), &board).unwrap();
    second.restore(first.views().to_vec());
    assert_eq!(second.hint(), first.hint());
    assert_eq!(second.progress().cameras[0].coverage, first.progress().cameras[0].coverage);
    let old = rest(&mut second, &points, &mount(2), &at(-0.25, -0.15, 0.9), &mut draw);
    assert_eq!(old.state, State::Known);
    first.forget_last();
    assert_eq!(first.views().len(), 3);
}

/// The pose that a hint asks for, from its words alone, as a person would read them: place, distance and tilt; or where the named cameras see it.
fn obeyed(points: &Points, hint: &Hint, mount: &[Rigid], draw: &mut Draw) -> Option<Rigid> {
    if hint.camera.is_none() {
        return (0..200).map(|_| mount[0].inverse().after(&anywhere(points, draw))).find(|pose| {
            let seen = seen(points, mount, pose, 0.0, &mut Draw(1));
            hint.seen_by.iter().all(|name| seen.iter().any(|s| format!("c{}", s.camera) == *name))
        });
    }
    let camera: usize = hint.camera.as_ref()?.strip_prefix('c')?.parse().ok()?;
    let lens = Camera::new(&truth()).unwrap();
    let candidate = points
        .candidates(&lens, SIZE)
        .into_iter()
        .filter(|c| Some(c.tilt) == hint.tilt)
        .filter(|c| hint.text.contains(&format!("to {} of", crate::mount::NAMES[c.row][c.column])))
        .min_by(|a, b| {
            let off = |c: &poses::Candidate| (c.distance_m - hint.distance_m.unwrap()).abs();
            off(a).total_cmp(&off(b))
        })?;
    for _ in 0..100 {
        let pose = shaken(&candidate.camera_from_board, draw, 0.15);
        if points.seen_by(&lens, SIZE, &pose).is_some() {
            return Some(mount[camera].inverse().after(&pose));
        }
    }
    None
}

/// Mean variance of projection over all cameras after each view, px², by the calibration that `solve` makes.
fn variance(points_of: &[CaptureCamera], views: &[RigView]) -> f64 {
    let inputs: Vec<CameraInput> = points_of
        .iter()
        .map(|c| CameraInput {
            name: c.name.clone(),
            size: c.size,
            factory: None,
            model: Distortion::BrownConrady,
        })
        .collect();
    let found = calibrate_mount(&inputs, views, MountOptions::default()).unwrap();
    let mut sum = 0.0;
    for camera in &found.cameras {
        let map = &camera.uncertainty.sigma_px;
        sum += map.iter().filter(|s| s.is_finite()).map(|s| s * s).sum::<f64>() / map.len() as f64;
    }
    sum / found.cameras.len() as f64
}

struct Race {
    hinted: f64,
    random: f64,
}

/// Takes views by hints and at random, and compares what is left uncertain.
fn race(n: usize, views: usize, seed: u64) -> Race {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mount = mount(n);
    let mut results = [0.0; 2];
    for (by_hint, result) in [true, false].into_iter().zip(&mut results) {
        let mut draw = Draw(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let mut capture = Capture::new(cameras(n), &board).unwrap();
        let mut noisy = Vec::new();
        while capture.views().len() < views {
            let hint = capture.hint().cloned();
            let obeyed = hint.filter(|_| by_hint).and_then(|h| obeyed(&points, &h, &mount, &mut draw));
            let pose = obeyed.unwrap_or_else(|| {
                let camera = (draw.unit() * n as f64) as usize;
                mount[camera].inverse().after(&anywhere(&points, &mut draw))
            });
            let taken = rest(&mut capture, &points, &mount, &pose, &mut draw);
            if let Some(view) = taken.view {
                // The same noise for both: what differs is where the board was.
                let seen = seen(&points, &mount, &pose, 0.15, &mut draw);
                noisy.push(RigView { name: view.name, seen });
            }
        }
        *result = variance(capture.cameras(), &noisy);
    }
    Race { hinted: results[0], random: results[1] }
}

#[test]
fn views_by_hints_reduce_uncertainty_faster_than_random_ones() {
    for (cameras, views, least) in [(1, 8, 3.0), (2, 12, 1.3)] {
        let mut ratios: Vec<f64> = Vec::new();
        for seed in 1..=9 {
            let race = race(cameras, views, seed);
            ratios.push(race.random / race.hinted);
        }
        ratios.sort_by(f64::total_cmp);
        println!(
            "{cameras} cameras, {views} views: variance of random views over that of hinted ones {ratios:.2?}"
        );
        assert!(ratios[ratios.len() / 2] > least, "{ratios:.2?}");
    }
}

#[test]
fn a_capture_that_follows_its_hints_ends_and_its_calibration_is_right() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mount = mount(3);
    let mut draw = Draw(99);
    let mut capture = Capture::new(cameras(3), &board).unwrap();
    let mut tries = 0;
    while !capture.is_enough() {
        tries += 1;
        assert!(tries < 80, "still missing: {:?}", capture.progress().missing);
        let hint = capture.hint().cloned().unwrap();
        let pose = obeyed(&points, &hint, &mount, &mut draw)
            .unwrap_or_else(|| mount[1].inverse().after(&anywhere(&points, &mut draw)));
        rest(&mut capture, &points, &mount, &pose, &mut draw);
    }
    println!("enough after {} views", capture.views().len());
    assert_eq!(capture.hint(), None);
    let inputs: Vec<CameraInput> = capture
        .cameras()
        .iter()
        .map(|c| CameraInput {
            name: c.name.clone(),
            size: c.size,
            factory: None,
            model: Distortion::BrownConrady,
        })
        .collect();
    let found = calibrate_mount(&inputs, capture.views(), MountOptions::default()).unwrap();
    assert_eq!(found.advice, Vec::<String>::new(), "solve has nothing to advise");
    for (camera, truth) in found.cameras.iter().zip(&mount) {
        let off = camera.rig_from_camera.distance(&truth.inverse());
        assert!(off.metres < 0.5e-3 && off.radians < 0.03_f64.to_radians(), "{}: {off:?}", camera.name);
    }
}

#[test]
fn seven_cameras_are_joined() {
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mount = mount(7);
    let mut draw = Draw(5);
    let mut capture = Capture::new(cameras(7), &board).unwrap();
    let began = HostTime::now();
    let mut tries = 0;
    while !capture.is_enough() {
        tries += 1;
        assert!(tries < 120, "still missing: {:?}", capture.progress().missing);
        let hint = capture.hint().cloned().unwrap();
        let pose = obeyed(&points, &hint, &mount, &mut draw)
            .unwrap_or_else(|| mount[tries % 7].inverse().after(&anywhere(&points, &mut draw)));
        rest(&mut capture, &points, &mount, &pose, &mut draw);
    }
    let each = began.elapsed().as_secs_f64() / f64::from(capture.views().len() as u32);
    println!("seven cameras: enough after {} views, {each:.2} s a view", capture.views().len());
    assert!(capture.views().len() < 80);
}

#[test]
fn hints_name_the_tilt_as_the_camera_sees_it() {
    for pattern in [Pattern::Charuco, Pattern::Aprilgrid, Pattern::Chessboard] {
        let board = board(pattern);
        let points = Points::new(&board);
        let lens = Camera::new(&truth()).unwrap();
        for candidate in points.candidates(&lens, SIZE) {
            let Some(corners) = points.seen_by(&lens, SIZE, &candidate.camera_from_board) else { continue };
            let depth = |c: &Corner| candidate.camera_from_board.transform(c.point).z;
            let by = |key: fn(&Corner) -> f64| {
                let least = corners.iter().min_by(|a, b| key(a).total_cmp(&key(b))).unwrap();
                let most = corners.iter().max_by(|a, b| key(a).total_cmp(&key(b))).unwrap();
                depth(most) - depth(least)
            };
            let (right, down) = (by(|c| c.pixel.x), by(|c| c.pixel.y));
            let fits = match candidate.tilt {
                Tilt::None => true,
                Tilt::TopAway => down < 0.0,
                Tilt::BottomAway => down > 0.0,
                Tilt::LeftAway => right < 0.0,
                Tilt::RightAway => right > 0.0,
            };
            assert!(fits, "{pattern:?} {candidate:?}: right {right}, down {down}");
        }
    }
}

#[test]
fn intrinsics_that_views_do_not_determine_are_not_believed() {
    // Frontal views alone: the focal length is free.
    let board = board(Pattern::Charuco);
    let points = Points::new(&board);
    let mut draw = Draw(17);
    let views: Vec<RigView> = (0..8)
        .map(|i| {
            let x = -0.25 + 0.02 * f64::from(i);
            let frontal = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(x, -0.15, 0.8) };
            RigView { name: i.to_string(), seen: seen(&points, &mount(1), &frontal, 0.1, &mut draw) }
        })
        .collect();
    let k = estimate::intrinsics_of(&cameras(1)[0], 0, &views);
    assert!((0.2..10.0).contains(&(k.fx / 640.0)), "{k:?}");
    let corners: Vec<Vec<Corner>> = views.iter().map(|v| v.seen[0].corners.clone()).collect();
    let options = IntrinsicsOptions::default();
    drop(calibrate(SIZE, &corners, &options));
}

proptest! {
    #[test]
    fn nothing_panics_whatever_the_cameras_see(
        rounds in prop::collection::vec(
            prop::collection::vec((0_usize..3, prop::collection::vec((0_usize..54, 0.0..640.0, 0.0..480.0), 0..20)), 0..3),
            1..12,
        ),
    ) {
        let board = board(Pattern::Charuco);
        let mut capture = Capture::new(cameras(3), &board).unwrap();
        for round in rounds {
            let mut all: Vec<Seen> = Vec::new();
            for (camera, corners) in round {
                if all.iter().any(|s| s.camera == camera) {
                    continue;
                }
                let corners = corners
                    .into_iter()
                    .map(|(id, x, y)| Corner { point: board.corner(id), pixel: DVec2::new(x, y) })
                    .collect();
                all.push(Seen { camera, corners });
            }
            for _ in 0..3 {
                capture.look(&all);
            }
            prop_assert!(capture.progress().views <= 12);
        }
    }
}
