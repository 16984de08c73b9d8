//! A rig whose disk fails: the recording ends or reports lost sets; the live feed is not affected.
//!
//! Each test watches every stream with a subscriber of its own, before the fault and during it. No frame may be lost but
//! those that a busy computer was too late for, and frames may not come much later than before. `DEPTHRIG_LONG=1` makes
//! the faults last three times as long.
//! Tests that need a small disk mount one, which tools/test.sh allows them; where that is refused they are skipped, unless
//! `DEPTHRIG_REQUIRE_TMPFS=1` makes that a failure.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, HostTime, RigName, StreamId, UtcPair};
use depthrig_daemon::ErrorKind;
use depthrig_daemon::control::{LossBucket, RecordRequest, RecordingLosses};
use depthrig_daemon::rig::{Rig, RigOptions};
use depthrig_daemon::status::RecordingStatus;
use depthrig_recorder::{Dataset, DatasetSet, SetRange, Severity, VerifyOptions, verify};
use depthrig_tests::disk::{Disk, Tmpfs};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, wait_until};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Encoded bytes that may wait for the disk in these tests.
const BACKLOG: u64 = 1 << 20;
const MIB: u64 = 1 << 20;
/// How long each feed is watched before the fault.
const BEFORE: Duration = Duration::from_millis(1500);
/// Frames of a stream that a busy computer may be too late for: a second's. A feed that waits for the disk lacks more.
const TOO_LATE: u64 = 30;

/// One rig at a time: two would disturb each other's latencies.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn long() -> u32 {
    if std::env::var_os("DEPTHRIG_LONG").is_some() { 3 } else { 1 }
}

fn seconds(s: f64) -> Duration {
    Duration::from_secs_f64(s * f64::from(long()))
}

/// Two cameras whose sets are stored unpacked enough to trouble a disk.
fn text() -> String {
    RigText::default().camera("left", "").camera("right", "").text().to_owned()
        + "[sets]\nrate_hz = 15.0\n[recording]\ncolor = \"raw\"\nreserve_mb = 0\nmin_minutes = 0\nqueue_sets = 4\n"
}

/// Frames that a subscriber received of all streams, with the delay from capture to arrival, ns.
#[derive(Default)]
struct Seen {
    late_ns: Vec<i64>,
    missed: u64,
    out_of_order: u64,
}

impl Seen {
    fn quantile_ms(&self, quantile: f64) -> f64 {
        let mut late = self.late_ns.clone();
        assert!(late.len() > 50, "only {} frames came", late.len());
        let at = ((late.len() - 1) as f64 * quantile) as usize;
        *late.select_nth_unstable(at).1 as f64 / 1e6
    }
}

