//! `depthrig recover`: repairs a dataset after a crash.

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
Each unfinished, torn or damaged segment is copied set by set; the copy is read back and compared before it replaces
the segment. Recovery can be interrupted at any time and started again; a second run changes nothing. The copy of a
segment needs as much free space as the segment. A dry run reads the same data and reports the same refusals and losses
without writing.

Exit codes: 0 nothing lost or nothing to do, 1 not recovered, 2 wrong usage, 3 recovered, but something is lost.

Examples:
  depthrig recover data/20261121_1015_kitchen
  depthrig recover data/20261121_1015_kitchen --dry-run     what would be done
  for d in data/*/; do depthrig recover \"$d\"; done";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct RecoverArgs {
    /// Dataset folder
    dataset: PathBuf,
    /// Report repairs and losses without changing anything
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
    let mut text = String::new();
    let path = printable::path(&report.path);
    let _ = match (report.changed, report.dry_run) {
        (false, _) => write!(text, "{path}: nothing to do, {}", out::count(report.sets, "set")),
        (true, false) => write!(text, "{path}: recovered, {}", out::count(report.sets, "set")),
        (true, true) => write!(text, "{path}: can be recovered, {}", out::count(report.sets, "set")),
    };
    for s in report.segments.iter().filter(|s| s.action != RecoverAction::None) {
        let done = match s.action {
            RecoverAction::Rebuilt => "copied set by set",
            _ => "complete, got its final name",
        };
        let _ =
            write!(text, "\n  {}: {done}, {}, {}", s.file, out::count(s.sets, "set"), out::bytes(s.bytes));
    }
    for name in &report.removed {
        let _ = write!(text, "\n  {}: a leftover, removed", printable::line(name));
    }
    for what in &report.lost {
        let _ = write!(text, "\n  lost: {}", printable::line(what));
    }
    for what in &report.notes {
        let _ = write!(text, "\n  note: {}", printable::line(what));
    }
    text
}
