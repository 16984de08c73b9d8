//! Writes the seeds of the fuzz targets: `cargo run --example fuzz_seeds -- fuzz/corpus`.
//!
//! Real recordings, as small as they can be: a fuzzer reaches more in a short file. Each is the start of a file in
//! `fuzz/corpus/TARGET`, where those that the fuzzer found lie too.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use depthrig_bus::{DropCounts, FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_recorder::codec::{DepthEncoder, DepthShape};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::fuzzing::mcap::File;
use depthrig_recorder::{
    ColorCodec, Compression, DepthCodec, Diagnostic, Level, RecordFrame, RecordSet, Recorder,
    RecorderOptions, Session, StreamAccount, StreamRecord,
};
use image::ImageFormat;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const UTC_NS: i64 = 1_700_000_000_000_000_000;
const MONO_NS: i64 = 1_000_000_000;
const PERIOD_NS: i64 = 200_000_000;
const SIZE: (u32, u32) = (8, 4);

fn stream(id: &str, format: PixelFormat) -> StreamRecord {
    StreamRecord {
        id: id.parse().unwrap(),
        model: "Seed".into(),
        serial: "1".into(),
        format,
        width: SIZE.0,
        height: SIZE.1,
        rate_hz: 30.0,
        depth_unit_m: if format.is_depth() { 0.001 } else { 0.0 },
        calibration: "made up".into(),
        intrinsics: Intrinsics::pinhole(9.0, 9.0, 4.0, 2.0),
        pose: Pose::IDENTITY,
    }
}

fn session(formats: &[PixelFormat]) -> Session {
    let mut session = Session::new("seed", "r");
    (session.scene, session.operator) = ("a gradient".into(), "nobody".into());
    (session.host, session.started_utc_ns) = ("h".into(), UTC_NS);
    session.rig_config = "# none\n".into();
    session.streams = formats.iter().map(|f| stream(&format!("c/{}", f.name()), *f)).collect();
    session
}

fn set(session: &Session, n: u64, missing: Option<usize>) -> RecordSet {
    let tick = MONO_NS + n as i64 * PERIOD_NS;
    let there = session.streams.iter().enumerate().filter(|(i, _)| Some(*i) != missing);
    let frames = there.map(|(stream, s)| {
        let mut header = FrameHeader::default();
        header.set_names(&session.rig, &s.id);
        header.set_picture(s.format, s.width, s.height);
        (header.sequence, header.captured) = (6 * n + 1, 6 * n + 1);
        (header.capture_time_ns, header.depth_unit_m) = (tick, s.depth_unit_m);
        (header.intrinsics, header.pose) = (s.intrinsics, s.pose);
        let bytes = header.payload_len;
        let pixels: Vec<u8> = (0..bytes).map(|i| (u64::from(i) / 2 + n) as u8).collect();
        RecordFrame { stream, header, pixels: Box::new(pixels) }
    });
    RecordSet {
        id: n + 1,
        tick: HostTime::from_ns(tick),
        utc: UtcPair { mono: HostTime::from_ns(MONO_NS), utc_ns: UTC_NS, width_ns: 200 },
        spread_ns: 0,
        missing: missing.into_iter().collect(),
        frames: frames.collect(),
    }
}

/// The session file and the segments of a recording.
fn record(session: &Session, options: &RecorderOptions, sets: u64, missing: Option<usize>) -> MemFs {
    let fs = MemFs::new();
    let options = RecorderOptions {
        workers: 1,
        queue_sets: sets as usize + 1,
        min_free_bytes: 0,
        reserve_bytes: 0,
        ..options.clone()
    };
    let dir = Path::new("/d");
    let recorder = Recorder::create(Arc::new(fs.clone()), dir, session.clone(), options).unwrap();
    recorder.add_note("a note").unwrap();
    recorder.diagnostics(vec![Diagnostic {
        level: Level::Ok,
        name: "r/c".into(),
        message: "streaming".into(),
        hardware_id: "1".into(),
        values: vec![("drift_ppm".into(), "1.5".into())],
    }]);
    recorder.update_accounts(vec![StreamAccount {
        stream: session.streams[0].id.clone(),
        captured: 3,
        delivered: 3,
        dropped: DropCounts::default(),
    }]);
    for n in 0..sets {
        recorder.push(set(session, n, missing.filter(|_| n == 1))).unwrap();
    }
    assert!(recorder.finish().unwrap().complete);
    fs
}

