//! `depthrig import kinect`: a recording becomes a complete dataset, and nothing is decoded on the way.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{DropReason, Name, PixelFormat};
use depthrig_convert::kinect::{KinectImport, KinectOptions};
use depthrig_convert::{ImportFacts, ImportReport, Importer, import};
use depthrig_kinect::motion::CORRECTED;
use depthrig_kinect::playback::CalibrationSource;
use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
use depthrig_kinect_fixture::{ACCEL_LATE_NS, Fixture, Images, Lacing, Pattern, damage_time, motion};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    ColorCodec, Dataset, DatasetSet, ErrorKind, PixelMode, RecordSet, RecorderOptions, Result, Session,
    StreamAccount,
};
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
    // As the program does by default.
    let recorder = RecorderOptions { color: ColorCodec::Raw, ..RecorderOptions::default() };
    import(&mut importer, Arc::new(RealFs), out, recorder, &mut |p| {
        assert!(p.done <= p.total);
        ControlFlow::Continue(())
    })
}

#[test]
fn a_recording_becomes_a_dataset_with_its_own_jpeg() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 12, lost: vec![5], depth_delay_ns: 160_000, ..Fixture::default() };
    let path = dir.path().join("a.mkv");
    let out = dir.path().join("out");
    fixture.write(&path, &mut Pattern::new(&fixture)).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert!(report.verified.is_whole(), "{:?}", report.verified);
    assert_eq!((report.facts.lost, report.summary.complete), (0, true), "{:?}", report.facts);
    let of_images = |a: &&StreamAccount| a.stream.stream.as_str() != "imu";
    for account in report.facts.accounts.iter().filter(of_images) {
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
    let mut pattern = Pattern::new(&fixture);
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
        assert!(set.frames[0].pixels == pattern.color(n), "the JPEG of {n} is not the recorder's own");
        let words = |pixels: Vec<u16>| pixels.into_iter().flat_map(u16::to_le_bytes).collect::<Vec<_>>();
        assert!(decoded.frames[1].pixels == words(pattern.depth(n)), "depth {n}");
        assert!(decoded.frames[2].pixels == words(pattern.infrared(n)), "infrared {n}");
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
    let path = dir.path().join("cut.mkv");
    let out = dir.path().join("out");
    std::fs::write(&path, bytes).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert!(lost_something(&report), "{:?}", report.verified);
    assert_eq!(report.facts.lost, 1);
    let problem = &report.facts.problems[0];
    assert!(
        problem.contains("at 2 places are damaged or cut off") && problem.contains("the file was cut off"),
        "{problem}"
    );
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.set_reader().unwrap().times().len(), 6);
}

#[test]
fn without_a_calibration_it_says_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { calibration: None, captures: 2, ..Fixture::small() };
    let path = dir.path().join("bare.mkv");
    let out = dir.path().join("out");
    std::fs::write(&path, fixture.bytes()).unwrap();
    let e = run(&path, &out, CalibrationSource::Recorded).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("no calibration.json"), "{e}");
    assert!(!out.exists());
    let report = run(&path, &out, CalibrationSource::None).unwrap();
    assert!(report.facts.stated.iter().any(|s| s.contains("no calibration")));
    std::fs::write(&path, b"<html>404</html>").unwrap();
    let e = run(&path, &dir.path().join("b"), CalibrationSource::Recorded).unwrap_err();
    assert!(e.to_string().contains("not a Matroska file"), "{e}");
}

/// Whether the dataset says itself that something did not come over; broken it never is.
fn lost_something(report: &ImportReport) -> bool {
    assert!(report.verified.broken().is_none(), "{:?}", report.verified);
    report.verified.lost().count() > 0
}

/// Writes `fixture` and imports it into a folder of this name.
fn imported(dir: &Path, name: &str, fixture: &Fixture) -> (ImportReport, Dataset) {
    let path = dir.join(format!("{name}.mkv"));
    let out = dir.join(name);
    fixture.write(&path, &mut Pattern::new(fixture)).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert_eq!(lost_something(&report), report.facts.lost > 0, "{name}: {:?}", report.verified);
    (report, Dataset::open(&out).unwrap())
}