/// Watches every stream until `stop`: while the rig warms up, before the fault, and since.
fn watch(home: &Home, phase: &AtomicUsize, stop: &AtomicBool) -> [Seen; 3] {
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let ids = ["left", "right"].iter().flat_map(|c| ["color", "depth"].map(|s| StreamId::new(c, s).unwrap()));
    let mut subscribers: Vec<_> = ids.map(|id| (bus.subscriber(&id).unwrap(), None)).collect();
    let mut seen = [Seen::default(), Seen::default(), Seen::default()];
    while !stop.load(Ordering::SeqCst) {
        let seen = &mut seen[phase.load(Ordering::SeqCst)];
        for (subscriber, last) in &mut subscribers {
            while let Some(frame) = subscriber.try_next().unwrap() {
                let h = frame.header();
                seen.late_ns.push(HostTime::now().ns() - h.capture_time_ns);
                seen.out_of_order += u64::from(last.is_some_and(|l| h.sequence <= l));
                *last = Some(h.sequence);
            }
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    seen[2].missed = subscribers.iter().map(|(s, _)| s.missed()).max().unwrap();
    seen
}

fn resident_bytes() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").unwrap();
    pages.split(' ').nth(1).unwrap().parse::<u64>().unwrap() * 4096
}

/// State after a fault.
struct Left {
    recording: RecordingStatus,
    /// Result of `record stop`.
    stopped: depthrig_daemon::Result<RecordingStatus>,
    /// Most bytes that waited for the disk.
    backlog_bytes: u64,
    /// Most sets that waited for an encoder.
    encode_queue: u64,
    grown_bytes: u64,
    /// When it lost something.
    losses: RecordingLosses,
}

/// Runs a rig that records into `data`, watches it, lets `fault` happen and looks for `length` at what comes of it.
fn run(
    home: &Home,
    data: &Path,
    change: impl FnOnce(&mut RigOptions),
    fault: impl FnOnce(&Rig, &RecordingStatus),
    length: Duration,
) -> Left {
    let rig = home
        .start_with(&text(), |o| {
            o.backlog_max_bytes = Some(BACKLOG);
            change(o);
        })
        .unwrap();
    wait_until(&rig, "streaming", all_stream);
    let phase = AtomicUsize::new(0);
    let stop = AtomicBool::new(false);
    let control = rig.control();
    let (left, seen) = std::thread::scope(|s| {
        let watcher = s.spawn(|| watch(home, &phase, &stop));
        let request = RecordRequest { directory: Some(data.to_owned()), ..RecordRequest::default() };
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let recording = control.record_start(&request).unwrap();
            wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 3));
            phase.store(1, Ordering::SeqCst);
            std::thread::sleep(BEFORE);
            let before = resident_bytes();
            fault(&rig, &recording);
            phase.store(2, Ordering::SeqCst);
            let end = HostTime::now().plus(length);
            let mut backlog_bytes = 0;
            let mut encode_queue = 0;
            let mut resident = 0;
            let mut recording = recording;
            while !end.from_now().is_zero() {
                std::thread::sleep(Duration::from_millis(20));
                recording = control.status().recording.unwrap();
                backlog_bytes = backlog_bytes.max(recording.backlog_bytes);
                encode_queue = encode_queue.max(recording.encode_queue);
                resident = resident.max(resident_bytes());
            }
            let stopped = control.record_stop();
            let grown_bytes = resident.saturating_sub(before);
            let losses = control.record_losses().unwrap();
            Left { recording, stopped, backlog_bytes, encode_queue, grown_bytes, losses }
        }));
        stop.store(true, Ordering::SeqCst);
        (result, watcher.join().unwrap())
    });
    let left = left.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    let again = control
        .record_start(&RecordRequest { directory: Some(home.path("another")), ..RecordRequest::default() });
    let disk_is_well = again.is_ok();
    let summary = rig.stop();
    unaffected(&summary.status, &seen);
    assert!(left.grown_bytes < BACKLOG + 48 * MIB, "memory grew by {} MiB", left.grown_bytes / MIB);
    assert!(left.encode_queue <= 4, "{} sets waited for an encoder", left.encode_queue);
    // A set that was admitted below the limit may carry it over, and so may those in the encoders.
    assert!(left.backlog_bytes < BACKLOG + 8 * 400_000, "{} bytes waited for the disk", left.backlog_bytes);
    assert!(disk_is_well || left.recording.error.is_some(), "{again:?}");
    left
}

/// The feed lost nothing and came as soon as before.
fn unaffected(status: &depthrig_daemon::status::RigStatus, [_, before, during]: &[Seen; 3]) {
    assert_balanced(status);
    for s in status.cameras.iter().flat_map(|c| &c.streams) {
        let late = s.dropped.get("device_gap").copied().unwrap_or(0);
        assert_eq!(late, s.dropped.values().sum::<u64>(), "{} lost frames: {:?}", s.id, s.dropped);
        assert!(late + s.in_sets.missed + s.in_sets.overflow <= TOO_LATE, "{s:?}");
    }
    assert!(during.missed <= TOO_LATE, "{} frames of a stream were not seen", during.missed);
    assert_eq!((before.out_of_order, during.out_of_order), (0, 0));
    // Far apart from noise: a feed that waits for a stalled disk comes seconds late.
    for (quantile, times, floor_ms) in [(0.5, 4.0, 5.0), (0.9, 10.0, 20.0)] {
        let b = before.quantile_ms(quantile);
        let d = during.quantile_ms(quantile);
        eprintln!("latency p{:.0}: {b:.2} ms before, {d:.2} ms during", quantile * 100.0);
        assert!(
            d < times * b.max(floor_ms),
            "quantile {quantile}: {b:.2} ms before, {d:.2} ms during the fault"
        );
    }
}

