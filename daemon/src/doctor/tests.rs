//! Every finding appears when its cause is made, and none on a computer where all is well. Long because every
//! finding has its case.
#![allow(clippy::type_complexity, clippy::too_many_lines, clippy::format_collect)] // tables of cases

use super::cameras;
use super::plan::Planned;
use super::*;
use crate::attached::look;
use crate::attached::tests::{FakeAnswers, kinect_half, profile, rig_with};
use crate::attached::{Attached, UseState};
use crate::family::{Selector, Unmet, kinect};
use depthrig_bus::PixelFormat;
use depthrig_driver::ErrorKind;
use depthrig_usb::fake::{FakeDevice, FakeTree};
use std::path::PathBuf;

mod external;
mod ways;

const FILES: &str = r#"
rig = "mount"
[recording]
directory = "/data"
[[camera]]
name = "front"
backend = "synthetic"
"#;

fn config(text: &str) -> RigConfig {
    RigConfig::parse(text, None).unwrap()
}

/// A computer on which all is well.
fn well(root: SysRoot) -> Host {
    Host {
        unmet: Vec::new(),
        root,
        shm_free_bytes: Some(64 << 30),
        realtime_refusal: None,
        clock: Some(ClockSync { synchronised: true, max_error_us: 900, slew_ppm: 12.0 }),
        link: None,
        ways: Vec::new(),
        rig_holder: None,
        disk: DiskFacts {
            folder: PathBuf::from("/data"),
            free_bytes: Some(4 << 40),
            bytes_per_s: Some(2e9),
            refusal: None,
        },
    }
}

fn ids(report: &Report) -> Vec<(&'static str, Severity)> {
    report.findings.iter().map(|f| (f.id, f.severity)).collect()
}

fn all_text(findings: &[Finding]) -> String {
    findings.iter().map(|f| format!("{}\n{}\n{}\n", f.what, f.why, f.cure)).collect()
}

fn nothing_attached() -> Attached {
    Attached { cameras: Vec::new(), unusable: Vec::new(), not_asked: Vec::new() }
}

/// The report of a synthetic rig on a computer after `change`.
fn host_report(text: &str, change: impl FnOnce(&mut Host)) -> Report {
    let home = tempfile::tempdir().unwrap();
    let config = config(text);
    let attached = nothing_attached();
    let mut host = well(SysRoot::new(home.path()));
    change(&mut host);
    judge(&config, &attached, cameras::plan(&config, &attached), &host)
}

#[test]
fn where_all_is_well_nothing_is_found() {
    let report = host_report(FILES, |_| {});
    assert_eq!(ids(&report), []);
    assert_eq!((report.verdict, report.cameras[0].worst), (Severity::Good, None));
    assert!(report.disk.minutes_left.is_some_and(|m| m > 60.0));
    assert!(report.shm_needed_bytes > 0 && report.disk.needed_bytes_per_s > 0.0);
}

#[test]
fn every_fault_of_the_computer_has_its_finding() {
    use Severity::{Error, Info, Warning};
    type Change = fn(&mut Host);
    let cases: [(Change, &[(&str, Severity)], &str); 13] = [
        (
            |h| h.clock = Some(ClockSync { synchronised: true, max_error_us: 9, slew_ppm: -80_000.0 }),
            &[("clock_slewed", Warning)],
            "-80000 ppm",
        ),
        (|h| h.rig_holder = Some("process 9 (rig.toml)".into()), &[("rig_running", Error)], "process 9"),
        (|h| h.realtime_refusal = Some("not permitted".into()), &[("realtime", Warning)], "rtprio"),
        (
            |h| h.clock = Some(ClockSync { synchronised: false, max_error_us: 0, slew_ppm: 0.0 }),
            &[("clock_unsynchronised", Info)],
            "timedatectl",
        ),
        (|h| h.clock = None, &[], ""),
        (|h| h.shm_free_bytes = Some(8 << 20), &[("shm_too_small", Error)], "/dev/shm"),
        (|h| h.shm_free_bytes = Some(60 << 20), &[("shm_tight", Warning)], "remount"),
        (|h| h.shm_free_bytes = None, &[("shm_missing", Error)], "tmpfs"),
        (|h| h.disk.free_bytes = Some(0), &[("disk_full", Error)], "recording.directory"),
        (|h| h.disk.free_bytes = Some(5_000_000_000), &[("disk_short", Warning)], "reserve"),
        (|h| h.disk.bytes_per_s = Some(1e6), &[("disk_slow", Error)], "1 MB/s"),
        (|h| h.disk.bytes_per_s = Some(3e6), &[("disk_slow", Warning)], "faster disk"),
        (
            |h| h.disk.refusal = Some("Permission denied".into()),
            &[("disk_denied", Error)],
            "Permission denied",
        ),
    ];
    for (change, expected, part) in cases {
        let report = host_report(FILES, change);
        assert_eq!(ids(&report), expected);
        let text = all_text(&report.findings);
        assert!(text.contains(part), "{part} in {text}");
        for f in &report.findings {
            assert!(!f.what.is_empty() && !f.why.is_empty() && !f.cure.is_empty(), "{f:?}");
        }
    }
}

