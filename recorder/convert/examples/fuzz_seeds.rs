//! Writes the seeds of the fuzz targets: `cargo run --example fuzz_seeds -- fuzz/corpus`.
//!
//! Real recordings, as small as they can be: a fuzzer reaches more in a short file. Each is the start of a file in
//! `fuzz/corpus/TARGET`, where those that the fuzzer found lie too.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use core::ops::ControlFlow;
use depthrig_bus::{DropCounts, FrameHeader, HostTime, Intrinsics, MotionSample, PixelFormat, Pose, UtcPair};
use depthrig_convert::{ByteCameraExport, CameraNames, ExportOptions, export};
use depthrig_recorder::codec::{DepthEncoder, DepthShape};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::fuzzing::mcap::File;
use depthrig_recorder::{
    ColorCodec, Compression, Dataset, DepthCodec, Diagnostic, Level, MotionRecord, RecordFrame, RecordMotion,
    RecordSet, Recorder, RecorderOptions, Session, StreamAccount, StreamRecord,
};
use image::ImageFormat;
use std::io::{Cursor, Write};
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

/// A batch of two samples of an IMU.
fn batch(session: &Session, unit: usize, n: u64) -> RecordMotion {
    let record: &MotionRecord = &session.motion[unit];
    let sample = |k: u64| MotionSample {
        time_ns: MONO_NS + k as i64 * PERIOD_NS / 2,
        device_time: k,
        sequence: k + 1,
        gyro_rad_s: [0.5, -0.5, k as f32],
        ..MotionSample::default()
    };
    let samples = vec![sample(2 * n), sample(2 * n + 1)];
    let mut header = FrameHeader::default();
    header.set_names(&session.rig, &record.id);
    header.set_image(PixelFormat::Motion, 2, 1);
    (header.sequence, header.captured) = (n + 1, n + 1);
    header.capture_time_ns = samples[1].time_ns;
    RecordMotion { unit, header, samples }
}

