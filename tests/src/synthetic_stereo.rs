//! Raw recordings of a synthetic stereo camera, and their true depth.
//!
//! A square stands before a wall, both with a pattern. Each image is rendered by ray casting, so the truth is exact.
//! The cameras are pinholes with parallel axes, so the rectified view is the left camera's.

use depthrig_bus::{
    DropCounts, FrameHeader, HostTime, Intrinsics, MotionSample, PixelFormat, Pose, StreamId, UtcPair,
};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    MotionRecord, RecordFrame, RecordMotion, RecordSet, Recorder, RecorderOptions, Session, StreamAccount,
    StreamRecord,
};
use std::path::Path;
use std::sync::Arc;

/// UTC of the first set.
pub const T0: i64 = 1_773_500_000_000_000_000;
/// Monotonic time of the first set.
pub const M0: i64 = 50_000_000_000;

/// A stereo camera and its scene.
#[derive(Debug, Clone)]
pub struct SyntheticStereo {
    /// Pixels per row and rows.
    pub size: (u32, u32),
    /// Pixels.
    pub focal: f64,
    /// Metres.
    pub baseline_m: f64,
    /// Distance of the wall, metres.
    pub wall_m: f64,
    /// Distance of the square, metres.
    pub square_m: f64,
    /// Sets.
    pub sets: u64,
    /// Time between sets, nanoseconds.
    pub period_ns: i64,
    /// Sets, from 0, that have no right image.
    pub without_right: Vec<u64>,
    /// Sets, from 0, that were not recorded.
    pub lost: Vec<u64>,
    /// Rows by which the right image lies lower than in its calibration.
    pub rows_apart: f64,
    /// Left and right images are swapped.
    pub swapped: bool,
    /// Difference between the brightest and the darkest of the patterns.
    pub contrast: f64,
}

impl Default for SyntheticStereo {
    fn default() -> Self {
        Self {
            size: (192, 108),
            focal: 150.0,
            baseline_m: 0.12,
            wall_m: 2.0,
            square_m: 1.0,
            sets: 6,
            period_ns: 200_000_000,
            without_right: Vec::new(),
            lost: Vec::new(),
            rows_apart: 0.0,
            swapped: false,
            contrast: 200.0,
        }
    }
}

