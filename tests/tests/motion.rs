//! IMUs from the bus into datasets: every batch of a recording once and in order, whatever happens meanwhile.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, FrameHeader, HostTime, MotionSample, RigName, StreamId, UtcPair};
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::replay::{Replay, ReplayOptions};
use depthrig_daemon::rig::Rig;
use depthrig_daemon::status::{CameraState, RigStatus, StreamStatus};
use depthrig_recorder::{
    CompareOptions, Dataset, DatasetSet, PixelCheck, SetRange, Severity, VerifyOptions, compare, verify,
};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, camera, wait_until};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Asks for the camera's IMU beside its images.
const IMU: &str = "[[camera.stream]]\nname = \"imu\"\n";
const UNITS: [&str; 2] = ["left/imu", "right/imu"];

/// A batch as a subscriber saw it.
type Seen = (FrameHeader, Vec<MotionSample>);

fn rig(sets_hz: f64, faults: impl FnOnce(RigText) -> RigText) -> String {
    let sets = format!("[sets]\nrate_hz = {sets_hz:?}\n[recording]\nreserve_mb = 0\nmin_minutes = 0\n");
    faults(RigText::default().camera("left", IMU).camera("right", IMU)).and(&sets).text().to_owned()
}

/// The batches of each unit that a subscriber saw, and how many it came too late for on a busy computer.
struct Watched([Vec<Seen>; 2], [u64; 2]);

