//! Pruning: discarded episodes go for good, and the rest is as it was, whatever fails on the way.

use crate::support::*;
use crate::verify::found;
use depthrig_bus::SignalSample;
use depthrig_recorder::fs::{Fault, Fs, MemFs, WriteFile, write_all};
use depthrig_recorder::{
    CompareOptions, Comparison, Dataset, Edge, Episode, EpisodeEnd, ErrorKind, PixelCheck, Pruned, Recorder,
    RecorderOptions, Session, SessionChanges, SetSpan, Severity, SliceOptions, VerifyOptions, compare_with,
    edit, prunable, prune, trim, verify_with,
};
use proptest::prelude::*;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn shared(fs: &MemFs) -> Arc<dyn Fs> {
    Arc::new(fs.clone())
}

fn pruned(fs: &MemFs) -> depthrig_recorder::Result<Pruned> {
    prune(&shared(fs), &dir(), &mut |_, _, _| ControlFlow::Continue(()))
}

/// An episode from one set to another, by their numbers.
fn episode(number: u32, from: u64, to: u64, discarded: bool) -> Episode {
    let at = |n: u64| T0 + n as i64 * PERIOD;
    let text = format!(
        "number = {number}\ntask = \"t\"\ndiscarded = {discarded}\nstart_utc_ns = {}\nend_utc_ns = {}",
        at(from),
        at(to)
    );
    toml::from_str(&text).unwrap()
}

/// Segments of four sets, and accounts as often as possible.
fn short() -> RecorderOptions {
    RecorderOptions { sync_interval_ns: 1_000_000, segment_max_ns: 4 * PERIOD, ..options() }
}

/// A dataset with these episodes; before the set numbered `n`, `refused(n)` sets are refused.
fn recording(sets: u64, episodes: &[Episode], refused: impl Fn(u64) -> u64) -> MemFs {
    let fs = MemFs::new();
    let session = Session { episodes: episodes.to_vec(), ..session() };
    let r = Recorder::create(shared(&fs), &dir(), session.clone(), short()).unwrap();
    for n in 0..=sets {
        for _ in 0..refused(n) {
            let mut bad = set(&session, n);
            bad.id = 0;
            bad.missing.push(9);
            r.push(bad).unwrap_err();
        }
        if n < sets {
            r.push(set(&session, n)).unwrap();
            settle(&r);
        }
    }
    r.add_note("between the lines").unwrap();
    r.finish().unwrap();
    fs
}

/// Thirteen sets: two episodes of five are discarded, one of them over the border of two segments, and the last one.
fn recorded() -> MemFs {
    let episodes = [
        episode(1, 0, 1, true),
        episode(2, 2, 3, false),
        episode(3, 4, 8, true),
        episode(4, 9, 10, false),
        episode(5, 11, 11, true),
    ];
    recording(13, &episodes, |_| 0)
}

const KEPT: [u64; 5] = [3, 4, 10, 11, 13];

fn ids(fs: &MemFs) -> Vec<u64> {
    read_all(fs).iter().map(|set| set.id).collect()
}

/// Verifies with all images decoded; the messages of what is lost or broken.
fn faults(fs: &MemFs) -> Vec<String> {
    let options = VerifyOptions { decode: true, ..VerifyOptions::default() };
    let report = verify_with(&shared(fs), &dir(), &options).unwrap();
    let bad = report.findings.into_iter().filter(|f| f.severity > Severity::Note);
    bad.map(|f| format!("{}: {}", f.file, f.message)).collect()
}

/// The sets from one id to another as a dataset of their own, so that two of them can be compared.
fn part(fs: &MemFs, from: u64, to: u64) -> Dataset {
    let out = PathBuf::from("/parts").join(format!("{from}"));
    fs.create_dir_all(Path::new("/parts")).unwrap();
    let span = SetSpan { from: Some(Edge::Set(from)), to: Some(Edge::Set(to)) };
    trim(fs, &open(fs), &out, span, &SliceOptions::default(), &mut |_, _| ControlFlow::Continue(())).unwrap();
    Dataset::open_with(shared(fs), &out).unwrap()
}

fn compared(a: &Dataset, b: &Dataset) -> Comparison {
    let options = CompareOptions { strict: true, pixels: PixelCheck::Stored, ..CompareOptions::default() };
    compare_with(a, b, &options, &mut |_| ControlFlow::Continue(())).unwrap()
}

fn write(fs: &MemFs, path: &Path, bytes: &[u8]) {
    let mut file: Box<dyn WriteFile> = fs.create_new(path).unwrap();
    write_all(&mut *file, bytes).unwrap();
    file.sync_all().unwrap();
}

