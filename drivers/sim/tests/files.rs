//! The `files` backend: the frames it plays, and its errors for folders that cannot be played.
//!
//! Longer than most files: every test builds its folder with the same few helpers.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::time::Duration;
use depthrig_bus::{ClockDomain, Distortion, PixelFormat};
use depthrig_driver::capture::{Capture, Session, StopOutcome};
use depthrig_driver::{Backend, Error, ErrorKind, MemorySink, Poll, Stream, StreamRequest};
use depthrig_sim::files::{EXAMPLE_MANIFEST, FilesBackend, FilesConfig};
use image::ExtendedColorType;
use jpeg_encoder::{ColorType, Encoder};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const TIMEOUT: Duration = Duration::from_secs(10);

const COLOR: &str = "[[stream]]\nname = \"color\"\nfiles = \"color_*.png\"\n";
const DEPTH: &str = "[[stream]]\nname = \"depth\"\nfiles = \"depth_*.png\"\ndepth_unit_m = 0.001\n";

fn manifest(top: &str, streams: &[&str]) -> String {
    format!("model = \"test\"\nrate_hz = 500.0\n{top}\n{}", streams.concat())
}

/// Pixels that differ in every image and place; as 16-bit little-endian where that matters.
fn pixels(seed: usize, len: usize) -> Vec<u8> {
    (0..len).map(|i| (i * 31 + seed * 97 + i / 7) as u8).collect()
}

fn save(path: &Path, w: u32, h: u32, kind: ExtendedColorType, pixels: &[u8]) {
    if path.extension().is_some_and(|e| e == "jpg") {
        let kind = if kind == ExtendedColorType::L8 { ColorType::Luma } else { ColorType::Rgb };
        Encoder::new_file(path, 75).unwrap().encode(pixels, w as u16, h as u16, kind).unwrap();
        return;
    }
    // The encoder wants 16-bit pixels in the host's order, which is little-endian wherever tests run.
    image::save_buffer(path, pixels, w, h, kind).unwrap();
}

fn color(dir: &TempDir, name: &str, seed: usize) -> Vec<u8> {
    let p = pixels(seed, 4 * 3 * 3);
    save(&dir.path().join(name), 4, 3, ExtendedColorType::Rgb8, &p);
    p
}

fn depth(dir: &TempDir, name: &str, seed: usize) -> Vec<u8> {
    let p = pixels(seed, 4 * 3 * 2);
    save(&dir.path().join(name), 4, 3, ExtendedColorType::L16, &p);
    p
}

/// A folder with `count` good pairs, numbered from 1.
fn folder(text: &str, count: usize) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("camera.toml"), text).unwrap();
    for i in 1..=count {
        color(&dir, &format!("color_{i}.png"), i);
        depth(&dir, &format!("depth_{i:04}.png"), 100 + i);
    }
    dir
}

fn backend(dir: &TempDir) -> FilesBackend {
    FilesBackend::new(FilesConfig::new(dir.path()))
}

fn start(dir: &TempDir) -> Result<Box<dyn Stream>, Error> {
    backend(dir).open(None)?.start(&[])
}

/// The error that the folder is refused with, at opening or at the first frames.
fn refused(dir: &TempDir) -> Error {
    start(dir).err().expect("the folder must be refused before it plays")
}

fn play(stream: &mut dyn Stream, sink: &mut MemorySink, frames: usize) {
    let mut played = 0;
    while played < frames {
        if stream.poll(TIMEOUT, sink).unwrap() == Poll::Frame {
            played += 1;
        }
    }
}