#[test]
fn priority_is_not_missed_by_a_rig_that_asks_for_none() {
    let text = format!("{FILES}\n[supervisor]\nraise_priority = false\n");
    let report = host_report(&text, |h| h.realtime_refusal = Some("not permitted".into()));
    assert_eq!(ids(&report), []);
}

#[test]
fn a_camera_that_cannot_work_is_an_error_of_its_own() {
    let text =
        "rig = \"a\"\n[[camera]]\nname = \"desk\"\nbackend = \"files\"\nmanifest = \"/none/such.toml\"\n";
    let report = host_report(text, |_| {});
    assert_eq!(ids(&report), [("camera_unusable", Severity::Error)]);
    assert_eq!(report.cameras[0].worst, Some(Severity::Error));
    assert_eq!(report.findings[0].camera.as_deref(), Some("desk"));
}

/// A camera of the rig that means a real device, without the rig file's keys for it.
fn planned(port: Option<&str>, serial: Option<&str>, attached: &Attached) -> Planned {
    let wanted =
        Selector { serial, port, needs_calibration: true, kernel_metadata: true, ..Selector::default() };
    let config = config(FILES);
    cameras::plan_device(&config.cameras[0], "realsense", &wanted, attached)
}

struct Bus {
    devices: Vec<FakeDevice>,
    fake: FakeAnswers,
    holder: Option<&'static str>,
}

impl Default for Bus {
    fn default() -> Self {
        Self { devices: vec![FakeDevice::new("4-1", 0)], fake: FakeAnswers::default(), holder: None }
    }
}

fn device_findings(bus: &Bus, port: Option<&str>, serial: Option<&str>) -> Vec<Finding> {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    bus.devices.iter().for_each(|d| tree.plug(d));
    if let Some(node) = bus.holder {
        tree.process(4711, "obs", &[node]);
    }
    let attached = look(tree.root(), &bus.fake).unwrap();
    planned(port, serial, &attached).findings
}

