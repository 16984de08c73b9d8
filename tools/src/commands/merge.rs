//! `depthrig merge`: parts of one recording as one dataset again.

use super::trim::report;
use crate::context::Context;
use crate::exit::Exit;
use crate::watched::watched;
use anyhow::Result;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, SliceOptions, merge};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Inputs are datasets or single segments of the same recording (same rig, begin, streams and calibration), in any
order. Sets are copied as they are stored, in the order of their times. A set that is in several inputs is taken
once; where it is damaged in one it is taken from another. Inputs that contradict each other are refused. Until
OUT is whole its folder is named OUT.part; the inputs are only read.

Exit codes: 0 done, 1 failed (OUT is not there), 2 wrong usage or inputs that do not belong together, 3 done, but
sets between its first and its last are missing (the output says which).

Examples:
  depthrig merge data/kitchen data/kitchen_start data/kitchen_end
  depthrig merge data/rescued /mnt/disk1/seg_0000.mcap /mnt/disk2/seg_0001.mcap";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct MergeArgs {
    /// Folder of the new dataset; must not be there
    out: PathBuf,
    /// Datasets or segments
    #[arg(required = true)]
    inputs: Vec<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Joins and reports.
pub fn run(args: &MergeArgs, context: &Context) -> Result<Exit> {
    let inputs = args.inputs.iter().map(|path| Dataset::open(path)).collect::<Result<Vec<_>, _>>()?;
    report(args.json, || {
        watched(context, |tell| {
            let mut progress = |done, total| tell("merge", done, total);
            merge(&RealFs, &inputs, &args.out, &SliceOptions::default(), &mut progress)
        })
    })
}