#[test]
fn the_documented_example_plays_and_shows_the_defaults() {
    let dir = folder(EXAMPLE_MANIFEST, 2);
    fs::write(dir.path().join("intrinsics.txt"), "460 0 1.5\n0 461 1\n0 0 1\n").unwrap();
    let described = |dir: &TempDir| {
        let device = backend(dir).open(None).unwrap();
        (device.info().clone(), device.profiles().to_vec())
    };
    let (info, profiles) = described(&dir);
    let name = dir.path().file_name().unwrap().to_string_lossy();
    assert_eq!((info.backend, info.model.as_str(), info.serial.as_str()), ("files", "D405", &*name));
    assert!(info.calibration.starts_with("file ") && info.calibration.ends_with("camera.toml"));
    assert_eq!((profiles[0].format, profiles[0].depth_unit_m), (PixelFormat::Rgb8, 0.0));
    assert_eq!((profiles[1].format, profiles[1].depth_unit_m), (PixelFormat::Z16, 0.0001));
    assert_eq!(profiles[0].intrinsics.fx, 648.0);
    assert_eq!(profiles[0].intrinsics.distortion(), Distortion::None);
    assert_eq!((profiles[1].intrinsics.fy, profiles[1].intrinsics.cx), (461.0, 1.5));
    assert_eq!((profiles[1].rate_hz, profiles[1].clock.domain), (30.0, ClockDomain::Kernel));

    // With every commented key switched on nothing changes but the serial number, which has no default value.
    let all = EXAMPLE_MANIFEST.replace("# serial", "serial").replace("\n# ", "\n");
    assert!(
        ["\nfolder", "\nloop", "\npair_by", "\ncache_mb", "\nformat", "\npose_in"]
            .iter()
            .all(|k| all.contains(k))
    );
    fs::write(dir.path().join("camera.toml"), all).unwrap();
    let (mut with_all, profiles_of_all) = described(&dir);
    assert_eq!(with_all.serial, "…");
    with_all.serial = info.serial.clone();
    assert_eq!((with_all, profiles_of_all), (info, profiles));
}

/// docs/files.md is all that a newcomer has: its manifests play, and its long one is the one that is tested above.
#[test]
fn the_manifests_of_the_documentation_play() {
    let page = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/files.md")).unwrap();
    assert!(page.contains(&format!("```toml\n{EXAMPLE_MANIFEST}```")), "the example is not that of the code");
    let blocks: Vec<&str> = page.split("```toml\n").skip(1).map(|b| b.split("```").next().unwrap()).collect();
    assert_eq!(blocks.len(), 2);
    for block in blocks {
        let text = block.lines().map(str::trim_start).collect::<Vec<_>>().join("\n");
        let dir = folder(&text, 3);
        fs::write(dir.path().join("intrinsics.txt"), "460 0 1.5\n0 461 1\n0 0 1\n").unwrap();
        let mut sink = MemorySink::default();
        play(&mut *start(&dir).unwrap_or_else(|e| panic!("{e}:\n{text}")), &mut sink, 3);
        assert_eq!(sink.frames.len(), 6);
    }
}

#[test]
fn plays_in_natural_order_paired_by_number_and_ends() {
    let dir = folder(&manifest("loop = false", &[COLOR, DEPTH]), 11);
    let mut stream = start(&dir).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 11);
    assert_eq!(stream.poll(TIMEOUT, &mut sink).unwrap(), Poll::End);
    assert_eq!(stream.poll(TIMEOUT, &mut sink).unwrap(), Poll::End, "it stays at its end");
    for (k, pair) in sink.frames.chunks(2).enumerate() {
        let [(0, cm, c), (1, dm, d)] = pair else { panic!("color and depth, in that order") };
        assert_eq!(*c, pixels(k + 1, 36), "color of frame {k}");
        assert_eq!(*d, pixels(101 + k, 24), "depth of frame {k}, little-endian");
        assert_eq!((cm.device_sequence, dm.device_sequence), (k as u64, k as u64));
        assert_eq!(cm.capture_time, dm.capture_time);
        assert!(cm.arrival >= cm.capture_time && cm.capture_uncertainty_ns == 0);
    }
    assert_eq!(sink.frames.len(), 22);
}

