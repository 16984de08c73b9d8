//! Measures the search for boards, and the solver, each on one core: `cargo bench -p depthrig-calibrate`.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "../tests/common/mod.rs"]
mod common;

use common::{Random, mount, mount_cameras, mount_views};
use criterion::{Criterion, criterion_group, criterion_main};
use depthrig_bus::Distortion;
use depthrig_calibrate::adjustment::{AdjustedCamera, Corner};
use depthrig_calibrate::board::{Board, Drawing, Paper, Pattern};
use depthrig_calibrate::detect::{GrayImage, detector};
use depthrig_calibrate::intrinsics::{self, ImageSize, IntrinsicsOptions};
use depthrig_calibrate::rig::{RigOptions, calibrate_rig};
use glam::{DMat3, DVec2, DVec3};

/// Millimetres of a drawn sheet's texel.
const TEXEL_MM: f64 = 0.2;

/// An image of a board 0.5 m away, turned by 20 degrees about each axis, on a grey wall, with noise.
fn photo(board: &Board, width: usize, height: usize) -> Vec<u8> {
    let paper = Paper::around(board);
    let drawing = Drawing::new(board, paper).unwrap();
    let columns = (paper.width_mm / TEXEL_MM) as usize;
    let rows = (paper.height_mm / TEXEL_MM) as usize;
    let mut sheet = vec![215_u8; columns * rows];
    for r in &drawing.black {
        let texel = |mm: f64| (mm / TEXEL_MM).round() as usize;
        for row in sheet.chunks_mut(columns).skip(texel(r.y)).take(texel(r.height).max(1)) {
            row[texel(r.x)..texel(r.x + r.width)].fill(28);
        }
    }
    let turn = DMat3::from_rotation_x(0.35) * DMat3::from_rotation_y(0.35) * DMat3::from_rotation_z(0.2);
    let focal = 0.95 * width as f64;
    let center = DVec2::new(width as f64, height as f64) / 2.0;
    let at = DVec3::new(0.0, 0.0, 1.5 * paper.width_mm);
    let mut random = Random(3);
    let mut image = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let mut sum = 0.0;
            // Sixteen samples a pixel.
            for k in 0..16 {
                let inside = DVec2::new(f64::from(k % 4) + 0.5, f64::from(k / 4) + 0.5) / 4.0 - 0.5;
                let ray = ((DVec2::new(x as f64, y as f64) + inside - center) / focal).extend(1.0);
                let reach = at.dot(turn.z_axis) / ray.dot(turn.z_axis);
                let on = turn.transpose() * (ray * reach - at);
                let column = (on.x + paper.width_mm / 2.0) / TEXEL_MM;
                let row = (on.y + paper.height_mm / 2.0) / TEXEL_MM;
                let is_sheet = (0.0..columns as f64).contains(&column) && (0.0..rows as f64).contains(&row);
                sum +=
                    if is_sheet { f64::from(sheet[row as usize * columns + column as usize]) } else { 120.0 };
            }
            image.push((sum / 16.0 + random.normal()).round().clamp(0.0, 255.0) as u8);
        }
    }
    image
}

fn detection(c: &mut Criterion) {
    let mut group = c.benchmark_group("detection");
    let paper = Paper::parse("a3").unwrap();
    for (pattern, columns, rows) in
        [(Pattern::Charuco, 11, 8), (Pattern::Chessboard, 10, 7), (Pattern::Aprilgrid, 6, 5)]
    {
        let board = Board::for_paper(pattern, columns, rows, None, paper).unwrap();
        let detector = detector(&board).unwrap();
        for (width, height) in [(640, 480), (1280, 720)] {
            let pixels = photo(&board, width, height);
            let image = GrayImage::new(width, height, &pixels).unwrap();
            let found = detector.detect(&image).corners.len();
            assert!(
                found * 10 >= board.corner_count() * 9,
                "{pattern:?}: {found} of {}",
                board.corner_count()
            );
            group.bench_function(format!("{pattern:?} {width}x{height}"), |b| {
                b.iter(|| detector.detect(&image));
            });
        }
    }
    group.finish();
}

fn solver(c: &mut Criterion) {
    let mut group = c.benchmark_group("solver");
    group.sample_size(10);
    let truth = mount();
    let cameras = mount_cameras();
    let views = mount_views(&truth, 40, &mut Random(1));
    let of_first: Vec<Vec<Corner>> =
        views.iter().flat_map(|v| &v.seen).filter(|s| s.camera == 0).map(|s| s.corners.clone()).collect();
    let size = ImageSize { width: 640, height: 480 };
    let options = IntrinsicsOptions { model: Distortion::BrownConrady, ..IntrinsicsOptions::default() };
    let name = format!("intrinsics, {} views", of_first.len());
    group.bench_function(name, |b| {
        b.iter(|| intrinsics::calibrate(size, &of_first, &options).unwrap());
    });
    // The same without the choice of coefficients, for which ten parts of the views are fitted as well.
    let one = IntrinsicsOptions { free: Some(AdjustedCamera::all_free(options.model)), ..options };
    group.bench_function("intrinsics, one fit", |b| {
        b.iter(|| intrinsics::calibrate(size, &of_first, &one).unwrap());
    });
    group.bench_function("seven cameras, 40 views", |b| {
        b.iter(|| calibrate_rig(&cameras, &views, &RigOptions::default()).unwrap());
    });
    group.finish();
}

criterion_group!(benches, detection, solver);
criterion_main!(benches);