#[test]
fn every_fault_of_a_camera_has_its_finding() {
    use Severity::{Error, Info, Warning};
    let two = || vec![FakeDevice::new("4-1", 0), FakeDevice::new("4-2", 10)];
    let d435 = || FakeDevice::new("4-1", 0);
    let denied =
        || FakeAnswers { denied: (0..6).map(|n| format!("video{n}")).collect(), ..FakeAnswers::default() };
    let failing = |kind| FakeAnswers { failing: vec![("4-1".into(), kind)], ..FakeAnswers::default() };
    let cases: Vec<(&str, Bus, Option<&str>, Option<&str>, &[(&str, Severity)], &str)> = vec![
        ("well", Bus::default(), None, None, &[], ""),
        ("by port", Bus { devices: two(), ..Bus::default() }, Some("4-2"), None, &[], ""),
        ("by serial", Bus { devices: two(), ..Bus::default() }, None, Some("sn4-1"), &[], ""),
        (
            "none",
            Bus { devices: vec![], ..Bus::default() },
            None,
            None,
            &[("camera_missing", Error)],
            "plug it in",
        ),
        (
            "other port",
            Bus::default(),
            Some("4-7"),
            None,
            &[("camera_missing", Error)],
            "D435 sn4-1 at USB port 4-1",
        ),
        (
            "mistyped",
            Bus::default(),
            None,
            Some("sn4-2"),
            &[("camera_missing", Error)],
            "did you mean serial = \"sn4-1\"",
        ),
        ("unlike", Bus::default(), None, Some("9876543"), &[("camera_missing", Error)], "depthrig cameras"),
        (
            "ambiguous",
            Bus { devices: two(), ..Bus::default() },
            None,
            None,
            &[("camera_ambiguous", Error)],
            "4-2",
        ),
        (
            "held",
            Bus { holder: Some("/dev/video0"), ..Bus::default() },
            Some("4-1"),
            None,
            &[("camera_in_use", Error)],
            "obs (process 4711)",
        ),
        (
            "held, by serial",
            Bus { holder: Some("/dev/video0"), ..Bus::default() },
            None,
            Some("x"),
            &[("camera_missing", Error)],
            "could not be asked (in use)",
        ),
        (
            "rig's",
            Bus {
                fake: FakeAnswers { rigs: vec![rig_with("4-1")], ..FakeAnswers::default() },
                ..Bus::default()
            },
            None,
            Some("012345"),
            &[("camera_in_use", Error)],
            "rig \"mount\"",
        ),
        (
            "denied",
            Bus { fake: denied(), ..Bus::default() },
            None,
            None,
            &[("permission_denied", Error)],
            "depthrig install",
        ),
        (
            "silent",
            Bus { fake: failing(ErrorKind::Io), ..Bus::default() },
            None,
            None,
            &[("camera_failed", Error)],
            "plug it in again",
        ),
        (
            "uncalibrated",
            Bus { fake: FakeAnswers { uncalibrated: true, ..FakeAnswers::default() }, ..Bus::default() },
            None,
            None,
            &[("calibration_missing", Error)],
            "calibrated",
        ),
        (
            "no D4XX",
            Bus { fake: FakeAnswers { no_d4xx: true, ..FakeAnswers::default() }, ..Bus::default() },
            None,
            None,
            &[("metadata_header", Info)],
            "Linux 6.5",
        ),
        (
            "USB2",
            Bus { devices: vec![FakeDevice { speed: 480, version: " 2.10", ..d435() }], ..Bus::default() },
            None,
            None,
            &[("usb2", Warning)],
            "from port 4-1",
        ),
        (
            "sleepy",
            Bus { devices: vec![FakeDevice { power: "auto", ..d435() }], ..Bus::default() },
            None,
            None,
            &[("autosuspend", Info)],
            "power/control",
        ),
    ];
    for (name, bus, port, serial, expected, part) in cases {
        let found = device_findings(&bus, port, serial);
        let seen: Vec<_> = found.iter().map(|f| (f.id, f.severity)).collect();
        assert_eq!(seen, expected, "{name}");
        let text = all_text(&found);
        assert!(text.contains(part), "{name}: {part} in {text}");
        assert!(found.iter().all(|f| f.camera.as_deref() == Some("front")), "{name}");
    }
}

#[test]
fn a_mode_that_is_missing_is_listed_with_those_there_are() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice { speed: 480, version: " 2.10", ..FakeDevice::new("3-1", 0) });
    let attached = look(tree.root(), &FakeAnswers::default()).unwrap();
    let text = format!("{FILES}[[camera.stream]]\nname = \"depth\"\n");
    let mut camera = config(&text).cameras.remove(0);
    camera.streams[0].size = Some((848, 480));
    let wanted = Selector { needs_calibration: true, ..Selector::default() };
    let found = cameras::plan_device(&camera, "realsense", &wanted, &attached).findings;
    let missing = found.iter().find(|f| f.id == "mode_missing").unwrap();
    assert!(missing.what.contains("depth 640x480 z16 30 Hz"), "{missing:?}");
    assert!(missing.cure.contains("USB2"), "that it is on USB2 is why: {missing:?}");
}

