//! `depthrig verify`: checks that a dataset is complete and undamaged.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Severity, VerifyOptions, VerifyReport, verify_watched};
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Without --decode every byte is checked against checksums and every image against its set's mark, at disk speed; with
--decode every image is decompressed and decoded as well.

Exit codes: 0 complete, 1 damaged or not a dataset, 2 wrong usage, 3 intact, but not everything was recorded.

Examples:
  depthrig verify data/20261121_1015_kitchen
  depthrig verify data/20261121_1015_kitchen --decode --max-spread-ms 20";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct VerifyArgs {
    /// Dataset folder
    dataset: PathBuf,
    /// Also decode every image
    #[arg(long)]
    decode: bool,
    /// Threads for decoding [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Report sets with a larger spread of capture times [default: the rig's limit]
    #[arg(long, value_name = "MS", value_parser = crate::args::spread_ms)]
    max_spread_ms: Option<f64>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Verifies and reports.
pub fn run(args: &VerifyArgs, context: &Context) -> Result<Exit> {
    let max_spread_ns = args.max_spread_ms.map(|ms| (ms * 1e6) as i64);
    let options =
        VerifyOptions { decode: args.decode, max_spread_ns, threads: usize::from(args.threads.unwrap_or(0)) };
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let report = verify_watched(&fs, &args.dataset, &options, &mut |p| {
        bar.set("verify", p.bytes >> 20, p.total_bytes >> 20);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    bar.clear();
    if report.stopped {
        bail!("interrupted; not everything was verified");
    }
    if args.json {
        out::json(&report)?;
    } else {
        if context.global.quiet == 0 {
            for finding in &report.findings {
                let at = finding.offset.map_or_else(String::new, |offset| format!(":{offset}"));
                out::line(format_args!(
                    "{}: {}{at}: {}",
                    word(finding.severity),
                    printable::line(&finding.file),
                    printable::line(&finding.message)
                ))?;
            }
        }
        out::line(summary(&report))?;
        if context.global.quiet == 0 {
            for producer in &report.computed {
                out::line(format_args!("computed: {}", printable::line(&producer.to_string())))?;
            }
        }
    }
    Ok(exit(&report))
}

/// One line with the verdict and the amount of data.
pub fn summary(report: &VerifyReport) -> String {
    let count = |severity| report.findings.iter().filter(|f| f.severity == severity).count();
    let verdict = match report.worst() {
        Some(Severity::Broken) => format!("BROKEN ({} findings)", count(Severity::Broken)),
        Some(Severity::Lost) => {
            format!("intact, but not everything was recorded ({} findings)", count(Severity::Lost))
        }
        _ => "whole".to_owned(),
    };
    format!(
        "{}: {verdict}; {}, {}{}, {} in {}",
        printable::path(&report.path),
        out::count(report.sets, "set"),
        out::count(report.frames, "frame"),
        if report.decoded { " (every image decoded)" } else { "" },
        out::bytes(report.bytes),
        out::count(report.segments, "segment")
    )
}

/// Exit code of the worst finding.
pub fn exit(report: &VerifyReport) -> Exit {
    match report.worst() {
        Some(Severity::Broken) => Exit::Failed,
        Some(Severity::Lost) => Exit::Lost,
        _ => Exit::Good,
    }
}

const fn word(severity: Severity) -> &'static str {
    match severity {
        Severity::Note => "note",
        Severity::Lost => "lost",
        Severity::Broken => "broken",
    }
}
