//! Depth of `zed replay` for third-party readers: a dataset and its expected contents.
//!
//! `cargo run -p depthrig-tests --example zed_replay_golden -- DATASET EXPECTED`; EXPECTED is as
//! `depthrig_tests::expected` writes it.
#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout)]

use core::ops::ControlFlow;
use depthrig_convert::zed_replay::{ZedReplayOptions, zed_replay};
use depthrig_recorder::Dataset;
use depthrig_tests::expected;
use depthrig_tests::synthetic_stereo::SyntheticStereo;
use std::path::Path;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, expected] = args.as_slice() else {
        println!("usage: zed_replay_golden DATASET EXPECTED");
        std::process::exit(2);
    };
    let dataset = Path::new(dataset);
    let source = tempfile::tempdir().unwrap();
    let source = source.path().join("source");
    SyntheticStereo { size: (96, 54), focal: 75.0, sets: 3, ..SyntheticStereo::default() }.record(&source);
    let options = ZedReplayOptions { disparity: true, ..ZedReplayOptions::default() };
    zed_replay(&source, dataset, &options, &mut |_, _, _| ControlFlow::Continue(())).unwrap();
    assert_eq!(
        Dataset::open(dataset).unwrap().session().motion.len(),
        1,
        "the unit of the camera that was taken"
    );
    expected::write(dataset, Path::new(expected), None, &mut |_, _, _| ());
}
