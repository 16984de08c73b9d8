//! `depthrig zed replay` from the command line: its output, its exit codes, and its messages for invalid input.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use depthrig_cdm::FakeNetwork;
use depthrig_zed::replay::fake::{FakeSvo, SERIAL, noise};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;
use support::Home;

/// Size of one image of a ZED in VGA.
const IMAGE_SIZE: (u32, u32) = (672, 376);
/// Disparity of the wall, pixels; with 300 pixels of focal length and a baseline of 0.12 m it is 1.8 m away.
const DISPARITY: u32 = 20;

/// A factory calibration of aligned cameras, without the lines that begin with one of `without`.
fn conf(without: &[&str]) -> String {
    let side =
        |e: &str| format!("[{e}_CAM_VGA]\nfx=300\nfy=300\ncx=336\ncy=188\nk1=0\nk2=0\np1=0\np2=0\nk3=0\n");
    let stereo = "[STEREO]\nBaseline=120\nTY=0\nTZ=0\nCV_VGA=0\nRX_VGA=0\nRZ_VGA=0\n";
    let text = format!("{stereo}{}{}", side("LEFT"), side("RIGHT"));
    text.split_inclusive('\n').filter(|l| !without.iter().any(|w| l.starts_with(w))).collect()
}

/// Left and right image side by side: a wall of noise, different for each `n`, `width` pixels wide.
fn side_by_side((width, height): (u32, u32), n: u32, swapped: bool) -> image::GrayImage {
    let side = width / 2;
    let spot = |x: u32, y: u32| {
        let v = (x / 2).wrapping_mul(7919) ^ (y / 2).wrapping_mul(104_729) ^ n.wrapping_mul(15_485_863);
        (v.wrapping_mul(2_654_435_761) >> 13) as u8
    };
    image::GrayImage::from_fn(width, height, |x, y| {
        let is_right = (x >= side) != swapped;
        image::Luma([spot(x % side.max(1) + if is_right { DISPARITY } else { 0 }, y)])
    })
}

/// A folder with `pairs` pairs and the camera's calibration.
fn folder(home: &Home, name: &str, pairs: u32, swapped: bool) -> String {
    let dir = home.path().join(name);
    std::fs::create_dir_all(&dir).unwrap();
    for n in 0..pairs {
        side_by_side((2 * IMAGE_SIZE.0, IMAGE_SIZE.1), n, swapped)
            .save(dir.join(format!("pair_{n:03}.png")))
            .unwrap();
    }
    std::fs::write(dir.join("SN123.conf"), conf(&[])).unwrap();
    dir.to_str().unwrap().to_owned()
}

fn path(home: &Home, name: &str) -> String {
    home.path().join(name).to_str().unwrap().to_owned()
}

/// Asserts that it is refused as wrong usage with these words, and leaves nothing behind.
#[track_caller]
fn refused(home: &Home, input: &str, more: &[&str], words: &[&str]) {
    ends(2, home, input, more, words);
}

/// Asserts that it fails with these words because of an invalid file, and leaves nothing behind.
#[track_caller]
fn failed(home: &Home, input: &str, more: &[&str], words: &[&str]) {
    ends(1, home, input, more, words);
}

#[track_caller]
fn ends(code: i32, home: &Home, input: &str, more: &[&str], words: &[&str]) {
    let out = path(home, "refused");
    let ran = home.run(&[&["zed", "replay", input, "--out", &out], more].concat());
    assert_eq!(ran.code, code, "{more:?}: {}{}", ran.out, ran.err);
    for word in words {
        assert!(ran.err.contains(word), "{word:?} is not in: {}", ran.err);
    }
    assert!(ran.err.starts_with("depthrig: error: ") || ran.err.starts_with("error: "), "{}", ran.err);
    for left in [out.clone(), format!("{out}.zedreplay")] {
        assert!(!Path::new(&left).exists(), "{left} was left behind");
    }
}

