//! Text and exit code of the demo's report, for each outcome.

use super::*;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_daemon::status::{ClockStatus, RecordingStatus, RefineStatus, SetAccount};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    RecordFrame, RecordSet, Recorder, RecorderOptions, Session, StreamRecord, Summary, VerifyOptions, verify,
};
use std::path::Path;
use std::sync::Arc;

/// A dataset in `dir` with `sets` sets of one small depth image.
fn recorded(dir: &Path, sets: u64) -> Summary {
    let mut session = Session::new("demo", "rig");
    session.streams = vec![StreamRecord {
        id: "d435/depth".parse().unwrap(),
        model: String::new(),
        serial: String::new(),
        format: PixelFormat::Z16,
        width: 8,
        height: 8,
        rate_hz: 30.0,
        depth_unit_m: 0.001,
        calibration: String::new(),
        intrinsics: Intrinsics::default(),
        pose: Pose::IDENTITY,
    }];
    let options = RecorderOptions { min_free_bytes: 0, ..RecorderOptions::default() };
    let recorder = Recorder::create(Arc::new(RealFs), dir, session, options).unwrap();
    for id in 1..=sets {
        let mut header = FrameHeader::default();
        header.set_image(PixelFormat::Z16, 8, 8);
        header.set_names("rig", &"d435/depth".parse().unwrap());
        header.sequence = id;
        header.captured = id;
        header.depth_unit_m = 0.001;
        header.capture_time_ns = id as i64 * 200_000_000;
        let tick = HostTime::from_ns(header.capture_time_ns);
        recorder
            .push(RecordSet {
                id,
                tick,
                utc: UtcPair { mono: HostTime::from_ns(0), utc_ns: 1_700_000_000_000_000_000, width_ns: 1 },
                frames: vec![RecordFrame { stream: 0, header, pixels: Box::new(vec![1; 128]) }],
                missing: vec![],
                motion: Vec::new(),
                signals: Vec::new(),
                spread_ns: 0,
            })
            .unwrap();
    }
    recorder.finish().unwrap()
}

fn stream(id: &str, delivered: u64) -> StreamStatus {
    StreamStatus {
        id: id.to_owned(),
        derived: false,
        format: "z16".to_owned(),
        width: 8,
        height: 8,
        nominal_hz: 30.0,
        rate_hz: 30.0,
        samples_hz: None,
        captured: delivered,
        delivered,
        dropped: BTreeMap::new(),
        last_frame_age_ms: None,
        latency_p50_ms: 1.0,
        latency_p99_ms: 1.0,
        clock: ClockStatus::default(),
        in_sets: SetAccount::default(),
    }
}

fn status() -> RigStatus {
    let camera = CameraStatus {
        name: "d435".to_owned(),
        backend: "synthetic".to_owned(),
        model: "D435".to_owned(),
        serial: String::new(),
        firmware: String::new(),
        port: String::new(),
        calibration: String::new(),
        state: CameraState::Streaming,
        state_for_s: 1.0,
        message: None,
        warnings: Vec::new(),
        reconnects: 0,
        streams: vec![stream("d435/color", 5), stream("d435/depth", 5)],
        refine: None,
        mount: None,
    };
    RigStatus {
        rig: "rig".to_owned(),
        version: String::new(),
        pid: 1,
        uptime_s: 1.0,
        utc_ns: 0,
        preparing: None,
        cameras: vec![camera],
        sets: depthrig_daemon::status::SetStatus::default(),
        recording: Some(RecordingStatus::default()),
        shared_memory: depthrig_daemon::status::SharedMemoryStatus::default(),
        cpu_cores: 0.0,
        replay: None,
        link: None,
        hosts: None,
        ros2: None,
        signals: Vec::new(),
    }
}

