//! `depthrig prune`: removes the sets of discarded episodes from a dataset for good.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use crate::watched::{usage, watched};
use anyhow::Result;
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Dataset, Prunable, prunable, prune};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Without --yes nothing changes: the output lists the episodes, sets and bytes that would go. With it they cannot be brought back.

The dataset is written anew beside the old one, which takes as much room as what stays, then verified, and then takes the old
one's place in one step. Sets that stay are copied as stored. A dataset that records, is in use or damaged is left alone.

Exit codes: 0 success, 1 failed (the dataset is as it was), 2 wrong usage.

Examples:
  depthrig prune data/20261121_1015_kitchen
  depthrig prune data/20261121_1015_kitchen --yes";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct PruneArgs {
    /// Dataset folder
    dataset: PathBuf,
    /// Remove them
    #[arg(long)]
    yes: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Lists what would go, or removes it.
pub fn run(args: &PruneArgs, context: &Context) -> Result<Exit> {
    let dataset = Dataset::open(&args.dataset)?;
    if !args.yes {
        let found = prunable(&dataset).map_err(usage)?;
        return report(args, &found, false);
    }
    // A path such as `.` has no name, and a link's name is not the folder's.
    let path = args.dataset.canonicalize()?;
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let done = watched(context, |progress| prune(&fs, &path, progress))?;
    report(args, &done.removed, done.removed.sets > 0)?;
    if let Some(left) = &done.left {
        let left = left.display();
        out::note(format_args!("{left}, the old folder, could not be removed; look at it and remove it"));
    }
    if done.had_report {
        let again = format!("depthrig report {}", args.dataset.display());
        out::note(format_args!("report.html was about all sets and is gone; write a new one: {again}"));
    }
    Ok(Exit::Good)
}

fn report(args: &PruneArgs, found: &Prunable, is_done: bool) -> Result<Exit> {
    let path = &args.dataset;
    if args.json {
        out::json(&json!({ "path": path, "removed": is_done, "prunable": found }))?;
        return Ok(Exit::Good);
    }
    out::line(text(path, found, is_done))?;
    Ok(Exit::Good)
}

fn text(path: &Path, found: &Prunable, is_done: bool) -> String {
    let shown = path.display();
    if found.sets == 0 {
        return format!("{shown}: no set is in a discarded episode alone, nothing to remove");
    }
    let mut lines: Vec<_> =
        found.episodes.iter().map(|e| format!("episode {}", printable::line(&e.text()))).collect();
    lines.push(format!(
        "{shown}: {}{} and {}; {} stay",
        if is_done { "removed " } else { "would remove " },
        out::count(found.sets, "set"),
        out::bytes(found.bytes),
        out::count(found.kept_sets, "set"),
    ));
    if !is_done {
        lines.push("nothing was changed; remove them for good with --yes".to_owned());
    }
    lines.join("\n")
}