#[test]
fn loops_and_stamps_on_the_grid_of_the_rate() {
    let dir = folder(&manifest("", &[COLOR, DEPTH]), 2);
    let config = FilesConfig { rate_hz: Some(50.0), ..FilesConfig::new(dir.path().join("camera.toml")) };
    let mut stream = FilesBackend::new(config).open(None).unwrap().start(&[]).unwrap();
    assert_eq!(stream.profiles()[0].rate_hz, 50.0);
    let mut sink = MemorySink::default();
    assert_eq!(stream.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Frame, "the first is due at once");
    assert_eq!(stream.poll(Duration::ZERO, &mut sink).unwrap(), Poll::Idle, "the second is not");
    play(&mut *stream, &mut sink, 6);
    let colors: Vec<_> = sink.frames.iter().filter(|f| f.0 == 0).collect();
    for (k, f) in colors.iter().enumerate() {
        assert_eq!(f.2, pixels(1 + k % 2, 36));
        let since = f.1.capture_time.since_ns(colors[0].1.capture_time);
        // A host that stalls moves the schedule; it can never run ahead of it.
        assert!(since >= k as i64 * 20_000_000, "frame {k} came after {since} ns");
    }
}

#[test]
fn looping_can_be_overridden() {
    let dir = folder(&manifest("loop = true", &[COLOR, DEPTH]), 1);
    let config = FilesConfig { looped: Some(false), ..FilesConfig::new(dir.path()) };
    let mut stream = FilesBackend::new(config).open(None).unwrap().start(&[]).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    assert_eq!(stream.poll(TIMEOUT, &mut sink).unwrap(), Poll::End);
}

#[test]
fn what_is_not_kept_is_decoded_again_and_a_lost_file_is_named() {
    let kept = folder(&manifest("", &[COLOR, DEPTH]), 3);
    let passing = folder(&manifest("cache_mb = 0", &[COLOR, DEPTH]), 3);
    let mut a = start(&kept).unwrap();
    let mut b = start(&passing).unwrap();
    let mut in_a = MemorySink::default();
    let mut in_b = MemorySink::default();
    play(&mut *a, &mut in_a, 7);
    play(&mut *b, &mut in_b, 7);
    let shown = |s: &MemorySink| s.frames.iter().map(|f| (f.0, f.2.clone())).collect::<Vec<_>>();
    assert_eq!(shown(&in_a), shown(&in_b));

    for dir in [&kept, &passing] {
        fs::remove_file(dir.path().join("depth_0003.png")).unwrap();
    }
    play(&mut *a, &mut in_a, 3);
    let error = loop {
        match b.poll(TIMEOUT, &mut in_b) {
            Ok(_) => assert!(in_b.frames.len() < 20, "the lost file went unnoticed"),
            Err(e) => break e,
        }
    };
    assert_eq!(error.kind(), ErrorKind::Io);
    assert!(error.to_string().contains("depth_0003.png"), "{error}");
}

#[test]
fn an_image_that_changes_its_size_while_playing_is_named() {
    let dir = folder(&manifest("cache_mb = 0", &[COLOR, DEPTH]), 1);
    let mut stream = start(&dir).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    save(&dir.path().join("color_1.png"), 5, 3, ExtendedColorType::Rgb8, &pixels(1, 45));
    let error = stream.poll(TIMEOUT, &mut sink).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput);
    for word in ["color_1.png", "was 4x3 8-bit colour", "is 5x3 8-bit colour now"] {
        assert!(error.to_string().contains(word), "{error}");
    }
}

#[test]
fn a_slow_camera_stops_at_once_and_one_at_its_end_says_so() {
    for (looped, wanted) in [(true, "Stopped"), (false, "Finished")] {
        let dir = folder(&manifest("", &[COLOR, DEPTH]), 1);
        let rate_hz = Some(if looped { 0.01 } else { 500.0 });
        let config = FilesConfig { rate_hz, looped: Some(looped), ..FilesConfig::new(dir.path()) };
        let capture = Capture::spawn("cam", move || {
            let device = FilesBackend::new(config).open(None)?;
            let info = device.info().clone();
            Ok(Session { info, stream: device.start(&[])?, sink: Box::new(MemorySink::default()) })
        })
        .unwrap();
        while capture.last_frame().is_none() || (!looped && !capture.has_ended()) {
            std::thread::sleep(Duration::from_millis(1));
        }
        match capture.stop(Duration::from_secs(1)) {
            StopOutcome::Ended(end) => assert_eq!(format!("{end:?}"), wanted),
            StopOutcome::Abandoned => panic!("it was waiting for its next image and could not be stopped"),
        }
    }
}