/// Collects every batch of both units until `stop`.
fn watch(home: &Home, stop: &AtomicBool) -> Watched {
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let mut subscribers = UNITS.map(|id| bus.subscriber(&id.parse::<StreamId>().unwrap()).unwrap());
    let mut seen = [Vec::new(), Vec::new()];
    while !stop.load(Ordering::SeqCst) {
        for (subscriber, seen) in subscribers.iter_mut().zip(&mut seen) {
            while let Some(frame) = subscriber.try_next().unwrap() {
                seen.push((*frame.header(), frame.motion().collect()));
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Watched(seen, subscribers.each_ref().map(depthrig_bus::Subscriber::missed))
}

/// Watches the units while `during` runs.
fn watched<T>(home: &Home, during: impl FnOnce() -> T) -> (T, Watched) {
    let stop = AtomicBool::new(false);
    std::thread::scope(|s| {
        let watcher = s.spawn(|| watch(home, &stop));
        // It is listening before anything is recorded.
        std::thread::sleep(Duration::from_millis(200));
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(during));
        stop.store(true, Ordering::SeqCst);
        let seen = watcher.join().unwrap();
        (result.unwrap_or_else(|panic| std::panic::resume_unwind(panic)), seen)
    })
}

/// Records for `length` after the first set, or for longer until there are enough batches; when it had begun, and where
/// it is.
fn record(rig: &Rig, into: &Path, length: Duration) -> (HostTime, PathBuf) {
    let request = RecordRequest { directory: Some(into.to_owned()), ..RecordRequest::default() };
    let recording = rig.control().record_start(&request).unwrap();
    let began = HostTime::now();
    let status = wait_until(rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.active && r.sets > 0));
    let before = UNITS.map(|id| unit(&status, id).in_sets.used);
    std::thread::sleep(length);
    // Of 25 a second; a busy computer has fewer.
    let enough = length.as_millis() as u64 / 50;
    wait_until(rig, "batches", |s| {
        UNITS.iter().zip(before).all(|(id, before)| unit(s, id).in_sets.used > before + enough)
    });
    let stopped = rig.control().record_stop().unwrap();
    assert_eq!((stopped.error, stopped.dropped.len()), (None, 0));
    (began, recording.path.into())
}

fn sets(data: &Path) -> Vec<DatasetSet> {
    let dataset = Dataset::open(data).unwrap();
    let units: Vec<_> = dataset.session().motion.iter().map(|m| m.id.to_string()).collect();
    assert_eq!(units, UNITS);
    assert!(dataset.session().streams.iter().all(|s| !s.format.is_motion()));
    assert_eq!(dataset.session().streams.len(), 4);
    dataset.sets(SetRange::ALL).map(Result::unwrap).collect()
}

/// The batches that the set thread came too late for on a busy computer.
fn missed_by_sets(status: &RigStatus, id: &str) -> u64 {
    unit(status, id).in_sets.missed
}

/// The batches that are missing between the first and the last.
fn gap(numbers: &[u64]) -> u64 {
    numbers[numbers.len() - 1] - numbers[0] + 1 - numbers.len() as u64
}

/// Compares the recorded batches of each IMU with those that a subscriber received. Returns their numbers.
fn check(
    sets: &[DatasetSet],
    Watched(seen, missed): &Watched,
    began: HostTime,
    status: &RigStatus,
) -> [Vec<u64>; 2] {
    let end_ns = sets.last().unwrap().tick.ns();
    core::array::from_fn(|unit| {
        let recorded: Vec<_> = sets
            .iter()
            .flat_map(|set| set.motion.iter().filter(|m| m.unit == unit).map(move |m| (set.id, m)))
            .collect();
        let numbers: Vec<_> = recorded.iter().map(|(_, m)| m.header.sequence).collect();
        assert!(numbers.is_sorted_by(|a, b| a < b), "{} in order and none twice: {numbers:?}", UNITS[unit]);
        let by_number: BTreeMap<_, _> =
            recorded.iter().map(|(set, m)| (m.header.sequence, (set, m))).collect();
        let (mut there, mut lacking) = (0, Vec::new());
        for (header, samples) in &seen[unit] {
            let inside = header.capture_time_ns > began.ns() && header.publish_time_ns < end_ns;
            let Some((set, m)) = by_number.get(&header.sequence) else {
                lacking.extend(inside.then_some(header.sequence));
                continue;
            };
            there += 1;
            assert_eq!(&m.samples, samples, "{} batch {}", UNITS[unit], header.sequence);
            assert_eq!(m.header, FrameHeader { set_id: **set, ..*header }, "{}", UNITS[unit]);
        }
        let may_lack = missed_by_sets(status, UNITS[unit]);
        assert!(lacking.len() as u64 <= may_lack, "{} lacks {lacking:?}, missed {may_lack}", UNITS[unit]);
        let unseen = numbers.len() as u64 - there;
        assert!(
            unseen <= missed[unit],
            "{}: {unseen} of what is recorded were not on the channel",
            UNITS[unit]
        );
        numbers
    })
}

fn unit<'s>(status: &'s RigStatus, id: &str) -> &'s StreamStatus {
    status.cameras.iter().flat_map(|c| &c.streams).find(|s| s.id == id).unwrap()
}

fn is_good(data: &Path) {
    let report = verify(data, &VerifyOptions::default()).unwrap();
    let bad: Vec<_> = report.findings.iter().filter(|f| f.severity != Severity::Note).collect();
    assert!(bad.is_empty(), "{bad:#?}");
}

#[test]
fn every_batch_of_a_recording_is_in_its_sets_once_and_in_order_and_the_next_recording_begins_anew() {
    let home = Home::default();
    let text = rig(5.0, |text| text);
    let rig = home.start(&text).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let (recorded, seen) = watched(&home, || {
        let began = ["one", "two"].map(|name| {
            let recorded = record(&rig, &home.path(name), Duration::from_millis(1500));
            std::thread::sleep(Duration::from_millis(300));
            recorded
        });
        for id in UNITS {
            let status = wait_until(&rig, "200 samples a second", |s| {
                unit(s, id).samples_hz.is_some_and(|hz| (hz - 200.0).abs() < 20.0)
            });
            let s = unit(&status, id);
            assert_eq!((s.format.as_str(), s.width), ("motion", 8));
        }
        began
    });
    let summary = rig.stop();
    assert_balanced(&summary.status);
    summary.status.cameras.iter().for_each(assert_undisturbed);
    let numbers: Vec<_> = recorded
        .iter()
        .map(|(began, data)| {
            is_good(data);
            check(&sets(data), &seen, *began, &summary.status)
        })
        .collect();
    for (i, id) in UNITS.iter().enumerate() {
        let [one, two] = [&numbers[0][i], &numbers[1][i]];
        assert!(one.len() > 30 && two.len() > 30, "{id}: {} and {}", one.len(), two.len());
        for all in [one, two] {
            assert!(gap(all) <= missed_by_sets(&summary.status, id), "{id} has a gap");
        }
        assert!(one[one.len() - 1] + 5 < two[0], "{id}: what came between them is in neither");
        let account = unit(&summary.status, id).in_sets;
        assert_eq!((account.used, account.overflow), ((one.len() + two.len()) as u64, 0));
    }
}

