//! `depthrig trim`: cuts a part of a dataset into a new dataset.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::watched::watched;
use anyhow::Result;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, Edge, Moment, SetSpan, SliceOptions, SliceReport, trim};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Sets are copied as stored, without compressing or encoding again; the range includes both ends. OUT is a full
dataset: it can be verified, replayed and merged with other parts of the same recording (depthrig merge).
session.toml names its source. Until OUT is complete its folder is named OUT.part; the input is only read.

A time T is a number of seconds after the first set, or a date and time such as 2026-11-21T10:15:03.2Z.

Exit codes: 0 success, 1 failed (OUT does not exist), 2 wrong usage, 3 done, but sets between its first and last
are missing (the output lists them).

Examples:
  depthrig trim data/20261121_1015_kitchen data/kitchen_start --to 30
  depthrig trim data/20261121_1015_kitchen data/kitchen_cup --from 12.5 --to 2026-11-21T10:16:00Z
  depthrig trim data/20261121_1015_kitchen data/kitchen_one --first-set 120 --last-set 180";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TrimArgs {
    /// Dataset folder, or one segment file
    dataset: PathBuf,
    /// Folder of the new dataset; must not exist
    out: PathBuf,
    /// Start at this time
    #[arg(long, value_name = "T", conflicts_with = "first_set")]
    from: Option<Moment>,
    /// End at this time
    #[arg(long, value_name = "T", conflicts_with = "last_set")]
    to: Option<Moment>,
    /// Start at the set with this id
    #[arg(long, value_name = "ID")]
    first_set: Option<u64>,
    /// End at the set with this id
    #[arg(long, value_name = "ID")]
    last_set: Option<u64>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Cuts the dataset and reports the result.
pub fn run(args: &TrimArgs, context: &Context) -> Result<Exit> {
    let edge = |moment: Option<Moment>, id: Option<u64>| moment.map(Edge::Moment).or(id.map(Edge::Set));
    let span = SetSpan { from: edge(args.from, args.first_set), to: edge(args.to, args.last_set) };
    let dataset = Dataset::open(&args.dataset)?;
    report(args.json, || {
        watched(context, |progress| {
            let mut progress = |done, total| progress("trim", done, total);
            trim(&RealFs, &dataset, &args.out, span, &SliceOptions::default(), &mut progress)
        })
    })
}

/// Prints the result, and returns its exit code.
pub(super) fn report(json: bool, make: impl FnOnce() -> Result<SliceReport>) -> Result<Exit> {
    let cut = make()?;
    if json {
        out::json(&cut)?;
    } else {
        let repeated = match cut.repeated {
            0 => String::new(),
            n => format!(" ({n} were in several inputs)"),
        };
        out::line(format_args!(
            "{}: {}{repeated}, {} to {}, {}, {} in {}",
            cut.path.display(),
            out::count(cut.sets, "set"),
            cut.first_set,
            cut.last_set,
            out::seconds(cut.duration_ns as f64 / 1e9),
            out::bytes(cut.bytes),
            out::count(cut.segments, "segment")
        ))?;
        for lost in &cut.lost {
            out::line(format_args!("lost: {lost}"))?;
        }
    }
    Ok(if cut.complete { Exit::Good } else { Exit::Lost })
}
