//! Attached Kinects in a running rig, through a fake libk4a that the configuration names: what reaches the bus and a
//! recording; cameras that are pulled out, held by others, wired together, without a library or a depth engine.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "../../drivers/kinect/tests/support/kinect.rs"]
mod fake;

use depthrig_bus::{Bus, FrameFlags, PixelFormat, RigName};
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::rig::Rig;
use depthrig_daemon::status::{CameraState, CameraStatus, RigStatus};
use depthrig_recorder::{Dataset, PixelMode, Severity, VerifyOptions, verify};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, camera, wait_until};
use fake::Fake;
use std::path::Path;
use std::time::Duration;

const A: &str = "000111111111";
const B: &str = "000222222222";
const SECOND: u64 = 1_000_000_000;

/// The table of a Kinect `name` of the library at `library`: small images at 15 Hz.
fn kinect(name: &str, library: &Path, extra: &str) -> String {
    let library = library.display();
    format!(
        "[[camera]]\nname = \"{name}\"\nbackend = \"kinect\"\nlibrary = \"{library}\"\n{extra}\n\
         [[camera.stream]]\nname = \"color\"\nwidth = 1280\nheight = 720\nrate_hz = 15.0\nformat = \"mjpeg\"\n\
         [[camera.stream]]\nname = \"depth\"\nwidth = 320\nheight = 288\n\
         [[camera.stream]]\nname = \"ir\"\n"
    )
}

/// A rig of a Kinect and a synthetic camera, `good`, beside it.
fn rig_text(fake: &Fake, extra: &str) -> String {
    RigText::default().camera("good", "").and(&kinect("k", &fake.folder(), extra)).text().to_owned()
}

fn k(status: &RigStatus) -> &CameraStatus {
    camera(status, "k")
}

fn says(status: &RigStatus, name: &str, part: &str) -> bool {
    camera(status, name).message.as_deref().is_some_and(|m| m.contains(part))
}

fn delivered(status: &RigStatus, name: &str) -> u64 {
    camera(status, name).streams.iter().map(|s| s.delivered).min().unwrap_or(0)
}

/// Ends the rig: everything balances, the camera beside lost nothing, and libk4a has everything back.
fn stop(rig: Rig, fakes: &[&Fake]) -> RigStatus {
    let status = rig.stop().status;
    if let Some(good) = status.cameras.iter().find(|c| c.name == "good") {
        assert_undisturbed(good);
    }
    assert_balanced(&status);
    for fake in fakes {
        let c = fake.census();
        assert_eq!((c.cameras, c.captures, c.images, c.misuse), (0, 0, 0, 0), "{c:?}");
    }
    status
}

#[test]
fn a_kinect_reaches_the_bus_and_a_recording_that_verifies() {
    let home = Home::default();
    let fake = Fake::new(&[A]);
    let rig = home.start(&rig_text(&fake, &format!("serial = \"{A}\""))).unwrap();
    let status = wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "k") > 2);
    let c = k(&status);
    assert_eq!((c.model.as_str(), c.serial.as_str()), ("Azure Kinect", A));
    assert_eq!((c.firmware.as_str(), c.calibration.as_str()), ("color 1.6.110, depth 1.6.79", "factory"));
    // A subscriber reads an image that the camera made.
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let mut depth = bus.subscriber(&"k/depth".parse().unwrap()).unwrap();
    let frame = depth.next_timeout(Duration::from_secs(20)).unwrap().unwrap();
    assert!(fake_k4a::images::is_genuine(fake_k4a::abi::DEPTH16, 320, 288, frame.pixels()));
    assert!((frame.header().depth_unit_m - 0.001).abs() < 1e-9);
    drop((frame, depth));
    let request = RecordRequest {
        directory: Some(home.path("")),
        name: Some("made".into()),
        force: true,
        ..<_>::default()
    };
    rig.control().record_start(&request).unwrap();
    wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 6));
    rig.control().record_stop().unwrap();
    let status = stop(rig, &[&fake]);
    assert_eq!((k(&status).reconnects, k(&status).state), (0, CameraState::Stopped));
    let out = home.path("made");
    let verified = verify(&out, &VerifyOptions { decode: true, ..<_>::default() }).unwrap();
    // The encoders of a busy computer may be too late for a set.
    let busy = " sets were not recorded: encoder_busy";
    let bad = verified.findings.iter().any(|f| f.severity != Severity::Note && !f.message.ends_with(busy));
    assert!(!bad, "{verified:?}");
    let dataset = Dataset::open(&out).unwrap();
    let of_k: Vec<_> =
        dataset.session().streams.iter().filter(|s| s.id.to_string().starts_with("k/")).collect();
    let formats: Vec<_> = of_k.iter().map(|s| s.format).collect();
    assert_eq!(formats, [PixelFormat::Mjpeg, PixelFormat::Z16, PixelFormat::Mono16]);
    assert!(of_k.iter().all(|s| s.serial == A && s.intrinsics.is_known()));
    let mut reader = dataset.set_reader().unwrap();
    let mut genuine = 0;
    for i in 0..reader.times().len() {
        for f in reader.read(i, PixelMode::Decoded).unwrap().frames {
            if dataset.session().streams[f.stream].id.to_string() == "k/depth" {
                assert!(fake_k4a::images::is_genuine(fake_k4a::abi::DEPTH16, 320, 288, &f.pixels));
                genuine += 1;
            }
        }
    }
    assert!(genuine >= 3, "{genuine} images of depth in six sets, which may lack some");
}

