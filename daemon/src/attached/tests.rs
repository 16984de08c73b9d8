//! Fake buses, read through fake answers.

use super::*;
use crate::status::CameraState;
use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, PixelFormat, Pose, StreamName};
use depthrig_driver::{DeviceClock, Error};
use depthrig_usb::fake::{FakeDevice, FakeTree};
use std::cell::RefCell;

/// Answers that a test chooses, and a list of the cameras that were opened.
#[derive(Default)]
pub(crate) struct FakeAnswers {
    pub(crate) denied: Vec<String>,
    pub(crate) streaming: Vec<String>,
    pub(crate) failing: Vec<(String, ErrorKind)>,
    pub(crate) rigs: Vec<RigStatus>,
    pub(crate) no_d4xx: bool,
    pub(crate) uncalibrated: bool,
    pub(crate) opened: RefCell<Vec<String>>,
}

pub(crate) fn profile(
    stream: &str,
    format: PixelFormat,
    width: u32,
    height: u32,
    rate_hz: f64,
) -> StreamProfile {
    StreamProfile {
        stream: StreamName::new(stream).unwrap(),
        format,
        width,
        height,
        rate_hz,
        depth_unit_m: 0.001,
        intrinsics: Intrinsics::default(),
        pose_in_device: Pose::IDENTITY,
        clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel },
        sequence_bits: 32,
        metadata: MetadataLevel::Kernel,
    }
}

impl Ask for FakeAnswers {
    fn node(&self, path: &Path) -> depthrig_driver::Result<NodeFacts> {
        let name = path.file_name().unwrap().to_str().unwrap();
        if self.denied.iter().any(|d| d == name) {
            return Err(Error::new(ErrorKind::PermissionDenied, format!("{name}: no")));
        }
        let number: u32 = name.strip_prefix("video").unwrap().parse().unwrap();
        let formats: &[&str] = match (number % 2, self.no_d4xx) {
            (0, _) => &["Z16 "],
            (_, true) => &["UVCH"],
            (_, false) => &["UVCH", "D4XX"],
        };
        Ok(NodeFacts {
            role: if number.is_multiple_of(2) { "images" } else { "metadata" },
            formats: formats.iter().map(ToString::to_string).collect(),
            bus: if number < 60 { "platform:vivid-000".into() } else { "platform:vivid-001".into() },
            used_elsewhere: self.streaming.iter().any(|s| s == name),
        })
    }

    fn device(
        &self,
        family: &Family,
        port: &str,
    ) -> Option<depthrig_driver::Result<(DeviceInfo, Vec<StreamProfile>)>> {
        self.opened.borrow_mut().push(port.to_owned());
        if let Some((_, kind)) = self.failing.iter().find(|(p, _)| p == port) {
            return Some(Err(Error::new(*kind, format!("{port} does not answer; plug it in again"))));
        }
        let info = DeviceInfo {
            backend: family.name,
            serial: format!("sn{port}"),
            firmware: "5.15.1.0".into(),
            port: port.into(),
            calibration: if self.uncalibrated { "none" } else { "factory" }.into(),
            ..DeviceInfo::default()
        };
        let profiles = vec![
            profile("depth", PixelFormat::Z16, 640, 480, 30.0),
            profile("depth", PixelFormat::Z16, 1280, 720, 30.0),
            profile("color", PixelFormat::Rgb8, 1280, 720, 30.0),
        ];
        Some(Ok((info, profiles)))
    }

    fn may_open(&self, node: &Path) -> bool {
        !self.denied.iter().any(|d| node.ends_with(d))
    }

    fn rigs(&self) -> (Vec<RigStatus>, Vec<String>) {
        (self.rigs.clone(), Vec::new())
    }
}

/// A running rig that has the camera at `port`.
pub(crate) fn rig_with(port: &str) -> RigStatus {
    let camera = CameraStatus {
        name: "front".into(),
        backend: "realsense".into(),
        model: "D435".into(),
        serial: "012345".into(),
        firmware: "5.16.0.1".into(),
        port: port.into(),
        calibration: "factory".into(),
        state: CameraState::Streaming,
        state_for_s: 1.0,
        message: None,
        warnings: Vec::new(),
        reconnects: 0,
        refine: None,
        mount: None,
        streams: Vec::new(),
    };
    RigStatus { rig: "mount".into(), pid: 77, uptime_s: 1.0, cameras: vec![camera], ..RigStatus::default() }
}

fn look_at(devices: &[FakeDevice], fake: &FakeAnswers, more: impl FnOnce(&FakeTree)) -> Attached {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    for d in devices {
        tree.plug(d);
    }
    more(&tree);
    look(tree.root(), fake).unwrap()
}

