//! Recordings resumed after their recorder was killed.

use crate::support::*;
use depthrig_bus::{StreamId, UtcPair};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    CompareOptions, Computed, ErrorKind, Recorder, RecorderOptions, RecoverOptions, Session, UtcSource,
    VerifyOptions, compare, recover_with, verify_with,
};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

const SETS: u64 = 17;

fn limits() -> RecorderOptions {
    // Only sets close segments, and no file depends on the host's clock.
    RecorderOptions { segment_max_ns: 4 * PERIOD, sync_interval_ns: i64::MAX / 4, ..options() }
}

fn clock() -> UtcSource {
    Arc::new(|| UtcPair { utc_ns: T0, ..UtcPair::default() })
}

fn computed() -> Session {
    let mut s = session();
    let from = vec![StreamId::new("zed", "left").unwrap(), StreamId::new("zed", "right").unwrap()];
    let of = |stream: &StreamId| Computed {
        stream: stream.clone(),
        name: "mimic_quality".into(),
        producer: "a matcher 1.0".into(),
        parameters: "paths=8".into(),
        from: from.clone(),
    };
    s.computed = vec![of(&s.streams[1].id)];
    s
}

fn push(r: &Recorder, sets: std::ops::Range<u64>) {
    for n in sets {
        r.push(set(&session(), n)).unwrap();
        settle(r);
    }
}

fn begin(fs: &MemFs) -> Recorder {
    let started = Session { started_utc_ns: T0, ..computed() };
    Recorder::create_with(Arc::new(fs.clone()), clock(), &dir(), started, limits()).unwrap()
}

/// Killed anywhere and any number of times, it ends like one that was not.
#[test]
fn a_resumed_recording_is_the_one_that_was_never_killed() {
    let whole = MemFs::new();
    let r = begin(&whole);
    push(&r, 0..SETS);
    assert!(r.finish().unwrap().complete);
    let strict = CompareOptions { strict: true, ..CompareOptions::default() };
    for first in [0, 1, 3, 4, 5, 8, 11, 16, 17] {
        for second in [0, 2, 6] {
            let fs = MemFs::new();
            let r = begin(&fs);
            push(&r, 0..first);
            drop(r);
            let mut done = 0;
            for more in [second, SETS] {
                let (r, resumed) = Recorder::resume(Arc::new(fs.clone()), clock(), &dir(), limits()).unwrap();
                assert!(
                    resumed.sets >= done && resumed.sets.is_multiple_of(4),
                    "{first} {second}: {resumed:?}"
                );
                assert_eq!(resumed.last_set, (resumed.sets > 0).then_some(resumed.sets));
                done = resumed.sets;
                push(&r, done..(done + more).min(SETS));
                if more == SETS {
                    let summary = r.finish().unwrap();
                    assert!(summary.complete, "{:?}", summary.lost);
                    assert_eq!(summary.sets.recorded, SETS);
                    assert_eq!(summary.duration_ns, (SETS as i64 - 1) * PERIOD);
                }
            }
            // Segments end at the same sets; the messages between sets are renumbered in each run.
            assert_eq!(names(&fs), names(&whole), "{first} {second}");
            let same = compare(&open(&fs), &open(&whole), &strict).unwrap();
            assert!(same.equal, "{first} {second}: {:?}", same.differences);
            let shared: Arc<dyn Fs> = Arc::new(fs);
            let report = verify_with(&shared, &dir(), &VerifyOptions { decode: true, ..Default::default() });
            assert!(report.as_ref().is_ok_and(depthrig_recorder::VerifyReport::is_whole), "{report:?}");
        }
    }
}

/// A disk that was full took some sets and not the others; with room, those are recorded again.
#[test]
fn a_recording_goes_on_after_a_full_disk() {
    let whole = MemFs::new();
    let r = begin(&whole);
    push(&r, 0..SETS);
    r.finish().unwrap();
    let all: u64 = whole.read_dir(&dir()).unwrap().iter().map(|e| e.len).sum();
    // The rest is the summary, which is written at the end.
    for percent in [30, 55, 80] {
        let small = MemFs::new().with_capacity(all * percent / 100);
        let r = begin(&small);
        let mut refused = false;
        for n in 0..SETS {
            refused |= r.push(set(&session(), n)).is_err();
            settle(&r);
        }
        assert!(refused || r.progress().error.is_some(), "{percent} %: the disk was never full");
        drop(r);
        let fs = MemFs::new();
        fs.create_dir_all(&dir()).unwrap();
        for name in names(&small) {
            fs.put(&dir().join(&name), contents(&small, &dir().join(&name)));
        }
        let (r, resumed) = Recorder::resume(Arc::new(fs.clone()), clock(), &dir(), limits()).unwrap();
        push(&r, resumed.sets..SETS);
        assert!(r.finish().unwrap().complete);
        let same = compare(&open(&fs), &open(&whole), &CompareOptions::default()).unwrap();
        assert!(same.equal, "{percent} %: {:?}", same.differences);
        let shared: Arc<dyn Fs> = Arc::new(fs);
        assert!(verify_with(&shared, &dir(), &VerifyOptions::default()).unwrap().is_whole());
    }
}

