//! Cutting and joining. Long because trimmed parts are what merging is tested with.

use crate::support::*;
use depthrig_recorder::fs::{Fault, Fs, MemFs, RealFs};
use depthrig_recorder::{
    ColorCodec, CompareOptions, Dataset, DepthCodec, Edge, ErrorKind, FrameChoice, Moment, Recorder,
    RecorderOptions, RecoverAction, RecoverOptions, Session, SetDrop, SetSpan, Severity, SliceOptions,
    SliceReport, StreamAccount, VerifyOptions, VerifyReport, compare, merge, recover, recover_with, trim,
    unfinished_in, verify_with,
};
use proptest::prelude::*;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn shared(fs: &MemFs) -> Arc<dyn Fs> {
    Arc::new(fs.clone())
}

fn at(fs: &MemFs, path: impl AsRef<Path>) -> Dataset {
    Dataset::open_with(shared(fs), path.as_ref()).unwrap()
}

fn named(name: &str) -> PathBuf {
    PathBuf::from("/data").join(name)
}

fn ids(from: u64, to: u64) -> SetSpan {
    SetSpan { from: Some(Edge::Set(from)), to: Some(Edge::Set(to)) }
}

fn cut(fs: &MemFs, out: &str, span: SetSpan) -> depthrig_recorder::Result<SliceReport> {
    cut_of(fs, &open(fs), out, span)
}

fn cut_of(fs: &MemFs, source: &Dataset, out: &str, span: SetSpan) -> depthrig_recorder::Result<SliceReport> {
    trim(fs, source, &named(out), span, &SliceOptions::default(), &mut |_, _| ControlFlow::Continue(()))
}

fn join(fs: &MemFs, out: &str, inputs: &[Dataset]) -> depthrig_recorder::Result<SliceReport> {
    merge(fs, inputs, &named(out), &SliceOptions::default(), &mut |_, _| ControlFlow::Continue(()))
}

fn check(fs: &MemFs, name: &str) -> VerifyReport {
    verify_with(&shared(fs), &named(name), &VerifyOptions { decode: true, ..VerifyOptions::default() })
        .unwrap()
}

fn strictly() -> CompareOptions {
    CompareOptions { strict: true, pixels: depthrig_recorder::PixelCheck::Stored, ..Default::default() }
}

/// A recording that writes accounts as often as it can, with segments of so many sets.
fn quick(sets_per_segment: i64) -> RecorderOptions {
    RecorderOptions {
        // Each image in a message of another type: an image, an image file, depth in its own codec.
        color: if sets_per_segment % 2 == 0 { ColorCodec::Jpeg } else { ColorCodec::Raw },
        depth: if sets_per_segment % 3 == 0 { DepthCodec::Rank } else { DepthCodec::Zstd },
        sync_interval_ns: 1_000_000,
        segment_max_ns: sets_per_segment * PERIOD,
        ..options()
    }
}

fn account(stream: &str, n: u64) -> StreamAccount {
    let stream = stream.parse().unwrap();
    StreamAccount { stream, captured: 6 * n, delivered: 6 * n, dropped: depthrig_bus::DropCounts([0; 8]) }
}

/// Records `sets` sets; before the set numbered `n`, `refused(n)` sets are refused.
fn recording(fs: &MemFs, sets: u64, options: RecorderOptions, refused: impl Fn(u64) -> u64) {
    let r = Recorder::create(shared(fs), &dir(), session(), options).unwrap();
    for n in 0..=sets {
        for _ in 0..refused(n) {
            // An id that is not greater than the last one, or a stream that is not there.
            let mut bad = set(&session(), n);
            bad.id = 0;
            bad.missing.push(9);
            r.push(bad).unwrap_err();
        }
        if n < sets {
            r.push(set(&session(), n)).unwrap();
            // A segment by itself knows of a loss after its last set by two accounts, one before it and one after it.
            if refused(n + 1) > 0 { accounted(&r) } else { settle(&r) }
        }
        r.update_accounts(vec![account("front/depth", n + 1), account("front/color", n + 1)]);
    }
    r.finish().unwrap();
}

#[test]
fn a_part_is_a_whole_dataset() {
    let fs = MemFs::new();
    recording(&fs, 12, quick(4), |_| 0);
    let report = cut(
        &fs,
        "part",
        SetSpan { from: Some(Edge::Moment(Moment::AfterFirst(3 * PERIOD))), to: Some(Edge::Set(10)) },
    );
    let report = report.unwrap();
    assert_eq!((report.sets, report.first_set, report.last_set, report.segments), (7, 4, 10, 1));
    assert!(report.complete && report.duration_ns == 6 * PERIOD);
    let verified = check(&fs, "part");
    assert_eq!(verified.findings, []);
    assert_eq!((verified.sets, verified.frames, verified.bytes), (7, 21, report.bytes));

    let part = at(&fs, named("part"));
    let s = part.session();
    assert_eq!((s.name.as_str(), s.started_utc_ns, &s.streams), ("part", T0, &session().streams));
    let outcome = s.outcome.as_ref().unwrap();
    assert_eq!((outcome.sets_offered, outcome.sets_recorded, outcome.complete), (7, 7, true));
    assert_eq!(outcome.ended_utc_ns, T0 + 9 * PERIOD);
    let [derived] = &s.derived[..] else { panic!("{:?}", s.derived) };
    assert_eq!((derived.by.as_str(), &derived.from[..]), ("trim", &["session".to_owned()][..]));
    assert_eq!((derived.first_utc_ns, derived.last_utc_ns), (T0 + 3 * PERIOD, T0 + 9 * PERIOD));

    // The frames are those of the source, byte by byte as stored.
    let got: Vec<_> =
        part.sets_with((..).into(), depthrig_recorder::PixelMode::Stored).map(Result::unwrap).collect();
    let want =
        open(&fs).sets_with((T0 + 3 * PERIOD..=T0 + 9 * PERIOD).into(), depthrig_recorder::PixelMode::Stored);
    for (got, want) in got.iter().zip(want.map(Result::unwrap)) {
        assert_eq!((got.id, got.utc_ns, got.utc_offset_ns), (want.id, want.utc_ns, want.utc_offset_ns));
        for (a, b) in got.frames.iter().zip(&want.frames) {
            assert_eq!(
                (&a.pixels, a.stored_bytes, a.header.sequence),
                (&b.pixels, b.stored_bytes, b.header.sequence)
            );
        }
    }
    // The segment stands alone, and another reader finds all of it.
    let bytes = contents(&fs, &named("part/seg_0000.mcap"));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let topics: Vec<_> =
        mcap::MessageStream::new(&bytes).unwrap().map(|m| m.unwrap().channel.topic.clone()).collect();
    assert_eq!(topics.len() as u64, summary.stats.unwrap().message_count);
    assert_eq!(topics[..2], ["/tf_static", "/rig/clock"]);
    assert_eq!(topics.iter().filter(|t| *t == "/rig/frame_set").count(), 7);
    let names: Vec<_> = fs.read_dir(&named("")).unwrap().into_iter().map(|e| e.name).collect();
    assert_eq!(names, ["part", "session"], "nothing else is left");
}