#[test]
fn a_free_camera_is_asked_everything() {
    let fake = FakeAnswers::default();
    let found = look_at(&[FakeDevice::new("4-1.2", 0)], &fake, |_| {});
    let [c] = found.cameras.as_slice() else { panic!("{found:?}") };
    assert_eq!((c.backend, c.model.as_str(), c.state), ("realsense", "D435", UseState::Free));
    assert_eq!((c.serial.as_deref(), c.firmware.as_deref()), (Some("sn4-1.2"), Some("5.15.1.0")));
    assert_eq!((c.usb_mbps, c.controller.as_deref()), (Some(5000), Some("0000:00:14.0")));
    assert_eq!((c.kernel_metadata, c.modes.len()), (Some("full"), 3));
    let roles: Vec<_> = c.nodes.iter().map(|n| n.role).collect();
    assert_eq!(roles, ["images", "metadata", "images", "metadata", "images", "metadata", "usb"]);
    assert!(c.problems.is_empty() && found.not_asked.is_empty(), "{found:?}");
    assert_eq!(c.describe(), "D435 sn4-1.2 at USB port 4-1.2");
}

#[test]
fn a_camera_that_a_process_has_is_named_with_it_and_not_opened() {
    let fake = FakeAnswers::default();
    let found = look_at(&[FakeDevice::new("4-1", 0), FakeDevice::new("4-2", 10)], &fake, |tree| {
        tree.process(4711, "obs", &["/dev/video4"]);
    });
    let states: Vec<_> = found.cameras.iter().map(|c| c.state).collect();
    assert_eq!(states, [UseState::InUse, UseState::Free]);
    assert_eq!(found.cameras[0].held_words(), "obs (process 4711)");
    assert_eq!(found.cameras[0].serial, None);
    assert_eq!(*fake.opened.borrow(), ["4-2"], "only the free one is opened");
}

#[test]
fn a_camera_that_a_program_has_over_libusb_is_in_use_too() {
    let fake = FakeAnswers::default();
    let found = look_at(&[FakeDevice::new("4-1", 0)], &fake, |tree| {
        tree.process(4711, "realsense-viewe", &["/dev/bus/usb/004/002"]);
    });
    assert_eq!(found.cameras[0].state, UseState::InUse);
    assert!(fake.opened.borrow().is_empty());
}

#[test]
fn what_a_running_rig_has_is_told_from_its_status() {
    let fake = FakeAnswers { rigs: vec![rig_with("4-1")], ..FakeAnswers::default() };
    let found = look_at(&[FakeDevice::new("4-1", 0), FakeDevice::new("4-2", 10)], &fake, |_| {});
    let c = &found.cameras[0];
    assert_eq!(
        (c.state, c.serial.as_deref(), c.firmware.as_deref()),
        (UseState::InUse, Some("012345"), Some("5.16.0.1"))
    );
    assert_eq!(c.held_words(), "rig \"mount\", camera \"front\"");
    assert_eq!(*fake.opened.borrow(), ["4-2"]);
}

#[test]
fn what_may_not_be_opened_is_said_with_the_rule() {
    let denied = (0..6).map(|n| format!("video{n}")).collect();
    let fake = FakeAnswers { denied, ..FakeAnswers::default() };
    let found = look_at(&[FakeDevice::new("4-1", 0)], &fake, |_| {});
    assert_eq!(found.cameras[0].state, UseState::Denied);
    assert!(fake.opened.borrow().is_empty());
    assert!(found.not_asked[0].contains("depthrig install"), "{:?}", found.not_asked);
}

#[test]
fn a_camera_that_does_not_answer_keeps_its_message() {
    let fake = FakeAnswers { failing: vec![("4-1".into(), ErrorKind::Io)], ..FakeAnswers::default() };
    let found = look_at(&[FakeDevice::new("4-1", 0)], &fake, |_| {});
    assert_eq!(found.cameras[0].state, UseState::Failed);
    assert!(found.cameras[0].problems[0].contains("plug it in again"));
    let fake = FakeAnswers { failing: vec![("4-1".into(), ErrorKind::Busy)], ..FakeAnswers::default() };
    let found = look_at(&[FakeDevice::new("4-1", 0)], &fake, |_| {});
    assert_eq!(found.cameras[0].state, UseState::InUse);
}

