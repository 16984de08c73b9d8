//! `depthrig edit`: changes a dataset's description, with history.

use crate::exit::{Exit, UsageError};
use crate::out;
use anyhow::Result;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::utc_text;
use depthrig_recorder::{Dataset, Edit, SessionChanges, edit, rename};
use serde::Serialize;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Only session.toml changes, never the recorded data. It keeps each change with its time and the previous value. \
Without an option the history is printed.

Examples:
  depthrig edit data/20261121_1015_kitchen --scene \"kitchen, lamp on\" --note \"camera 3 was bumped at 04:10\"
  depthrig edit data/20261121_1015_kitchen --rename 20261121_1015_kitchen_lamp
  depthrig edit data/20261121_1015_kitchen --json";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct EditArgs {
    /// Dataset folder
    dataset: PathBuf,
    /// Set the scene label; an empty text removes it
    #[arg(long, value_name = "LABEL")]
    scene: Option<String>,
    /// Set the operator; an empty text removes it
    #[arg(long, value_name = "NAME")]
    operator: Option<String>,
    /// Add a note; repeatable
    #[arg(long = "note", value_name = "TEXT")]
    notes: Vec<String>,
    /// Rename the dataset and its folder
    #[arg(long, value_name = "NAME")]
    rename: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The new changes and the full history.
#[derive(Serialize)]
struct Edited {
    path: PathBuf,
    changed: Vec<Edit>,
    history: Vec<Edit>,
}

/// Applies the changes, or prints the history.
pub fn run(args: &EditArgs) -> Result<Exit> {
    let changes = SessionChanges {
        scene: args.scene.clone(),
        operator: args.operator.clone(),
        notes: args.notes.clone(),
    };
    let asked = changes != SessionChanges::default() || args.rename.is_some();
    let mut path = args.dataset.clone();
    let mut changed = Vec::new();
    if asked {
        let usage = |e: depthrig_recorder::Error| match e.kind() {
            depthrig_recorder::ErrorKind::BadInput => anyhow::Error::new(UsageError(e.to_string())),
            _ => e.into(),
        };
        changed = edit(&RealFs, &path, &changes).map_err(usage)?;
        if let Some(name) = &args.rename {
            // A path such as `.` has no file name.
            let (to, edits) = rename(&RealFs, &path.canonicalize()?, name).map_err(usage)?;
            changed.extend(edits);
            path = to;
        }
    }
    let history = Dataset::open(&path)?.session().history.clone();
    if args.json {
        out::json(&Edited { path, changed, history })?;
        return Ok(Exit::Good);
    }
    let shown = if asked { &changed } else { &history };
    if shown.is_empty() {
        out::line(format_args!(
            "{}: {}",
            path.display(),
            if asked { "nothing to change" } else { "never edited" }
        ))?;
    }
    for e in shown {
        let what = if e.field == "notes" {
            format!("note added: {:?}", e.after)
        } else {
            format!("{}: {:?} is now {:?}", e.field, e.before, e.after)
        };
        out::line(format_args!("{} {}: {what}", utc_text(e.utc_ns), path.display()))?;
    }
    Ok(Exit::Good)
}