#[test]
fn a_unit_that_is_unplugged_goes_on_in_the_same_recording() {
    let home = Home::default();
    let text = rig(5.0, |text| text.fault("unplug", 3.0, "duration_s = 0.6").fault("skip", 1.2, "count = 3"));
    let rig = home.start(&text).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let ((began, data), seen) = watched(&home, || {
        let request = RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() };
        let recording = rig.control().record_start(&request).unwrap();
        let began = HostTime::now();
        wait_until(&rig, "unplugged", |s| {
            let right = camera(s, "right");
            right.state == CameraState::Reconnecting || right.reconnects > 0
        });
        wait_until(&rig, "back", |s| camera(s, "right").state == CameraState::Streaming);
        let before = UNITS.map(|id| unit(&rig.control().status(), id).in_sets.used);
        wait_until(&rig, "recorded again", |s| {
            UNITS.iter().zip(before).all(|(id, before)| unit(s, id).in_sets.used > before + 20)
        });
        rig.control().record_stop().unwrap();
        (began, PathBuf::from(recording.path))
    });
    let summary = rig.stop();
    assert_balanced(&summary.status);
    let sets = sets(&data);
    let [left, right] = check(&sets, &seen, began, &summary.status);
    // The other camera's sets go on, and its unit with them: 15 batches of 40 ms in the time that this one lacks.
    assert!(right.len() > 20 && left.len() > right.len() + 10, "{} and {}", left.len(), right.len());
    assert!(gap(&left) <= missed_by_sets(&summary.status, UNITS[0]), "left has a gap");
    let of_right: Vec<_> = sets.iter().flat_map(|s| &s.motion).filter(|m| m.unit == 1).collect();
    let epochs: Vec<_> = of_right.iter().map(|m| m.header.clock_epoch).collect();
    assert!(
        epochs.is_sorted() && epochs.first() < epochs.last(),
        "a device that starts afresh has a new map"
    );
    let samples: Vec<_> = of_right.iter().flat_map(|m| &m.samples).map(|s| s.sequence).collect();
    assert!(samples.is_sorted_by(|a, b| a < b), "the numbers of samples rise all the same");
    let skipped = unit(&summary.status, "right/imu").dropped.get("device_gap").copied();
    // A busy computer may be too late for more.
    assert!(skipped >= Some(3), "what the device skipped is counted as batches: {skipped:?}");
}

#[test]
fn rare_sets_lose_no_batch() {
    let home = Home::default();
    let rig = home.start(&rig(0.5, |text| text)).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let ((began, data), seen) =
        watched(&home, || record(&rig, &home.path("data"), Duration::from_millis(4200)));
    let summary = rig.stop();
    is_good(&data);
    let sets = sets(&data);
    assert!(
        sets.iter().skip(1).all(|s| s.motion.len() > 60),
        "two units of 25 batches a second, two seconds a set"
    );
    for (numbers, id) in check(&sets, &seen, began, &summary.status).iter().zip(UNITS) {
        assert!(gap(numbers) <= missed_by_sets(&summary.status, id), "{id} has a gap");
        assert_eq!(unit(&summary.status, id).in_sets.overflow, 0);
    }
}

