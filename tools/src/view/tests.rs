//! Layout of the status text.

use super::*;
use depthrig_daemon::status::{ClockStatus, RefineStatus, SetAccount, SetStatus, SharedMemoryStatus};

fn stream(id: &str, lost: u64) -> StreamStatus {
    StreamStatus {
        id: id.into(),
        derived: false,
        format: "z16".into(),
        width: 1280,
        height: 720,
        nominal_hz: 30.0,
        rate_hz: 29.97,
        samples_hz: None,
        captured: 903,
        delivered: 903 - lost,
        dropped: [("device_gap".to_owned(), lost)].into(),
        last_frame_age_ms: Some(12.0),
        latency_p50_ms: 4.1,
        latency_p99_ms: 8.25,
        clock: ClockStatus {
            domain: "device".into(),
            metadata: "full".into(),
            rate_ppm: -12.3,
            uncertainty_us: 210.0,
            ..ClockStatus::default()
        },
        in_sets: SetAccount::default(),
    }
}

fn camera(name: &str, state: CameraState, message: Option<&str>, lost: u64) -> CameraStatus {
    CameraStatus {
        name: name.into(),
        backend: "synthetic".into(),
        model: "D435".into(),
        serial: "1".into(),
        firmware: String::new(),
        port: String::new(),
        calibration: "factory".into(),
        state,
        state_for_s: 2.5,
        message: message.map(Into::into),
        warnings: Vec::new(),
        reconnects: 0,
        refine: None,
        mount: None,
        streams: vec![stream(&format!("{name}/depth"), lost)],
    }
}

fn rig() -> RigStatus {
    RigStatus {
        rig: "mount".into(),
        version: "0.1.0".into(),
        pid: 42,
        uptime_s: 30.1,
        utc_ns: 0,
        preparing: None,
        cameras: vec![
            camera("d435", CameraState::Streaming, None, 0),
            camera("l515", CameraState::Reconnecting, Some("unplugged"), 3),
        ],
        sets: SetStatus { nominal_hz: 5.0, sent: 150, ..SetStatus::default() },
        recording: None,
        shared_memory: SharedMemoryStatus { free_bytes: 1 << 30, slots: 48, reserved_bytes: 1 << 29 },
        cpu_cores: 0.5,
        replay: None,
        signals: Vec::new(),
        link: None,
        hosts: None,
        ros2: None,
    }
}

#[test]
fn an_imu_has_no_image_and_the_rate_of_its_samples() {
    let mut rig = rig();
    let imu = StreamStatus {
        format: "motion".into(),
        width: 64,
        height: 1,
        nominal_hz: 6.25,
        rate_hz: 10.0,
        samples_hz: Some(400.0),
        ..stream("d435/imu", 0)
    };
    rig.cameras[0].streams.push(imu);
    for width in [80, 160] {
        let text = status(&rig, Style { width, color: false });
        let line = text.lines().find(|l| l.starts_with("d435/imu")).unwrap();
        let words: Vec<_> = line.split_whitespace().collect();
        assert!(words.contains(&"motion") && words.contains(&"400.0") && !line.contains("64x1"), "{line}");
    }
}

#[test]
fn superseded_refined_frames_are_not_lost() {
    let mut rig = rig();
    let refined = StreamStatus {
        derived: true,
        nominal_hz: 5.0,
        dropped: [("queue_full".to_owned(), 70), ("no_slot".to_owned(), 2)].into(),
        ..stream("d435/depth_refined", 0)
    };
    rig.cameras[0].streams.push(refined);
    rig.cameras[0].refine = Some(RefineStatus {
        state: RefineState::Running,
        state_for_s: 60.0,
        message: None,
        engine: "fill".into(),
        model: String::new(),
        nominal_hz: 5.0,
        rate_hz: 4.9,
        skipped: BTreeMap::new(),
        not_due: 1500,
        restarts: 0,
        steps_p50_ms: BTreeMap::new(),
        steps_p99_ms: BTreeMap::new(),
    });
    let text = status(&rig, Style { width: 160, color: false });
    let line = text.lines().find(|l| l.starts_with("d435/depth_refined")).unwrap();
    let words: Vec<_> = line.split_whitespace().collect();
    assert!(words.contains(&"2") && !words.contains(&"72"), "{line}");
    let line = text.lines().find(|l| l.starts_with("refined")).unwrap();
    assert!(line.contains("4.9 of 5.0 Hz (limited by rate_hz of [camera.refine]; camera 30.0 Hz)"), "{line}");
}