/// Plans of cameras at `ports`, each sending depth and colour at this size and rate.
fn loads_of(
    ports: &[&str],
    speed: u32,
    width: u32,
    height: u32,
    rate_hz: f64,
) -> (Vec<LinkLoad>, Vec<Finding>) {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    for (i, port) in ports.iter().enumerate() {
        tree.plug(&FakeDevice { speed, ..FakeDevice::new(port, 10 * i as u32) });
    }
    let attached = look(tree.root(), &FakeAnswers::default()).unwrap();
    let streams = || {
        [
            profile("depth", PixelFormat::Z16, width, height, rate_hz),
            profile("color", PixelFormat::Rgb8, width, height, rate_hz),
        ]
    };
    let plans: Vec<_> = ports
        .iter()
        .map(|port| {
            let mut plan = planned(Some(port), None, &attached).plan;
            (plan.name, plan.streams, plan.profiles) = (format!("at {port}"), Vec::new(), Vec::new());
            for p in streams() {
                let usb_mbit_s = wire_bits_per_s(&p) / 1e6;
                plan.streams.push(PlannedStream { mode: (&p).into(), usb_mbit_s, recorded: true });
            }
            plan
        })
        .collect();
    let links = bandwidth::loads(&plans, &attached);
    let mut findings = Vec::new();
    bandwidth::check(&links, &mut findings);
    (links, findings)
}

#[test]
fn what_streams_take_of_the_bus_is_that_of_the_notes() {
    // The table of bandwidths: pixels × bytes × 8 × rate.
    for (format, size, rate, mbit) in [
        (PixelFormat::Z16, (640, 480), 30.0, 147),
        (PixelFormat::Z16, (848, 480), 90.0, 586),
        (PixelFormat::Rgb8, (1280, 720), 30.0, 442),
        (PixelFormat::Rgb8, (1920, 1080), 30.0, 995),
        (PixelFormat::Mono8, (848, 480), 30.0, 98),
    ] {
        let p = profile("depth", format, size.0, size.1, rate);
        assert_eq!((wire_bits_per_s(&p) / 1e6).round() as i64, mbit, "{format:?} {size:?}");
    }
}

#[test]
fn seven_cameras_at_30_need_a_second_controller_and_at_15_one_will_do() {
    let ports = ["4-1", "4-2", "4-3.1", "4-3.2", "4-3.3", "4-4", "4-5"];
    let (links, findings) = loads_of(&ports, 5000, 1280, 720, 30.0);
    let worst = &links[0];
    assert_eq!(worst.link, "USB3 of controller 0000:00:14.0");
    assert_eq!(
        (worst.load_mbit_s.round() as i64, worst.plan_mbit_s, worst.most_mbit_s),
        (6193, 3000.0, 4000.0)
    );
    let ids: Vec<_> = findings.iter().map(|f| (f.id, f.camera.is_some())).collect();
    assert_eq!(ids, [("bandwidth_exceeded", false)]);
    assert!(findings[0].cure.contains("another controller"), "{findings:?}");
    let hub = links.iter().find(|l| l.link == "hub at USB port 4-3").unwrap();
    assert_eq!(hub.cameras, ["at 4-3.1", "at 4-3.2", "at 4-3.3"]);

    let (_, findings) = loads_of(&ports, 5000, 640, 480, 15.0);
    assert_eq!(findings, []);
    let (_, findings) = loads_of(&ports, 5000, 1280, 720, 15.0);
    assert_eq!(findings[0].id, "bandwidth_tight");
}

#[test]
fn two_buses_of_a_controller_are_two_and_two_controllers_are_two() {
    let (links, _) = loads_of(&["4-1"], 480, 640, 480, 30.0);
    assert_eq!(links.len(), 1, "a link with the same cameras is reported once: {links:?}");
    assert_eq!((links[0].link.as_str(), links[0].plan_mbit_s), ("USB port 4-1", 300.0));
    let (_, findings) = loads_of(&["4-1"], 480, 1280, 720, 15.0);
    assert_eq!((findings[0].id, findings[0].severity), ("bandwidth_exceeded", Severity::Error));
    assert_eq!(findings[0].camera.as_deref(), Some("at 4-1"));
}

