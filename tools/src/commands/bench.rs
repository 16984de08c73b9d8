//! `depthrig bench`: measures performance and checks it against depthrig's promises.

use crate::bench::bus::{self, Plan, report};
use crate::bench::capture;
use crate::bench::stereo;
use crate::commands::stereo::Image;
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::RuntimeDir;
use depthrig_recorder::bench::soak::{self, SoakOptions, SoakReport};
use depthrig_recorder::bench::{BenchOptions, BenchReport, Conditions};
use depthrig_v4l2::V4l2Config;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Every ratio is measured within one run, alternating between both sides, so that it holds on a busy machine.

Examples:
  depthrig bench bus             about three minutes
  depthrig bench bus --quick     half a minute, as a smoke test
  depthrig bench bus --check     exit code 1 if a promise is not kept
  depthrig bench record --json
  depthrig bench capture --port 1-2 --check
  depthrig bench stereo --check
  depthrig bench soak --check    ten minutes of recording at full speed; 12 GB of disk, deleted afterwards";

/// Subcommands of `depthrig bench`.
#[derive(Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// Measure the bus: latency, copies, CPU, effect of bad subscribers
    Bus(BenchArgs),
    /// Measure recording seven cameras at 5 Hz: CPU, lost sets, writer throughput
    Record(RecordArgs),
    /// Measure V4L2 capture from a camera: CPU against a bare loop, and copies
    Capture(CaptureArgs),
    /// Measure stereo matching: CPU time per pair with each preset
    Stereo(StereoArgs),
    /// Run a long recording at full speed: constant memory, every set accounted for
    Soak(SoakArgs),
}

/// Options of every benchmark.
#[derive(Debug, clap::Args)]
pub struct BenchArgs {
    /// Measure briefly, with rough numbers
    #[arg(long)]
    quick: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Exit with code 1 if a promise is not kept
    #[arg(long)]
    check: bool,
}

/// Options of `bench record`.
#[derive(Debug, clap::Args)]
pub struct RecordArgs {
    /// Folder for temporary datasets, on the disk used for recordings
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
    /// Record the images in DIR (PNG, JPEG; depth: 16-bit PNG) [default: generated]
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Recording time, seconds
    #[arg(long, value_name = "N", default_value = "10", value_parser = crate::args::positive_seconds)]
    seconds: f64,
    /// Options of every benchmark.
    #[command(flatten)]
    bench: BenchArgs,
}

/// Options of `bench capture`.
#[derive(Debug, clap::Args)]
pub struct CaptureArgs {
    /// Serial number of the camera [default: the only one attached]
    #[arg(long)]
    serial: Option<String>,
    /// USB port of the camera, as `depthrig cameras` lists it
    #[arg(long)]
    port: Option<String>,
    /// Image width, pixels
    #[arg(long, default_value_t = 1280, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    width: u32,
    /// Image height, pixels
    #[arg(long, default_value_t = 720, value_parser = clap::value_parser!(u32).range(1..=16_384))]
    height: u32,
    /// Frame rate, Hz
    #[arg(long, value_name = "HZ", default_value_t = 30.0, value_parser = crate::args::rate_hz)]
    rate_hz: f64,
    /// Options of every benchmark.
    #[command(flatten)]
    bench: BenchArgs,
}

/// Options of `bench stereo`.
#[derive(Debug, clap::Args)]
pub struct StereoArgs {
    /// Left image of a rectified pair [default: a generated pair of 1280x720]
    #[arg(long, value_name = "FILE", requires = "right")]
    left: Option<PathBuf>,
    /// Right image
    #[arg(long, value_name = "FILE", requires = "left")]
    right: Option<PathBuf>,
    /// Disparity search range, pixels
    #[arg(long, value_name = "N", default_value_t = 128, value_parser = clap::value_parser!(u16).range(1..=256))]
    max_disparity: u16,
    /// Threads per matcher
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64))]
    threads: u16,
    /// Pairs per preset; at most 3 with --quick
    #[arg(long, value_name = "N", default_value_t = 15, value_parser = clap::value_parser!(u16).range(1..=10_000))]
    rounds: u16,
    /// Options of every benchmark; `--quick` measures three rounds.
    #[command(flatten)]
    bench: BenchArgs,
}

/// Options of `bench soak`.
#[derive(Debug, clap::Args)]
pub struct SoakArgs {
    /// Folder for the temporary dataset
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
    /// Record the images in DIR (PNG, JPEG; depth: 16-bit PNG) [default: generated]
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// Recorded time at 5 sets per second, seconds; at most 300 with --quick
    #[arg(long, value_name = "SECONDS", default_value = "600", value_parser = crate::args::positive_seconds)]
    seconds: f64,
    /// Options of every benchmark; `--quick` records five minutes of small images.
    #[command(flatten)]
    bench: BenchArgs,
}

