//! The default file is complete and true, and every problem of a bad one is named with its place. Long because every
//! backend's keys are in it.
#![allow(clippy::items_after_statements)] // each test names its subject

use super::read::Report;
use super::*;
use depthrig_bus::PixelFormat;
use depthrig_external::ExternalConfig;
use depthrig_realsense::RealsenseConfig;
use depthrig_realsense::l515::L515Config;
use depthrig_sim::files::FilesConfig;
use depthrig_sim::synthetic::SyntheticConfig;
use depthrig_sim::synthetic::board::BoardScene;
use depthrig_v4l2::V4l2Config;
use depthrig_zed::ZedConfig;
use depthrig_zed::replay::ZedPlaybackConfig;
use std::collections::BTreeSet;
use std::fmt::Write as _;

mod link;
mod paper;
mod ros2;

fn parse(text: &str) -> Result<RigConfig, ConfigError> {
    RigConfig::parse(text, Some(Path::new("/rigs/rig.toml")))
}

fn problems(text: &str) -> Vec<String> {
    parse(text).unwrap_err().to_string().lines().map(str::to_owned).collect()
}

/// The default file with its `# key = value` lines (and, if wanted, its `#e.g.` lines) brought to life.
fn uncommented(examples: bool) -> String {
    let mut text = String::new();
    for line in RigConfig::default_text().lines() {
        let example = line.strip_prefix("#e.g. ").filter(|_| examples);
        let is_key = |l: &&str| {
            l.split_once(" = ").is_some_and(|(k, _)| k.chars().all(|c| c.is_ascii_lowercase() || c == '_'))
        };
        let default = line.strip_prefix("# ").filter(is_key);
        writeln!(text, "{}", example.or(default).unwrap_or(line)).unwrap();
    }
    text
}

#[test]
fn the_defaults_in_the_comments_are_those_of_the_code() {
    let mut as_it_is = parse(RigConfig::default_text()).unwrap();
    let mut written_out = parse(&uncommented(false)).unwrap();
    assert_ne!(as_it_is.text, written_out.text);
    let lines = |text: &str| text.lines().filter(|l| !l.starts_with('#')).count();
    let brought_to_life = lines(&written_out.text) - lines(&as_it_is.text);
    assert!(brought_to_life > 30, "only {brought_to_life} defaults were found in the comments");
    (as_it_is.text, written_out.text) = <_>::default();
    assert_eq!(as_it_is, written_out);
}

#[test]
fn every_key_is_in_the_default_file() {
    let text = uncommented(true);
    let report = Report::new(&text);
    super::rig::read(&report, &text, None, crate::family::FAMILIES).unwrap();
    let asked = report.asked();
    assert!(asked.contains(&("[[camera.fault]]", "count")), "{asked:?}");
    assert_eq!(report.into_problems(), []);

    let document: toml::Table = text.parse().unwrap();
    let mut present = BTreeSet::new();
    gather(&document, "", &mut present);
    // The two spellings of a rotation exclude each other, so one of them is only described.
    let described = |key: &str| RigConfig::default_text().contains(&format!("{key}, "));
    let missing: Vec<_> = asked
        .iter()
        .filter(|(table, key)| !present.contains(&(plain(table), (*key).to_owned())) && !described(key))
        .collect();
    assert!(missing.is_empty(), "default_rig.toml does not explain {missing:?}");
}

/// `[[camera.stream]]` and `pose = { }` as the path that [`gather`] makes.
fn plain(table: &str) -> String {
    match table {
        "pose = { }" => "camera.pose".to_owned(),
        // It has the keys of the other one.
        "[link.hosts.refine]" => "camera.refine".to_owned(),
        "displaced = { }" => "camera.board.displaced".to_owned(),
        _ => table.trim_matches(['[', ']']).to_owned(),
    }
}

fn gather(table: &toml::Table, path: &str, keys: &mut BTreeSet<(String, String)>) {
    for (key, value) in table {
        keys.insert((path.to_owned(), key.clone()));
        let inner = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
        let items = value.as_array().cloned().unwrap_or_else(|| vec![value.clone()]);
        items.iter().filter_map(toml::Value::as_table).for_each(|t| gather(t, &inner, keys));
    }
}

#[test]
fn a_synthetic_camera_can_be_told_everything_that_its_driver_knows() {
    // Serialised names of the driver that have another form in a rig file.
    let renamed = |key: &str| match key {
        "pose_on_mount" => "pose".to_owned(),
        "streams" => "stream".to_owned(),
        "faults" => "fault".to_owned(),
        _ => key.to_owned(),
    };
    let driver = toml::Table::try_from(SyntheticConfig::default()).unwrap();
    let text = uncommented(true);
    let report = Report::new(&text);
    super::rig::read(&report, &text, None, crate::family::FAMILIES).unwrap();
    let asked = report.asked();
    let has = |table: &str, key: &str| asked.iter().any(|(t, k)| *t == table && *k == key);
    for key in driver.keys() {
        assert!(has("[[camera]]", &renamed(key)), "{key}");
    }
    for key in driver["clock"].as_table().unwrap().keys() {
        assert!(has("[camera.clock]", key), "{key}");
    }
    let board = toml::Table::try_from(BoardScene::default()).unwrap();
    // The sheet is made of the file.
    for key in board.keys().filter(|k| *k != "sheet") {
        assert!(has("[camera.board]", key), "{key}");
    }
}

#[test]
fn the_default_rig_is_the_mount_of_seven() {
    let rig = parse(RigConfig::default_text()).unwrap();
    let names: Vec<_> = rig.cameras.iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["d405", "d415", "d435", "d455", "l515", "zed2i", "kinect"]);
    for camera in &rig.cameras {
        let s = camera.backend.settings::<SyntheticConfig>().unwrap();
        assert_eq!((s.model.as_str(), s.pose_on_mount), (camera.name.as_str(), camera.pose));
        // The point 0.7 m ahead of the mount lies on the camera's axis, 0.7 m and a little away.
        let there = depthrig_calib::PoseExt::inverse(&camera.pose);
        let p = depthrig_calib::PoseExt::transform_point(&there, [0.0, 0.0, 0.7].into());
        assert!(
            p.x.abs() < 0.003 && p.y.abs() < 0.003 && (0.69..0.75).contains(&p.z),
            "{}: {p}",
            camera.name
        );
    }
    let seeds: BTreeSet<_> = rig.cameras.iter().map(|c| format!("{:?}", c.backend)).collect();
    assert_eq!(seeds.len(), 7);
}

