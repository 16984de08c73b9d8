//! The first start of simulated cameras, whose scenes are rendered once: the rig answers and streams meanwhile.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{HostTime, RigName};
use depthrig_daemon::ErrorKind;
use depthrig_daemon::client::Client;
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::status::{CameraState, RigStatus};
use depthrig_recorder::Dataset;
use depthrig_recorder::SetRange;
use depthrig_tests::{Home, all_stream, wait_until};
use std::time::Duration;

/// A camera with scenes of `poses` poses, of which each takes some milliseconds for the smallest size that models offer.
fn text(poses: u32) -> String {
    format!(
        "rig = \"test\"\n[recording]\nreserve_mb = 0\nmin_minutes = 0\n[[camera]]\nname = \"front\"\nbackend = \
         \"synthetic\"\nmodel = \"d435\"\nposes = {poses}\n"
    )
}

fn request(home: &Home) -> RecordRequest {
    RecordRequest { directory: Some(home.path("data")), ..RecordRequest::default() }
}

/// 240 poses take minutes: no request here waits for them.
#[test]
fn a_rig_answers_and_streams_while_its_scenes_are_rendered() {
    let home = Home::default();
    let rig = home
        .start_with(&text(240), |o| {
            o.serve_api = true;
            o.draw_while_running = true;
        })
        .unwrap();
    let client = Client::connect(&home.runtime(), Some(&RigName::new("test").unwrap())).unwrap();
    wait_until(&rig, "streaming", all_stream);
    wait_until(&rig, "sets", |s| s.sets.sent >= 5);
    let status = client.status().unwrap();
    let preparing = status.preparing.clone().expect("240 poses are not rendered yet");
    assert!(preparing.share < 1.0 && preparing.images < preparing.images_total, "{preparing:?}");
    assert!(preparing.error.is_none() && preparing.images_total >= 480, "{preparing:?}");
    // A dataset of coarse images would look like one of a broken camera.
    let e = rig.control().record_start(&request(&home)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::WrongState);
    assert!(e.to_string().contains("still being rendered"), "{e}");
    assert!(!home.path("data").exists());
    let lost = |s: &RigStatus| {
        s.cameras.iter().flat_map(|c| &c.streams).any(|s| s.dropped.contains_key("wrong_size"))
    };
    assert!(!lost(&status), "coarse images have the size of the stream");
    // Ending does not wait for the scenes either, and leaves no half of one.
    let begin = HostTime::now();
    let summary = rig.stop();
    assert!(begin.elapsed() < Duration::from_secs(30), "{:?}", begin.elapsed());
    assert!(summary.status.cameras.iter().all(|c| c.state != CameraState::Failed));
    let left: Vec<_> = std::fs::read_dir(home.path("cache")).into_iter().flatten().flatten().collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn a_recording_begins_once_the_scenes_are_rendered_and_shows_them() {
    let home = Home::default();
    let rig = home.start_with(&text(1), |o| o.draw_while_running = true).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let begin = HostTime::now();
    while rig.drawing().is_some() {
        assert!(begin.elapsed() < Duration::from_mins(4), "the scenes are not rendered: {:?}", rig.drawing());
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(rig.control().status().preparing, None);
    rig.control().record_start(&request(&home)).unwrap();
    // A busy computer's set may lack its depth.
    wait_until(&rig, "recorded sets with depth", |s| {
        let recording = s.recording.as_ref();
        recording.is_some_and(|r| r.sets >= 3 + r.missing.get("front/depth").copied().unwrap_or(0))
    });
    let path = rig.control().record_stop().unwrap().path;
    rig.stop();
    // One pose: every depth image but for the noise of the sensor is the one of the file.
    let dataset = Dataset::open(std::path::Path::new(&path)).unwrap();
    let sets: Vec<_> = dataset.sets(SetRange::ALL).map(Result::unwrap).collect();
    // The first set may take a frame that came just before its scene was there.
    let frames = sets.iter().skip(1).flat_map(|set| &set.frames);
    let mut depth = frames.filter(|f| f.header.format == depthrig_bus::PixelFormat::Z16 as u32);
    let first = &depth.next().unwrap().pixels;
    assert!(depth.all(|f| f.pixels == *first), "it stands still");
    // Coarse images repeat each row; those of the scene do not.
    let row = first.len() / 720;
    let repeats = first.chunks(row).collect::<Vec<_>>().windows(2).filter(|w| w[0] == w[1]).count();
    assert!(repeats < 100, "{repeats} of 720 rows repeat the one before");
}
