//! `zed replay`: depth in several modes from raw stereo, also when the run is killed and resumed.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::ops::ControlFlow;
use depthrig_bus::{FrameFlags, FrameHeader, MotionSample, PixelFormat};
use depthrig_calib::stereo::Preset;
use depthrig_convert::zed_replay::{NetworkChoice, Step, ZedReplayOptions, zed_replay};
use depthrig_recorder::{
    CompareOptions, Dataset, DatasetSet, ErrorKind, PixelMode, RecordMotion, Session, SetRange,
    VerifyOptions, compare, verify,
};
use depthrig_stereo::Mode;
use depthrig_tests::synthetic_stereo::SyntheticStereo;
use depthrig_zed::replay::fake;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const CLASSICAL: [Mode; 3] =
    [Mode::Preset(Preset::Performance), Mode::Preset(Preset::Ultra), Mode::Preset(Preset::Quality)];

fn options(modes: &[Mode], jobs: usize) -> ZedReplayOptions {
    ZedReplayOptions { modes: modes.to_vec(), jobs, memory_bytes: u64::MAX, ..ZedReplayOptions::default() }
}

fn go_on(_: Step, _: u64, _: u64) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

fn u16s(bytes: &[u8]) -> Vec<u16> {
    bytes.as_chunks().0.iter().map(|b| u16::from_le_bytes(*b)).collect()
}

/// A set has what the camera's unit, the second of the original, sent before it, and nothing of the other camera's.
fn check_motion(set: &DatasetSet, old: &DatasetSet, session: &Session, original: &Dataset) {
    assert_eq!(original.session().motion[1..], session.motion);
    let mine = &set.motion[0];
    let theirs = &old.motion[1];
    let samples = |m: &RecordMotion| m.samples.iter().map(MotionSample::to_bytes).collect::<Vec<_>>();
    assert_eq!((set.motion.len(), mine.unit, samples(mine)), (1, 0, samples(theirs)));
    let times = |h: &FrameHeader| (h.sequence, h.device_sequence, h.capture_time_ns, h.captured);
    assert_eq!(times(&mine.header), times(&theirs.header));
}

