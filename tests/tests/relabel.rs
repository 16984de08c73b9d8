//! `cdm relabel`: a copy of a dataset with refined depth, whatever happens to the run that makes it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::ops::ControlFlow;
use depthrig_bus::{FrameFlags, FrameHeader, MOTION_SAMPLE_BYTES, MotionSample};
use depthrig_cdm::stage::{CdmConfig, EngineChoice, RefineConfig};
use depthrig_convert::relabel::{RelabelOptions, Step, relabel};
use depthrig_recorder::{
    CompareOptions, Dataset, DatasetSet, ErrorKind, PixelMode, RecordMotion, SetRange, VerifyOptions,
    compare, verify,
};
use depthrig_tests::fixture::Fixture;
use std::collections::BTreeMap;
use std::path::Path;

fn options(workers: usize) -> RelabelOptions {
    let refine = RefineConfig { engine: EngineChoice::Fill, ..RefineConfig::default() };
    RelabelOptions { refine, cdm: CdmConfig::default(), workers, threads: 1 }
}

/// Every file of a folder with its contents.
fn bytes_of(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    std::fs::read_dir(dir)
        .unwrap()
        .map(Result::unwrap)
        .map(|e| (e.file_name().to_string_lossy().into_owned(), std::fs::read(e.path()).unwrap()))
        .collect()
}

fn go_on(_: Step, _: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Refined pixels of each set and stream.
fn refined(path: &Path) -> Vec<(u64, String, Vec<u8>)> {
    let dataset = Dataset::open(path).unwrap();
    let sets = dataset.sets_with(SetRange::ALL, PixelMode::Decoded).map(Result::unwrap);
    sets.flat_map(|set| {
        let frames = set.frames.into_iter().filter(|f| f.header.stream() == "depth_refined");
        frames.map(|f| (set.id, f.header.camera().to_owned(), f.pixels)).collect::<Vec<_>>()
    })
    .collect()
}

/// The batches of a set bit by bit, since a sample may say NaN.
fn motion(set: &DatasetSet) -> Vec<(usize, FrameHeader, Vec<[u8; MOTION_SAMPLE_BYTES]>)> {
    let samples = |m: &RecordMotion| m.samples.iter().map(MotionSample::to_bytes).collect();
    set.motion.iter().map(|m| (m.unit, m.header, samples(m))).collect()
}

#[test]
fn a_copy_with_refined_depth() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    Fixture { sets: 25, motion: true, ..Fixture::default() }.record(&source);
    let before = bytes_of(&source);
    let report = relabel(&Dataset::open(&source).unwrap(), &out, &options(2), &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost, report.ended, report.streams.len()), (25, 0, false, 2));
    assert!(report.streams.iter().all(|s| s.frames == 25 && s.engine == "fill"), "{:?}", report.streams);
    assert_eq!(bytes_of(&source), before, "the source is only read");
    assert!(!dir.path().join("out.relabel").exists());
    let verified = verify(&out, &VerifyOptions::default()).unwrap();
    assert!(verified.is_whole(), "{:?}", verified.findings);
    let copy = Dataset::open(&out).unwrap();
    assert_eq!(copy.session().streams.len(), 6);
    assert_eq!(copy.session().derived.last().unwrap().by, "relabel");
    let sets = (copy.sets_with(SetRange::ALL, PixelMode::Decoded), Dataset::open(&source).unwrap());
    let of_source = sets.1.sets_with(SetRange::ALL, PixelMode::Decoded);
    for (number, (new, old)) in sets.0.zip(of_source).enumerate() {
        let new = new.unwrap();
        let old = old.unwrap();
        assert_eq!((new.id, new.tick, new.utc_ns, new.frames.len()), (old.id, old.tick, old.utc_ns, 6));
        assert_eq!((new.motion.len(), motion(&new)), (2, motion(&old)));
        for (a, b) in new.frames.iter().zip(&old.frames) {
            assert_eq!((&a.header, &a.pixels, a.codec), (&b.header, &b.pixels, b.codec));
        }
        for (made, camera) in new.frames[4..].iter().zip(["left", "right"]) {
            let h = &made.header;
            assert_eq!((h.camera(), h.stream(), h.refiner()), (camera, "depth_refined", "fill"));
            assert_eq!((h.sequence, h.captured), (number as u64 + 1, number as u64 + 1));
            let of = |stream: &str| {
                new.frames
                    .iter()
                    .map(|f| &f.header)
                    .find(|h| h.camera() == camera && h.stream() == stream)
                    .unwrap()
            };
            assert_eq!(
                (h.source_sequence, h.source_color_sequence),
                (of("depth").sequence, of("color").sequence)
            );
            assert_eq!(
                (h.capture_time_ns, h.intrinsics),
                (of("depth").capture_time_ns, of("color").intrinsics)
            );
            assert!(h.has(FrameFlags::DERIVED));
            assert!(made.pixels.as_chunks::<2>().0.iter().any(|z| *z != [0; 2]), "there is depth");
        }
    }
    // A dataset that has it is not given it twice, and nothing is overwritten.
    let again = relabel(&copy, &dir.path().join("third"), &options(1), &mut go_on).unwrap_err();
    assert_eq!(again.kind(), ErrorKind::BadInput);
    let over = relabel(&sets.1, &out, &options(1), &mut go_on).unwrap_err();
    assert_eq!(over.kind(), ErrorKind::AlreadyExists);
}

