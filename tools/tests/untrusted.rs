//! Untrusted paths and texts at the command line: special files are refused without blocking on them, terminal control
//! sequences are escaped, and inputs are not written to.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_kinect_fixture::{Fixture, Pattern};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// Far longer than any of these commands takes.
const POLLS: u32 = 600;

/// Runs the binary in `dir`; one that does not end is killed and fails the test.
fn run(dir: &Path, args: &[&str]) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_depthrig"))
        .args(args)
        .current_dir(dir)
        .env("DEPTHRIG_RUNTIME_DIR", dir.join("runtime"))
        .env("NO_COLOR", "1")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    for _ in 0..POLLS {
        if child.try_wait().unwrap().is_some() {
            return child.wait_with_output().unwrap();
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    child.kill().unwrap();
    let output = child.wait_with_output().unwrap();
    panic!("depthrig {args:?} never ends: {}", String::from_utf8_lossy(&output.stderr));
}

fn text(output: &Output) -> String {
    [&output.stdout[..], &output.stderr].map(String::from_utf8_lossy).concat()
}

fn fifo(path: &Path) {
    mknodat(CWD, path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
}

/// A dataset without a set whose session says `scene`, of a camera of this model.
fn dataset(dir: &Path, name: &str, scene: &str, model: &str) {
    let text = format!(
        "name = \"{name}\"\nrig = \"rig\"\nstarted_utc_ns = 1\nscene = \"{scene}\"\n\n[[streams]]\nid = \"a/color\"\n\
         model = \"{model}\"\nformat = \"rgb8\"\nwidth = 4\nheight = 4\n\n[streams.intrinsics]\nfx = 1.0\nfy = 1.0\n\
         cx = 1.0\ncy = 1.0\n\n[streams.pose]\ntranslation_m = [0.0, 0.0, 0.0]\nrotation_xyzw = [0.0, 0.0, 0.0, 1.0]\n\n\
         [[motion]]\nid = \"a/imu\"\nbatch = 1\n\n[motion.pose]\ntranslation_m = [0.0, 0.0, 0.0]\n\
         rotation_xyzw = [0.0, 0.0, 0.0, 1.0]\n"
    );
    fs::create_dir(dir.join(name)).unwrap();
    fs::write(dir.join(name).join("session.toml"), text).unwrap();
}

#[test]
fn a_fifo_or_a_device_in_the_place_of_a_file_is_refused_and_not_waited_for() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path();
    for name in ["f", "f.mkv", "f.bag", "f.svo2", "f.png", "f.conf", "f.json", "f.toml", "f.onnx", "f.npy"] {
        fifo(&dir.join(name));
    }
    dataset(dir, "segment", "", "");
    fifo(&dir.join("segment/seg_0000.mcap"));
    dataset(dir, "part", "", "");
    fifo(&dir.join("part/seg_0000.mcap.part"));
    fs::create_dir(dir.join("session")).unwrap();
    fifo(&dir.join("session/session.toml"));
    dataset(dir, "endless", "", "");
    std::os::unix::fs::symlink("/dev/zero", dir.join("endless/seg_0000.mcap")).unwrap();
    for name in ["images", "camera"] {
        fs::create_dir(dir.join(name)).unwrap();
    }
    fifo(&dir.join("images/a.png"));
    fs::create_dir(dir.join("images/camera_d435")).unwrap();
    fifo(&dir.join("images/camera_d435/depth_0.png"));
    fifo(&dir.join("camera/camera.toml"));
    let rig = "rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"files\"\nmanifest = \"camera\"\n";
    fs::write(dir.join("files.toml"), rig).unwrap();

    let mut named = 0;
    for line in [
        "sessions .",
        "info f",
        "info segment",
        "info part",
        "info session",
        "info endless",
        "verify f",
        "verify segment",
        "verify part",
        "verify session",
        "verify endless",
        "recover segment",
        "recover part",
        "recover session",
        "recover endless",
        "report segment",
        "cat segment",
        "cat f",
        "trim segment out",
        "merge segment part --out out",
        "merge out segment part",
        "compare segment part",
        "replay segment",
        "edit segment --scene x",
        "export lerobot segment out",
        "export hdf5 segment out",
        "export zarr segment out",
        "export bytecameradepth part out",
        "import kinect f.mkv out",
        "import kinect f.mkv out --calibration f.json",
        "import rosbag f.bag out",
        "import bytecameradepth images out",
        "zed replay f.svo2 --out out --modes quality",
        "zed replay f --out out --modes quality",
        "zed replay images --out out --modes quality --calibration f.conf",
        "config check f",
        "config check f.toml",
        "config check files.toml",
        "run f.toml",
        "doctor f.toml",
        "stereo f.png f.png --out o.png",
        "eval --truth f.png --pred f.png",
        "eval --truth images --pred images",
        "cdm run --rgb f.png --depth f.png --depth-unit 0.001 --engine fill --out o.png",
        "cdm import f --name x",
        "cdm verify f",
    ] {
        let args: Vec<_> = line.split_whitespace().collect();
        let output = run(dir, &args);
        let said = text(&output);
        assert!(said.lines().count() < 60, "{line}: {said}");
        named += usize::from(said.contains("it is a FIFO") || said.contains("it is a device"));
    }
    // The others end at something else first, such as an argument that they need.
    assert!(named >= 25, "{named} name the file type");
    let said = text(&run(dir, &["recover", "segment"]));
    assert!(said.contains("it is a FIFO; a regular file is needed"), "{said}");
}

/// Files that are named by others or read after them, each a FIFO beside what is as it should be.
#[test]
fn a_fifo_beside_what_is_good_is_refused_by_name() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path();
    for name in ["f.conf", "f.json", "f.npy"] {
        fifo(&dir.join(name));
    }
    for name in ["pairs", "lens", "models/x", "root/etc/udev/rules.d"] {
        fs::create_dir_all(dir.join(name)).unwrap();
    }
    image::GrayImage::new(2 * 672, 376).save(dir.join("pairs/1.png")).unwrap();
    image::RgbImage::new(8, 6).save(dir.join("c.png")).unwrap();
    image::ImageBuffer::<image::Luma<u16>, _>::new(8, 6).save(dir.join("z.png")).unwrap();
    let recording = Fixture::small();
    recording.write(&dir.join("good.mkv"), &mut Pattern::new(&recording)).unwrap();
    image::RgbImage::new(8, 6).save(dir.join("lens/c.png")).unwrap();
    fifo(&dir.join("lens/k.txt"));
    let manifest = "model = \"m\"\nrate_hz = 5.0\n[[stream]]\nname = \"color\"\nfiles = \"c.png\"\nintrinsics_file = \"k.txt\"\n";
    fs::write(dir.join("lens/camera.toml"), manifest).unwrap();
    let rig = "rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"files\"\nmanifest = \"lens\"\n";
    fs::write(dir.join("lens.toml"), rig).unwrap();
    fifo(&dir.join("models/x/model.toml"));
    fifo(&dir.join("root/etc/udev/rules.d/70-depthrig.rules"));
    for line in [
        "zed replay pairs --out out --modes quality --calibration f.conf",
        "import kinect good.mkv out --calibration f.json",
        "cdm list --models models",
        "config check lens.toml",
        "install --apply --user robot --root root",
    ] {
        let said = text(&run(dir, &line.split_whitespace().collect::<Vec<_>>()));
        assert!(said.contains("it is a FIFO; a regular file is needed"), "{line}: {said}");
    }
}