/// A demo in which nothing was lost and nothing is wrong, whose dataset lies in `dir`.
fn good(dir: &Path) -> DemoReport {
    let dataset = dir.join("dataset");
    let recording = Some(recorded(&dataset, 2));
    DemoReport {
        start_s: 1.0,
        stop_s: 0.1,
        live: status(),
        depth: BTreeMap::new(),
        refined: BTreeMap::new(),
        seeded: Seeded::default(),
        units_mm: BTreeMap::new(),
        recorded: BTreeMap::from([("d435".to_owned(), 2)]),
        signals: Vec::new(),
        unavailable: Vec::new(),
        untrained: Vec::new(),
        sets_seen: 2,
        frames_unread: 0,
        summary: RigSummary { status: status(), recording, lost: Vec::new() },
        verify: verify(&dataset, &VerifyOptions::default()).unwrap(),
        replay: Replayed { depth_equal: 2, ..Replayed::default() },
        quality_report: dataset.join("report.html"),
        dataset,
        segments: Vec::new(),
        contact_sheet: dir.join("contact-sheet.png"),
    }
}

/// Lines of the report that begin with `start`.
fn lines<'a>(text: &'a str, start: &str) -> Vec<&'a str> {
    text.lines().filter(|line| line.starts_with(start)).collect()
}

#[test]
fn a_demo_without_a_loss_is_good_and_says_nothing_of_one() {
    let dir = tempfile::tempdir().unwrap();
    let report = good(dir.path());
    assert_eq!(report.exit(), Exit::Good);
    let text = report.text();
    assert_eq!((lines(&text, "LOOK wrong").len(), lines(&text, "note lost").len()), (0, 0), "{text}");
    assert_eq!(lines(&text, "ok   record").len(), 1, "{text}");
}

/// Frames lost on a busy computer are counted and listed, but are not a failure.
#[test]
fn lost_frames_are_one_line_and_no_failure() {
    let dir = tempfile::tempdir().unwrap();
    let mut report = good(dir.path());
    let status = &mut report.summary.status;
    status.cameras[0].streams[0].dropped.insert("queue_full".to_owned(), 3);
    status.cameras[0].streams[1].dropped.insert("device_gap".to_owned(), 4);
    let recording = status.recording.as_mut().unwrap();
    recording.dropped = BTreeMap::from([("encoder_busy".to_owned(), 2), ("disk_slow".to_owned(), 1)]);
    report.replay.lost.push("a read".to_owned());
    assert_eq!(report.exit(), Exit::Good);
    let text = report.text();
    let notes = lines(&text, "note lost");
    assert_eq!((notes.len(), lines(&text, "LOOK wrong").len()), (1, 0), "{text}");
    for what in
        ["7 frames of d435", "3 sets of the recording", "1 reads of the replay", "close other programs"]
    {
        assert!(notes[0].contains(what), "{what}: {}", notes[0]);
    }
}

#[test]
fn a_recording_that_is_not_what_it_should_be_is_a_failure() {
    let dir = tempfile::tempdir().unwrap();
    let mut report = good(dir.path());
    assert_eq!(report.recording_fault(), None);
    let drop = |report: &mut DemoReport, reason: &str| {
        let recording = report.summary.status.recording.as_mut().unwrap();
        recording.dropped = BTreeMap::from([(reason.to_owned(), 6)]);
    };
    for reason in SetDrop::ALL {
        drop(&mut report, reason.name());
        let is_busy = [SetDrop::EncoderBusy, SetDrop::DiskSlow].contains(&reason);
        let fault = report.recording_fault();
        assert_eq!(fault.is_none(), is_busy, "{}: {fault:?}", reason.name());
        assert!(fault.is_none_or(|f| f.contains(&format!("6 sets {}", reason.name()))));
        assert_eq!(report.exit(), if is_busy { Exit::Good } else { Exit::Failed });
    }
    drop(&mut report, "disk_full");
    report.summary.status.recording.as_mut().unwrap().error = Some("the disk is full".to_owned());
    let wrong = "the recording: 6 sets disk_full; the disk is full";
    assert_eq!(report.recording_fault().as_deref(), Some(wrong));
    assert!(report.text().contains(&format!("LOOK wrong    {wrong}")), "{}", report.text());
    // Nothing in it, and nothing at all.
    report.summary.status.recording = Some(RecordingStatus::default());
    report.summary.recording = Some(recorded(&dir.path().join("empty"), 0));
    assert_eq!(report.recording_fault().as_deref(), Some("the recording: no set came"));
    report.summary.recording = None;
    assert_eq!(report.recording_fault().as_deref(), Some("nothing was recorded"));
    assert_eq!(report.exit(), Exit::Failed);
}

