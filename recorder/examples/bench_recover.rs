//! How fast an unfinished recording of seven cameras is recovered, and where the time goes:
//! `cargo run --release --example bench_recover -p depthrig-recorder -- [FOLDER] [MB]`.
#![allow(clippy::unwrap_used)] // a bench stops at the first thing that does not work

use core::ops::ControlFlow;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    RecordFrame, RecordSet, Recorder, RecorderOptions, RecoverOptions, Session, StreamRecord, VerifyOptions,
    recover, verify,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 720;
/// Bytes of a 720p JPEG at quality 95, 4:4:4.
const JPEG_BYTES: usize = 250_000;

fn session() -> Session {
    let mut session = Session::new("bench", "rig");
    for camera in 0..7 {
        for (stream, format) in [("color", PixelFormat::Mjpeg), ("depth", PixelFormat::Z16)] {
            session.streams.push(StreamRecord {
                id: format!("cam{camera}/{stream}").parse().unwrap(),
                model: "bench".into(),
                serial: camera.to_string(),
                format,
                width: WIDTH,
                height: HEIGHT,
                rate_hz: 30.0,
                depth_unit_m: 0.001,
                calibration: "none".into(),
                intrinsics: Intrinsics::default(),
                pose: Pose::IDENTITY,
            });
        }
    }
    session
}

/// Depth of a slope with the noise and the holes of a stereo camera; the JPEG is noise behind its first bytes.
fn images() -> [Arc<[u8]>; 2] {
    let mut state = 1u32;
    let mut noise = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        state >> 24
    };
    let mut jpeg = vec![0xFF, 0xD8, 0xFF];
    jpeg.extend((3..JPEG_BYTES).map(|_| noise() as u8));
    let mut depth = Vec::new();
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let hole = (x / 40 + y / 30) % 9 == 0;
            let z = if hole { 0 } else { 800 + x / 4 + y / 3 + u32::from(noise() < 40) };
            depth.extend((z as u16).to_le_bytes());
        }
    }
    [jpeg.into(), depth.into()]
}

/// Bytes a second: six times what seven cameras at 5 Hz write. Without it all would be recorded between two checkpoints,
/// which come once a second, and what no checkpoint proves has to be unpacked.
const PACE: f64 = 100e6;

/// Records until the file has `bytes` and leaves it as a killed process does.
fn record(dir: &Path, bytes: u64) {
    let session = session();
    let images = images();
    let options =
        RecorderOptions { segment_max_ns: i64::MAX, segment_max_bytes: u64::MAX, ..Default::default() };
    let r = Recorder::create(Arc::new(RealFs), dir, session.clone(), options).unwrap();
    let began = HostTime::now();
    for n in 0.. {
        let frames = (0..session.streams.len()).map(|i| {
            let pixels = Arc::clone(&images[i % 2]);
            let mut header = FrameHeader::default();
            header.set_names("rig", &session.streams[i].id);
            header.set_image(session.streams[i].format, WIDTH, HEIGHT);
            // The recording numbers its frames from 1, and loses none.
            (header.sequence, header.captured) = (n + 1, n + 1);
            header.capture_time_ns = n as i64;
            header.payload_len = pixels.len() as u32;
            RecordFrame { stream: i, header, pixels: Box::new(pixels) }
        });
        let utc = UtcPair { mono: HostTime::from_ns(0), utc_ns: 1_700_000_000_000_000_000, width_ns: 0 };
        let tick = HostTime::from_ns(200_000_000 * n as i64);
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
        r.push(set).unwrap();
        let behind = |r: &Recorder| {
            r.progress().encode_queue > 2 || began.elapsed().as_secs_f64() * PACE < r.progress().bytes as f64
        };
        while behind(&r) {
            std::thread::sleep(Duration::from_millis(1));
        }
        if r.progress().bytes >= bytes {
            break;
        }
    }
    drop(r);
}

fn main() {
    let mut args = std::env::args().skip(1);
    let folder = args.next().map_or_else(std::env::temp_dir, PathBuf::from);
    let mb: u64 = args.next().map_or(1000, |n| n.parse().unwrap());
    let dir = folder.join(format!("bench_recover_{}", std::process::id()));
    record(&dir, mb * 1_000_000);
    let part = dir.join("seg_0000.mcap.part");
    let torn = dir.join("torn");
    std::fs::rename(&part, &torn).unwrap();
    for tail in [0, 1000] {
        let _ = std::fs::remove_file(dir.join("seg_0000.mcap"));
        std::fs::copy(&torn, &part).unwrap();
        let file = std::fs::OpenOptions::new().write(true).open(&part).unwrap();
        let bytes = file.metadata().unwrap().len() - tail;
        file.set_len(bytes).unwrap();
        file.sync_all().unwrap();
        for dry_run in [true, false] {
            let cpu = depthrig_bus::clock::process_cpu_ns();
            let began = HostTime::now();
            let options = RecoverOptions { dry_run, ..Default::default() };
            let report = recover(&dir, &options, &mut |_| ControlFlow::Continue(())).unwrap();
            let wall = began.elapsed().as_secs_f64();
            let cpu = depthrig_bus::clock::process_cpu_ns() - cpu;
            println!(
                "{} MB, {tail} bytes cut off, {}: {} sets, {:.0} MB/s, {:.2} s, {:.2} s of CPU",
                bytes / 1_000_000,
                if dry_run { "dry run" } else { "recovered and proven" },
                report.sets,
                bytes as f64 / 1e6 / wall,
                wall,
                cpu as f64 * 1e-9,
            );
        }
    }
    std::fs::remove_file(&torn).unwrap();
    let found = verify(&dir, &VerifyOptions::default()).unwrap();
    println!("verified: {} sets, worst {:?}", found.sets, found.worst());
    for finding in found.findings.iter().filter(|f| f.severity > depthrig_recorder::Severity::Note) {
        println!("  {}: {}", finding.file, finding.message);
    }
    std::fs::remove_dir_all(&dir).unwrap();
}
