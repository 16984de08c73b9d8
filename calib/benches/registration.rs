//! Measures registration at 1280x720: `cargo bench -p depthrig-calib`.
#![allow(clippy::unwrap_used)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_calib::Registration;

const SIZE: (u32, u32) = (1280, 720);
const PIXELS: usize = 1280 * 720;

/// A room with boxes in it, noise and holes, as a D435 sees it.
fn depth() -> Vec<u16> {
    let mut state = 1u32;
    (0..PIXELS)
        .map(|i| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let x = i % 1280;
            let y = i / 1280;
            let is_box = (x / 160 + y / 120) % 3 == 0;
            let z = if is_box { 900 } else { 1500 + y as u32 };
            if state >> 24 < 6 { 0 } else { (z + (state >> 16) % 5) as u16 }
        })
        .collect()
}

fn registration(c: &mut Criterion) {
    let depth = depth();
    let of_depth = Intrinsics::pinhole(641.3, 641.3, 642.7, 358.2);
    let straight = Intrinsics::pinhole(911.8, 911.2, 645.1, 364.9);
    let coeffs = [-0.055, 0.064, 0.0007, 0.0002, -0.02, 0.0, 0.0, 0.0];
    let lens = Intrinsics { coeffs, model: Distortion::InverseBrownConrady as u32, ..straight };
    let wide = Intrinsics { coeffs, model: Distortion::BrownConrady as u32, ..of_depth };
    let pose = Pose {
        translation_m: [0.014_75, 0.000_13, 0.000_27],
        rotation_xyzw: [0.0015, -0.001, 0.002, 0.999_996],
    };
    let mut group = c.benchmark_group("registration 1280x720");
    group.throughput(Throughput::Elements(PIXELS as u64));
    let mut out = vec![0; PIXELS];
    let cases = [
        ("pinholes", of_depth, straight),
        ("colour distorted", of_depth, lens),
        ("both distorted", wide, lens),
    ];
    for (name, depth_k, color_k) in &cases {
        let mut r = Registration::new(depth_k, SIZE, color_k, SIZE, &pose).unwrap();
        group.bench_function(*name, |b| b.iter(|| r.depth_to_color(&depth, 0.001, &mut out).unwrap()));
    }
    let color = vec![77; PIXELS * 3];
    let mut painted = vec![0; PIXELS * 3];
    let mut r = Registration::new(&of_depth, SIZE, &straight, SIZE, &pose).unwrap();
    group.bench_function("colour to depth", |b| {
        b.iter(|| r.color_to_depth(&depth, 0.001, &color, &mut painted).unwrap());
    });
    group.finish();
}

criterion_group!(benches, registration);
criterion_main!(benches);