#[test]
fn what_a_file_says_is_what_comes_out() {
    let rig = parse(
        r#"
        rig = "lab_2"
        bus.slots = 32
        sets = { rate_hz = 10, max_wait_ms = 40, phase = "fixed" }
        recording = { directory = "../out/./x", color = "png", depth = "rank", segment_max_s = 5, workers = 3 }
        control.tcp = "[::1]:8000"
        control.foxglove = 8765
        [[camera]]
        name = "a"
        backend = "files"
        manifest = "images"
        rate_hz = 15
        loop = false
        record = ["depth"]
        pose = { translation_m = [1, 2.5, -3], rotation_xyzw = [0, 0.7071, 0, 0.7071] }
        stream = [{ name = "depth" }, { name = "color", width = 640, height = 480, rate_hz = 15, format = "rgb8" }]
        [[camera]]
        name = "b"
        backend = "synthetic"
        fault = [{ at_s = 2.5, kind = "half_frame", count = 3 }]
        stream = [{ name = "color", width = 320, height = 240, rate_hz = 30 }]
        "#,
    )
    .unwrap();
    assert_eq!((rig.rig.as_str(), rig.bus.slots), ("lab_2", 32));
    assert_eq!(rig.sets, SetsConfig { rate_hz: 10.0, max_wait_ms: Some(40.0), phase: Phase::Fixed });
    assert_eq!(rig.recording.directory, Path::new("/rigs/../out/x"));
    assert_eq!(
        (rig.recording.color, rig.recording.depth, rig.recording.workers, rig.recording.segment_max_s),
        (ColorCodec::Png, DepthCodec::Rank, 3, 5)
    );
    assert_eq!(rig.control.tcp, Port::At("[::1]:8000".parse().unwrap()));
    assert_eq!(rig.control.foxglove, Port::At("127.0.0.1:8765".parse().unwrap()));
    let a = rig.camera("a").unwrap();
    let settings = FilesConfig { manifest: "/rigs/images".into(), rate_hz: Some(15.0), looped: Some(false) };
    assert_eq!(a.backend, BackendConfig::new(settings));
    assert_eq!(a.pose.translation_m, [1.0, 2.5, -3.0]);
    assert!((a.pose.rotation_xyzw[1] - 0.5f64.sqrt()).abs() < 1e-12, "made unit length: {:?}", a.pose);
    assert_eq!((a.streams[1].size, a.streams[1].rate_hz), (Some((640, 480)), Some(15.0)));
    let name = |s: &str| StreamName::new(s).unwrap();
    assert!(
        a.records(&name("depth")) && !a.records(&name("color")) && rig.cameras[1].records(&name("color"))
    );
    let b = rig.cameras[1].backend.settings::<SyntheticConfig>().unwrap();
    assert_eq!((b.serial.as_str(), b.faults[0].count, b.faults[0].at_s), ("sim-b", 3, 2.5));
    assert_eq!((b.streams[0].size, b.streams[0].rate_hz), (Some((320, 240)), Some(30.0)));
}

#[test]
fn a_realsense_camera_is_set_as_the_file_says() {
    let rig = parse(
        r#"
        rig = "r"
        [[camera]]
        name = "a"
        backend = "realsense"
        serial = "012345678901"
        port = "4-1.2"
        transport = "libusb"
        metadata = "header"
        emitter = "off"
        laser_power_mw = 150
        exposure_us = 8500
        gain = 16
        color_controls = { gamma = 300, power_line_frequency = "50 Hz", white_balance_automatic = false }
        depth_unit_m = 0.0001
        preset = "near.json"
        sync = "slave"
        allow_uncalibrated = true
        reset_when_silent = true
        [[camera]]
        name = "b"
        backend = "realsense"
        "#,
    )
    .unwrap();
    use depthrig_realsense::config::{Emitter, MetadataWish, TransportChoice};
    use depthrig_realsense::protocol::sync::SyncMode;
    use depthrig_usb::controls::ControlValue::{Boolean, Integer, Item};
    let color_controls = [
        ("gamma", Integer(300)),
        ("power_line_frequency", Item("50 Hz".into())),
        ("white_balance_automatic", Boolean(false)),
    ];
    let wanted = RealsenseConfig {
        serial: Some("012345678901".into()),
        port: Some("4-1.2".into()),
        transport: TransportChoice::Libusb,
        metadata: MetadataWish::Header,
        emitter: Some(Emitter::Off),
        laser_power_mw: Some(150),
        exposure_us: Some(8500),
        auto_exposure: None,
        gain: Some(16),
        preset: Some("/rigs/near.json".into()),
        sync: Some(SyncMode::Slave),
        color_controls: color_controls.map(|(n, v)| (n.to_owned(), v)).into(),
        depth_unit_m: Some(0.0001),
        allow_uncalibrated: true,
        reset_when_silent: true,
    };
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(wanted));
    assert_eq!(rig.cameras[1].backend, BackendConfig::new(RealsenseConfig::default()));
    let streams: Vec<_> = rig.cameras[1].streams.iter().map(|s| s.stream.as_str()).collect();
    assert_eq!(streams, ["depth", "color"], "the imagers are asked for by name");
}

#[test]
fn a_zed_is_set_as_the_file_says() {
    let rig = parse(
        r#"
        rig = "r"
        [[camera]]
        name = "a"
        backend = "zed"
        serial = "31234567"
        port = "4-1"
        calibration = "SN31234567.conf"
        exposure_percent = 40
        gain_percent = 0
        led = false
        controls = { brightness = 4, white_balance_automatic = false }
        motion = false
        [[camera.stream]]
        name = "right"
        width = 672
        height = 376
        [[camera]]
        name = "b"
        backend = "zed"
        auto_exposure = true
        calibration = "none"
        [[camera]]
        name = "c"
        backend = "zed"
        "#,
    )
    .unwrap();
    use depthrig_usb::controls::ControlValue::{Boolean, Integer};
    use depthrig_zed::CalibrationFile;
    let controls = [("brightness", Integer(4)), ("white_balance_automatic", Boolean(false))];
    let wanted = ZedConfig {
        serial: Some("31234567".into()),
        port: Some("4-1".into()),
        calibration: CalibrationFile::At("/rigs/SN31234567.conf".into()),
        auto_exposure: None,
        exposure_percent: Some(40),
        gain_percent: Some(0),
        led: Some(false),
        controls: controls.map(|(n, v)| (n.to_owned(), v)).into(),
        without_motion: true,
    };
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(wanted));
    let b =
        ZedConfig { auto_exposure: Some(true), calibration: CalibrationFile::None, ..ZedConfig::default() };
    assert_eq!(rig.cameras[1].backend, BackendConfig::new(b));
    assert_eq!(rig.cameras[2].backend, BackendConfig::new(ZedConfig::default()));
}