#[test]
#[allow(clippy::too_many_lines)] // one run of all modes, looked at in turn
fn every_mode_has_depth_that_is_right() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    let stereo = SyntheticStereo { without_right: vec![2, 5], ..SyntheticStereo::default() };
    stereo.record(&source);
    let options = ZedReplayOptions { disparity: true, ..options(&CLASSICAL, 3) };
    let report = zed_replay(&source, &out, &options, &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost, report.ended, report.modes.len()), (6, 0, false, 3), "{report:?}");
    assert!(!dir.path().join("out.zedreplay").exists());
    let verified = verify(&out, &VerifyOptions { decode: true, ..VerifyOptions::default() }).unwrap();
    assert!(verified.is_whole(), "{:?}", verified.findings);
    let dataset = Dataset::open(&out).unwrap();
    let session = dataset.session();
    let names: Vec<_> = session.streams.iter().map(|s| s.id.to_string()).collect();
    let of = |mode: &str| ["depth", "confidence", "disparity"].map(|s| format!("zed2i/{s}_{mode}"));
    let expected: Vec<_> = ["performance", "ultra", "quality"].into_iter().flat_map(of).collect();
    assert_eq!(names[0], "zed2i/color");
    assert_eq!(names[1..], expected);
    assert_eq!((session.scene.as_str(), session.rig.as_str()), ("a square before a wall", "bench"));
    assert_eq!(session.derived.last().unwrap().by, "zed replay");
    for made in &session.computed[1..] {
        let mode = made.stream.stream.as_str().rsplit('_').next().unwrap().to_owned();
        assert_eq!(made.name, format!("mimic_{mode}"));
        assert!(
            made.producer.starts_with("depthrig-sgm ") && made.parameters.contains("max_disparity="),
            "{made:?}"
        );
        assert!(made.parameters.starts_with(&format!("preset={mode} ")), "{made:?}");
        assert!(made.parameters.ends_with(" min_depth_m=0.3 max_depth_m=20"), "{made:?}");
        assert_eq!(
            made.from.iter().map(ToString::to_string).collect::<Vec<_>>(),
            ["zed2i/left", "zed2i/right"]
        );
    }
    // The view is the left camera's, because the cameras' axes are parallel.
    let view = &session.streams[1];
    assert!((view.intrinsics.fx - stereo.focal).abs() < 0.5, "{:?}", view.intrinsics);
    assert!((view.pose.translation_m[0] - 0.5).abs() < 1e-9, "{:?}", view.pose);

    let truth = stereo.truth_m();
    let original = Dataset::open(&source).unwrap();
    let sets = dataset.sets_with(SetRange::ALL, PixelMode::Decoded).map(Result::unwrap);
    let before = original.sets_with(SetRange::ALL, PixelMode::None).map(Result::unwrap);
    for (n, (set, old)) in sets.zip(before).enumerate() {
        assert_eq!((set.id, set.tick, set.utc_ns), (old.id, old.tick, old.utc_ns));
        check_motion(&set, &old, session, &original);
        if stereo.without_right.contains(&(n as u64)) {
            assert_eq!(
                (set.frames.len(), set.missing.len()),
                (0, 10),
                "a set without a pair keeps its place"
            );
            continue;
        }
        assert_eq!(set.frames.len(), 10);
        let number = if n < 2 { n as u64 + 1 } else { n as u64 };
        for frame in &set.frames {
            let h = &frame.header;
            let l = &old.frames[0].header;
            assert_eq!(
                (h.capture_time_ns, h.capture_uncertainty_ns, h.device_sequence),
                (l.capture_time_ns, 12_000, 100 + n as u64)
            );
            assert_eq!((h.sequence, h.captured, h.source_sequence), (number, number, l.sequence));
            assert!(h.has(FrameFlags::DERIVED));
            assert_eq!((h.width, h.height), stereo.size);
            assert_eq!(h.camera(), "zed2i");
        }
        for mode in set.frames[1..].chunks(3) {
            let [depth, confidence, disparity] = mode else { panic!() };
            assert_eq!(
                depth.header.refiner_model(),
                format!("mimic_{}", depth.header.stream().strip_prefix("depth_").unwrap())
            );
            assert_eq!(disparity.header.pixel_format(), Some(PixelFormat::DisparityF32));
            let z = u16s(&depth.pixels);
            let d: Vec<f32> = disparity.pixels.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            let mut valid = 0;
            let mut right = 0;
            for (i, z) in z.iter().enumerate() {
                assert_eq!(*z > 0, d[i] > 0.0 && u32::from(*z) > 0, "a hole is a hole in both");
                assert_eq!(d[i].is_nan(), confidence.pixels[i] == 0);
                if *z > 0 {
                    let from_disparity = stereo.focal * stereo.baseline_m / f64::from(d[i]);
                    assert!((f64::from(*z) * 1e-3 - from_disparity).abs() < 0.003, "{z} {}", d[i]);
                    valid += 1;
                    right += u32::from((f64::from(*z) * 1e-3 / truth[i] - 1.0).abs() < 0.05);
                }
            }
            let name = depth.header.stream();
            assert!(valid as usize > truth.len() * 6 / 10, "{name}: {valid} of {}", truth.len());
            assert!(f64::from(right) > 0.9 * f64::from(valid), "{name}: {right} of {valid}");
        }
    }
    // Nothing is overwritten, and the numbers do not depend on how many work on them.
    assert_eq!(zed_replay(&source, &out, &options, &mut go_on).unwrap_err().kind(), ErrorKind::AlreadyExists);
    let alone = dir.path().join("alone");
    let options = ZedReplayOptions { jobs: 1, threads: 2, ..options };
    zed_replay(&source, &alone, &options, &mut go_on).unwrap();
    let same = compare(
        &Dataset::open(&alone).unwrap(),
        &dataset,
        &CompareOptions { strict: true, ..CompareOptions::default() },
    );
    let same = same.unwrap();
    assert!(same.equal, "{same:?}");
}