#[test]
fn segments_are_cut_at_their_limits() {
    let fs = MemFs::new();
    recording(&fs, 9, quick(100), |_| 0);
    let options = SliceOptions { segment_max_ns: 2 * PERIOD, ..SliceOptions::default() };
    let report =
        trim(&fs, &open(&fs), &named("part"), ids(2, 8), &options, &mut |_, _| ControlFlow::Continue(()))
            .unwrap();
    assert_eq!(report.segments, 4);
    assert_eq!(check(&fs, "part").findings, []);
    let options = SliceOptions { segment_max_bytes: 1, ..SliceOptions::default() };
    let part = at(&fs, named("part"));
    let report =
        merge(&fs, &[part], &named("again"), &options, &mut |_, _| ControlFlow::Continue(())).unwrap();
    assert_eq!(report.segments, 7);
    assert_eq!(check(&fs, "again").findings, []);
    // Each is complete on its own.
    for i in 0..7 {
        assert_eq!(check(&fs, &format!("again/seg_{i:04}.mcap")).findings, [], "segment {i}");
    }
}

/// Notes by their own time, wherever the second's chunk put them.
#[test]
fn notes_go_with_the_sets_of_their_time() {
    let fs = MemFs::new();
    let r = Recorder::create(
        shared(&fs),
        &dir(),
        session(),
        RecorderOptions { sync_interval_ns: 1 << 60, ..quick(100) },
    );
    let r = r.unwrap();
    for n in 0..6 {
        r.push(set(&session(), n)).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    // The recorder stamps notes with the time of day; the sets here are of another day, so the stamps are set.
    let mut s = open(&fs).session().clone();
    let note = |ns: i64, text: &str| depthrig_recorder::Note { utc_ns: T0 + ns, text: text.into() };
    s.notes = vec![
        note(-5, "before"),
        note(PERIOD + 7, "in set 2"),
        note(4 * PERIOD - 1, "in set 4"),
        note(4 * PERIOD, "in set 5"),
        note(9 * PERIOD, "after"),
    ];
    fs.put(&dir().join("session.toml"), s.to_toml().unwrap().into_bytes());
    let notes = |name: &str| {
        let texts: Vec<_> = at(&fs, named(name)).session().notes.iter().map(|n| n.text.clone()).collect();
        let bytes = contents(&fs, &named(name).join("seg_0000.mcap"));
        let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
        let in_file = messages.filter(|m| m.channel.topic == "/rig/notes").count();
        assert_eq!(in_file, texts.len(), "{name}");
        texts
    };
    cut(&fs, "a", ids(1, 1)).unwrap();
    cut(&fs, "b", ids(2, 4)).unwrap();
    cut(&fs, "c", ids(5, 6)).unwrap();
    assert_eq!(notes("a"), ["before"]);
    assert_eq!(notes("b"), ["in set 2", "in set 4"]);
    assert_eq!(notes("c"), ["in set 5", "after"]);
    join(&fs, "all", &[at(&fs, named("c")), at(&fs, named("a")), at(&fs, named("b"))]).unwrap();
    assert_eq!(notes("all"), ["before", "in set 2", "in set 4", "in set 5", "after"]);
    for name in ["a", "b", "c", "all"] {
        assert_eq!(check(&fs, name).findings, [], "{name}");
    }
}

/// Where a recording is cut, which parts overlap, and what it lost.
#[derive(Debug, Clone)]
struct Plan {
    sets: u64,
    sets_per_segment: i64,
    /// Sets refused before the set of each number; the last is after the last set.
    refused: Vec<u64>,
    /// First and last id of each part.
    parts: Vec<(u64, u64)>,
}

fn plan() -> impl Strategy<Value = Plan> {
    (2..11u64).prop_flat_map(|sets| {
        let refused = proptest::collection::vec(prop_oneof![4 => Just(0), 1 => 1..3u64], sets as usize + 1);
        let parts = proptest::collection::vec((1..=sets, 1..=sets), 1..5);
        (Just(sets), 1..5i64, refused, any::<bool>(), parts, any::<u64>()).prop_map(
            |(sets, sets_per_segment, refused, lossless, parts, shuffle)| {
                let refused = if lossless { vec![0; refused.len()] } else { refused };
                let mut parts: Vec<_> = parts.into_iter().map(|(a, b)| (a.min(b), a.max(b))).collect();
                // Whatever no part covers becomes a part: together they are the whole.
                let mut next = 1;
                for n in 1..=sets + 1 {
                    if n > sets || parts.iter().any(|(a, b)| (a..=b).contains(&&n)) {
                        if next < n {
                            parts.push((next, n - 1));
                        }
                        next = n + 1;
                    }
                }
                let by = shuffle as usize % parts.len();
                parts.rotate_left(by);
                Plan { sets, sets_per_segment, refused, parts }
            },
        )
    })
}

/// How many sets a dataset says were lost, by count and in words.
fn lost(fs: &MemFs, name: &str) -> (u64, u64) {
    let dataset = at(fs, named(name));
    let outcome = dataset.session().outcome.clone().unwrap();
    let counted: u64 = outcome.sets_dropped.values().sum();
    assert_eq!(outcome.sets_offered, outcome.sets_recorded + counted);
    let in_words = outcome.lost.iter().filter(|l| !l.contains("were not recorded"));
    (counted, in_words.filter_map(|l| l.split(' ').next()?.parse::<u64>().ok()).sum())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(if std::env::var_os("DEPTHRIG_LONG").is_some() { 1500 } else { 40 }))]
    #[test]
    fn parts_joined_again_are_the_recording(plan in plan()) {
        let fs = MemFs::new();
        recording(&fs, plan.sets, quick(plan.sets_per_segment), |n| plan.refused[n as usize]);
        let mut parts = Vec::new();
        for (i, (a, b)) in plan.parts.iter().enumerate() {
            let name = format!("part{i}");
            let report = cut(&fs, &name, ids(*a, *b)).unwrap();
            prop_assert_eq!((report.sets, report.first_set, report.last_set), (b - a + 1, *a, *b));
            // Set n is number n - 1: what was refused before it belongs to a part that has the set before as well.
            let between = plan.refused[*a as usize..*b as usize].iter().sum::<u64>();
            let before = if *a == 1 { plan.refused[0] } else { 0 };
            let after = if *b == plan.sets { plan.refused[*b as usize] } else { 0 };
            prop_assert_eq!(lost(&fs, &name), (between + before + after, 0), "part {} of {:?}", i, plan);
            let expected = if report.complete { None } else { Some(Severity::Lost) };
            let verified = check(&fs, &name);
            prop_assert_eq!(verified.worst(), expected, "{:?}", verified.findings);
            prop_assert_eq!(verified.sets, report.sets);
            parts.push(at(&fs, named(&name)));
        }
        let report = join(&fs, "whole", &parts).unwrap();
        let total: u64 = plan.parts.iter().map(|(a, b)| b - a + 1).sum();
        prop_assert_eq!((report.sets, report.repeated), (plan.sets, total - plan.sets));
        let all: u64 = plan.refused.iter().sum();
        let (counted, in_words) = lost(&fs, "whole");
        prop_assert_eq!(counted + in_words, all, "{:?}", at(&fs, named("whole")).session().outcome);
        let verified = check(&fs, "whole");
        prop_assert_eq!(verified.worst(), (all > 0).then_some(Severity::Lost), "{:?}", verified.findings);
        let c = compare(&open(&fs), &at(&fs, named("whole")), &strictly()).unwrap();
        prop_assert!(c.equal, "{:?}", c.differences);
    }

    /// Single segments, in any order, some of them twice.
    #[test]
    fn loose_segments_joined_are_the_recording(plan in plan(), twice in 0..4usize, shuffle in any::<usize>()) {
        let fs = MemFs::new();
        recording(&fs, plan.sets, quick(plan.sets_per_segment), |n| plan.refused[n as usize]);
        let source = open(&fs);
        let mut loose: Vec<_> = source.segments().iter().map(|path| at(&fs, path)).collect();
        let n = loose.len();
        loose.extend(source.segments().iter().cycle().skip(shuffle % n).take(twice).map(|path| at(&fs, path)));
        let by = shuffle % loose.len();
        loose.rotate_left(by);
        let report = join(&fs, "whole", &loose).unwrap();
        prop_assert_eq!(report.sets, plan.sets);
        let all: u64 = plan.refused.iter().sum();
        prop_assert_eq!(lost(&fs, "whole"), (all, 0), "{:?}", at(&fs, named("whole")).session().outcome);
        let verified = check(&fs, "whole");
        prop_assert_eq!(verified.worst(), (all > 0).then_some(Severity::Lost), "{:?}", verified.findings);
        let c = compare(&source, &at(&fs, named("whole")), &strictly()).unwrap();
        prop_assert!(c.equal, "{:?}", c.differences);
    }
}