fn words(pixels: Vec<u16>) -> Vec<u8> {
    pixels.into_iter().flat_map(u16::to_le_bytes).collect()
}

fn sets(dataset: &Dataset, mode: PixelMode) -> Vec<DatasetSet> {
    let mut reader = dataset.set_reader().unwrap();
    (0..reader.times().len()).map(|i| reader.read(i, mode).unwrap()).collect()
}

#[test]
fn every_colour_format_and_every_depth_mode_keeps_its_pixels() {
    let dir = tempfile::tempdir().unwrap();
    let color = |format| Some(ColorMode { format, resolution: ColorResolution::P720 });
    let small = || Fixture { captures: 3, motion: false, ..Fixture::small() };
    let forms = [
        ("nv12", PixelFormat::Nv12, Fixture { color: color(ColorFormat::Nv12), ..small() }),
        ("yuy2", PixelFormat::Yuyv, Fixture { color: color(ColorFormat::Yuy2), early: true, ..small() }),
        ("bgra", PixelFormat::Bgr8, Fixture { color: color(ColorFormat::Bgra), ..small() }),
        ("wide", PixelFormat::Z16, Fixture { color: None, depth: Some(DepthMode::Wfov2x2Binned), ..small() }),
        (
            "unbinned",
            PixelFormat::Z16,
            Fixture { color: None, depth: Some(DepthMode::WfovUnbinned), rate_hz: 15, ..small() },
        ),
        (
            "narrow",
            PixelFormat::Z16,
            Fixture { color: None, depth: Some(DepthMode::NfovUnbinned), ..small() },
        ),
        (
            "passive",
            PixelFormat::Mono16,
            Fixture { color: None, depth: Some(DepthMode::PassiveIr), ..small() },
        ),
        ("colour", PixelFormat::Nv12, Fixture { depth: None, ..small() }),
    ];
    for (name, first, fixture) in forms {
        let (report, dataset) = imported(dir.path(), name, &fixture);
        let session = dataset.session();
        assert_eq!(session.streams[0].format, first, "{name}");
        let mut pattern = Pattern::new(&fixture);
        let sets = sets(&dataset, PixelMode::Decoded);
        assert_eq!((sets.len(), report.facts.lost), (3, 0), "{name}");
        for (set, n) in sets.iter().zip(0..) {
            assert_eq!(set.frames.len(), session.streams.len(), "{name}");
            for f in &set.frames {
                let wanted = match session.streams[f.stream].id.to_string().as_str() {
                    "kinect/depth" => words(pattern.depth(n)),
                    "kinect/ir" => words(pattern.infrared(n)),
                    _ if first == PixelFormat::Bgr8 => {
                        pattern.color(n).chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect()
                    }
                    _ => pattern.color(n),
                };
                assert!(f.pixels == wanted, "{name}: {} of {n}", session.streams[f.stream].id);
            }
        }
    }
}

/// The importer's output, before any recorder.
fn handed_over(fixture: &Fixture, dir: &Path) -> (Session, Vec<RecordSet>, ImportFacts) {
    let path = dir.join("source.mkv");
    fixture.write(&path, &mut Pattern::new(fixture)).unwrap();
    let mut importer = KinectImport::open(&path, options(CalibrationSource::Recorded)).unwrap();
    let session = importer.session().unwrap();
    let mut sets = Vec::new();
    while let Some(set) = importer.next().unwrap() {
        sets.push(set);
    }
    (session, sets, importer.facts())
}

