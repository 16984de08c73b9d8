//! Bytes per second from a camera's image into lent memory: both halves of a side-by-side image, beside one plain copy
//! of it. Run with `cargo bench -p depthrig-driver --bench side_by_side`.
#![allow(missing_docs)]

use core::hint::black_box;
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use depthrig_driver::unpack::{Half, copy_half, copy_rows};

fn side_by_side(c: &mut Criterion) {
    for (name, width, height) in [("VGA", 672, 376), ("HD720", 1280, 720), ("2K", 2208, 1242)] {
        let half = 2 * width;
        let image: Vec<u8> = (0..2 * half * height).map(|i| (i * 31) as u8).collect();
        let mut left = vec![0; half * height];
        let mut right = vec![0; half * height];
        let mut whole = vec![0; image.len()];
        let mut group = c.benchmark_group(format!("side by side, {name}"));
        group.throughput(Throughput::Bytes(image.len() as u64));
        group.bench_function("two halves", |b| {
            b.iter(|| {
                let from = black_box(&image);
                copy_half(from, 2 * half, half, Half::Left, &mut left)
                    .and_then(|()| copy_half(from, 2 * half, half, Half::Right, &mut right))
            });
        });
        group.bench_function("one plain copy", |b| {
            b.iter(|| copy_rows(black_box(&image), 2 * half, 2 * half, &mut whole));
        });
        group.finish();
    }
}

criterion_group!(benches, side_by_side);
criterion_main!(benches);