#[test]
fn a_gap_between_the_inputs_is_said() {
    let fs = MemFs::new();
    recording(&fs, 9, quick(3), |_| 0);
    cut(&fs, "a", ids(1, 3)).unwrap();
    cut(&fs, "b", ids(6, 9)).unwrap();
    let report = join(&fs, "both", &[at(&fs, named("b")), at(&fs, named("a"))]).unwrap();
    assert_eq!(report.lost, ["2 sets between set 3 and set 6 are in none of the inputs"]);
    let verified = check(&fs, "both");
    assert_eq!(verified.worst(), Some(Severity::Lost));
    assert!(verified.findings.iter().any(|f| f.message == report.lost[0]), "{:?}", verified.findings);
    // Once the gap is filled, nobody speaks of it any more.
    cut(&fs, "c", ids(4, 5)).unwrap();
    let report = join(&fs, "all", &[at(&fs, named("both")), at(&fs, named("c"))]).unwrap();
    assert!(report.complete, "{:?}", report.lost);
    assert_eq!(check(&fs, "all").findings, []);
}

/// Loose segments without the one between them; parts joined twice before the one between them comes; and a
/// segment of such a dataset, which no longer knows what it was made from.
#[test]
fn what_a_later_merge_brings_is_not_lost_any_more() {
    let fs = MemFs::new();
    recording(&fs, 12, quick(3), |_| 0);
    let gap = ["3 sets between set 3 and set 7 are in none of the inputs"];
    let loose = |n: u32| at(&fs, segment(n));
    let part = |name: &str| at(&fs, named(name));
    assert_eq!(join(&fs, "ends", &[loose(0), loose(2)]).unwrap().lost, gap);
    let report = join(&fs, "begin", &[part("ends"), loose(1)]).unwrap();
    assert!(report.complete && report.sets == 9, "{:?}", report.lost);
    assert_eq!(check(&fs, "begin").findings, []);

    for (name, from, to) in [("a", 1, 3), ("b", 4, 6), ("c", 7, 9), ("d", 10, 12)] {
        cut(&fs, name, ids(from, to)).unwrap();
    }
    assert_eq!(join(&fs, "ac", &[part("a"), part("c")]).unwrap().lost, gap);
    assert_eq!(join(&fs, "acd", &[part("ac"), part("d")]).unwrap().lost, gap);
    let report = join(&fs, "lone", &[part("ac/seg_0000.mcap")]).unwrap();
    assert_eq!(report.lost, ["3 sets are not there, and no account tells why"]);
    for (made_of, sets) in [("acd", 12), ("lone", 9)] {
        let all = format!("{made_of}_and_b");
        let report = join(&fs, &all, &[part("b"), part(made_of)]).unwrap();
        assert!(report.complete && report.sets == sets, "{made_of}: {:?}", report.lost);
        assert_eq!(check(&fs, &all).findings, [], "{made_of}");
    }
}

