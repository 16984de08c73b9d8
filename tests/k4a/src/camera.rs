//! One fake camera: its settings, its clock, its images, and how it fails.

use crate::abi::{self, Configuration};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Captures that wait for a late reader, as in the real library (half a second at 30 Hz).
const QUEUE: u64 = 16;
/// From mid-exposure to the end of the transfer.
const LATENCY_NS: i64 = 20_000_000;
/// IMU samples a second.
const IMU_HZ: i64 = 1600;
/// Samples that wait for a late reader, as in the real library (half a second of them).
const IMU_QUEUE: u64 = 800;
/// From a sample to when it can be read. The device sends many at once.
const IMU_LATENCY_NS: i64 = 4_000_000;
/// How much later than the gyroscope the accelerometer is read, microseconds.
const ACCEL_LATE_US: u64 = 40;
/// Microseconds of the device's clock when the first camera starts.
const CLOCK_START_US: i64 = 3_000_000;

/// Counts of a stream's images since it was last started.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
pub struct Ledger {
    /// Images that the host could know of.
    pub captured: u64,
    /// Complete images that came once.
    pub good: u64,
    /// Half of their bytes.
    pub half: u64,
    /// Too many bytes, or another size.
    pub wrong_size: u64,
    /// Without memory.
    pub damaged: u64,
    /// A second time.
    pub repeated: u64,
    /// Never.
    pub lost: u64,
}

/// Faults that are still to happen.
#[derive(Debug, Clone, Copy, Default)]
pub struct Troubles {
    pub half: u64,
    pub wrong_size: u64,
    pub damaged: u64,
    pub repeated: u64,
    pub skip: u64,
    pub stall_until: i64,
    pub hang_until: i64,
    pub stop_hang_ns: i64,
    pub close_hang_ns: i64,
    /// 0: there; 1: not found; 2: gets no graphics.
    pub engine: u64,
    /// Only colour comes, or only depth and infrared, of the next captures.
    pub only_color: u64,
    pub only_depth: u64,
    /// Images have no stamp of the host.
    pub no_host_stamp: u64,
    /// Bytes between the rows.
    pub padding: u64,
    /// It is silent as a subordinate while no master streams.
    pub needs_master: bool,
    /// Images say another format than was asked for.
    pub wrong_format: u64,
    /// So many IMU samples never come.
    pub imu_skip: u64,
    /// The IMU breaks off and says so.
    pub imu_ends: bool,
}

/// An image as it is handed over.
#[derive(Debug, Clone)]
pub struct Image {
    pub format: u32,
    pub size: (u32, u32),
    pub stride: u32,
    /// `None`: it has no memory.
    pub bytes: Option<Arc<Vec<u8>>>,
    pub device_us: u64,
    pub system_ns: u64,
    pub exposure_us: u64,
}

/// The IMU's values at this time of the device's clock: rotation (rad/s) and acceleration (m/s²).
pub fn motion(device_us: u64) -> ([f32; 3], [f32; 3]) {
    let n = (device_us / 625 % 65_536) as f32;
    ([n / 1024.0, -0.5, 0.25], [0.2, -9.81, n])
}

/// A camera.
pub struct Camera {
    pub serial: String,
    pub calibration: Vec<u8>,
    pub open: Option<usize>,
    pub busy_until: i64,
    pub absent_until: i64,
    /// The user may not open it.
    pub denied: bool,
    pub jacks: (bool, bool),
    pub troubles: Troubles,
    /// Colour controls by command: whether automatic, and the value.
    pub controls: BTreeMap<u32, (bool, i32)>,
    /// The commands of the controls that were set, in that order.
    pub set: Vec<u32>,
    /// How long opening it takes.
    pub open_takes_ns: i64,
    pub running: Option<Running>,
    pub ledgers: [Ledger; 3],
    jpegs: BTreeMap<(u32, u32, u64), Arc<Vec<u8>>>,
}

/// A camera that streams.
pub struct Running {
    configuration: Configuration,
    began_ns: i64,
    period_ns: i64,
    /// Number of the next image.
    next: u64,
    /// Offset of the device's clock, microseconds.
    offset_us: i64,
    /// Images that were lost since the last that was handed over.
    lost: u64,
    handed: bool,
    /// The clock was set since the last image, so that losses are unknown.
    set: bool,
    again: Option<Vec<(usize, Image)>>,
    /// Number of the next IMU sample, while the IMU runs.
    imu: Option<u64>,
}