#[test]
fn transfers_over_libusb_are_held_against_the_limit() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice::new("4-1", 0));
    let attached = look(tree.root(), &FakeAnswers::default()).unwrap();
    let mut plan = planned(None, None, &attached).plan;
    let found = |limit: &str, plan: &CameraPlan| {
        tree.file("sys/module/usbcore/parameters/usbfs_memory_mb", limit);
        let mut findings = Vec::new();
        bandwidth::check_usbfs(core::slice::from_ref(plan), &well(tree.root().clone()), &mut findings);
        findings.into_iter().map(|f| f.what).collect::<Vec<_>>()
    };
    plan.profiles = vec![(profile("depth", PixelFormat::Z16, 1280, 720, 30.0), true); 2];
    assert!(found("8", &plan).is_empty(), "the kernel's driver needs none");
    plan.libusb = true;
    assert!(found("8", &plan)[0].contains("15 MB are needed"), "{:?}", found("8", &plan));
    assert!(found("512", &plan).is_empty());
}

#[test]
fn what_is_attached_and_not_named_is_told_only_to_a_rig_of_real_cameras() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice::new("4-1", 0));
    tree.plug(&FakeDevice::new("4-2", 10));
    let attached = look(tree.root(), &FakeAnswers::default()).unwrap();
    assert!(attached.cameras.iter().all(|c| c.state == UseState::Free));
    let config = config(FILES);
    let report = judge(&config, &attached, cameras::plan(&config, &attached), &well(tree.root().clone()));
    assert_eq!(ids(&report), []);
    let plans = vec![planned(Some("4-1"), None, &attached)];
    let report = judge(&config, &attached, plans, &well(tree.root().clone()));
    assert_eq!(ids(&report), [("camera_unnamed", Severity::Info)]);
    let twice = vec![planned(Some("4-1"), None, &attached), planned(None, Some("sn4-1"), &attached)];
    let report = judge(&config, &attached, twice, &well(tree.root().clone()));
    assert!(ids(&report).contains(&("camera_named_twice", Severity::Error)), "{:?}", ids(&report));
}

#[test]
fn the_worst_comes_first() {
    let report = host_report(FILES, |h| {
        h.clock = Some(ClockSync { synchronised: false, max_error_us: 0, slew_ppm: 0.0 });
        h.realtime_refusal = Some("no".into());
        h.disk.free_bytes = Some(0);
    });
    let order: Vec<_> = report.findings.iter().map(|f| f.severity).collect();
    assert_eq!(order, [Severity::Error, Severity::Warning, Severity::Info]);
    assert_eq!(report.verdict, Severity::Error);
}

/// A folder of models with one that is for the D415, as far as its record says: the weights are not looked for.
fn models_of(dir: &std::path::Path) -> PathBuf {
    let record = "format = 1\nencoder = \"vitl\"\nchannel_order = \"bgr\"\ninput_size = 518\nmax_depth_m = 6.0\n\
        trained = true\ncameras = [\"D415\"]\ninstalled = \"2026-01-01T00:00:00Z\"\ninstalled_by = \"test\"\n\
        [weights]\nsha256 = \"00\"\nbytes = 1\ntensors = 1\n\
        [source]\nkind = \"file\"\npath = \"/lab.pth\"\nsha256 = \"00\"\nbytes = 1\n";
    let model = dir.join("models/lab");
    std::fs::create_dir_all(&model).unwrap();
    std::fs::write(model.join("model.toml"), record).unwrap();
    dir.join("models")
}