/// All samples come over, in order, with the values that the file was given, each with the first set that is not earlier.
#[test]
fn imu_samples_come_over_with_their_sets() {
    let dir = tempfile::tempdir().unwrap();
    for lacing in [Lacing::None, Lacing::Xiph, Lacing::Fixed, Lacing::Ebml] {
        // Depth is exposed before colour, so that the first samples are earlier than the first set.
        let fixture =
            Fixture { lacing, lost: vec![2], depth_delay_ns: -20_000_000, captures: 9, ..Fixture::small() };
        let (session, sets, facts) = handed_over(&fixture, dir.path());
        let [unit] = session.motion.as_slice() else { panic!("one unit") };
        assert_eq!((unit.id.to_string().as_str(), unit.rate_hz, unit.batch), ("kinect/imu", 1600.0, 64));
        assert_eq!((unit.model.as_str(), unit.serial.as_str()), ("Azure Kinect", "000123456789"));
        let corrected = format!("{}; {CORRECTED}", session.streams[0].calibration);
        assert_eq!(unit.calibration, corrected);
        // The accelerometer of the attached calibration: rotation (0 -1 0, 0 0 -1, 1 0 0) and t; the pose is its inverse.
        let at = unit.pose.translation_m;
        let want = [-0.0015, -0.051, 0.0034];
        assert!(at.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-6), "{at:?}");
        let mut i = 0u64;
        let mut batches = 0u64;
        let mut last_tick = i64::MIN;
        for (n, set) in sets.iter().enumerate() {
            let is_last = n + 1 == sets.len();
            for batch in &set.motion {
                batches += 1;
                let h = &batch.header;
                assert_eq!((batch.unit, h.sequence, h.captured), (0, batches, batches));
                assert_eq!(
                    (h.width, h.height, h.pixel_format()),
                    (batch.samples.len() as u32, 1, Some(PixelFormat::Motion))
                );
                assert_eq!((h.payload_len, h.stride), (64 * h.width, 64 * h.width));
                assert_eq!(h.pose, unit.pose);
                let newest = batch.samples.last().unwrap();
                assert_eq!((h.capture_time_ns, h.device_sequence), (newest.time_ns, newest.sequence));
                assert_eq!(h.device_time, newest.device_time);
                assert!(newest.time_ns > last_tick || n == 0, "it belongs to a set before");
                assert!(newest.time_ns <= set.tick.ns() || is_last, "it belongs to a later set");
                for s in &batch.samples {
                    let (device_ns, acceleration, rotation) = motion(&fixture, i);
                    assert_eq!((s.sequence, s.device_time), (i, device_ns / 1000));
                    assert_eq!(
                        s.time_ns,
                        session.started_utc_ns + (device_ns - fixture.start_offset_ns) as i64
                    );
                    assert_eq!((s.gyro_rad_s, s.accel_m_s2), (rotation, acceleration));
                    assert_eq!(s.accel_offset_ns, ACCEL_LATE_NS as i32);
                    assert!(s.temperature_c.is_nan(), "a recording does not say it");
                    i += 1;
                }
            }
            last_tick = set.tick.ns();
        }
        let (_, written) = fixture.bytes_and_places();
        assert_eq!(i, written.motion, "none is left out");
        assert!(
            sets.last().unwrap().motion.iter().any(|b| b.samples.len() < 64),
            "the rest that fills no batch"
        );
        assert!(facts.left_out.is_empty(), "{:?}", facts.left_out);
        let said = format!("{i} samples of accelerometer and gyroscope came over, 0 were left out");
        assert!(facts.stated.contains(&said), "{:?}", facts.stated);
        let account = facts.accounts.iter().find(|a| a.stream == unit.id).unwrap();
        assert_eq!((account.captured, account.delivered, account.dropped.total()), (batches, batches, 0));
    }
    let still = Fixture { motion: false, ..Fixture::small() };
    let (session, sets, facts) = handed_over(&still, dir.path());
    assert!(session.motion.is_empty() && sets.iter().all(|s| s.motion.is_empty()));
    assert!(!facts.stated.iter().any(|s| s.contains("gyroscope")) && facts.accounts.len() == 3);
}

/// A sample of another century is left out; those around it come over, and the dataset is complete.
#[test]
fn a_sample_whose_time_is_damaged_is_left_out_alone() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { checksums: false, captures: 9, ..Fixture::small() };
    let path = dir.path().join("a.mkv");
    let out = dir.path().join("out");
    fixture.write(&path, &mut Pattern::new(&fixture)).unwrap();
    damage_time(&path, &fixture, 70);
    let mut importer = KinectImport::open(&path, options(CalibrationSource::Recorded)).unwrap();
    let go_on = &mut |_| ControlFlow::Continue(());
    let report = import(&mut importer, Arc::new(RealFs), &out, RecorderOptions::default(), go_on).unwrap();
    assert_eq!(report.facts.left_out["motion_samples"], 1);
    assert_eq!(report.verified.motion_samples, fixture.bytes_and_places().1.motion - 1);
    assert!(report.verified.broken().is_none(), "{:?}", report.verified.findings);
}