#[test]
fn a_frame_without_a_slot_is_counted() {
    let dir = folder(&manifest("", &[COLOR, DEPTH]), 1);
    let mut stream = start(&dir).unwrap();
    let mut sink = MemorySink::default();
    sink.refuse = 1;
    play(&mut *stream, &mut sink, 2);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (1, 2));
    assert_eq!(sink.drops_of(0).get(depthrig_bus::DropReason::NoSlot), 1);
    let last = sink.frames.iter().rfind(|f| f.0 == 0).unwrap();
    assert_eq!((last.1.device_sequence, last.1.captured), (1, 2));
}

#[test]
fn one_stream_of_two_can_be_asked_for() {
    let dir = folder(&manifest("", &[COLOR, DEPTH]), 1);
    let request = StreamRequest::any(depthrig_bus::Name::new("depth").unwrap());
    let mut stream = backend(&dir).open(None).unwrap().start(&[request]).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    assert_eq!(stream.profiles().len(), 1);
    assert_eq!((sink.frames[0].0, &sink.frames[0].2), (0, &pixels(101, 24)));
    let request = StreamRequest::any(depthrig_bus::Name::new("ir_left").unwrap());
    let error = backend(&dir).open(None).unwrap().start(&[request]).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::Unsupported);
    assert!(error.to_string().contains("color 4x3 rgb8 500 Hz"), "{error}");
    assert_eq!(backend(&dir).open(Some("nobody")).err().unwrap().kind(), ErrorKind::NotFound);
}

#[test]
fn sub_folders_order_pairing_and_every_format() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("grey")).unwrap();
    let grey = pixels(1, 12);
    let grey16 = pixels(2, 24);
    for (i, stamp) in ["9.25", "10.5"].into_iter().enumerate() {
        save(&dir.path().join(format!("grey/{stamp}.png")), 4, 3, ExtendedColorType::L8, &pixels(i, 12));
        color(&dir, &format!("c{i}.png"), i);
    }
    save(&dir.path().join("ir.png"), 4, 3, ExtendedColorType::L16, &grey16);
    save(&dir.path().join("ir2.png"), 4, 3, ExtendedColorType::L16, &grey16);
    save(&dir.path().join("conf.png"), 4, 3, ExtendedColorType::L8, &grey);
    save(&dir.path().join("conf2.png"), 4, 3, ExtendedColorType::L8, &grey);
    let text = manifest(
        "pair_by = \"order\"\nserial = \"s1\"",
        &[
            "[[stream]]\nname = \"ir_right\"\nfiles = \"grey/*.png\"\n",
            "[[stream]]\nname = \"color\"\nfiles = \"c?.png\"\n",
            "[[stream]]\nname = \"ir_left\"\nfiles = \"ir*.png\"\n",
            "[[stream]]\nname = \"confidence\"\nfiles = \"conf*.png\"\n",
            "[[stream]]\nname = \"thermal\"\nfiles = \"ir*.png\"\nformat = \"mono16\"\n",
        ],
    );
    fs::write(dir.path().join("camera.toml"), text.replace("c?.png", "c*.png")).unwrap();
    // `c*.png` takes conf.png too: the mixture is named.
    let error = refused(&dir);
    assert!(error.to_string().contains("conf.png has no partner in stream \"ir_right\""), "{error}");
    for i in 0..2 {
        fs::rename(dir.path().join(format!("c{i}.png")), dir.path().join(format!("rgb{i}.png"))).unwrap();
    }
    fs::write(dir.path().join("camera.toml"), text.replace("c?.png", "rgb*.png")).unwrap();
    let mut stream = start(&dir).unwrap();
    let formats: Vec<_> = stream.profiles().iter().map(|p| p.format.name()).collect();
    assert_eq!(formats, ["mono8", "rgb8", "mono16", "confidence8", "mono16"]);
    assert!(stream.profiles().iter().all(|p| !p.intrinsics.is_known()));
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    let shown: Vec<_> = sink.frames.iter().map(|f| f.2.clone()).collect();
    assert_eq!(shown, [pixels(0, 12), pixels(0, 36), grey16.clone(), grey, grey16]);
}