/// A part's own losses stay its own: the gap before it does not use them up.
#[test]
fn a_gap_before_a_part_and_a_loss_after_it_are_two() {
    let fs = MemFs::new();
    recording(&fs, 5, quick(1), |n| u64::from(n == 2 || n == 5));
    cut(&fs, "a", ids(1, 2)).unwrap();
    cut(&fs, "b", ids(3, 5)).unwrap();
    let report = join(&fs, "both", &[at(&fs, named("b")), at(&fs, named("a"))]).unwrap();
    let expected = [
        "1 of 6 sets were not recorded: bad_set",
        "1 sets between set 2 and set 3 are in none of the inputs",
    ];
    assert_eq!(report.lost, expected);
}

#[test]
fn what_contradicts_itself_or_is_of_another_session_is_refused() {
    let fs = MemFs::new();
    recording(&fs, 4, quick(100), |_| 0);
    let refused = |change: &dyn Fn(&mut Session, u64) -> depthrig_recorder::RecordSet| {
        let other = MemFs::new();
        let mut s = session();
        change(&mut s, 0);
        let r = Recorder::create(shared(&other), &dir(), s, quick(100)).unwrap();
        for n in 0..4 {
            r.push(change(&mut session(), n)).unwrap();
            settle(&r);
        }
        r.finish().unwrap();
        let e = join(&fs, "out", &[open(&fs), at(&other, dir())]).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput, "{e}");
        assert_eq!(names_of(&fs), ["session"], "nothing is left: {e}");
        e.to_string()
    };
    let plain = |_: &mut Session, n: u64| set(&session(), n);
    let e = refused(&|s, n| {
        s.started_utc_ns += 1;
        plain(s, n)
    });
    assert!(e.contains("not of the same session") && e.contains("began at"), "{e}");
    let e = refused(&|s, n| {
        s.streams[1].intrinsics.fx += 1.0;
        s.streams[1].depth_unit_m = 0.001;
        plain(s, n)
    });
    assert!(e.contains("front/depth has another calibration; front/depth has another depth unit"), "{e}");
    let e = refused(&|s, n| {
        s.streams.pop();
        let mut set = plain(s, n);
        set.frames.truncate(2);
        set
    });
    assert!(
        e.contains("the streams are front/color, front/depth, side/ir_left and front/color, front/depth"),
        "{e}"
    );

    let e = refused(&|_, n| {
        let mut s = set(&session(), n);
        if n == 2 {
            let mut bytes = s.frames[1].pixels.bytes().to_vec();
            bytes[9] ^= 1;
            s.frames[1].pixels = Box::new(bytes);
        }
        s
    });
    assert!(e.contains("set 3 of") && e.contains("their commit marks differ"), "{e}");
    let e = refused(&|_, n| {
        let mut s = set(&session(), n);
        s.frames[0].header.gain += f32::from(u8::from(n == 1));
        s
    });
    assert!(e.contains("set 2 of") && e.contains("their frames are described otherwise"), "{e}");
    let e = refused(&|_, n| {
        let mut s = set(&session(), n);
        s.id += 10;
        s
    });
    assert!(e.contains("set 1 of") && e.contains("their commit marks differ"), "{e}");
    let e = refused(&|_, n| {
        let mut s = set(&session(), n);
        s.tick = s.tick.plus_ns(50_000_000);
        s
    });
    assert!(e.contains("comes after set 1 in time, but not by its number"), "{e}");
}

fn names_of(fs: &MemFs) -> Vec<String> {
    fs.read_dir(&named("")).unwrap().into_iter().map(|e| e.name).collect()
}