/// Result of a request for an IMU sample.
pub enum Moved {
    /// This.
    Sample(abi::ImuSample),
    /// Nothing before this moment.
    Wait(i64),
    /// Nothing any more.
    Over,
}

/// Result of a request for a capture.
pub enum Step {
    /// This, by stream.
    Ready(Vec<(usize, Image)>),
    /// Nothing before this moment.
    Wait(i64),
    /// The call does not come back before this moment.
    Hang(i64),
}

impl Camera {
    pub fn new(serial: &str) -> Self {
        Self {
            serial: serial.to_owned(),
            calibration: crate::calibration::text(serial),
            open: None,
            busy_until: 0,
            absent_until: 0,
            denied: false,
            jacks: (false, false),
            troubles: Troubles::default(),
            controls: BTreeMap::new(),
            set: Vec::new(),
            open_takes_ns: 0,
            running: None,
            ledgers: [Ledger::default(); 3],
            jpegs: BTreeMap::new(),
        }
    }

    /// Starts it, or says what is wrong, in the words of the real library.
    pub fn start(&mut self, c: &Configuration, now: i64) -> Result<(), String> {
        let rate =
            abi::rate_hz(c.camera_fps).ok_or("The configured camera_fps is not a valid k4a_fps_t value.")?;
        let color = abi::color_size(c.color_resolution);
        let depth = abi::depth_size(c.depth_mode);
        let raw = matches!(c.color_format, abi::NV12 | abi::YUY2);
        let problem = if self.running.is_some() {
            Some("k4a_device_start_cameras called while one of the sensors are running")
        } else if c.color_format > abi::BGRA32 {
            Some("The configured color_format is not a valid k4a_color_format_t value.")
        } else if color.is_none() && depth.is_none() {
            Some("Neither depth camera nor color camera are enabled in the configuration")
        } else if color.is_some() && raw && c.color_resolution != 1 || c.color_resolution == 6 && rate > 15 {
            Some("The combination of color_resolution, color_format and camera_fps is not supported.")
        } else if c.depth_mode == 4 && rate > 15 {
            Some("The configured depth_mode does not support the configured camera_fps.")
        } else if c.wired_sync_mode == 2 && !self.jacks.0 {
            Some("Failure to detect presence of sync in cable with wired sync mode")
        } else if c.wired_sync_mode == 1 && !self.jacks.1 {
            Some("Failure to detect presence of sync out cable with wired sync mode")
        } else if c.wired_sync_mode != 2 && c.subordinate_delay_off_master_usec != 0 {
            Some("subordinate_delay_off_master_usec must be 0.")
        } else if (color.is_none() || depth.is_none()) && c.depth_delay_off_color_usec != 0 {
            Some("both depth camera and color camera must be enabled.")
        } else {
            match (depth, self.troubles.engine) {
                (Some(_), 1) => Some(
                    "Failed to Load Depth Engine Plugin (depthengine). Depth functionality will not work",
                ),
                (Some(_), 2) => Some("Depth engine create and initialize failed with error code: 204."),
                _ => None,
            }
        };
        if let Some(problem) = problem {
            return Err(problem.to_owned());
        }
        let period_ns = 1_000_000_000 / rate as i64;
        self.running = Some(Running {
            configuration: *c,
            began_ns: now,
            period_ns,
            next: 0,
            offset_us: CLOCK_START_US,
            lost: 0,
            handed: false,
            set: false,
            again: None,
            imu: None,
        });
        self.ledgers = [Ledger::default(); 3];
        // Encoding JPEG takes a while, which is not camera time.
        if let Some(size) = color.filter(|_| c.color_format == abi::MJPG) {
            for n in 0..crate::images::JPEGS {
                self.jpeg(size.0, size.1, n);
            }
        }
        Ok(())
    }

    /// Starts the IMU, or says what is wrong, in the words of the real library.
    pub fn start_imu(&mut self, now: i64) -> Result<(), String> {
        let Some(r) = &mut self.running else {
            let why =
                "k4a_device_start_imu called while the color/depth camera is not running is not supported";
            return Err(why.to_owned());
        };
        if r.imu.is_some() {
            return Err("Invalid argument to k4a_device_start_imu(). imu_started is true".to_owned());
        }
        r.imu = Some(((now - r.began_ns) * IMU_HZ / 1_000_000_000).max(0) as u64);
        Ok(())
    }

