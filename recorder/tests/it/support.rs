//! A small rig whose images and headers follow from the set's number.

use depthrig_bus::{
    FieldType, FrameFlags, FrameHeader, HostTime, Intrinsics, MotionFlags, MotionSample, PixelFormat, Pose,
    SignalDescription, SignalField, SignalHeader, SignalName, SignalSample, UtcPair,
};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    Dataset, DatasetSet, MotionRecord, RecordFrame, RecordMotion, RecordSet, RecordSignal, Recorder,
    RecorderOptions, Session, SignalRecord, StreamRecord, Summary,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// UTC of the first set.
pub const T0: i64 = 1_700_000_000_000_000_000;
/// Monotonic time of the first set.
pub const M0: i64 = 5_000_000_000;
/// Time from set to set.
pub const PERIOD: i64 = 200_000_000;

pub fn dir() -> PathBuf {
    PathBuf::from("/data/session")
}

/// Nothing reserved, nothing limited: for tests on a small file system.
pub fn options() -> RecorderOptions {
    RecorderOptions { workers: 2, queue_sets: 8, min_free_bytes: 0, reserve_bytes: 0, ..Default::default() }
}

pub fn stream(id: &str, format: PixelFormat, width: u32, height: u32) -> StreamRecord {
    let depth = format.is_depth();
    StreamRecord {
        id: id.parse().unwrap(),
        model: "Test 1".into(),
        serial: "0042".into(),
        format,
        width,
        height,
        rate_hz: 30.0,
        depth_unit_m: if depth { 0.0001 } else { 0.0 },
        calibration: "made up".into(),
        intrinsics: Intrinsics::pinhole(600.0, 601.0, f64::from(width) / 2.0, f64::from(height) / 2.0),
        pose: Pose { translation_m: [0.1, -0.2, 0.3], ..Pose::IDENTITY },
    }
}

pub fn session() -> Session {
    let mut s = Session::new("session", "rig");
    s.scene = "a table".into();
    s.operator = "nobody".into();
    s.started_utc_ns = T0;
    s.rig_config = "[rig]\nname = \"rig\"\n".into();
    s.streams = vec![
        stream("front/color", PixelFormat::Rgb8, 64, 48),
        stream("front/depth", PixelFormat::Z16, 64, 48),
        stream("side/ir_left", PixelFormat::Mono8, 40, 30),
    ];
    s.motion = vec![unit("front/imu"), unit("side/imu")];
    s.signals = vec![joints("arm/joints"), gripper("arm/gripper")];
    s
}

/// Samples of one batch of an IMU, and batches of one set.
pub const SAMPLES: u64 = 4;
pub const BATCHES: u64 = 2;
/// Time from sample to sample.
pub const SAMPLE_PERIOD: i64 = PERIOD / (SAMPLES * BATCHES) as i64;

pub fn unit(id: &str) -> MotionRecord {
    MotionRecord {
        id: id.parse().unwrap(),
        model: "Test 1".into(),
        serial: "0042".into(),
        rate_hz: 1e9 / SAMPLE_PERIOD as f64,
        batch: SAMPLES as u32 + 1,
        calibration: "made up".into(),
        pose: Pose { translation_m: [0.2, -0.1, 0.4], ..Pose::IDENTITY },
    }
}

/// Sample number `k` of an IMU; now and then it lacks something.
pub fn sample(unit: usize, k: u64) -> MotionSample {
    let v = k as f32 / 8.0 + unit as f32;
    MotionSample {
        time_ns: M0 + k as i64 * SAMPLE_PERIOD,
        device_time: 1000 * k,
        sequence: k + 1,
        uncertainty_ns: 20_000,
        accel_offset_ns: -7,
        gyro_rad_s: if k % 5 == 4 { [f32::NAN; 3] } else { [v, -v, 0.1] },
        accel_m_s2: [0.3, 9.81 + v, -v / 3.0],
        temperature_c: if unit == 0 { 31.5 } else { f32::NAN },
        flags: if k.is_multiple_of(4) { MotionFlags::FRAME_SYNC.0 } else { 0 },
    }
}

