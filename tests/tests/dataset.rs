//! From camera to disk and back: the dataset and its replay equal the frames that a subscriber received live.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, Frame, FrameFlags, FrameHeader, HostTime, RigName, StreamId, Subscriber};
use depthrig_daemon::ErrorKind;
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::replay::{Replay, ReplayOptions};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Dataset, DatasetSet, SetRange};
use depthrig_tests::fixture::Fixture;
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, wait_until};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, SystemTime};

const WAIT: Duration = Duration::from_secs(10);
const RAW: &str = "[recording]\ncolor = \"raw\"\n";

/// Frames by stream and device sequence.
type Seen = BTreeMap<(String, u64), (FrameHeader, Vec<u8>)>;

fn text() -> String {
    RigText::default().camera("left", "").camera("right", "").text().to_owned() + RAW
}

fn streams() -> Vec<StreamId> {
    ["left", "right"].iter().flat_map(|c| ["color", "depth"].map(|s| StreamId::new(c, s).unwrap())).collect()
}

fn keep(seen: &mut Seen, frame: &Frame) {
    let h = frame.header();
    seen.insert((h.stream_id().unwrap().to_string(), h.device_sequence), (*h, frame.pixels().to_vec()));
}

/// Ends a watcher however its test ends, or a failed assertion would leave the test waiting for it.
struct StopAtEnd<'a>(&'a AtomicBool);

impl Drop for StopAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