/// Runs a benchmark.
pub fn run(command: &BenchCommand, context: &Context) -> Result<Exit> {
    match command {
        BenchCommand::Bus(args) => run_bus(args, context),
        BenchCommand::Record(args) => run_record(args),
        BenchCommand::Stereo(args) => run_stereo(args, context),
        BenchCommand::Soak(args) => run_soak(args, context),
        BenchCommand::Capture(args) => run_capture(args, context),
    }
}

fn run_capture(args: &CaptureArgs, context: &Context) -> Result<Exit> {
    let folder = crate::context::private_folder()?;
    let runtime = RuntimeDir::at(folder.path())?;
    let camera = V4l2Config { serial: args.serial.clone(), port: args.port.clone(), ..V4l2Config::default() };
    let (images, warm_up, rounds) = if args.bench.quick { (20, 10, 1) } else { (150, 30, 5) };
    let size = (args.width, args.height);
    let plan = capture::Plan { camera, size, rate_hz: args.rate_hz, images, warm_up, rounds };
    let mut progress = Progress::new(context.global.quiet > 0);
    let result = capture::run(&runtime, &plan, |what, done, total| progress.set(what, done, total))?;
    progress.clear();
    if args.bench.json {
        out::json(&result)?;
    } else {
        out::line(capture::text(&result))?;
    }
    let kept = capture::bars(&result).iter().all(|bar| bar.kept);
    Ok(if args.bench.check && !kept { Exit::Failed } else { Exit::Good })
}

fn run_stereo(args: &StereoArgs, context: &Context) -> Result<Exit> {
    let max_disparity = usize::from(args.max_disparity);
    let [left, right] = match (&args.left, &args.right) {
        (Some(left), Some(right)) => Image::pair(left, right)?,
        _ => stereo::synthetic_pair(1280, 720, max_disparity),
    };
    let rounds = if args.bench.quick { args.rounds.min(3) } else { args.rounds }.into();
    let plan = stereo::Plan { max_disparity, threads: args.threads.into(), rounds };
    let mut progress = Progress::new(context.global.quiet > 0);
    let result = stereo::run(&left, &right, plan, |what, done, total| progress.set(what, done, total));
    progress.clear();
    let report = result?;
    if args.bench.json {
        out::json(&report)?;
    } else {
        out::line(stereo::text(&report))?;
    }
    let kept = stereo::bars(&report).iter().all(|bar| bar.kept);
    Ok(if args.bench.check && !kept { Exit::Failed } else { Exit::Good })
}

fn run_bus(args: &BenchArgs, context: &Context) -> Result<Exit> {
    let folder = crate::context::private_folder()?;
    let runtime = RuntimeDir::at(folder.path())?;
    let plan = if args.quick {
        Plan { blocks: 3, rounds: 1, phase: Duration::from_secs(2), settle: Duration::from_millis(500) }
    } else {
        Plan { blocks: 30, rounds: 5, phase: Duration::from_secs(5), settle: Duration::from_secs(1) }
    };
    let mut progress = Progress::new(context.global.quiet > 0);
    let result = bus::run(&runtime, plan, |what, done, total| progress.set(what, done, total))?;
    progress.clear();
    if args.json {
        out::json(&result)?;
    } else {
        out::line(report::text(&result))?;
    }
    let kept = report::bars(&result).iter().all(|bar| bar.kept);
    Ok(if args.check && !kept { Exit::Failed } else { Exit::Good })
}

fn run_record(args: &RecordArgs) -> Result<Exit> {
    let mut options =
        BenchOptions { images: args.images.clone(), seconds: args.seconds, ..BenchOptions::default() };
    if let Some(dir) = &args.dir {
        options.dir.clone_from(dir);
    }
    if args.bench.quick {
        options.seconds = options.seconds.min(3.0);
        options.writer_bytes /= 4;
    }
    let report = depthrig_recorder::bench::run(&options)?;
    let bars = record_bars(&report);
    if args.bench.json {
        out::json(&report)?;
    } else {
        out::line(record_text(&report, &bars))?;
    }
    Ok(if args.bench.check && !bars.iter().all(|b| b.kept) { Exit::Failed } else { Exit::Good })
}

fn run_soak(args: &SoakArgs, context: &Context) -> Result<Exit> {
    let mut options =
        SoakOptions { images: args.images.clone(), recorded_s: args.seconds, ..SoakOptions::default() };
    if let Some(dir) = &args.dir {
        options.dir.clone_from(dir);
    }
    if args.bench.quick {
        (options.width, options.height) = (160, 120);
        options.recorded_s = options.recorded_s.min(300.0);
        // As many segments and as small a share of unwritten data as in the long form.
        (options.recorder.segment_max_ns, options.backlog_bytes) = (20_000_000_000, 1 << 20);
    }
    let mut progress = Progress::new(context.global.quiet > 0);
    let result = soak::run(&options, |done, total| progress.set("sets recorded", done, total));
    progress.clear();
    let report = result?;
    let bars = soak_bars(&report);
    if args.bench.json {
        out::json(&report)?;
    } else {
        out::line(soak_text(&report, &bars))?;
    }
    Ok(if args.bench.check && !bars.iter().all(|b| b.kept) { Exit::Failed } else { Exit::Good })
}

