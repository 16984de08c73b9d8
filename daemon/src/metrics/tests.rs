//! The whole text of a scrape, against a golden file that a person has read.

use super::*;
use crate::status::CameraStatus;
use crate::status::SharedMemoryStatus;
use std::collections::BTreeSet;

fn refine() -> RefineStatus {
    let steps = |ms: f64| [("infer", ms), ("register", ms / 10.0)].map(|(s, ms)| (s.to_owned(), ms)).into();
    RefineStatus {
        state: RefineState::Running,
        state_for_s: 4.0,
        message: None,
        engine: "onnxruntime 1.31.1 cpu fp32".into(),
        model: "cdm-d435@1f2e3d4c".into(),
        nominal_hz: 5.0,
        rate_hz: 4.5,
        skipped: [("busy".to_owned(), 3)].into(),
        not_due: 77,
        restarts: 1,
        steps_p50_ms: steps(200.0),
        steps_p99_ms: steps(300.0),
    }
}

#[allow(clippy::too_many_lines)] // one literal
fn rig() -> RigStatus {
    let stream = |id: &str, dropped: &[(&str, u64)]| StreamStatus {
        id: id.into(),
        derived: id.ends_with("_refined"),
        format: "z16".into(),
        width: 1280,
        height: 720,
        nominal_hz: 30.0,
        rate_hz: 29.5,
        samples_hz: None,
        captured: 103,
        delivered: 100,
        dropped: dropped.iter().map(|(r, n)| ((*r).to_owned(), *n)).collect(),
        last_frame_age_ms: Some(12.5),
        latency_p50_ms: 4.0,
        latency_p99_ms: 9.0,
        clock: ClockStatus {
            domain: "device".into(),
            metadata: "full".into(),
            metadata_lost: 8,
            epoch: 2,
            rate_ppm: 31.0,
            uncertainty_us: 250.0,
            residual_p50_us: 80.0,
            residual_p99_us: 900.0,
            uncertain_frames: 6,
        },
        in_sets: SetAccount {
            used: 16,
            decimated: 80,
            late: 1,
            out_of_order: 0,
            overflow: 0,
            missed: 2,
            pending: 1,
            unread: 0,
        },
    };
    let camera = |name: &str, state, streams| CameraStatus {
        name: name.into(),
        backend: "synthetic".into(),
        model: "D435".into(),
        serial: "a\"b\\c\nd".into(),
        firmware: "1.2".into(),
        port: String::new(),
        calibration: "simulated".into(),
        state,
        state_for_s: 3.5,
        message: None,
        warnings: Vec::new(),
        reconnects: 1,
        refine: (name == "d435").then(refine),
        mount: None,
        streams,
    };
    RigStatus {
        rig: "mount".into(),
        version: "0.1.0".into(),
        pid: 42,
        uptime_s: 20.25,
        utc_ns: 1_700_000_000_000_000_000,
        preparing: None,
        cameras: vec![
            camera(
                "d435",
                CameraState::Streaming,
                vec![
                    stream("d435/color", &[]),
                    stream("d435/depth", &[("no_slot", 2), ("of_a_later_version", 1)]),
                    stream("d435/depth_refined", &[("queue_full", 3)]),
                ],
            ),
            camera("d405", CameraState::Reconnecting, vec![]),
        ],
        sets: SetStatus {
            nominal_hz: 5.0,
            sent: 100,
            incomplete: 3,
            spread_p50_ms: 8.0,
            spread_p95_ms: 15.0,
            spread_p99_ms: 16.0,
            spread_max_ms: 20.0,
            skews: Vec::new(),
        },
        recording: Some(RecordingStatus {
            active: true,
            sets: 50,
            frames: 700,
            bytes: 123_456_789_012,
            segments: 2,
            duration_s: 10.0,
            dropped: [("backlog_full".to_owned(), 1)].into(),
            disk_free_bytes: 5_000_000_000,
            disk_seconds_left: Some(610.5),
            error: Some("1 set was lost".into()),
            ..RecordingStatus::default()
        }),
        shared_memory: SharedMemoryStatus { free_bytes: 8 << 30, slots: 48, reserved_bytes: 3 << 30 },
        cpu_cores: 0.75,
        replay: None,
        signals: Vec::new(),
        link: None,
        hosts: None,
        ros2: None,
    }
}

#[test]
fn a_scrape_is_the_golden_text() {
    let text = render(&rig());
    assert!(
        text == include_str!("golden.txt"),
        "the metrics changed; if they should have, this is the new golden.txt:\n{text}"
    );
}

/// The rules of OpenMetrics and of good Prometheus names, checked on the text itself.
#[test]
fn names_and_order_follow_the_rules() {
    let text = render(&rig());
    assert!(text.ends_with("# EOF\n"));
    let mut families: Vec<(String, String)> = Vec::new();
    let mut samples = BTreeSet::new();
    for line in text.lines().filter(|l| *l != "# EOF") {
        if let Some(help) = line.strip_prefix("# HELP ") {
            let (_, what) = help.split_once(' ').unwrap();
            assert!(what.len() > 5 && what.ends_with('.'), "{line}");
        } else if let Some((name, kind)) = line.strip_prefix("# TYPE ").and_then(|l| l.split_once(' ')) {
            assert!(name.starts_with("depthrig_") && !name.ends_with("_total"), "{name}");
            assert!(families.iter().all(|(n, _)| n != name), "{name} comes in two pieces");
            for unit in ["_ms", "_us", "_ppm", "_mb", "_hz", "_ns"] {
                assert!(!name.ends_with(unit), "{name} is not in a base unit");
            }
            families.push((name.to_owned(), kind.to_owned()));
        } else if !line.starts_with('#') {
            let (series, value) = line.rsplit_once(' ').unwrap();
            let (name, kind) = families.last().unwrap();
            let suffix = if kind == "counter" { "_total" } else { "" };
            assert_eq!(series.split('{').next().unwrap(), format!("{name}{suffix}"), "{line}");
            assert!(value.parse::<f64>().unwrap().is_finite(), "{line}");
            assert!(samples.insert(series.to_owned()), "{series} is there twice");
        }
    }
    assert!(families.len() > 30);
}

#[test]
fn losses_are_series_before_the_first_one() {
    let text = render(&rig());
    for reason in DropReason::ALL {
        let series = format!(
            "depthrig_frames_dropped_total{{camera=\"d435\",stream=\"color\",reason=\"{}\"}} 0\n",
            reason.name()
        );
        assert!(text.contains(&series), "{series}");
    }
    assert!(text.contains("stream=\"depth\",reason=\"of_a_later_version\"} 1\n"));
}