/// Sets that are missing in a recording are missing in the copy, which reports them.
#[test]
fn a_recording_that_lost_something_is_copied_with_its_gaps() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    Fixture { sets: 9, lost: vec![3, 4], motion: true, ..Fixture::default() }.record(&source);
    let report = relabel(&Dataset::open(&source).unwrap(), &out, &options(2), &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost), (7, 0), "{:?}", report.problems);
    let gap = "4 batches of left/imu were not recorded";
    assert!(verify(&out, &VerifyOptions::default()).unwrap().findings.iter().any(|f| f.message == gap));

    let source = dir.path().join("wide");
    let out = dir.path().join("wide_out");
    Fixture { sets: 3, max_spread_ns: Some(1_000_000), ..Fixture::default() }.record(&source);
    let report = relabel(&Dataset::open(&source).unwrap(), &out, &options(2), &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost, report.problems.len()), (3, 3, 3));
    assert!(report.problems[0].contains("is the limit"), "{:?}", report.problems);
}

/// Also where it is the first one, with which the file of refined images begins.
#[test]
fn a_set_that_lacks_an_image_has_no_refined_one_and_the_next_one_has() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    Fixture { sets: 9, without_color: vec![0, 4], ..Fixture::default() }.record(&source);
    let report = relabel(&Dataset::open(&source).unwrap(), &out, &options(2), &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost), (9, 0), "{:?}", report.problems);
    let ids: Vec<_> = refined(&out).into_iter().map(|(id, ..)| id).collect();
    let expected: Vec<_> = [1, 2, 3, 5, 6, 7, 8].iter().flat_map(|n| [3 * n + 5; 2]).collect();
    assert_eq!(ids, expected);
}

#[test]
fn a_run_that_was_ended_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    Fixture { sets: 45, ..Fixture::default() }.record(&source);
    let dataset = Dataset::open(&source).unwrap();
    let whole = dir.path().join("whole");
    relabel(&dataset, &whole, &options(1), &mut go_on).unwrap();

    for (name, last_step, at) in [("early", Step::Refine, 15), ("late", Step::Write, 7)] {
        let out = dir.path().join(name);
        let ended = relabel(&dataset, &out, &options(1), &mut |step, done, _| {
            if step == last_step && done >= at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(ended.unwrap().ended && !out.exists());
        // Another engine's images are not mixed in.
        let mut other = options(1);
        other.refine.is_aligned = true;
        assert_eq!(relabel(&dataset, &out, &other, &mut go_on).unwrap_err().kind(), ErrorKind::AlreadyExists);
        let mut first = None;
        let report = relabel(&dataset, &out, &options(2), &mut |_, done, total| {
            first.get_or_insert((done, total));
            ControlFlow::Continue(())
        })
        .unwrap();
        // Nothing is refined twice; when all of it was refined, there is no progress to report.
        let done = if last_step == Step::Refine { first.unwrap().0 } else { 45 };
        assert!(report.parts_resumed >= 1 && done >= 10, "{} {first:?}", report.parts_resumed);
        assert_eq!(refined(&out), refined(&whole));
        assert!(verify(&out, &VerifyOptions::default()).unwrap().is_whole());
        let same = compare(
            &Dataset::open(&out).unwrap(),
            &Dataset::open(&whole).unwrap(),
            &CompareOptions::default(),
        )
        .unwrap();
        assert!(same.equal, "{same:?}");
    }
}