/// Panics if a recording lost something but sets that the encoders of a busy computer were too late for.
fn assert_kept(recording: &RecordingStatus) {
    let busy = recording.dropped.keys().all(|reason| reason == "encoder_busy");
    let only = |e: &String| e.ends_with(" sets were not recorded: encoder_busy") && !e.contains("; ");
    assert!(busy && recording.error.as_ref().is_none_or(only), "{recording:?}");
}

/// Ends the rig, which must have lost nothing but what a busy computer was too late for.
fn stop(rig: Rig) {
    let status = rig.stop().status;
    status.cameras.iter().for_each(assert_undisturbed);
    assert_kept(&status.recording.unwrap());
}

/// Every set of the dataset, which must be intact up to its end; `lost` permits it to report lost sets of any reason.
fn sets_of(path: &str, lost: bool) -> Vec<DatasetSet> {
    let report =
        verify(Path::new(path), &VerifyOptions { decode: true, ..VerifyOptions::default() }).unwrap();
    let bad = |f: &&depthrig_recorder::Finding| match f.severity {
        Severity::Note => false,
        Severity::Lost => !lost && !f.message.ends_with(" sets were not recorded: encoder_busy"),
        Severity::Broken => true,
    };
    let bad: Vec<_> = report.findings.iter().filter(bad).collect();
    assert!(bad.is_empty(), "{bad:#?}");
    Dataset::open(Path::new(path)).unwrap().sets(SetRange::ALL).map(Result::unwrap).collect()
}

#[test]
fn a_disk_that_stalls_costs_counted_sets_and_nothing_else() {
    let _alone = alone();
    let home = Home::default();
    let disk = Disk::default();
    let fs = Arc::new(disk.clone());
    let fault = |_: &Rig, _: &RecordingStatus| disk.stall(seconds(5.0));
    let left = run(&home, &home.path("data"), |o| o.fs = fs, fault, seconds(5.0) + Duration::from_secs(2));
    let stopped = left.stopped.unwrap();
    let dropped = stopped.dropped.get("disk_slow").copied().unwrap_or(0);
    assert!(dropped > 10, "five seconds are 75 sets and the backlog takes a few: {:?}", stopped.dropped);
    assert!(left.backlog_bytes >= BACKLOG, "the backlog was never full");
    assert!(stopped.error.as_ref().is_some_and(|e| e.contains("disk_slow")), "{:?}", stopped.error);
    assert!(stopped.dropped.keys().all(|reason| ["disk_slow", "encoder_busy"].contains(&reason.as_str())));
    // The history knows when: every set, in seconds one after the other, and none before the backlog was full.
    let slow = |b: &LossBucket| Some((b.from_s, *b.losses.sets.get("disk_slow")?));
    let (seconds, lost): (Vec<f64>, Vec<u64>) = left.losses.buckets.iter().filter_map(slow).unzip();
    let lost = lost.iter().sum::<u64>();
    assert_eq!((lost, left.losses.path.as_str()), (dropped, stopped.path.as_str()));
    assert!(seconds.len() > 1 && seconds[0] >= 1.0, "{seconds:?}");
    assert!(seconds.last().unwrap() - seconds[0] < left.losses.duration_s, "{seconds:?}");
    // It goes on after the stall: the last set is later than the stall's end.
    let sets = sets_of(&stopped.path, true);
    assert_eq!(sets.len() as u64, stopped.sets);
    let gap = sets.windows(2).map(|w| w[1].tick.since_ns(w[0].tick)).max().unwrap();
    assert!(gap > 1_000_000_000, "the refused sets are missing");
    assert!(sets.last().unwrap().id > sets.len() as u64 + dropped / 2, "ids show what was refused");
}