#[test]
fn what_keeps_depth_from_being_refined_is_found() {
    use Severity::{Error, Info, Warning};
    let home = tempfile::tempdir().unwrap();
    let models = models_of(home.path());
    let checkpoint = home.path().join("net.pth");
    std::fs::write(&checkpoint, "").unwrap();
    let net = format!("engine = \"onnxruntime\"\nmodel = \"{}\"", checkpoint.display());
    let engine = ("engine_missing", Error);
    let no_model = ("model_missing", Error);
    let too_fast = ("refine_too_fast", Warning);
    let cases: [(&str, &str, &[(&str, Severity)], &str); 14] = [
        ("d435", "engine = \"fill\"", &[], ""),
        ("d435", "engine = \"tiny\"", &[engine], "pip install onnxruntime"),
        ("d435", "engine = \"off\"", &[], ""),
        ("d435", "", &[("refine_fill", Info)], "cdm-d435"),
        ("generic", "", &[("refine_fill", Info)], "no camera depth model is known for"),
        // The library is set to a path that does not exist.
        ("d415", "rate_hz = 0.01", &[("engine_missing", Warning)], "fill stands in"),
        ("d415", "engine = \"onnxruntime\"\nrate_hz = 0.01", &[engine], "/none/such.so"),
        ("d415", "engine = \"onnxruntime\"\nrate_hz = 0.01\nmodel = \"lab\"", &[engine], "stays silent"),
        ("d415", "engine = \"onnxruntime\"\nrate_hz = 1", &[engine, too_fast], "threads of this CPU"),
        ("d415", "engine = \"onnxruntime\"\nrate_hz = 1\ninput_size = 56\nmodel = \"lab\"", &[engine], ""),
        ("d435", "engine = \"onnxruntime\"", &[no_model, engine], "depthrig cdm fetch cdm-d435"),
        ("generic", "engine = \"onnxruntime\"", &[no_model, engine], "no camera depth model is known"),
        ("generic", "engine = \"onnxruntime\"\nmodel = \"/none/x.pth\"", &[no_model, engine], "/none/x.pth"),
        ("generic", &net, &[engine], ""),
    ];
    for (model, refine, expected, part) in cases {
        let text = format!(
            "{FILES}model = \"{model}\"\n[camera.refine]\n{refine}\n[cdm]\nthreads = 1\nmodels = \"{}\"\n\
             library = \"/none/such.so\"\n",
            models.display()
        );
        let report = host_report(&text, |_| {});
        assert_eq!(ids(&report), expected, "{model} {refine}: {:#?}", report.findings);
        let said = all_text(&report.findings);
        assert!(said.contains(part), "{part} in {said}");
        for f in &report.findings {
            assert!(!f.what.is_empty() && !f.why.is_empty() && !f.cure.is_empty(), "{f:?}");
            let of = if f.id == "refine_too_fast" { None } else { Some("front") };
            assert_eq!(f.camera.as_deref(), of, "{f:?}");
        }
    }
}

const KINECT: &str = r#"
rig = "mount"
[recording]
directory = "/data"
[[camera]]
name = "overhead"
backend = "kinect"
serial = "000123456789"
"#;

/// The report of [`KINECT`] with a Kinect attached.
fn kinect_report(text: &str, fake: &FakeAnswers, change: impl FnOnce(&mut Host)) -> Report {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&kinect_half("2-1.1", 0x097c, "000123456789", 0));
    tree.plug(&kinect_half("2-1.2", 0x097d, "000123456789", 10));
    let config = config(text);
    let mut host = well(tree.root().clone());
    change(&mut host);
    let attached = look(tree.root(), fake).unwrap();
    judge(&config, &attached, cameras::plan(&config, &attached), &host)
}

#[test]
fn what_a_kinect_misses_is_said_once() {
    let named = KINECT.replace("serial = \"000123456789\"", "port = \"2-1.1\"");
    assert_eq!(ids(&kinect_report(&named, &FakeAnswers::default(), |_| {})), []);
    let failing = vec![("2-1.1".to_owned(), ErrorKind::BadInput)];
    let fake = FakeAnswers { failing, ..FakeAnswers::default() };
    let good = || kinect::Facts { library: Ok(()), engine: Ok(()), wants_depth: true, has_display: true };
    let bad = |what: &str| Err(what.to_owned());
    let report = |text: &str, fake: &FakeAnswers, facts: kinect::Facts| {
        let of_camera = |u: Unmet| Unmet { finding: u.finding.of("overhead"), ..u };
        kinect_report(text, fake, |h| h.unmet = facts.unmet().map(of_camera).into_iter().collect())
    };
    let none = FakeAnswers::default();
    let library = bad("libk4a is not installed");
    let nothing = kinect::Facts { library, engine: bad("no engine"), has_display: false, ..good() };
    let without_library = report(KINECT, &fake, nothing);
    let found = ids(&without_library);
    assert_eq!(found, [("kinect_library", Severity::Error)], "neither that it failed nor a display");
    assert!(without_library.findings[0].cure.contains("packages.microsoft.com"));
    let device = without_library.cameras[0].device.as_deref();
    assert_eq!(device, Some("Azure Kinect 000123456789 at USB port 2-1.1"));
    let no_engine = || kinect::Facts { engine: bad("no engine"), ..good() };
    assert_eq!(ids(&report(&named, &none, no_engine())), [("kinect_engine", Severity::Error)]);
    let failed = ids(&report(KINECT, &fake, no_engine()));
    assert!(
        failed.contains(&("camera_failed", Severity::Error)),
        "an engine explains no failure: {failed:?}"
    );
    let no_display = || kinect::Facts { has_display: false, ..good() };
    assert_eq!(ids(&report(&named, &none, no_display())), [("kinect_display", Severity::Warning)]);
    assert_eq!(ids(&report(&named, &none, kinect::Facts { wants_depth: false, ..no_display() })), []);
}