fn main() {
    let corpus = PathBuf::from(std::env::args().nth(1).expect("which folder?"));
    let put = |target: &str, name: &str, bytes: &[u8]| {
        let dir = corpus.join(target);
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join(name), bytes).unwrap();
        println!("{target}/{name}: {} bytes", bytes.len());
    };
    let raw = RecorderOptions { color: ColorCodec::Raw, ..RecorderOptions::default() };
    let plain = RecorderOptions { compression: Compression::None, ..raw.clone() };
    let lossless = RecorderOptions { color: ColorCodec::Png, depth: DepthCodec::Rank, ..raw.clone() };
    let kinds = [
        ("seed_lossless", vec![PixelFormat::Rgb8, PixelFormat::Z16], lossless),
        ("seed_jpeg", vec![PixelFormat::Rgb8, PixelFormat::Z16], RecorderOptions::default()),
        ("seed_raw", vec![PixelFormat::Bgr8, PixelFormat::DepthF32, PixelFormat::Mono8], raw),
        ("seed_plain", vec![PixelFormat::Z16, PixelFormat::Nv12], plain),
    ];
    for (name, formats, options) in kinds {
        let session = session(&formats);
        let fs = record(&session, &options, 3, Some(1));
        let dir = Path::new("/d");
        let segment = fs.contents(&dir.join("seg_0000.mcap")).unwrap();
        let segment = File::parse(&segment).unwrap().without_schema_text().to_bytes();
        put("segment", name, &segment);
        // The same without its end, as a killed process leaves it.
        put("segment", &format!("{name}_cut"), &segment[..segment.len() * 2 / 3]);
        // An odd length is an unfinished one's; enough that two sets are whole.
        put("recover", name, &segment[..(segment.len() * 7 / 10) | 1]);
        put("session", name, &fs.contents(&dir.join("session.toml")).unwrap());
        assert!(fs.read_dir(dir).unwrap().len() == 2);
    }
    for (name, shape) in [("seed_tight", [16, 12, 0]), ("seed_padded", [9, 5, 3])] {
        // The head that `fuzzing::depth_codec` reads: what follows, width, height, padding.
        let head = |kind: u8| vec![kind, shape[0], shape[1], shape[2]];
        let [width, height, pad] = shape.map(u32::from);
        let size = DepthShape { width, height, step: 2 * width + pad };
        let pixels: Vec<u8> = (0..=size.bytes() / 2)
            .flat_map(|i| (if i % 7 == 0 { 0 } else { 400 + 37 * (i % 11) as u16 }).to_le_bytes())
            .take(size.bytes() as usize)
            .collect();
        let mut packed = Vec::new();
        DepthEncoder::new().encode(&pixels, size, &mut packed).unwrap();
        let body = zstd::bulk::decompress(&packed[4..], 1 << 16).unwrap();
        put("depth_codec", &format!("{name}_packed"), &[head(0), packed.clone()].concat());
        put("depth_codec", &format!("{name}_body"), &[head(1), packed[..4].to_vec(), body].concat());
        put("depth_codec", &format!("{name}_pixels"), &[head(2), pixels].concat());
    }
    // The size, then the file, as `fuzzing::color_codec` reads it.
    let color: Vec<u8> = (0..8 * 6 * 3).map(|i| (i * 5) as u8).collect();
    let color = image::RgbImage::from_raw(8, 6, color).unwrap();
    for (name, format) in [("seed_png", ImageFormat::Png), ("seed_jpeg", ImageFormat::Jpeg)] {
        let mut file = Vec::new();
        color.write_to(&mut Cursor::new(&mut file), format).unwrap();
        put("color_codec", name, &[&[8, 6], &file[..]].concat());
    }
}
