//! The framework of exports: resumed, failed at each operation, refused, with an exporter that is as small as can be.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod bytecamera;
mod lerobot;
mod rosbag;
mod rows_faults;
mod rows_truth;
#[path = "../../../tests/it/support.rs"]
#[allow(dead_code)] // the recorder's tests use the rest
mod support;

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_convert::{
    ExportOptions, ExportProgress, ExportReport, Exporter, Output, Part, PartOut, PartSets, Parts, Plan,
    REPORT_FILE, Source, export,
};
use depthrig_recorder::fs::{Fault, Fs, MemFs};
use depthrig_recorder::{ErrorKind, PixelMode, RecorderOptions, Result};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A file per set with the CRC-32 of each image, and a list of all sets.
struct Sums {
    sets_of_a_part: usize,
    flavour: &'static str,
}

impl Exporter for Sums {
    fn format(&self) -> &'static str {
        "sums"
    }

    fn options(&self) -> Value {
        json!({ "flavour": self.flavour, "a tenth": 0.1, "third": 1.0 / 3.0 })
    }

    fn plan(&mut self, sources: &[Source]) -> Result<Plan> {
        let parts = sources.iter().enumerate().flat_map(|(i, s)| s.parts(i, self.sets_of_a_part)).collect();
        Ok(Plan { parts, folders: vec!["sets".into()], losses: vec!["images".into()] })
    }

    fn part(
        &self,
        _source: &Source,
        part: &Part,
        sets: &mut PartSets<'_>,
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        while let Some((number, set)) = sets.next(PixelMode::Stored, out)? {
            let sums: Vec<_> = set.frames.iter().map(|f| crc32(&f.pixels)).collect();
            set.frames.iter().for_each(|f| out.frame(f.stream));
            out.file(&format!("sets/{number:03}.txt"), format!("{sums:?}").as_bytes())?;
            out.rows().extend(format!("{number},{}\n", set.id).bytes());
            out.count("sets seen", 1);
        }
        *out.extra() = json!(part.sets.len());
        Ok(())
    }

    fn finish(&self, _sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
        let mut list = out.create("list.csv")?;
        for rows in parts.rows(0) {
            list.append(&rows?)?;
        }
        list.finish()?;
        let lengths: Vec<_> = parts.iter().map(|(_, r)| r.extra.clone()).collect();
        out.file("lengths.txt", format!("{lengths:?}").as_bytes())
    }
}

fn crc32(bytes: &[u8]) -> u64 {
    bytes.iter().fold(7, |h, b| h.wrapping_mul(31).wrapping_add(u64::from(*b)))
}

/// A dataset of two segments.
fn dataset(sets: u64) -> MemFs {
    let fs = MemFs::new();
    record(&fs, sets, RecorderOptions { segment_max_ns: 5 * PERIOD, ..options() });
    fs
}

fn out() -> PathBuf {
    PathBuf::from("/export")
}

fn run(
    fs: &MemFs,
    exporter: &mut dyn Exporter,
    workers: usize,
    progress: &mut dyn FnMut(ExportProgress) -> ControlFlow<()>,
) -> Result<ExportReport> {
    export(fs, exporter, vec![open(fs)], &out(), ExportOptions { workers }, progress)
}

fn plain(fs: &MemFs, workers: usize) -> Result<ExportReport> {
    let mut sums = Sums { sets_of_a_part: 3, flavour: "plain" };
    run(fs, &mut sums, workers, &mut |_| ControlFlow::Continue(()))
}

#[test]
fn an_export_says_that_it_leaves_out_what_is_no_image() {
    let left_out = "session: the samples of front/imu, side/imu, arm/joints, arm/gripper are left out; `depthrig cat --stream` writes them";
    assert_eq!(plain(&dataset(2), 1).unwrap().losses, ["images", left_out]);
}

