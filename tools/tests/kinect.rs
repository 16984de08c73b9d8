//! Azure Kinects from the command line: recordings that are imported, verified, reported, replayed or rejected; and
//! attached cameras through a fake libk4a.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use depthrig_bus::HostTime;
use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode};
use depthrig_kinect_fixture::{Fixture, Pattern};
use depthrig_usb::fake::{FakeDevice, FakeTree};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Output, Stdio};
use support::{Home, Ran, depthrig, wait};

const SERIAL: &str = "000123456789";

fn json(ran: &Ran) -> Value {
    serde_json::from_str(&ran.out).unwrap_or_else(|e| panic!("{e}\n{}\n{}", ran.out, ran.err))
}

/// A fixture written into the home; its path.
fn written(home: &Home, name: &str, fixture: &Fixture) -> String {
    let path = home.path().join(name);
    fixture.write(&path, &mut Pattern::new(fixture)).unwrap();
    path.to_str().unwrap().to_owned()
}

fn at(home: &Home, name: &str) -> String {
    home.path().join(name).to_str().unwrap().to_owned()
}

#[test]
fn recordings_of_every_mode_are_imported_verified_reported_and_replayed() {
    let color = |format, resolution| Some(ColorMode { format, resolution });
    let mjpg = |resolution| color(ColorFormat::Mjpg, resolution);
    let small = || Fixture { captures: 3, ..Fixture::small() };
    let still = || Fixture { captures: 2, motion: false, ..Fixture::small() };
    let mut forms: Vec<(String, Fixture, usize)> = Vec::new();
    for depth in DepthMode::ALL {
        let rate_hz = depth.max_rate_hz();
        let streams = if depth.has_depth() { 3 } else { 2 };
        forms.push((depth.name().into(), Fixture { depth: Some(depth), rate_hz, ..small() }, streams));
    }
    for resolution in ColorResolution::ALL {
        let fixture = Fixture { color: mjpg(resolution), rate_hz: resolution.max_rate_hz(), ..still() };
        forms.push((format!("mjpg_{}", resolution.name()), fixture, 3));
    }
    for format in [ColorFormat::Nv12, ColorFormat::Yuy2, ColorFormat::Bgra] {
        let fixture = Fixture { color: color(format, ColorResolution::P720), ..still() };
        forms.push((format.name().into(), fixture, 3));
    }
    let only_ir = Fixture { color: None, depth: Some(DepthMode::PassiveIr), ..still() };
    forms.push(("without_colour".into(), Fixture { color: None, ..small() }, 2));
    forms.push(("infrared_only".into(), only_ir, 1));
    forms.push(("colour_only".into(), Fixture { depth: None, ..small() }, 1));
    let home = Home::new();
    for (name, fixture, streams) in forms {
        let file = written(&home, "a.mkv", &fixture);
        let out = at(&home, &name);
        let said = home.run(&["import", "kinect", &file, &out, "-q", "--json"]);
        assert_eq!((said.code, said.err.as_str()), (0, ""), "{name}");
        let report = json(&said);
        let accounts = report["facts"]["accounts"].as_array().unwrap();
        let (units, images): (Vec<_>, Vec<_>) = accounts.iter().partition(|a| a["stream"] == "kinect/imu");
        assert_eq!((images.len(), units.len()), (streams, usize::from(fixture.motion)), "{name}");
        assert!(images.iter().all(|a| a["delivered"] == fixture.captures), "{name}: {accounts:?}");
        assert!(report["facts"]["left_out"].get("motion_samples").is_none(), "{name}");
        let verified = json(&home.run(&["verify", "--decode", "--json", &out, "-q"]));
        assert_eq!(verified["findings"].as_array().map(Vec::len), Some(0), "{name}: {verified}");
        home.run(&["report", &out, "-q"]).good();
        let replayed = home.run(&["replay", &out, "--as-fast-as-possible", "--json", "-q"]);
        let replayed: Value = serde_json::from_str(&replayed.good()).unwrap();
        let frames = u64::from(fixture.captures) * streams as u64;
        assert!(replayed.to_string().contains(&frames.to_string()), "{name}: {replayed}");
        std::fs::remove_dir_all(&out).unwrap();
    }
}

