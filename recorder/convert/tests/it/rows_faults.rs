//! Exports of rows whose disk fails at each operation, or loses its power. Their content is checked in `tests/python/test_lerobot.py` and
//! `test_demonstrations.py`, with readers of others.

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_convert::lerobot::Lerobot;
use depthrig_convert::{ExportOptions, ExportReport, Exporter, Hdf5, RowOptions, Zarr, export};
use depthrig_recorder::fs::{Fault, Fs, MemFs};
use depthrig_recorder::{Dataset, ErrorKind, RecorderOptions, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn out() -> PathBuf {
    PathBuf::from("/export")
}

/// Two segments, and the same again as a second episode.
fn dataset() -> MemFs {
    let fs = MemFs::new();
    record(&fs, 6, RecorderOptions { segment_max_ns: 4 * PERIOD, ..options() });
    fs
}

/// Twice the same dataset: two episodes.
fn two(fs: &MemFs) -> Vec<Dataset> {
    vec![open(fs), open(fs)]
}

/// An exporter of one layout, new for each run.
type Make = fn() -> Box<dyn Exporter>;

fn lerobot() -> Box<dyn Exporter> {
    Box::new(Lerobot::new(RowOptions::default()))
}

fn zarr() -> Box<dyn Exporter> {
    Box::new(Zarr::new(RowOptions::default()))
}

fn hdf5() -> Box<dyn Exporter> {
    Box::new(Hdf5::new(RowOptions::default()))
}

/// Exports until `sets` sets are read; `None` is all of them.
fn run(make: Make, fs: &MemFs, datasets: Vec<Dataset>, sets: Option<u64>) -> Result<ExportReport> {
    export(fs, &mut *make(), datasets, &out(), ExportOptions { workers: 1 }, &mut |p| {
        if sets.is_some_and(|sets| p.sets >= sets) {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    })
}

/// Every file below the folder of the export.
fn files(fs: &MemFs, dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let entries = fs.read_dir(dir).unwrap().into_iter().map(|e| (dir.join(&e.name), e.is_dir));
    entries
        .flat_map(|(p, is_dir)| if is_dir { files(fs, &p) } else { [(p.clone(), contents(fs, &p))].into() })
        .collect()
}

/// Whether a file is of an export that is not complete; arrays of Zarr have hidden files of their own.
fn is_temporary(path: &Path) -> bool {
    let name = path.file_name().unwrap().to_str().unwrap();
    path.extension().is_some_and(|e| e == "tmp") || name.starts_with('.') && !name.starts_with(".z")
}

fn whole(make: Make, source: &MemFs) -> BTreeMap<PathBuf, Vec<u8>> {
    let fs = copy(source);
    let report = run(make, &fs, two(&fs), None).unwrap();
    let files = files(&fs, &out());
    assert_eq!((report.sets, report.lost, report.files as usize), (12, 0, files.len() - 1));
    assert!(!files.keys().any(|p| is_temporary(p)), "{:?}", files.keys());
    files
}

#[test]
fn an_export_to_lerobot_survives_a_failure_of_any_operation() {
    survives_failures(lerobot);
}

#[test]
fn an_export_to_zarr_survives_a_failure_of_any_operation() {
    survives_failures(zarr);
}

#[test]
fn an_export_to_hdf5_survives_a_failure_of_any_operation() {
    survives_failures(hdf5);
}

fn survives_failures(make: Make) {
    let source = dataset();
    let expected = whole(make, &source);
    let mut failures = 0;
    for n in 0.. {
        let fs = copy(&source);
        let datasets = two(&fs);
        let at = fs.ops() + n;
        let fs = fs.with_fault(Fault::FailOnce(at, std::io::ErrorKind::Other));
        let result = run(make, &fs, datasets, None);
        if at >= fs.ops() {
            result.unwrap();
            break;
        }
        failures += 1;
        if let Err(e) = result {
            assert!(
                matches!(e.kind(), ErrorKind::Io | ErrorKind::DiskFull),
                "operation {n}: {:?} {e}",
                e.kind()
            );
        }
        if fs.read_dir(&out()).is_ok() {
            let left = files(&fs, &out());
            for (path, bytes) in left.iter().filter(|(p, _)| !is_temporary(p)) {
                assert_eq!(
                    Some(bytes),
                    expected.get(path),
                    "operation {n} left {} in pieces",
                    path.display()
                );
            }
        }
        run(make, &fs, two(&fs), None).unwrap_or_else(|e| panic!("after operation {n} failed: {e}"));
        assert!(files(&fs, &out()) == expected, "after operation {n} failed");
    }
    assert!(failures > 50, "only {failures} operations");
}

#[test]
fn an_export_to_lerobot_survives_a_power_cut() {
    survives_power_cuts(lerobot);
}

#[test]
fn an_export_to_zarr_survives_a_power_cut() {
    survives_power_cuts(zarr);
}

#[test]
fn an_export_to_hdf5_survives_a_power_cut() {
    survives_power_cuts(hdf5);
}

fn survives_power_cuts(make: Make) {
    let source = dataset();
    let expected = whole(make, &source);
    let mut ended = 0;
    for sets in 1..12 {
        let fs = copy(&source);
        // The last ones may be over before they are asked to end.
        ended += u32::from(run(make, &fs, two(&fs), Some(sets)).unwrap().ended);
        // Nothing unsynced is left.
        let fs = fs.after_crash(|_| 0);
        run(make, &fs, two(&fs), None).unwrap();
        assert!(files(&fs, &out()) == expected, "power cut after {sets} sets");
    }
    assert!(ended > 5, "{ended} exports were ended");
}
