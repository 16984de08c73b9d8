//! Writes a short dataset that is always the same, and what readers must find in it:
//! `cargo run -p depthrig-tests --example golden -- DATASET EXPECTED [raw|rank|stereo]`: colour as JPEG, as it is, as
//! PNG with depth in our own codec, or as JPEG beside a raw stereo pair. EXPECTED is as `depthrig_tests::expected`
//! writes it.
#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout)]

use depthrig_bus::{
    DropCounts, FrameHeader, HostTime, Intrinsics, MotionFlags, MotionSample, PixelFormat, Pose, UtcPair,
};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    ColorCodec, Dataset, DepthCodec, Diagnostic, Level, MotionRecord, RecordFrame, RecordMotion, RecordSet,
    Recorder, RecorderOptions, Session, SetRange, StreamAccount, StreamRecord,
};
use depthrig_tests::expected;
use std::path::Path;
use std::sync::Arc;

const NOTE: &str = "the golden note";
const SETS: u64 = 6;
const PERIOD_NS: i64 = 200_000_000;
const UTC_NS: i64 = 1_700_000_000_000_000_000;
const MONO_NS: i64 = 1_000_000_000;

fn stream(id: &str, format: PixelFormat, w: u32, h: u32, unit: f64) -> StreamRecord {
    let mut intrinsics =
        Intrinsics::pinhole(1.1 * f64::from(w), 1.1 * f64::from(w), 0.5 * f64::from(w), 0.5 * f64::from(h));
    intrinsics.model = 2;
    intrinsics.coeffs[..5].copy_from_slice(&[0.01, -0.02, 0.001, 0.0005, 0.003]);
    StreamRecord {
        id: id.parse().unwrap(),
        model: "Golden".into(),
        serial: "1".into(),
        format,
        width: w,
        height: h,
        rate_hz: 30.0,
        depth_unit_m: unit,
        calibration: "made up for the golden dataset".into(),
        intrinsics,
        pose: Pose { translation_m: [0.25, 0.0, 0.5], rotation_xyzw: [0.5, -0.5, 0.5, -0.5] },
    }
}

fn pixels(s: &StreamRecord, n: u64) -> Vec<u8> {
    let mut out = Vec::new();
    for y in 0..s.height {
        for x in 0..s.width {
            let v = x + 2 * y + 5 * n as u32 + if x > s.width / 2 { 90 } else { 0 };
            match s.format {
                PixelFormat::Rgb8 => out.extend([v as u8, (v / 3) as u8, 255 - (v / 2) as u8]),
                // Every bit of the sixteen is in use, and there are holes.
                PixelFormat::Z16 => out.extend(if (x + y) % 13 == 0 {
                    [0, 0]
                } else {
                    (v as u16).wrapping_mul(67).to_le_bytes()
                }),
                PixelFormat::Yuyv => out.extend([v as u8, (if x % 2 == 0 { x } else { y }) as u8]),
                _ => out.push(v as u8),
            }
        }
    }
    out
}

/// The two batches that the IMU sends between set `n` and the one before, of five and of three samples.
fn motion(unit: &MotionRecord, n: u64) -> Vec<RecordMotion> {
    let sample = |k: u64| {
        let v = k as f32;
        MotionSample {
            time_ns: MONO_NS + k as i64 * PERIOD_NS / 8 - PERIOD_NS,
            device_time: 3_000_000_000 + 25_000 * k,
            sequence: k + 1,
            uncertainty_ns: 40_000,
            accel_offset_ns: 1_250_000,
            gyro_rad_s: [0.1 * v, -0.25, 1e-3 / (v + 1.0)],
            // One has no acceleration.
            accel_m_s2: if k == 6 { [f32::NAN; 3] } else { [0.02, 9.806_65, -0.1 * v] },
            temperature_c: 33.25,
            flags: if k.is_multiple_of(8) { MotionFlags::FRAME_SYNC.0 } else { 0 },
        }
    };
    let batch = |b: u64, from: u64, to: u64| {
        let samples: Vec<_> = (from..to).map(|k| sample(8 * n + k)).collect();
        let mut header = FrameHeader::default();
        header.set_names("golden", &unit.id);
        header.set_device(&unit.model, &unit.serial);
        header.set_image(PixelFormat::Motion, samples.len() as u32, 1);
        (header.sequence, header.captured) = (2 * n + b, 2 * n + b);
        header.device_sequence = 8 * n + to;
        header.capture_time_ns = samples[samples.len() - 1].time_ns;
        header.pose = unit.pose;
        RecordMotion { unit: 0, header, samples }
    };
    vec![batch(1, 0, 5), batch(2, 5, 8)]
}