fn set(session: &Session, n: u64, missing: Option<usize>) -> RecordSet {
    let tick = MONO_NS + n as i64 * PERIOD_NS;
    let there = session.streams.iter().enumerate().filter(|(i, _)| Some(*i) != missing);
    let frames = there.map(|(stream, s)| {
        let mut header = FrameHeader::default();
        header.set_names(&session.rig, &s.id);
        header.set_image(s.format, s.width, s.height);
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
        motion: (0..session.motion.len()).map(|unit| batch(session, unit, n)).collect(),
        signals: Vec::new(),
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

/// A record of a bag: fields, then data, both with their length.
fn bag_record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let fields: Vec<u8> =
        fields.iter().flat_map(|(k, v)| of_bag(&[k.as_bytes(), b"=", v].concat())).collect();
    [of_bag(&fields), of_bag(data)].concat()
}

/// Bytes or text of a bag.
fn of_bag(bytes: &[u8]) -> Vec<u8> {
    [&(bytes.len() as u32).to_le_bytes(), bytes].concat()
}

/// A bag as librealsense writes one, of `frames` images of two streams, with what is said of them.
fn bag(frames: u32, lz4: bool) -> Vec<u8> {
    let words = |w: &[u32]| w.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
    let floats = |w: &[f64]| w.iter().flat_map(|w| w.to_le_bytes()).collect::<Vec<u8>>();
    let said = |k: &str, v: &str| [of_bag(k.as_bytes()), of_bag(v.as_bytes())].concat();
    let mut out = b"#ROSBAG V2.0\n".to_vec();
    let mut topics: Vec<String> = Vec::new();
    let mut chunk = |time_ns: u32, messages: Vec<(String, Vec<u8>)>| {
        let mut body = Vec::new();
        for (topic, data) in messages {
            let known = topics.iter().position(|t| *t == topic);
            let conn = (known.unwrap_or(topics.len()) as u32).to_le_bytes();
            if known.is_none() {
                let fields = [("op", &[7][..]), ("conn", &conn), ("topic", topic.as_bytes())];
                body.extend(bag_record(&fields, b""));
                topics.push(topic);
            }
            let time = words(&[0, time_ns]);
            body.extend(bag_record(&[("op", &[2]), ("conn", &conn), ("time", &time)], &data));
        }
        let size = (body.len() as u32).to_le_bytes();
        let mut packed = lz4_flex::frame::FrameEncoder::new(Vec::new());
        packed.write_all(&body).unwrap();
        let packed = packed.finish().unwrap();
        let (how, data) = if lz4 { (&b"lz4"[..], &packed) } else { (&b"none"[..], &body) };
        out.extend(bag_record(&[("op", &[5]), ("compression", how), ("size", &size)], data));
    };
    let streams = ["/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"];
    let mut first = vec![
        ("/device_0/info".to_owned(), said("Name", "Intel RealSense D435")),
        ("/device_0/info".to_owned(), said("Serial Number", "1")),
        ("/device_0/sensor_0/option/Depth Units/value".to_owned(), 0.001f32.to_le_bytes().to_vec()),
        ("/device_0/sensor_2/Accel_0/imu/data".to_owned(), Vec::new()),
    ];
    let k = floats(&[0.1, 0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 4.0, 0.0, 9.0, 2.0, 0.0, 0.0, 1.0]);
    let info = [words(&[0, 0, 0, 0, 2, 4]), of_bag(b"Brown Conrady"), words(&[5]), k].concat();
    for stream in streams {
        first.push((format!("{stream}/info"), words(&[30])));
        first.push((format!("{stream}/info/camera_info"), info.clone()));
        first.push((format!("{stream}/tf/0"), floats(&[0.015, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])));
    }
    chunk(0, first);
    for n in 0..frames {
        for (stream, encoding, pixel) in [(streams[0], "mono16", 2), (streams[1], "rgb8", 3)] {
            let time_ns = 33_000_000 * n;
            let head = words(&[n, 0, time_ns, 0, 2, 4]);
            let step = words(&[4 * pixel]);
            let pixels: Vec<u8> = (0..8 * pixel).map(|i| (i + n) as u8).collect();
            let image = [head, of_bag(encoding.as_bytes()), vec![0], step, of_bag(&pixels)].concat();
            let mut messages = vec![(format!("{stream}/image/data"), image)];
            for (key, value) in [
                ("Frame Counter", (n + 7).to_string()),
                ("Sensor Timestamp", (33_000 * u64::from(n) + 4_294_950_000).to_string()),
                ("system_time", format!("{}.5", 1_534_232_519_732 + 33 * u64::from(n))),
                ("timestamp_domain", "Hardware Clock".to_owned()),
                ("Actual Exposure", "6452".to_owned()),
            ] {
                messages.push((format!("{stream}/image/metadata"), said(key, &value)));
            }
            chunk(time_ns, messages);
        }
    }
    out
}

/// An export of the layout `bytecameradepth`; the file system and the folder of the session.
fn exported() -> (MemFs, PathBuf) {
    let made = session(&[PixelFormat::Z16, PixelFormat::Rgb8, PixelFormat::DepthF32]);
    let fs = record(&made, &RecorderOptions::default(), 3, Some(1));
    let dataset = Dataset::open_with(Arc::new(fs.clone()), Path::new("/d")).unwrap();
    let mut exporter = ByteCameraExport::new(CameraNames::Short, None).unwrap();
    let to = Path::new("/e");
    let on = &mut |_| ControlFlow::Continue(());
    export(&fs, &mut exporter, vec![dataset], to, ExportOptions { workers: 1 }, on).unwrap();
    let folder = fs.read_dir(to).unwrap().into_iter().find(|e| e.is_dir).unwrap();
    (fs, to.join(folder.name))
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
        ("seed_plain", vec![PixelFormat::Z16, PixelFormat::Nv12], plain.clone()),
        ("seed_motion", vec![PixelFormat::Z16, PixelFormat::Mono8], plain),
    ];
    for (name, formats, options) in kinds {
        let mut session = session(&formats);
        if name == "seed_motion" {
            session.motion.push(MotionRecord {
                id: "c/imu".parse().unwrap(),
                model: "Seed".into(),
                serial: "1".into(),
                rate_hz: 10.0,
                batch: 2,
                calibration: "made up".into(),
                pose: Pose::IDENTITY,
            });
        }
        let fs = record(&session, &options, 3, Some(1));
        let dir = Path::new("/d");
        let segment = fs.contents(&dir.join("seg_0000.mcap")).unwrap();
        let segment = File::parse(&segment).unwrap().without_schema_text().to_bytes();
        put("segment", name, &segment);
        // The same without its end, as a killed process leaves it.
        put("segment", &format!("{name}_cut"), &segment[..segment.len() * 2 / 3]);
        // An unfinished dataset may end at an odd length; this is enough for two complete sets.
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
    let mut jpeg = Vec::new();
    jpeg_encoder::Encoder::new(&mut jpeg, 75).encode(&color, 8, 6, jpeg_encoder::ColorType::Rgb).unwrap();
    let mut png = Vec::new();
    let color = image::RgbImage::from_raw(8, 6, color).unwrap();
    color.write_to(&mut Cursor::new(&mut png), ImageFormat::Png).unwrap();
    for (name, file) in [("seed_png", png), ("seed_jpeg", jpeg)] {
        put("color_codec", name, &[&[8, 6], &file[..]].concat());
    }
    put("rosbag", "seed_plain", &bag(2, false));
    put("rosbag", "seed_lz4", &bag(3, true));
    let (fs, folder) = exported();
    let file = |name: &str| fs.contents(&folder.join(name)).unwrap();
    put("calibration_json", "seed_export", &file("calibration.json"));
    let rows = String::from_utf8(file("frames.csv")).unwrap();
    for (n, row) in rows.lines().skip(1).enumerate() {
        put("frames_csv", &format!("seed_row_{n}"), row.as_bytes());
    }
    let metres = fs.read_dir(&folder.join("camera_c")).unwrap();
    let metres = metres.iter().find(|e| e.name.starts_with("raw_depth_")).unwrap();
    put("npy", "seed_metres", &file(&format!("camera_c/{}", metres.name)));
    let mut array = b"\x93NUMPY\x02\x00\x3d\0\0\0".to_vec();
    array.extend(b"{'descr': '|u1', 'fortran_order': False, 'shape': (2, 3), } \n123456");
    put("npy", "seed_bytes", &array);
}