#[test]
fn nothing_is_written_over() {
    let fs = MemFs::new();
    recording(&fs, 3, quick(100), |_| 0);
    let before = contents(&fs, &segment(0));
    let e = cut(&fs, "session", ids(1, 2)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::AlreadyExists);
    // The rest of a run that was cut off stays as well, and is named.
    fs.create_dir_all(&named("part.part")).unwrap();
    fs.put(&named("part.part/seg_0000.mcap.part"), vec![1]);
    let e = cut(&fs, "part", ids(1, 2)).unwrap_err();
    assert!(e.to_string().contains("/data/part.part is there already"), "{e}");
    assert_eq!(contents(&fs, &named("part.part/seg_0000.mcap.part")), [1]);
    assert_eq!(contents(&fs, &segment(0)), before);
    let e = cut(&fs, "empty", SetSpan { from: Some(Edge::Set(8)), to: None }).unwrap_err();
    assert!(e.to_string().contains("no set is between these; the dataset has sets 1 to 3"), "{e}");
}

#[test]
fn a_folder_that_grows_is_left_alone() {
    let fs = MemFs::new();
    recording(&fs, 4, quick(2), |_| 0);
    let grows = named("part.part");
    let mut looked = false;
    let options = SliceOptions::default();
    let made = trim(&fs, &open(&fs), &named("part"), ids(1, 4), &options, &mut |done, _| {
        // Before the first set nothing is in it that could be recovered.
        if done > 0 && !std::mem::replace(&mut looked, true) {
            assert_eq!(fs.lock(&grows).err().map(|e| e.kind()), Some(io::ErrorKind::WouldBlock));
            let quiet = &mut |_| ControlFlow::Continue(());
            let recovered = recover_with(&shared(&fs), &grows, &RecoverOptions::default(), quiet);
            assert_eq!(recovered.unwrap_err().kind(), ErrorKind::InUse);
            let unfinished = unfinished_in(&shared(&fs), &named(""), "rig").unwrap();
            assert!(unfinished.is_empty(), "{unfinished:?}");
        }
        ControlFlow::Continue(())
    });
    assert!(made.unwrap().complete && looked);
    drop(fs.lock(&named("part")).unwrap());

    // A folder that is being written to is not taken for a rest.
    let other = named("other.part");
    fs.create_dir_all(&other).unwrap();
    fs.put(&other.join("seg_0000.mcap.part"), vec![1]);
    let lock = fs.lock(&other).unwrap();
    let e = cut(&fs, "other", ids(1, 2)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains("/data/other.part is being written by another process"), "{e}");
    drop(lock);
    assert_eq!(cut(&fs, "other", ids(1, 2)).unwrap_err().kind(), ErrorKind::AlreadyExists);
    assert_eq!(contents(&fs, &other.join("seg_0000.mcap.part")), [1]);
}

#[test]
fn a_lock_goes_with_its_folder_to_another_name() {
    let home = tempfile::tempdir().unwrap();
    let memory = MemFs::new();
    let places: [(&dyn Fs, &Path); 2] = [(&RealFs, home.path()), (&memory, Path::new("/data"))];
    for (fs, place) in places {
        let from = place.join("out.part");
        let to = place.join("out");
        fs.create_dir_all(&from).unwrap();
        let lock = fs.lock(&from).unwrap();
        fs.rename(&from, &to).unwrap();
        assert_eq!(fs.lock(&to).err().map(|e| e.kind()), Some(io::ErrorKind::WouldBlock), "{fs:?}");
        fs.create_dir_all(&from).unwrap();
        drop(fs.lock(&from).unwrap());
        drop(lock);
    }
    drop(memory.lock(Path::new("/data/out")).unwrap());
}

#[test]
fn a_disk_without_room_is_refused_before_and_leaves_nothing() {
    let fs = MemFs::new();
    recording(&fs, 3, quick(100), |_| 0);
    let full = copy(&fs).with_capacity(10 << 20);
    let e = trim(&full, &open(&fs), &named("part"), ids(1, 3), &SliceOptions::default(), &mut |_, _| {
        ControlFlow::Continue(())
    });
    assert_eq!(e.unwrap_err().kind(), ErrorKind::DiskFull);
    assert_eq!(names_of(&full), ["session"]);
}