#[test]
fn invalid_input_is_reported() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    SyntheticStereo { sets: 1, ..SyntheticStereo::default() }.record(&source);
    let out = dir.path().join("out");
    let fails = |options: &ZedReplayOptions| zed_replay(&source, &out, options, &mut go_on).unwrap_err();
    let quality = options(&CLASSICAL[2..], 1);
    let e = fails(&ZedReplayOptions { modes: vec![Mode::Neural], ..quality.clone() });
    assert!(e.to_string().contains("unavailable, because no network was given"), "{e}");
    let e = fails(&ZedReplayOptions { camera: Some("front".into()), ..quality.clone() });
    assert!(e.to_string().contains("of its cameras have: zed2i"), "{e}");
    let e = fails(&ZedReplayOptions { range_m: (2.0, 1.0), ..quality.clone() });
    assert!(e.to_string().contains("invalid depth range"), "{e}");
    let e = fails(&ZedReplayOptions { modes: [CLASSICAL[0], CLASSICAL[0]].to_vec(), ..quality.clone() });
    assert!(e.to_string().contains("twice"), "{e}");
    assert!(!out.exists() && !dir.path().join("out.zedreplay").exists(), "nothing is left of a refusal");
    // Without its network a mode is left out, and that is in the dataset.
    let modes = vec![CLASSICAL[0], Mode::Neural];
    let report = zed_replay(&source, &out, &ZedReplayOptions { modes, ..quality }, &mut go_on).unwrap();
    assert_eq!((report.modes.len(), report.unavailable.len()), (1, 1));
    let session = Dataset::open(&out).unwrap().session().clone();
    assert!(session.extra["zed_replay"].to_string().contains("unavailable, because"), "{:?}", session.extra);
}

/// Swapped left and right images are refused, and nothing else is.
#[test]
fn swapped_images_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    SyntheticStereo { sets: 3, without_right: vec![0], swapped: true, ..SyntheticStereo::default() }
        .record(&source);
    let e = zed_replay(&source, &out, &options(&CLASSICAL, 1), &mut go_on).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().starts_with("left and right are swapped"), "{e}");
    assert!(!out.exists() && !dir.path().join("out.zedreplay").exists());
    // A wall without a pattern matches in neither order, and that is no reason to refuse it.
    let plain = dir.path().join("plain");
    SyntheticStereo { sets: 1, contrast: 0.0, ..SyntheticStereo::default() }.record(&plain);
    zed_replay(&plain, &out, &options(&CLASSICAL[..1], 1), &mut go_on).unwrap();
}

/// A calibration that leaves rows apart is reported and kept in the dataset.
#[test]
fn rows_that_are_apart_are_reported() {
    let dir = tempfile::tempdir().unwrap();
    for (rows_apart, is_bad) in [(0.0, false), (-1.5, true)] {
        let [source, out] = ["source", "out"].map(|name| dir.path().join(format!("{name}{is_bad}")));
        // Two looks at the rows: the first pair and the fifth.
        SyntheticStereo { rows_apart, ..SyntheticStereo::default() }.record(&source);
        let report = zed_replay(&source, &out, &options(&CLASSICAL[..1], 1), &mut go_on).unwrap();
        let noted = report
            .notes
            .iter()
            .any(|n| n.starts_with("zed2i: left and right are not rectified to the same rows"));
        assert_eq!(noted, is_bad, "{:?}", report.notes);
        let session = Dataset::open(&out).unwrap().session().clone();
        let kept = &session.extra["zed_replay"];
        assert_eq!(kept.get("warning").is_some(), is_bad, "{kept}");
        assert_eq!(kept["rows_corrected"].as_bool(), Some(is_bad), "{kept}");
        for computed in &session.computed {
            let states = computed.parameters.contains("rows_moved_px=-1.");
            assert_eq!(states, is_bad && computed.from.len() > 1, "{computed:?}");
        }
        let rows = kept["rows"].as_str().unwrap();
        let said = if is_bad { ["lies 1.5", "px higher"] } else { ["lies 0.0", " 2 pairs)"] };
        assert!(said.iter().all(|s| rows.contains(s)), "{rows}");
    }
}