#[test]
fn families_are_told_apart_and_hubs_are_no_cameras() {
    let uvc = |id, port: &str, node| FakeDevice {
        id,
        strings: ["", "HD Webcam", "77"],
        interfaces: vec![(0, 0x0e, 1, "uvcvideo", vec![node, node + 1], vec![])],
        ..FakeDevice::new(port, 0)
    };
    let zed_sensors = FakeDevice {
        id: (0x2b03, 0xf881),
        interfaces: vec![(0, 3, 0, "usbhid", vec![], vec![2])],
        ..FakeDevice::new("3-4.2", 0)
    };
    let recovery = FakeDevice { id: (0x8086, 0x0adb), ..FakeDevice::new("4-9", 40) };
    let devices = [
        uvc((0x2b03, 0xf880), "4-4.1", 10),
        zed_sensors,
        uvc((0x046d, 0x0825), "4-5", 20),
        FakeDevice { id: (0x8086, 0x0b64), ..FakeDevice::new("4-6", 30) },
        FakeDevice {
            interfaces: vec![(0, 9, 0, "hub", vec![], vec![])],
            id: (0x0424, 0x2512),
            ..FakeDevice::new("4-4", 0)
        },
        recovery,
    ];
    let found = look_at(&devices, &FakeAnswers::default(), |tree| {
        tree.platform_video("platform/vivid.0", 50, "vivid-000-vid-cap");
        tree.platform_video("platform/vivid.0", 51, "vivid-000-meta-cap");
        tree.platform_video("platform/vivid.0", 60, "vivid-001-vid-cap");
    });
    let seen: Vec<_> = found.cameras.iter().map(|c| (c.backend, c.model.as_str(), c.port.as_str())).collect();
    let expected = [
        ("zed", "ZED 2i", "4-4.1"),
        ("v4l2", "HD Webcam", "4-5"),
        ("l515", "L515", "4-6"),
        ("v4l2", "vivid-000-vid-cap", "platform:vivid-000"),
        ("v4l2", "vivid-001-vid-cap", "platform:vivid-001"),
    ];
    assert_eq!(seen, expected);
    assert!(
        found.cameras[0].nodes.iter().any(|n| n.role == "hid" && n.path.ends_with("hidraw2")),
        "{found:?}"
    );
    assert!(found.cameras[0].problems.is_empty(), "{:?}", found.cameras[0].problems);
    assert_eq!(found.cameras[3].nodes.len(), 2);
    assert!(found.unusable[0].contains("recovery"), "{:?}", found.unusable);
}

#[test]
fn an_imu_that_may_not_be_opened_is_reported() {
    let video = FakeDevice {
        id: (0x2b03, 0xf880),
        interfaces: vec![(0, 0x0e, 1, "uvcvideo", vec![10, 11], vec![])],
        ..FakeDevice::new("4-4.1", 0)
    };
    let unit = FakeDevice {
        id: (0x2b03, 0xf881),
        interfaces: vec![(0, 3, 0, "usbhid", vec![], vec![2])],
        ..FakeDevice::new("3-4.2", 0)
    };
    let fake = FakeAnswers { denied: vec!["hidraw2".into()], ..FakeAnswers::default() };
    let found = look_at(&[video, unit], &fake, |_| {});
    let problems = found.cameras[0].problems.join("; ");
    assert!(
        problems.contains("hidraw2 may not be opened") && problems.contains("depthrig install --print"),
        "{problems}"
    );
}

#[test]
fn how_a_camera_is_attached_is_complained_about() {
    let slow = FakeDevice { speed: 480, version: " 2.10", power: "auto", ..FakeDevice::new("3-1", 0) };
    let fake = FakeAnswers { no_d4xx: true, ..FakeAnswers::default() };
    let found = look_at(&[slow], &fake, |_| {});
    let problems = found.cameras[0].problems.join("\n");
    assert!(problems.contains("USB2") && problems.contains("USB port 3-1"), "{problems}");
    assert_eq!(found.cameras[0].may_sleep, Some(true));
    assert_eq!(found.cameras[0].kernel_metadata, Some("header"));
}

/// Without the right to see every process, a node that somebody streams from is the only sign.
#[test]
fn a_busy_node_counts_when_its_holder_cannot_be_seen() {
    // Process 1 of this very system belongs to root; its files are hidden from everybody else, so the test uses a
    // folder that cannot be listed instead, which root can all the same.
    if rustix::process::geteuid().is_root() {
        return;
    }
    let fake = FakeAnswers { streaming: vec!["video0".into()], ..FakeAnswers::default() };
    let found = look_at(&[FakeDevice::new("4-1", 0)], &fake, |tree| {
        tree.process(4711, "hidden", &["/dev/video0"]);
        let fd = tree.root().join("proc/4711/fd");
        std::fs::set_permissions(fd, std::os::unix::fs::PermissionsExt::from_mode(0o0)).unwrap();
    });
    assert_eq!(found.cameras[0].state, UseState::InUse);
    assert!(found.cameras[0].held_words().contains("another user"));
}

