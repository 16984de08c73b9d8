//! Failures are reported, counted and survived. Long because each failure has the same disks, encoders and checks.

use crate::logged::errors;
use crate::recover::{ids, recover};
use crate::support::*;
use depthrig_bus::PixelFormat;
use depthrig_recorder::fs::{DirEntry, Fault, Fs, MemFs, ReadFile, WriteFile};
use depthrig_recorder::{
    Dataset, ErrorKind, PixelMode, Pixels, RecordMotion, Recorder, RecorderOptions, SetDrop, SetRange,
    Severity, VerifyOptions, verify_with,
};
use proptest::prelude::*;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// A gate: callers wait until it is opened.
#[derive(Debug, Clone, Default)]
struct Gate(Arc<(Mutex<bool>, Condvar)>);

impl Gate {
    fn open(&self) {
        *self.0.0.lock().unwrap() = true;
        self.0.1.notify_all();
    }

    fn pass(&self) {
        let open = self.0.0.lock().unwrap();
        drop(self.0.1.wait_timeout_while(open, Duration::from_secs(20), |open| !*open).unwrap());
    }
}

/// Pixels whose encoder waits; looking at their length when they are pushed does not.
struct Held(Vec<u8>, Gate, AtomicUsize);

impl Pixels for Held {
    fn bytes(&self) -> &[u8] {
        if self.2.fetch_add(1, Ordering::Relaxed) > 0 {
            self.1.pass();
        }
        &self.0
    }
}

/// A disk whose writes wait.
#[derive(Debug)]
struct Stalled(MemFs, Gate);

struct StalledFile(Box<dyn WriteFile>, Gate);

impl Fs for Stalled {
    fn create_dir_all(&self, dir: &Path) -> io::Result<()> {
        self.0.create_dir_all(dir)
    }
    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        let file = self.0.create_new(path)?;
        // Creating a dataset must get through; what stalls is the segment, after its head.
        let stalls = path.to_string_lossy().ends_with(".part");
        Ok(if stalls { Box::new(StalledFile(file, self.1.clone())) } else { file })
    }
    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        self.0.open(path)
    }
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.0.rename(from, to)
    }
    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.0.remove_file(path)
    }
    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.0.sync_dir(dir)
    }
    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        self.0.read_dir(dir)
    }
    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        self.0.available_space(dir)
    }
}

impl WriteFile for StalledFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !bytes.starts_with(b"\x89MCAP") {
            self.1.pass();
        }
        self.0.write(bytes)
    }
    fn truncate(&mut self, len: u64) -> io::Result<()> {
        self.0.truncate(len)
    }
    fn sync_data(&mut self) -> io::Result<()> {
        self.0.sync_data()
    }
    fn sync_all(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }
}

/// The ids of the sets that can be read, and what stopped the reading.
fn readable(fs: &MemFs) -> (Vec<u64>, Vec<String>) {
    let mut ids = Vec::new();
    let mut errors = Vec::new();
    for set in open(fs).sets(SetRange::ALL) {
        match set {
            Ok(set) => {
                let want = crate::support::set(&session(), set.id - 1);
                assert_eq!(set.frames[1].pixels, want.frames[1].pixels.bytes(), "depth of set {}", set.id);
                ids.push(set.id);
            }
            Err(e) => errors.push(e.to_string()),
        }
    }
    (ids, errors)
}

fn worst(fs: &MemFs) -> Option<Severity> {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    verify_with(&fs, &dir(), &VerifyOptions::default()).unwrap().worst()
}

