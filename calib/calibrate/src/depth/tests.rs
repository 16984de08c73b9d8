use super::*;
use crate::adjustment::Corner;
use crate::intrinsics::ImageSize;
use crate::{Rigid, board_pose};
use depthrig_bus::{Intrinsics, PixelFormat};
use depthrig_calib::Camera;
use glam::{DQuat, DVec2, DVec3};

/// Random numbers that are the same on each run (`splitmix64`).
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (core::f64::consts::TAU * self.uniform()).cos()
    }
}

const SIZE: ImageSize = ImageSize { width: 640, height: 360 };
/// Focal length of the depth image (pixels) times baseline (metres).
const FOCAL_BASELINE: f64 = 320.0 * 0.095;
/// Noise of the disparity, pixels.
const SIGMA_PX: f64 = 0.05;
const DISTANCES_M: [f64; 7] = [0.4, 0.5, 0.65, 0.8, 1.0, 1.25, 1.5];

fn color_lens() -> Intrinsics {
    Intrinsics::pinhole(610.0, 611.0, 322.3, 238.1)
}

fn depth_lens() -> Intrinsics {
    Intrinsics::pinhole(320.0, 320.0, 319.5, 179.5)
}

/// The colour camera sits 15 mm beside the depth camera.
fn depth_from_color() -> Rigid {
    Rigid {
        rotation: DQuat::from_scaled_axis(DVec3::new(0.002, -0.004, 0.001)),
        translation: DVec3::X * 0.015,
    }
}

fn points() -> Vec<DVec3> {
    (0..70).map(|i| DVec3::new(f64::from(i % 10) * 0.03, f64::from(i / 10) * 0.03, 0.0)).collect()
}

/// How a camera senses a true depth.
type Sensor = fn(f64) -> f64;

/// Pixels that have one error of depth in common.
#[derive(Clone, Copy)]
enum Noise {
    /// Each its own, another one in each frame.
    OfPixels,
    /// The 8 by 8 pixels of a matcher's window, the same in each frame.
    OfWindows,
}

/// The board at `z`, nearly facing the colour camera.
fn pose(z: f64, random: &mut Random) -> Rigid {
    let tilt = DVec3::new(random.normal(), random.normal(), 0.2 * random.normal()) * 0.05;
    Rigid { rotation: DQuat::from_scaled_axis(tilt), translation: DVec3::new(-0.135, -0.09, z) }
}

/// Corners with a noise of 0.1 pixels.
fn corners(color_from_board: &Rigid, random: &mut Random) -> Vec<Corner> {
    let lens = Camera::new(&color_lens()).unwrap();
    let seen = points().into_iter().map(|point| {
        let noise = DVec2::new(random.normal(), random.normal()) * 0.1;
        Corner { point, pixel: lens.project(color_from_board.transform(point)).unwrap() + noise }
    });
    seen.collect()
}

/// A place at `z`: what corners with a noise of 0.1 pixels and noisy depth frames say of it.
fn place(z: f64, sensed: Sensor, noise: Noise, random: &mut Random) -> (Measured, Observation) {
    let color_from_board = pose(z, random);
    let corners = corners(&color_from_board, random);
    let found = board_pose(&color_lens(), &corners).unwrap();
    let depth_from_board = depth_from_color().after(&found.camera_from_board);
    let mut meter = PlaneMeter::new(&depth_lens(), SIZE, &depth_from_board, &points()).unwrap();
    let at = depth_from_color().after(&color_from_board);
    let windows: Vec<f64> = (0..SIZE.width * SIZE.height / 64).map(|_| random.normal()).collect();
    let frames = if matches!(noise, Noise::OfPixels) { 2 } else { 1 };
    for _ in 0..frames {
        let frame = match noise {
            Noise::OfPixels => frame(&at, sensed, &mut |_, random| random.normal(), random),
            Noise::OfWindows => frame(&at, sensed, &mut |window, _| windows[window], random),
        };
        meter.add(&frame).unwrap();
    }
    let measured = meter.finish().unwrap();
    let pose_sigma_m = plane_sigma_m(&color_lens(), &corners, &found.camera_from_board).unwrap();
    let observation = Observation {
        sensed_m: measured.truth_m + measured.error_m,
        truth_m: measured.truth_m,
        sigma_m: pose_sigma_m.hypot(measured.noise_sigma_m),
        windows: measured.windows(),
    };
    (measured, observation)
}