#[test]
fn a_disk_ten_times_too_slow_costs_counted_sets_and_nothing_else() {
    let _alone = alone();
    let home = Home::default();
    let disk = Disk::default();
    let fs = Arc::new(disk.clone());
    let fault = |_: &Rig, recording: &RecordingStatus| {
        let rate = disk.written() as f64 / (BEFORE.as_secs_f64() + 0.5);
        assert!(rate > 100_000.0, "{} writes {rate} bytes a second", recording.path);
        disk.slow_down((rate / 10.0) as u64);
    };
    let watch = |o: &mut RigOptions| o.fs = fs;
    let left = run(&home, &home.path("data"), watch, fault, seconds(6.0));
    let dropped = left.recording.dropped.get("disk_slow").copied().unwrap_or(0);
    assert!(dropped > 10, "{:?}", left.recording.dropped);
    disk.slow_down(0);
    let stopped = left.stopped.unwrap();
    let sets = sets_of(&stopped.path, true);
    assert_eq!(sets.len() as u64, stopped.sets);
    assert!(stopped.error.as_ref().is_some_and(|e| e.contains("disk_slow")), "{:?}", stopped.error);
}

#[test]
fn a_full_disk_ends_the_recording_with_a_closed_file() {
    let _alone = alone();
    let home = Home::default();
    let Some(small) = Tmpfs::mount(&home.path("small"), 24 * MIB) else { return };
    let fault = |_: &Rig, _: &RecordingStatus| small.fill(200_000);
    let left = run(&home, small.path(), |_| {}, fault, seconds(3.0));
    assert!(left.recording.error.is_some(), "the status says so while the rig runs: {:?}", left.recording);
    let stopped = left.stopped.unwrap();
    assert!(stopped.dropped.contains_key("write_failed"), "{:?}", stopped.dropped);
    assert!(stopped.error.as_ref().is_some_and(|e| e.contains("the disk is full")), "{:?}", stopped.error);
    let sets = sets_of(&stopped.path, true);
    assert_eq!(sets.len() as u64, stopped.sets, "what was recorded until then is there");
    let part = Path::new(&stopped.path).join("seg_0000.mcap.part");
    assert!(!part.exists() && part.with_extension("").exists(), "the last segment has its index");
}

#[test]
fn a_disk_that_becomes_read_only_ends_the_recording() {
    let _alone = alone();
    let home = Home::default();
    let disk = Disk::default();
    let fs = Arc::new(disk.clone());
    // As a kernel does it after an error of the medium: open files fail as well. A remount by hand is refused then.
    let fault = |_: &Rig, _: &RecordingStatus| disk.fail(std::io::ErrorKind::ReadOnlyFilesystem);
    let left = run(&home, &home.path("data"), |o| o.fs = fs, fault, seconds(2.0));
    assert!(left.recording.error.as_ref().is_some_and(|e| e.contains("read-only")), "{:?}", left.recording);
    let stopped = left.stopped.unwrap();
    assert!(stopped.dropped.contains_key("write_failed"), "{:?}", stopped.dropped);
    // Nothing more could be written, not even an index; the written part can be read.
    let sets =
        Dataset::open(Path::new(&stopped.path)).unwrap().sets(SetRange::ALL).filter_map(Result::ok).count();
    assert!(sets as u64 >= stopped.sets && stopped.sets > 10, "{sets} of {} sets", stopped.sets);
}