/// Batch number `b` of an IMU, counted from 0.
pub fn batch(session: &Session, unit: usize, b: u64) -> RecordMotion {
    let record = &session.motion[unit];
    let samples: Vec<_> = (b * SAMPLES..(b + 1) * SAMPLES).map(|k| sample(unit, k)).collect();
    let mut header = FrameHeader::default();
    header.set_names("rig", &record.id);
    header.set_device(&record.model, &record.serial);
    header.set_image(PixelFormat::Motion, SAMPLES as u32, 1);
    header.sequence = b + 1;
    header.captured = b + 1;
    header.device_sequence = (b + 1) * SAMPLES;
    header.capture_time_ns = samples.last().unwrap().time_ns;
    header.pose = record.pose;
    RecordMotion { unit, header, samples }
}

/// The batches that the IMUs send between set `n` and the one before.
pub fn motion(session: &Session, n: u64) -> Vec<RecordMotion> {
    let batches = n * BATCHES..(n + 1) * BATCHES;
    batches.flat_map(|b| (0..session.motion.len()).map(move |u| batch(session, u, b))).collect()
}

fn name(id: &str) -> SignalName {
    let (device, signal) = id.split_once('/').unwrap();
    SignalName::new(device, signal).unwrap()
}

/// A signal of two joint angles.
pub fn joints(id: &str) -> SignalRecord {
    SignalRecord::new(&Arc::new(SignalDescription::joints(name(id), &["shoulder", "elbow"], "rad").unwrap()))
}

/// A signal of a number, a bool and a text.
pub fn gripper(id: &str) -> SignalRecord {
    let fields = vec![
        SignalField::new("width", FieldType::F64, "m"),
        SignalField::new("closed", FieldType::Bool, ""),
        SignalField::new("task", FieldType::Text, ""),
    ];
    SignalRecord::new(&Arc::new(SignalDescription::fields(name(id), fields).unwrap()))
}

/// Samples of one signal in a set.
pub const SIGNAL_SAMPLES: u64 = 5;

/// Sample number `k` of a signal, counted from 0; now and then a value is NaN.
pub fn signal_sample(record: &SignalRecord, k: u64) -> SignalSample {
    let time_ns = M0 + k as i64 * (PERIOD / SIGNAL_SAMPLES as i64);
    let x = if k % 7 == 6 { f64::NAN } else { k as f64 / 8.0 };
    let mut values = x.to_le_bytes().to_vec();
    if record.description.has_text() {
        let task = format!("put \"cup\" {k} on it \u{1f375}\n");
        values.extend([u8::from(k.is_multiple_of(2)), 0, 0, 0]);
        values.extend((task.len() as u32).to_le_bytes());
        values.extend(task.as_bytes());
    } else {
        values.extend((-x).to_le_bytes());
    }
    let header = SignalHeader {
        sequence: k + 1,
        session: 77,
        time_ns,
        publish_time_ns: time_ns + 900,
        uncertainty_ns: 1000,
        description_hash: record.description.hash(),
        ..SignalHeader::default()
    };
    SignalSample::new(header, &record.description, values).unwrap()
}

/// The samples that the signals publish between set `n` and the one before.
pub fn signals(session: &Session, n: u64) -> Vec<RecordSignal> {
    let samples = |record| {
        let numbers = n * SIGNAL_SAMPLES..(n + 1) * SIGNAL_SAMPLES;
        numbers.map(|k| signal_sample(record, k)).collect()
    };
    let part = |(signal, record)| RecordSignal { signal, samples: samples(record) };
    session.signals.iter().enumerate().map(part).collect()
}

/// Smooth images with an edge, as a camera gives them, different for each set.
pub fn pixels(format: PixelFormat, width: u32, height: u32, n: u64) -> Vec<u8> {
    let mut out = Vec::with_capacity(format.frame_bytes(width, height));
    for y in 0..height {
        for x in 0..width {
            let edge = if x > width / 2 { 60 } else { 0 };
            let v = (x + 2 * y + edge + n as u32) as u16;
            match format {
                PixelFormat::Rgb8 => out.extend([v as u8, (v / 2) as u8, 255 - v as u8]),
                PixelFormat::Z16 => {
                    out.extend((if (x + y) % 17 == 0 { 0 } else { 400 + 3 * v }).to_le_bytes());
                }
                PixelFormat::DepthF32 => out.extend((f32::from(v) / 100.0).to_le_bytes()),
                PixelFormat::DisparityF32 if (x + y) % 11 == 0 => out.extend(f32::NAN.to_le_bytes()),
                PixelFormat::DisparityF32 => out.extend((f32::from(v) / 16.0).to_le_bytes()),
                PixelFormat::Mono16 => out.extend((v * 7).to_le_bytes()),
                _ => out.push(v as u8),
            }
        }
    }
    out.resize(format.frame_bytes(width, height), 9);
    out
}

