//! Measures the cost of recording on this computer: cores at a steady rate, and the writer's throughput.
//!
//! The first part records images in real time, as the daemon would, from memory that stands for shared
//! memory. The second part pushes images that are JPEG already as fast as they are taken, so that what is
//! left is building messages, checksums and writing.

use crate::fs::RealFs;
use crate::{
    ColorCodec, Compression, Error, ErrorKind, RecordFrame, RecordSet, Recorder, RecorderOptions, Result,
    Session, StreamRecord, Summary,
};
use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

mod images;
pub mod soak;

/// Options of a measurement.
#[derive(Debug, Clone, Serialize)]
pub struct BenchOptions {
    /// Where datasets are written and removed again.
    pub dir: PathBuf,
    /// Cameras, each with a colour and a depth stream.
    pub cameras: usize,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Sets per second.
    pub rate_hz: f64,
    /// How long to record, seconds.
    pub seconds: f64,
    /// A folder of images to record instead of synthetic ones: 8-bit PNG or JPEG for colour, 16-bit PNG for depth.
    pub images: Option<PathBuf>,
    /// Bytes to write in the throughput part; 0 leaves it out.
    pub writer_bytes: u64,
    /// How to record in the first part.
    pub recorder: RecorderOptions,
}

impl Default for BenchOptions {
    fn default() -> Self {
        Self {
            dir: std::env::temp_dir(),
            cameras: 7,
            width: 1280,
            height: 720,
            rate_hz: 5.0,
            seconds: 10.0,
            images: None,
            writer_bytes: 1 << 30,
            recorder: RecorderOptions::default(),
        }
    }
}

/// Results of a measurement, and its conditions.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct BenchReport {
    /// The options it ran with.
    pub options: BenchOptions,
    /// The computer.
    pub conditions: Conditions,
    /// Recording at a steady rate.
    pub steady: Steady,
    /// Writing as fast as it goes, if asked for.
    pub writer: Option<Throughput>,
}

/// The computer that was measured on.
#[derive(Debug, Clone, Serialize)]
pub struct Conditions {
    /// Its processor.
    pub cpu: String,
    /// Cores this process may use.
    pub cores: usize,
    /// Load average over one minute before the measurement: other work makes numbers worse.
    pub load: String,
    /// Whether this is an optimised build; other builds measure nothing of interest.
    pub optimised: bool,
    /// Where the images come from.
    pub images: String,
}

/// Recording at a steady rate.
#[derive(Debug, Clone, Serialize)]
pub struct Steady {
    /// CPU time over wall time, all threads of the process.
    pub cores: f64,
    /// Sets pushed.
    pub sets: u64,
    /// Sets that were not recorded.
    pub dropped: u64,
    /// Longest time that a push took, microseconds.
    pub push_max_us: f64,
    /// Bytes of pixels that came in per second, MB.
    pub raw_mb_per_s: f64,
    /// Bytes that went to disk per second, MB.
    pub disk_mb_per_s: f64,
    /// Bytes on disk per colour and depth pair, MB.
    pub mb_per_pair: f64,
}

/// Writing as fast as it goes.
#[derive(Debug, Clone, Serialize)]
pub struct Throughput {
    /// MB written per second of CPU time of the whole process.
    pub mb_per_cpu_s: f64,
    /// MB written per second.
    pub mb_per_s: f64,
    /// MB written.
    pub mb: f64,
    /// Bytes of one payload.
    pub payload_bytes: usize,
}

impl Conditions {
    fn now(images: String) -> Self {
        let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
        let cpuinfo = read("/proc/cpuinfo");
        let cpu = cpuinfo.lines().find_map(|l| l.strip_prefix("model name\t: "));
        Self {
            cpu: cpu.unwrap_or("unknown").to_owned(),
            cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            load: read("/proc/loadavg").split(' ').next().unwrap_or_default().to_owned(),
            optimised: !cfg!(debug_assertions),
            images,
        }
    }
}