#[test]
fn an_attached_kinect_is_set_as_the_file_says() {
    let rig = parse(
        r#"
        rig = "r"
        [[camera]]
        name = "a"
        backend = "kinect"
        serial = "000123456789"
        port = "2-1.1"
        library = "k4a"
        depth_engine = "/opt/k4a"
        depth_mode = "wfov_2x2binned"
        sync = "subordinate"
        subordinate_delay_us = 160
        depth_delay_us = -80
        color_controls = { exposure_us = 8330, white_balance_k = "auto" }
        led = false
        [[camera.stream]]
        name = "ir"
        [[camera.stream]]
        name = "color"
        format = "mjpeg"
        [[camera]]
        name = "b"
        backend = "kinect"
        "#,
    )
    .unwrap();
    use depthrig_kinect::live::{LiveConfig, Places};
    use depthrig_kinect::{DepthMode, WiredSync};
    use depthrig_usb::controls::ControlValue::{Integer, Item};
    let controls = [("exposure_us", Integer(8330)), ("white_balance_k", Item("auto".into()))];
    let wanted = LiveConfig {
        serial: Some("000123456789".into()),
        port: Some("2-1.1".into()),
        places: Places { library: Some("/rigs/k4a".into()), engine: Some("/opt/k4a".into()) },
        depth_mode: Some(DepthMode::Wfov2x2Binned),
        sync: WiredSync::Subordinate,
        subordinate_delay_us: 160,
        depth_delay_us: -80,
        color_controls: controls.map(|(n, v)| (n.to_owned(), v)).into(),
        dark: true,
    };
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(wanted));
    assert_eq!(rig.cameras[1].backend, BackendConfig::new(LiveConfig::default()));
}

#[test]
fn a_recording_of_a_zed_and_its_stereo_are_set_as_the_file_says() {
    use depthrig_calib::stereo::Preset;
    use depthrig_stereo::Mode;
    let rig = parse(
        r#"
        rig = "r"
        [cdm]
        library = "libonnxruntime.so"
        [[camera]]
        name = "a"
        backend = "zed"
        input = "recordings/a.svo2"
        calibration = "SN5.conf"
        serial = "5"
        rate_hz = 5
        loop = true
        [camera.stereo]
        modes = ["performance", "neural"]
        threads = 2
        min_depth_m = 0.3
        max_depth_m = 8
        disparity = true
        rate_hz = 2.5
        every_pair = true
        network = "net.onnx"
        [camera.refine]
        [[camera]]
        name = "b"
        backend = "zed"
        [camera.stereo]
        [camera.refine]
        depth = "depth_quality"
        [[camera.stream]]
        name = "color"
        [[camera.stream]]
        name = "depth_quality"
        "#,
    )
    .unwrap();
    let a = rig.cameras[0].backend.settings::<ZedPlaybackConfig>().unwrap();
    let b = ZedPlaybackConfig {
        input: "/rigs/recordings/a.svo2".into(),
        serial: Some("5".into()),
        calibration: depthrig_zed::CalibrationFile::At("/rigs/SN5.conf".into()),
        rate_hz: Some(5.0),
        looped: true,
    };
    assert_eq!((a, rig.cameras[0].backend.name()), (&b, "zed"));
    let wanted = StereoConfig {
        modes: vec![Mode::Preset(Preset::Performance), Mode::Neural],
        threads: 2,
        range_m: (0.3, 8.0),
        disparity: true,
        rate_hz: 2.5,
        every_pair: true,
        network: Some("/rigs/net.onnx".into()),
        library: Some("/rigs/libonnxruntime.so".into()),
    };
    assert_eq!(rig.cameras[0].stereo, Some(wanted.clone()));
    let derived = ["color", "depth_performance", "confidence_performance", "disparity_performance"];
    assert_eq!(wanted.streams()[..4], derived);
    assert_eq!(rig.cameras[0].refine.as_ref().unwrap().depth, "depth_performance", "the first mode");
    assert_eq!(rig.cameras[1].refine.as_ref().unwrap().depth, "depth_quality");
    assert_eq!(
        rig.cameras[1].stereo,
        Some(StereoConfig { library: wanted.library, ..StereoConfig::default() })
    );
    // Late streams are in no set that is waited for; with nothing else there would be no set.
    let late = |camera: usize, name: &str| rig.cameras[camera].joins_late(&StreamName::new(name).unwrap());
    assert!(
        late(0, "depth_neural") && late(1, "confidence_quality") && !late(0, "color") && !late(0, "left")
    );
}

#[test]
fn a_recorded_kinect_is_played_as_the_file_says() {
    use depthrig_kinect::playback::{CalibrationSource, PlaybackConfig};
    let text = |keys: &str| {
        format!("rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"kinect\"\nrecording = \"a.mkv\"\n{keys}")
    };
    let backend = |keys: &str| {
        let rig = RigConfig::parse(&text(keys), Some(Path::new("/rigs/kinect.toml"))).unwrap();
        rig.cameras[0].backend.clone()
    };
    let recorded = |config: PlaybackConfig| BackendConfig::new(config);
    assert_eq!(backend(""), recorded(PlaybackConfig::new("/rigs/a.mkv")));
    let calibration = CalibrationSource::At("/rigs/device.json".into());
    let wanted =
        PlaybackConfig { looped: true, rate: 0.5, calibration, ..PlaybackConfig::new("/rigs/a.mkv") };
    assert_eq!(backend("loop = true\nrate = 0.5\ncalibration = \"device.json\""), recorded(wanted));
    let none = PlaybackConfig { calibration: CalibrationSource::None, ..PlaybackConfig::new("/rigs/a.mkv") };
    assert_eq!(backend("calibration = \"none\""), recorded(none));
    let problem = |keys: &str| RigConfig::parse(&text(keys), None).unwrap_err().to_string();
    assert!(problem("rate = 0").contains("it must be within 0.05 and 20"), "{}", problem("rate = 0"));
    // Keys of attached cameras alone.
    assert!(problem("sync = \"master\"").contains("sync"), "{}", problem("sync = \"master\""));
}

