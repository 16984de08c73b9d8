//! Cost of unpacking an L515's images: turned depth against a plain copy and against the two loops of the rule.
#![allow(missing_docs)]

use core::hint::black_box;
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use depthrig_driver::unpack::{turn, y411};

/// The rule as it is written: down a column of the image for each row that came.
fn two_loops(from: &[u8], columns: usize, to: &mut [u8]) {
    let rows = from.len() / (2 * columns);
    let (from, _) = from.as_chunks::<2>();
    let (to, _) = to.as_chunks_mut::<2>();
    for i in 0..rows {
        for j in 0..columns {
            to[(columns - 1 - j) * rows + rows - 1 - i] = from[i * columns + j];
        }
    }
}

fn benches(c: &mut Criterion) {
    for (columns, rows) in [(480, 640), (768, 1024)] {
        let from: Vec<u8> = (0..columns * rows * 2).map(|i| i as u8).collect();
        let mut to = vec![0; from.len()];
        let mut group = c.benchmark_group(format!("l515 {rows}x{columns}"));
        group.throughput(Throughput::Bytes(from.len() as u64));
        group.bench_function("copy", |b| b.iter(|| to.copy_from_slice(black_box(&from))));
        group.bench_function("two loops", |b| b.iter(|| two_loops(black_box(&from), columns, &mut to)));
        group.bench_function("depth", |b| b.iter(|| turn::turn::<2>(black_box(&from), columns, &mut to)));
        let grey = &from[..columns * rows];
        let out = &mut to[..columns * rows];
        group.bench_function("infrared", |b| b.iter(|| turn::turn::<1>(black_box(grey), columns, out)));
        let half = &from[..columns * rows / 2];
        group.bench_function("confidence", |b| {
            b.iter(|| turn::confidence(black_box(half), columns / 2, &mut to[..columns * rows]));
        });
        group.finish();
    }
    let from: Vec<u8> = (0..1920 * 1080 * 3 / 2).map(|i| i as u8).collect();
    let mut to = vec![0; from.len()];
    let mut group = c.benchmark_group("l515 1920x1080");
    group.throughput(Throughput::Bytes(from.len() as u64));
    group.bench_function("copy", |b| b.iter(|| to.copy_from_slice(black_box(&from))));
    group.bench_function("colour (Y411)", |b| b.iter(|| y411::to_nv12(black_box(&from), 1920, &mut to)));
    group.finish();
}

criterion_group!(turned, benches);
criterion_main!(turned);