/// Measures what recording costs.
///
/// # Errors
/// As recording does; [`ErrorKind::BadInput`] when the images cannot be used.
pub fn run(options: &BenchOptions) -> Result<BenchReport> {
    let (pool, images) = images::pool(options.images.as_deref(), options.width, options.height)?;
    let conditions = Conditions::now(images);
    let steady = steady(options, &pool)?;
    let writer = (options.writer_bytes > 0).then(|| throughput(options)).transpose()?;
    Ok(BenchReport { options: options.clone(), conditions, steady, writer })
}

/// A stream of images that repeat.
struct Source {
    record: StreamRecord,
    images: Vec<Arc<[u8]>>,
}

fn stream(id: &str, format: PixelFormat, width: u32, height: u32) -> Result<StreamRecord> {
    let id = id.parse().map_err(|e| Error::new(ErrorKind::BadInput, "no stream").with_source(e))?;
    Ok(StreamRecord {
        id,
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
    })
}

fn set(sources: &[Source], id: u64, tick: HostTime, utc: UtcPair) -> RecordSet {
    let frames = sources.iter().enumerate().map(|(stream, source)| {
        let record = &source.record;
        let image = &source.images[id as usize % source.images.len()];
        let mut header = FrameHeader::default();
        header.set_names("bench", &record.id);
        header.set_image(record.format, record.width, record.height);
        header.payload_len = image.len() as u32;
        (header.sequence, header.captured) = (id, id);
        header.capture_time_ns = tick.ns();
        header.depth_unit_m = record.depth_unit_m;
        header.intrinsics = record.intrinsics;
        RecordFrame { stream, header, pixels: Box::new(Arc::clone(image)) }
    });
    RecordSet {
        id,
        tick,
        utc,
        frames: frames.collect(),
        missing: Vec::new(),
        motion: Vec::new(),
        signals: Vec::new(),
        spread_ns: 0,
    }
}

fn steady(options: &BenchOptions, pool: &images::Pool) -> Result<Steady> {
    let mut sources = Vec::new();
    for camera in 0..options.cameras.max(1) {
        // Each camera begins at another image.
        let turn = |p: &[Arc<[u8]>]| (0..p.len()).map(|i| Arc::clone(&p[(i + camera) % p.len()])).collect();
        let w = options.width;
        let h = options.height;
        sources.push(Source {
            record: stream(&format!("cam{camera}/color"), PixelFormat::Rgb8, w, h)?,
            images: turn(&pool.color),
        });
        sources.push(Source {
            record: stream(&format!("cam{camera}/depth"), PixelFormat::Z16, w, h)?,
            images: turn(&pool.depth),
        });
    }
    let period = Duration::from_secs_f64(1.0 / options.rate_hz.clamp(0.01, 1000.0));
    let sets = (options.seconds * options.rate_hz).round().max(1.0) as u64;
    let begin = HostTime::now();
    let cpu = process_cpu_ns();
    let utc = UtcPair::sample();
    let mut push_max_ns = 0;
    let feed = |recorder: &Recorder| {
        for n in 0..sets {
            let due = begin.plus(period.saturating_mul(n as u32));
            std::thread::sleep(due.from_now());
            let set = set(&sources, n + 1, due, utc);
            let before = HostTime::now();
            // A refused set is counted by the recorder and reported below.
            drop(recorder.push(set));
            push_max_ns = push_max_ns.max(HostTime::now().since_ns(before));
        }
        std::thread::sleep(begin.plus(period.saturating_mul(sets as u32)).from_now());
    };
    let (measured, ()) = record(&options.dir, &sources, options.recorder.clone(), feed, |_| Ok(()))?;
    let Measured { summary, end, end_cpu_ns } = measured;
    let wall = end.since_ns(begin) as f64 / 1e9;
    let cpu = (end_cpu_ns - cpu) as f64 / 1e9;
    let raw: usize = sources.iter().map(|s| s.images[0].len()).sum();
    let mb = summary.bytes as f64 / 1e6;
    let pairs = summary.sets.recorded * options.cameras as u64;
    Ok(Steady {
        cores: cpu / wall,
        sets,
        dropped: summary.sets.dropped_total(),
        push_max_us: push_max_ns as f64 / 1e3,
        raw_mb_per_s: raw as f64 * summary.sets.recorded as f64 / 1e6 / wall,
        disk_mb_per_s: mb / wall,
        mb_per_pair: mb / pairs.max(1) as f64,
    })
}