/// A frame of the board's plane with a noise of SIGMA_PX of disparity and one hole in fifty.
fn frame(
    depth_from_board: &Rigid,
    sensed: Sensor,
    noise: &mut dyn FnMut(usize, &mut Random) -> f64,
    random: &mut Random,
) -> Vec<f32> {
    let Intrinsics { fx, fy, cx, cy, .. } = depth_lens();
    let normal = depth_from_board.rotation * DVec3::Z;
    let distance = normal.dot(depth_from_board.translation);
    let mut depth = vec![0.0; (SIZE.width * SIZE.height) as usize];
    for (i, out) in depth.iter_mut().enumerate() {
        if random.uniform() < 0.02 {
            continue;
        }
        let x = i % SIZE.width as usize;
        let y = i / SIZE.width as usize;
        let z = sensed(distance / normal.dot(DVec3::new((x as f64 - cx) / fx, (y as f64 - cy) / fy, 1.0)));
        let noise = noise(y / 8 * (SIZE.width as usize / 8) + x / 8, random);
        *out = (1.0 / (1.0 / z + SIGMA_PX / FOCAL_BASELINE * noise)) as f32;
    }
    depth
}

fn trial(sensed: Sensor, seed: u64) -> Choice {
    let mut random = Random(seed * 7919);
    let places: Vec<Observation> =
        DISTANCES_M.iter().map(|z| place(*z, sensed, Noise::OfWindows, &mut random).1).collect();
    choose(&places, true).unwrap()
}

fn picked(sensed: Sensor, model: Model) -> Vec<Choice> {
    let all: Vec<Choice> = (1..=50).map(|seed| trial(sensed, seed)).collect();
    let right = all.iter().filter(|c| c.best.model == model).count();
    println!("{model:?}: {right} of 50");
    assert!(right >= 48, "{model:?} was chosen in {right} of 50");
    all
}

#[test]
fn scale_and_offset_are_found_within_their_sigmas() {
    let all = picked(|z| 1.004 * z + 0.003, Model::ScaleOffset);
    let truth = Correction { scale: 1.0 / 1.004, offset_m: -0.003 / 1.004, inverse_per_m: 0.0 };
    let mut scale_chi = 0.0;
    let mut offset_chi = 0.0;
    let mut within = 0;
    for choice in &all {
        let found = choice.candidates[3];
        let by_scale = (found.correction.scale - truth.scale) / found.sigma.scale;
        let by_offset = (found.correction.offset_m - truth.offset_m) / found.sigma.offset_m;
        assert!((found.correction.scale - truth.scale).abs() < 0.0015, "{found:?}");
        within += usize::from(by_scale.abs() < 3.0 && by_offset.abs() < 3.0);
        scale_chi += by_scale * by_scale / 50.0;
        offset_chi += by_offset * by_offset / 50.0;
    }
    println!("within 3 sigma {within} of 50; mean squares {scale_chi:.2} {offset_chi:.2}");
    assert!(within >= 48, "{within}");
    // A sigma that is honest gives 1 on average, and 50 trials scatter by 0.2. This one is on the safe side: it is raised where
    // places scatter more than expected, and not lowered where they scatter less.
    assert!((0.3..1.4).contains(&scale_chi) && (0.3..1.4).contains(&offset_chi), "{scale_chi} {offset_chi}");
}

#[test]
fn the_sigma_of_a_plane_is_that_of_its_corners() {
    let mut random = Random(11);
    let mut chi = 0.0;
    for _ in 0..200 {
        let truth = pose(0.8, &mut random);
        let corners = corners(&truth, &mut random);
        let found = board_pose(&color_lens(), &corners).unwrap().camera_from_board;
        let middle = corners.iter().map(|c| c.point).sum::<DVec3>() / corners.len() as f64;
        let at = truth.transform(middle);
        let normal = found.rotation * DVec3::Z;
        let depth = normal.dot(found.translation) / normal.dot(at / at.z);
        let sigma = plane_sigma_m(&color_lens(), &corners, &found).unwrap();
        chi += ((depth - at.z) / sigma).powi(2) / 200.0;
    }
    // 1 on average; 200 trials scatter by 0.1.
    assert!((0.7..1.3).contains(&chi), "{chi}");
}

#[test]
fn without_an_error_no_correction_is_chosen() {
    picked(|z| z, Model::None);
}

#[test]
fn an_offset_alone_is_recognised() {
    for choice in picked(|z| z + 0.003, Model::Offset) {
        assert!((choice.candidates[1].correction.offset_m + 0.003).abs() < 0.0005);
    }
}

#[test]
fn a_scale_alone_is_recognised() {
    picked(|z| 1.01 * z, Model::Scale);
}

