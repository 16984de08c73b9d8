//! The corpus of the fuzz targets of what devices send, as tests: what a fuzzer once found interesting or broken stays
//! mended.

use depthrig_drivers::fuzzing::realsense;
use std::path::{Path, PathBuf};

/// Runs each input that is kept for `target`, and sees that the seeds still reach what they were made for.
fn run(target: &str, reached: impl Fn(&[u8]) -> u64) {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus").join(target);
    let mut paths: Vec<PathBuf> = std::fs::read_dir(&dir)
        .unwrap_or_else(|e| panic!("{}: {e}", dir.display()))
        .map(|e| e.unwrap().path())
        .collect();
    paths.sort();
    let mut seeds = 0;
    for path in &paths {
        println!("{}", path.display());
        let far = reached(&std::fs::read(path).unwrap());
        if path.file_name().unwrap().to_string_lossy().starts_with("seed_") {
            seeds += 1;
            assert!(far > 0, "{} reaches nothing: make the seeds anew", path.display());
        }
    }
    assert!(seeds > 0, "{target} has no seeds");
}

#[test]
fn realsense_hwm() {
    run("realsense_hwm", realsense::hwm);
}

#[test]
fn realsense_gvd() {
    run("realsense_gvd", realsense::gvd);
}

#[test]
fn realsense_tables() {
    run("realsense_tables", realsense::tables);
}

#[test]
fn realsense_metadata() {
    run("realsense_metadata", realsense::metadata);
}

#[test]
fn realsense_l515() {
    run("realsense_l515", realsense::l515);
}

#[test]
fn realsense_preset() {
    run("realsense_preset", realsense::preset);
}
