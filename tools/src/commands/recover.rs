//! `depthrig recover`: makes a dataset whole again after a crash.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::fmt::Write;
use core::ops::ControlFlow;
use depthrig_recorder::{RecoverAction, RecoverOptions, RecoverReport, recover};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Each segment that is unfinished, torn or damaged is copied set by set; the copy is read back and compared, and only
then takes the old file's place. It may be interrupted at any time and begun again; done twice it changes nothing.
A segment's copy needs as much free space as the segment. A dry run does the same but for writing: it reads as much,
and what it refuses or finds lost is what a recovery refuses or finds lost.

Exit codes: 0 nothing was lost or nothing to do, 3 recovered and something is lost, 1 not recovered, 2 wrong usage.

Examples:
  depthrig recover data/20261121_1015_kitchen
  depthrig recover data/20261121_1015_kitchen --dry-run     what would be done
  for d in data/*/; do depthrig recover \"$d\"; done";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct RecoverArgs {
    /// The dataset's folder
    dataset: PathBuf,
    /// Say what would be done and lost, and change nothing; only a disk that fails or fills up is not foreseen
    #[arg(long)]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Recovers and reports.
pub fn run(args: &RecoverArgs, context: &Context) -> Result<Exit> {
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let options = RecoverOptions { dry_run: args.dry_run, ..RecoverOptions::default() };
    let report = recover(&args.dataset, &options, &mut |p| {
        bar.set("recover", p.done_bytes, p.total_bytes);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    bar.clear();
    if args.json {
        out::json(&report)?;
    } else {
        out::line(text(&report))?;
    }
    Ok(if report.lost.is_empty() { Exit::Good } else { Exit::Lost })
}

fn text(report: &RecoverReport) -> String {
    let mut told = String::new();
    let path = printable::path(&report.path);
    // Writing to a string cannot fail.
    let _ = match (report.changed, report.dry_run) {
        (false, _) => write!(told, "{path}: nothing to do, {}", out::count(report.sets, "set")),
        (true, false) => write!(told, "{path}: recovered, {}", out::count(report.sets, "set")),
        (true, true) => write!(told, "{path}: can be recovered, {}", out::count(report.sets, "set")),
    };
    for s in report.segments.iter().filter(|s| s.action != RecoverAction::None) {
        let done = match s.action {
            RecoverAction::Rebuilt => "copied set by set",
            _ => "whole, got its final name",
        };
        let _ =
            write!(told, "\n  {}: {done}, {}, {}", s.file, out::count(s.sets, "set"), out::bytes(s.bytes));
    }
    for name in &report.removed {
        let _ = write!(told, "\n  {}: a leftover, removed", printable::line(name));
    }
    for what in &report.lost {
        let _ = write!(told, "\n  lost: {}", printable::line(what));
    }
    for what in &report.notes {
        let _ = write!(told, "\n  note: {}", printable::line(what));
    }
    told
}
