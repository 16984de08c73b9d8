//! `depthrig merge`: joins parts of one recording into one dataset.

use super::trim::report;
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::signals::Stop;
use crate::watched::watched;
use anyhow::Result;
use depthrig_daemon::hosts::parts_of;
use depthrig_daemon::joining::join;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, SliceOptions, merge};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Inputs are datasets or single segments of the same recording (same rig, start, streams and calibration), in any
order. Sets are copied as stored, ordered by time. A set in several inputs is copied once; if it is damaged in one
input, it is taken from another. Contradicting inputs are refused. Until OUT is complete its folder is named
OUT.part; the inputs are only read.

Exit codes: 0 success, 1 failed (OUT does not exist), 2 wrong usage or inputs of different recordings, 3 done, but
sets between its first and last are missing (the output lists them).

Examples:
  depthrig merge data/kitchen data/kitchen_start data/kitchen_end
  depthrig merge data/rescued /mnt/disk1/seg_0000.mcap /mnt/disk2/seg_0001.mcap
  depthrig merge --hosts data/kitchen_joined data/kitchen             with the parts that were pulled of it
  depthrig merge --hosts data/kitchen_joined data/kitchen /mnt/left/kitchen_left

With --hosts the first input is that of the computer whose clock is the session's; scene, notes and episodes are taken from it, and OUT does not exist until
it is verified and has every frame of the inputs.";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct MergeArgs {
    /// Folder of the new dataset; must not exist
    out: PathBuf,
    /// Dataset folders or segment files
    #[arg(required = true)]
    inputs: Vec<PathBuf>,
    /// Inputs are what several computers recorded of one session: of each moment one set with the cameras of all
    #[arg(long)]
    hosts: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Joins the parts and reports the result.
pub fn run(args: &MergeArgs, context: &Context) -> Result<Exit> {
    if args.hosts {
        return join_hosts(args, context);
    }
    let inputs = args.inputs.iter().map(|path| Dataset::open(path)).collect::<Result<Vec<_>, _>>()?;
    report(args.json, || {
        watched(context, |progress| {
            let mut progress = |done, total| progress("merge", done, total);
            merge(&RealFs, &inputs, &args.out, &SliceOptions::default(), &mut progress)
        })
    })
}

/// Joins what several computers recorded.
fn join_hosts(args: &MergeArgs, context: &Context) -> Result<Exit> {
    let stop = Stop::on_signals()?;
    let inputs = match args.inputs.as_slice() {
        [only] => core::iter::once(only.clone()).chain(parts_of(only)?).collect(),
        several => several.to_vec(),
    };
    let sets = join(&inputs, &args.out, &context.runtime()?, 0, stop.flag())?;
    if args.json {
        out::json(&serde_json::json!({ "path": args.out, "sets": sets, "inputs": inputs }))?;
    } else {
        let of = out::count(inputs.len() as u64, "computer");
        out::line(format_args!("{}: {} of {of}", args.out.display(), out::count(sets, "set")))?;
    }
    Ok(Exit::Good)
}
