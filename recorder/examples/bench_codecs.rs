//! The depth codecs side by side on real images, one core: `cargo run --release --example bench_codecs -p
//! depthrig-recorder -- depth_1.png depth_2.png ...` (16-bit PNG). MB are of raw pixels per second of CPU time.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use depthrig_bus::clock::thread_cpu_ns;
use depthrig_recorder::codec::{DepthDecoder, DepthEncoder, DepthShape};

/// MB per second of CPU time: the best of several runs, because only disturbance makes one slower.
fn speed(bytes: usize, mut work: impl FnMut()) -> f64 {
    let mut best = i64::MAX;
    let rounds = (60_000_000 / bytes).clamp(5, 60);
    for _ in 0..rounds {
        let before = thread_cpu_ns();
        work();
        best = best.min(thread_cpu_ns() - before);
    }
    bytes as f64 * 1e3 / best as f64
}

fn main() {
    let mut encoder = DepthEncoder::new();
    let mut decoder = DepthDecoder::new();
    let mut zstd = zstd::bulk::Compressor::new(1).unwrap();
    let mut unzstd = zstd::bulk::Decompressor::new().unwrap();
    let mut logs = [0.0f64; 6];
    let mut n = 0.0;
    println!(
        "{:<44} {:>6} | {:>6} {:>6} {:>6} | {:>6} {:>6} {:>6}",
        "depth image", "levels", "rank", "enc", "dec", "zstd1", "enc", "dec"
    );
    for path in std::env::args().skip(1) {
        let image::DynamicImage::ImageLuma16(image) = image::open(&path).unwrap() else {
            println!("{path}: not a 16-bit grey image");
            continue;
        };
        let shape = DepthShape { width: image.width(), height: image.height(), step: 2 * image.width() };
        let bytes: Vec<u8> = image.iter().flat_map(|v| v.to_le_bytes()).collect();
        let mut packed = Vec::new();
        let mut back = Vec::new();
        let encode = speed(bytes.len(), || {
            packed.clear();
            encoder.encode(&bytes, shape, &mut packed).unwrap();
        });
        let decode = speed(bytes.len(), || decoder.decode(&packed, shape, &mut back).unwrap());
        assert!(back == bytes, "{path} does not come back");
        let mut plain = vec![0; zstd::zstd_safe::compress_bound(bytes.len())];
        let mut len = 0;
        let zencode = speed(bytes.len(), || len = zstd.compress_to_buffer(&bytes, &mut plain[..]).unwrap());
        let zdecode = speed(bytes.len(), || {
            unzstd.decompress_to_buffer(&plain[..len], &mut back[..]).unwrap();
        });
        let ratio = |len: usize| bytes.len() as f64 / len as f64;
        let row = [ratio(packed.len()), encode, decode, ratio(len), zencode, zdecode];
        let levels = u32::from_le_bytes([packed[0], packed[1], packed[2], packed[3]]);
        let name = &path[path.len().saturating_sub(44)..];
        println!(
            "{name:<44} {levels:>6} | {:>6.2} {:>6.0} {:>6.0} | {:>6.2} {:>6.0} {:>6.0}",
            row[0], row[1], row[2], row[3], row[4], row[5]
        );
        logs.iter_mut().zip(row).for_each(|(l, r)| *l += r.ln());
        n += 1.0;
    }
    let m = logs.map(|l| (l / n).exp());
    println!(
        "{:<44} {:>6} | {:>6.2} {:>6.0} {:>6.0} | {:>6.2} {:>6.0} {:>6.0}",
        "geometric mean", "", m[0], m[1], m[2], m[3], m[4], m[5]
    );
}