#[test]
fn whatever_is_wrong_is_a_line_and_a_failure() {
    let dir = tempfile::tempdir().unwrap();
    let failed = |change: &dyn Fn(&mut DemoReport), expected: &str| {
        let dir = tempfile::tempdir_in(dir.path()).unwrap();
        let mut report = good(dir.path());
        change(&mut report);
        assert_eq!(report.exit(), Exit::Failed, "{expected}");
        let text = report.text();
        let wrong = lines(&text, "LOOK wrong");
        assert!(wrong.len() == 1 && wrong[0].contains(expected), "{expected}: {wrong:?}");
    };
    failed(
        &|r| {
            let camera = &mut r.summary.status.cameras[0];
            camera.state = CameraState::Failed;
            camera.message = Some("unplugged".to_owned());
        },
        "camera d435 failed: unplugged",
    );
    failed(
        &|r| {
            r.summary.status.cameras[0].refine = Some(RefineStatus {
                state: RefineState::Failed,
                state_for_s: 1.0,
                message: None,
                engine: String::new(),
                model: String::new(),
                nominal_hz: 1.0,
                rate_hz: 0.0,
                skipped: BTreeMap::new(),
                not_due: 0,
                restarts: 0,
                steps_p50_ms: BTreeMap::new(),
                steps_p99_ms: BTreeMap::new(),
            });
        },
        "camera d435: no refined depth: no reason known",
    );
    failed(&|r| r.summary.status.cameras[0].streams[1] = stream("d435/depth", 0), "d435 gave no frame");
    failed(&|r| r.replay.depth_different = 1, "the replay differs from what was live");
    failed(&|r| r.replay.depth_equal = 0, "the replay differs from what was live");
    failed(&|r| r.replay.wrong_headers = 1, "the replay differs from what was live");
    failed(
        &|r| {
            let segment = r.dataset.join("seg_0000.mcap");
            let mut bytes = std::fs::read(&segment).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            std::fs::write(&segment, bytes).unwrap();
            r.verify = verify(&r.dataset, &VerifyOptions::default()).unwrap();
        },
        "the dataset: ",
    );
}

/// Parts that this computer cannot run are listed with the reason, and are not a failure.
#[test]
fn what_cannot_be_shown_is_named_and_is_no_failure() {
    let dir = tempfile::tempdir().unwrap();
    let mut report = good(dir.path());
    report.unavailable.push("zed2i neural is unavailable, because ONNX Runtime was not found".to_owned());
    report.seeded.missing = Some("ONNX Runtime was not found".to_owned());
    assert_eq!(report.exit(), Exit::Good);
    let text = report.text();
    let [mode, model] = ["--   mode ", "--   model"].map(|start| lines(&text, start));
    assert!(
        mode.len() == 1 && mode[0].contains("zed2i neural is unavailable, because ONNX Runtime"),
        "{text}"
    );
    assert!(model.len() == 1 && model[0].contains("is not shown: ONNX Runtime was not found"), "{text}");
}

#[test]
fn what_gives_way_by_design_is_not_lost() {
    let dropped = BTreeMap::from([("queue_full".to_owned(), 7), ("device_error".to_owned(), 2)]);
    assert_eq!(lost("d435/depth", &dropped), 9);
    assert_eq!(lost("zed2i/depth_ultra", &dropped), 2);
    assert_eq!(lost("zed2i/confidence_ultra", &dropped), 2);
}

#[test]
fn the_modes_of_a_dataset_are_its_depth_streams() {
    let found = modes([("d435/color", 5), ("d435/depth", 4), ("zed2i/depth_ultra", 3), ("zed2i/left", 5)]);
    let wanted = [("d435".to_owned(), 4), ("zed2i ultra".to_owned(), 3)];
    assert_eq!(found, BTreeMap::from(wanted));
}