#[test]
fn what_cannot_go_on_is_refused() {
    let resume =
        |fs: &MemFs| Recorder::resume(Arc::new(fs.clone()), clock(), &dir(), limits()).err().unwrap();
    assert_eq!(resume(&MemFs::new()).kind(), ErrorKind::NotFound);
    let fs = MemFs::new();
    let r = begin(&fs);
    push(&r, 0..9);
    assert_eq!(resume(&fs).kind(), ErrorKind::InUse);
    drop(r);
    let gap = copy(&fs);
    gap.remove_file(&segment(0)).unwrap();
    let e = resume(&gap);
    assert_eq!(e.kind(), ErrorKind::Corrupt, "{e}");
    let (r, _) = Recorder::resume(Arc::new(fs.clone()), clock(), &dir(), limits()).unwrap();
    r.finish().unwrap();
    assert_eq!(resume(&fs).kind(), ErrorKind::AlreadyExists);
}

/// The producer of a computed stream is in the session, in the channels, in the info and in the verification.
#[test]
fn provenance_is_reported() {
    let fs = MemFs::new();
    let r = begin(&fs);
    push(&r, 0..2);
    r.finish().unwrap();
    let dataset = open(&fs);
    let expected = computed().computed;
    assert_eq!(dataset.session().computed, expected);
    assert_eq!(dataset.info().unwrap().computed, expected);
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let report = verify_with(&shared, &dir(), &VerifyOptions::default()).unwrap();
    assert!(report.is_whole());
    assert_eq!(report.computed, expected);
    let bytes = contents(&fs, &segment(0));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let facts = |key: &str| {
        let channels =
            summary.channels.values().filter_map(|c| Some((c.topic.clone(), c.metadata.get(key)?.clone())));
        channels.collect::<Vec<_>>()
    };
    assert_eq!(facts("computed").len(), 3, "{:?}", facts("computed"));
    assert!(facts("producer").iter().all(|(_, v)| v == "a matcher 1.0"));
    assert!(facts("parameters").iter().all(|(_, v)| v == "paths=8"));
    let text = expected[0].to_string();
    assert!(text.ends_with("mimic_quality by a matcher 1.0 from zed/left and zed/right: paths=8"), "{text}");

    let mut wrong = computed();
    wrong.computed[0].stream = StreamId::new("no", "stream").unwrap();
    let dir = Path::new("/wrong");
    let r = Recorder::create(Arc::new(fs.clone()), dir, wrong, limits()).unwrap();
    r.push(set(&session(), 0)).unwrap();
    r.finish().unwrap();
    let report = verify_with(&shared, dir, &VerifyOptions::default()).unwrap();
    assert!(report.findings.iter().any(|f| f.message.contains("no such stream")), "{:?}", report.findings);
}

/// Finished and added to, killed and added to: every set stays, and the whole is one dataset.
#[test]
fn a_finished_dataset_grows() {
    let whole = MemFs::new();
    let r = begin(&whole);
    push(&r, 0..SETS);
    r.finish().unwrap();
    for (first, second) in [(0, 3), (1, 2), (5, 8), (9, 16)] {
        let fs = MemFs::new();
        let shared: Arc<dyn Fs> = Arc::new(fs.clone());
        let append = || Recorder::append(Arc::clone(&shared), clock(), &dir(), limits());
        let r = begin(&fs);
        push(&r, 0..first);
        r.finish().unwrap();
        // Killed: it is recovered before anything is added.
        let (r, resumed) = append().unwrap();
        assert_eq!((resumed.sets, resumed.last_set), (first, (first > 0).then_some(first)));
        push(&r, first..second);
        drop(r);
        assert_eq!(append().err().unwrap().kind(), ErrorKind::Truncated);
        let unfinished = RecoverOptions { unfinished_only: true, ..RecoverOptions::default() };
        recover_with(&shared, &dir(), &unfinished, &mut |_| ControlFlow::Continue(())).unwrap();
        let (r, resumed) = append().unwrap();
        assert_eq!(resumed.sets, second, "{first}: a set was lost");
        assert_eq!(append().err().unwrap().kind(), ErrorKind::InUse);
        push(&r, second..SETS);
        let summary = r.finish().unwrap();
        assert!(summary.complete, "{:?}", summary.lost);
        assert_eq!(summary.sets.recorded, SETS);
        let same = compare(&open(&fs), &open(&whole), &CompareOptions::default()).unwrap();
        assert!(same.equal, "{first} {second}: {:?}", same.differences);
        let report = verify_with(&shared, &dir(), &VerifyOptions { decode: true, ..Default::default() });
        assert!(report.as_ref().is_ok_and(depthrig_recorder::VerifyReport::is_whole), "{report:?}");
    }
}