#[test]
fn what_will_not_fit_is_refused_unless_forced() {
    let _alone = alone();
    let home = Home::default();
    let Some(small) = Tmpfs::mount(&home.path("small"), 24 * MIB) else { return };
    let rig = home.start(&text().replace("min_minutes = 0", "min_minutes = 1")).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let control = rig.control();
    let asks = |max_duration_s, force| RecordRequest {
        directory: Some(small.path().to_owned()),
        max_duration_s,
        force,
        ..RecordRequest::default()
    };
    // About 1.7 MB a second: 14 s of them fit.
    for length_s in [None, Some(60.0)] {
        let e = control.record_start(&asks(length_s, false)).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::NoSpace, "{e}");
        assert!(e.to_string().contains("about 0.2 minutes fit"), "{e}");
        assert_eq!(std::fs::read_dir(small.path()).unwrap().count(), 0, "nothing was begun");
    }
    control.record_start(&asks(Some(60.0), true)).unwrap();
    wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 3));
    control.record_stop().unwrap();
    control.record_start(&asks(Some(0.5), false)).unwrap();
    stop(rig);
}

#[test]
fn a_recording_ends_by_itself_when_its_time_is_over() {
    let _alone = alone();
    let home = Home::default();
    let rig = home.start(&text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let control = rig.control();
    let asks = |max_duration_s| RecordRequest {
        directory: Some(home.path("data")),
        max_duration_s,
        ..RecordRequest::default()
    };
    assert_eq!(control.record_start(&asks(Some(-1.0))).unwrap_err().kind(), ErrorKind::BadInput);
    control.record_start(&asks(Some(1.0))).unwrap();
    let early = control.status().recording.unwrap();
    assert!(early.active || early.duration_s >= 1.0);
    let ended = wait_until(&rig, "its end", |s| s.recording.as_ref().is_some_and(|r| !r.active));
    let ended = ended.recording.unwrap();
    assert_kept(&ended);
    let dropped: u64 = ended.dropped.values().sum();
    assert!(ended.duration_s >= 0.8 || dropped > 0, "{} s: sets of less than a second", ended.duration_s);
    // The feed was asked for about one second of 15 sets; a loaded machine may be late to end it.
    let sets = sets_of(&ended.path, false);
    assert_eq!(sets.len() as u64, ended.sets);
    assert!((10..90).contains(&(ended.sets + dropped)) && sets.len() >= 3, "{ended:?}");
    let dataset = Dataset::open(Path::new(&ended.path)).unwrap();
    assert_eq!(dataset.session().outcome.as_ref().unwrap().complete, dropped == 0);
    assert_eq!(control.record_stop().unwrap_err().kind(), ErrorKind::WrongState);
    // One without an end goes on past that.
    control.record_start(&asks(None)).unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    assert!(control.status().recording.unwrap().active);
    stop(rig);
}

#[test]
fn a_read_only_disk_is_refused_at_the_start() {
    let _alone = alone();
    let home = Home::default();
    let Some(small) = Tmpfs::mount(&home.path("small"), 8 * MIB) else { return };
    small.make_read_only();
    let rig = home.start(&text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let request = RecordRequest { directory: Some(small.path().to_owned()), ..RecordRequest::default() };
    let e = rig.control().record_start(&request).unwrap_err();
    assert!(e.to_string().to_lowercase().contains("read-only"), "{e}");
    assert!(e.to_string().contains("small"), "it names the folder: {e}");
    let request = RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() };
    rig.control().record_start(&request).unwrap();
    wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 3));
    stop(rig);
}

#[test]
fn a_folder_deleted_under_the_recorder_ends_the_recording() {
    let _alone = alone();
    let home = Home::default();
    let fault = |_: &Rig, recording: &RecordingStatus| std::fs::remove_dir_all(&recording.path).unwrap();
    let left = run(&home, &home.path("data"), |_| {}, fault, seconds(2.5));
    let error = left.recording.error.as_deref().unwrap_or_default();
    assert!(
        error.contains("was removed while it was recorded into"),
        "the status says so while the rig runs: {:?}",
        left.recording
    );
    let stopped = left.stopped.map_or_else(|e| e.to_string(), |s| s.error.unwrap_or_default());
    assert!(!stopped.is_empty(), "`record stop` says so");
    assert!(!Path::new(&left.recording.path).exists(), "it is not created again behind the user's back");
}

