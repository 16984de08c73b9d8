//! `depthrig import kinect`: a recording becomes a dataset that is whole, and nothing is decoded on the way.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{DropReason, Name, PixelFormat};
use depthrig_daemon::import_kinect::{KinectImport, KinectOptions};
use depthrig_drivers::kinect::playback::CalibrationSource;
use depthrig_kinect_fixture::{Fixture, Pattern, Pictures};
use depthrig_recorder::exchange::{ImportReport, import};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Dataset, ErrorKind, PixelMode, RecorderOptions, Result};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

/// 2026-01-01T00:00:00Z, when the fixtures were recorded.
const BEGAN: i64 = 1_767_225_600_000_000_000;

fn options(calibration: CalibrationSource) -> KinectOptions {
    KinectOptions { name: "kitchen".into(), camera: Name::new("kinect").unwrap(), calibration }
}

fn run(path: &Path, out: &Path, calibration: CalibrationSource) -> Result<ImportReport> {
    let mut importer = KinectImport::open(path, options(calibration))?;
    let recorder = RecorderOptions::default();
    import(&mut importer, Arc::new(RealFs), out, recorder, &mut |p| {
        assert!(p.done <= p.total);
        ControlFlow::Continue(())
    })
}

#[test]
fn a_recording_becomes_a_dataset_with_its_own_jpeg() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 12, lost: vec![5], depth_delay_ns: 160_000, ..Fixture::default() };
    let (path, out) = (dir.path().join("a.mkv"), dir.path().join("out"));
    fixture.write(&path, &mut Pattern::new(&fixture)).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert!(report.verified.is_whole(), "{:?}", report.verified);
    assert_eq!((report.facts.lost, report.summary.complete), (0, true), "{:?}", report.facts);
    for account in &report.facts.accounts {
        assert_eq!((account.captured, account.delivered), (12, 11), "{}", account.stream);
        assert_eq!(account.dropped.get(DropReason::DeviceGap), 1);
    }
    let dataset = Dataset::open(&out).unwrap();
    let session = dataset.session();
    assert_eq!(session.started_utc_ns, BEGAN);
    let import = session.extra["import"].as_table().unwrap();
    assert_eq!(import["depth_mode"].as_str(), Some("nfov_unbinned"));
    assert_eq!(import["calibration_json"].as_str(), Some(depthrig_kinect_fixture::CALIBRATION));
    let ids: Vec<_> = session.streams.iter().map(|s| (s.id.to_string(), s.format)).collect();
    let wanted = [("color", PixelFormat::Mjpeg), ("depth", PixelFormat::Z16), ("ir", PixelFormat::Mono16)];
    assert_eq!(ids, wanted.map(|(s, f)| (format!("kinect/{s}"), f)));
    assert!((session.streams[1].intrinsics.cx - 332.78128).abs() < 1e-9);
    assert!((session.streams[0].pose.translation_m[0] - 0.032).abs() < 1e-3);
    assert_eq!(session.streams[0].serial, "000123456789");
    let mut made = Pattern::new(&fixture);
    let mut reader = dataset.set_reader().unwrap();
    let there: Vec<u32> = (0..12).filter(|n| *n != 5).collect();
    assert_eq!(reader.times().len(), there.len());
    for (i, n) in there.into_iter().enumerate() {
        let set = reader.read(i, PixelMode::Stored).unwrap();
        let decoded = reader.read(i, PixelMode::Decoded).unwrap();
        assert_eq!(set.frames.len(), 3, "set {i}");
        let (color_us, depth_us) = fixture.times_us(n);
        for f in &set.frames {
            let us = if f.stream == 0 { color_us } else { depth_us };
            assert_eq!((f.header.device_time, f.header.device_sequence), (us, u64::from(n)));
            assert_eq!(f.header.capture_time_ns, BEGAN + (us * 1000 - fixture.start_offset_ns) as i64);
        }
        assert_eq!(set.spread_ns, 160_000);
        assert!(set.frames[0].pixels == made.color(n), "the JPEG of {n} is not the recorder's own");
        let words = |pixels: Vec<u16>| pixels.into_iter().flat_map(u16::to_le_bytes).collect::<Vec<_>>();
        assert!(decoded.frames[1].pixels == words(made.depth(n)), "depth {n}");
        assert!(decoded.frames[2].pixels == words(made.infrared(n)), "infrared {n}");
    }
}

#[test]
fn a_file_that_was_cut_gives_what_is_whole_and_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 9, motion: false, ..Fixture::small() };
    let (mut bytes, written) = fixture.bytes_and_places();
    // A damaged cluster in the middle, and an end that is missing.
    bytes[written.clusters[3] as usize + 90_000] ^= 1;
    bytes.truncate(written.clusters[7] as usize + 1000);
    let (path, out) = (dir.path().join("cut.mkv"), dir.path().join("out"));
    std::fs::write(&path, bytes).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert!(report.verified.is_whole(), "{:?}", report.verified);
    assert_eq!(report.facts.lost, 1);
    let told = &report.facts.problems[0];
    assert!(
        told.contains("at 2 places are damaged or cut off") && told.contains("the file was cut off"),
        "{told}"
    );
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.set_reader().unwrap().times().len(), 6);
}

#[test]
fn without_a_calibration_it_says_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { calibration: None, captures: 2, ..Fixture::small() };
    let (path, out) = (dir.path().join("bare.mkv"), dir.path().join("out"));
    std::fs::write(&path, fixture.bytes()).unwrap();
    let e = run(&path, &out, CalibrationSource::Recorded).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("no calibration.json"), "{e}");
    assert!(!out.exists());
    let report = run(&path, &out, CalibrationSource::None).unwrap();
    assert!(report.facts.stated.iter().any(|s| s.contains("no calibration")));
    std::fs::write(&path, b"<html>404</html>").unwrap();
    let e = run(&path, &dir.path().join("b"), CalibrationSource::Recorded).unwrap_err();
    assert!(e.to_string().contains("no Matroska file"), "{e}");
}
