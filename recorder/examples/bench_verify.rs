//! How fast a dataset is verified: `cargo run --release --example bench_verify -p depthrig-recorder -- DIR IMAGES
//! [MB] [rank]` records seven cameras of 1280x720 from the images of a folder (8-bit PNG or JPEG, 16-bit PNG, tiled)
//! into DIR until it has MB (1000), verifies it and removes it. MB are of the file; per core is per second of CPU time.
#![allow(clippy::print_stdout, clippy::unwrap_used)]

use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    DepthCodec, RecordFrame, RecordSet, Recorder, RecorderOptions, Session, StreamRecord, VerifyOptions,
    verify,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 720;

fn images(dir: &Path, color: &mut Vec<Arc<[u8]>>, depth: &mut Vec<Arc<[u8]>>) {
    let mut paths: Vec<_> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            images(&path, color, depth);
            continue;
        }
        let Ok(image) = image::open(&path) else { continue };
        let w = image.width();
        let h = image.height();
        let places = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (x % w, y % h)));
        match image {
            image::DynamicImage::ImageLuma16(p) => {
                depth.push(places.flat_map(|(x, y)| p.get_pixel(x, y).0[0].to_le_bytes()).collect());
            }
            other => {
                let p = other.into_rgb8();
                color.push(places.flat_map(|(x, y)| p.get_pixel(x, y).0).collect());
            }
        }
    }
}

fn stream(camera: usize, name: &str, format: PixelFormat) -> StreamRecord {
    StreamRecord {
        id: format!("cam{camera}/{name}").parse().unwrap(),
        model: "bench".into(),
        serial: String::new(),
        format,
        width: WIDTH,
        height: HEIGHT,
        rate_hz: 30.0,
        depth_unit_m: if format.is_depth() { 0.001 } else { 0.0 },
        calibration: "made up".into(),
        intrinsics: Intrinsics::pinhole(600.0, 600.0, 640.0, 360.0),
        pose: Pose::IDENTITY,
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [dir, folder, ..] = args.as_slice() else { panic!("usage: bench_verify DIR IMAGES [MB] [rank]") };
    let mb: u64 = args.get(2).map_or(1000, |n| n.parse().unwrap());
    let depth_codec = if args.iter().any(|a| a == "rank") { DepthCodec::Rank } else { DepthCodec::Zstd };
    let mut color = Vec::new();
    let mut depth = Vec::new();
    images(Path::new(folder), &mut color, &mut depth);
    let dir = PathBuf::from(dir).join(format!("depthrig-bench-verify-{}", std::process::id()));
    let mut session = Session::new("bench", "bench");
    for camera in 0..7 {
        session.streams.push(stream(camera, "color", PixelFormat::Rgb8));
        session.streams.push(stream(camera, "depth", PixelFormat::Z16));
    }
    let options = RecorderOptions { depth: depth_codec, min_free_bytes: 0, ..RecorderOptions::default() };
    let recorder = Recorder::create(Arc::new(RealFs), &dir, session.clone(), options).unwrap();
    let start = HostTime::now();
    let utc = UtcPair::sample();
    for n in 0.. {
        let tick = start.plus_ns(n as i64 * 200_000_000);
        while recorder.progress().encode_queue >= 3 || recorder.progress().backlog_bytes > 64 << 20 {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        if recorder.progress().bytes > mb * 1_000_000 {
            break;
        }
        let frames = session.streams.iter().enumerate().map(|(stream, s)| {
            let pool = if s.format == PixelFormat::Z16 { &depth } else { &color };
            let image = &pool[(n as usize + stream) % pool.len()];
            let mut header = FrameHeader::default();
            header.set_names("bench", &s.id);
            header.set_image(s.format, WIDTH, HEIGHT);
            (header.sequence, header.captured) = (6 * n + 1, 6 * n + 1);
            header.capture_time_ns = tick.ns();
            header.depth_unit_m = s.depth_unit_m;
            header.intrinsics = s.intrinsics;
            RecordFrame { stream, header, pixels: Box::new(Arc::clone(image)) }
        });
        let set = RecordSet {
            id: n + 1,
            tick,
            utc,
            frames: frames.collect(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        recorder.push(set).unwrap();
    }
    let summary = recorder.finish().unwrap();
    assert!(summary.complete, "{:?}", summary.lost);
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    println!("{} sets, {:.0} MB, load {}", summary.sets.recorded, summary.bytes as f64 / 1e6, load.trim());
    for (name, decode, threads) in [
        ("verify", false, 0),
        ("verify", false, 0),
        ("verify --decode --threads 1", true, 1),
        ("verify --decode", true, 0),
    ] {
        let begin = HostTime::now();
        let cpu = process_cpu_ns();
        let report = verify(&dir, &VerifyOptions { decode, threads, ..VerifyOptions::default() }).unwrap();
        let wall = begin.elapsed().as_secs_f64();
        let cpu = (process_cpu_ns() - cpu) as f64 / 1e9;
        assert!(report.is_whole(), "{:?}", report.findings.first());
        let mb = report.bytes as f64 / 1e6;
        println!(
            "{name:<28} {wall:>6.2} s wall, {cpu:>6.2} s CPU: {:>6.0} MB/s, {:>6.0} MB/s per core",
            mb / wall,
            mb / cpu
        );
    }
    std::fs::remove_dir_all(&dir).unwrap();
}
