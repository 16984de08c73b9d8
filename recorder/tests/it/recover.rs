//! Unfinished, torn and damaged datasets are repaired, and nothing readable is lost on the way.

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_recorder::fs::{Fault, Fs, MemFs};
use depthrig_recorder::{
    ColorCodec, Dataset, DepthCodec, ErrorKind, Outcome, RecorderOptions, RecoverAction, RecoverOptions,
    RecoverReport, SetRange, Severity, VerifyOptions, recover_with, unfinished_in, verify_with,
};
use std::io;
use std::sync::Arc;

pub fn recover(fs: &MemFs) -> depthrig_recorder::Result<RecoverReport> {
    recover_as(fs, RecoverOptions::default())
}

/// A recovery after a dry run, which changes nothing and reports the same.
pub fn planned_and_recovered(fs: &MemFs) -> depthrig_recorder::Result<RecoverReport> {
    let changes = fs.changes();
    let plan = recover_as(fs, RecoverOptions { dry_run: true, ..Default::default() });
    assert_eq!(fs.changes(), changes, "a dry run changes nothing");
    let done = recover(fs);
    match (&plan, &done) {
        (Ok(plan), Ok(done)) => {
            assert_eq!(plan.lost, done.lost);
            assert_eq!(plan.segments, done.segments);
            assert_eq!((&plan.removed, plan.sets, plan.changed), (&done.removed, done.sets, done.changed));
            assert_eq!(plan.session_rebuilt, done.session_rebuilt);
            assert_eq!(plan.notes.iter().any(|n| n.starts_with("nothing was written")), plan.changed);
            let shared = plan.notes.len() - usize::from(plan.changed);
            assert_eq!(plan.notes[..shared], done.notes);
        }
        (Err(plan), Err(done)) => {
            assert_eq!((plan.kind(), plan.to_string()), (done.kind(), done.to_string()));
        }
        _ => panic!("the dry run ended with {plan:?}, the recovery with {done:?}"),
    }
    done
}

fn recover_as(fs: &MemFs, options: RecoverOptions) -> depthrig_recorder::Result<RecoverReport> {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    recover_with(&fs, &dir(), &options, &mut |_| ControlFlow::Continue(()))
}

/// The ids of the sets; each is bit by bit what was recorded.
pub fn ids(fs: &MemFs) -> Vec<u64> {
    let Ok(dataset) = Dataset::open_with(Arc::new(fs.clone()), &dir()) else { return Vec::new() };
    let mut ids = Vec::new();
    for s in dataset.sets(SetRange::ALL).filter_map(Result::ok) {
        let want = set(&session(), s.id - 1);
        assert_eq!(s.frames.len(), 3, "set {}", s.id);
        for (frame, want) in s.frames.iter().zip(&want.frames).skip(1) {
            assert!(frame.pixels == want.pixels.bytes(), "an image of set {} is another one", s.id);
        }
        ids.push(s.id);
    }
    ids
}

pub fn outcome(fs: &MemFs) -> Outcome {
    open(fs).session().outcome.clone().expect("an outcome")
}

pub fn findings(fs: &MemFs) -> Vec<String> {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    let report = verify_with(&fs, &dir(), &VerifyOptions { decode: true, ..Default::default() }).unwrap();
    report.findings.iter().filter(|f| f.severity == Severity::Broken).map(|f| f.message.clone()).collect()
}

/// Records `sets` sets with `n` to a segment and drops the recorder, as a crash of the process does.
fn crashed(sets: u64, n: i64) -> MemFs {
    let fs = MemFs::new();
    let r = recorder(&fs, RecorderOptions { segment_max_ns: n * PERIOD, ..options() });
    for k in 0..sets {
        r.push(set(&session(), k)).unwrap();
        settle(&r);
    }
    drop(r);
    fs
}