#[test]
fn kept_sets_stay_as_they_were_and_the_others_are_gone() {
    let fs = recorded();
    let before = copy(&fs);
    let session = open(&fs).session().clone();
    let expected = prunable(&open(&fs)).unwrap();
    assert_eq!((expected.sets, expected.kept_sets, expected.episodes.len()), (8, 5, 3));
    assert!(expected.bytes > 8 * 64 * 48, "{}", expected.bytes);
    let all: usize = names(&fs).iter().map(|name| contents(&fs, &dir().join(name)).len()).sum();

    let done = pruned(&fs).unwrap();
    assert_eq!((&done.removed, &done.left, done.had_report), (&expected, &None, false));
    assert_eq!(ids(&fs), KEPT);
    assert_eq!(faults(&fs), Vec::<String>::new());
    let now: usize = names(&fs).iter().map(|name| contents(&fs, &dir().join(name)).len()).sum();
    assert!(all - now >= expected.bytes as usize, "{all} bytes before, {now} after");
    for (from, to) in [(3, 4), (10, 11), (13, 13)] {
        let difference = compared(&part(&before, from, to), &part(&fs, from, to));
        assert!(difference.differences.is_empty(), "{from}: {:?}", difference.differences);
    }

    let after = open(&fs).session().clone();
    let numbers = |s: &Session| s.episodes.iter().map(|e| e.number).collect::<Vec<_>>();
    assert_eq!((numbers(&session), numbers(&after)), (vec![1, 2, 3, 4, 5], vec![2, 4]));
    assert_eq!(after.history.len(), 1);
    assert_eq!(after.history[0].text(), "pruned: discarded episodes 1, 3, 5, 8 sets");
    assert_eq!((after.derived.len(), after.derived[0].by.as_str()), (1, "prune"));
    assert_eq!((after.name, after.notes, after.streams), (session.name, session.notes, session.streams));
    let outcome = after.outcome.unwrap();
    assert_eq!((outcome.sets_recorded, outcome.sets_offered, outcome.complete), (5, 5, true));
    assert_eq!(fs.read_dir(Path::new("/data")).unwrap().len(), 1, "nothing is left beside it");

    // Again there is nothing to do, and nothing is done.
    let again = pruned(&fs).unwrap();
    assert_eq!((again.removed.sets, again.removed.kept_sets), (0, 5));
    assert_eq!(open(&fs).session().history.len(), 1);
}

#[test]
fn an_owners_files_stay_and_an_old_report_goes() {
    let fs = recorded();
    write(&fs, &dir().join("mine.txt"), b"mine");
    write(&fs, &dir().join("report.html"), b"old");
    let done = pruned(&fs).unwrap();
    assert!(done.had_report && done.left.is_none());
    assert_eq!(contents(&fs, &dir().join("mine.txt")), b"mine");
    assert!(!names(&fs).contains(&"report.html".to_owned()));
    assert_eq!(fs.read_dir(Path::new("/data")).unwrap().len(), 1);
}

#[test]
fn what_must_not_be_pruned_is_left_alone() {
    // One that records.
    let fs = MemFs::new();
    let session = Session { episodes: vec![episode(1, 0, 1, true)], ..session() };
    let r = Recorder::create(shared(&fs), &dir(), session.clone(), short()).unwrap();
    r.push(set(&session, 0)).unwrap();
    r.push(set(&session, 2)).unwrap();
    settle(&r);
    let e = pruned(&fs).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("stop the recording first"), "{e}");
    r.finish().unwrap();
    // One of which nothing would stay.
    let all = recording(3, &[episode(1, 0, 9, true)], |_| 0);
    let e = pruned(&all).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("remove its folder"), "{e}");
    // A damaged one: what cannot be read would be gone with the old one.
    let damaged = recorded();
    let mut bytes = contents(&damaged, &segment(0));
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    damaged.put(&segment(0), bytes);
    let e = pruned(&damaged).unwrap_err();
    assert!(e.kind() == ErrorKind::Corrupt && e.to_string().contains("depthrig recover"), "{e}");
    // One that is being edited.
    let busy = recorded();
    let lock = busy.lock(&dir()).unwrap();
    assert_eq!(pruned(&busy).unwrap_err().kind(), ErrorKind::InUse);
    drop(lock);
    // One that somebody ends.
    let e = prune(&shared(&busy), &dir(), &mut |step, _, _| match step {
        "prune" => ControlFlow::Break(()),
        _ => ControlFlow::Continue(()),
    });
    assert_eq!(e.unwrap_err().kind(), ErrorKind::Cancelled);
    assert_eq!(ids(&busy).len(), 13);
    assert_eq!(busy.read_dir(Path::new("/data")).unwrap().len(), 1);
}