/// A dataset of a recording says how much of it came over.
#[test]
fn imu_samples_are_told_in_the_report_and_in_the_dataset() {
    let dir = tempfile::tempdir().unwrap();
    let (report, dataset) = imported(dir.path(), "moved", &Fixture::small());
    let (_, written) = Fixture::small().bytes_and_places();
    let said =
        format!("{} samples of accelerometer and gyroscope came over, 0 were left out", written.motion);
    assert!(report.facts.stated.contains(&said), "{:?}", report.facts.stated);
    assert!(report.facts.left_out.is_empty());
    let import = dataset.session().extra["import"].as_table().unwrap();
    assert!(import.get("left_out").is_none());
    let stated: Vec<String> =
        import["stated"].as_array().unwrap().iter().map(|s| s.as_str().unwrap().to_owned()).collect();
    assert_eq!(stated, report.facts.stated);
    assert_eq!((import["lost"].as_integer(), import["ended_early"].as_bool()), (Some(0), Some(false)));
    assert_eq!(dataset.session().motion.len(), 1);
    let sets = sets(&dataset, PixelMode::Stored);
    let samples: Vec<_> = sets.iter().flat_map(|s| &s.motion).flat_map(|b| &b.samples).collect();
    assert_eq!(samples.len() as u64, written.motion);
    for (i, s) in (0..).zip(samples) {
        let (device_ns, acceleration, rotation) = motion(&Fixture::small(), i);
        assert_eq!((s.sequence, s.device_time), (i, device_ns / 1000));
        assert_eq!((s.accel_m_s2, s.gyro_rad_s), (acceleration, rotation));
    }
}

#[test]
fn depth_that_is_exposed_long_after_colour_is_in_its_set() {
    let dir = tempfile::tempdir().unwrap();
    // More than half a period, which without the delay would make other pairs.
    for (name, depth_delay_ns) in [("after", 20_000_000), ("before", -20_000_000)] {
        let fixture =
            Fixture { depth_delay_ns, wired_sync: WiredSync::Subordinate, captures: 8, ..Fixture::small() };
        let (_, dataset) = imported(dir.path(), name, &fixture);
        let import = dataset.session().extra["import"].as_table().unwrap();
        assert_eq!(import["wired_sync"].as_str(), Some("subordinate"));
        assert_eq!(import["depth_delay_ns"].as_integer(), Some(depth_delay_ns));
        let sets = sets(&dataset, PixelMode::Stored);
        assert_eq!(sets.len(), 8, "{name}");
        for (set, n) in sets.iter().zip(0..8) {
            let times: Vec<_> = set.frames.iter().map(|f| f.header.device_time).collect();
            let (color, depth) = fixture.times_us(n);
            assert_eq!(times, [color, depth, depth], "{name}, capture {n}");
        }
    }
}