/// A half of a Kinect.
pub(crate) fn kinect_half(port: &str, product: u16, serial: &'static str, node: u32) -> FakeDevice {
    let interfaces = match product {
        0x097d => vec![(0, 0x0e, 1, "uvcvideo", vec![node, node + 1], vec![])],
        _ => vec![(0, 0xff, 0, "", vec![], vec![])],
    };
    FakeDevice {
        id: (0x045e, product),
        strings: ["Microsoft Corp.", "Azure Kinect", serial],
        interfaces,
        ..FakeDevice::new(port, 0)
    }
}

#[test]
fn the_halves_of_a_kinect_are_one_camera() {
    let halves = [
        kinect_half("2-1.1", 0x097c, "000123456789", 0),
        kinect_half("2-1.2", 0x097d, "000123456789", 10),
        kinect_half("2-2.1", 0x097c, "", 0),
        kinect_half("2-3.2", 0x097d, "000987654321", 20),
    ];
    // Without libk4a none can be asked, and the bus is all there is.
    let failing = ["2-1.1", "2-2.1"].map(|p| (p.to_owned(), ErrorKind::BadInput)).into();
    let found = look_at(&halves[..3], &FakeAnswers { failing, ..FakeAnswers::default() }, |_| {});
    let seen: Vec<_> = found
        .cameras
        .iter()
        .map(|c| (c.backend, c.model.as_str(), c.port.as_str(), c.serial.as_deref(), c.state))
        .collect();
    let expected = [
        ("kinect", "Azure Kinect", "2-1.1", Some("000123456789"), UseState::Failed),
        ("kinect", "Azure Kinect", "2-2.1", None, UseState::Failed),
    ];
    assert_eq!(seen, expected);
    assert!(found.cameras[0].nodes.iter().any(|n| n.path.ends_with("video10")), "{found:?}");
    assert!(found.cameras[1].problems[0].contains("colour camera is not on the bus"), "{found:?}");
    let found = look_at(&halves[3..], &FakeAnswers::default(), |_| {});
    assert!(
        found.cameras.is_empty() && found.unusable[0].contains("depth camera is not on the bus"),
        "{found:?}"
    );
    // Asked, it answers with its own name; and a Kinect on USB2 is reported.
    let slow = FakeDevice { speed: 480, version: " 2.00", ..halves[0].clone() };
    let found = look_at(&[slow, halves[1].clone()], &FakeAnswers::default(), |_| {});
    assert_eq!(
        (found.cameras[0].serial.as_deref(), found.cameras[0].state),
        (Some("sn2-1.1"), UseState::Free)
    );
    assert!(found.cameras[0].problems[0].contains("runs it as USB2"), "{found:?}");
}

/// An OAK: its ports, product and serial number.
pub(crate) fn oak(port: &str, product: u16) -> FakeDevice {
    FakeDevice {
        id: (0x03e7, product),
        strings: ["Movidius Ltd.", "Movidius MyriadX", "18443010B1D25A0F00"],
        interfaces: vec![(0, 0xff, 0, "", vec![], vec![])],
        ..FakeDevice::new(port, 0)
    }
}

#[test]
fn an_oak_is_listed_for_what_it_is_and_left_alone() {
    let fake = FakeAnswers::default();
    let found = look_at(&[oak("4-1", 0xf63b), oak("4-2", 0x2485), oak("4-3", 0xf63d)], &fake, |tree| {
        tree.process(4711, "python3", &["/dev/bus/usb/004/006"]);
    });
    let seen: Vec<_> =
        found.cameras.iter().map(|c| (c.model.as_str(), c.serial.as_deref(), c.state)).collect();
    let serial = Some("18443010B1D25A0F00");
    let expected = [
        ("OAK", serial, UseState::Free),
        ("OAK, not booted", None, UseState::Free),
        ("OAK", None, UseState::InUse),
    ];
    assert_eq!(seen, expected, "{:?}", found.cameras);
    assert!(found.cameras.iter().all(|c| c.backend == "external" && c.usb.is_some()));
    assert_eq!(found.cameras[2].held_words(), "python3 (process 4711)");
    assert!(fake.opened.borrow().is_empty(), "its firmware is not started for a list");
    let fake = FakeAnswers { denied: vec!["002".into()], ..FakeAnswers::default() };
    let found = look_at(&[oak("4-1", 0x2485)], &fake, |_| {});
    assert_eq!(found.cameras[0].state, UseState::Denied);
    assert!(found.not_asked[0].contains("depthrig install"), "{:?}", found.not_asked);
}

#[test]
fn an_oak_that_the_rig_has_through_its_process_is_the_rigs() {
    let mut rig = rig_with("4-1");
    rig.cameras[0].backend = "external".into();
    let fake = FakeAnswers { rigs: vec![rig], ..FakeAnswers::default() };
    let found = look_at(&[oak("4-1", 0xf63b)], &fake, |_| {});
    assert_eq!(found.cameras[0].held_words(), "rig \"mount\", camera \"front\"");
}