/// Reads each segment with the `mcap` crate, by its own index and its own stream; the number of sets.
fn read_outside(fs: &MemFs) -> usize {
    let mut sets = 0;
    for name in names(fs).iter().filter(|n| n.starts_with("seg_")) {
        let bytes = contents(fs, &dir().join(name));
        let summary = mcap::Summary::read(&bytes).unwrap().expect("a summary");
        let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
        assert_eq!(summary.stats.unwrap().message_count, messages.len() as u64, "{name}");
        sets += messages.iter().filter(|m| m.channel.topic.ends_with("/frame_set")).count();
    }
    sets
}

#[test]
fn an_unfinished_dataset_is_finished_and_says_that_it_was_cut_off() {
    let fs = crashed(7, 3);
    assert_eq!(names(&fs), ["seg_0000.mcap", "seg_0001.mcap", "seg_0002.mcap.part", "session.toml"]);
    let report = planned_and_recovered(&fs).unwrap();
    assert_eq!((report.sets, report.changed, report.session_rebuilt), (7, true, false));
    assert_eq!(report.segments[1].action, RecoverAction::None);
    assert_eq!(report.segments[2].action, RecoverAction::Rebuilt);
    assert_eq!((report.segments[2].sets, report.segments[2].tail_bytes), (1, 0));
    assert_eq!(names(&fs), ["seg_0000.mcap", "seg_0001.mcap", "seg_0002.mcap", "session.toml"]);
    assert_eq!(ids(&fs), (1..=7).collect::<Vec<_>>());
    assert_eq!(read_outside(&fs), 7);
    assert_eq!(findings(&fs), [""; 0]);
    let o = outcome(&fs);
    assert!(!o.complete && o.lost[0].starts_with("the recording was cut off"), "{o:?}");
    assert_eq!((o.sets_offered, o.sets_recorded, o.sets_dropped.len()), (7, 7, 0));

    let before = fs.changes();
    let again = recover(&fs).unwrap();
    assert!(!again.changed && again.lost.is_empty(), "{again:?}");
    assert_eq!(fs.changes(), before, "a second time changes nothing");
}

#[test]
fn what_was_finished_without_a_loss_is_complete() {
    // Killed after the last segment had its index and before it had its name, or before the outcome was there.
    for part in [false, true] {
        let fs = MemFs::new();
        record(&fs, 4, options());
        let mut session = open(&fs).session().clone();
        let recorded = session.outcome.take();
        fs.put(&dir().join("session.toml"), session.to_toml().unwrap().into_bytes());
        if part {
            fs.rename(&segment(0), &segment(0).with_extension("mcap.part")).unwrap();
        }
        let report = recover(&fs).unwrap();
        let action = if part { RecoverAction::Finished } else { RecoverAction::None };
        assert_eq!((report.segments[0].action, report.lost.len()), (action, 0), "{report:?}");
        assert_eq!(Some(outcome(&fs)), recorded);
        assert_eq!(findings(&fs), [""; 0]);
    }
}

#[test]
fn a_whole_dataset_is_left_alone() {
    let fs = MemFs::new();
    record(&fs, 5, RecorderOptions { segment_max_ns: 2 * PERIOD, ..options() });
    let before = fs.changes();
    let report = recover(&fs).unwrap();
    assert!(!report.changed && report.lost.is_empty() && report.sets == 5, "{report:?}");
    assert_eq!(fs.changes(), before);
}

