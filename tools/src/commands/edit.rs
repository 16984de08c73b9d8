//! `depthrig edit`: changes a dataset's description, with history.

use crate::calibrate;
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::watched::watched;
use anyhow::Result;
use depthrig_convert::recalibrate;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::utc_text;
use depthrig_recorder::{Dataset, Edit, EpisodeEnd, Mark, SessionChanges, edit, rename};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Only session.toml changes, never the recorded images. It keeps each change with its time and the previous value. \
Without an option the history is printed.

--calibration gives the dataset another calibration of the mount: session.toml, /tf_static, the camera information and the header of each
frame then have its intrinsics and poses. Segments are copied before they are replaced, so the disk needs room for them once more.
A calibration of another serial number or size of image is refused. Run it again if it was cut off.

Examples:
  depthrig edit data/20261121_1015_kitchen --scene \"kitchen, lamp on\" --note \"camera 3 was bumped at 04:10\"
  depthrig edit data/20261121_1015_kitchen --calibration calibration.toml
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
    /// Judge the recording; exports leave out what is marked bad
    #[arg(long, value_enum, value_name = "MARK")]
    mark: Option<MarkArg>,
    /// Judge an episode: N=success, N=failure, N=none or N=discard; repeatable
    #[arg(long = "episode", value_name = "N=JUDGEMENT", value_parser = super::episode::judgement)]
    episodes: Vec<(u32, EpisodeEnd)>,
    /// Calibration of the mount to attach
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Rename the dataset and its folder
    #[arg(long, value_name = "NAME")]
    rename: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A judgement of a recording.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum MarkArg {
    /// To be used
    Good,
    /// Not to be used
    Bad,
    /// Take the judgement back
    None,
}

impl MarkArg {
    const fn mark(self) -> Option<Mark> {
        match self {
            Self::Good => Some(Mark::Good),
            Self::Bad => Some(Mark::Bad),
            Self::None => None,
        }
    }
}

/// The new changes and the full history.
#[derive(Serialize)]
struct Edited {
    path: PathBuf,
    changed: Vec<Edit>,
    history: Vec<Edit>,
}

/// Applies the changes, or prints the history.
pub fn run(args: &EditArgs, context: &Context) -> Result<Exit> {
    let changes = SessionChanges {
        scene: args.scene.clone(),
        operator: args.operator.clone(),
        notes: args.notes.clone(),
        mark: args.mark.map(MarkArg::mark),
        episodes: args.episodes.clone(),
    };
    let asked = changes != SessionChanges::default() || args.rename.is_some() || args.calibration.is_some();
    let mut path = args.dataset.clone();
    let mut changed = Vec::new();
    if asked {
        if let Some(file) = &args.calibration {
            changed = attach(&path, file, context)?;
        }
        changed.extend(edit(&RealFs, &path, &changes).map_err(usage)?);
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
        out::line(format_args!("{} {}: {}", utc_text(e.utc_ns), path.display(), e.text()))?;
    }
    Ok(Exit::Good)
}

/// Bad input is wrong usage.
fn usage(e: depthrig_recorder::Error) -> anyhow::Error {
    match e.kind() {
        depthrig_recorder::ErrorKind::BadInput => UsageError(e.to_string()).into(),
        _ => e.into(),
    }
}

/// Gives the dataset the calibration in `file`.
fn attach(path: &Path, file: &Path, context: &Context) -> Result<Vec<Edit>> {
    let text = calibrate::calibration_text(file)?;
    let calibration = calibrate::calibration(file)?;
    let dataset = Dataset::open(path)?;
    let plan = recalibrate::plan(dataset.session(), &calibration, &text, file).map_err(usage)?;
    if !plan.left.is_empty() {
        tracing::warn!(
            "{} has no entry of {}: their poses stay as they were, against the old reference",
            file.display(),
            plan.left.join(", ")
        );
    }
    for doubt in &plan.doubts {
        tracing::warn!("{}: {doubt}", file.display());
    }
    let done = watched(context, |progress| {
        depthrig_recorder::recalibrate(&RealFs, path, &plan.change, &mut |done, total| {
            progress("copy", done, total)
        })
    })?;
    Ok(done.edits)
}