pub fn header(s: &StreamRecord, n: u64) -> FrameHeader {
    let mut h = FrameHeader::default();
    h.set_names("rig", &s.id);
    h.set_device(&s.model, &s.serial);
    h.set_image(s.format, s.width, s.height);
    h.sequence = 6 * n + 1;
    h.device_sequence = 6 * n + 100;
    h.device_time = 123_456 * n;
    h.device_tick_ns = 1000.0;
    h.capture_time_ns = M0 + n as i64 * PERIOD + s.id.to_string().len() as i64;
    h.capture_uncertainty_ns = 15_000;
    h.arrival_time_ns = h.capture_time_ns + 8_000_000;
    h.publish_time_ns = h.capture_time_ns + 8_100_000;
    h.captured = h.sequence + 2;
    h.dropped[1] = 2;
    h.depth_unit_m = s.depth_unit_m;
    h.intrinsics = s.intrinsics;
    h.pose = s.pose;
    h.clock_domain = 1;
    h.clock_epoch = 3;
    h.flags = FrameFlags::SYNTHETIC.0;
    h.gain = 1.5;
    h
}

pub fn set_of(session: &Session, n: u64, streams: &[usize]) -> RecordSet {
    let frames: Vec<_> = streams
        .iter()
        .map(|i| {
            let s = &session.streams[*i];
            let pixels = pixels(s.format, s.width, s.height, n);
            RecordFrame { stream: *i, header: header(s, n), pixels: Box::new(pixels) }
        })
        .collect();
    let times: Vec<_> = frames.iter().map(|f| f.header.capture_time_ns).collect();
    RecordSet {
        id: n + 1,
        tick: HostTime::from_ns(M0 + n as i64 * PERIOD),
        utc: UtcPair { mono: HostTime::from_ns(M0), utc_ns: T0, width_ns: 100 },
        motion: motion(session, n),
        signals: signals(session, n),
        spread_ns: times.iter().max().unwrap_or(&0) - times.iter().min().unwrap_or(&0),
        missing: (0..session.streams.len()).filter(|i| !streams.contains(i)).collect(),
        frames,
    }
}

pub fn set(session: &Session, n: u64) -> RecordSet {
    set_of(session, n, &(0..session.streams.len()).collect::<Vec<_>>())
}

pub fn recorder(fs: &MemFs, options: RecorderOptions) -> Recorder {
    Recorder::create(Arc::new(fs.clone()), &dir(), session(), options).unwrap()
}

/// Waits until everything pushed is settled.
pub fn settle(r: &Recorder) {
    for _ in 0..2000 {
        let p = r.progress();
        if p.sets.offered == p.sets.recorded + p.sets.dropped_total() {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("sets are not settled after ten seconds: {:?}", r.progress());
}

/// Waits until everything pushed is settled and an account says so, however late the writer's thread is woken. For recorders that sync at
/// once.
pub fn accounted(r: &Recorder) {
    settle(r);
    let so_far = r.progress().bytes;
    for _ in 0..10_000 {
        if r.progress().bytes != so_far {
            return;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    panic!("no account is written in ten seconds: {:?}", r.progress());
}

/// Records sets one at a time, so that no set is refused for lack of room.
pub fn record(fs: &MemFs, sets: u64, options: RecorderOptions) -> Summary {
    let r = recorder(fs, options);
    for n in 0..sets {
        r.push(set(&session(), n)).unwrap();
        settle(&r);
    }
    r.finish().unwrap()
}

pub fn open(fs: &MemFs) -> Dataset {
    Dataset::open_with(Arc::new(fs.clone()), &dir()).unwrap()
}

pub fn read_all(fs: &MemFs) -> Vec<DatasetSet> {
    open(fs).sets(depthrig_recorder::SetRange::ALL).map(Result::unwrap).collect()
}

pub fn names(fs: &MemFs) -> Vec<String> {
    fs.read_dir(&dir()).unwrap().into_iter().map(|e| e.name).collect()
}

/// A file system that shares nothing with `fs` and holds the same files.
pub fn copy(fs: &MemFs) -> MemFs {
    fs.after_crash(|n| n)
}

pub fn segment(index: u32) -> PathBuf {
    dir().join(format!("seg_{index:04}.mcap"))
}

pub fn contents(fs: &MemFs, path: &Path) -> Vec<u8> {
    fs.contents(path).unwrap_or_else(|| panic!("{} is not there: {:?}", path.display(), names(fs)))
}