fn wait_for(ready: &AtomicBool) {
    let deadline = HostTime::now().plus(WAIT);
    while !ready.load(Ordering::SeqCst) {
        assert!(!deadline.from_now().is_zero(), "the test's own subscriber did not come");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Reads every stream until `stop`; `ready` is set once it has subscribed to all. Also returns how many frames it missed.
fn watch(home: &Home, ready: &AtomicBool, stop: &AtomicBool) -> (Seen, u64) {
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let mut subscribers: Vec<_> =
        streams().iter().map(|id| bus.subscriber_within(id, WAIT).unwrap()).collect();
    ready.store(true, Ordering::SeqCst);
    let mut seen = Seen::new();
    loop {
        let last = stop.load(Ordering::SeqCst);
        for subscriber in &mut subscribers {
            while let Some(frame) = subscriber.try_next().unwrap() {
                keep(&mut seen, &frame);
            }
        }
        if last {
            return (seen, subscribers.iter().map(Subscriber::missed).sum());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn live_recorded_and_replayed_frames_are_the_same() {
    let home = Home::default();
    let rig = home.start(&text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let stop = AtomicBool::new(false);
    let ready = AtomicBool::new(false);
    let control = rig.control();
    let ((live, missed), recorded) = std::thread::scope(|s| {
        let _stop = StopAtEnd(&stop);
        let watcher = s.spawn(|| watch(&home, &ready, &stop));
        wait_for(&ready);
        // The first set may take frames that came a little before it was asked for.
        std::thread::sleep(Duration::from_millis(300));
        let request = RecordRequest {
            directory: Some(home.path("data")),
            scene: "desk".into(),
            notes: "first".into(),
            ..RecordRequest::default()
        };
        let started = control.record_start(&request).unwrap();
        assert_eq!(control.record_start(&request).unwrap_err().kind(), ErrorKind::InUse);
        control.record_note("cup moved").unwrap();
        wait_until(&rig, "ten sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 10));
        let recorded = control.record_stop().unwrap();
        assert_eq!(recorded.path, started.path);
        stop.store(true, Ordering::SeqCst);
        (watcher.join().unwrap(), recorded)
    });
    let summary = rig.stop();
    assert_balanced(&summary.status);
    summary.status.cameras.iter().for_each(assert_undisturbed);
    // A busy computer may have no time for a set.
    assert!(recorded.dropped.keys().all(|reason| reason == "encoder_busy"), "{recorded:?}");
    assert!(recorded.error.is_none() || !recorded.dropped.is_empty(), "{recorded:?}");

    let dataset = Dataset::open(recorded.path.as_ref()).unwrap();
    assert_eq!(dataset.session().scene, "desk");
    assert_eq!(
        dataset.session().notes.iter().map(|n| n.text.as_str()).collect::<Vec<_>>(),
        ["first", "cup moved"]
    );
    let sets: Vec<_> = dataset.sets(SetRange::ALL).map(Result::unwrap).collect();
    assert!(sets.len() >= 10);
    let mut in_dataset = Seen::new();
    let mut unseen = 0;
    for set in &sets {
        assert_eq!(set.frames.len() + set.missing.len(), 4, "set {}", set.id);
        for frame in &set.frames {
            let key = (frame.header.stream_id().unwrap().to_string(), frame.header.device_sequence);
            if let Some((header, pixels)) = live.get(&key) {
                assert_eq!(frame.header, FrameHeader { set_id: set.id, ..*header });
                assert!(frame.pixels == *pixels, "{key:?}");
            } else {
                unseen += 1;
            }
            in_dataset.insert(key, (frame.header, frame.pixels.clone()));
        }
    }
    // A busy computer may be late with a frame.
    let complete = sets.iter().filter(|s| s.missing.is_empty()).count();
    assert!(2 * complete >= sets.len(), "{complete} of {} sets are complete", sets.len());
    // The test's own subscriber may be late on a busy computer, too. What it did not see, it must have counted.
    assert!(unseen <= missed && in_dataset.len() as u64 >= 2 * unseen, "{unseen} unseen, {missed} missed");
    replayed_is(&home, recorded.path.as_ref(), &in_dataset);
}

/// Replays the dataset and compares every frame with `expected`.
fn replayed_is(home: &Home, path: &std::path::Path, expected: &Seen) {
    let stop = AtomicBool::new(false);
    let ready = AtomicBool::new(false);
    let replayed = std::thread::scope(|s| {
        let options = ReplayOptions { as_fast_as_possible: true, paused: true, ..ReplayOptions::default() };
        let replay = Replay::start(&[path.to_owned()], &home.runtime(), None, options).unwrap();
        let _stop = StopAtEnd(&stop);
        let watcher = s.spawn(|| watch(home, &ready, &stop));
        wait_for(&ready);
        replay.control().replay().unwrap().resume().unwrap();
        while !replay.progress().done {
            std::thread::sleep(Duration::from_millis(20));
        }
        stop.store(true, Ordering::SeqCst);
        let (seen, missed) = watcher.join().unwrap();
        assert_eq!(missed, 0, "the test's own subscriber was too slow");
        assert_eq!(replay.stop().status.lost, Vec::<String>::new());
        seen
    });
    assert_eq!(replayed.len(), expected.len());
    for (key, (header, pixels)) in &replayed {
        let (recorded, recorded_pixels) = &expected[key];
        assert!(header.has(FrameFlags::REPLAYED));
        let original = FrameHeader {
            sequence: recorded.sequence,
            captured: recorded.captured,
            flags: header.flags & !FrameFlags::REPLAYED.0,
            ..*header
        };
        assert_eq!(original, *recorded, "{key:?}");
        assert!(pixels == recorded_pixels, "{key:?}");
    }
}

#[test]
fn a_camera_that_is_lost_leaves_marked_sets() {
    let text = RigText::default()
        .camera("left", "")
        .camera("right", "")
        .fault("unplug", 3.0, "duration_s = 1.0")
        .text()
        .to_owned()
        + RAW;
    let home = Home::default();
    let rig = home.start(&text).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let control = rig.control();
    let request = RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() };
    control.record_start(&request).unwrap();
    wait_until(&rig, "back", |s| s.cameras[1].reconnects == 1);
    std::thread::sleep(Duration::from_millis(600));
    let recorded = control.record_stop().unwrap();
    rig.stop();
    let dataset = Dataset::open(recorded.path.as_ref()).unwrap();
    let sets: Vec<_> = dataset.sets(SetRange::ALL).map(Result::unwrap).collect();
    let of =
        |set: &DatasetSet, camera: &str| set.frames.iter().filter(|f| f.header.camera() == camera).count();
    let (alone, others): (Vec<_>, Vec<_>) = sets.iter().partition(|s| of(s, "right") == 0);
    let right = |s: &DatasetSet| {
        s.frames.iter().filter(|f| f.header.camera() == "right").map(|f| f.header.capture_time_ns).min()
    };
    let seen: Vec<i64> = sets.iter().filter_map(right).collect();
    let gap = seen.windows(2).max_by_key(|w| w[1] - w[0]).unwrap();
    // A second, and its return, which takes a busy computer longer. The sets go on five times a second, or half of them there.
    let due = (gap[1] - gap[0]) / 200_000_000;
    let within = alone.iter().filter(|s| (gap[0]..gap[1]).contains(&s.tick.ns())).count() as i64;
    assert!(due >= 5 && (due / 2..=due + 1).contains(&within), "{within} sets of {due} without it");
    for set in &sets {
        assert_eq!(set.frames.len() + set.missing.len(), 4);
    }
    // A busy computer may be late with a frame of either.
    for sets in [alone, others] {
        let left = sets.iter().filter(|s| of(s, "left") == 2).count();
        assert!(2 * left >= sets.len(), "left was always there, and is in {left} of {} sets", sets.len());
    }
}

#[test]
fn a_folder_without_a_dataset_is_reported() {
    let home = Home::default();
    let start = |name: &str, options| Replay::start(&[home.path(name)], &home.runtime(), None, options);
    let Err(e) = start("nowhere", ReplayOptions::default()) else { panic!() };
    assert_eq!(e.kind(), ErrorKind::NotFound);
    std::fs::create_dir(home.path("empty")).unwrap();
    let Err(e) = start("empty", ReplayOptions::default()) else { panic!() };
    assert_eq!(e.kind(), ErrorKind::Other);
    assert!(e.to_string().contains("is not a dataset"), "{e}");
    let options = ReplayOptions { rate: 0.0, ..ReplayOptions::default() };
    let Err(e) = start("empty", options) else { panic!() };
    assert!(e.to_string().contains("from 0.1 to 10"), "{e}");
}

/// Every file of a folder: its bytes and when they were last written.
fn files(dir: &Path) -> BTreeMap<String, (Vec<u8>, SystemTime)> {
    let entries = std::fs::read_dir(dir).unwrap().map(Result::unwrap);
    let read = |e: std::fs::DirEntry| {
        let modified = e.metadata().unwrap().modified().unwrap();
        (e.file_name().into_string().unwrap(), (std::fs::read(e.path()).unwrap(), modified))
    };
    entries.map(read).collect()
}

#[test]
fn a_rig_finishes_at_its_start_what_a_crash_left_of_its_own() {
    let home = Home::default();
    let data = home.path("data");
    // In the order in which they are looked at: what must not be touched comes first.
    let [foreign, held, cut] = ["1_foreign", "2_held", "3_cut"].map(|name| data.join(name));
    let made = Fixture { rig: "test", ..Fixture::default() };
    Fixture { rig: "another", ..Fixture::default() }.record_and_crash(&foreign);
    made.record_and_crash(&held);
    made.record_and_crash(&cut);
    // As a recorder does.
    let lock = RealFs.lock(&held).unwrap();
    let before = [files(&foreign), files(&held)];
    let unfinished = files(&cut);
    assert!(unfinished.contains_key("seg_0002.mcap.part"), "{:?}", unfinished.keys());

    let config = |more: &str| text() + &format!("directory = \"{}\"\n{more}", data.display());
    home.start(&config("recover_on_start = false\n")).unwrap().stop();
    assert!(files(&cut) == unfinished, "the options forbid it");

    let rig = home.start(&config("")).unwrap();
    wait_until(&rig, "the recovery", |_| Dataset::open(&cut).unwrap().session().outcome.is_some());
    rig.stop();
    drop(lock);
    assert!([files(&foreign), files(&held)] == before, "what is not its own or in use was touched");
    assert!(!cut.join("seg_0002.mcap.part").exists());
    let dataset = Dataset::open(&cut).unwrap();
    let ids: Vec<_> = dataset.sets(SetRange::ALL).map(|s| s.unwrap().id).collect();
    assert_eq!(ids, (0..12).map(|n| 3 * n + 5).collect::<Vec<_>>());
    let outcome = dataset.session().outcome.as_ref().unwrap();
    assert!(!outcome.complete && outcome.lost[0].contains("cut off"), "{:?}", outcome.lost);
}