#[test]
fn damage_in_the_middle_costs_the_sets_it_hits_and_is_said() {
    let fs = MemFs::new();
    record(&fs, 9, RecorderOptions { segment_max_ns: 100 * PERIOD, ..options() });
    let whole = contents(&fs, &segment(0));
    let mut damaged = whole.clone();
    // A sector in the middle, as a failing disk leaves it.
    let at = whole.len() * 2 / 5;
    damaged[at..at + 512].fill(0xA5);
    fs.put(&segment(0), damaged.clone());
    let readable = ids(&fs);
    let shallow = recover_as(&fs, RecoverOptions { unfinished_only: true, ..Default::default() }).unwrap();
    assert!(!shallow.changed, "segments with an index are trusted on request");

    let report = recover(&fs).unwrap();
    let left = ids(&fs);
    assert!(readable.iter().all(|id| left.contains(id)), "{readable:?} could be read, {left:?} are left");
    assert!((7..9).contains(&left.len()) && left.last() == Some(&9), "{left:?}");
    let gone: Vec<u64> = (1..=9).filter(|id| !left.contains(id)).collect();
    assert_eq!(report.segments[0].sets_missing, [(gone[0], gone[gone.len() - 1])]);
    assert!(report.lost.iter().any(|l| l.contains("lost")), "{:?}", report.lost);
    assert_eq!(read_outside(&fs), left.len());
    let o = outcome(&fs);
    assert_eq!((o.complete, o.sets_offered, o.sets_recorded), (false, 9, left.len() as u64));
    assert_eq!(o.sets_dropped["lost_in_crash"], gone.len() as u64);
    let bytes = contents(&fs, &segment(0));
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let index = summary.metadata_indexes.iter().find(|m| m.name == "depthrig.recovered").unwrap();
    let record = mcap::read::metadata(&bytes, index).unwrap();
    let said = &record.metadata;
    assert_eq!(said["sets_lost"], gone.len().to_string());
    assert_eq!(said["lost"].lines().collect::<Vec<_>>(), report.segments[0].lost);
    let before = fs.changes();
    assert!(!recover(&fs).unwrap().changed);
    assert_eq!(fs.changes(), before);
}

/// The file's bytes and their checksum that each checkpoint of a segment states.
fn checkpoints(bytes: &[u8]) -> Vec<(u64, u32)> {
    let messages = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    let messages = messages.filter(|m| m.channel.topic.ends_with("/checkpoint"));
    // CDR: four bytes of its head, a time of two numbers of 32 bits, then these two.
    let read = |m: mcap::Message<'_>| {
        let file_bytes = u64::from_le_bytes(m.data[12..20].try_into().unwrap());
        (file_bytes, u32::from_le_bytes(m.data[20..24].try_into().unwrap()))
    };
    messages.map(read).collect()
}