#[test]
fn what_comes_over_of_motion_is_said_to_the_person_and_in_the_dataset() {
    let home = Home::new();
    let file = written(&home, "a.mkv", &Fixture::small());
    let out = at(&home, "out");
    let said = home.run(&["import", "kinect", &file, &out]).good();
    let line = said.lines().find(|l| l.contains("samples of accelerometer and gyroscope came over")).unwrap();
    let n: u64 = line.split(' ').find_map(|word| word.parse().ok()).unwrap();
    assert!((318..=322).contains(&n) && line.contains("0 were left out"), "{line}");
    let session = std::fs::read_to_string(home.path().join("out/session.toml")).unwrap();
    assert!(session.contains("[[motion]]") && session.contains("kinect/imu"), "{session}");
    assert!(!session.contains("motion_samples"), "{session}");
}

#[test]
fn recordings_that_cannot_be_imported_say_why_and_what_to_do() {
    let home = Home::new();
    let plain = Fixture { motion: false, ..Fixture::small() };
    let file = written(&home, "a.mkv", &plain);
    let bare = written(&home, "bare.mkv", &Fixture { calibration: None, ..plain.clone() });
    let odd = written(&home, "odd.mkv", &Fixture { calibration: Some("{}".into()), ..plain.clone() });
    let (bytes, places) = plain.bytes_and_places();
    let write = |name: &str, bytes: &[u8]| {
        std::fs::write(home.path().join(name), bytes).unwrap();
        at(&home, name)
    };
    let cut = places.clusters[4] as usize + 999;
    let mut foreign = bytes.clone();
    for i in 0..20_000 {
        if foreign[i..].starts_with(b"K4A_") {
            foreign[i..i + 4].copy_from_slice(b"XYZ_");
        }
    }
    // Where outputs go: one beside the inputs would lie in the input that is a folder.
    let elsewhere = Home::new();
    for (file, code, parts) in [
        (write("empty.mkv", b""), 1, &["the file is empty"][..]),
        (write("text.mkv", b"hello"), 1, &["not a Matroska file (.mkv)"]),
        (write("other.mkv", &foreign), 1, &["no recording of an Azure Kinect", "\"COLOR\""]),
        (write("head.mkv", &bytes[..2000]), 1, &["cut off or damaged before its first image"]),
        (at(&home, "nowhere.mkv"), 1, &["nowhere.mkv cannot be opened: No such file"]),
        (at(&home, ""), 1, &["cannot be opened: it is a folder; a regular file is needed"]),
        (bare.clone(), 2, &["no calibration.json", "`calibration`", "\"none\""]),
        (odd, 1, &["the Kinect's calibration: no object CalibrationInformation"]),
    ] {
        let out = at(&elsewhere, "out");
        let ran = home.run(&["import", "kinect", &file, &out]);
        assert_eq!(ran.code, code, "{file}: {}", ran.err);
        for part in parts {
            assert!(ran.err.contains(part), "{part} in {}", ran.err);
        }
        assert!(!Path::new(&out).exists(), "{file}: nothing is left behind");
    }
    // The complete clusters of a truncated file are imported, and the exit code reports the loss.
    let ran = home.run(&["import", "kinect", &write("cut.mkv", &bytes[..cut]), &at(&home, "cut")]);
    assert_eq!(ran.code, 3, "{}", ran.err);
    assert!(
        ran.err.contains("lost: ") && ran.err.contains("at one place are damaged or cut off"),
        "{}",
        ran.err
    );
    assert!(ran.out.contains("4 sets"), "{}", ran.out);
    // The imported part is sound but incomplete.
    assert_eq!(home.run(&["verify", "--decode", &at(&home, "cut"), "-q"]).code, 3);
    // With a calibration of its own, or without any, it goes.
    let calibration = home.write("device.json", depthrig_kinect_fixture::CALIBRATION);
    home.run(&["import", "kinect", &bare, &at(&home, "given"), "--calibration", &calibration]).good();
    let said = home.run(&["import", "kinect", &bare, &at(&home, "none"), "--calibration", "none"]).good();
    assert!(said.contains("there is no calibration: intrinsics are unknown"), "{said}");
    // An existing dataset is kept.
    let ran = home.run(&["import", "kinect", &file, &at(&home, "given")]);
    assert!(ran.code == 1 && ran.err.contains("holds a dataset already"), "{}", ran.err);
}

/// A computer with a fake libk4a and optionally a depth engine beside it.
struct Computer {
    home: Home,
}