#[test]
fn grey_and_colour_jpeg_play() {
    let dir = tempfile::tempdir().unwrap();
    save(&dir.path().join("g.jpg"), 16, 8, ExtendedColorType::L8, &[200; 128]);
    save(&dir.path().join("c.jpg"), 16, 8, ExtendedColorType::Rgb8, &[[10, 200, 90]; 128].concat());
    let streams = [
        "[[stream]]\nname = \"color\"\nfiles = \"c.jpg\"\n",
        "[[stream]]\nname = \"ir_left\"\nfiles = \"g.jpg\"\n",
    ];
    fs::write(dir.path().join("camera.toml"), manifest("", &streams)).unwrap();
    let mut stream = start(&dir).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    let near = |a: u8, b: u8| a.abs_diff(b) <= 3;
    assert!(sink.frames[0].2.chunks(3).all(|p| near(p[0], 10) && near(p[1], 200) && near(p[2], 90)));
    assert_eq!(sink.frames[0].2.len(), 384);
    assert!(sink.frames[1].2.len() == 128 && sink.frames[1].2.iter().all(|p| near(*p, 200)));
}

/// Damages a good folder of three pairs and looks at the kind and the words of the refusal.
#[track_caller]
fn refuses(text: &str, damage: impl FnOnce(&TempDir), kind: ErrorKind, words: &[&str]) {
    let dir = folder(text, 3);
    damage(&dir);
    let error = refused(&dir);
    let message = error.to_string();
    for word in words {
        assert!(message.contains(word), "{word:?} is not in: {message}");
    }
    assert_eq!(error.kind(), kind, "{message}");
}

fn good() -> String {
    manifest("", &[COLOR, DEPTH])
}

#[test]
fn missing_folders_and_manifests() {
    let nowhere = FilesBackend::new(FilesConfig::new("/nonexistent/cam.toml"));
    let error = nowhere.open(None).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::NotFound);
    assert!(
        error.to_string().contains("/nonexistent/cam.toml") && error.to_string().contains("manifest"),
        "{error}"
    );
    assert_eq!(nowhere.discover().unwrap_err().kind(), ErrorKind::NotFound);

    let gone = manifest("folder = \"gone\"", &[COLOR]);
    refuses(
        &gone,
        |_| (),
        ErrorKind::NotFound,
        &["camera.toml", "gone", "folder = \"gone\"", "no such folder"],
    );
    let file = manifest("folder = \"color_1.png\"", &[COLOR]);
    refuses(&file, |_| (), ErrorKind::BadInput, &["color_1.png", "is not a folder"]);
    let unset = manifest("folder = \"${DEPTHRIG_NO_SUCH_VARIABLE}/x\"", &[COLOR]);
    refuses(&unset, |_| (), ErrorKind::BadInput, &["line 3", "DEPTHRIG_NO_SUCH_VARIABLE", "not set"]);
    refuses(
        &manifest("", &[&COLOR.replace("color_*", "colour_*")]),
        |_| (),
        ErrorKind::BadInput,
        &["line 4", "\"color\"", "no file in", "colour_*.png"],
    );
}

