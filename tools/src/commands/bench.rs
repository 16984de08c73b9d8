//! `depthrig bench`: measures what depthrig promises about speed.

use crate::bench::bus::{self, Plan, report};
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::RuntimeDir;
use depthrig_recorder::bench::{BenchOptions, BenchReport};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Every ratio is taken inside one run, with both sides taking turns, so that it holds on a busy machine too.

Examples:
  depthrig bench bus             about three minutes
  depthrig bench bus --quick     half a minute, to see that it works
  depthrig bench bus --check     exit code 1 when a promise is not kept
  depthrig bench record --json";

/// What to measure.
#[derive(Debug, clap::Subcommand)]
pub enum BenchCommand {
    /// Sending a frame: latency, copies, CPU, and what bad subscribers do to a publisher
    Bus(BenchArgs),
    /// Recording seven cameras at 5 Hz: CPU, lost sets, and how fast the writer can be
    Record(RecordArgs),
}

/// How much, and in which form.
#[derive(Debug, clap::Args)]
pub struct BenchArgs {
    /// Measure briefly; the numbers are rough
    #[arg(long)]
    quick: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// End with exit code 1 when a promise is not kept
    #[arg(long)]
    check: bool,
}

/// How to record.
#[derive(Debug, clap::Args)]
pub struct RecordArgs {
    /// Where datasets are written and removed again; the disk that you will record to
    #[arg(long, value_name = "DIR")]
    dir: Option<PathBuf>,
    /// Record these pictures instead of made ones (8-bit PNG or JPEG for colour, 16-bit PNG for depth)
    #[arg(long, value_name = "DIR")]
    images: Option<PathBuf>,
    /// How long to record
    #[arg(long, value_name = "N", default_value = "10", value_parser = crate::cli::positive_seconds)]
    seconds: f64,
    /// How much, and in which form
    #[command(flatten)]
    bench: BenchArgs,
}

/// Runs a bench.
pub fn run(command: &BenchCommand, context: &Context) -> Result<Exit> {
    match command {
        BenchCommand::Bus(args) => run_bus(args, context),
        BenchCommand::Record(args) => run_record(args),
    }
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
    let (conditions, options, steady) = (&report.conditions, &report.options, &report.steady);
    let warning = if conditions.optimised { "" } else { "; DEBUG BUILD, numbers mean nothing" };
    let mut lines = vec![
        format!(
            "{} x {}, load average {} before; {}{warning}",
            conditions.cores, conditions.cpu, conditions.load, conditions.pictures
        ),
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