#[test]
fn what_it_prints_and_that_nothing_is_overwritten() {
    let home = Home::new();
    let input = folder(&home, "in", 3, false);
    let out = path(&home, "out");
    // The order of the modes is the one that was asked for.
    let args = ["zed", "replay", &input, "--out", &out, "--modes", "quality,performance"];
    let ran = home.run(&[&args[..], &["--json"]].concat());
    assert_eq!(ran.code, 0, "{}", ran.err);
    let report: Value = serde_json::from_str(&ran.out).expect("nothing but JSON on the standard output");
    let names = |key: &str| -> Vec<String> {
        report["modes"].as_array().unwrap().iter().map(|m| m[key].as_str().unwrap().to_owned()).collect()
    };
    assert_eq!(names("mode"), ["quality", "performance"]);
    assert_eq!(names("recorded_as"), ["mimic_quality", "mimic_performance"]);
    assert_eq!((&report["sets"], &report["lost"], &report["ended"]), (&3.into(), &0.into(), &false.into()));
    assert_eq!(report["modes"][0]["frames"], 3);
    assert!(report["cpu"]["stereo_s"].as_f64().unwrap() > 0.0 && report["verified"].is_object(), "{report}");
    // Not a terminal: plain lines, no codes.
    assert!(ran.err.contains("depth: 100 %") && ran.err.contains("verify: 100 %"), "{}", ran.err);
    assert!(!ran.err.contains('\x1b') && !ran.err.contains('\r'), "{:?}", ran.err);

    let session = std::fs::read_to_string(Path::new(&out).join("session.toml")).unwrap();
    for part in ["mimic_quality", "mimic_performance", "preset=quality max_disparity=", "depthrig-sgm"] {
        assert!(session.contains(part), "{part} is not in {session}");
    }
    let said = home.run(&["info", &out]).good();
    assert!(said.contains("mimic_quality"), "{said}");
    home.run(&["verify", &out, "--decode"]).good();

    let again = home.run(&args);
    assert_eq!(again.code, 1, "{}", again.err);
    assert!(again.err.contains("is there already"), "{}", again.err);

    let second = path(&home, "second");
    let said = home.run(&["zed", "replay", &input, "--out", &second, "--modes", "performance"]);
    assert!(
        said.out.contains("3 sets") && said.out.contains("performance: 3 frames, mimic_performance by"),
        "{}",
        said.out
    );
    let third = path(&home, "third");
    let ran = home.run(&["-q", "zed", "replay", &input, "--out", &third, "--modes", "performance"]);
    assert_eq!(
        (ran.code, ran.out.as_str(), ran.err.as_str()),
        (0, "", ""),
        "-q says nothing when all is well"
    );
}

#[test]
fn a_terminal_gets_a_bar() {
    let home = Home::new();
    let input = folder(&home, "in", 2, false);
    let out = path(&home, "out");
    let line = format!(
        "'{}' zed replay '{input}' --out '{out}' --modes performance > '{}'",
        env!("CARGO_BIN_EXE_depthrig"),
        path(&home, "stdout")
    );
    // `script` (of bsdutils, which every Debian has) gives it a terminal.
    let Ok(ran) = Command::new("script").args(["-qec", &line, "/dev/null"]).env("TERM", "xterm").output()
    else {
        println!("skipped: there is no script(1)");
        return;
    };
    let shown = String::from_utf8_lossy(&ran.stdout).into_owned();
    assert!(ran.status.success(), "{shown}");
    assert!(shown.contains('\x1b') && shown.contains("depth") && shown.contains('['), "{shown:?}");
    assert!(!shown.contains("depth: 100 %"), "no plain lines beside the bar: {shown:?}");
    let report = std::fs::read_to_string(home.path().join("stdout")).unwrap();
    assert!(report.contains("2 sets") && !report.contains('\x1b'), "{report:?}");
}

#[test]
fn modes_that_are_not_there() {
    let home = Home::new();
    let input = folder(&home, "in", 1, false);
    let out = path(&home, "out");
    refused(
        &home,
        &input,
        &["--modes", "best"],
        &["no mode \"best\"", "performance, ultra, quality, neural"],
    );
    refused(&home, &input, &["--modes", "quality,quality"], &["twice"]);
    refused(
        &home,
        &input,
        &["--modes", "neural"],
        &["unavailable, because no network was given", "--network FILE.onnx"],
    );
    refused(&home, &input, &["--modes", "quality", "--network", "n.onnx"], &["for the mode neural"]);
    let ran =
        home.run(&["zed", "replay", &input, "--out", &out, "--modes", "performance,neural", "--json", "-q"]);
    assert_eq!(ran.code, 3, "{}", ran.err);
    let report: Value = serde_json::from_str(&ran.out).unwrap();
    assert_eq!(report["modes"].as_array().unwrap().len(), 1);
    assert!(report["unavailable"][0].as_str().unwrap().contains("unavailable, because"), "{report}");
    home.run(&["verify", &out]).good();
}

