//! Selects what `depthrig eval` reads.

use super::EvalArgs;
use crate::context::Context;
use crate::eval::dataset::{FromDataset, Streams};
use crate::eval::files::{Files, Named, Pairs, RAW};
use crate::eval::scenes::Scenes;
use crate::eval::shards::{self, Shards};
use crate::eval::{Source, USUAL_RANGE_M, hammer};
use crate::exit::UsageError;
use anyhow::Result;
use depthrig_bus::StreamName;
use depthrig_cdm::metrics::DepthRange;
use depthrig_convert::store::Place;
use std::path::Path;

/// Images to evaluate.
pub struct Opened {
    /// The images.
    pub source: Box<dyn Source>,
    /// References that count by default.
    pub limits: DepthRange,
    /// Title of the report.
    pub title: String,
    /// The folder of copies that the images are read from, of a bucket.
    pub copy: Option<tempfile::TempDir>,
}

/// The range of references of HAMMER and of shards.
pub const fn usual_range() -> DepthRange {
    let (min_m, max_m) = USUAL_RANGE_M;
    DepthRange { min_m, max_m }
}

/// Opens what the arguments name.
///
/// # Errors
/// When it is not one of the known layouts, or options do not belong to it; and as a bucket says.
pub fn open(args: &EvalArgs, context: &Context) -> Result<Opened> {
    let scenes = Scenes::new(&args.scenes);
    let Some(input) = &args.input else { return pairs(args, &scenes) };
    let title = input.display().to_string();
    let (folder, copy) = match Place::parse(input)? {
        Place::Local(folder) => (folder, None),
        Place::Remote(remote) => {
            let (folder, copy) = args.scratch.copy(&remote, context)?;
            (folder, Some(copy))
        }
    };
    let input = folder.as_path();
    let opened = |source: Box<dyn Source>, limits| Ok(Opened { source, limits, title, copy });
    if shards::are_at(input) {
        only(
            "shards",
            &[
                ("--pred", !args.pred.is_empty()),
                ("--raw", args.raw.is_some()),
                ("--truth", args.truth.is_some()),
            ],
        )?;
        return opened(Box::new(Shards::open(input, &scenes)?), usual_range());
    }
    // A folder without read permission is refused like a dataset, with the cure.
    let is_closed = input.read_dir().is_err_and(|e| e.kind() == std::io::ErrorKind::PermissionDenied);
    if is_closed || input.join(depthrig_recorder::SESSION_FILE).is_file() || input.is_file() {
        let names = args.pred.iter().map(|p| stream(p)).collect::<Result<Vec<_>>>()?;
        let truth = args.truth.as_deref().map(stream).transpose()?;
        let raw = args.raw.as_deref().map(stream).transpose()?;
        let streams = Streams {
            predictions: &names,
            truth: truth.as_ref(),
            raw: raw.as_ref(),
            refining: !args.refine.is_empty(),
        };
        only("a dataset", &[("--scenes", !scenes.is_all())])?;
        return opened(Box::new(FromDataset::open(input, &streams)?), DepthRange::ALL);
    }
    only("HAMMER", &[("--raw", args.raw.is_some()), ("--truth", args.truth.is_some())])?;
    let tests = hammer::TEST_SCENES.map(str::to_owned);
    let scenes = if args.like_cdm && scenes.is_all() { Scenes::new(&tests) } else { scenes };
    let files = hammer::open(input, &folders(args), args.material.as_deref(), &scenes, args.resize)?;
    opened(Box::new(files), usual_range())
}

/// Folders beside each other.
fn pairs(args: &EvalArgs, scenes: &Scenes) -> Result<Opened> {
    let usage = "without INPUT give --truth DIR and --pred DIR or --raw DIR, or give a dataset with truth";
    let given = !args.pred.is_empty() || args.raw.is_some();
    let truth = args.truth.as_ref().filter(|_| given).ok_or_else(|| UsageError(usage.into()))?;
    if !args.refine.is_empty() && args.raw.is_none() {
        return Err(UsageError("--refine needs --raw DIR, a folder of raw depth".into()).into());
    }
    let raw = args.raw.as_ref().map(|r| Named { name: RAW.into(), folder: r.into(), unit_m: args.unit });
    let files = Files::pairs(&Pairs {
        truth: Path::new(truth),
        truth_unit_m: args.truth_unit.unwrap_or(args.unit),
        predictions: &folders(args),
        raw: raw.as_ref(),
        color: args.rgb.as_deref(),
        material: args.material.as_deref(),
        lens: args.intrinsics,
        scenes,
        resize: args.resize,
    })?;
    Ok(Opened { source: Box::new(files), limits: DepthRange::ALL, title: truth.clone(), copy: None })
}

/// Refuses options that a layout has no use for.
fn only(layout: &str, given: &[(&str, bool)]) -> Result<()> {
    match given.iter().find(|(_, given)| *given) {
        Some((option, _)) => Err(UsageError(format!("{option} does not apply to {layout}")).into()),
        None => Ok(()),
    }
}

fn stream(text: &str) -> Result<StreamName> {
    StreamName::new(text).map_err(|e| UsageError(format!("invalid stream name {text}: {e}")).into())
}

fn folders(args: &EvalArgs) -> Vec<Named> {
    let named = |text: &String| {
        let (name, folder) = text.split_once('=').unwrap_or_else(|| (last_part(text), text));
        Named { name: name.to_owned(), folder: folder.into(), unit_m: args.unit }
    };
    args.pred.iter().map(named).collect()
}

fn last_part(path: &str) -> &str {
    path.trim_end_matches('/').rsplit('/').next().unwrap_or(path)
}
