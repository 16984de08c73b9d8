//! `depthrig trim`: a part of a dataset as a dataset of its own.

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
Sets are copied as they are stored, never packed or coded anew; both ends are part of the range. OUT is a whole
dataset: it verifies, replays and can be merged again with other parts of the same recording (depthrig merge).
session.toml says what it was cut from. Until OUT is whole its folder is named OUT.part; the input is only read.

A moment T is a number of seconds after the first set, or a time such as 2026-11-21T10:15:03.2Z.

Exit codes: 0 done, 1 failed (OUT is not there), 2 wrong usage, 3 done, but sets between its first and its last
are missing (the output says which).

Examples:
  depthrig trim data/20261121_1015_kitchen data/kitchen_start --to 30
  depthrig trim data/20261121_1015_kitchen data/kitchen_cup --from 12.5 --to 2026-11-21T10:16:00Z
  depthrig trim data/20261121_1015_kitchen data/kitchen_one --first-set 120 --last-set 180";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TrimArgs {
    /// The dataset's folder, or one segment
    dataset: PathBuf,
    /// Folder of the new dataset; must not be there
    out: PathBuf,
    /// From this moment on
    #[arg(long, value_name = "T", conflicts_with = "first_set")]
    from: Option<Moment>,
    /// Up to this moment
    #[arg(long, value_name = "T", conflicts_with = "last_set")]
    to: Option<Moment>,
    /// From the set of this id on
    #[arg(long, value_name = "ID")]
    first_set: Option<u64>,
    /// Up to the set of this id
    #[arg(long, value_name = "ID")]
    last_set: Option<u64>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Cuts and reports.
pub fn run(args: &TrimArgs, context: &Context) -> Result<Exit> {
    let edge = |moment: Option<Moment>, id: Option<u64>| moment.map(Edge::Moment).or(id.map(Edge::Set));
    let span = SetSpan { from: edge(args.from, args.first_set), to: edge(args.to, args.last_set) };
    let dataset = Dataset::open(&args.dataset)?;
    report(args.json, || {
        watched(context, |tell| {
            let mut progress = |done, total| tell("trim", done, total);
            trim(&RealFs, &dataset, &args.out, span, &SliceOptions::default(), &mut progress)
        })
    })
}

/// Tells what was made, and which exit code that is.
pub(super) fn report(json: bool, make: impl FnOnce() -> Result<SliceReport>) -> Result<Exit> {
    let made = make()?;
    if json {
        out::json(&made)?;
    } else {
        let repeated = match made.repeated {
            0 => String::new(),
            n => format!(" ({n} were in several inputs)"),
        };
        out::line(format_args!(
            "{}: {}{repeated}, {} to {}, {}, {} in {}",
            made.path.display(),
            out::count(made.sets, "set"),
            made.first_set,
            made.last_set,
            out::seconds(made.duration_ns as f64 / 1e9),
            out::bytes(made.bytes),
            out::count(made.segments, "segment")
        ))?;
        for lost in &made.lost {
            out::line(format_args!("lost: {lost}"))?;
        }
    }
    Ok(if made.complete { Exit::Good } else { Exit::Lost })
}