/// Promises about long recordings.
fn soak_bars(report: &SoakReport) -> [report::Bar; 3] {
    [
        report::Bar {
            promise: "resident memory: below 1 MB more per minute recorded",
            measured: format!("{:+.3}", report.slope_mb_per_min),
            kept: report.slope_mb_per_min < 1.0,
        },
        report::Bar {
            promise: "sets neither recorded nor in the accounts of the dropped: 0",
            measured: format!("{} of {}", report.unexplained, report.pushed),
            kept: report.unexplained == 0,
        },
        report::Bar {
            promise: "sets dropped, and findings of verify: none",
            measured: format!("{} dropped, {} findings", report.dropped, report.findings.len()),
            kept: report.dropped == 0 && report.findings.is_empty(),
        },
    ]
}

fn soak_text(report: &SoakReport, bars: &[report::Bar]) -> String {
    let options = &report.options;
    let mut lines = vec![
        conditions(&report.conditions),
        format!(
            "{} cameras x {}x{} (colour + depth), {:.0} s at {} Hz, in {:.0} s ({:.1} times as fast), {:.0} s of CPU",
            options.cameras,
            options.width,
            options.height,
            options.recorded_s,
            options.rate_hz,
            report.wall_s,
            options.recorded_s / report.wall_s,
            report.cpu_s
        ),
        format!(
            "  {} sets in {} segments, {}; resident after {:.0} s: {:.1} to {:.1} MB",
            report.recorded,
            report.segments,
            out::bytes(report.bytes),
            options.warm_up_s,
            report.rss_mb.0,
            report.rss_mb.1
        ),
    ];
    let minutes: Vec<String> = report
        .samples
        .chunk_by(|a, b| (a.recorded_s / 60.0).floor() == (b.recorded_s / 60.0).floor())
        .map(|m| format!("{:.1}", m.iter().map(|s| s.rss_mb).sum::<f64>() / m.len() as f64))
        .collect();
    lines.push(format!("  mean resident MB of each minute: {}", minutes.join(" ")));
    lines.extend(report.findings.iter().map(|f| format!("  {f}")));
    lines.push("\nPromises".to_owned());
    lines.extend(bars.iter().map(report::Bar::line));
    lines.join("\n")
}

/// The computer, in a line.
fn conditions(c: &Conditions) -> String {
    let warning = if c.optimised { "" } else { "; DEBUG BUILD, numbers mean nothing" };
    format!("{} x {}, load average {} before; {}{warning}", c.cores, c.cpu, c.load, c.images)
}

/// Promises about recording.
fn record_bars(report: &BenchReport) -> Vec<report::Bar> {
    let steady = &report.steady;
    let mut bars = vec![
        report::Bar {
            promise: "sets dropped: 0",
            measured: format!("{} of {}", steady.dropped, steady.sets),
            kept: steady.dropped == 0,
        },
        report::Bar {
            promise: "cores for 7 x 1280x720 (RGB8 + Z16) at 5 Hz: at most 1.2",
            measured: format!("{:.2}", steady.cores),
            kept: steady.cores <= 1.2,
        },
    ];
    bars.extend(report.writer.as_ref().map(|w| report::Bar {
        promise: "writer of pre-encoded payloads: at least 1500 MB per CPU second",
        measured: format!("{:.0}", w.mb_per_cpu_s),
        kept: w.mb_per_cpu_s >= 1500.0,
    }));
    bars
}

fn record_text(report: &BenchReport, bars: &[report::Bar]) -> String {
    let options = &report.options;
    let steady = &report.steady;
    let mut lines = vec![
        conditions(&report.conditions),
        format!(
            "{} cameras x {}x{} (colour + depth) at {} Hz for {} s, JPEG quality {}",
            options.cameras,
            options.width,
            options.height,
            options.rate_hz,
            options.seconds,
            options.recorder.jpeg_quality
        ),
        format!(
            "  {:.2} cores; {} sets, {} dropped; {:.0} MB/s of pixels in, {:.0} MB/s to disk ({:.2} MB a pair); longest push {:.0} us",
            steady.cores,
            steady.sets,
            steady.dropped,
            steady.raw_mb_per_s,
            steady.disk_mb_per_s,
            steady.mb_per_pair,
            steady.push_max_us
        ),
    ];
    lines.extend(report.writer.as_ref().map(|w| {
        format!(
            "writer, payloads of {}: {:.0} MB per CPU second, {:.0} MB/s to this disk, {:.0} MB written",
            out::bytes(w.payload_bytes as u64),
            w.mb_per_cpu_s,
            w.mb_per_s,
            w.mb
        )
    }));
    lines.push("\nPromises".to_owned());
    lines.extend(bars.iter().map(report::Bar::line));
    lines.join("\n")
}
