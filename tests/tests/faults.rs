//! A rig whose cameras fail: each failure is reported as such, and the other cameras are not affected.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::HostTime;
use depthrig_daemon::ErrorKind;
use depthrig_daemon::control::{Losses, RecordRequest};
use depthrig_daemon::status::{CameraState, RigStatus};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, camera, wait_until};
use std::time::Duration;

/// One camera with `fault` at 1 s and two without; runs until `seen` of the bad camera and it streams again.
fn run(kind: &str, more: &str, seen: impl Fn(&RigStatus) -> bool) -> RigStatus {
    run_at(1.0, kind, more, seen)
}

fn run_at(at_s: f64, kind: &str, more: &str, seen: impl Fn(&RigStatus) -> bool) -> RigStatus {
    let text =
        RigText::default().camera("good", "").camera("bad", "").fault(kind, at_s, more).camera("fine", "");
    // A stall is to last well beyond the time after which it is one, and to end before the camera is opened again.
    let stall_s = if kind == "stall" { "stall_s = 1.0" } else { "stall_s = 0.4" };
    let text = text.text().replace("stall_s = 0.4", stall_s);
    let home = Home::default();
    let rig = home.start(&text).unwrap();
    wait_until(&rig, kind, &seen);
    wait_until(&rig, "back to streaming", |s| camera(s, "bad").state == CameraState::Streaming);
    std::thread::sleep(Duration::from_millis(300));
    let summary = rig.stop();
    for name in ["good", "fine"] {
        assert_undisturbed(camera(&summary.status, name));
    }
    assert_balanced(&summary.status);
    summary.status
}

fn lost(status: &RigStatus, reason: &str) -> u64 {
    camera(status, "bad").streams.iter().map(|s| s.dropped.get(reason).copied().unwrap_or(0)).sum()
}

#[test]
fn an_unplugged_camera_comes_back() {
    let status = run("unplug", "duration_s = 0.8", |s| {
        camera(s, "bad").state == CameraState::Reconnecting || camera(s, "bad").reconnects > 0
    });
    assert_eq!(camera(&status, "bad").reconnects, 1);
    assert!(
        camera(&status, "bad").streams[0].clock.epoch >= 1,
        "a device that starts afresh has a new clock map"
    );
}

#[test]
fn a_camera_that_is_lost_before_it_was_seen_to_stream_came_back() {
    let status = run_at(0.001, "unplug", "duration_s = 0.05", |s| camera(s, "bad").reconnects > 0);
    assert_eq!(camera(&status, "bad").reconnects, 1);
}

#[test]
fn a_stalled_camera_is_seen_and_comes_back() {
    let status = run("stall", "duration_s = 2.5", |s| camera(s, "bad").state == CameraState::Stalled);
    assert_eq!(camera(&status, "bad").reconnects, 0, "a short stall needs no reconnect");
    assert!(lost(&status, "device_gap") > 0, "the frames of the stall are lost and counted");
}

#[test]
fn a_hung_driver_is_given_up_and_its_successor_streams() {
    let status = run("hang", "duration_s = 3.0", |s| {
        let bad = camera(s, "bad");
        bad.message.as_deref().is_some_and(|m| m.contains("hangs")) || bad.reconnects > 0
    });
    assert!(camera(&status, "bad").reconnects >= 1);
}

#[test]
fn broken_frames_are_dropped_and_counted() {
    for (kind, reason) in [
        ("half_frame", "incomplete"),
        ("wrong_size", "wrong_size"),
        ("damaged", "device_error"),
        ("skip", "device_gap"),
    ] {
        // Frames come 30 times a second: those of the fault were there.
        let status = run(kind, "count = 3", |s| {
            let streams = &camera(s, "bad").streams;
            !streams.is_empty() && streams.iter().all(|s| s.captured > 45)
        });
        // On a busy computer some of them may be lost in the device first, and others with them.
        let n = lost(&status, reason);
        let gaps = if kind == "skip" { 0 } else { lost(&status, "device_gap") };
        assert!(n + gaps >= 6, "three frames of two streams each: {kind}, not {n} with {gaps} lost before");
        assert!(n <= 6 || kind == "skip", "three frames of two streams each: {kind}, not {n}");
    }
}

