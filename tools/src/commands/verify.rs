//! `depthrig verify`: proves that a dataset is whole, or says where it is not.

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
Exit codes: 0 it is whole, 1 it is broken or no dataset, 3 it says itself that something was not recorded.

Without --decode every byte is proven by checksums and every picture by its set's mark, at the speed of the disk;
with it every picture is unpacked and decoded too.

Examples:
  depthrig verify data/20261121_1015_kitchen
  depthrig verify data/20261121_1015_kitchen --decode --max-spread-ms 20";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct VerifyArgs {
    /// The dataset's folder
    dataset: PathBuf,
    /// Decode every picture as well
    #[arg(long)]
    decode: bool,
    /// Threads that unpack and decode; all cores when not given
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Report sets whose frames were captured further apart than this, in place of the rig's own limit
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
        bail!("the verification was ended before it had read everything");
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
            for made in &report.computed {
                out::line(format_args!("computed: {}", printable::line(&made.to_string())))?;
            }
        }
    }
    Ok(exit(&report))
}

/// One line: how much was looked at, and what came of it.
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
        if report.decoded { " (every picture decoded)" } else { "" },
        out::bytes(report.bytes),
        out::count(report.segments, "segment")
    )
}

/// The exit code that the worst finding asks for.
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