/// Whatever operation is the last one, the dataset has all of its sets or the kept ones, and the next run ends the work.
#[test]
fn whenever_it_is_killed_one_of_both_datasets_is_there() {
    let start = recorded();
    write(&start, &dir().join("mine.txt"), b"mine");
    let counted = copy(&start);
    pruned(&counted).unwrap();
    let operations = counted.ops();
    let exchange = counted.log().iter().position(|line| line.starts_with("exchange")).unwrap() as u64;
    let mut seen = [0, 0];
    // The new dataset is nobody's before that; some operations of its making are enough.
    for n in (0..exchange - 4).step_by(exchange as usize / 60).chain(exchange - 4..operations) {
        let fs = copy(&start).with_fault(Fault::FailFrom(n, io::ErrorKind::Other));
        let result = pruned(&fs);
        let left = copy(&fs);
        let there = ids(&left);
        assert!(there == KEPT || there.len() == 13, "operation {n}: {there:?}");
        seen[usize::from(there == KEPT)] += 1;
        assert!(result.is_err() || there == KEPT, "operation {n} was reported as done");
        assert_eq!(faults(&left), Vec::<String>::new(), "operation {n}");
        pruned(&left).unwrap_or_else(|e| panic!("operation {n}: {e}"));
        assert_eq!(ids(&left), KEPT);
        assert_eq!(contents(&left, &dir().join("mine.txt")), b"mine", "operation {n}");
        assert_eq!(left.read_dir(Path::new("/data")).unwrap().len(), 1, "operation {n}");
    }
    assert!(seen.iter().all(|n| *n > 3), "{seen:?}");
}

#[test]
fn on_a_file_system_that_cannot_exchange_names_the_folders_are_renamed() {
    let start = recorded();
    let counted = copy(&start);
    pruned(&counted).unwrap();
    let exchange = counted.log().iter().position(|line| line.starts_with("exchange")).unwrap() as u64;
    let unsupported = Fault::FailOnce(exchange, io::ErrorKind::Unsupported);
    let fs = copy(&start).with_fault(unsupported);
    pruned(&fs).unwrap();
    assert_eq!(ids(&fs), KEPT);
    assert_eq!(fs.read_dir(Path::new("/data")).unwrap().len(), 1);
    // The new folder cannot get the name: the old one has it again.
    let fs =
        copy(&start).with_fault(unsupported).with_fault(Fault::FailOnce(exchange + 2, io::ErrorKind::Other));
    pruned(&fs).unwrap_err();
    assert_eq!(ids(&fs).len(), 13);
    assert_eq!(fs.read_dir(Path::new("/data")).unwrap().len(), 1);
    // Killed between the two: both are there under other names.
    let fs =
        copy(&start).with_fault(unsupported).with_fault(Fault::FailFrom(exchange + 2, io::ErrorKind::Other));
    pruned(&fs).unwrap_err();
    let left = copy(&fs);
    for (name, sets) in [(".session.old", 13), (".session.prune", 5)] {
        let found = Dataset::open_with(shared(&left), &Path::new("/data").join(name)).unwrap();
        assert_eq!(found.sets(depthrig_recorder::SetRange::ALL).flatten().count(), sets);
    }
}