/// The set thread is blocked for longer than the channel keeps batches: they are lost, and every count includes them.
#[test]
fn what_a_set_thread_that_is_behind_does_not_read_is_counted() {
    let home = Home::default();
    let slow = Arc::new(AtomicBool::new(false));
    let theirs = Arc::clone(&slow);
    let rig = home
        .start_with(&rig(5.0, |text| text), |options| {
            // Asked by the set thread for every set that it hands over.
            options.utc = Arc::new(move || {
                if theirs.swap(false, Ordering::SeqCst) {
                    // Shorter than what makes a set too late to be recorded, which would take its batches with it.
                    std::thread::sleep(Duration::from_millis(500));
                }
                UtcPair::sample()
            });
        })
        .unwrap();
    wait_until(&rig, "streaming", all_stream);
    let before = UNITS.map(|id| missed_by_sets(&rig.control().status(), id));
    let request = RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() };
    let data = rig.control().record_start(&request).unwrap().path;
    wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets > 2));
    slow.store(true, Ordering::SeqCst);
    std::thread::sleep(Duration::from_secs(2));
    rig.control().record_stop().unwrap();
    let summary = rig.stop();
    assert_balanced(&summary.status);
    let info = Dataset::open(data.as_ref()).unwrap().info().unwrap();
    let sets = sets(data.as_ref());
    let report = verify(data.as_ref(), &VerifyOptions::default()).unwrap();
    for (i, id) in UNITS.iter().enumerate() {
        let numbers: Vec<_> =
            sets.iter().flat_map(|s| &s.motion).filter(|m| m.unit == i).map(|m| m.header.sequence).collect();
        assert!(numbers.is_sorted_by(|a, b| a < b));
        let lost = gap(&numbers);
        let missed = missed_by_sets(&summary.status, id) - before[i];
        assert!(lost > 5, "{id}: the channel keeps four of some twenty: {lost}");
        // A busy computer may make it miss a few before the first or after the last that is recorded.
        assert!(lost == info.motion[i].lost_batches && lost <= missed, "{id}: {lost} of {missed}");
        let reported =
            report.findings.iter().any(|f| f.message.contains(id) && f.message.contains(&lost.to_string()));
        assert!(reported, "{id}: {lost} lost: {:#?}", report.findings);
    }
}

#[test]
fn a_recording_of_a_replay_has_the_motion_of_the_original() {
    let home = Home::default();
    let rig = home.start(&rig(5.0, |text| text)).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let (_, data) = record(&rig, &home.path("data"), Duration::from_millis(800));
    rig.stop();
    let options = ReplayOptions { as_fast_as_possible: true, paused: true, ..ReplayOptions::default() };
    let replay = Replay::start(std::slice::from_ref(&data), &home.runtime(), None, options).unwrap();
    let request = RecordRequest { directory: Some(home.path("again")), ..RecordRequest::default() };
    let again = PathBuf::from(replay.control().record_start(&request).unwrap().path);
    replay.control().replay().unwrap().resume().unwrap();
    let deadline = HostTime::now().plus(Duration::from_secs(20));
    while !replay.wait(Duration::from_millis(20)) {
        assert!(!deadline.from_now().is_zero(), "{:?}", replay.progress());
    }
    replay.stop();
    is_good(&again);
    let [before, after] = [&data, &again].map(|d| sets(d));
    assert_eq!(before.len(), after.len());
    for (a, b) in before.iter().zip(&after) {
        let batches = |s: &DatasetSet| -> Vec<_> {
            s.motion
                .iter()
                .map(|m| (m.unit, m.header.device_sequence, m.header.capture_time_ns, m.samples.clone()))
                .collect()
        };
        assert_eq!(batches(a), batches(b));
    }
    assert!(before.iter().map(|s| s.motion.len()).sum::<usize>() > 20);
    let [a, b] = [&data, &again].map(|d| Dataset::open(d).unwrap());
    let report =
        compare(&a, &b, &CompareOptions { pixels: PixelCheck::Stored, ..CompareOptions::default() }).unwrap();
    assert!(report.equal, "{:#?}", report.differences);
}