/// A folder of side-by-side images: depth by the factory calibration, times by the names.
#[test]
fn a_folder_of_images() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    let stereo = SyntheticStereo { size: (672, 376), focal: 300.0, sets: 3, ..SyntheticStereo::default() };
    stereo.write_folder(&source);
    let options = options(&CLASSICAL[..1], 2);
    let report = zed_replay(&source, &out, &options, &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost, report.notes.len()), (3, 0, 0), "{report:?}");
    let dataset = Dataset::open(&out).unwrap();
    let s = &dataset.session().streams[1];
    assert_eq!((s.id.to_string().as_str(), s.serial.as_str()), ("zed2i/depth_performance", "20267155"));
    assert!(s.calibration.contains("SN20267155.conf"), "{}", s.calibration);
    assert_eq!(dataset.session().started_utc_ns, depthrig_tests::synthetic_stereo::T0);
    let truth = stereo.truth_m();
    for (n, set) in dataset.sets_with(SetRange::ALL, PixelMode::Decoded).map(Result::unwrap).enumerate() {
        assert_eq!(set.utc_ns, depthrig_tests::synthetic_stereo::T0 + n as i64 * stereo.period_ns);
        assert_eq!(set.frames[1].header.device_sequence, n as u64);
        let z = u16s(&set.frames[1].pixels);
        let right =
            z.iter().zip(&truth).filter(|(z, t)| (f64::from(**z) * 1e-3 / **t - 1.0).abs() < 0.05).count();
        assert!(right * 10 > truth.len() * 6, "{right} of {}", truth.len());
    }
    // A folder without calibration gives no depth.
    std::fs::remove_file(source.join("SN20267155.conf")).unwrap();
    let e = zed_replay(&source, &dir.path().join("second"), &options, &mut go_on).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput, "{e}");
    assert!(e.to_string().contains("has no calibration"), "{e}");
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    assert!(zed_replay(&empty, &dir.path().join("third"), &options, &mut go_on).is_err());
}

/// An SVO2 file, whole and cut; killed or not, a resumed run goes on by the number of the pair.
#[test]
fn an_svo2_file() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("kitchen.svo2");
    let stereo = SyntheticStereo { size: (672, 376), focal: 300.0, ..SyntheticStereo::default() };
    let bytes = fake::FakeSvo::strips(stereo.size, 4).build();
    std::fs::write(&source, &bytes).unwrap();
    std::fs::write(dir.path().join(format!("SN{}.conf", fake::SERIAL)), stereo.conf()).unwrap();
    let options = options(&CLASSICAL[..1], 2);
    let out = dir.path().join("out");
    let report = zed_replay(&source, &out, &options, &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost), (4, 0), "{report:?}");
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.session().derived.last().unwrap().from, ["kitchen.svo2"]);
    assert_eq!(dataset.session().streams[0].serial, fake::SERIAL.to_string());
    let times: Vec<_> = dataset.sets(SetRange::ALL).map(|s| s.unwrap().utc_ns).collect();
    assert_eq!(times, (0..4).map(fake::time_of).collect::<Vec<_>>());
    // Other files are refused.
    std::fs::write(&source, &bytes[..40]).unwrap();
    let e = zed_replay(&source, &dir.path().join("cut"), &options, &mut go_on).unwrap_err();
    assert!(e.to_string().contains("kitchen.svo2"), "{e}");
}

/// Each mode of `at_once`, which `options` made, has the frames that it has alone.
fn modes_are_those_alone(source: &Path, at_once: &Dataset, options: &ZedReplayOptions, dir: &Path) {
    let frames = |dataset: &Dataset, mode: &str| {
        let mut all = Vec::new();
        for set in dataset.sets_with(SetRange::ALL, PixelMode::Decoded).map(Result::unwrap) {
            let of_mode = set.frames.into_iter().filter(|f| f.header.stream().ends_with(&format!("_{mode}")));
            all.extend(of_mode.map(|f| {
                (set.id, f.header.stream().to_owned(), f.header.refiner_model().to_owned(), f.pixels)
            }));
        }
        assert!(!all.is_empty(), "{mode}");
        all
    };
    for mode in &options.modes {
        let out = dir.join(format!("only_{mode}"));
        let report =
            zed_replay(source, &out, &ZedReplayOptions { modes: vec![*mode], ..options.clone() }, &mut go_on);
        assert!(report.unwrap().modes[0].shared_with.is_empty());
        let same = frames(at_once, mode.name()) == frames(&Dataset::open(&out).unwrap(), mode.name());
        assert!(same, "{mode} is not what it is alone");
    }
}

