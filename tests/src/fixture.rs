//! Datasets made without a rig: every header and image follows from the stream and the number of the set.

use depthrig_bus::{FrameHeader, HostTime, Intrinsics, MotionSample, PixelFormat, Pose, StreamId, UtcPair};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    ColorCodec, DepthCodec, MotionRecord, RecordFrame, RecordMotion, RecordSet, Recorder, RecorderOptions,
    Session, StreamRecord, Summary,
};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// UTC of the first set of a dataset that begins at 0.
pub const T0: i64 = 1_773_500_000_000_000_000;
/// A second in nanoseconds.
pub const SECOND: i64 = 1_000_000_000;

/// A dataset to record.
#[derive(Debug, Clone)]
pub struct Fixture {
    /// The rig's name.
    pub rig: &'static str,
    /// Cameras; each has `color` and `depth`.
    pub cameras: Vec<&'static str>,
    /// UTC of the first set, nanoseconds after [`T0`].
    pub at_ns: i64,
    /// Monotonic time of the first set.
    pub mono_ns: i64,
    /// Time between sets.
    pub period_ns: i64,
    /// Sets.
    pub sets: u64,
    /// Sets, from 0, that were not recorded.
    pub lost: Vec<u64>,
    /// Sets, from 0, that have no colour.
    pub without_color: Vec<u64>,
    /// How far the frames of a set may be apart, nanoseconds; they are, by a millisecond from stream to stream.
    pub max_spread_ns: Option<i64>,
    /// Pixels per row and rows.
    pub size: (u32, u32),
    /// How colour is stored.
    pub color: ColorCodec,
    /// How depth is stored.
    pub depth: DepthCodec,
    /// Whether the first camera has an IMU, `imu`.
    pub motion: bool,
}

impl Default for Fixture {
    fn default() -> Self {
        Self {
            rig: "bench",
            cameras: vec!["left", "right"],
            at_ns: 0,
            mono_ns: 50 * SECOND,
            period_ns: SECOND / 5,
            sets: 12,
            lost: Vec::new(),
            without_color: Vec::new(),
            max_spread_ns: None,
            size: (64, 48),
            color: ColorCodec::Raw,
            depth: DepthCodec::default(),
            motion: false,
        }
    }
}

/// A pose whose rotation has no short numbers: taken apart into a matrix and put together again it is another one.
fn turned(translation_m: [f64; 3], n: f64) -> Pose {
    let q = [0.3 + 0.1 * n, -0.7, 0.2 * n + 0.11, 0.53];
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    Pose { translation_m, rotation_xyzw: q.map(|c| c / length) }
}

impl Fixture {
    /// The streams in their order.
    pub fn streams(&self) -> Vec<StreamId> {
        let names = ["color", "depth"];
        self.cameras.iter().flat_map(|c| names.map(|s| StreamId::new(c, s).unwrap())).collect()
    }

    fn session(&self) -> Session {
        let mut session = Session::new("made", self.rig);
        session.scene = "made up".into();
        session.started_utc_ns = T0 + self.at_ns;
        session.rig_config = "# made\n".into();
        session.max_spread_ns = self.max_spread_ns;
        let (width, height) = self.size;
        let record = |(i, id): (usize, StreamId)| {
            let depth = id.stream.as_str() == "depth";
            StreamRecord {
                id,
                model: "Made".into(),
                serial: "7".into(),
                format: if depth { PixelFormat::Z16 } else { PixelFormat::Rgb8 },
                width,
                height,
                rate_hz: 30.0,
                depth_unit_m: if depth { 0.001 } else { 0.0 },
                calibration: "made up".into(),
                intrinsics: Intrinsics::pinhole(60.0, 61.0, 32.0, 24.0),
                pose: turned([0.1, -0.2, 0.3], (i / 2) as f64),
            }
        };
        session.streams = self.streams().into_iter().enumerate().map(record).collect();
        if self.motion {
            session.motion.push(MotionRecord {
                id: self.unit(),
                model: "Made".into(),
                serial: "7".into(),
                rate_hz: 8e9 / self.period_ns as f64,
                batch: 4,
                calibration: "made up".into(),
                pose: turned([0.3, 0.2, -0.1], 9.0),
            });
        }
        session
    }

    /// The IMU of the first camera.
    pub fn unit(&self) -> StreamId {
        StreamId::new(self.cameras[0], "imu").unwrap()
    }

    /// The batches that the IMU sends between set `n` and the one before: two of four samples.
    fn batches(&self, session: &Session, n: u64) -> Vec<RecordMotion> {
        let batch = |record: &MotionRecord, b: u64| {
            let sample = |k: u64| MotionSample {
                time_ns: self.tick(n).ns() - self.period_ns + (k - 8 * n) as i64 * (self.period_ns / 8) + 5,
                device_time: 1000 * k,
                sequence: k + 1,
                uncertainty_ns: 30_000,
                gyro_rad_s: [k as f32 / 64.0, -1.5, 0.25],
                accel_m_s2: if k % 7 == 3 { [f32::NAN; 3] } else { [0.1, 9.8, k as f32 / 128.0] },
                temperature_c: 36.5,
                ..MotionSample::default()
            };
            let samples: Vec<_> = (4 * b..4 * b + 4).map(sample).collect();
            let mut header = FrameHeader::default();
            header.set_names(self.rig, &record.id);
            header.set_device(&record.model, &record.serial);
            header.set_image(PixelFormat::Motion, 4, 1);
            // Now and then a batch is lost before its channel.
            (header.sequence, header.captured) = (b + 1, b + 1 + b / 3);
            header.dropped[1] = b / 3;
            header.device_sequence = 4 * b + 4;
            header.capture_time_ns = samples[3].time_ns;
            header.arrival_time_ns = header.capture_time_ns + 1_000_000;
            header.publish_time_ns = header.capture_time_ns + 1_100_000;
            header.pose = record.pose;
            header.temperature_c = 36.5;
            RecordMotion { unit: 0, header, samples }
        };
        session.motion.iter().flat_map(|r| [2 * n, 2 * n + 1].map(|b| batch(r, b))).collect()
    }