#[test]
fn a_busy_encoder_costs_sets_that_are_counted_in_the_file() {
    let fs = MemFs::new();
    let gate = Gate::default();
    let r = recorder(&fs, RecorderOptions { workers: 1, queue_sets: 2, ..options() });
    for n in 0..2 {
        let mut held = set(&session(), n);
        for f in &mut held.frames {
            let pixels = f.pixels.bytes().to_vec();
            f.pixels = Box::new(Held(pixels, gate.clone(), AtomicUsize::new(0)));
        }
        r.push(held).unwrap();
    }
    let refused = r.push(set(&session(), 2)).unwrap_err();
    assert_eq!(refused.reason, SetDrop::EncoderBusy);
    assert!(refused.message.contains("set 3 was not recorded: 2 sets wait to be encoded"), "{refused}");
    gate.open();
    settle(&r);
    r.push(set(&session(), 3)).unwrap();
    let summary = r.finish().unwrap();
    assert!(!summary.complete);
    assert_eq!(summary.lost, ["1 of 4 sets were not recorded: encoder_busy"]);
    assert_eq!(readable(&fs).0, [1, 2, 4]);
    let counts = open(&fs).info().unwrap().set_counts.unwrap();
    assert_eq!((counts.offered, counts.recorded, counts.dropped[SetDrop::EncoderBusy as usize]), (4, 3, 1));
    assert_eq!(worst(&fs), Some(Severity::Lost), "the dataset says itself that it lost a set");
}

