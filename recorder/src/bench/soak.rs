//! A long recording in a short time: whether memory stays where it is, and every set is accounted for.
//!
//! Sets come as fast as the recorder takes them, with the times of a real recording, so that everything which
//! grows with a recording's length grows here too: segments, indexes, accounts.

use super::{Conditions, Measured, Source, images, record, set, stream};
use crate::{Progress, RecorderOptions, Result, Severity, VerifyOptions, verify};
use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::{HostTime, PixelFormat, UtcPair};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// Options of a soak run.
#[derive(Debug, Clone, Serialize)]
pub struct SoakOptions {
    /// Where the dataset is written and removed again.
    pub dir: PathBuf,
    /// Cameras, each with a colour and a depth stream.
    pub cameras: usize,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Sets per second of recorded time.
    pub rate_hz: f64,
    /// Recorded time, seconds.
    pub recorded_s: f64,
    /// Recorded time before memory is looked at, seconds.
    pub warm_up_s: f64,
    /// Sets wait while this many encoded bytes are on their way to the disk: memory that comes and goes with them
    /// would hide memory that stays.
    pub backlog_bytes: u64,
    /// A folder of images to record instead of synthetic ones.
    pub images: Option<PathBuf>,
    /// How to record.
    pub recorder: RecorderOptions,
}

impl Default for SoakOptions {
    fn default() -> Self {
        Self {
            dir: std::env::temp_dir(),
            cameras: 7,
            width: 1280,
            height: 720,
            rate_hz: 5.0,
            recorded_s: 600.0,
            warm_up_s: 180.0,
            backlog_bytes: 16 << 20,
            images: None,
            recorder: RecorderOptions::default(),
        }
    }
}

/// Resident memory of this process at one moment.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Sample {
    /// Recorded time so far, seconds.
    pub recorded_s: f64,
    /// Resident memory, MB.
    pub rss_mb: f64,
}

/// Results of a soak run, and its conditions.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct SoakReport {
    /// The options it ran with.
    pub options: SoakOptions,
    /// The computer.
    pub conditions: Conditions,
    /// Once a second of recorded time.
    pub samples: Vec<Sample>,
    /// Slope of the straight line through the samples after warming up, MB per minute of recorded time.
    pub slope_mb_per_min: f64,
    /// Least and most resident memory after warming up, MB.
    pub rss_mb: (f64, f64),
    /// Sets handed over, as counted here and not by the recorder.
    pub pushed: u64,
    /// Sets that were refused at once, as counted here.
    pub refused: u64,
    /// Sets in the dataset, as counted by reading it.
    pub recorded: u64,
    /// Sets that the dataset's accounts say were dropped.
    pub dropped: u64,
    /// Sets that are neither recorded nor dropped by the accounts: must be 0.
    pub unexplained: i64,
    /// Findings of `verify` beyond notes; empty for a complete dataset.
    pub findings: Vec<String>,
    /// Bytes written.
    pub bytes: u64,
    /// Segments written.
    pub segments: u32,
    /// Time it took, seconds.
    pub wall_s: f64,
    /// CPU time of the process, seconds.
    pub cpu_s: f64,
}

/// Resident memory of this process, MB; 0 when the system does not report it.
fn rss_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"));
    let kib = line.and_then(|l| l.split_whitespace().next()?.parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0 / 1e6
}

/// Slope of the line with the least squared distance to the points (x, y); 0 for fewer than two places of x.
fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len().max(1) as f64;
    let mx = points.iter().map(|p| p.0).sum::<f64>() / n;
    let my = points.iter().map(|p| p.1).sum::<f64>() / n;
    let var: f64 = points.iter().map(|p| (p.0 - mx).powi(2)).sum();
    let cov: f64 = points.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum();
    if var > 0.0 { cov / var } else { 0.0 }
}