#[test]
fn presets_share_their_matching_and_stay_what_they_are_alone() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    SyntheticStereo { sets: 3, without_right: vec![1], ..SyntheticStereo::default() }.record(&source);
    let options = options(&CLASSICAL, 2);
    let report = zed_replay(&source, &out, &options, &mut go_on).unwrap();
    assert_eq!(report.modes[1].shared_with, ["performance", "quality"]);
    let once: Vec<_> = report.modes.iter().map(|m| m.stereo_s).collect();
    assert!(once.iter().all(|s| (s - report.cpu.stereo_s).abs() < 1e-9), "{once:?} {:?}", report.cpu);
    modes_are_those_alone(&source, &Dataset::open(&out).unwrap(), &options, dir.path());
}

/// A network of one's own beside the classical modes; skipped, with a line that says so, without ONNX Runtime.
#[test]
fn a_network_is_a_mode_like_any_other() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    let stereo = SyntheticStereo { sets: 3, ..SyntheticStereo::default() };
    stereo.record(&source);
    let file = dir.path().join("made.onnx");
    let made = depthrig_cdm::FakeNetwork { disparities: 24, confidence: true, ..Default::default() };
    std::fs::write(&file, made.file()).unwrap();
    let network = NetworkChoice {
        file: file.clone(),
        library: None,
        device: "cpu".into(),
        pixels: None,
        negative: false,
    };
    // The network between two presets, whose matching is shared.
    let modes = vec![CLASSICAL[2], Mode::Neural, CLASSICAL[0]];
    let options = ZedReplayOptions { modes, network: Some(network), ..options(&[], 2) };
    let report = match zed_replay(&source, &out, &options, &mut go_on) {
        Err(e) if e.to_string().contains("ONNX Runtime was not found") => {
            assert!(std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none(), "{e}");
            println!("skipped: {e}");
            return;
        }
        report => report.unwrap(),
    };
    assert_eq!(report.modes[1].recorded_as, "mimic_neural");
    assert!(report.modes[1].parameters.contains("network=made.onnx sha256="), "{:?}", report.modes[1]);
    let dataset = Dataset::open(&out).unwrap();
    let truth = stereo.truth_m();
    for set in dataset.sets_with(SetRange::ALL, PixelMode::Decoded).map(Result::unwrap) {
        let depth = set.frames.iter().find(|f| f.header.stream() == "depth_neural").unwrap();
        assert!(depth.header.refiner().starts_with("onnxruntime"), "{}", depth.header.refiner());
        let z = u16s(&depth.pixels);
        let right =
            z.iter().zip(&truth).filter(|(z, t)| (f64::from(**z) * 1e-3 / **t - 1.0).abs() < 0.05).count();
        assert!(right * 10 > truth.len() * 7, "{right} of {}", truth.len());
    }
    modes_are_those_alone(&source, &dataset, &options, dir.path());
    // One with other inputs is refused before anything is written.
    let wrong = depthrig_cdm::FakeNetwork { channels: 4, ..Default::default() };
    std::fs::write(&file, wrong.file()).unwrap();
    let second = dir.path().join("second");
    let e = zed_replay(&source, &second, &options, &mut go_on).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().contains("another number of channels; taken are two inputs"), "{e}");
    assert!(!second.exists() && !dir.path().join("second.zedreplay").exists());
}

/// Where the child below replays from and to.
const KILL: &str = "DEPTHRIG_TEST_ZED_KILL";

/// Long enough for several segments: a set each 2.5 s of recorded time.
fn long() -> SyntheticStereo {
    SyntheticStereo {
        sets: 40,
        period_ns: 2_500_000_000,
        size: (128, 72),
        focal: 100.0,
        ..SyntheticStereo::default()
    }
}

/// Not a test of its own: the child that the test below starts and kills. It prints its progress and goes on after
/// each line that it gets.
#[test]
fn child() {
    let Some(dir) = std::env::var_os(KILL).map(PathBuf::from) else { return };
    let options = options(&CLASSICAL[..1], 1);
    let report = zed_replay(&dir.join("source"), &dir.join("out"), &options, &mut |_, done, _| {
        println!("done {done}");
        std::io::stdin().read_line(&mut String::new()).unwrap();
        // Slow enough for its segments to be finished meanwhile.
        std::thread::sleep(std::time::Duration::from_millis(4));
        ControlFlow::Continue(())
    });
    println!("resumed {}", report.unwrap().resumed);
}