#[test]
fn what_a_dataset_says_cannot_steer_the_terminal() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path();
    let evil = "\\u001B]0;evil\\u0007\\u009B31m\\nlost: nothing\\u202E";
    dataset(dir, "a", evil, evil);
    dataset(dir, "b", "", "other");
    fs::create_dir(dir.join("c")).unwrap();
    fs::write(dir.join("c/session.toml"), "name = \"\u{1b}[2J\"").unwrap();
    for args in [
        &["info", "a"][..],
        &["info", "a", "--json"],
        &["info", "c"],
        &["compare", "a", "b"],
        &["compare", "a", "b", "--json"],
        &["sessions", "."],
        &["sessions", ".", "--json"],
        &["verify", "a"],
        &["verify", "c"],
        &["recover", "a"],
        &["info", "\u{1b}]0;no\u{7}"],
        &["export", "lerobot", "a", "out"],
    ] {
        let said = text(&run(dir, args));
        let steers = |c: char| (c.is_control() && c != '\n') || c == '\u{202e}';
        let json = args.contains(&"--json");
        assert!(!said.chars().any(|c| steers(c) && !(json && c == '\u{202e}')), "{args:?}: {said:?}");
    }
    let said = text(&run(dir, &["info", "a"]));
    assert!(said.contains("\\u{1b}]0;evil\\u{7}\\u{9b}31m\\nlost: nothing\\u{202e}"), "{said}");
    assert!(!said.lines().any(|l| l.starts_with("lost: nothing")), "{said}");
}

#[test]
fn nothing_is_written_into_what_is_read() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path();
    dataset(dir, "ds", "", "");
    fs::create_dir(dir.join("images")).unwrap();
    fs::create_dir(dir.join("images/camera_d435")).unwrap();
    let listed = |name: &str| fs::read_dir(dir.join(name)).unwrap().count();
    let before = [listed("ds"), listed("images")];
    for line in [
        "export lerobot ds ds/inner",
        "export lerobot ds ds",
        "export bytecameradepth ds ds/../ds/inner",
        "trim ds ds/inner",
        "merge ds/inner ds ds",
        "cat ds --out ds/inner",
        "cat ds --stream a/imu --out ds/inner",
        "cdm relabel ds ds/inner --engine fill",
        "zed replay ds --out ds/inner --modes quality",
        "zed replay images --out images/inner --modes quality",
        "import bytecameradepth images images/inner",
    ] {
        let args: Vec<_> = line.split_whitespace().collect();
        let output = run(dir, &args);
        let said = text(&output);
        assert!(!output.status.success(), "{line}: {said}");
        assert_eq!([listed("ds"), listed("images")], before, "{line}: {said}");
        assert!(said.contains("which is read and must stay as it is"), "{line}: {said}");
    }
}