impl Computer {
    fn new(with_engine: bool) -> Self {
        let home = Home::new();
        std::fs::create_dir(home.path().join("k4a")).unwrap();
        let exe = std::env::current_exe().unwrap();
        let built = exe.ancestors().skip(1).take(2).map(|f| f.join("libfake_k4a.so")).find(|p| p.is_file());
        let built: PathBuf = built.expect("libfake_k4a.so is built with the tests");
        std::fs::copy(&built, home.path().join("k4a/libk4a.so.1.4")).unwrap();
        if with_engine {
            std::fs::copy(&built, home.path().join("k4a/libdepthengine.so.2.0")).unwrap();
        }
        let tree = FakeTree::new(&home.path().join("computer"));
        for (port, product, interfaces) in [
            ("2-1.1", 0x097c, vec![(0, 0xff, 0, "", vec![], vec![])]),
            ("2-1.2", 0x097d, vec![(0, 0x0e, 1, "uvcvideo", vec![0, 1], vec![])]),
        ] {
            let strings = ["Microsoft Corp.", "Azure Kinect", SERIAL];
            tree.plug(&FakeDevice { id: (0x045e, product), strings, interfaces, ..FakeDevice::new(port, 0) });
        }
        Self { home }
    }

    fn command(&self, args: &[&str]) -> std::process::Command {
        let mut command = depthrig();
        command.arg("--runtime-dir").arg(self.home.path().join("run")).args(args).stdin(Stdio::null());
        command.env("DEPTHRIG_FAKE_K4A", SERIAL).env_remove("DISPLAY").env_remove("DEPTHRIG_LIBK4A");
        command
    }

    fn run(&self, args: &[&str]) -> (i32, String, String) {
        outcome(&self.command(args).output().unwrap())
    }

    /// A rig of the Kinect; `library` is a folder below the home.
    fn rig(&self, library: &str) -> String {
        let text = format!(
            "rig = \"kin\"\n[recording]\nallow = [\"data\"]\nreserve_mb = 16\n[[camera]]\nname = \"overhead\"\nbackend = \"kinect\"\nserial = \"{SERIAL}\"\n\
             library = \"{library}\"\ndepth_engine = \"{library}\"\n[[camera.stream]]\nname = \"depth\"\nwidth = 320\nheight = 288\n"
        );
        self.home.write("rig.toml", &text)
    }
}