/// Every file below the folder of the export.
fn files(fs: &MemFs) -> BTreeMap<String, Vec<u8>> {
    fn walk(fs: &MemFs, dir: &Path, into: &mut BTreeMap<String, Vec<u8>>) {
        for entry in fs.read_dir(dir).unwrap() {
            let path = dir.join(&entry.name);
            if entry.is_dir {
                walk(fs, &path, into);
            } else {
                into.insert(path.display().to_string(), contents(fs, &path));
            }
        }
    }
    let mut all = BTreeMap::new();
    walk(fs, &out(), &mut all);
    all
}

#[test]
fn an_export_says_what_it_did_and_leaves_no_marks() {
    let fs = dataset(8);
    let report = plain(&fs, 2).unwrap();
    assert_eq!((report.sets, report.frames, report.files, report.lost), (8, 24, 10, 0));
    assert_eq!((report.parts, report.parts_resumed, report.ended), (3, 0, false));
    assert_eq!(report.counters["sets seen"], 8);
    assert!(report.streams.iter().all(|s| (s.frames, s.missing) == (8, 0)));
    let files = files(&fs);
    assert_eq!(files.len(), 11);
    assert!(files.keys().all(|name| !name.contains("/.")), "{:?}", files.keys());
    let bytes: usize = files.iter().filter(|(n, _)| !n.ends_with(REPORT_FILE)).map(|(_, b)| b.len()).sum();
    assert_eq!(report.bytes, bytes as u64);
    let mut stored: ExportReport = serde_json::from_slice(&files["/export/export.json"]).unwrap();
    stored.parts = 3;
    assert_eq!(stored, report);
    assert_eq!(files["/export/list.csv"], b"0,1\n1,2\n2,3\n3,4\n4,5\n5,6\n6,7\n7,8\n");
}

#[test]
fn the_number_of_threads_changes_nothing_and_a_second_run_does_nothing() {
    let [one, four] = [1, 4].map(|workers| {
        let fs = dataset(12);
        plain(&fs, workers).unwrap();
        let before = files(&fs);
        let again = plain(&fs, workers).unwrap();
        assert_eq!((again.sets, again.parts_resumed), (12, again.parts));
        assert_eq!(files(&fs), before);
        before
    });
    assert_eq!(one, four);
}