#[test]
fn angles_turn_about_x_then_y_then_z() {
    let pose = |rpy: &str| {
        let text = format!(
            "rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"synthetic\"\npose.rotation_rpy_deg = {rpy}\n"
        );
        parse(&text).unwrap().cameras[0].pose
    };
    let turned =
        |rpy: &str, p: [f64; 3]| depthrig_calib::PoseExt::transform_point(&pose(rpy), p.into()).to_array();
    let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
    assert!(near(turned("[90, 0, 0]", [0.0, 1.0, 0.0]), [0.0, 0.0, 1.0]));
    assert!(near(turned("[0, 90, 0]", [0.0, 0.0, 1.0]), [1.0, 0.0, 0.0]));
    assert!(near(turned("[0, 0, 90]", [1.0, 0.0, 0.0]), [0.0, 1.0, 0.0]));
    // x first: y goes to z, which the turn about y takes to x, which the turn about z takes to y.
    assert!(near(turned("[90, 90, 90]", [0.0, 1.0, 0.0]), [0.0, 1.0, 0.0]));
    assert!(near(turned("[90, 90, 0]", [0.0, 1.0, 0.0]), [1.0, 0.0, 0.0]));
}

const ONE_CAMERA: &str = "rig = \"r\"\n[[camera]]\nname = \"d435\"\nbackend = \"synthetic\"\n";