#[test]
fn an_unplugged_camera_is_reported_and_streams_again_when_it_is_back() {
    let home = Home::default();
    let fake = Fake::new(&[A]);
    // Each message is there for a second, long enough to be read.
    let text = rig_text(&fake, "").replace("backoff_max_s = 0.5", "backoff_min_s = 1.0\nbackoff_max_s = 1.0");
    let rig = home.start(&text).unwrap();
    wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "k") > 5);
    fake.command(A, "unplug", 4 * SECOND);
    let status = wait_until(&rig, "the loss", |s| says(s, "k", "it stopped sending, and is unplugged"));
    assert!(says(&status, "k", A) && k(&status).state == CameraState::Reconnecting, "{:?}", k(&status));
    wait_until(&rig, "word that none is there", |s| says(s, "k", "there is no Azure Kinect"));
    let before = delivered(&rig.control().status(), "k");
    wait_until(&rig, "frames again", |s| all_stream(s) && delivered(s, "k") > before + 5);
    let status = stop(rig, &[&fake]);
    assert_eq!(k(&status).reconnects, 1);
    assert!(k(&status).streams.iter().all(|s| s.clock.epoch >= 1), "a clock that may have begun anew");
}

#[test]
fn captures_that_are_damaged_on_their_way_are_counted_and_nothing_is_held() {
    let home = Home::default();
    let fake = Fake::new(&[A]);
    let rig = home.start(&rig_text(&fake, "")).unwrap();
    wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "k") > 2);
    let lost = |s: &RigStatus, reason: &str| {
        k(s).streams.iter().map(|x| x.dropped.get(reason).copied().unwrap_or(0)).min().unwrap_or(0)
    };
    let troubles = [("half", 2, "incomplete"), ("damaged", 3, "device_error"), ("skip", 4, "device_gap")];
    for (trouble, n, reason) in troubles {
        fake.command(A, trouble, n);
        // A slow machine may leave captures lying, which are gaps too.
        wait_until(&rig, reason, |s| lost(s, reason) >= n);
    }
    let status = rig.control().status();
    assert_eq!((lost(&status, "incomplete"), lost(&status, "device_error")), (2, 3), "{:?}", k(&status));
    let before = delivered(&status, "k");
    wait_until(&rig, "good ones", |s| delivered(s, "k") > before + 5);
    stop(rig, &[&fake]);
}

#[test]
fn without_libk4a_the_rig_says_what_to_install() {
    let home = Home::default();
    let empty = home.path("nothing");
    std::fs::create_dir_all(&empty).unwrap();
    let text = RigText::default().camera("good", "").and(&kinect("k", &empty, ""));
    let e = home.start(text.text()).map(Rig::stop).err().unwrap().to_string();
    for part in ["k", "is not at", "libk4a1.4", "packages.microsoft.com", "`library`"] {
        assert!(e.contains(part), "{part} in {e}");
    }
    // The rig without it starts.
    let rig = home.start(RigText::default().camera("good", "").text()).unwrap();
    wait_until(&rig, "the other camera", all_stream);
    stop(rig, &[]);
}

#[test]
fn without_a_depth_engine_there_is_colour_or_a_word_of_what_is_missing() {
    let home = Home::default();
    let fake = Fake::without_engine(&[A]);
    let nowhere = home.path("nowhere");
    std::fs::create_dir_all(&nowhere).unwrap();
    let engine = format!("depth_engine = \"{}\"", nowhere.display());
    let e = home.start(&rig_text(&fake, &engine)).map(Rig::stop).err().unwrap().to_string();
    for part in [A, "the depth engine (libdepthengine.so.2.0)", "colour alone", "libk4a1.4", "`depth_engine`"]
    {
        assert!(e.contains(part), "{part} in {e}");
    }
    let color = "[[camera.stream]]\nname = \"color\"\nwidth = 1280\nheight = 720\nformat = \"yuyv\"\n";
    let table = format!(
        "[[camera]]\nname = \"k\"\nbackend = \"kinect\"\nlibrary = \"{}\"\n{engine}\n{color}",
        fake.folder().display()
    );
    let rig = home.start(RigText::default().camera("good", "").and(&table).text()).unwrap();
    wait_until(&rig, "colour", |s| all_stream(s) && delivered(s, "k") > 2);
    stop(rig, &[&fake]);
}