fn throughput(options: &BenchOptions) -> Result<Throughput> {
    /// A 720p JPEG of quality 95, about.
    const PAYLOAD: usize = 320 << 10;
    const STREAMS: usize = 14;
    let mut sources = Vec::new();
    for i in 0..STREAMS {
        let bytes = images::incompressible(PAYLOAD, i as u64);
        sources.push(Source {
            record: stream(&format!("cam{i}/color"), PixelFormat::Mjpeg, 1280, 720)?,
            images: vec![bytes],
        });
    }
    let recorder = RecorderOptions {
        compression: Compression::None,
        color: ColorCodec::Raw,
        segment_max_bytes: 1 << 30,
        min_free_bytes: 0,
        workers: 1,
        ..RecorderOptions::default()
    };
    let sets = options.writer_bytes.div_ceil((PAYLOAD * STREAMS) as u64).max(1);
    let begin = HostTime::now();
    let cpu = process_cpu_ns();
    let utc = UtcPair::sample();
    let feed = |recorder: &Recorder| {
        for n in 0..sets {
            let tick = begin.plus_ns(n as i64 * 1_000_000);
            while recorder.progress().encode_queue >= 2 || recorder.progress().backlog_bytes > 64 << 20 {
                std::thread::sleep(Duration::from_micros(200));
            }
            drop(recorder.push(set(&sources, n + 1, tick, utc)));
        }
    };
    let (measured, ()) = record(&options.dir, &sources, recorder, feed, |_| Ok(()))?;
    let Measured { summary, end, end_cpu_ns } = measured;
    let wall = end.since_ns(begin) as f64 / 1e9;
    let cpu = (end_cpu_ns - cpu) as f64 / 1e9;
    if summary.sets.recorded != sets {
        let message = format!("the throughput cannot be measured: {}", summary.lost.join("; "));
        return Err(Error::new(ErrorKind::Io, message));
    }
    let mb = summary.bytes as f64 / 1e6;
    Ok(Throughput { mb_per_cpu_s: mb / cpu, mb_per_s: mb / wall, mb, payload_bytes: PAYLOAD })
}

/// A finished recording and when it was finished, before it was removed.
struct Measured {
    summary: Summary,
    end: HostTime,
    end_cpu_ns: i64,
}

/// Records into a new folder below `dir`, looks at it with `look`, and removes it.
fn record<T>(
    dir: &Path,
    sources: &[Source],
    options: RecorderOptions,
    feed: impl FnOnce(&Recorder),
    look: impl FnOnce(&Path) -> Result<T>,
) -> Result<(Measured, T)> {
    let dir = dir.join(format!("depthrig-bench-{}", std::process::id()));
    let mut session = Session::new("bench", "bench");
    session.streams = sources.iter().map(|s| s.record.clone()).collect();
    let recorder = Recorder::create(Arc::new(RealFs), &dir, session, options)?;
    feed(&recorder);
    let summary = recorder.finish();
    let end = HostTime::now();
    let end_cpu_ns = process_cpu_ns();
    let seen = look(&dir);
    std::fs::remove_dir_all(&dir).map_err(|e| Error::io("remove", &dir, e))?;
    Ok((Measured { summary: summary?, end, end_cpu_ns }, seen?))
}