fn outcome(output: &Output) -> (i32, String, String) {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

fn ids(report: &str) -> Vec<String> {
    let report: Value = serde_json::from_str(report).unwrap_or_else(|e| panic!("{e}: {report}"));
    report["findings"].as_array().unwrap().iter().map(|f| f["id"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn a_kinect_is_listed_with_and_without_its_library() {
    let computer = Computer::new(true);
    let root = computer.home.path().join("computer");
    let args = ["cameras", "--json", "--sys-root", root.to_str().unwrap()];
    let asked = computer.command(&args).env("DEPTHRIG_LIBK4A", computer.home.path().join("k4a")).output();
    let (code, out, err) = outcome(&asked.unwrap());
    let found: Value = serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out} {err}"));
    let camera = &found["cameras"][0];
    for (key, value) in [
        ("model", "Azure Kinect"),
        ("serial", SERIAL),
        ("port", "2-1.1"),
        ("backend", "kinect"),
        ("state", "free"),
        ("calibration", "factory"),
        ("firmware", "color 1.6.110, depth 1.6.79"),
    ] {
        assert_eq!(camera[key], value, "{key}: {camera}");
    }
    assert_eq!((code, found["cameras"].as_array().unwrap().len()), (0, 1), "{out}");
    assert!(camera["modes"].as_array().unwrap().len() > 30, "{camera}");
    // Without the library the camera is still found on the bus, and the message says what to install.
    let empty = computer.home.path().join("computer");
    let asked = computer.command(&args).env("DEPTHRIG_LIBK4A", empty).output().unwrap();
    let (code, out, _) = outcome(&asked);
    let found: Value = serde_json::from_str(&out).unwrap();
    assert_eq!((code, &found["cameras"][0]["serial"]), (3, &Value::from(SERIAL)), "{out}");
    let problems = found["cameras"][0]["problems"].to_string();
    assert!(problems.contains("libk4a1.4") && problems.contains("DEPTHRIG_LIBK4A"), "{problems}");
}

#[test]
fn doctor_says_what_a_kinect_lacks() {
    let computer = Computer::new(false);
    std::fs::create_dir(computer.home.path().join("empty")).unwrap();
    let doctor = |library: &str| {
        let rig = computer.rig(library);
        let (code, out, _) = computer.run(&["doctor", &rig, "--no-disk", "--json"]);
        assert_eq!(code, 1, "{out}");
        let text = computer.run(&["doctor", &rig, "--no-disk"]).1;
        assert!(text.lines().all(|l| l.chars().count() <= 120), "{text}");
        (ids(&out), text)
    };
    let has = |ids: &[String], id: &str| ids.iter().any(|i| i == id);
    let (found, text) = doctor("empty");
    assert!(has(&found, "kinect_library") && !has(&found, "kinect_engine"), "{found:?}");
    assert!(text.contains("libk4a1.4") && text.contains("packages.microsoft.com"), "{text}");
    let (found, text) = doctor("k4a");
    assert!(has(&found, "kinect_engine") && !has(&found, "kinect_library"), "{found:?}");
    assert!(text.contains("libdepthengine.so.2.0"), "{text}");
    let computer = Computer::new(true);
    let rig = computer.rig("k4a");
    let (_, out, _) = computer.run(&["doctor", &rig, "--no-disk", "--json"]);
    assert!(has(&ids(&out), "kinect_display") && !has(&ids(&out), "kinect_engine"), "{out}");
}

#[test]
fn a_rig_of_an_attached_kinect_runs_and_records() {
    let computer = Computer::new(true);
    let rig = computer.rig("k4a");
    let data = at(&computer.home, "data");
    let mut command = computer.command(&["run", &rig]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let status = || computer.run(&["status", "--json"]);
    wait(|| status().1.contains("\"streaming\""), "the Kinect does not stream");
    let (code, out, err) = computer.run(&["record", "start", "--out", &data, "--name", "one", "--force"]);
    assert_eq!(code, 0, "{out} {err}");
    let sets = || {
        let said = computer.run(&["record", "status", "--json"]).1;
        serde_json::from_str::<Value>(&said).ok().and_then(|s| s["sets"].as_u64()).unwrap_or(0)
    };
    wait(|| sets() >= 3, "the recording gets no sets");
    assert_eq!(computer.run(&["record", "stop"]).0, 0);
    let ended = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(ended.success());
    // 3: on a busy machine an image is lost now and then.
    assert!(matches!(child.wait().unwrap().code(), Some(0 | 3)));
    let (code, out, err) = computer.run(&["verify", "--decode", &format!("{data}/one")]);
    assert_eq!(code, 0, "{out} {err}");
    // Without the library it does not start, and says what to install.
    std::fs::create_dir(computer.home.path().join("empty")).unwrap();
    let (code, _, err) = computer.run(&["run", &computer.rig("empty")]);
    assert!(code != 0 && err.contains("libk4a1.4") && err.contains("overhead"), "{code}: {err}");
}

/// A daemon that is stopped and goes on counts the frames of that time, of a camera that has no frame counter too.
#[test]
fn a_stopped_daemon_counts_the_frames_that_it_missed() {
    let home = Home::new();
    let fixture = Fixture { captures: 60, rate_hz: 15, motion: false, ..Fixture::small() };
    let recording = written(&home, "a.mkv", &fixture);
    let text = format!(
        "rig = \"stopped\"\n[recording]\nreserve_mb = 16\n[[camera]]\nname = \"k\"\nbackend = \"kinect\"\n\
         recording = \"{recording}\"\nloop = true\n"
    );
    let running = home.start(&["run", &home.write("rig.toml", &text), "-q"]);
    // Delivered, lost and the reconnects of its first stream.
    let account = || {
        let status: Value = serde_json::from_str(&home.run(&["status", "--json"]).out).unwrap_or_default();
        let camera = &status["cameras"][0];
        let stream = &camera["streams"][0];
        let lost = stream["dropped"]["device_gap"].as_u64().unwrap_or(0);
        [stream["delivered"].as_u64().unwrap_or(0), lost, camera["reconnects"].as_u64().unwrap_or(0)]
    };
    wait(|| account()[0] > 5, "the recording does not play");
    let [_, lost_before, _] = account();
    let begin = HostTime::now();
    running.send("STOP");
    let stopped = HostTime::now();
    std::thread::sleep(std::time::Duration::from_secs(4));
    let woken = HostTime::now();
    running.send("CONT");
    let [delivered, ..] = account();
    wait(|| account()[0] > delivered + 15, "it does not play on");
    let end = HostTime::now();
    let [_, lost, reconnects] = account();
    // Exact within a frame; how long a busy computer takes to stop and wake it is measured.
    let frames = |from: HostTime, to: HostTime| to.since_ns(from) as f64 / 1e9 * 15.0;
    let least = frames(stopped, woken) - 2.0;
    let most = frames(begin, end) + 2.0;
    let counted = (lost - lost_before) as f64;
    assert!((least..=most).contains(&counted), "{counted} counted, {least:.1} to {most:.1} missed");
    assert_eq!(reconnects, 0);
    let _ = running.interrupt();
}