/// Noise that is smooth between whole numbers, 0 to 1.
fn noise(u: f64, v: f64, seed: u64) -> f64 {
    let at = |i: f64, j: f64| {
        let mut x = (i as i64 as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (j as i64 as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
            ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
        x ^= x >> 31;
        x = x.wrapping_mul(0xBF58_476D_1CE4_E5B9);
        ((x >> 40) & 0xFFFF) as f64 / 65_535.0
    };
    let i = u.floor();
    let j = v.floor();
    let fu = u - i;
    let fv = v - j;
    let row = |j| at(i, j) * (1.0 - fu) + at(i + 1.0, j) * fu;
    row(j) * (1.0 - fv) + row(j + 1.0) * fv
}

impl SyntheticStereo {
    fn center(&self) -> (f64, f64) {
        (f64::from(self.size.0) / 2.0, f64::from(self.size.1) / 2.0)
    }

    /// Intrinsics of both cameras.
    pub fn intrinsics(&self) -> Intrinsics {
        let (cx, cy) = self.center();
        Intrinsics::pinhole(self.focal, self.focal, cx, cy)
    }

    /// Distance and brightness at a pixel of a camera `shift` metres to the right, in set `n`.
    fn seen(&self, x: f64, y: f64, shift: f64, n: u64) -> (f64, u8) {
        let (cx, cy) = self.center();
        let dx = (x - cx) / self.focal;
        let dy = (y - cy) / self.focal;
        let on = |z: f64| (shift + dx * z, dy * z);
        let (u, v) = on(self.square_m);
        let (z, seed) =
            if u.abs() < 0.25 && v.abs() < 0.18 { (self.square_m, 7 + n) } else { (self.wall_m, 1 + n) };
        let (u, v) = on(z);
        // Three pixels to a spot of the pattern.
        let spots = self.focal / z / 3.0;
        (z, (30.0 + self.contrast * noise(u * spots, v * spots, seed)) as u8)
    }

    /// Brightness of the left or right image in set `n`.
    pub fn grey(&self, right: bool, n: u64) -> Vec<u8> {
        let shift = if right == self.swapped { 0.0 } else { self.baseline_m };
        let lower = if right { self.rows_apart } else { 0.0 };
        let (w, h) = self.size;
        (0..h)
            .flat_map(|y| (0..w).map(move |x| (x, y)))
            .map(|(x, y)| self.seen(x.into(), f64::from(y) - lower, shift, n).1)
            .collect()
    }

    /// The same in YUYV.
    pub fn yuyv(&self, right: bool, n: u64) -> Vec<u8> {
        self.grey(right, n).iter().flat_map(|y| [*y, 128]).collect()
    }

    /// The left view's distances, metres.
    pub fn truth_m(&self) -> Vec<f64> {
        let (w, h) = self.size;
        (0..h)
            .flat_map(|y| (0..w).map(move |x| (x, y)))
            .map(|(x, y)| self.seen(x.into(), y.into(), 0.0, 0).0)
            .collect()
    }

    /// The factory calibration of such a camera in every mode, with this one's at the size of VGA.
    pub fn conf(&self) -> String {
        use core::fmt::Write;
        const MODES: [(&str, f64); 4] = [("2K", 2208.0), ("FHD", 1920.0), ("HD", 1280.0), ("VGA", 672.0)];
        let mut text = format!("[STEREO]\nBaseline={}\nTY=0\nTZ=0\n", self.baseline_m * 1e3);
        for (name, _) in MODES {
            let _ = write!(text, "CV_{name}=0\nRX_{name}=0\nRZ_{name}=0\n");
        }
        let (cx, cy) = self.center();
        for (name, width) in MODES {
            let scale = width / 672.0;
            for side in ["LEFT", "RIGHT"] {
                let f = self.focal * scale;
                let cx = cx * scale;
                let cy = cy * scale;
                let lens = "k1=0\nk2=0\np1=0\np2=0\nk3=0";
                let _ = write!(text, "[{side}_CAM_{name}]\nfx={f}\nfy={f}\ncx={cx}\ncy={cy}\n{lens}\n");
            }
        }
        text
    }

    /// Writes a folder of side-by-side grey PNGs with the camera's calibration.
    pub fn write_folder(&self, dir: &Path) {
        std::fs::create_dir_all(dir).unwrap();
        let (w, h) = self.size;
        for n in 0..self.sets {
            let left = self.grey(false, n);
            let right = self.grey(true, n);
            let rows = left.chunks(w as usize).zip(right.chunks(w as usize));
            let both: Vec<u8> = rows.flat_map(|(l, r)| l.iter().chain(r).copied()).collect();
            let image = image::GrayImage::from_raw(2 * w, h, both).unwrap();
            image.save(dir.join(format!("{}.png", T0 + n as i64 * self.period_ns))).unwrap();
        }
        std::fs::write(dir.join("SN20267155.conf"), self.conf()).unwrap();
    }

    /// Records a dataset: camera `zed2i` with the streams `left` and `right`, and a camera that has nothing to do with it.
    /// Both have an IMU.
    pub fn record(&self, out: &Path) {
        let mut session = Session::new("eyes", "bench");
        session.scene = "a square before a wall".into();
        session.started_utc_ns = T0;
        session.rig_config = "# made\n".into();
        let stream = |name: &str, x: f64| StreamRecord {
            id: StreamId::new("zed2i", name).unwrap(),
            model: "ZED 2i".into(),
            serial: "20267155".into(),
            format: PixelFormat::Yuyv,
            width: self.size.0,
            height: self.size.1,
            rate_hz: 15.0,
            depth_unit_m: 0.0,
            calibration: "made up".into(),
            intrinsics: self.intrinsics(),
            pose: Pose { translation_m: [0.5 + x, 0.25, 0.0], rotation_xyzw: [0.0, 0.0, 0.0, 1.0] },
        };
        session.streams = vec![stream("left", 0.0), stream("right", self.baseline_m)];
        session.streams.push(StreamRecord {
            id: StreamId::new("other", "color").unwrap(),
            format: PixelFormat::Mono8,
            ..stream("left", 0.0)
        });
        session.motion = ["other", "zed2i"].map(unit).to_vec();
        let options = RecorderOptions { queue_sets: 64, ..RecorderOptions::default() };
        let r = Recorder::create(Arc::new(RealFs), out, session.clone(), options).unwrap();
        for n in (0..self.sets).filter(|n| !self.lost.contains(n)) {
            let mono = M0 + n as i64 * self.period_ns;
            let header = |stream: usize| {
                let s = &session.streams[stream];
                let mut h = FrameHeader::default();
                h.set_names("bench", &s.id);
                h.set_device(&s.model, &s.serial);
                h.set_image(s.format, s.width, s.height);
                (h.sequence, h.captured, h.device_sequence) = (n + 1, n + 1, 100 + n);
                h.capture_time_ns = mono + 1_000;
                (h.arrival_time_ns, h.publish_time_ns) = (mono + 8_000_000, mono + 8_100_000);
                (h.capture_uncertainty_ns, h.clock_domain, h.clock_epoch) = (12_000, 1, 3);
                (h.intrinsics, h.pose) = (s.intrinsics, s.pose);
                h
            };
            let mut frames = vec![
                RecordFrame { stream: 0, header: header(0), pixels: Box::new(self.yuyv(false, n)) },
                RecordFrame { stream: 1, header: header(1), pixels: Box::new(self.yuyv(true, n)) },
                RecordFrame { stream: 2, header: header(2), pixels: Box::new(self.grey(false, n)) },
            ];
            let mut missing = Vec::new();
            if self.without_right.contains(&n) {
                frames.remove(1);
                missing.push(1);
            }
            let utc = UtcPair { mono: HostTime::from_ns(M0), utc_ns: T0, width_ns: 100 };
            let set = RecordSet {
                id: 10 + n,
                tick: HostTime::from_ns(mono),
                utc,
                frames,
                missing,
                motion: session.motion.iter().enumerate().map(|(i, u)| batch(i, u, n, mono)).collect(),
                signals: Vec::new(),
                spread_ns: 0,
            };
            while !r.has_room() {
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            r.push(set).unwrap();
        }
        let batches = self.sets - self.lost.len() as u64;
        let account = |u: &MotionRecord| StreamAccount {
            stream: u.id.clone(),
            captured: batches + 1,
            delivered: batches,
            dropped: DropCounts([1, 0, 0, 0, 0, 0, 0, 0]),
        };
        r.update_accounts(session.motion.iter().map(account).collect());
        assert!(r.finish().unwrap().complete);
    }
}

/// The IMU of a camera.
fn unit(camera: &str) -> MotionRecord {
    MotionRecord {
        id: StreamId::new(camera, "imu").unwrap(),
        model: "made up".into(),
        serial: "20267155".into(),
        rate_hz: 30.0,
        batch: 2,
        calibration: "made up".into(),
        pose: Pose::IDENTITY,
    }
}

/// The batch that an IMU sent before set `n`: two samples.
fn batch(index: usize, unit: &MotionRecord, n: u64, mono: i64) -> RecordMotion {
    let sample = |k: u64| MotionSample {
        time_ns: mono - 10_000_000 + 5_000_000 * k as i64,
        sequence: 2 * n + k + 1,
        gyro_rad_s: [index as f32, n as f32, k as f32],
        ..MotionSample::default()
    };
    let samples = vec![sample(0), sample(1)];
    let mut header = FrameHeader::default();
    header.set_names("bench", &unit.id);
    header.set_device(&unit.model, &unit.serial);
    header.set_image(PixelFormat::Motion, 2, 1);
    (header.sequence, header.captured, header.device_sequence) = (n + 1, n + 1, samples[1].sequence);
    header.capture_time_ns = samples[1].time_ns;
    RecordMotion { unit: index, header, samples }
}
