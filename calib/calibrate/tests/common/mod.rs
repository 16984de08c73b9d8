//! A board in front of cameras whose truth is known.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::Camera;
use depthrig_calibrate::Rigid;
use depthrig_calibrate::adjustment::{Corner, INTRINSIC_PARAMETERS};
use depthrig_calibrate::board::{Board, Pattern};
use depthrig_calibrate::rig::{RigCamera, RigView, Seen};
use glam::{DQuat, DVec2, DVec3};

/// Random numbers that are the same on each run (`splitmix64`).
pub struct Random(pub u64);

impl Random {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Standard normal (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.uniform()).ln()).sqrt() * (core::f64::consts::TAU * self.uniform()).cos()
    }

    pub fn normal3(&mut self, sigma: f64) -> DVec3 {
        DVec3::new(self.normal(), self.normal(), self.normal()) * sigma
    }
}

pub fn charuco() -> Board {
    Board {
        pattern: Pattern::Charuco,
        columns: 11,
        rows: 8,
        square_mm: 30.0,
        marker_mm: Some(22.0),
        dictionary: Some("DICT_4X4_50".to_owned()),
        ruler_mm: 100.0,
        measured_ruler_mm: None,
    }
}

/// A lens as of a D435's colour camera.
pub fn intrinsics(focal: f64) -> Intrinsics {
    Intrinsics {
        model: Distortion::BrownConrady as u32,
        coeffs: [0.12, -0.22, 0.0008, -0.0005, 0.0, 0.0, 0.0, 0.0],
        ..Intrinsics::pinhole(focal, focal * 1.002, 322.3, 238.1)
    }
}

/// The board's middle at `middle`, facing the rig's origin, tilted and turned.
pub fn board_at(board: &Board, middle: DVec3, tilt: DVec3) -> Rigid {
    let centre = DVec3::new(
        f64::from(board.columns) * board.square_mm * 0.5e-3,
        f64::from(board.rows) * board.square_mm * 0.5e-3,
        0.0,
    );
    let rotation = DQuat::from_rotation_arc(DVec3::Z, middle.normalize()) * DQuat::from_scaled_axis(tilt);
    Rigid { rotation, translation: middle - rotation * centre }
}

/// The corners that a camera of 640x480 sees, with noise.
pub fn seen(
    board: &Board,
    intrinsics: &Intrinsics,
    camera_from_board: &Rigid,
    sigma_px: f64,
    random: &mut Random,
) -> Vec<Corner> {
    let camera = Camera::new(intrinsics).unwrap();
    (0..board.corner_count())
        .filter_map(|id| {
            let point = board.corner(id);
            let pixel = camera.project(camera_from_board.transform(point))?;
            let noise = DVec2::new(random.normal(), random.normal()) * sigma_px;
            let inside = pixel.x > 5.0 && pixel.y > 5.0 && pixel.x < 634.0 && pixel.y < 474.0;
            inside.then_some(Corner { point, pixel: pixel + noise })
        })
        .collect()
}

/// Noise of a corner's coordinate.
pub const NOISE_PX: f64 = 0.2;

/// Seven cameras on an arc of 0.6 m, looking at a point 0.8 m ahead; the first one is the rig's frame.
pub fn mount() -> Vec<Rigid> {
    (0..7)
        .map(|i| {
            let x = f64::from(i) * 0.1;
            let rotation =
                DQuat::from_rotation_y(-0.1 * f64::from(i)) * DQuat::from_rotation_x(0.03 * f64::from(i % 3));
            let at = DVec3::new(x, 0.02 * f64::from(i % 2), 0.0);
            Rigid { rotation, translation: at }.inverse()
        })
        .collect()
}

/// Corners that the cameras of a mount see of a board at random places.
pub fn mount_views(truth: &[Rigid], count: usize, random: &mut Random) -> Vec<RigView> {
    let board = charuco();
    (0..count)
        .map(|i| {
            let middle =
                DVec3::new(random.between(-0.1, 0.6), random.between(-0.15, 0.15), random.between(0.55, 1.0));
            let tilt =
                DVec3::new(random.between(-0.6, 0.6), random.between(-0.6, 0.6), random.between(-0.4, 0.4));
            let rig_from_board = board_at(&board, middle, tilt);
            let each = truth.iter().enumerate().map(|(camera, camera_from_rig)| Seen {
                camera,
                corners: seen(
                    &board,
                    &intrinsics(520.0),
                    &camera_from_rig.after(&rig_from_board),
                    NOISE_PX,
                    random,
                ),
            });
            RigView { name: i.to_string(), seen: each.filter(|s| s.corners.len() >= 12).collect() }
        })
        .filter(|v: &RigView| v.seen.len() >= 2)
        .collect()
}

/// The cameras of [`mount`].
pub fn mount_cameras() -> Vec<RigCamera> {
    (0..7)
        .map(|i| RigCamera {
            name: format!("cam{i}"),
            intrinsics: intrinsics(520.0),
            free_intrinsics: [false; INTRINSIC_PARAMETERS],
        })
        .collect()
}