#[test]
fn an_error_of_disparity_is_recognised() {
    // 0.1 pixels.
    let all = picked(|z| 1.0 / (1.0 / z - 0.1 / FOCAL_BASELINE), Model::Disparity);
    let mean = all.iter().map(|c| c.candidates[4].correction.inverse_per_m).sum::<f64>() / 50.0;
    assert!((mean * FOCAL_BASELINE - 0.1).abs() < 0.01, "{mean}");
}

#[test]
fn one_wrong_place_does_not_move_the_correction() {
    let mut random = Random(5);
    let sensed: Sensor = |z| 1.004 * z + 0.003;
    let mut places: Vec<Observation> =
        DISTANCES_M.iter().map(|z| place(*z, sensed, Noise::OfWindows, &mut random).1).collect();
    places[3].truth_m += 0.05;
    let found = choose(&places, false).unwrap().candidates[3].correction;
    assert!((found.apply(1.007) - 1.0).abs() < 0.001, "{found:?}");
}

#[test]
fn noise_and_fill_of_a_plane_are_those_of_the_frame() {
    let (measured, _) = place(0.8, |z| z + 0.01, Noise::OfPixels, &mut Random(3));
    let subpixel = measured.inverse_rms_per_m * FOCAL_BASELINE;
    // Without the 1 % of the largest residuals the rest of a normal distribution has 0.96 of its width.
    assert!((0.93..1.02).contains(&(subpixel / SIGMA_PX)), "{subpixel}");
    let expected = 0.8 * 0.8 * SIGMA_PX / FOCAL_BASELINE;
    assert!((0.9..1.05).contains(&(measured.plane_rms_m / expected)), "{measured:?}");
    assert!((0.93..1.1).contains(&(measured.temporal_m.unwrap() / expected)), "{measured:?}");
    assert!((measured.fill - 0.98).abs() < 0.01);
    assert!((measured.error_m - 0.01).abs() < 0.001);
}

#[test]
fn a_frame_without_depth_and_a_board_out_of_the_image_are_refused() {
    let at = Rigid { translation: DVec3::new(-0.1, -0.1, 0.8), ..Rigid::IDENTITY };
    let mut meter = PlaneMeter::new(&depth_lens(), SIZE, &at, &points()).unwrap();
    assert!(meter.add(&[1.0; 3]).is_err());
    meter.add(&vec![f32::NAN; (SIZE.width * SIZE.height) as usize]).unwrap();
    assert!(meter.finish().unwrap_err().to_string().contains("no pixel of the board has depth"));
    let beside = Rigid { translation: DVec3::new(3.0, 0.0, 0.8), ..Rigid::IDENTITY };
    let refused = PlaneMeter::new(&depth_lens(), SIZE, &beside, &points()).unwrap_err().to_string();
    assert!(refused.contains("sees 0 pixels of the board"), "{refused}");
}

#[test]
fn pixels_are_corrected_and_holes_stay() {
    let correction = Correction { scale: 1.0 / 1.004, offset_m: -0.003 / 1.004, inverse_per_m: 0.0 };
    let mut counts: Vec<u8> = [0_u16, 1007, 2, 65_535].iter().flat_map(|v| v.to_le_bytes()).collect();
    correction.apply_to_pixels(PixelFormat::Z16, 0.001, &mut counts).unwrap();
    let read: Vec<u16> = counts.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    // What would lie behind the camera is a hole.
    assert_eq!(read, [0, 1000, 0, 65_271]);
    let up = Correction { scale: 1.01, ..Correction::NONE };
    let mut far = 65_535_u16.to_le_bytes();
    up.apply_to_pixels(PixelFormat::Z16, 0.001, &mut far).unwrap();
    assert_eq!(u16::from_le_bytes(far), 0);
    let mut floats: Vec<u8> = [0.0_f32, 1.007, f32::NAN].iter().flat_map(|v| v.to_le_bytes()).collect();
    correction.apply_to_pixels(PixelFormat::DepthF32, 0.0, &mut floats).unwrap();
    let read: Vec<f32> = floats.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    assert!(read[0] == 0.0 && (read[1] - 1.0).abs() < 1e-6 && read[2].is_nan());
    assert!(correction.apply_to_pixels(PixelFormat::Rgb8, 0.0, &mut [0; 3]).is_err());
    let disparity = Correction { inverse_per_m: 0.01, ..Correction::NONE };
    assert!((disparity.apply(2.0) - 1.0 / 0.51).abs() < 1e-6);
}

#[test]
fn nearly_equal_distances_count_once() {
    assert_eq!(distinct([0.5, 0.51, 0.8, 0.505, 1.2, f64::NAN]), 3);
}