    /// When set `n` is, on the monotonic clock.
    pub fn tick(&self, n: u64) -> HostTime {
        HostTime::from_ns(self.mono_ns + n as i64 * self.period_ns)
    }

    /// The header of a stream's frame in set `n`.
    fn header(&self, s: &StreamRecord, stream: usize, n: u64) -> FrameHeader {
        let mut h = FrameHeader::default();
        h.set_names(self.rig, &s.id);
        h.set_device(&s.model, &s.serial);
        h.set_image(s.format, s.width, s.height);
        h.sequence = 6 * n + 1;
        h.device_sequence = 6 * n + 100;
        h.device_time = 123_456 * n;
        h.device_tick_ns = 1000.0;
        h.capture_time_ns = self.tick(n).ns() + stream as i64 * 1_000_003;
        h.capture_uncertainty_ns = 15_000 + n;
        h.arrival_time_ns = h.capture_time_ns + 8_000_000;
        h.publish_time_ns = h.capture_time_ns + 8_100_000;
        h.exposure_ns = 3_000_000 + n;
        h.dropped[1] = n / 4;
        h.captured = h.sequence + n / 4;
        h.depth_unit_m = s.depth_unit_m;
        h.intrinsics = s.intrinsics;
        h.pose = s.pose;
        h.clock_domain = 1;
        h.gain = 1.5;
        h.temperature_c = 40.0 + n as f32 / 8.0;
        h
    }

    /// The set of this number.
    pub fn set(&self, session: &Session, n: u64) -> RecordSet {
        let frame = |(i, s): (usize, &StreamRecord)| RecordFrame {
            stream: i,
            header: self.header(s, i, n),
            pixels: Box::new(pixels(s.format, s.width, s.height, n + 31 * i as u64)),
        };
        let is_missing = |s: &StreamRecord| s.format == PixelFormat::Rgb8 && self.without_color.contains(&n);
        let (missing, present): (Vec<_>, Vec<_>) =
            session.streams.iter().enumerate().partition(|(_, s)| is_missing(s));
        let frames: Vec<_> = present.into_iter().map(frame).collect();
        let times = frames.iter().map(|f| f.header.capture_time_ns);
        RecordSet {
            id: 3 * n + 5,
            tick: self.tick(n),
            utc: UtcPair { mono: self.tick(0), utc_ns: T0 + self.at_ns, width_ns: 100 },
            motion: self.batches(session, n),
            signals: Vec::new(),
            spread_ns: times.clone().max().unwrap_or(0) - times.min().unwrap_or(0),
            missing: missing.into_iter().map(|(i, _)| i).collect(),
            frames,
        }
    }

    /// Records it into the new folder `dir`.
    pub fn record(&self, dir: &Path) -> Summary {
        let summary = self.recorder(dir).finish().unwrap();
        let sets = self.sets - self.lost.len() as u64;
        assert_eq!((summary.complete, summary.sets.recorded), (true, sets), "{:?}", summary.lost);
        summary
    }

    /// Records it into the new folder `dir` without an end, as a crash of the process leaves it.
    pub fn record_and_crash(&self, dir: &Path) {
        let recorder = self.recorder(dir);
        while recorder.progress().sets.recorded < self.sets - self.lost.len() as u64 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// A recorder that was handed every set.
    fn recorder(&self, dir: &Path) -> Recorder {
        let options = RecorderOptions {
            color: self.color,
            depth: self.depth,
            workers: 2,
            min_free_bytes: 0,
            reserve_bytes: 0,
            // Several segments, also of a short one.
            segment_max_ns: 5 * self.period_ns,
            ..RecorderOptions::default()
        };
        let session = self.session();
        let recorder = Recorder::create(Arc::new(RealFs), dir, session.clone(), options).unwrap();
        for n in (0..self.sets).filter(|n| !self.lost.contains(n)) {
            while !recorder.has_room() {
                std::thread::sleep(Duration::from_millis(1));
            }
            recorder.push(self.set(&session, n)).unwrap();
        }
        recorder
    }
}

/// A smooth image with an edge, different for each `n`.
fn pixels(format: PixelFormat, width: u32, height: u32, n: u64) -> Vec<u8> {
    let mut out = Vec::with_capacity(format.frame_bytes(width, height));
    for y in 0..height {
        for x in 0..width {
            let v = (x + 2 * y + if x > width / 2 { 60 } else { 0 }) as u16 + n as u16;
            if format == PixelFormat::Z16 {
                out.extend((if (x + y) % 17 == 0 { 0 } else { 400 + 3 * v }).to_le_bytes());
            } else {
                out.extend([v as u8, (v / 2) as u8, 255 - v as u8]);
            }
        }
    }
    out
}