#[test]
fn an_export_that_was_ended_goes_on_where_it_was() {
    let expected = {
        let fs = dataset(11);
        plain(&fs, 1).unwrap();
        files(&fs)
    };
    for end_after in 0..9 {
        let fs = dataset(11);
        let mut sums = Sums { sets_of_a_part: 2, flavour: "plain" };
        let mut end = |p: ExportProgress| {
            assert_eq!(p.total, 11);
            if p.sets >= end_after { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let report = run(&fs, &mut sums, 1, &mut end).unwrap();
        assert!(report.ended && !files(&fs).contains_key("/export/export.json"), "{end_after}");
        let report = run(&fs, &mut sums, 2, &mut |_| ControlFlow::Continue(())).unwrap();
        // The set that the end was asked for in may be the last of its part.
        assert!(
            report.parts_resumed >= end_after.saturating_sub(1) / 2 - u64::from(end_after > 5),
            "{report:?}"
        );
        let mut found = files(&fs);
        found.insert("/export/lengths.txt".into(), expected["/export/lengths.txt"].clone());
        let mut report: Value = serde_json::from_slice(&found["/export/export.json"]).unwrap();
        let wanted: Value = serde_json::from_slice(&expected["/export/export.json"]).unwrap();
        report["bytes"] = wanted["bytes"].clone(); // `lengths.txt` covers other parts
        assert_eq!(report, wanted);
        found.insert("/export/export.json".into(), expected["/export/export.json"].clone());
        assert_eq!(found, expected, "{end_after}");
    }
}

/// The n-th operation on the disk fails, for every n: a typed error, no incomplete file with its final name, and the
/// next run ends as if nothing had been.
#[test]
fn an_export_survives_a_failure_of_any_operation() {
    let source = dataset(7);
    let whole = copy(&source);
    plain(&whole, 1).unwrap();
    let expected = files(&whole);
    let mut failures = 0;
    for n in 0.. {
        let fs = copy(&source);
        let opened = open(&fs);
        let at = fs.ops() + n;
        let fs = fs.with_fault(Fault::FailOnce(at, std::io::ErrorKind::Other));
        let mut sums = Sums { sets_of_a_part: 3, flavour: "plain" };
        let on = &mut |_| ControlFlow::Continue(());
        let result = export(&fs, &mut sums, vec![opened], &out(), ExportOptions { workers: 1 }, on);
        let hit = at < fs.ops();
        if fs.read_dir(&out()).is_ok() {
            for (name, bytes) in files(&fs).iter().filter(|(name, _)| !name.contains("/.")) {
                assert_eq!(bytes, &expected[name], "operation {n} left {name} in pieces");
            }
        }
        if !hit {
            result.unwrap();
            break;
        }
        failures += 1;
        if let Err(e) = result {
            assert!(matches!(e.kind(), ErrorKind::Io | ErrorKind::DiskFull), "operation {n}: {e}");
        }
        plain(&fs, 1).unwrap_or_else(|e| panic!("after operation {n} failed: {e}"));
        assert_eq!(files(&fs), expected, "after operation {n} failed");
    }
    assert!(failures > 50, "only {failures} operations");
}

/// A power cut keeps what was synced: what is marked as done is there.
#[test]
fn an_export_survives_a_power_cut() {
    let source = dataset(7);
    let whole = copy(&source);
    plain(&whole, 1).unwrap();
    let expected = files(&whole);
    for end_after in 1..5 {
        let fs = copy(&source);
        let mut sums = Sums { sets_of_a_part: 3, flavour: "plain" };
        let report = run(&fs, &mut sums, 1, &mut |p| {
            if p.sets >= end_after { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(report.unwrap().ended);
        // Nothing unsynced is left.
        let fs = fs.after_crash(|_| 0);
        plain(&fs, 1).unwrap();
        assert_eq!(files(&fs), expected, "power cut after {end_after} sets");
    }
}

#[test]
fn what_is_there_is_never_overwritten() {
    let fs = dataset(4);
    let refused = |fs: &MemFs, exporter: &mut dyn Exporter| {
        let e = run(fs, exporter, 1, &mut |_| ControlFlow::Continue(())).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::AlreadyExists, "{e}");
        e.to_string()
    };
    let mut sums = Sums { sets_of_a_part: 3, flavour: "plain" };
    // Somebody's files.
    fs.create_dir_all(&out()).unwrap();
    fs.put(&out().join("thesis.tex"), b"years".to_vec());
    assert!(refused(&fs, &mut sums).contains("it holds thesis.tex"));
    fs.remove_file(&out().join("thesis.tex")).unwrap();
    // An unfinished export with other options, then a finished one.
    run(&fs, &mut sums, 1, &mut |_| ControlFlow::Break(())).unwrap();
    let mut sweet = Sums { sets_of_a_part: 3, flavour: "sweet" };
    assert!(refused(&fs, &mut sweet).contains("differs in its options"));
    plain(&fs, 1).unwrap();
    let before = files(&fs);
    assert!(refused(&fs, &mut sweet).contains("differs in its options"));
    // Another dataset.
    let other = dataset(5);
    for (name, bytes) in &before {
        other.create_dir_all(Path::new(name).parent().unwrap()).unwrap();
        other.put(Path::new(name), bytes.clone());
    }
    assert!(refused(&other, &mut sums).contains("differs in its datasets"));
    assert_eq!(files(&fs), before);
}

#[test]
fn what_cannot_be_read_is_counted() {
    let fs = dataset(8);
    let path = segment(0);
    let mut bytes = contents(&fs, &path);
    let at = bytes.len() / 2;
    bytes[at] ^= 0xff;
    fs.put(&path, bytes);
    let report = plain(&fs, 2).unwrap();
    assert_eq!((report.sets, report.lost, report.problems.len()), (7, 1, 1));
    assert!(report.problems[0].contains("seg_0000.mcap"), "{:?}", report.problems);
}