/// Ten sets of which a session of samples and two runs of sets go; beside these, samples and batches of kept sets are lost.
#[test]
fn samples_that_went_with_their_episodes_are_not_lost() {
    let episodes = [episode(1, 0, 2, false), episode(2, 3, 4, true), episode(3, 9, 9, true)];
    let session = Session { episodes: episodes.to_vec(), ..session() };
    let record = |spoils: bool, restarts: bool| {
        let fs = MemFs::new();
        let r = Recorder::create(shared(&fs), &dir(), session.clone(), short()).unwrap();
        for n in 0..10 {
            let mut set = set(&session, n);
            if spoils && n == 1 {
                set.signals[0].samples.remove(2);
                set.motion.remove(0);
            }
            // Beside the removed sets, where nobody can tell them from those that went.
            if spoils && n == 5 {
                set.signals[0].samples.remove(0);
            }
            if spoils && n == 7 {
                set.signals[1].samples.drain(1..4);
            }
            if restarts && n > 3 {
                let later = |s: &SignalSample| {
                    let mut header = *s.header();
                    (header.session, header.sequence) = (99, header.sequence - 3 * SIGNAL_SAMPLES);
                    SignalSample::new(header, s.description(), s.bytes().to_vec()).unwrap()
                };
                set.signals[0].samples = set.signals[0].samples.iter().map(later).collect();
            }
            r.push(set).unwrap();
            settle(&r);
        }
        r.finish().unwrap();
        assert_eq!(pruned(&fs).unwrap().removed.sets, 3);
        fs
    };
    let rates = |fs: &MemFs| {
        let info = open(fs).info().unwrap();
        let lost: Vec<_> =
            info.signals.iter().map(|s| s.lost).chain(info.motion.iter().map(|u| u.lost_batches)).collect();
        let rates = info
            .signals
            .iter()
            .map(|s| s.rate_hz)
            .chain(info.motion.iter().map(|u| u.rate_hz))
            .collect::<Vec<f64>>();
        (lost, rates)
    };
    let whole = record(false, false);
    assert_eq!(found(&whole), Vec::<String>::new());
    let signal_hz = SIGNAL_SAMPLES as f64 * 1e9 / PERIOD as f64;
    let (lost, hz) = rates(&whole);
    assert_eq!(lost, [0; 4]);
    for (hz, expected) in
        hz.iter().zip([signal_hz, signal_hz, 1e9 / SAMPLE_PERIOD as f64, 1e9 / SAMPLE_PERIOD as f64])
    {
        assert!((hz - expected).abs() < 1e-6 * expected, "{hz} is not {expected}");
    }
    assert_eq!(
        found(&record(false, true)),
        Vec::<String>::new(),
        "the publisher began anew in a removed set"
    );
    let expected = [
        "1 batches of front/imu were not recorded",
        "1 samples of arm/joints were not recorded",
        "3 samples of arm/gripper were not recorded",
    ];
    let lossy = record(true, false);
    let mut notes = found(&lossy);
    notes.sort();
    assert_eq!(notes, expected);
    assert_eq!(rates(&lossy).0, [1, 3, 1, 0]);
    // A part of it knows as well, and so does the dataset when more of it goes.
    let later = part(&lossy, 2, 7);
    let verified = verify_with(&shared(&lossy), later.path(), &VerifyOptions::default()).unwrap();
    assert_eq!(verified.findings.iter().map(|f| f.message.as_str()).collect::<Vec<_>>(), expected[1..2]);
    let discard = SessionChanges { episodes: vec![(1, EpisodeEnd::Discarded)], ..SessionChanges::default() };
    edit(&lossy, &dir(), &discard).unwrap();
    assert_eq!(pruned(&lossy).unwrap().removed.sets, 3);
    assert_eq!(found(&lossy), expected[2..]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    /// Whatever is discarded and lost, the kept sets stay, and losses beside them are counted.
    #[test]
    fn sets_and_losses_are_those_of_the_kept_episodes(
        flags in prop::collection::vec(any::<bool>(), 2..12),
        lost in prop::collection::vec(0..2_u64, 13),
    ) {
        let sets = flags.len() as u64;
        let episodes: Vec<_> =
            flags.iter().zip(0..).map(|(gone, n)| episode(n as u32 + 1, n, n, *gone)).collect();
        let fs = recording(sets, &episodes, |n| lost[n as usize]);
        let kept: Vec<u64> = (0..sets).filter(|n| !flags[*n as usize]).collect();
        let result = pruned(&fs);
        if kept.is_empty() {
            prop_assert_eq!(result.unwrap_err().kind(), ErrorKind::BadInput);
            return Ok(());
        }
        prop_assert_eq!(result.unwrap().removed.sets, sets - kept.len() as u64);
        prop_assert_eq!(ids(&fs), kept.iter().map(|n| n + 1).collect::<Vec<_>>());
        if kept.len() as u64 == sets {
            return Ok(());
        }
        let is_kept = |n: Option<u64>| n.is_some_and(|n| kept.contains(&n));
        // Lost before a set: it counts if that set or the one before stays, but nothing before the first one that stays, unless that is
        // the first of all.
        let counts = |n: u64| {
            let after_first = n > kept[0] || (n == 0 && kept[0] == 0);
            after_first && (is_kept(n.checked_sub(1)) || is_kept(Some(n)))
        };
        let expected: u64 = (0..=sets).filter(|n| counts(*n)).map(|n| lost[n as usize]).sum();
        let outcome = open(&fs).session().outcome.clone().unwrap();
        prop_assert_eq!(outcome.sets_offered - outcome.sets_recorded, expected, "{:?}", outcome);
        prop_assert!(faults(&fs).iter().all(|f| f.contains("were not recorded")), "{:?}", faults(&fs));
    }
}