#[test]
fn an_end_from_outside_leaves_nothing() {
    let fs = MemFs::new();
    recording(&fs, 6, quick(2), |_| 0);
    let mut reported = Vec::new();
    let e = trim(&fs, &open(&fs), &named("part"), ids(2, 6), &SliceOptions::default(), &mut |done, total| {
        reported.push((done, total));
        if reported.len() == 4 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Cancelled);
    assert!(reported.windows(2).all(|w| w[0].0 < w[1].0 && w[1].0 < w[1].1), "{reported:?}");
    assert_eq!(names_of(&fs), ["session"]);
}

/// Whichever operation fails: an error, the input as it was, and a complete dataset or nothing under the new name.
#[test]
fn any_failing_operation_leaves_the_whole_or_nothing() {
    let good = MemFs::new();
    recording(&good, 4, quick(2), |_| 0);
    let source = contents(&good, &segment(1));
    // The input is read from a good disk: this is about the one that is written.
    let cut = |fs: &MemFs| {
        trim(fs, &open(&good), &named("part"), ids(2, 4), &SliceOptions::default(), &mut |_, _| {
            ControlFlow::Continue(())
        })
    };
    let short = |fs: MemFs| fs.with_fault(Fault::ShortWrites(3000));
    let whole = short(copy(&good));
    cut(&whole).unwrap();
    let ops = whole.ops();
    let mut failed = 0;
    let mut nothing = 0;
    for n in 0..ops {
        for fault in
            [Fault::FailOnce(n, io::ErrorKind::StorageFull), Fault::FailFrom(n, io::ErrorKind::StorageFull)]
        {
            let fs = short(copy(&good)).with_fault(fault);
            let made = cut(&fs);
            assert_eq!(contents(&fs, &segment(1)), source);
            let after = copy(&fs);
            if after.contents(&named("part/session.toml")).is_some() {
                assert_eq!(check(&after, "part").findings, [], "operation {n}");
            } else {
                assert!(
                    !names_of(&after).contains(&"part".to_owned()),
                    "operation {n}: {:?}",
                    names_of(&after)
                );
                nothing += 1;
            }
            if let Err(e) = made {
                failed += 1;
                assert_eq!(e.kind(), ErrorKind::DiskFull, "operation {n}: {e}");
            }
        }
    }
    // Only where the disk fails after the rename, where a cut back after the last write is refused, and where the
    // folder cannot be locked, is all there.
    assert!(
        failed + 4 > 2 * ops && nothing + 8 > 2 * ops,
        "{failed} failed, {nothing} left nothing of {ops}"
    );
}

#[test]
fn a_damaged_set_costs_itself_and_is_named() {
    let fs = MemFs::new();
    recording(&fs, 6, quick(100), |_| 0);
    let reference = copy(&fs);
    let mut bytes = contents(&fs, &segment(0));
    let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    // The largest is one of images.
    let chunk = chunks.iter().max_by_key(|c| c.chunk_length).unwrap();
    bytes[(chunk.chunk_start_offset + chunk.chunk_length / 2) as usize] ^= 1;
    fs.put(&segment(0), bytes);
    let report = cut(&fs, "part", SetSpan::default()).unwrap();
    assert_eq!(report.sets, 5);
    assert!(report.lost.len() == 1 && report.lost[0].starts_with("1 sets between set "), "{:?}", report.lost);
    let verified = check(&fs, "part");
    assert_eq!(verified.worst(), Some(Severity::Lost), "{:?}", verified.findings);
    // Cut again it says the same, once; and nothing more when a copy brings the set.
    let part = at(&fs, named("part"));
    assert_eq!(cut_of(&fs, &part, "again", SetSpan::default()).unwrap().lost, report.lost);
    let brought = join(&fs, "brought", &[part, open(&reference)]).unwrap();
    assert!(brought.complete && brought.sets == 6, "{:?}", brought.lost);
    // Another copy has the set that is damaged here.
    let report = join(&fs, "mended", &[open(&fs), open(&reference)]).unwrap();
    assert!(report.complete && report.sets == 6, "{:?}", report.lost);
    let c = compare(&open(&reference), &at(&fs, named("mended")), &strictly()).unwrap();
    assert!(c.equal, "{:?}", c.differences);
    assert_eq!(check(&fs, "mended").findings, []);
}

#[test]
fn an_unfinished_segment_can_be_joined_and_its_end_is_said() {
    let fs = MemFs::new();
    recording(&fs, 6, quick(3), |_| 0);
    let bytes = contents(&fs, &segment(1));
    fs.remove_file(&segment(1)).unwrap();
    let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    let end = chunks[chunks.len() / 2].chunk_start_offset as usize + 5;
    fs.put(&dir().join("seg_0001.mcap.part"), bytes[..end].to_vec());
    let report = join(&fs, "joined", &[open(&fs)]).unwrap();
    assert!((4..6).contains(&report.sets), "{report:?}");
    let ends: Vec<_> = report.lost.iter().filter(|l| l.starts_with("what came after set ")).collect();
    assert!(ends.len() == 1 && !ends[0].contains("was not finished"), "{:?}", report.lost);
    assert_eq!(check(&fs, "joined").worst(), Some(Severity::Lost));
}

/// As a killed process leaves it whose last write was whole: nothing in the file is damaged.
#[test]
fn the_end_of_a_recording_that_was_cut_off_is_said() {
    let whole = MemFs::new();
    recording(&whole, 6, quick(3), |_| 0);
    let bytes = contents(&whole, &segment(1));
    let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
    let of_last = chunks.iter().filter(|c| c.message_start_time == (T0 + 5 * PERIOD) as u64);
    let end = of_last.map(|c| c.chunk_start_offset).min().unwrap() as usize;
    let part = dir().join("seg_0001.mcap.part");
    let session_file = dir().join("session.toml");
    let mut killed = open(&whole).session().clone();
    killed.outcome = None;
    let killed = killed.to_toml().unwrap().into_bytes();
    for closed in [false, true] {
        let fs = copy(&whole);
        fs.remove_file(&segment(1)).unwrap();
        fs.put(&part, bytes[..end].to_vec());
        if !closed {
            fs.put(&session_file, killed.clone());
        }
        let said = |report: SliceReport| {
            assert!(!report.complete && report.last_set == 5, "{report:?}");
            let [line] = &report.lost[..] else { panic!("{:?}", report.lost) };
            assert!(line.starts_with("what came after set 5 is not there: "), "{line}");
            assert_eq!(line.matches("seg_0001.mcap.part was not finished").count(), 1, "{line}");
        };
        said(join(&fs, "joined", &[open(&fs)]).unwrap());
        said(join(&fs, "loose", &[at(&fs, &part), at(&fs, segment(0))]).unwrap());
        said(cut(&fs, "end", ids(2, 6)).unwrap());
        assert_eq!(check(&fs, "end").worst(), Some(Severity::Lost));
        // A loss that is stated already is repeated, and not twice.
        said(cut_of(&fs, &at(&fs, named("joined")), "part", ids(3, 9)).unwrap());
        said(join(&fs, "again", &[at(&fs, named("end")), open(&fs)]).unwrap());
        // The requested range ends before, or comes from elsewhere.
        let begin = cut(&fs, "begin", ids(1, 4)).unwrap();
        assert!(begin.complete && begin.sets == 4, "{:?}", begin.lost);
        for (name, first) in [("mended", open(&fs)), ("brought", at(&fs, named("joined")))] {
            let report = join(&fs, name, &[first, open(&whole)]).unwrap();
            assert!(report.complete && report.sets == 6, "{name}: {:?}", report.lost);
        }
    }
    // Killed when one segment was finished and the next one not begun.
    whole.put(&session_file, killed);
    let expected = ["what came after set 6 is not there: the recording /data/session was not closed"];
    assert_eq!(cut(&whole, "end", ids(5, 6)).unwrap().lost, expected);
    assert!(cut(&whole, "begin", ids(1, 5)).unwrap().complete);
}

/// After a write that failed no account is written: only the session says how many sets came after it.
#[test]
fn sets_lost_after_a_failed_write_stay_counted() {
    let full = MemFs::new().with_capacity(130_000);
    let r = recorder(&full, RecorderOptions { reserve_bytes: 45_000, ..options() });
    for n in 0..40 {
        drop(r.push(set(&session(), n)));
        settle(&r);
    }
    let summary = r.finish().unwrap();
    let failed = summary.sets.dropped[SetDrop::WriteFailed as usize];
    assert!(summary.sets.recorded >= 3 && failed > 10, "{summary:?}");
    let fs = copy(&full);
    let expect_losses = |name: &str, report: SliceReport| {
        let count = format!("{failed} of {} sets were not recorded: write_failed", report.sets + failed);
        let [first, second] = &report.lost[..] else { panic!("{name}: {:?}", report.lost) };
        assert_eq!(*first, count, "{name}");
        assert!(second.starts_with("the recording ended before its time: "), "{name}: {second}");
        assert_eq!(lost(&fs, name), (failed, 0), "{name}");
        let verified = check(&fs, name);
        assert_eq!(verified.worst(), Some(Severity::Lost), "{name}: {:?}", verified.findings);
    };
    let end = SetSpan { from: Some(Edge::Set(2)), to: None };
    expect_losses("end", cut(&fs, "end", end).unwrap());
    expect_losses("again", cut_of(&fs, &at(&fs, named("end")), "again", SetSpan::default()).unwrap());
    // Losses after the end do not belong to the beginning.
    assert!(cut(&fs, "begin", ids(1, 2)).unwrap().complete);
    assert_eq!(check(&fs, "begin").findings, []);
    let part = |name: &str| at(&fs, named(name));
    expect_losses("joined", join(&fs, "joined", &[part("begin"), part("end")]).unwrap());
    expect_losses("twice", join(&fs, "twice", &[part("end"), open(&fs)]).unwrap());
}

/// One bit of the index of a segment: another copy has all that is in it.
#[test]
fn a_damaged_index_costs_nothing_that_another_copy_has() {
    let why = "the summary's checksum does not agree with it";
    let before = "what came before set 4 is not there: ";
    let between = "3 sets between set 3 and set 7 are not there: ";
    let after = "what came after set 6 is not there: ";
    let cases = [(100, 0, None), (3, 0, Some(before)), (3, 1, Some(between)), (3, 2, Some(after))];
    for (sets_per_segment, hit, alone) in cases {
        let case = format!("segment {hit} of {sets_per_segment} sets");
        let fs = MemFs::new();
        recording(&fs, 9, quick(sets_per_segment), |_| 0);
        let reference = copy(&fs);
        let mut bytes = contents(&fs, &segment(hit));
        // The footer takes the last 37; before it there is nothing but the summary.
        let bit = bytes.len() - 60;
        bytes[bit] ^= 1;
        fs.put(&segment(hit), bytes);
        for (name, inputs) in
            [("first", [open(&fs), open(&reference)]), ("second", [open(&reference), open(&fs)])]
        {
            let report = join(&fs, name, &inputs).unwrap();
            assert!(report.complete && report.sets == 9, "{case}: {:?}", report.lost);
            assert_eq!(check(&fs, name).findings, [], "{case}");
            let c = compare(&open(&reference), &at(&fs, named(name)), &strictly()).unwrap();
            assert!(c.equal, "{case}: {:?}", c.differences);
        }
        if let Some(begin) = alone {
            let report = join(&fs, "alone", &[open(&fs)]).unwrap();
            let [line] = &report.lost[..] else { panic!("{case}: {:?}", report.lost) };
            assert!(line.starts_with(begin) && line.contains(why), "{case}: {line}");
            assert_eq!((report.sets, check(&fs, "alone").worst()), (6, Some(Severity::Lost)), "{case}");
        } else {
            let e = join(&fs, "alone", &[open(&fs)]).unwrap_err();
            assert!(e.kind() == ErrorKind::Corrupt && e.to_string().contains(why), "{case}: {e}");
            // A copy that has not all of it.
            cut(&reference, "part", ids(1, 4)).unwrap();
            let report = join(&fs, "some", &[open(&fs), at(&reference, named("part"))]).unwrap();
            let [line] = &report.lost[..] else { panic!("{case}: {:?}", report.lost) };
            assert!(line.starts_with("what /data/session holds is not there: "), "{case}: {line}");
        }
    }
}

/// Accounts of streams are a second apart, and a part may be shorter than that.
#[test]
fn a_short_part_has_the_accounts_of_its_streams() {
    let fs = MemFs::new();
    // An account at the end of each segment, and no other.
    recording(&fs, 9, RecorderOptions { sync_interval_ns: 1 << 60, ..quick(3) }, |_| 0);
    for (name, from, to) in [("begin", 1, 2), ("middle", 4, 5)] {
        cut(&fs, name, ids(from, to)).unwrap();
        let accounts = at(&fs, named(name)).info().unwrap().accounts;
        assert_eq!(accounts, [account("front/depth", 3), account("front/color", 3)], "{name}");
        assert_eq!(check(&fs, name).findings, [], "{name}");
    }
}

/// Variable with the folder of the child processes below; without it their tests do nothing.
const DIR: &str = "DEPTHRIG_TEST_SLICE_DIR";

/// Starts one of the tests below in a process of its own.
fn child(test: &str, dir: &Path) -> std::process::Command {
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", &format!("slice::{test}"), "--nocapture"]).env(DIR, dir);
    command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::null());
    command
}