#[test]
fn a_stalled_disk_costs_sets_and_never_blocks_nor_grows() {
    let fs = MemFs::new();
    let gate = Gate::default();
    let stalled = Arc::new(Stalled(fs.clone(), gate.clone()));
    let limits = RecorderOptions { backlog_max_bytes: 20_000, ..options() };
    let r = Recorder::create(stalled, &dir(), session(), limits).unwrap();
    let mut refused = Vec::new();
    for n in 0..60 {
        if let Err(e) = r.push(set(&session(), n)) {
            refused.push(e.reason);
        }
        // Until this set is encoded, so that the backlog is the reason of the refusal.
        for _ in 0..400 {
            if r.progress().encode_queue == 0 {
                break;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    assert!(refused.len() > 20 && refused.iter().all(|r| *r == SetDrop::DiskSlow), "{refused:?}");
    // Nor do notes, of which the writer takes none now.
    let taken = (0..1000).take_while(|_| r.add_note("is it slow?").is_ok()).count();
    assert!((200..=300).contains(&taken), "{taken} notes wait");
    assert!(r.add_note("one more").unwrap_err().to_string().contains("wait to be written already"));
    let backlog = r.progress().backlog_bytes;
    // A set: its images, and its IMU batches as they wait.
    let one = 10_000 + motion(&session(), 0).iter().map(RecordMotion::stored_bytes).sum::<u64>();
    assert!(backlog < 20_000 + one, "{backlog} bytes wait; the limit is exceeded by one set at most");
    gate.open();
    let summary = r.finish().unwrap();
    assert!(summary.sets.balances(), "{:?}", summary.sets);
    assert_eq!(summary.sets.dropped[SetDrop::DiskSlow as usize], refused.len() as u64);
    assert_eq!(readable(&fs).0.len() as u64, summary.sets.recorded);
}

#[test]
fn a_full_disk_ends_in_a_closed_dataset() {
    let fs = MemFs::new().with_capacity(130_000);
    let r = recorder(&fs, RecorderOptions { reserve_bytes: 45_000, ..options() });
    for n in 0..40 {
        drop(r.push(set(&session(), n)));
        settle(&r);
    }
    let e = r.progress().error.expect("40 sets do not fit");
    assert_eq!(e.kind(), ErrorKind::DiskFull);
    assert!(e.to_string().contains("the disk is full; free some space"), "{e}");
    let refused = r.push(set(&session(), 40)).unwrap_err();
    assert_eq!(refused.reason, SetDrop::WriteFailed);
    let logged = errors(|| (41..60).for_each(|n| drop(r.push(set(&session(), n)))));
    assert_eq!(logged, [""; 0], "refused sets are logged with the first one");
    assert!(refused.message.contains("the recording had ended: cannot write"), "{refused}");
    let summary = r.finish().unwrap();
    assert!(summary.sets.recorded >= 3 && summary.sets.balances(), "{summary:?}");
    assert!(summary.lost[0].contains("ended before its time"), "{:?}", summary.lost);
    assert_eq!(names(&fs), ["seg_0000.mcap", "session.toml"], "closed, with its index, under its final name");
    let (ids, errors) = readable(&fs);
    assert_eq!((ids.len() as u64, errors), (summary.sets.recorded, Vec::new()));
    assert_eq!(worst(&fs), Some(Severity::Lost), "losses, but no damage");
}

/// Records sets until the recording has ended, with pauses in which it looks at the disk.
fn record_to_the_limit(r: &Recorder) {
    for n in 0..60 {
        drop(r.push(set(&session(), n)));
        settle(r);
        std::thread::sleep(Duration::from_millis(50));
        if r.progress().error.is_some() {
            break;
        }
    }
}

#[test]
fn a_recording_stops_while_there_is_still_room() {
    let fs = MemFs::new().with_capacity(300_000);
    let limits = RecorderOptions { min_free_bytes: 200_000, sync_interval_ns: 1_000_000, ..options() };
    let r = recorder(&fs, limits);
    record_to_the_limit(&r);
    let e = r.progress().error.expect("the limit is reached");
    assert_eq!(e.kind(), ErrorKind::DiskFull);
    assert!(e.to_string().contains("the sets recorded so far are complete"), "{e}");
    let summary = r.finish().unwrap();
    assert_eq!(readable(&fs), ((1..=summary.sets.recorded).collect(), Vec::new()));
    assert!(names(&fs).contains(&"seg_0000.mcap".to_owned()));
}

/// A recording that stops at its limit still has room for the last accounts and the notes.
#[test]
fn a_recording_that_stops_at_its_limit_says_how_it_stands() {
    let fs = MemFs::new().with_capacity(300_000);
    // No account comes but the last.
    let sync_interval_ns = i64::MAX / 4;
    let r = recorder(&fs, RecorderOptions { min_free_bytes: 200_000, sync_interval_ns, ..options() });
    r.add_note("the cup fell").unwrap();
    record_to_the_limit(&r);
    assert_eq!(r.progress().error.expect("the limit is reached").kind(), ErrorKind::DiskFull);
    let summary = r.finish().unwrap();
    let counts = open(&fs).info().unwrap().set_counts.expect("an account");
    assert_eq!(counts.recorded, summary.sets.recorded);
    let file = mcap_messages(&contents(&fs, &segment(0)), "/notes");
    assert_eq!(file, 1, "the note is in the file");
    assert_eq!(worst(&fs), Some(Severity::Lost));
}

/// Messages of topics that end in `topic`.
fn mcap_messages(bytes: &[u8], topic: &str) -> usize {
    let messages = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
    messages.filter(|m| m.channel.topic.ends_with(topic)).count()
}

/// Sets that waited when others were refused: the last account counts the refused ones, the marks of those that
/// waited do not.
#[test]
fn what_was_refused_while_others_waited_is_counted_after_a_crash() {
    let fs = MemFs::new();
    let gate = Gate::default();
    let sync_interval_ns = 200_000_000;
    let r = recorder(&fs, RecorderOptions { workers: 1, queue_sets: 2, sync_interval_ns, ..options() });
    r.push(set(&session(), 0)).unwrap();
    settle(&r);
    for n in 1..3 {
        let mut held = set(&session(), n);
        for f in &mut held.frames {
            let pixels = f.pixels.bytes().to_vec();
            f.pixels = Box::new(Held(pixels, gate.clone(), AtomicUsize::new(0)));
        }
        r.push(held).unwrap();
    }
    let logged = errors(|| {
        for n in 3..8 {
            assert_eq!(r.push(set(&session(), n)).unwrap_err().reason, SetDrop::EncoderBusy);
        }
    });
    assert!(logged.len() == 1 && logged[0].contains("encoder_busy"), "one line for all of them: {logged:?}");
    // An account of one set and five refused ones; the first to come may have been begun before.
    for _ in 0..2 {
        let before = r.progress().bytes;
        let grows = (0..4000).any(|_| {
            std::thread::sleep(Duration::from_millis(5));
            r.progress().bytes > before
        });
        assert!(grows, "no account comes");
    }
    gate.open();
    settle(&r);
    drop(r);
    recover(&fs).unwrap();
    assert_eq!(ids(&fs), [1, 2, 3]);
    let o = open(&fs).session().outcome.clone().unwrap();
    assert_eq!((o.sets_offered, o.sets_recorded), (8, 3), "{o:?}");
    assert_eq!(o.sets_dropped["encoder_busy"], 5, "{o:?}");
}

#[test]
fn folders_that_cannot_take_a_dataset_are_refused_with_the_reason() {
    let create =
        |fs: &MemFs, options| Recorder::create(Arc::new(fs.clone()), &dir(), session(), options).err();
    let refusal = |fs: &MemFs| create(fs, options()).expect("refused");

    let fs = MemFs::new();
    record(&fs, 1, options());
    let e = refusal(&fs);
    assert_eq!(e.kind(), ErrorKind::AlreadyExists);
    assert!(e.to_string().contains("holds a dataset already; choose another name"), "{e}");

    let fs = MemFs::new();
    fs.create_dir_all(&dir()).unwrap();
    fs.put(&dir().join("thesis.txt"), vec![1]);
    let e = refusal(&fs);
    assert_eq!(e.kind(), ErrorKind::AlreadyExists);
    assert!(e.to_string().contains("it holds thesis.txt"), "{e}");

    let e = refusal(&MemFs::new().with_fault(Fault::FailFrom(1, io::ErrorKind::ReadOnlyFilesystem)));
    assert_eq!(e.kind(), ErrorKind::PermissionDenied);
    assert!(e.to_string().contains("the file system is read-only; choose another folder"), "{e}");

    let e = refusal(&MemFs::new().with_fault(Fault::FailFrom(1, io::ErrorKind::PermissionDenied)));
    assert!(e.to_string().contains("choose a folder that this user may write"), "{e}");

    let limits = RecorderOptions { min_free_bytes: 5_000_000, ..options() };
    let e = create(&MemFs::new().with_capacity(2_000_000), limits).expect("refused");
    assert_eq!(e.kind(), ErrorKind::DiskFull);
    assert!(e.to_string().contains("2 MB left, a recording stops at 5 MB"), "{e}");
}

/// A new folder is as durable as its name, and so on upwards to the first that was there.
#[test]
fn every_new_folder_is_durable_in_its_parent() {
    let synced = |there: Option<&Path>| {
        let fs = MemFs::new();
        if let Some(there) = there {
            fs.create_dir_all(there).unwrap();
        }
        drop(recorder(&fs, options()));
        let log = fs.log();
        ["syncdir /data", "syncdir /"].map(|op| log.iter().any(|o| o == op))
    };
    assert_eq!(synced(None), [true, true]);
    assert_eq!(synced(Some(Path::new("/data"))), [true, false]);
}

#[test]
fn sets_that_contradict_the_session_are_refused_with_the_reason() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    let refused = |change: &dyn Fn(&mut depthrig_recorder::RecordSet), why: &str| {
        let mut s = set(&session(), 5);
        change(&mut s);
        let e = r.push(s).unwrap_err();
        assert!(e.reason == SetDrop::BadSet && e.message.contains(why), "{e}");
    };
    refused(&|s| s.frames[0].stream = 9, "stream number 9 is not in the session");
    refused(&|s| s.frames[0].stream = 1, "stream front/depth is in it twice");
    refused(&|s| s.missing = vec![0], "stream front/color is in it twice");
    refused(&|s| s.frames[1].header.payload_len += 1, "its header promises 6145 bytes, 6144 are there");
    refused(&|s| s.frames[1].header.height -= 1, "64x47 z16 with 128 bytes per row takes 6016 bytes");
    refused(&|s| s.frames[1].header.format = 99, "pixel format code 99 is unknown");
    refused(&|s| s.frames[1].header.format = PixelFormat::Mono16 as u32, "the session announced z16");
    r.push(set(&session(), 5)).unwrap();
    refused(&|s| s.id = 6, "its id is not greater than that of the set before");
    let summary = r.finish().unwrap();
    assert_eq!((summary.sets.recorded, summary.sets.dropped[SetDrop::BadSet as usize]), (1, 8));
}

#[test]
fn what_is_no_dataset_is_named() {
    let fs = MemFs::new();
    let open = |path: &Path| Dataset::open_with(Arc::new(fs.clone()), path).unwrap_err();
    let e = open(&dir());
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert!(e.to_string().contains("/data/session: it does not exist"), "{e}");

    fs.create_dir_all(&dir()).unwrap();
    let e = open(&dir());
    assert_eq!(e.kind(), ErrorKind::NotADataset);
    assert!(
        e.to_string().contains("is not a dataset: it holds neither session.toml nor seg_0000.mcap"),
        "{e}"
    );

    let text = dir().join("notes.txt");
    fs.put(&text, b"these are not the frames you are looking for".to_vec());
    let e = open(&text);
    assert_eq!(e.kind(), ErrorKind::NotADataset);
    assert!(e.to_string().contains("notes.txt is not an MCAP file"), "{e}");

    let mut foreign = mcap::Writer::new(io::Cursor::new(Vec::new())).unwrap();
    foreign.add_channel(0, "/chatter", "json", &std::collections::BTreeMap::new()).unwrap();
    foreign.finish().unwrap();
    let other = dir().join("seg_0000.mcap");
    fs.put(&other, foreign.into_inner().into_inner());
    for path in [&other, &dir()] {
        let e = open(path);
        assert_eq!(e.kind(), ErrorKind::Foreign);
        assert!(e.to_string().contains("is an MCAP file, but not one of depthrig"), "{e}");
    }

    fs.put(
        &dir().join("session.toml"),
        b"format = \"depthrig.dataset/9\"\nname = \"\"\nrig = \"r\"\nstarted_utc_ns = 0\nstreams = []\n"
            .to_vec(),
    );
    let e = open(&dir());
    assert_eq!(e.kind(), ErrorKind::Version);
    assert!(
        e.to_string().contains("depthrig.dataset/9") && e.to_string().contains("use a later version"),
        "{e}"
    );
}

#[test]
fn a_cut_file_gives_its_whole_sets_and_then_the_reason() {
    let fs = MemFs::new();
    record(&fs, 4, options());
    let whole = contents(&fs, &segment(0));
    let mut counts = Vec::new();
    // Every place would take long; these meet each kind of record.
    for cut in (0..whole.len()).step_by(61) {
        let fs = copy(&fs);
        fs.put(&segment(0), whole[..cut].to_vec());
        let (ids, errors) = readable(&fs);
        assert_eq!(ids, (1..=ids.len() as u64).collect::<Vec<_>>(), "cut at {cut}");
        assert_eq!(errors.len(), 1, "cut at {cut}: {errors:?}");
        if !ids.is_empty() {
            assert!(errors[0].contains("the sets before it are complete"), "{errors:?}");
        }
        assert_eq!(worst(&fs), Some(Severity::Broken), "cut at {cut}");
        counts.push(ids.len());
    }
    assert!(counts.is_sorted() && counts.first() == Some(&0) && counts.last() == Some(&4), "{counts:?}");
}

#[test]
fn a_recorder_dropped_unfinished_leaves_a_readable_part() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..3 {
        r.push(set(&session(), n)).unwrap();
    }
    drop(r);
    assert_eq!(names(&fs), ["seg_0000.mcap.part", "session.toml"]);
    let (ids, errors) = readable(&fs);
    assert_eq!((ids, errors.len()), (vec![1, 2, 3], 1), "{errors:?}");
    assert_eq!(open(&fs).info().unwrap().unfinished, ["seg_0000.mcap.part"]);
    let fs: Arc<dyn Fs> = Arc::new(fs);
    let report = verify_with(&fs, &dir(), &VerifyOptions::default()).unwrap();
    let found: Vec<_> = report.findings.iter().map(|f| f.message.as_str()).collect();
    assert!(found.iter().any(|m| m.starts_with("unfinished: the data ends without a summary")), "{found:?}");
    assert!(found.iter().any(|m| m.contains("the recording was not closed")), "{found:?}");
}

/// The loss of a power cut is bounded by the sync interval: once that has passed, all is durable.
#[test]
fn written_sets_become_durable_without_closing_anything() {
    let fs = MemFs::new();
    let r = recorder(&fs, RecorderOptions { sync_interval_ns: 5_000_000, ..options() });
    for n in 0..3 {
        r.push(set(&session(), n)).unwrap();
    }
    settle(&r);
    let durable = || readable(&fs.after_crash(|_unsynced| 0)).0.len();
    for _ in 0..2000 {
        if durable() == 3 {
            break;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(durable(), 3, "{:?}", fs.log());
    r.finish().unwrap();
}

/// SQLite's method: fail the first operation, the second, … of a recording that rolls its segments.
#[test]
fn whichever_operation_fails_the_rest_is_whole() {
    let kinds = [io::ErrorKind::StorageFull, io::ErrorKind::Other];
    let faults: [fn(u64, io::ErrorKind) -> Fault; 2] = [Fault::FailOnce, Fault::FailFrom];
    for fault in faults {
        let mut n = 0;
        loop {
            let fs = MemFs::new()
                .with_fault(fault(n, kinds[n as usize % 2]))
                .with_fault(Fault::ShortWrites(5_000));
            let limits = RecorderOptions { segment_max_ns: 3 * PERIOD, reserve_bytes: 1000, ..options() };
            match Recorder::create(Arc::new(fs.clone()), &dir(), session(), limits.clone()) {
                Err(e) => {
                    assert!(matches!(e.kind(), ErrorKind::Io | ErrorKind::DiskFull), "operation {n}: {e}");
                    let again = copy(&fs);
                    let tried = Recorder::create(Arc::new(again), &dir(), session(), limits);
                    if matches!(fault(0, kinds[0]), Fault::FailOnce(..)) {
                        assert!(tried.is_ok(), "operation {n} failed and its remains refuse a second try");
                    }
                }
                Ok(r) => {
                    for k in 0..8 {
                        drop(r.push(set(&session(), k)));
                        settle(&r);
                    }
                    let summary = r.finish().unwrap();
                    assert!(summary.sets.balances(), "operation {n}: {summary:?}");
                    let clean = copy(&fs);
                    let (ids, _) = readable(&clean);
                    // Where truncation failed too, a set that counts as lost may be there all the same.
                    let uncut = u64::from(matches!(fault(0, kinds[0]), Fault::FailFrom(..)));
                    let at_most: Vec<u64> = (1..=summary.sets.recorded + uncut).collect();
                    let all = at_most.starts_with(&ids) && ids.len() as u64 >= summary.sets.recorded;
                    assert!(all, "operation {n}, {:?}: {ids:?} of {summary:?}", fs.log().get(n as usize));
                    if fs.ops() <= n {
                        assert!(summary.complete, "{summary:?}");
                        break;
                    }
                    let operation = fs.log().get(n as usize).cloned().unwrap_or_default();
                    let full = kinds[n as usize % 2] == io::ErrorKind::StorageFull;
                    if full && operation.starts_with("write ") && operation.contains(".part") {
                        // The room of the reserve is enough for an index.
                        let part = names(&clean).into_iter().find(|n| n.contains(".part"));
                        let once = matches!(fault(0, kinds[0]), Fault::FailOnce(..));
                        assert!(!once || part.is_none(), "operation {n}, {operation}: {part:?} is left");
                        assert!(
                            !once || worst(&clean) < Some(Severity::Broken),
                            "operation {n}, {operation}"
                        );
                    }
                    if summary.complete {
                        assert_eq!(worst(&clean), None, "operation {n} cost something that nobody says");
                    }
                }
            }
            n += 1;
        }
        assert!(n > 60, "only {n} operations were tried");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    /// A crash keeps the synced data and any part of the rest: readable are the first sets, all of those that were
    /// synced, and each bit by bit.
    #[test]
    fn a_crash_leaves_the_first_sets(sets in 1u64..8, keep in any::<prop::sample::Index>()) {
        let fs = MemFs::new();
        let r = recorder(&fs, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
        let mut synced = 0;
        for n in 0..sets {
            r.push(set(&session(), n)).unwrap();
            settle(&r);
            // A segment that was closed is durable.
            if n % 3 == 0 {
                synced = n;
            }
        }
        let crashed = fs.after_crash(|unsynced| keep.index(unsynced + 1));
        drop(r);
        prop_assert!(crashed.contents(&dir().join("session.toml")).is_some());
        let (ids, _) = readable(&crashed);
        prop_assert_eq!(&ids, &(1..=ids.len() as u64).collect::<Vec<_>>());
        prop_assert!(ids.len() as u64 >= synced, "{} of {synced} synced sets", ids.len());
        let all = open(&crashed).sets_with(SetRange::ALL, PixelMode::None).filter_map(Result::ok).count();
        prop_assert_eq!(all, ids.len());
    }
}