/// A checkpoint of the damaged file would pass for damage of the copy wherever their lengths agree.
#[test]
fn the_checkpoints_of_a_copy_are_its_own() {
    let fs = MemFs::new();
    let limits = RecorderOptions { segment_max_ns: 100 * PERIOD, sync_interval_ns: 1, ..options() };
    let r = recorder(&fs, limits);
    for k in 0..9 {
        r.push(set(&session(), k)).unwrap();
        settle(&r);
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    r.finish().unwrap();
    let mut damaged = contents(&fs, &segment(0));
    let middle = damaged.len() * 2 / 5;
    damaged[middle..middle + 512].fill(0xA5);
    fs.put(&segment(0), damaged);
    assert!(planned_and_recovered(&fs).unwrap().changed);
    let bytes = contents(&fs, &segment(0));
    let checkpoints = checkpoints(&bytes);
    assert!(checkpoints.len() >= 4, "{checkpoints:?}");
    for (file_bytes, crc32) in checkpoints {
        let there = crc32fast::hash(&bytes[..file_bytes as usize]);
        assert_eq!(there, crc32, "the checkpoint of the first {file_bytes} bytes");
    }
}

/// An unproven head is not trusted: the session stays that of `session.toml`.
#[test]
fn a_damaged_head_does_not_change_the_session() {
    let fs = MemFs::new();
    record(&fs, 4, RecorderOptions { segment_max_ns: 2 * PERIOD, ..options() });
    let mut bytes = contents(&fs, &segment(0));
    let rig = b"rig = \"rig\"";
    let at = bytes.windows(rig.len()).position(|w| w == rig).unwrap();
    bytes[at + rig.len() - 2] = b'h';
    fs.put(&segment(0), bytes);
    let report = planned_and_recovered(&fs).unwrap();
    assert!(report.changed && !report.session_rebuilt, "{report:?}");
    assert_eq!(open(&fs).session().rig, "rig");
    assert_eq!((ids(&fs), findings(&fs)), (vec![1, 2, 3, 4], Vec::new()));
    let bytes = contents(&fs, &segment(0));
    assert!(!bytes.windows(rig.len()).any(|w| w == b"rig = \"rih\""), "the head is still damaged");
}

#[test]
fn a_lost_head_and_a_lost_session_are_made_anew_from_what_is_left() {
    // The head of each segment in turn, with and without session.toml.
    for (number, session) in [(0, true), (1, true), (0, false), (1, false)] {
        let fs = MemFs::new();
        record(&fs, 4, RecorderOptions { segment_max_ns: 2 * PERIOD, ..options() });
        let mut bytes = contents(&fs, &segment(number));
        bytes[..600].fill(0);
        fs.put(&segment(number), bytes);
        if !session {
            fs.remove_file(&dir().join("session.toml")).unwrap();
        }
        let report = planned_and_recovered(&fs).unwrap();
        assert_eq!(ids(&fs), [1, 2, 3, 4], "{report:?}");
        assert_eq!(report.session_rebuilt, !session);
        assert!(!report.lost.is_empty() && !outcome(&fs).complete);
        assert_eq!(findings(&fs), [""; 0]);
        assert_eq!(read_outside(&fs), 4);
        assert!(!recover(&fs).unwrap().changed);
    }
    // The only segment: how images are stored, its own head alone knew.
    let fs = MemFs::new();
    let color = ColorCodec::Raw;
    let depth = DepthCodec::Rank;
    record(&fs, 3, RecorderOptions { color, depth, ..options() });
    let mut bytes = contents(&fs, &segment(0));
    bytes[..600].fill(0);
    fs.put(&segment(0), bytes);
    recover(&fs).unwrap();
    assert_eq!(findings(&fs), [""; 0]);
    assert_eq!(ids(&fs), [1, 2, 3]);
}

#[test]
fn a_torn_session_is_made_anew_and_a_segment_without_a_set_stays_valid() {
    let fs = crashed(4, 2);
    fs.put(&dir().join("session.toml"), b"format = \"depthrig.data".to_vec());
    fs.put(&dir().join("session.tmp"), b"format".to_vec());
    fs.put(&dir().join(".reserve"), vec![0; 100]);
    fs.put(&dir().join("seg_0001.mcap.recovering"), vec![0; 100]);
    // As a crash leaves it right after the next segment was begun.
    fs.put(&dir().join("seg_0002.mcap.part"), Vec::new());
    let report = planned_and_recovered(&fs).unwrap();
    assert_eq!(report.removed, [".reserve", "seg_0001.mcap.recovering", "session.tmp"]);
    assert_eq!(names(&fs), ["seg_0000.mcap", "seg_0001.mcap", "seg_0002.mcap", "session.toml"]);
    assert_eq!((ids(&fs), read_outside(&fs)), (vec![1, 2, 3, 4], 4));
    assert!(report.session_rebuilt);
    assert_eq!(findings(&fs), [""; 0]);
    assert!(!recover(&fs).unwrap().changed);
}

#[test]
fn a_dataset_that_is_being_recorded_is_refused_and_found_once_it_is_not() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.push(set(&session(), 0)).unwrap();
    settle(&r);
    let found = || {
        let fs: Arc<dyn Fs> = Arc::new(fs.clone());
        let folder = dir().parent().unwrap().to_owned();
        (unfinished_in(&fs, &folder, "rig").unwrap(), unfinished_in(&fs, &folder, "another").unwrap())
    };
    let before = contents(&fs, &dir().join("seg_0000.mcap.part"));
    let e = recover(&fs).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains("is being recorded right now"), "{e}");
    assert_eq!(contents(&fs, &dir().join("seg_0000.mcap.part")), before);
    assert_eq!(found(), (vec![], vec![]));
    drop(r);
    assert_eq!(found(), (vec![dir()], vec![]));
    recover(&fs).unwrap();
    assert_eq!(found(), (vec![], vec![]));
    let e = recover_with(
        &(Arc::new(fs.clone()) as Arc<dyn Fs>),
        dir().parent().unwrap(),
        &RecoverOptions::default(),
        &mut |_| ControlFlow::Continue(()),
    );
    assert_eq!(e.unwrap_err().kind(), ErrorKind::NotADataset);
}