fn write(dir: &Path, color: ColorCodec, depth: DepthCodec, stereo: bool) {
    let mut session = Session::new(dir.file_name().unwrap().to_string_lossy(), "golden");
    (session.scene, session.started_utc_ns) = ("a gradient with an edge".into(), UTC_NS);
    session.rig_config = "# the golden rig\n".into();
    session.streams = vec![
        stream("front/color", PixelFormat::Rgb8, 160, 120, 0.0),
        stream("front/depth", PixelFormat::Z16, 160, 120, 0.001),
        stream("front/ir_left", PixelFormat::Mono8, 96, 64, 0.0),
        stream("near/depth", PixelFormat::Z16, 128, 72, 0.0001),
    ];
    if stereo {
        let left = stream("stereo/left", PixelFormat::Yuyv, 96, 54, 0.0);
        // A lens of its own, and a baseline to the left.
        let mut right = StreamRecord { id: "stereo/right".parse().unwrap(), ..left.clone() };
        (right.intrinsics.cx, right.intrinsics.coeffs[0]) = (49.5, 0.012);
        right.pose.translation_m[1] -= 0.12;
        session.streams.extend([left, right]);
    }
    session.motion = vec![MotionRecord {
        id: "front/imu".parse().unwrap(),
        model: "Golden".into(),
        serial: "1".into(),
        rate_hz: 8e9 / PERIOD_NS as f64,
        batch: 5,
        calibration: "made up for the golden dataset".into(),
        pose: Pose { translation_m: [0.2, 0.01, 0.45], rotation_xyzw: [0.0, 0.6, 0.0, 0.8] },
    }];
    // Two segments, and room on any disk.
    let options = RecorderOptions {
        color,
        depth,
        segment_max_ns: 4 * PERIOD_NS,
        min_free_bytes: 0,
        queue_sets: SETS as usize,
        ..RecorderOptions::default()
    };
    let recorder = Recorder::create(Arc::new(RealFs), dir, session.clone(), options).unwrap();
    recorder.add_note(NOTE).unwrap();
    recorder.diagnostics(vec![Diagnostic {
        level: Level::Ok,
        name: "golden/front".into(),
        message: "streaming".into(),
        hardware_id: "1".into(),
        values: vec![("drift_ppm".into(), "1.5".into())],
    }]);
    recorder.update_accounts(vec![StreamAccount {
        stream: "front/depth".parse().unwrap(),
        captured: 40,
        delivered: 38,
        dropped: DropCounts([2, 0, 0, 0, 0, 0, 0, 0]),
    }]);
    for n in 0..SETS {
        let tick = MONO_NS + n as i64 * PERIOD_NS;
        let frames: Vec<_> = session
            .streams
            .iter()
            .enumerate()
            // The third set lacks a camera.
            .filter(|(i, _)| !(n == 2 && *i == 3))
            .map(|(stream, s)| {
                let mut header = FrameHeader::default();
                header.set_names("golden", &s.id);
                header.set_device(&s.model, &s.serial);
                header.set_image(s.format, s.width, s.height);
                header.sequence = 6 * n + 1;
                header.captured = header.sequence;
                header.capture_time_ns = tick - 4_000_000 + 1_000_000 * stream as i64;
                header.depth_unit_m = s.depth_unit_m;
                header.intrinsics = s.intrinsics;
                header.pose = s.pose;
                RecordFrame { stream, header, pixels: Box::new(pixels(s, n)) }
            })
            .collect();
        let times: Vec<_> = frames.iter().map(|f| f.header.capture_time_ns).collect();
        let set = RecordSet {
            id: n + 1,
            tick: HostTime::from_ns(tick),
            utc: UtcPair { mono: HostTime::from_ns(MONO_NS), utc_ns: UTC_NS, width_ns: 200 },
            motion: motion(&session.motion[0], n),
            signals: Vec::new(),
            spread_ns: times.iter().max().unwrap() - times.iter().min().unwrap(),
            missing: if n == 2 { vec![3] } else { Vec::new() },
            frames,
        };
        recorder.push(set).unwrap();
    }
    let summary = recorder.finish().unwrap();
    assert!(summary.complete, "{:?}", summary.lost);
}

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (dataset, expected, color, depth, stereo) = match args.as_slice() {
        [d, e] => (d, e, ColorCodec::Jpeg, DepthCodec::Zstd, false),
        [d, e, stereo] if stereo == "stereo" => (d, e, ColorCodec::Jpeg, DepthCodec::Zstd, true),
        [d, e, raw] if raw == "raw" => (d, e, ColorCodec::Raw, DepthCodec::Zstd, false),
        [d, e, rank] if rank == "rank" => (d, e, ColorCodec::Png, DepthCodec::Rank, false),
        _ => {
            println!("usage: golden DATASET EXPECTED [raw|rank|stereo]");
            std::process::exit(2);
        }
    };
    let dataset = Path::new(dataset);
    write(dataset, color, depth, stereo);
    assert!(Dataset::open(dataset).unwrap().sets(SetRange::ALL).all(|set| set.unwrap().motion.len() == 2));
    // Where pixels are stored losslessly they are those of the source.
    expected::write(dataset, Path::new(expected), Some(NOTE), &mut |stream, set, stored| {
        assert!(stored == pixels(stream, set - 1), "{} of set {set}", stream.id);
    });
}