#[test]
fn depth_of_a_kinect_takes_of_the_bus_what_its_raw_phases_take() {
    let named = KINECT.replace("serial = \"000123456789\"", "port = \"2-1.1\"");
    let depth = format!("{named}[[camera.stream]]\nname = \"depth\"\nwidth = 640\nheight = 480\n");
    let report = kinect_report(&depth, &FakeAnswers::default(), |_| {});
    let load = report.cameras[0].streams[0].usb_mbit_s;
    assert!((load - 5_310_760.0 * 8.0 * 30.0 / 1e6).abs() < 0.1, "{load}");
    assert_eq!(report.cameras[0].transfer_bytes, kinect::TRANSFERS);
}

#[test]
fn two_kinects_need_more_memory_for_transfers_than_the_kernel_gives() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.file("sys/module/usbcore/parameters/usbfs_memory_mb", "16");
    let plan = |port: &str| CameraPlan {
        name: port.into(),
        backend: "kinect",
        device: None,
        port: Some(port.into()),
        streams: Vec::new(),
        worst: None,
        libusb: false,
        transfer_bytes: kinect::TRANSFERS,
        profiles: Vec::new(),
    };
    let plans = [plan("2-1.1"), plan("2-3.1")];
    let found = |plans: &[CameraPlan]| {
        let mut findings = Vec::new();
        bandwidth::check_usbfs(plans, &well(tree.root().clone()), &mut findings);
        all_text(&findings)
    };
    assert_eq!(found(&plans[..1]), "");
    assert!(found(&plans).contains("32 MB are needed"), "{}", found(&plans));
}

#[test]
fn the_clock_of_the_session_is_asked_for_before_a_session() {
    use crate::config::{LinkConfig, LinkRole};
    use depthrig_link::{Key, Trust};
    let link =
        |role, insecure| LinkConfig { host: "left".parse().unwrap(), role, insecure, hosts: Vec::new() };
    let found_of = |role, insecure| {
        let asked = super::link::ask(&link(role, insecure));
        let report = host_report(FILES, |h| h.link = Some(asked));
        (ids(&report), all_text(&report.findings))
    };
    let found = |role| found_of(role, true);
    let answerer = |trust| depthrig_link::Answerer::start("127.0.0.1:0".parse().unwrap(), trust).unwrap();
    // Only a daemon gets a key; that it would be answered is known all the same.
    let keyed = answerer(Trust::Key(Key::random().unwrap()));
    for insecure in [false, true] {
        let (ids, text) = found_of(LinkRole::Camera(keyed.address()), insecure);
        assert_eq!(ids, [("link_answers", Severity::Info)], "{text}");
    }
    let recorder = answerer(Trust::Anyone);
    let (ids, text) = found(LinkRole::Camera(recorder.address()));
    // A busy computer may give a loose bound.
    assert!(
        matches!(ids.as_slice(), [("link_clock", Severity::Info) | ("link_loose", Severity::Warning)]),
        "{text}"
    );
    let (ids, _) = found(LinkRole::Recorder("127.0.0.1:0".parse().unwrap()));
    assert_eq!(ids, []);
    let (ids, text) = found(LinkRole::Recorder(recorder.address()));
    assert_eq!(ids, [("link_address", Severity::Error)]);
    assert!(text.contains("is refused; listen in [link] must be an address of this computer"), "{text}");
    let address = recorder.address();
    drop(recorder);
    let (ids, text) = found(LinkRole::Camera(address));
    assert_eq!(ids, [("link_silent", Severity::Error)]);
    assert!(text.contains("let its firewall pass UDP"), "{text}");
}