#[test]
fn a_status_says_what_matters_and_fits_80_columns() {
    let text = status(&rig(), Style { width: 80, color: false });
    for line in text.lines() {
        assert!(line.chars().count() <= 80, "{line}");
    }
    assert!(text.contains("d435/depth  streaming"), "{text}");
    assert!(
        text.ends_with("l515: reconnecting for 2.5 s: unplugged; l515/depth lost device_gap 3"),
        "{text}"
    );
    assert!(!text.contains('\x1b'));
}

#[test]
fn a_wide_one_has_more_columns() {
    let text = status(&rig(), Style { width: 140, color: false });
    let header = text.lines().find(|l| l.starts_with("stream")).unwrap();
    assert_eq!(
        header.split_whitespace().collect::<Vec<_>>().join(" "),
        "stream state image format Hz frames lost p50 ms p99 ms clock metadata ppm ±us"
    );
    let row = text.lines().find(|l| l.starts_with("l515/depth")).unwrap();
    assert_eq!(
        row.split_whitespace().collect::<Vec<_>>(),
        [
            "l515/depth",
            "reconnecting",
            "1280x720",
            "z16",
            "30.0",
            "900",
            "3",
            "4.1",
            "8.2",
            "device",
            "full",
            "-12.3",
            "210"
        ]
    );
}

#[test]
fn what_times_come_from_is_said_at_every_width() {
    let mut rig = rig();
    assert!(!status(&rig, Style { width: 80, color: false }).contains("metadata"));
    rig.cameras[0].streams[0].clock.metadata = "header".into();
    rig.cameras[0].streams[0].clock.metadata_lost = 4;
    for width in [80, 140] {
        let text = status(&rig, Style { width, color: false });
        assert!(text.contains("metadata  header only: d435/depth"), "{text}");
        assert!(text.contains("d435: d435/depth had 4 frames without metadata"), "{text}");
    }
}

#[test]
fn color_marks_what_is_wrong_and_clipping_keeps_it_whole() {
    let text = status(&rig(), Style { width: 80, color: true });
    let bad = text.lines().find(|l| l.contains("l515/depth  ")).unwrap();
    assert!(bad.starts_with(YELLOW) && bad.ends_with(RESET));
    assert_eq!(clip("\x1b[31mabcdef\x1b[0m", 3), "\x1b[31mabc\x1b[0m");
}

#[test]
fn the_clock_of_the_session_has_a_line_and_a_cure_if_it_does_not_answer() {
    let known = LinkStatus {
        host: "left".into(),
        insecure: false,
        recorder: Some("10.0.0.1:7447".into()),
        state: LinkState::Live,
        offset_s: Some(-1_234.567_890_1),
        uncertainty_us: Some(21.4),
        rate_ppm: Some(3.0),
        epoch: Some(1),
        round_trip_us: Some(40.0),
        age_s: Some(12.4),
        exchanges: 7,
        refused: 0,
    };
    let shown = |link: LinkStatus| {
        let text = status(&RigStatus { link: Some(link), ..rig() }, Style { width: 80, color: false });
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
        text
    };
    let live = shown(known.clone());
    assert!(live.contains("link    left: 10.0.0.1:7447 is -1234.567890 s, within 21 us\n"), "{live}");
    assert!(!live.contains("firewall"));
    let silent = shown(LinkStatus { state: LinkState::Silent, ..known.clone() });
    assert!(silent.contains("within 21 us, silent for 12 s\n") && silent.contains("firewall"), "{silent}");
    let unknown = shown(LinkStatus { state: LinkState::Unknown, offset_s: None, ..known.clone() });
    assert!(unknown.contains("10.0.0.1:7447 does not answer") && !unknown.contains("within"), "{unknown}");
    let unkeyed = shown(LinkStatus { state: LinkState::Unkeyed, offset_s: None, ..known.clone() });
    assert!(unkeyed.contains("10.0.0.1:7447 answers, but has given no key yet\n"), "{unkeyed}");
    let own = shown(LinkStatus { recorder: None, state: LinkState::Own, ..known });
    assert!(own.contains("link    left: the clock of the session is here, 7 questions answered"), "{own}");
}