/// Records images that no compressor makes smaller, 300 kB a set, on the real file system.
fn big_recording(dir: &Path, sets: u64) {
    let mut session = session();
    session.streams = vec![stream("cam/any", depthrig_bus::PixelFormat::Mono8, 640, 480)];
    let r = Recorder::create(Arc::new(RealFs), dir, session.clone(), quick(50)).unwrap();
    let mut noise = 1u64;
    for n in 0..sets {
        let mut s = set(&session, n);
        let mut next = || {
            noise = noise.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (noise >> 33) as u8
        };
        s.frames[0].pixels = Box::new((0..640 * 480).map(|_| next()).collect::<Vec<_>>());
        r.push(s).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
}

/// Not a test of its own: cuts, and says each step, slowly enough to be killed between any two.
#[test]
fn killed_child() {
    let Some(dir) = std::env::var_os(DIR).map(PathBuf::from) else { return };
    let source = Dataset::open(&dir.join("source")).unwrap();
    trim(&RealFs, &source, &dir.join("out"), ids(2, 29), &SliceOptions::default(), &mut |done, _| {
        println!("\nat {done}");
        std::thread::sleep(std::time::Duration::from_millis(5));
        ControlFlow::Continue(())
    })
    .unwrap();
}

#[test]
fn a_killed_cut_leaves_the_input_and_nothing_that_looks_whole() {
    use std::io::BufRead;
    let home = tempfile::tempdir().unwrap();
    let source = home.path().join("source");
    big_recording(&source, 30);
    let bytes = || -> Vec<_> {
        let names = std::fs::read_dir(&source).unwrap().map(|e| e.unwrap().path());
        let mut all: Vec<_> = names.map(|p| (p.clone(), std::fs::read(p).unwrap())).collect();
        all.sort();
        all
    };
    let before = bytes();
    let out = home.path().join("out");
    let part = home.path().join("out.part");
    let at_once = || {
        trim(
            &RealFs,
            &Dataset::open(&source).unwrap(),
            &out,
            ids(2, 29),
            &SliceOptions::default(),
            &mut |_, _| ControlFlow::Continue(()),
        )
    };
    for kill_after in [2, 9, 27] {
        let mut process = child("killed_child", home.path()).spawn().unwrap();
        let lines = std::io::BufReader::new(process.stdout.take().unwrap()).lines();
        let mut steps = 0;
        for line in lines.map_while(Result::ok) {
            steps += usize::from(line.starts_with("at "));
            if steps == kill_after {
                process.kill().unwrap();
            }
        }
        process.wait().unwrap();
        assert!(!out.exists() && part.is_dir(), "killed after {kill_after} of {steps} steps");
        let e = at_once().unwrap_err();
        assert_eq!(e.kind(), ErrorKind::AlreadyExists);
        assert!(e.to_string().contains("out.part is there already"), "{e}");
        std::fs::remove_dir_all(&part).unwrap();
    }
    assert_eq!(bytes(), before);
    assert_eq!(at_once().unwrap().sets, 28);
}

/// Not a test of its own: does everything with a dataset and says the most memory that it took, kB.
#[test]
fn memory_child() {
    let Some(dir) = std::env::var_os(DIR).map(PathBuf::from) else { return };
    let source = Dataset::open(&dir.join("source")).unwrap();
    let quiet = &mut |_, _| ControlFlow::Continue(());
    let o = SliceOptions::default();
    trim(&RealFs, &source, &dir.join("part"), SetSpan { from: Some(Edge::Set(2)), to: None }, &o, quiet)
        .unwrap();
    let parts = [source.clone(), Dataset::open(&dir.join("part")).unwrap()];
    merge(&RealFs, &parts, &dir.join("joined"), &o, quiet).unwrap();
    let joined = Dataset::open(&dir.join("joined")).unwrap();
    let exact = CompareOptions::default();
    assert!(compare(&source, &joined, &exact).unwrap().equal);
    let done = depthrig_recorder::export_frames(
        &RealFs,
        &source,
        &FrameChoice::default(),
        None,
        &dir.join("f"),
        quiet,
    );
    assert_eq!(done.unwrap().lost, 0);
    // Without its footer all of it is copied.
    let segment = dir.join("joined/seg_0000.mcap");
    let file = std::fs::OpenOptions::new().write(true).open(&segment).unwrap();
    file.set_len(file.metadata().unwrap().len() - 7).unwrap();
    let quiet = &mut |_| ControlFlow::Continue(());
    let done = recover(&dir.join("joined"), &RecoverOptions::default(), quiet).unwrap();
    assert_eq!(done.segments[0].action, RecoverAction::Rebuilt);
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    println!("\n{}", status.lines().find(|l| l.starts_with("VmHWM:")).unwrap());
}

#[test]
fn memory_does_not_grow_with_the_dataset() {
    let peak = |sets: u64| {
        let home = tempfile::tempdir().unwrap();
        big_recording(&home.path().join("source"), sets);
        let done = child("memory_child", home.path()).output().unwrap();
        let text = String::from_utf8(done.stdout).unwrap();
        let line =
            text.lines().find_map(|l| l.strip_prefix("VmHWM:")).expect("the child did all of its work");
        line.trim().trim_end_matches(" kB").parse::<i64>().unwrap()
    };
    let long = if std::env::var_os("DEPTHRIG_LONG").is_some() { 2_000 } else { 120 };
    let few = peak(10);
    let many = peak(long);
    // The sets that are more take 33 MB in the short form.
    assert!(many - few < 8_000, "{few} kB for 10 sets, {many} kB for {long}");
}