#[test]
fn manifests_that_are_wrong() {
    let bad = |text: &str, words: &[&str]| refuses(text, |_| (), ErrorKind::BadInput, words);
    bad(
        "model = \"x\"\nrate_hz = 30\nrate = 5\n",
        &["camera.toml", "line 3", "unknown field `rate`", "rate_hz"],
    );
    bad("model = \"x\"\n", &["missing field `rate_hz`"]);
    bad("model = \"x\"\nrate_hz = \"fast\"\n", &["line 2", "invalid type"]);
    bad("model = \"x\nrate_hz = 3\n", &["line 1"]);
    bad("model = \"x\"\nrate_hz = 30\n", &["no [[stream]]"]);
    bad(&manifest("", &[COLOR, COLOR]), &["line 7", "second stream \"color\""]);
    bad(&good().replace("\"color\"", "\"Color\""), &["line 5", "\"Color\" cannot be a name"]);
    bad(&good().replace("color_*", "*/color_*"), &["`*` can stand in the file name only"]);
    bad(&good().replace("0.001", "0.001\nunit = 3"), &["unknown field `unit`", "depth_unit_m"]);
    for rate in ["0", "0.0", "-30.0", "nan", "inf", "1e6"] {
        bad(&good().replace("500.0", rate), &["line 2", "Hz is out of range", "at most 1000"]);
    }
    let k = |k: &str| manifest("", &[COLOR, k]);
    bad(
        &k("intrinsics = { fx = 0.0, fy = 1.0, cx = 1.0, cy = 1.0 }\n"),
        &["line 4", "invalid focal lengths"],
    );
    bad(&k("intrinsics = { fx = 1.0, fy = 1.0, cx = 1.0 }\n"), &["missing field `cy`"]);
    bad(
        &k("intrinsics = { fx = 1.0, fy = 1.0, cx = 1.0, cy = 1.0, model = \"fish\" }\n"),
        &["fish", "brown_conrady"],
    );
    bad(
        &k("intrinsics = { fx = 1.0, fy = 1.0, cx = 1.0, cy = 1.0, coeffs = [0.1] }\n"),
        &["1 coefficients", "at most 0"],
    );
    bad(
        &k("intrinsics_file = \"k.txt\"\nintrinsics = { fx = 1.0, fy = 1.0, cx = 1.0, cy = 1.0 }\n"),
        &["both"],
    );
    refuses(&k("intrinsics_file = \"k.txt\"\n"), |_| (), ErrorKind::NotFound, &["k.txt"]);
    let write = |d: &TempDir| fs::write(d.path().join("k.txt"), "1 0 1 0 1 1 0 0").unwrap();
    refuses(&k("intrinsics_file = \"k.txt\"\n"), write, ErrorKind::BadInput, &["k.txt", "8 numbers", "3x3"]);
    let pose = "pose_in_device = { translation_m = [0.0, 0.0, 0.0], rotation_xyzw = [0.0, 0.0, 0.0, 2.0] }\n";
    bad(&k(pose), &["quaternion of length 1"]);

    let dir = folder(&good(), 1);
    let config = FilesConfig { rate_hz: Some(0.0), ..FilesConfig::new(dir.path()) };
    let error = FilesBackend::new(config).open(None).err().unwrap();
    assert!(error.to_string().contains("a rate of 0 Hz is out of range"), "{error}");
}

#[test]
fn images_without_partner() {
    let remove = |name: &'static str| move |d: &TempDir| fs::remove_file(d.path().join(name)).unwrap();
    let bad = ErrorKind::BadInput;
    refuses(
        &good(),
        remove("color_2.png"),
        bad,
        &[
            "depth_0002.png has no partner in stream \"color\"",
            "color_0002.png is not there",
            "2 of \"color_*.png\"",
        ],
    );
    refuses(
        &good(),
        remove("depth_0003.png"),
        bad,
        &["color_3.png has no partner", "depth_3.png is not there"],
    );
    let by_order = manifest("pair_by = \"order\"", &[COLOR, DEPTH]);
    refuses(
        &by_order,
        remove("depth_0001.png"),
        bad,
        &["color_3.png has no partner in stream \"depth\"", "order"],
    );
    let twice = |d: &TempDir| drop(color(d, "color_02.png", 5));
    refuses(&good(), twice, bad, &["color_02.png and color_2.png", "same number"]);
}