#[test]
fn an_engine_that_gets_no_display_is_tried_again_while_the_others_stream() {
    let home = Home::default();
    let fake = Fake::new(&[A]);
    fake.command(A, "engine", 2);
    let rig = home.start(&rig_text(&fake, "")).unwrap();
    let status = wait_until(&rig, "why", |s| says(s, "k", "set DISPLAY"));
    assert_eq!(
        (k(&status).state, camera(&status, "good").state),
        (CameraState::Reconnecting, CameraState::Streaming)
    );
    fake.command(A, "engine", 0);
    wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "k") > 2);
    stop(rig, &[&fake]);
}

#[test]
fn one_that_another_program_has_is_waited_for() {
    let home = Home::default();
    let fake = Fake::new(&[A]);
    fake.command(A, "busy", 3600 * SECOND);
    let rig = home.start(&rig_text(&fake, "")).unwrap();
    let status = wait_until(&rig, "why", |s| says(s, "k", "another program has it"));
    assert_eq!(
        (k(&status).state, camera(&status, "good").state),
        (CameraState::Reconnecting, CameraState::Streaming)
    );
    fake.command(A, "busy", 0);
    wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "k") > 2);
    // This user may not open it: the message has the cure.
    drop(stop(rig, &[&fake]));
    fake.command(A, "denied", 1);
    let rig = home.start(&rig_text(&fake, "")).unwrap();
    wait_until(&rig, "the rule", |s| says(s, "k", "depthrig install"));
    stop(rig, &[&fake]);
}

#[test]
fn two_wired_kinects_are_told_apart_and_come_back_together() {
    let home = Home::default();
    let fake = Fake::new(&[A, B]);
    let folder = fake.folder();
    let master = kinect("m", &folder, &format!("serial = \"{A}\"\nsync = \"master\""));
    let follower = "sync = \"subordinate\"\nsubordinate_delay_us = 160\ndepth_delay_us = -80";
    let follower = kinect("s", &folder, &format!("serial = \"{B}\"\n{follower}"));
    let text = RigText::default().and(&follower).and(&master);
    // Without their cables both say which jack.
    let rig = home.start(text.text()).unwrap();
    wait_until(&rig, "both jacks", |s| says(s, "m", "\"Sync out\"") && says(s, "s", "\"Sync in\""));
    fake.command(A, "sync_out", 1);
    fake.command(B, "sync_in", 1);
    fake.command(B, "needs_master", 1);
    let status =
        wait_until(&rig, "frames", |s| all_stream(s) && delivered(s, "m").min(delivered(s, "s")) > 5);
    assert_eq!((camera(&status, "m").serial.as_str(), camera(&status, "s").serial.as_str()), (A, B));
    let request = RecordRequest {
        directory: Some(home.path("")),
        name: Some("wired".into()),
        force: true,
        ..<_>::default()
    };
    rig.control().record_start(&request).unwrap();
    wait_until(&rig, "sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 5));
    rig.control().record_stop().unwrap();
    // Without its master a subordinate is silent. Both come back when the master does.
    fake.command(A, "unplug", 1500 * SECOND / 1000);
    wait_until(&rig, "the master's loss", |s| camera(s, "m").state == CameraState::Reconnecting);
    wait_until(&rig, "the silence of the other", |s| camera(s, "s").state != CameraState::Streaming);
    let before = rig.control().status();
    let more = |s: &RigStatus, name: &str| delivered(s, name) > delivered(&before, name) + 5;
    wait_until(&rig, "both again", |s| all_stream(s) && more(s, "m") && more(s, "s"));
    stop(rig, &[&fake]);
    let dataset = Dataset::open(&home.path("wired")).unwrap();
    let mut reader = dataset.set_reader().unwrap();
    let mut seen = [0, 0];
    for i in 0..reader.times().len() {
        for f in reader.read(i, PixelMode::Stored).unwrap().frames {
            let is_follower = dataset.session().streams[f.stream].id.to_string().starts_with("s/");
            let is_triggered = FrameFlags(f.header.flags).has(FrameFlags::HARDWARE_TRIGGERED);
            assert_eq!(is_triggered, is_follower);
            seen[usize::from(is_follower)] += 1;
        }
    }
    assert!(seen.iter().all(|n| *n >= 5), "{seen:?}");
}
