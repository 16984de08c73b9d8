//! Records the images of one file and says what that cost; depthrig's part of `make bench-peers`:
//! `cargo run --release --example bench_frames -- OPTIONS FRAMES SETS OUT`.
//!
//! `OPTIONS` are `RecorderOptions` as JSON; with `"lent": true` the pixels' memory is lent, as it is on a rig, so that
//! the recorder may not keep it until the disk has taken the pixels. The file is what `tests/peers/frames.py` writes.
//! Measured is the CPU time of all threads from before the dataset is created until it is closed. Then every image is
//! read back, and where it was stored losslessly it must be the one that went in.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    Dataset, Pixels, RecordFrame, RecordSet, Recorder, RecorderOptions, Session, SetRange, StreamRecord,
};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

const CAMERAS: u64 = 7;
const PERIOD_NS: i64 = 200_000_000;

/// Colour and depth.
type Pair = [Arc<[u8]>; 2];

fn images(path: &Path) -> (u32, u32, Vec<Pair>) {
    let mut file = BufReader::new(std::fs::File::open(path).unwrap());
    let mut head = String::new();
    file.read_line(&mut head).unwrap();
    let head: Value = serde_json::from_str(&head).unwrap();
    let number = |key: &str| head[key].as_u64().unwrap();
    let w = number("width");
    let h = number("height");
    let mut read = |bytes: u64| {
        let mut buf = vec![0; bytes as usize];
        file.read_exact(&mut buf).unwrap();
        Arc::from(buf)
    };
    let pairs = (0..number("pairs")).map(|_| [read(3 * w * h), read(2 * w * h)]).collect();
    (w as u32, h as u32, pairs)
}

fn stream(id: &str, format: PixelFormat, width: u32, height: u32) -> StreamRecord {
    StreamRecord {
        id: id.parse().unwrap(),
        model: "bench".into(),
        serial: String::new(),
        format,
        width,
        height,
        rate_hz: 30.0,
        depth_unit_m: if format.is_depth() { 0.001 } else { 0.0 },
        calibration: "none".into(),
        intrinsics: Intrinsics::pinhole(600.0, 600.0, f64::from(width) / 2.0, f64::from(height) / 2.0),
        pose: Pose::IDENTITY,
    }
}

/// The image of a stream in a set: cameras take turns at them.
fn image(pool: &[Pair], stream: usize, set: u64) -> &Arc<[u8]> {
    &pool[(set as usize + stream / 2) % pool.len()][stream % 2]
}

/// Pixels in memory that others want back.
struct Lent(Arc<[u8]>);

impl Pixels for Lent {
    fn bytes(&self) -> &[u8] {
        &self.0
    }
}

fn set(session: &Session, pool: &[Pair], lent: bool, n: u64, begin: HostTime, utc: UtcPair) -> RecordSet {
    let tick = begin.plus_ns(n as i64 * PERIOD_NS);
    let frames = session.streams.iter().enumerate().map(|(stream, s)| {
        let pixels = Arc::clone(image(pool, stream, n));
        let pixels: Box<dyn Pixels> = if lent { Box::new(Lent(pixels)) } else { Box::new(pixels) };
        let mut header = FrameHeader::default();
        header.set_names("bench", &s.id);
        header.set_image(s.format, s.width, s.height);
        (header.sequence, header.capture_time_ns) = (n, tick.ns());
        (header.depth_unit_m, header.intrinsics) = (s.depth_unit_m, s.intrinsics);
        RecordFrame { stream, header, pixels }
    });
    RecordSet {
        id: n + 1,
        tick,
        utc,
        frames: frames.collect(),
        missing: Vec::new(),
        motion: Vec::new(),
        signals: Vec::new(),
        spread_ns: 0,
    }
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [options, frames, sets, out] = &args[..] else { panic!("OPTIONS FRAMES SETS OUT") };
    let mut asked: Value = serde_json::from_str(options).unwrap();
    let lent = asked.as_object_mut().unwrap().remove("lent").is_some_and(|lent| lent == true);
    let options: RecorderOptions = serde_json::from_value(asked.clone()).unwrap();
    let known = serde_json::to_value(&options).unwrap();
    for (key, value) in asked.as_object().unwrap() {
        assert_eq!(known.get(key), Some(value), "option {key} is unknown");
    }
    let sets: u64 = sets.parse().unwrap();
    let out = Path::new(out);
    let (width, height, pool) = images(Path::new(frames));
    let mut session = Session::new("bench", "bench");
    for i in 0..CAMERAS {
        session.streams.push(stream(&format!("cam{i}/color"), PixelFormat::Rgb8, width, height));
        session.streams.push(stream(&format!("cam{i}/depth"), PixelFormat::Z16, width, height));
    }
    let begin = HostTime::now();
    let utc = UtcPair::sample();
    let cpu = process_cpu_ns();
    let recorder = Recorder::create(Arc::new(RealFs), out, session.clone(), options).unwrap();
    for n in 0..sets {
        while recorder.progress().encode_queue >= 2 || recorder.progress().backlog_bytes > 64 << 20 {
            std::thread::sleep(Duration::from_micros(500));
        }
        recorder.push(set(&session, &pool, lent, n, begin, utc)).unwrap();
    }
    let summary = recorder.finish().unwrap();
    let cpu = process_cpu_ns() - cpu;
    let wall = HostTime::now().since_ns(begin);
    assert!(summary.complete && summary.sets.recorded == sets, "{:?}", summary.lost);

    let files = std::fs::read_dir(out).unwrap().map(|f| f.unwrap().metadata().unwrap().len());
    let disk_bytes: u64 = files.sum();
    let mut lossy = false;
    for s in Dataset::open(out).unwrap().sets(SetRange::ALL) {
        let s = s.unwrap();
        assert_eq!(s.frames.len(), session.streams.len());
        for f in s.frames {
            lossy |= f.codec == "jpeg";
            let same = f.pixels[..] == image(&pool, f.stream, s.id - 1)[..];
            assert!(same || f.codec == "jpeg", "set {}: {} changed an image", s.id, f.codec);
        }
    }
    let raw_bytes = sets * CAMERAS * u64::from(width * height) * 5;
    println!(
        "{}",
        json!({
            "cpu_s": cpu as f64 / 1e9, "wall_s": wall as f64 / 1e9, "raw_bytes": raw_bytes,
            "disk_bytes": disk_bytes, "pairs": sets * CAMERAS, "lossy": lossy,
        })
    );
}