/// Records for a long recorded time and looks at memory and accounts. `progress` hears of sets done and of all.
///
/// # Errors
/// As recording and verifying do.
pub fn run(options: &SoakOptions, mut progress: impl FnMut(u64, u64)) -> Result<SoakReport> {
    let (pool, from) = images::pool(options.images.as_deref(), options.width, options.height)?;
    let conditions = Conditions::now(from);
    let mut sources = Vec::new();
    for camera in 0..options.cameras.max(1) {
        let w = options.width;
        let h = options.height;
        let color = stream(&format!("cam{camera}/color"), PixelFormat::Rgb8, w, h)?;
        sources.push(Source { record: color, images: pool.color.clone() });
        let depth = stream(&format!("cam{camera}/depth"), PixelFormat::Z16, w, h)?;
        sources.push(Source { record: depth, images: pool.depth.clone() });
    }
    let rate = options.rate_hz.clamp(0.01, 1000.0);
    let period_ns = (1e9 / rate) as i64;
    let sets = (options.recorded_s * rate).round().max(1.0) as u64;
    let sample_every = rate.round().max(1.0) as u64;
    let begin = HostTime::now();
    let cpu = process_cpu_ns();
    let utc = UtcPair::sample();
    let mut samples = Vec::with_capacity((sets / sample_every + 1) as usize);
    let mut refused = 0;
    let (measured, report) = record(
        &options.dir,
        &sources,
        options.recorder.clone(),
        |recorder| {
            for n in 0..sets {
                let busy = |p: Progress| p.encode_queue >= 2 || p.backlog_bytes > options.backlog_bytes;
                while busy(recorder.progress()) {
                    std::thread::sleep(Duration::from_micros(500));
                }
                let tick = begin.plus_ns((n as i64).saturating_mul(period_ns));
                refused += u64::from(recorder.push(set(&sources, n + 1, tick, utc)).is_err());
                if n % sample_every == 0 {
                    samples.push(Sample { recorded_s: n as f64 / rate, rss_mb: rss_mb() });
                    progress(n, sets);
                }
            }
            progress(sets, sets);
        },
        |dir| verify(dir, &VerifyOptions::default()),
    )?;
    let Measured { summary, end, end_cpu_ns } = measured;
    let after: Vec<_> = samples.iter().filter(|s| s.recorded_s >= options.warm_up_s).collect();
    let points: Vec<_> = after.iter().map(|s| (s.recorded_s / 60.0, s.rss_mb)).collect();
    let range =
        after.iter().fold((f64::MAX, 0.0), |(lo, hi): (f64, f64), s| (lo.min(s.rss_mb), hi.max(s.rss_mb)));
    let dropped = summary.sets.dropped_total();
    let worse = report.findings.iter().filter(|f| f.severity > Severity::Note);
    Ok(SoakReport {
        options: options.clone(),
        conditions,
        slope_mb_per_min: slope(&points),
        rss_mb: range,
        samples,
        pushed: sets,
        refused,
        recorded: report.sets,
        dropped,
        unexplained: sets as i64 - report.sets as i64 - dropped as i64,
        findings: worse.map(|f| format!("{}: {}", f.file, f.message)).collect(),
        bytes: summary.bytes,
        segments: summary.segments,
        wall_s: end.since_ns(begin) as f64 / 1e9,
        cpu_s: (end_cpu_ns - cpu) as f64 / 1e9,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_slope_is_that_of_the_line() {
        let line: Vec<_> = (0..9).map(|x| (f64::from(x), 3.0 - 0.5 * f64::from(x))).collect();
        assert!((slope(&line) + 0.5).abs() < 1e-12);
        assert_eq!(slope(&[(1.0, 5.0), (1.0, 9.0)]), 0.0);
        assert_eq!(slope(&[]), 0.0);
    }

    #[test]
    fn memory_is_resident() {
        let before = rss_mb();
        let used = vec![1_u8; 64 << 20];
        assert!(rss_mb() > before + 40.0 && used[7] == 1, "{before} MB before 64 MiB, {} after", rss_mb());
    }
}