#[test]
fn images_that_cannot_be_played() {
    let bad = |damage: &dyn Fn(&Path), words: &[&str]| {
        refuses(&good(), |d| damage(d.path()), ErrorKind::BadInput, words);
    };
    let write = |d: &Path, name: &str, w, h, kind, len| save(&d.join(name), w, h, kind, &pixels(1, len));
    bad(
        &|d| write(d, "color_3.png", 5, 3, ExtendedColorType::Rgb8, 45),
        &["color_1.png is 4x3 8-bit colour", "color_3.png is 5x3 8-bit colour", "alike"],
    );
    bad(&|d| write(d, "color_2.png", 4, 3, ExtendedColorType::L8, 12), &["color_2.png is 4x3 8-bit grey"]);
    bad(
        &|d| write(d, "color_1.png", 4, 3, ExtendedColorType::Rgba8, 48),
        &["color_1.png", "alpha", "mogrify"],
    );
    bad(&|d| write(d, "color_1.png", 4, 3, ExtendedColorType::La8, 24), &["color_1.png", "alpha"]);
    bad(
        &|d| write(d, "color_1.png", 4, 3, ExtendedColorType::Rgb16, 72),
        &["color_1.png", "16-bit colour is not"],
    );
    bad(
        &|d| fs::write(d.join("color_1.png"), "hello, I am no image").unwrap(),
        &["color_1.png", "neither PNG nor"],
    );
    bad(&|d| fs::write(d.join("depth_0002.png"), "").unwrap(), &["depth_0002.png", "cut off"]);
    let whole_len = {
        let dir = folder(&good(), 1);
        fs::metadata(dir.path().join("color_1.png")).unwrap().len()
    };
    for keep in 0..whole_len {
        let cut = |d: &Path| {
            fs::OpenOptions::new().write(true).open(d.join("color_2.png")).unwrap().set_len(keep).unwrap();
        };
        bad(&cut, &["color_2.png: the file is cut off", "copy it again"]);
    }
}

#[test]
fn a_cut_jpeg_is_refused_at_any_length() {
    let dir = tempfile::tempdir().unwrap();
    let streams = ["[[stream]]\nname = \"color\"\nfiles = \"c_*.jpg\"\n"];
    fs::write(dir.path().join("camera.toml"), manifest("", &streams)).unwrap();
    let path = dir.path().join("c_1.jpg");
    save(&path, 16, 16, ExtendedColorType::Rgb8, &pixels(3, 768));
    let whole = fs::read(&path).unwrap();
    assert!(start(&dir).is_ok());
    for keep in 0..whole.len() {
        fs::write(&path, &whole[..keep]).unwrap();
        let error = refused(&dir);
        assert!(error.to_string().contains("c_1.jpg: the file is cut off"), "{keep} bytes: {error}");
    }
    fs::write(&path, [&whole[..], b"\0\0trailing bytes of a camera's own"].concat()).unwrap();
    assert!(start(&dir).is_ok(), "what follows the end mark is nobody's business");
}

#[test]
fn damage_inside_a_png_is_found_when_it_is_played() {
    let dir = folder(&good(), 3);
    let path = dir.path().join("depth_0002.png");
    let mut bytes = fs::read(&path).unwrap();
    let idat = bytes.windows(4).position(|w| w == b"IDAT").unwrap();
    bytes[idat + 12] ^= 0x10;
    fs::write(&path, bytes).unwrap();
    let mut stream = start(&dir).unwrap();
    let mut sink = MemorySink::default();
    play(&mut *stream, &mut sink, 1);
    let error = stream.poll(TIMEOUT, &mut sink).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput);
    assert!(error.to_string().contains("depth_0002.png: the image is damaged"), "{error}");
    assert_eq!(sink.frames.len(), 2, "nothing of the broken pair was published");
}

#[test]
fn depth_needs_a_unit_and_sixteen_bits() {
    let stream = |text: &str| manifest("", &[COLOR, "[[stream]]\n", text]);
    let bad = |text: &str, words: &[&str]| refuses(&stream(text), |_| (), ErrorKind::BadInput, words);
    bad("name = \"depth\"\nfiles = \"depth_*.png\"\n", &["line 7", "depth_unit_m is missing", "0.001"]);
    for unit in ["0.0", "-0.001", "1.0", "nan"] {
        let text = format!("name = \"depth\"\nfiles = \"depth_*.png\"\ndepth_unit_m = {unit}\n");
        bad(&text, &["line 7", "depth_unit_m"]);
    }
    bad("name = \"left\"\nfiles = \"depth_*.png\"\n", &["depth or infrared?", "depth_unit_m", "mono16"]);
    bad("name = \"depth\"\nfiles = \"color_*.png\"\n", &["8-bit colour, but depth is 16-bit"]);
    bad(
        "name = \"rgb\"\nfiles = \"color_*.png\"\ndepth_unit_m = 0.001\n",
        &["rgb8 images have no depth_unit_m"],
    );
    bad("name = \"rgb\"\nfiles = \"color_*.png\"\nformat = \"z16\"\n", &["cannot be z16", "rgb8"]);
}