#[test]
fn images_that_are_damaged_or_come_twice_are_in_the_accounts() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture {
        captures: 6,
        lost: vec![3],
        checksums: false,
        motion: false,
        open_sizes: true,
        ..Fixture::default()
    };
    let (mut bytes, written) = fixture.bytes_and_places();
    let find = |bytes: &[u8], from: usize, what: &[u8]| {
        bytes[from..].windows(what.len()).position(|w| w == what).unwrap() + from
    };
    // The second JPEG has no start; the last capture is in the file twice.
    let second = find(&bytes, written.clusters[1] as usize, &[0xFF, 0xD8]);
    bytes[second] = 0;
    let last = bytes[written.clusters[4] as usize..written.clusters_end as usize].to_vec();
    bytes.splice(written.clusters_end as usize..written.clusters_end as usize, last);
    let path = dir.path().join("a.mkv");
    let out = dir.path().join("out");
    std::fs::write(&path, bytes).unwrap();
    let report = run(&path, &out, CalibrationSource::Recorded).unwrap();
    assert!(lost_something(&report), "{:?}", report.verified);
    let [color, depth, ir] = report.facts.accounts.as_slice() else { panic!("three streams") };
    // Six exposures, one of which the recorder lost, and one more that is a repetition.
    for (a, delivered) in [(color, 4), (depth, 5), (ir, 5)] {
        assert_eq!((a.captured, a.delivered), (7, delivered), "{}", a.stream);
        assert_eq!(a.captured, a.delivered + a.dropped.total());
        assert_eq!((a.dropped.get(DropReason::DeviceGap), a.dropped.get(DropReason::OutOfOrder)), (1, 1));
    }
    assert_eq!(color.dropped.get(DropReason::WrongSize), 1);
    // The damaged one and three repetitions are reported, each with its place.
    assert_eq!(report.facts.lost, 4, "{:?}", report.facts.problems);
    assert!(report.facts.problems[0].contains("kinect/color: the image at"), "{:?}", report.facts.problems);
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.session().extra["import"]["lost"].as_integer(), Some(4));
    let sets = sets(&dataset, PixelMode::Stored);
    let missing: Vec<_> = sets.iter().map(|s| s.frames.len()).collect();
    assert_eq!(missing, [3, 2, 3, 3, 3], "the second lacks its colour");
    let h = &sets[3].frames[0].header;
    let dropped = [DropReason::WrongSize, DropReason::DeviceGap].map(|r| h.dropped[r as usize]);
    assert_eq!((h.sequence, h.captured, dropped), (3, 5, [1, 1]), "the account of the fourth set's colour");
}

#[test]
fn what_is_there_is_not_overwritten_and_an_import_may_be_ended() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 30, motion: true, ..Fixture::small() };
    let path = dir.path().join("a.mkv");
    let out = dir.path().join("out");
    fixture.write(&path, &mut Pattern::new(&fixture)).unwrap();
    let mut importer = KinectImport::open(&path, options(CalibrationSource::Recorded)).unwrap();
    let mut seen = 0;
    let report = import(&mut importer, Arc::new(RealFs), &out, RecorderOptions::default(), &mut |_| {
        seen += 1;
        if seen == 10 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap();
    assert!(report.ended && lost_something(&report), "{:?}", report.verified);
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.set_reader().unwrap().times().len(), 10, "as many as were read until then");
    // Accounts are of the dataset; data that was read and is not in it was left out.
    let delivered: Vec<_> =
        report.facts.accounts.iter().map(|a| (a.stream.to_string(), a.captured, a.delivered)).collect();
    let in_sets = sets(&dataset, PixelMode::None);
    for (at, (stream, captured, delivered)) in delivered.iter().enumerate() {
        let there = match dataset.session().streams.get(at) {
            Some(_) => in_sets.iter().flat_map(|s| &s.frames).filter(|f| f.stream == at).count(),
            None => in_sets.iter().map(|s| s.motion.len()).sum(),
        };
        assert_eq!((*captured, *delivered), (there as u64, there as u64), "{stream}");
    }
    let samples: usize = in_sets.iter().flat_map(|s| &s.motion).map(|b| b.samples.len()).sum();
    let left_out = report.facts.left_out["motion_samples"];
    let said =
        format!("{samples} samples of accelerometer and gyroscope came over, {left_out} were left out");
    assert!(left_out > 0 && report.facts.stated.contains(&said), "{said} {:?}", report.facts.stated);
    let table = &dataset.session().extra["import"];
    assert_eq!(table["ended_early"].as_bool(), Some(true));
    let before = std::fs::read(out.join("session.toml")).unwrap();
    let e = run(&path, &out, CalibrationSource::Recorded).unwrap_err();
    assert!(e.to_string().contains(&out.display().to_string()), "{e}");
    assert_eq!(std::fs::read(out.join("session.toml")).unwrap(), before, "it stays as it was");
    assert_eq!(Dataset::open(&out).unwrap().set_reader().unwrap().times().len(), 10);
}