/// Frames that a camera loses are in the history of the recording by reason, sets that lack them by stream.
#[test]
fn a_recording_knows_when_it_lost_something() {
    let text = RigText::default().camera("good", "").camera("bad", "").fault("damaged", 4.0, "count = 60");
    let home = Home::default();
    let rig = home.start(text.text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let control = rig.control();
    assert_eq!(control.record_losses(), None, "nothing was recorded yet");
    let request = RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() };
    control.record_start(&request).unwrap();
    let seen = |s: &RigStatus| {
        let recording = s.recording.as_ref();
        recording.is_some_and(|r| {
            r.missing.contains_key("bad/color") && r.frames_dropped.contains_key("device_error")
        })
    };
    wait_until(&rig, "losses", seen);
    wait_until(&rig, "all damaged frames", |s| {
        // A busy computer may lose some of them before.
        lost(s, "device_error") + lost(s, "device_gap") >= 120
    });
    let stopped = control.record_stop().unwrap();
    let losses = control.record_losses().unwrap();
    rig.stop();
    let mut sum = Losses::default();
    for bucket in &losses.buckets {
        for (to, from) in [
            (&mut sum.sets, &bucket.losses.sets),
            (&mut sum.missing, &bucket.losses.missing),
            (&mut sum.frames, &bucket.losses.frames),
        ] {
            for (reason, n) in from {
                *to.entry(reason.clone()).or_default() += n;
            }
        }
    }
    assert_eq!(losses.path, stopped.path);
    assert_eq!(
        sum,
        Losses { sets: stopped.dropped, missing: stopped.missing, frames: stopped.frames_dropped }
    );
    assert!(sum.frames["device_error"] <= 120 && sum.missing["bad/color"] > 0, "{sum:?}");
    // A busy computer may be late with a few.
    let mut good = sum.missing.iter().filter(|(stream, _)| stream.starts_with("good/"));
    assert!(good.all(|(_, n)| *n < sum.missing["bad/color"]), "{sum:?}");
}

#[test]
fn time_going_backwards_is_a_new_epoch_or_flagged() {
    let status = run("time_backwards", "duration_s = 5.0", |s| {
        let stream = &camera(s, "bad").streams[0];
        stream.clock.uncertain_frames > 0 || stream.clock.epoch > 0
    });
    assert!(camera(&status, "bad").streams.iter().all(|s| s.clock.epoch > 0 || s.clock.uncertain_frames > 0));
}

#[test]
fn a_rig_stops_within_a_second_even_when_a_driver_hangs() {
    let text = RigText::default().camera("bad", "").fault("hang", 0.5, "duration_s = 8.0").camera("good", "");
    let home = Home::default();
    let rig = home.start(text.text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    std::thread::sleep(Duration::from_millis(700));
    let began = HostTime::now();
    let summary = rig.stop();
    assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
    assert_balanced(&summary.status);
}

#[test]
fn settings_that_cannot_work_fail_the_start_and_name_every_camera() {
    let files = |name: &str| {
        format!("[[camera]]\nname = \"{name}\"\nbackend = \"files\"\nmanifest = \"/nowhere/{name}.toml\"\n")
    };
    let text = RigText::default().camera("one", "").text().to_owned() + &files("two") + &files("three");
    let home = Home::default();
    let Err(e) = home.start(&text) else { panic!("it started") };
    assert_eq!(e.kind(), ErrorKind::NotFound);
    let message = e.to_string();
    for part in ["2 cameras", "\"two\"", "/nowhere/two.toml", "\"three\"", "/nowhere/three.toml"] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn a_rig_runs_once() {
    let text = RigText::default().camera("cam", "");
    let home = Home::default();
    let rig = home.start(text.text()).unwrap();
    let Err(e) = home.start(text.text()) else { panic!("it started twice") };
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains(&format!("process {}", std::process::id())), "{e}");
    drop(rig);
    home.start(text.text()).unwrap();
}