#[test]
fn a_recovery_that_finds_no_room_or_is_interrupted_changes_nothing() {
    let fs = crashed(5, 100);
    let part = dir().join("seg_0000.mcap.part");
    let before = contents(&fs, &part);
    let full = copy(&fs).with_capacity(before.len() as u64 * 3 / 2);
    let e = planned_and_recovered(&full).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::DiskFull);
    assert!(e.to_string().contains("free some space and try again (nothing was changed)"), "{e}");
    assert_eq!(names(&full), names(&fs));

    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let e = recover_with(&shared, &dir(), &RecoverOptions::default(), &mut |p| {
        if p.done_bytes > 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!(e.unwrap_err().kind(), ErrorKind::Interrupted);
    assert_eq!(names(&fs), ["seg_0000.mcap.part", "session.toml"]);
    assert!(contents(&fs, &part) == before);
    recover(&fs).unwrap();
    assert_eq!(ids(&fs), [1, 2, 3, 4, 5]);
}

/// Whichever operation of a recovery fails, once or from then on: a typed error, readable data stays readable, and the
/// next recovery succeeds.
#[test]
fn whichever_operation_of_a_recovery_fails_nothing_is_lost() {
    // A torn one, a damaged one and a complete one.
    let torn = crashed(5, 2);
    let mut bytes = contents(&torn, &segment(0));
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    torn.put(&segment(0), bytes);
    let part = contents(&torn, &dir().join("seg_0002.mcap.part"));
    torn.put(&dir().join("seg_0002.mcap.part"), part[..part.len() - 7].to_vec());
    let could = ids(&torn);
    let expected = {
        let fs = copy(&torn);
        recover(&fs).unwrap();
        ids(&fs)
    };
    assert!(could.iter().all(|id| expected.contains(id)) && expected.len() >= 3, "{could:?} {expected:?}");
    let faults: [fn(u64) -> Fault; 4] = [
        |n| Fault::FailOnce(n, io::ErrorKind::Other),
        |n| Fault::FailFrom(n, io::ErrorKind::StorageFull),
        |n| Fault::FailOnce(n, io::ErrorKind::PermissionDenied),
        Fault::ShortOnce,
    ];
    let mut tried = 0;
    let operations = {
        let fs = copy(&torn);
        recover(&fs).unwrap();
        fs.log()
    };
    for fault in faults {
        for n in 0.. {
            // Reads are many and alike.
            if operations.get(n as usize).is_some_and(|o| o.starts_with("read ")) && n % 16 != 3 {
                continue;
            }
            let fs = copy(&torn).with_fault(fault(n));
            let done = recover(&fs);
            let after = copy(&fs);
            if let Err(e) = &done {
                assert!(
                    matches!(e.kind(), ErrorKind::Io | ErrorKind::DiskFull | ErrorKind::PermissionDenied),
                    "operation {n}: {e}"
                );
                let left = ids(&after);
                assert!(could.iter().all(|id| left.contains(id)), "operation {n}: {left:?} of {could:?}");
            }
            recover(&after).unwrap_or_else(|e| panic!("operation {n}: {e}"));
            assert_eq!(ids(&after), expected, "operation {n}");
            assert!(!recover(&after).unwrap().changed, "operation {n}");
            tried += 1;
            if fs.ops() <= n {
                assert!(done.is_ok());
                break;
            }
        }
    }
    assert!(tried > 100, "only {tried} operations were tried");
}

#[test]
fn a_sync_that_fails_fails_the_recovery() {
    // One that is copied, and one that only lacks its name.
    let unnamed = MemFs::new();
    record(&unnamed, 4, options());
    let mut session = open(&unnamed).session().clone();
    session.outcome = None;
    unnamed.put(&dir().join("session.toml"), session.to_toml().unwrap().into_bytes());
    unnamed.rename(&segment(0), &segment(0).with_extension("mcap.part")).unwrap();
    for fs in [crashed(5, 100), unnamed] {
        let log = {
            let fs = copy(&fs);
            recover(&fs).unwrap();
            fs.log()
        };
        let syncs: Vec<_> = (0..).zip(&log).filter(|(_, o)| o.starts_with("sync ")).collect();
        assert!(syncs.iter().any(|(_, o)| o.contains("seg_0000")), "{log:?}");
        for (n, operation) in syncs {
            let fs = copy(&fs).with_fault(Fault::FailOnce(n, io::ErrorKind::Other));
            let e = recover(&fs).expect_err(operation);
            assert_eq!(e.kind(), ErrorKind::Io, "{operation}: {e}");
        }
    }
}

#[test]
fn a_copy_that_is_not_what_was_written_takes_nobodys_place() {
    let fs = crashed(5, 100);
    let part = dir().join("seg_0000.mcap.part");
    let before = contents(&fs, &part);
    let theirs: Arc<dyn Fs> = Arc::new(fs.clone());
    let e = recover_with(&theirs, &dir(), &RecoverOptions::default(), &mut |_| {
        // As a disk that stores other data than it was given.
        if let Some(mut bytes) = fs.contents(&dir().join("seg_0000.mcap.recovering")) {
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            fs.put(&dir().join("seg_0000.mcap.recovering"), bytes);
        }
        ControlFlow::Continue(())
    });
    assert!(e.is_err(), "{e:?}");
    assert!(contents(&fs, &part) == before && ids(&fs) == [1, 2, 3, 4, 5]);
}

/// A byte of each chunk in turn, and a cut after each: whatever a set's place in its segment, the dataset is
/// complete afterwards, its losses are counted exactly, and a second recovery changes nothing.
#[test]
fn whichever_chunk_is_damaged_the_dataset_is_repaired() {
    for synced_ns in [i64::MAX / 4, 1] {
        let fs = MemFs::new();
        let limits = RecorderOptions { segment_max_ns: 3 * PERIOD, sync_interval_ns: synced_ns, ..options() };
        let r = recorder(&fs, limits);
        for k in 0..9 {
            r.push(set(&session(), k)).unwrap();
            settle(&r);
            // So that an account comes after many a set.
            std::thread::sleep(std::time::Duration::from_millis(2));
        }
        assert!(r.finish().unwrap().complete);
        let mut lossy = 0;
        for number in 0..3 {
            let whole = contents(&fs, &segment(number));
            for chunk in mcap::Summary::read(&whole).unwrap().unwrap().chunk_indexes {
                let middle = (chunk.chunk_start_offset + chunk.chunk_length / 2) as usize;
                let mut flipped = whole.clone();
                flipped[middle] ^= 0x10;
                for (damage, bytes) in [("byte", flipped), ("cut", whole[..middle].to_vec())] {
                    let case = format!("{damage} {middle} of segment {number}");
                    let fs = copy(&fs);
                    fs.put(&segment(number), bytes);
                    let report = recover(&fs).unwrap_or_else(|e| panic!("{case}: {e}"));
                    assert_eq!(findings(&fs), [""; 0], "{case}: {:?}", report.lost);
                    let left = ids(&fs);
                    let o = outcome(&fs);
                    let gone = 9 - left.len() as u64;
                    assert_eq!((o.sets_offered, o.sets_recorded), (9, left.len() as u64), "{case}");
                    assert_eq!(o.sets_dropped.values().sum::<u64>(), gone, "{case}");
                    assert_eq!(report.segments[number as usize].sets_lost, gone, "{case}: {:?}", report.lost);
                    assert!(!recover(&fs).unwrap().changed, "{case}");
                    lossy += usize::from(gone > 0);
                }
            }
        }
        assert!(lossy > 40, "{lossy}");
    }
}

#[test]
fn a_segment_that_is_recovered_twice_has_lost_both_times() {
    let fs = MemFs::new();
    let r = recorder(&fs, RecorderOptions { sync_interval_ns: 1, ..options() });
    for k in 0..9 {
        r.push(set(&session(), k)).unwrap();
        settle(&r);
        // So that an account comes after the last set as well.
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    drop(r);
    recover(&fs).unwrap();
    for image in [6, 12] {
        let mut bytes = contents(&fs, &segment(0));
        let chunks = mcap::Summary::read(&bytes).unwrap().unwrap().chunk_indexes;
        let mut images = chunks.iter().filter(|c| c.message_index_offsets.len() == 1);
        let hit = images.nth(image).unwrap();
        bytes[(hit.chunk_start_offset + hit.chunk_length / 2) as usize] ^= 0x10;
        fs.put(&segment(0), bytes);
        let report = recover(&fs).unwrap();
        assert!(report.segments[0].sets_lost > 0, "{:?}", report.lost);
        assert_eq!(findings(&fs), [""; 0], "{:?}", report.lost);
    }
    assert_eq!(ids(&fs).len(), 7);
}

/// The damaged segment is copied, and before the last one is looked at the recovery is ended.
#[test]
fn a_recovery_that_was_ended_between_two_segments_is_told_by_the_next() {
    let fs = MemFs::new();
    record(&fs, 9, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
    let mut bytes = contents(&fs, &segment(1));
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    fs.put(&segment(1), bytes.clone());
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let e = recover_with(&shared, &dir(), &RecoverOptions::default(), &mut |_| {
        let copied = contents(&fs, &segment(1)) != bytes;
        if copied { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!(e.unwrap_err().kind(), ErrorKind::Interrupted);
    assert!(outcome(&fs).complete, "nothing was said yet");
    let report = recover(&fs).unwrap();
    assert!(report.changed && report.lost.iter().any(|l| l.contains("lost")), "{report:?}");
    let o = outcome(&fs);
    let left = ids(&fs).len() as u64;
    assert!(left < 9 && !o.complete && o.sets_recorded == left, "{o:?}");
    assert_eq!(findings(&fs), [""; 0]);
    assert!(!recover(&fs).unwrap().changed);
}

/// Data of a failed sync may never reach the disk, whatever succeeds later: the file is copied, not renamed.
#[test]
fn a_file_whose_sync_failed_is_copied() {
    let limits =
        || RecorderOptions { segment_max_ns: 3 * PERIOD, sync_interval_ns: i64::MAX / 4, ..options() };
    let log = {
        let fs = MemFs::new();
        record(&fs, 5, limits());
        fs.log()
    };
    let of_segment = |o: &String| o.starts_with("sync ") && o.ends_with(".mcap.part");
    let syncs: Vec<u64> = (0..).zip(&log).filter(|(_, o)| of_segment(o)).map(|(n, _)| n).collect();
    assert!(syncs.len() >= 2, "{log:?}");
    for n in syncs {
        let fs = MemFs::new().with_fault(Fault::FailOnce(n, io::ErrorKind::Other));
        let r = recorder(&fs, limits());
        for k in 0..5 {
            // Refused once the recording has ended.
            let _ = r.push(set(&session(), k));
            settle(&r);
        }
        let summary = r.finish().unwrap();
        assert!(!summary.complete && names(&fs).iter().any(|n| n.contains(".part")), "{summary:?}");
        let recorded: Vec<u64> = (1..=summary.sets.recorded).collect();
        recover(&fs).unwrap();
        assert_eq!(ids(&fs.after_crash(|_| 0)), recorded, "sync {n}: what is on the disk");
        assert_eq!(findings(&fs), [""; 0]);
        assert!(!recover(&fs).unwrap().changed);
    }
}