/// How UTC minus the monotonic clock changed from each `clock` message to the next, nanoseconds, read with the `mcap`
/// crate alone.
fn clock_steps(dataset: &Path) -> Vec<i64> {
    let bytes = std::fs::read(dataset.join("seg_0000.mcap")).unwrap();
    let number = |data: &[u8], at: usize| i64::from_le_bytes(data[at..at + 8].try_into().unwrap());
    let offsets: Vec<i64> = mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(Result::unwrap)
        .filter(|m| m.channel.topic.ends_with("/clock"))
        // Encapsulation (4 bytes) and stamp (8), then an int64 each; CDR aligns from behind the encapsulation.
        .map(|m| number(&m.data, 20) - number(&m.data, 12))
        .collect();
    offsets.windows(2).map(|w| w[1] - w[0]).collect()
}

#[test]
fn a_step_of_the_wall_clock_moves_no_recorded_time() {
    let _alone = alone();
    let home = Home::default();
    let step_ns = Arc::new(AtomicI64::new(0));
    let theirs = Arc::clone(&step_ns);
    let utc = Arc::new(move || {
        let pair = UtcPair::sample();
        UtcPair { utc_ns: pair.utc_ns + theirs.load(Ordering::SeqCst), ..pair }
    });
    let hour = 3_600_000_000_000;
    let fault = |_: &Rig, _: &RecordingStatus| step_ns.store(hour, Ordering::SeqCst);
    let left = run(&home, &home.path("data"), |o| o.utc = utc, fault, seconds(2.5));
    let stopped = left.stopped.unwrap();
    assert_kept(&stopped);
    let sets = sets_of(&stopped.path, false);
    assert!(sets.len() as u64 + stopped.dropped.values().sum::<u64>() > 30 && sets.len() > 3, "{stopped:?}");
    let offset = sets[0].utc_offset_ns;
    for pair in sets.windows(2) {
        assert_eq!(pair[1].utc_offset_ns, offset);
        assert_eq!(pair[1].utc_ns - pair[0].utc_ns, pair[1].tick.since_ns(pair[0].tick), "a time jumped");
    }
    let steps = clock_steps(Path::new(&stopped.path));
    assert!(steps.iter().any(|by| (by - hour).abs() < 1_000_000_000), "the step is in `clock`: {steps:?}");
    let notes = verify(Path::new(&stopped.path), &VerifyOptions::default()).unwrap().findings;
    let said = |f: &&depthrig_recorder::Finding| f.message.starts_with("the wall clock was set by +3600");
    let said: Vec<_> = notes.iter().filter(said).collect();
    assert!(said.len() == 1 && said[0].severity == Severity::Note, "{notes:#?}");
    let now = UtcPair::sample().utc_ns;
    assert!(
        (0..60_000_000_000).contains(&(now - sets.last().unwrap().utc_ns)),
        "placed by the first reading"
    );
    assert!(stopped.started_utc_ns < now);
}

/// Somebody put FIFOs in the names of a dataset into the recording folder: opening one would wait for ever.
#[test]
fn fifos_in_the_recording_folder_keep_nothing_from_ending() {
    let _alone = alone();
    let home = Home::default();
    let old = home.path("data").join("20260101_0000");
    std::fs::create_dir_all(&old).unwrap();
    for name in ["session.toml", "seg_0000.mcap.part"] {
        let made = std::process::Command::new("mkfifo").arg(old.join(name)).status().unwrap();
        assert!(made.success());
    }
    let text = text() + &format!("directory = \"{}\"\n", home.path("data").display());
    let (done, ended) = std::sync::mpsc::sync_channel(1);
    std::thread::spawn(move || {
        let rig = home.start(&text).unwrap();
        wait_until(&rig, "streaming", all_stream);
        rig.stop();
        done.send(()).unwrap();
    });
    ended.recv_timeout(Duration::from_mins(1)).expect("the rig does not end");
}