    /// Stops it.
    pub fn stop_imu(&mut self) {
        if let Some(r) = &mut self.running {
            r.imu = None;
        }
    }

    /// The next IMU sample, if it is there.
    pub fn imu_step(&mut self, now: i64) -> Option<Moved> {
        let t = &mut self.troubles;
        let r = self.running.as_mut()?;
        let Some(next) = &mut r.imu else { return Some(Moved::Over) };
        if core::mem::take(&mut t.imu_ends) {
            r.imu = None;
            return Some(Moved::Over);
        }
        let stalled = t.hang_until.max(t.stall_until);
        if stalled > now {
            return Some(Moved::Wait(stalled));
        }
        let at_ns = |n: u64| n as i64 * 1_000_000_000 / IMU_HZ;
        let newest = ((now - r.began_ns - IMU_LATENCY_NS) * IMU_HZ).div_euclid(1_000_000_000);
        *next += core::mem::take(&mut t.imu_skip);
        // A late reader loses samples.
        *next = (*next).max((newest + 1).max(0) as u64 - IMU_QUEUE.min((newest + 1).max(0) as u64));
        let n = *next;
        if (n as i64) > newest {
            return Some(Moved::Wait(r.began_ns + at_ns(n) + IMU_LATENCY_NS));
        }
        *next += 1;
        let us = (at_ns(n) / 1000 + r.offset_us).max(0) as u64;
        let (rotation, acceleration) = motion(us);
        Some(Moved::Sample(abi::ImuSample {
            temperature: 33.5,
            acc_sample: acceleration,
            acc_timestamp_usec: us + ACCEL_LATE_US,
            gyro_sample: rotation,
            gyro_timestamp_usec: us,
        }))
    }

    /// Whether it streams as this part of a wired group, `k4a_wired_sync_mode_t`.
    pub fn plays(&self, part: u32) -> bool {
        self.running.as_ref().is_some_and(|r| r.configuration.wired_sync_mode == part)
    }

    /// The configuration that it was last started with.
    pub fn configuration(&self) -> Option<Configuration> {
        self.running.as_ref().map(|r| r.configuration)
    }

    /// Sets the device's clock back by `back_us`, or, without it, to its beginning.
    pub fn set_clock(&mut self, back_us: Option<i64>) {
        let Some(r) = &mut self.running else { return };
        r.offset_us = match back_us {
            Some(back) => r.offset_us - back,
            None => 1000 - r.next as i64 * r.period_ns / 1000,
        };
        r.set = true;
    }

    /// The next capture, if it is due.
    pub fn step(&mut self, now: i64) -> Option<Step> {
        let t = &mut self.troubles;
        let r = self.running.as_mut()?;
        if t.hang_until > now {
            return Some(Step::Hang(t.hang_until));
        }
        if t.stall_until > now {
            return Some(Step::Wait(t.stall_until));
        }
        if let Some(again) = r.again.take() {
            for (stream, _) in &again {
                self.ledgers[*stream].captured += 1;
                self.ledgers[*stream].repeated += 1;
            }
            return Some(Step::Ready(again));
        }
        let due = |n: u64| r.began_ns + n as i64 * r.period_ns + LATENCY_NS;
        let newest = ((now - r.began_ns - LATENCY_NS) / r.period_ns).max(0) as u64;
        // A late reader or a stall loses images.
        let mut first = r.next.max((newest + 1).saturating_sub(QUEUE));
        if core::mem::take(&mut t.stall_until) != 0 {
            first = first.max(newest);
        }
        first += core::mem::take(&mut t.skip);
        r.lost += first - r.next;
        r.next = first;
        if due(first) > now {
            return Some(Step::Wait(due(first)));
        }
        r.next += 1;
        let lost = core::mem::take(&mut r.lost);
        let lost = if r.handed && !r.set { lost } else { 0 };
        (r.handed, r.set) = (true, false);
        let repeats = core::mem::take(&mut t.repeated);
        t.repeated = repeats.saturating_sub(1);
        let images = self.images(first, lost);
        if let Some(r) = self.running.as_mut().filter(|_| repeats > 0) {
            r.again = Some(images.clone());
        }
        Some(Step::Ready(images))
    }

