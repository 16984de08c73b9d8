//! Updates per second of the clock map: 30 fps with jitter for ten minutes of device time, and the same with a
//! stall every second. Run with `cargo bench -p depthrig-drivers --bench clock`.
#![allow(missing_docs)]

use criterion::{BatchSize, Criterion, Throughput, criterion_group, criterion_main};
use depthrig_bus::HostTime;
use depthrig_driver::clock::{ClockConfig, ClockMap};

const FRAMES: u64 = 18_000;
const PERIOD_NS: u64 = 33_333_333;

/// Counter and arrival of frame `i`: a clock 50 ppm fast, 3 ms of latency, up to 2 ms of jitter.
fn frame(i: u64, stalls: bool) -> (u64, HostTime) {
    let time_ns = i * PERIOD_NS;
    let raw = ((time_ns + time_ns / 20_000) / 1000) & 0xffff_ffff;
    let random = i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32;
    let arrival = time_ns + 3_000_000 + ((random * random) >> 32) * 2_000_000 / 0xffff_ffff;
    let stall = if stalls && i % 30 < 4 { (4 - i % 30) * PERIOD_NS } else { 0 };
    (raw, HostTime::from_ns((arrival + stall) as i64))
}

fn observe(c: &mut Criterion) {
    let mut group = c.benchmark_group("clock");
    group.throughput(Throughput::Elements(FRAMES));
    for (name, stalls) in [("nominal", false), ("stalls", true)] {
        let frames: Vec<_> = (0..FRAMES).map(|i| frame(i, stalls)).collect();
        group.bench_function(name, |b| {
            b.iter_batched_ref(
                || ClockMap::new(ClockConfig::new(32, 1000.0, PERIOD_NS)),
                |map| {
                    let mut last = HostTime::default();
                    for (i, &(raw, arrival)) in frames.iter().enumerate() {
                        last = map.observe(raw, i as u64, arrival).capture_time;
                    }
                    last
                },
                BatchSize::SmallInput,
            );
        });
    }
    group.finish();
}

criterion_group!(benches, observe);
criterion_main!(benches);