/// Starts the child and kills it (SIGKILL) once it has reported `after` sets. Returns the sets that it resumed.
fn run_child(dir: &Path, after: u64) -> Option<u64> {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "child", "--nocapture"])
        .env(KILL, dir)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut resumed = None;
    let mut stdin = child.stdin.take().unwrap();
    for line in BufReader::new(child.stdout.take().unwrap()).lines() {
        let line = line.unwrap_or_default();
        // The first may come behind the name of the test.
        if let Some((_, n)) = line.split_once("done ") {
            if n.parse::<u64>().unwrap() >= after {
                child.kill().unwrap();
                break;
            }
            writeln!(stdin).unwrap();
        }
        resumed = resumed.or_else(|| line.strip_prefix("resumed ")?.parse().ok());
    }
    child.wait().unwrap();
    resumed
}

#[test]
fn a_recording_that_lost_sets_is_replayed_with_its_gaps() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    SyntheticStereo { lost: vec![2], ..SyntheticStereo::default() }.record(&source);
    let report = zed_replay(&source, &out, &options(&CLASSICAL[..1], 1), &mut go_on).unwrap();
    assert_eq!((report.sets, report.lost), (5, 0), "{:?}", report.problems);
    let accounts = |path: &Path| Dataset::open(path).unwrap().info().unwrap().accounts;
    let unit = accounts(&source).into_iter().find(|a| a.stream.to_string() == "zed2i/imu").unwrap();
    assert!(unit.dropped.total() == 1 && accounts(&out).contains(&unit), "{:?}", accounts(&out));
    assert!(!accounts(&out).iter().any(|a| a.stream.to_string() == "other/imu"));
    let gap = "1 batches of zed2i/imu were not recorded";
    assert!(report.verified.unwrap().findings.iter().any(|f| f.message == gap));
}

#[test]
fn a_killed_run_goes_on() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path();
    long().record(&dir.join("source"));
    let whole = dir.join("whole");
    zed_replay(&dir.join("source"), &whole, &options(&CLASSICAL[..1], 2), &mut go_on).unwrap();
    for after in [1, 9, 22, 33] {
        assert_eq!(run_child(dir, after), None, "it was killed");
        assert!(!dir.join("out").exists() && dir.join("out.zedreplay").exists());
    }
    // Other options are refused, and the existing folder is not changed.
    let other = ZedReplayOptions { depth_unit_m: 0.0001, ..options(&CLASSICAL[..1], 1) };
    let e = zed_replay(&dir.join("source"), &dir.join("out"), &other, &mut go_on).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::AlreadyExists, "{e}");
    assert!(e.to_string().contains("depth_unit_m"), "{e}");
    let resumed = run_child(dir, u64::MAX).expect("it came to its end");
    assert!(resumed >= 12, "{resumed}: segments that were finished before the last kill are kept");
    assert!(!dir.join("out.zedreplay").exists());
    assert!(verify(&dir.join("out"), &VerifyOptions::default()).unwrap().is_whole());
    let a = Dataset::open(&dir.join("out")).unwrap();
    let b = Dataset::open(&whole).unwrap();
    let same = compare(&a, &b, &CompareOptions { strict: true, ..CompareOptions::default() }).unwrap();
    assert!(same.equal, "{same:?}");
}

#[test]
fn a_run_that_was_ended_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("source");
    let out = dir.path().join("out");
    long().record(&source);
    let options = options(&CLASSICAL[..1], 2);
    let ended = zed_replay(&source, &out, &options, &mut |_, done, _| {
        if done >= 15 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(ended.unwrap().ended && !out.exists());
    let verify_break = zed_replay(&source, &out, &options, &mut |step, _, _| {
        if step == Step::Verify { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    let report = verify_break.unwrap();
    assert!(report.ended && report.resumed >= 8 && !out.exists(), "{report:?}");
    let report = zed_replay(&source, &out, &options, &mut go_on).unwrap();
    assert_eq!((report.sets, report.resumed), (40, 40));
}