    fn images(&mut self, n: u64, lost: u64) -> Vec<(usize, Image)> {
        let Some(r) = &self.running else { return Vec::new() };
        let c = r.configuration;
        let began = r.began_ns;
        let period = r.period_ns;
        let device_us = (n as i64 * period / 1000 + r.offset_us).max(0) as u64;
        let mut take = |what: fn(&mut Troubles) -> &mut u64| {
            let left = what(&mut self.troubles);
            let is = *left > 0;
            *left = left.saturating_sub(1);
            is
        };
        let half = take(|t| &mut t.half);
        let wrong = take(|t| &mut t.wrong_size);
        let damaged = take(|t| &mut t.damaged);
        let only_color = take(|t| &mut t.only_color);
        let only_depth = take(|t| &mut t.only_depth);
        let no_stamp = take(|t| &mut t.no_host_stamp);
        let wrong_format = take(|t| &mut t.wrong_format);
        let padding = self.troubles.padding as u32;
        let mut streams = Vec::new();
        if let Some(size) = abi::color_size(c.color_resolution) {
            streams.push((0, c.color_format, size, only_depth));
        }
        if let Some(size) = abi::depth_size(c.depth_mode) {
            streams.extend((c.depth_mode != 5).then_some((1, abi::DEPTH16, size, only_color)));
            streams.push((2, abi::IR16, size, only_color));
        }
        let mut out = Vec::new();
        for (stream, format, mut size, is_missing) in streams {
            let ledger = &mut self.ledgers[stream];
            if is_missing {
                // The device took it, and it did not arrive.
                ledger.captured += 1;
                ledger.lost += 1;
                continue;
            }
            ledger.captured += 1 + lost;
            ledger.lost += lost;
            let mut bytes = match format {
                abi::MJPG => self.jpeg(size.0, size.1, n),
                _ => Arc::new(crate::images::image(format, size.0, size.1, n)),
            };
            let row = match format {
                abi::MJPG => 0,
                abi::NV12 => size.0,
                abi::BGRA32 => size.0 * 4,
                _ => size.0 * 2,
            };
            let mut stride = row;
            if padding > 0 && row > 0 {
                stride = row + padding;
                let padded = bytes
                    .chunks(row as usize)
                    .flat_map(|r| r.iter().copied().chain(core::iter::repeat_n(0xEE, padding as usize)));
                bytes = Arc::new(padded.collect());
            }
            let format = if wrong_format { (format + 1) % 6 } else { format };
            let ledger = &mut self.ledgers[stream];
            if wrong_format {
                ledger.damaged += 1;
            } else if half {
                bytes = Arc::new(bytes[..bytes.len() / 2].to_vec());
                ledger.half += 1;
            } else if wrong {
                ledger.wrong_size += 1;
                if format == abi::MJPG {
                    size = (size.0 + 16, size.1);
                    bytes = Arc::new(crate::images::image(format, size.0, size.1, n));
                } else {
                    bytes = Arc::new([&bytes[..], &[0; 640]].concat());
                }
            } else if damaged {
                ledger.damaged += 1;
            } else {
                ledger.good += 1;
            }
            let arrived = began + n as i64 * period + LATENCY_NS;
            out.push((
                stream,
                Image {
                    format,
                    size,
                    stride,
                    bytes: (!damaged).then_some(bytes),
                    device_us,
                    system_ns: if no_stamp { 0 } else { arrived as u64 },
                    exposure_us: if stream == 0 { 8330 } else { 12_800 },
                },
            ));
        }
        out
    }

    fn jpeg(&mut self, width: u32, height: u32, n: u64) -> Arc<Vec<u8>> {
        let n = n % crate::images::JPEGS;
        let encode = || Arc::new(crate::images::image(abi::MJPG, width, height, n));
        Arc::clone(self.jpegs.entry((width, height, n)).or_insert_with(encode))
    }

    /// True mid-exposure on the host of the newest image that had arrived by `at`.
    pub fn exposed(&self, at: i64) -> Option<i64> {
        let r = self.running.as_ref()?;
        let n = (at - r.began_ns - LATENCY_NS).div_euclid(r.period_ns);
        Some(r.began_ns + n * r.period_ns)
    }
}
