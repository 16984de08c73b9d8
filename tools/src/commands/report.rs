//! `depthrig report`: writes the quality report of a dataset.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use core::ops::ControlFlow;
use depthrig_recorder::Dataset;
use depthrig_recorder::report::{REPORT_FILE, Report, ReportOptions};
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
A recording writes its report when it ends; --overwrite replaces it, for instance after `depthrig recover`.
Exit codes: 0 the dataset is complete, 1 no report was written, 2 wrong usage, 3 the dataset is incomplete or damaged.

Examples:
  depthrig report data/20261121_1015_kitchen --overwrite
  depthrig report data/20261121_1015_kitchen --out kitchen.html --max-spread-ms 20
  depthrig report data/20261121_1015_kitchen --json | jq .verdict";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ReportArgs {
    /// Dataset folder, or one segment file
    dataset: PathBuf,
    /// HTML report to write [default: report.html in the dataset]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Largest spread in a set [default: the session's, else half the longest period]
    #[arg(long, value_name = "MS", value_parser = crate::args::spread_ms)]
    max_spread_ms: Option<f64>,
    /// Number of sets to decode depth images of, for the fill rate
    #[arg(long, value_name = "N", default_value_t = ReportOptions::default().fill_sets)]
    fill_sets: usize,
    /// Print JSON instead of writing the HTML report (with --out: both)
    #[arg(long)]
    json: bool,
}

/// Writes the report.
pub fn run(args: &ReportArgs, context: &Context) -> Result<Exit> {
    let dataset = Dataset::open(&args.dataset)?;
    let page = match &args.out {
        Some(path) => Some(path.clone()),
        None if args.json => None,
        None if args.dataset.is_dir() => Some(args.dataset.join(REPORT_FILE)),
        None => return Err(UsageError("a report of one segment needs --out FILE".to_owned()).into()),
    };
    let session = args.dataset.join(depthrig_recorder::SESSION_FILE);
    let inputs: Vec<&Path> =
        dataset.segments().iter().map(PathBuf::as_path).chain([session.as_path()]).collect();
    let page = page.map(|path| OutFile::new(&path, args.overwrite, &inputs)).transpose()?;
    let options = ReportOptions {
        fill_sets: args.fill_sets,
        max_spread_ns: args.max_spread_ms.map(|ms| (ms * 1e6) as i64),
    };
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let mut on_progress = |done: u64| {
        bar.set("looking at the dataset", done, 1000);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let Some(report) = Report::of(&dataset, &options, &mut on_progress)? else {
        bail!("interrupted; no report was written");
    };
    bar.clear();
    if let Some(page) = &page {
        page.write(report.to_html().as_bytes())?;
    }
    if args.json {
        out::json(&report)?;
    } else {
        out::line(&report.verdict.headline)?;
        for line in report.verdict.why.iter().chain(&report.verdict.remarks) {
            out::line(format_args!("  {line}"))?;
        }
        if let Some(page) = &page {
            out::line(format_args!("report    {}", page.path().display()))?;
        }
    }
    Ok(if report.verdict.health.is_bad() { Exit::Lost } else { Exit::Good })
}