#[test]
#[allow(clippy::too_many_lines)] // a table
fn each_problem_has_its_place_and_says_what_to_write() {
    let top = |line: &str| format!("{line}\n{ONE_CAMERA}");
    let camera = |line: &str| format!("{ONE_CAMERA}{line}\n");
    let second = |lines: &str| format!("{ONE_CAMERA}[[camera]]\n{lines}\n");
    #[rustfmt::skip]
    let cases: Vec<(String, &str)> = vec![
        (camera("  modle = \"d405\""), "rig.toml:5:3: unknown key \"modle\" in [[camera]] \"d435\"; did you mean \"model\"?"),
        (camera("rate_hz = 5"), "5:1: unknown key \"rate_hz\" in [[camera]] \"d435\"; it belongs to [camera.refine]"),
        (top("set = {}"), "1:1: unknown key \"set\" at the top of the file; did you mean \"sets\"?"),
        (top("xyz = 1"), "1:1: unknown key \"xyz\" at the top of the file; it has: rig, calibration, bus, sets"),
        (camera("clock = { drift = 3 }"), "5:11: unknown key \"drift\" in [camera.clock] of camera \"d435\"; did you mean \"drift_ppm\"?"),
        (camera("seed = \"1\""), "5:8: \"seed\" in [[camera]] \"d435\" must be a whole number; it is the string \"1\""),
        (camera("seed = -1"), "5:8: \"seed\" in [[camera]] \"d435\" must be a whole number within 0..="),
        (camera("truth = 1"), "must be true or false; it is the number 1"),
        (camera("phase = nan"), "must be a finite number"),
        (camera("phase = 1.5"), "5:9: \"phase\" in [[camera]] \"d435\": phase = 1.5 is out of range 0..1"),
        (camera("clock.counter_bits = 8"), "5:22: \"counter_bits\" in [camera.clock] of camera \"d435\": clock.counter_bits = 8"),
        (camera("model = \"d436\""), "5:9: \"model\" in [[camera]] \"d435\": there is no model \"d436\"; there are d405,"),
        (camera("stream = [{ name = \"ir\" }]"), "it has no stream \"ir\""),
        (camera("stream = [{ name = \"color\", rate_hz = 0 }]"), "5:39: \"rate_hz\" in [[camera.stream]] \"color\" is 0; it must be above 0 and at most 1000"),
        (camera("stream = [{ name = \"color\", rate_hz = 1001 }]"), "is 1001; it must be above 0"),
        (camera("stream = [{ name = \"color\", width = -1, height = 480 }]"), "must be a whole number within"),
        (camera("stream = [{ name = \"color\", width = 640, height = 99999 }]"), "is 99999 pixels"),
        (camera("stream = [{ name = \"color\", rate_hz = 1e300 }]"), "is 1e300; it must be above 0"),
        (camera("stream = [{ name = \"color\", width = 3 }]"), "\"width\" in [[camera.stream]] \"color\" needs height as well"),
        (camera("stream = [{ name = \"color\", format = \"rbg8\" }]"), "has the invalid value \"rbg8\"; did you mean \"rgb8\"?"),
        (camera("stream = [{ name = \"color\" }, { name = \"color\" }]"), "stream \"color\" is listed twice"),
        (camera("stream = [{ name = \"color\" }]\nrecord = [\"depth\"]"), "6:10: \"record\" in [[camera]] \"d435\" names \"depth\", which is not among"),
        (camera("fault = [{ at_s = 1, kind = \"fire\" }]"), "5:29: \"kind\" in [[camera.fault]] of camera \"d435\" has the invalid value \"fire\"; it is one of: unplug, stall"),
        (camera("fault = [{ at_s = -1, kind = \"hang\" }]"), "at_s and duration_s must be 0 or more"),
        (camera("fault = [{ kind = \"hang\" }]"), "\"at_s\" is missing in [[camera.fault]]"),
        (camera("pose = { rotation_xyzw = [0, 0, 0, 2] }"), "5:26: \"rotation_xyzw\" in pose = { } of camera \"d435\" must be a quaternion x, y, z, w of length 1; its length is 2.0000"),
        (camera("pose = { rotation_xyzw = [0, 0, 0, 0] }"), "its length is 0.0000"),
        (camera("pose = { translation_m = [0, inf, 0] }"), "value 2 must be a finite number"),
        (camera("pose = { translation_m = [0, 1] }"), "must have 3 values; it has 2"),
        (camera("pose = { rotation_xyzw = [0, 0, 0, 1], rotation_rpy_deg = [0, 0, 0] }"), "keep one"),
        (second("name = \"d435\"\nbackend = \"synthetic\""), "6:8: camera name \"d435\" is taken by an earlier camera"),
        (second("name = \"D435\"\nbackend = \"synthetic\""), "6:8: \"name\" in [[camera]] is not a valid name: \"D435\" cannot be a name: it begins with 'D'"),
        (second("backend = \"synthetic\""), "5:1: \"name\" is missing in [[camera]]"),
        (second("name = \"b\""), "5:1: \"backend\" is missing in [[camera]] \"b\""),
        (second("name = \"b\"\nbackend = \"file\""), "7:11: \"backend\" in [[camera]] \"b\" has the invalid value \"file\"; did you mean \"files\"?"),
        (second("name = \"b\"\nbackend = \"files\""), "\"manifest\" is missing in [[camera]] \"b\"; write, for example, manifest = "),
        (second("name = \"b\"\nbackend = \"files\"\nmanifest = \"x\"\nrate_hz = -3"), "9:11: \"rate_hz\" in [[camera]] \"b\" is -3; it must be above 0"),
        (second("name = \"b\"\nbackend = \"files\"\nmanifest = \"x\"\nmodel = \"d405\""), "only another backend has it"),
        (second("name = \"b\"\nbackend = \"realsense\"\nemitter = \"lazer\""), "8:11: \"emitter\" in [[camera]] \"b\" has the invalid value \"lazer\"; did you mean \"laser\"?"),
        (second("name = \"b\"\nbackend = \"realsense\"\nlaser_power_mw = 361"), "\"laser_power_mw\" in [[camera]] \"b\" is 361; it must be within 0 and 360"),
        (second("name = \"b\"\nbackend = \"realsense\"\nexposure_us = 0"), "is 0; it must be within 1 and 200000"),
        (second("name = \"b\"\nbackend = \"realsense\"\nauto_exposure = true\ngain = 16"), "9:8: \"gain\" in [[camera]] \"b\" cannot be set while auto_exposure is true"),
        (second("name = \"b\"\nbackend = \"realsense\"\ndepth_unit_m = 1"), "is 1; it must be within 0.000001 and 0.01"),
        (second("name = \"b\"\nbackend = \"realsense\"\nserial = \" \""), "8:10: \"serial\" in [[camera]] \"b\" is empty"),
        (second("name = \"b\"\nbackend = \"realsense\"\nserial = 12345"), "must be a string in quotes"),
        (second("name = \"b\"\nbackend = \"realsense\"\ncolor_controls = { hue = 1.5 }"), "8:26: \"hue\" of \"color_controls\" in [[camera]] \"b\" must be a whole number, true, false"),
        (second("name = \"b\"\nbackend = \"realsense\"\ncolor_controls = 1"), "must be a table, color_controls = { }; it is the number 1"),
        (second("name = \"b\"\nbackend = \"realsense\"\ncolor_controls = { hue = 1 }\nstream = [{ name = \"depth\" }]"), "is set, but color is not among the streams"),
        (second("name = \"b\"\nbackend = \"realsense\"\nstream = [{ name = \"ir\" }]"), "8:11: a RealSense D400 has no stream \"ir\"; it has: depth, color, ir_left, ir_right, imu"),
        (second("name = \"b\"\nbackend = \"realsense\"\nseed = 1"), "only another backend has it"),
        (second("name = \"b\"\nbackend = \"synthetic\"\nmodel = \"d435\"\nstream = [{ name = \"color\", width = 320, height = 240 }]"), ": [[camera]] \"b\": it has no such mode of \"color\"; it has: color 1280x720 rgb8 30, 15, 6 Hz; color 1920x1080 rgb8 30, 15, 6 Hz; "),
        (second("name = \"b\"\nbackend = \"zed\"\nexposure_percent = 101"), "8:20: \"exposure_percent\" in [[camera]] \"b\" is 101; it must be within 0 and 100"),
        (second("name = \"b\"\nbackend = \"zed\"\nauto_exposure = true\ngain_percent = 16"), "9:16: \"gain_percent\" in [[camera]] \"b\" cannot be set while auto_exposure is true"),
        (second("name = \"b\"\nbackend = \"zed\"\ncalibration = \"\""), "8:15: \"calibration\" in [[camera]] \"b\" is empty"),
        (second("name = \"b\"\nbackend = \"zed\"\nstream = [{ name = \"depth_quality\" }]"), "it has: left, right, imu; depth and rectified colour need [camera.stereo]"),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { modes = [\"best\"] }"), "there is no mode \"best\"; it is one of: performance, ultra, quality, neural"),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { modes = [] }"), "is empty; name at least one mode"),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { modes = [\"ultra\", \"ultra\"] }"), "has \"ultra\" twice; keep one"),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { modes = [\"neural\"] }"), "needs network = \"FILE.onnx\""),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { network = \"a.onnx\" }"), "has no use without the mode \"neural\""),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { min_depth_m = 9, max_depth_m = 3 }"), "leaves nothing: from 9 m to 3 m"),
        (second("name = \"b\"\nbackend = \"zed\"\nstereo = { every_pair = true }"), "every_pair = true is for a recording (input)"),
        (second("name = \"b\"\nbackend = \"zed\"\ncalibration = \"none\"\nstereo = { }"), "stereo needs the factory calibration"),
        (second("name = \"b\"\nbackend = \"zed\"\ninput = \"x\"\nled = true"), "is for a camera that is attached, and input plays a recording"),
        (second("name = \"b\"\nbackend = \"realsense\"\nstereo = { }"), "unknown key \"stereo\" in [[camera]] \"b\""),
        (second("name = \"b\"\nbackend = \"zed\"\nstream = [{ name = \"depth\" }]"), "8:11: a ZED has no stream \"depth\"; it has: left, right, imu"),
        (second("name = \"b\"\nbackend = \"zed\"\nmodel = \"zed2i\""), "only another backend has it"),
        (second("name = \"b\"\nbackend = \"kinect\"\ndepth_mode = \"wfov\""), "has the invalid value \"wfov\"; did you mean \"wfov_"),
        (second("name = \"b\"\nbackend = \"kinect\"\nsubordinate_delay_us = 160"), "only sync = \"subordinate\" has it"),
        (second("name = \"b\"\nbackend = \"kinect\"\ncolor_controls = { exposure = 5 }"), "has \"exposure\", which a Kinect has not; it has: exposure_us, "),
        (second("name = \"b\"\nbackend = \"kinect\"\nstream = [{ name = \"left\" }]"), "8:11: a Kinect has no stream \"left\"; it has: color, depth, ir, imu"),
        (second("name = \"b\"\nbackend = \"kinect\"\nstream = [{ name = \"ir\" }]\ncolor_controls = { gain = 5 }"), "color is not among the streams"),
        (second("name = \"b\"\nbackend = \"kinect\"\ndepth_mode = \"passive_ir\"\nstream = [{ name = \"depth\" }]"), "gives no depth"),
        (top("sets.rate_hz = 31"), "1:16: \"rate_hz\" in [sets] is 31 sets a second, but the fastest camera gives 30 frames a second"),
        (top("sets.rate_hz = 0.0"), "1:16: \"rate_hz\" in [sets] is 0; it must be above 0"),
        (top("control.tcp = \"0.0.0.0:80\""), "1:15: \"tcp\" in [control] must be a loopback address such as 127.0.0.1:80, not 0.0.0.0:80: the API is not encrypted"),
        (top("control.tcp = \"localhost\""), "must be an address and a port such as"),
        (top("control.foxglove = \"192.168.0.7:8765\""), "\"foxglove\" in [control] must be a loopback address such as 127.0.0.1:8765"),
        (top("control.foxglove = 70000"), "must be a whole number within 0..=65535"),
        (top("bus.slots = 3"), "\"slots\" in [bus] is 3; it must be within 16 and 1024"),
        (top("recording.jpeg_quality = 101"), "is 101; it must be within 1 and 100"),
        (top("recording.jpeg_quality = 300"), "whole number within 0..=255"),
        (top("recording.min_minutes = 100001"), "is 100001; it must be within 0 and 100000"),
        (top("recording.recover_on_start = \"yes\""), "\"recover_on_start\" in [recording] must be true or false"),
        (top("recording.recover_on_start = 1"), "\"recover_on_start\" in [recording] must be true or false"),
        (top("recording.directory = \"\""), "\"directory\" in [recording] is empty"),
        (top("supervisor = { backoff_min_s = 3, backoff_max_s = 1 }"), "is 1, less than backoff_min_s, which is 3"),
        (top("sets = 3"), "1:8: \"sets\" must be a table, [sets]; it is the number 3"),
        ("rig = \"r\"\n[camera]\nname = \"a\"".into(), "must be written as tables, each headed [[camera]]"),
        ("rig = \"r\"".into(), "1:1: the rig has no camera; add a [[camera]] table"),
        ("rig = \"r\"\ncamera = []".into(), "the rig has no camera"),
        ("[[camera]]\nname = \"a\"\nbackend = \"synthetic\"".into(), "1:1: \"rig\" is missing in the top of the file"),
        ("rig = \"r\nx = 3".into(), "rig.toml:1:"),
        (top("rig = \"s\""), "rig.toml:2:1: duplicate key"),
        (top("x = 1 # \u{e4}\u{f6}\n\u{ff} = 2"), "rig.toml:2:1: "),
    ];
    let mut wrong = String::new();
    for (text, wanted) in cases {
        let found = problems(&text);
        if found.len() != 1 || !found[0].contains(wanted) || !found[0].starts_with("/rigs/rig.toml:") {
            writeln!(wrong, "{text}\nwanted: {wanted}\nfound:  {found:#?}\n").unwrap();
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn all_problems_are_listed_in_the_order_of_the_file() {
    let text = "rig = \"R\"\n[sets]\nrate_hz = 0\nphas = \"auto\"\n[[camera]]\nname = \"a\"\nbackend = \"synthetic\"\n\
                seed = true\nphase = 7\n[[camera]]\nname = \"a\"\nbackend = \"files\"\n";
    let lines: Vec<_> = parse(text).unwrap_err().problems().iter().map(|p| p.line).collect();
    assert_eq!(lines, [1, 3, 4, 8, 9, 10, 11]);
}

#[test]
fn columns_count_characters() {
    let text = format!("{ONE_CAMERA}clock = {{ \"drift_ppm\" = 1, \"\u{e4}\u{f6}\u{fc}\" = 2, zz = 1 }}\n");
    let places: Vec<_> = parse(&text).unwrap_err().problems().iter().map(|p| (p.line, p.column)).collect();
    assert_eq!(places, [(5, 28), (5, 39)]);
}

#[test]
fn files_that_cannot_be_read_say_why() {
    let tmp = tempfile::tempdir().unwrap();
    let path = tmp.path().join("rig.toml");
    let e = RigConfig::load(&path).unwrap_err();
    assert_eq!(e.kind(), crate::ErrorKind::NotFound);
    assert!(e.to_string().contains("depthrig config show"), "{e}");
    assert!(RigConfig::load(tmp.path()).unwrap_err().to_string().contains("it is a folder"));
    std::fs::write(&path, [0xff, 0xfe, 0x00]).unwrap();
    assert!(RigConfig::load(&path).unwrap_err().to_string().contains("it is not text"));
    std::fs::write(&path, RigConfig::default_text()).unwrap();
    let rig = RigConfig::load(&path).unwrap();
    assert_eq!(rig.recording.directory, tmp.path().join("datasets"));
    assert_eq!(rig.path.as_deref(), Some(path.as_path()));
}

proptest::proptest! {
    /// Whatever is done to a good file, reading it ends with a configuration or with problems that lie in it.
    #[test]
    fn damaged_files_never_panic(at in 0usize..20_000, cut in 0usize..40, put in "[\\[\\]{}=\".#a0 \n-]{0,8}") {
        let mut text = uncommented(true);
        let at = text.floor_char_boundary(at % text.len());
        let end = text.floor_char_boundary((at + cut).min(text.len()));
        text.replace_range(at..end, &put);
        if let Err(e) = parse(&text) {
            let lines = text.lines().count().max(1);
            proptest::prop_assert!(!e.problems().is_empty());
            proptest::prop_assert!(e.problems().iter().all(|p| (1..=lines + 1).contains(&p.line)), "{e}");
        }
    }
}

#[test]
fn a_v4l2_camera_is_read_with_all_its_keys() {
    use depthrig_usb::controls::ControlValue;
    use depthrig_v4l2::{ClockChoice, MemoryChoice, MjpegChoice};
    let rig = parse(
        r#"
        rig = "lab"
        [[camera]]
        name = "a"
        backend = "v4l2"
        port = "1-2"
        memory = "userptr"
        mjpeg = "keep"
        clock = "kernel"
        device_clock_hz = 48_000_000
        depth_unit_m = 0.0001
        buffers = 6
        controls = { gain = 0x10, "White Balance, Automatic" = false, auto_exposure = "Manual Mode" }
        stream = [{ name = "color", rate_hz = 15 }]
        [[camera.intrinsics]]
        stream = "color"
        width = 640
        height = 480
        fx = 500
        fy = 501.5
        cx = 320
        cy = 240
        model = "rational"
        coefficients = [1, 2, 3, 4, 5, 6, 7, 8]
        [[camera]]
        name = "b"
        backend = "v4l2"
        "#,
    )
    .unwrap();
    let a = rig.cameras[0].backend.settings::<V4l2Config>().unwrap();
    let chosen = (a.memory, a.mjpeg, a.clock);
    assert_eq!(chosen, (MemoryChoice::UserPointer, MjpegChoice::Keep, ClockChoice::Kernel));
    assert_eq!((a.serial.as_deref(), a.port.as_deref()), (None, Some("1-2")));
    assert_eq!((a.device_clock_hz, a.depth_unit_m, a.buffers), (Some(48_000_000), 0.0001, 6));
    let has = |name: &str, value: ControlValue| a.controls.contains(&(name.to_owned(), value));
    assert!(has("gain", ControlValue::Integer(16)));
    assert!(has("White Balance, Automatic", ControlValue::Boolean(false)));
    assert!(has("auto_exposure", ControlValue::Item("Manual Mode".into())));
    let given = &a.intrinsics[0];
    assert_eq!((given.width, given.height, given.intrinsics.fy), (640, 480, 501.5));
    assert_eq!(given.intrinsics.coeffs, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
    assert_eq!(given.intrinsics.distortion(), depthrig_bus::Distortion::Rational);
    assert_eq!(rig.cameras[1].backend, BackendConfig::new(V4l2Config::default()));
}

#[test]
fn every_problem_of_a_v4l2_camera_is_named_at_its_line() {
    let found = problems(
        r#"rig = "lab"
[[camera]]
name = "a"
backend = "v4l2"
serial = ""
memory = "dma"
buffers = 9
device_clock_hz = 10
depth_unit_m = 0
model = "d435"
[camera.controls]
gain = 1.5
[[camera.intrinsics]]
stream = "color"
width = 640
height = 0
fx = -1
fy = 500
cx = 320
cy = 240
model = "brown_conrady"
coefficients = [0, 0, 0, 0, 0, 0]
"#,
    );
    let said = |line: usize, what: &str| {
        let place = format!(":{line}:");
        assert!(found.iter().any(|p| p.contains(&place) && p.contains(what)), "{line} {what}: {found:#?}");
    };
    said(5, "is empty");
    said(6, "it is one of: mmap, userptr");
    said(7, "must be within 2 and 8");
    said(8, "must be within 1000 and 1000000000");
    said(9, "must be above 0");
    said(10, "unknown key \"model\"");
    said(12, "must be a whole number, true, false or the name of an item");
    said(16, "must be within 1 and 16384");
    said(17, "must be above 0");
    said(22, "has 6 values; this model has 5");
}

#[test]
fn a_rig_of_v4l2_cameras_is_not_faster_than_its_streams() {
    let text = |rate: &str| {
        format!(
            "rig = \"lab\"\nsets.rate_hz = 20\n[[camera]]\nname = \"a\"\nbackend = \"v4l2\"\nstream = [{{ name = \"color\"{rate} }}]"
        )
    };
    assert!(problems(&text(", rate_hz = 15")).iter().any(|p| p.contains("the fastest camera gives 15")));
    assert!(parse(&text("")).is_ok(), "the camera decides");
}

#[test]
fn an_l515_and_its_controls() {
    use depthrig_usb::controls::ControlValue::Integer;
    let rig = parse(
        r#"
        rig = "mount"
        [[camera]]
        name = "l"
        backend = "l515"
        serial = "f0123456"
        port = "4-1.2"
        controls = { laser_power = 60, noise_filtering = 4 }
        color_controls = { gamma = 300 }
        "#,
    )
    .unwrap();
    let wanted = L515Config {
        serial: Some("f0123456".into()),
        port: Some("4-1.2".into()),
        controls: [("laser_power".to_owned(), 60), ("noise_filtering".to_owned(), 4)].into(),
        color_controls: [("gamma".to_owned(), Integer(300))].into(),
    };
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(wanted));
    let streams: Vec<_> = rig.cameras[0].streams.iter().map(|s| s.stream.as_str()).collect();
    assert_eq!(streams, ["depth", "color"]);
}

#[test]
fn what_an_l515_has_not() {
    let wrong = |more: &str| {
        let text = format!("[[camera]]\nname = \"l\"\nbackend = \"l515\"\n{more}");
        parse(&text).unwrap_err().to_string()
    };
    assert!(wrong("controls = { laser = 1 }").contains("laser_power"), "the names there are");
    assert!(wrong("[[camera.stream]]\nname = \"ir_left\"").contains("depth, color, ir, confidence, imu"));
    assert!(
        wrong("color_controls = { gamma = 1 }\n[[camera.stream]]\nname = \"depth\"")
            .contains("color_controls")
    );
}

const REFINED: &str = "rig = \"r\"\n[cdm]\nthreads = 3\nlibrary = \"lib/ort\"\nmodels = \"/models\"\nhang_s = 2.5\n\
    [[camera]]\nname = \"a\"\nbackend = \"synthetic\"\nrecord = [\"depth\", \"depth_aligned\"]\n\
    [camera.refine]\nengine = \"onnxruntime\"\nmodel = \"my/net.pth\"\nrate_hz = 0\ninput_size = 252\n\
    precision = \"bf16\"\ndevice = \"tensorrt:1\"\nformat = \"depth_f32\"\nfill_reach = 0.5\nrecord = true\nalign = true\n\
    is_aligned = true\ncorrected = true\n\
    [[camera]]\nname = \"b\"\nbackend = \"synthetic\"\nrefine = { model = \"cdm-d435\" }\n\
    [[camera]]\nname = \"c\"\nbackend = \"synthetic\"\n";

#[test]
fn how_depth_is_refined_is_read_with_all_its_keys() {
    let rig = parse(REFINED).unwrap();
    let models = Some("/models".into());
    let library = Some("/rigs/lib/ort".into());
    assert_eq!(rig.cdm, CdmConfig { threads: 3, library, models, hang_s: 2.5 });
    let written_out = RefineConfig {
        engine: EngineChoice::OnnxRuntime,
        model: Some(RefineModel::File("/rigs/my/net.pth".into())),
        rate_hz: 0.0,
        input_size: Some(252),
        precision: Precision::Bf16,
        device: "tensorrt:1".into(),
        format: PixelFormat::DepthF32,
        fill_reach: 0.5,
        record: true,
        align: true,
        is_aligned: true,
        corrected: true,
        depth: "depth".into(),
    };
    assert_eq!(rig.cameras[0].refine.as_ref(), Some(&written_out));
    let model = Some(RefineModel::Installed("cdm-d435".into()));
    assert_eq!(rig.cameras[1].refine, Some(RefineConfig { model, ..RefineConfig::default() }));
    assert_eq!(rig.cameras[2].refine, None);
}

#[test]
fn what_is_wrong_with_refining_is_named_at_its_line() {
    let rig = |keys: &str| {
        format!("rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"synthetic\"\n[camera.refine]\n{keys}\n")
    };
    for (keys, line, said) in [
        (
            "engine = \"onnx\"",
            6,
            "\"engine\" in [camera.refine] of camera \"a\" has the invalid value \"onnx\"; did you mean \"onnxruntime\"?",
        ),
        (
            "engnie = \"fill\"",
            6,
            "unknown key \"engnie\" in [camera.refine] of camera \"a\"; did you mean \"engine\"?",
        ),
        ("rate_hz = -1", 6, "is -1; it must be above 0 and at most 1000, or 0 for every pair"),
        ("device = \"gpu\"", 6, "is \"gpu\"; it must be cpu, cuda, cuda:1, tensorrt, tensorrt:0 or openvino"),
        ("input_size = 8", 6, "is 8; it must be within 56 and 2044"),
        ("fill_reach = 1.5", 6, "is 1.5; it must be within 0 and 1"),
        ("format = \"rgb8\"", 6, "it is one of: z16, depth_f32"),
        ("engine = \"fill\"\nmodel = \"x\"", 7, "has no use: the engine \"fill\" needs no model"),
        (
            "engine = \"tiny\"\nmodel = \"x\"",
            7,
            "has no use: the engine \"tiny\" runs its own network, or a file NAME.onnx",
        ),
        ("engine = \"tiny\"\nmodel = \"net.pth\"", 7, "or a file NAME.onnx"),
        ("engine = \"tiny\"\ndevice = \"cuda:0\"", 7, "has no use: the engine \"tiny\" runs on the CPU"),
        ("engine = \"tiny\"\nprecision = \"fp16\"", 7, "has no use: the engine \"tiny\" computes in fp32"),
        ("engine = \"tiy\"", 6, "has the invalid value \"tiy\"; did you mean \"tiny\"?"),
        ("engine = \"tiny\"\nreach = 1", 7, "unknown key \"reach\" in [camera.refine] of camera \"a\""),
        ("[[camera.stream]]\nname = \"depth\"", 5, "[camera.refine] needs the stream \"color\""),
    ] {
        let all = problems(&rig(keys));
        let at = format!("/rigs/rig.toml:{line}:");
        assert!(all.iter().any(|p| p.starts_with(&at) && p.contains(said)), "{keys}: {all:#?}");
    }
    let tiny = parse(&rig("engine = \"tiny\"\ndevice = \"cpu\"\nfill_reach = 0.3")).unwrap();
    let tiny = tiny.cameras[0].refine.as_ref().unwrap();
    assert_eq!((tiny.engine, tiny.fill_reach), (EngineChoice::Tiny, 0.3));
    let recorded = rig("").replace("[camera.refine]", "record = [\"depth_refined\"]");
    assert!(problems(&recorded)[0].contains("which only a camera with [camera.refine] has"));
}

#[test]
fn an_external_camera_is_read_with_all_its_keys() {
    use std::time::Duration;
    let rig = parse(
        r#"
        rig = "lab"
        [[camera]]
        name = "a"
        backend = "external"
        command = ["bin/cam", "--serial", "7"]
        directory = "oak"
        start_timeout_s = 3
        heartbeat_timeout_s = 0.5
        stream = [{ name = "color", rate_hz = 15 }]
        [[camera]]
        name = "b"
        backend = "external"
        "#,
    )
    .unwrap();
    let wanted = ExternalConfig {
        command: ["bin/cam", "--serial", "7"].map(str::to_owned).into(),
        directory: "/rigs/oak".into(),
        start_timeout: Duration::from_secs(3),
        heartbeat_timeout: Duration::from_millis(500),
    };
    assert_eq!(rig.cameras[0].backend, BackendConfig::new(wanted));
    let plain = ExternalConfig { directory: "/rigs".into(), ..ExternalConfig::default() };
    assert_eq!(rig.cameras[1].backend, BackendConfig::new(plain));
    assert_eq!(rig.cameras[1].backend.name(), "external");
}

#[test]
fn what_is_wrong_with_an_external_camera_is_named_at_its_line() {
    for (line, said) in [
        ("command = []", "\"command\" in [[camera]] \"a\" is empty; write [\"program\","),
        ("command = [\" \"]", "names no program"),
        ("command = \"cam\"", "\"command\" in [[camera]] \"a\" must be"),
        ("directory = \"x\"", "is where `command` runs, which is not given"),
        ("start_timeout_s = 121", "is 121 s; it must be within 0.1 and 120"),
        ("heartbeat_timeout_s = 0.1", "is 0.1 s; it must be within 0.5 and 14"),
        ("comand = [\"cam\"]", "did you mean \"command\"?"),
    ] {
        let text = format!("rig = \"r\"\n[[camera]]\nname = \"a\"\nbackend = \"external\"\n{line}\n");
        let all = problems(&text);
        assert!(
            all.len() == 1 && all[0].starts_with("/rigs/rig.toml:5:") && all[0].contains(said),
            "{line}: {all:#?}"
        );
    }
}