#[test]
fn a_network_of_another_kind() {
    let home = Home::new();
    let input = folder(&home, "in", 1, false);
    let file = home.path().join("net.onnx");
    let wrong = FakeNetwork { channels: 4, ..FakeNetwork::default() };
    std::fs::write(&file, wrong.file()).unwrap();
    let args = ["--modes", "neural", "--network", file.to_str().unwrap()];
    let ran = home.run(&[&["zed", "replay", &input, "--out", &path(&home, "out")], &args[..]].concat());
    assert_eq!(ran.code, 2, "{}", ran.err);
    if ran.err.contains("ONNX Runtime was not found") {
        assert!(std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none(), "{}", ran.err);
        println!("skipped: {}", ran.err);
        return;
    }
    refused(&home, &input, &args, &["mode neural", "another number of channels; taken are"]);
    std::fs::write(&file, "no network").unwrap();
    refused(&home, &input, &args, &["mode neural", "net.onnx"]);
    std::fs::remove_file(&file).unwrap();
    mknodat(CWD, &file, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    refused(&home, &input, &args, &["mode neural", "net.onnx", "it is a FIFO"]);
}

#[test]
fn images_that_will_not_do() {
    let home = Home::new();
    let swapped = folder(&home, "swapped", 2, true);
    refused(&home, &swapped, &[], &["left and right are swapped"]);
    let odd = home.path().join("odd");
    std::fs::create_dir(&odd).unwrap();
    side_by_side((2 * IMAGE_SIZE.0 - 1, IMAGE_SIZE.1), 0, false).save(odd.join("1.png")).unwrap();
    std::fs::write(odd.join("SN123.conf"), conf(&[])).unwrap();
    failed(&home, odd.to_str().unwrap(), &[], &["a side-by-side image has an even width", "1343x376"]);
    let empty = home.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    failed(&home, empty.to_str().unwrap(), &[], &["no side-by-side images"]);
    let ran = home.run(&["zed", "replay", "/nonexistent", "--out", &path(&home, "refused")]);
    assert_eq!(ran.code, 1, "{}", ran.err);
    assert!(ran.err.contains("/nonexistent"), "{}", ran.err);
}

#[test]
fn a_pair_that_cannot_be_read_is_lost_and_said() {
    let home = Home::new();
    let input = folder(&home, "in", 3, false);
    let out = path(&home, "out");
    let damaged = Path::new(&input).join("pair_001.png");
    let mut bytes = std::fs::read(&damaged).unwrap();
    // One that is cut off is seen at once, when all of them are looked at.
    std::fs::write(&damaged, &bytes[..bytes.len() / 2]).unwrap();
    failed(&home, &input, &[], &["pair_001.png", "cut off"]);
    let middle = bytes.len() / 2;
    bytes[middle..middle + 64].fill(0xff);
    std::fs::write(&damaged, bytes).unwrap();
    let ran = home.run(&["zed", "replay", &input, "--out", &out, "--modes", "performance", "--json", "-q"]);
    assert_eq!(ran.code, 3, "{}", ran.err);
    assert!(ran.err.contains("lost: pair 1 of") && ran.err.contains("pair_001.png"), "{}", ran.err);
    let report: Value = serde_json::from_str(&ran.out).unwrap();
    assert_eq!(
        (&report["sets"], &report["lost"], &report["modes"][0]["frames"]),
        (&3.into(), &1.into(), &2.into())
    );
}

#[test]
fn calibrations_that_will_not_do() {
    let home = Home::new();
    let input = folder(&home, "in", 1, false);
    let file = Path::new(&input).join("SN123.conf");
    for (without, words) in [
        ("fx=", &["has no fx", "SN123.conf"][..]),
        ("Baseline", &["[STEREO] has no Baseline"]),
        ("RX_VGA", &["RX_VGA"]),
        ("[RIGHT_CAM", &["has no [RIGHT_CAM_VGA]"]),
    ] {
        std::fs::write(&file, conf(&[without])).unwrap();
        failed(&home, &input, &[], words);
    }
    // Half as large: the file has nothing for it.
    let small = home.path().join("small");
    std::fs::create_dir(&small).unwrap();
    side_by_side((IMAGE_SIZE.0, IMAGE_SIZE.1 / 2), 0, false).save(small.join("1.png")).unwrap();
    let whole = home.write("whole.conf", &conf(&[]));
    let args = ["--calibration", whole.as_str()];
    failed(&home, small.to_str().unwrap(), &args, &["336x188", "672x376", "must not be resized"]);
    refused(&home, small.to_str().unwrap(), &[], &["has no calibration", "--calibration"]);
    let absent = path(&home, "absent.conf");
    failed(&home, &input, &["--calibration", &absent], &["absent.conf"]);
}

#[test]
fn svo2_files_that_will_not_do() {
    let home = Home::new();
    let write = |name: &str, bytes: &[u8]| {
        let file = home.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        file.to_str().unwrap().to_owned()
    };
    home.write(&format!("SN{SERIAL}.conf"), &conf(&[]));
    let mut secret = FakeSvo::new(IMAGE_SIZE, (0..3).map(|_| noise(3000)).collect());
    secret.header = Some(FakeSvo::header_of(IMAGE_SIZE, "5.0.1", true));
    failed(
        &home,
        &write("secret.svo2", &secret.build()),
        &[],
        &["secret.svo2", "it is encrypted", "convert it"],
    );
    let whole = FakeSvo::strips(IMAGE_SIZE, 3).build();
    failed(&home, &write("cut.svo2", &whole[..40]), &[], &["cut.svo2"]);
    failed(&home, &write("text.svo2", b"not a recording"), &[], &["text.svo2"]);
    let good = write("good.svo2", &whole);
    let out = path(&home, "out");
    home.run(&["zed", "replay", &good, "--out", &out, "--modes", "performance"]).good();
    home.run(&["verify", &out]).good();
}

/// Segments of the dataset that grows.
fn segments(out: &str) -> usize {
    let dir = PathBuf::from(format!("{out}.zedreplay/dataset"));
    let Ok(entries) = std::fs::read_dir(dir) else { return 0 };
    entries.flatten().filter(|e| e.file_name().to_string_lossy().ends_with(".mcap")).count()
}

#[test]
fn it_goes_on_where_it_was_killed() {
    let home = Home::new();
    let input = folder(&home, "in", 12, false);
    let out = path(&home, "out");
    let whole = path(&home, "whole");
    // A segment for each pair: they are 20 s apart.
    let with = |out: &str| -> Vec<String> {
        let args = [
            "zed",
            "replay",
            &input,
            "--out",
            out,
            "--rate",
            "0.05",
            "--modes",
            "performance,quality",
            "-j",
            "1",
        ];
        args.map(str::to_owned).to_vec()
    };
    let run = |args: &[String]| home.run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    run(&with(&whole)).good();
    let args = with(&out);
    for more in [3, 5] {
        let running = home.start(&args.iter().map(String::as_str).collect::<Vec<_>>());
        let mut polls = 0;
        while segments(&out) < more {
            polls += 1;
            assert!(polls < 60_000, "no segments come");
            std::thread::sleep(Duration::from_millis(2));
        }
        running.signal("KILL");
        assert!(!Path::new(&out).exists(), "it was killed before its end");
    }
    let other = run(&[with(&out), vec!["--depth-unit".into(), "0.0001".into()]].concat());
    assert_eq!(other.code, 1, "{}", other.err);
    assert!(other.err.contains("begun with another depth_unit_m"), "{}", other.err);
    let report: Value =
        serde_json::from_str(&run(&[with(&out), vec!["--json".into()]].concat()).good()).unwrap();
    assert_eq!(report["sets"], 12);
    assert!(report["resumed"].as_u64().unwrap() >= 4, "finished segments are kept: {report}");
    assert!(!Path::new(&format!("{out}.zedreplay")).exists());
    home.run(&["compare", &whole, &out, "--strict"]).good();
    // Ctrl-C instead: exit code 1, and the way to go on is said.
    let third = path(&home, "third");
    let args = with(&third);
    let running = home.start(&args.iter().map(String::as_str).collect::<Vec<_>>());
    while segments(&third) < 2 {
        std::thread::sleep(Duration::from_millis(2));
    }
    let ended = running.interrupt();
    assert_eq!(ended.code, 1, "{}{}", ended.out, ended.err);
    assert!(ended.out.contains("run it again to resume"), "{}", ended.out);
    run(&args).good();
}
