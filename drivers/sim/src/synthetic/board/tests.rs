use super::*;
use depthrig_bus::Intrinsics;
use depthrig_calib::Camera;
use glam::DVec3;

const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;

/// A sheet with one black square in the middle, 60 mm wide.
fn scene(motion: BoardMotion) -> BoardScene {
    let square = Black { x_m: 0.118, y_m: 0.075, width_m: 0.06, height_m: 0.06 };
    BoardScene {
        sheet: Sheet { size_m: [0.296, 0.21], black: vec![square] },
        motion,
        ..BoardScene::default()
    }
}

fn lens() -> Intrinsics {
    let mut k = Intrinsics::pinhole(300.0, 300.0, 158.0, 121.0);
    k.model = depthrig_bus::Distortion::BrownConrady as u32;
    k.coeffs[..5].copy_from_slice(&[-0.1, 0.05, 0.001, -0.0005, 0.0]);
    k
}

fn painter(scene: &BoardScene) -> Painter {
    Painter::new(scene, Rays::new(&lens(), WIDTH, HEIGHT), &Pose::IDENTITY, 3)
}

fn at(seconds: f64) -> HostTime {
    HostTime::from_ns((seconds * 1e9) as i64)
}

/// The centre of the ink is where the camera model projects the middle of the square, at every pose.
#[test]
fn the_print_is_where_the_lens_puts_it() {
    let scene = scene(BoardMotion::Wave);
    let painter = painter(&scene);
    let camera = Camera::new(&lens()).unwrap();
    for i in 0..20 {
        let t = at(0.37 * f64::from(i));
        let mut rgb = vec![255u8; (WIDTH * HEIGHT * 3) as usize];
        painter.color(&mut rgb, Moment { world_start: HostTime::from_ns(0), capture: t, frame: 1 });
        let pose = scene.pose(HostTime::from_ns(0), t).unwrap();
        // The mean over the square, of the projections weighted by the area that they have in the image.
        let mut wanted = glam::DVec2::ZERO;
        let mut area = 0.0;
        for n in 0..60 * 60 {
            let p = |dx: f64, dy: f64| {
                let x = (f64::from(n % 60) + 0.5 + dx) * 1e-3 - 0.03;
                let y = (f64::from(n / 60) + 0.5 + dy) * 1e-3 - 0.03;
                camera.project(pose.transform_point3(DVec3::new(x, y, 0.0))).unwrap()
            };
            let here = p(0.0, 0.0);
            let patch = (p(0.5, 0.0) - p(-0.5, 0.0)).perp_dot(p(0.0, 0.5) - p(0.0, -0.5)).abs();
            wanted += here * patch;
            area += patch;
        }
        wanted /= area;
        let mut found = glam::DVec2::ZERO;
        let mut ink = 0.0;
        for (i, pixel) in rgb.chunks_exact(3).enumerate() {
            // The paper is the brightest of what is painted; its noise cancels.
            let x = i % WIDTH as usize;
            let y = i / WIDTH as usize;
            let near = (glam::DVec2::new(x as f64, y as f64) - wanted).length() < 40.0;
            if near && pixel[1] < 150 {
                // Dark enough to be ink, of which an edge pixel has a part.
                let share = (190.0 - f64::from(pixel[1])).clamp(0.0, 160.0);
                found += glam::DVec2::new(x as f64, y as f64) * share;
                ink += share;
            }
        }
        found /= ink;
        assert!((found - wanted).length() < 0.15, "at {i}: {found} instead of {wanted}");
    }
}

#[test]
fn depth_is_the_plane_with_the_error_that_was_asked_for() {
    let mut scene = scene(BoardMotion::Wall);
    scene.depth_scale = 1.02;
    scene.depth_offset_mm = 5.0;
    let model = super::super::models::find("d435").unwrap();
    let painter = painter(&scene);
    let moment = Moment { world_start: HostTime::from_ns(0), capture: at(1.0), frame: 7 };
    let mut images = [true, false].map(|is_true| {
        let mut counts = vec![0u8; (WIDTH * HEIGHT * 2) as usize];
        painter.depth(&mut counts, model, is_true, moment);
        counts
            .as_chunks::<2>()
            .0
            .iter()
            .map(|c| f64::from(u16::from_le_bytes(*c)) * model.depth_unit_m)
            .collect::<Vec<_>>()
    });
    let board_from_camera = scene.pose(HostTime::from_ns(0), at(1.0)).unwrap().inverse();
    let camera = Camera::new(&lens()).unwrap();
    let mut off = 0.0;
    let mut seen = 0;
    for i in (0..images[0].len()).step_by(97) {
        let pixel = glam::DVec2::new((i % WIDTH as usize) as f64, (i / WIDTH as usize) as f64);
        let on_plane = board_from_camera.transform_point3(camera.unproject(pixel).unwrap() * images[0][i]);
        assert!(on_plane.z.abs() < 0.6e-3, "{pixel}: {on_plane}");
        if images[1][i] > 0.0 {
            off += images[1][i] - (1.02 * images[0][i] + 0.005);
            seen += 1;
        }
    }
    assert!(seen > 700 && (off / f64::from(seen)).abs() < 1e-4, "{seen} {off}");
    // Noise, and a hole here and there.
    assert!(images[1].iter().filter(|z| **z == 0.0).count() > 100);
    images[1].dedup();
    assert!(images[1].len() > 10_000);
}

#[test]
fn it_rests_and_moves_on() {
    let scene = scene(BoardMotion::Steps);
    let pose = |s: f64| scene.pose(HostTime::from_ns(0), at(s)).unwrap();
    assert_eq!(pose(0.1), pose(1.9));
    assert_ne!(pose(1.9), pose(2.6));
    assert_eq!(pose(2.6), pose(4.4));
    let step = (pose(2.2).translation - pose(2.21).translation).length();
    assert!(step < 0.02, "{step}");
    let away = BoardScene { motion: BoardMotion::Away, ..scene };
    assert!(away.pose(HostTime::from_ns(0), at(1.0)).is_none());
}

#[test]
fn ink_is_the_part_of_the_pixel_that_is_black() {
    let print = Print::new(&scene(BoardMotion::Steps).sheet);
    assert_eq!(print.ink([0.0, 0.0], [0.001, 0.001]), Some(1.0));
    assert_eq!(print.ink([0.1, 0.0], [0.001, 0.001]), Some(0.0));
    assert_eq!(print.ink([0.2, 0.0], [0.001, 0.001]), None);
    for share in [0.1, 0.25, 0.5, 0.9] {
        // The black edge is at 30 mm; a pixel of 1 mm.
        let x = 0.03 + (0.5 - share) * 1e-3;
        let ink = print.ink([x, 0.01], [1e-3, 1e-3]).unwrap();
        assert!((ink - share).abs() < 0.01, "{share}: {ink}");
    }
}
