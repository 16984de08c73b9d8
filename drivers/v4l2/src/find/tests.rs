//! Cameras in a fake tree: the list, and the choice of a rig's camera.

use super::*;
use depthrig_usb::fake::{FakeDevice, FakeTree};

fn webcam(port: &str, node: u32, serial: &'static str) -> FakeDevice {
    FakeDevice {
        id: (0x046d, 0x082d),
        strings: ["Logitech", "HD Pro Webcam C920", serial],
        interfaces: vec![
            (0, 0x0e, 1, "uvcvideo", vec![node, node + 1], vec![]),
            (1, 0x0e, 2, "uvcvideo", vec![], vec![]),
        ],
        ..FakeDevice::new(port, 0)
    }
}

fn mount() -> (tempfile::TempDir, Vec<FoundCamera>) {
    let folder = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(folder.path());
    tree.plug(&webcam("1-2", 0, "A1B2"));
    tree.plug(&webcam("1-3", 2, ""));
    tree.plug(&FakeDevice::new("4-1", 4));
    let found = cameras(tree.root()).unwrap();
    (folder, found)
}

fn config(serial: Option<&str>, port: Option<&str>) -> V4l2Config {
    V4l2Config { serial: serial.map(Into::into), port: port.map(Into::into), ..V4l2Config::default() }
}

#[test]
fn every_usb_camera_is_listed_with_what_tells_it_apart() {
    let (_folder, found) = mount();
    let shown: Vec<_> = found.iter().map(|f| (f.describe(), f.family())).collect();
    assert_eq!(
        shown,
        [
            ("HD Pro Webcam C920 (serial A1B2) at 1-2".to_owned(), None),
            ("HD Pro Webcam C920 at 1-3".to_owned(), None),
            ("Intel(R) RealSense(TM) 435 at 4-1".to_owned(), Some("realsense")),
        ]
    );
    assert_eq!(found[1].info.serial, "1-3", "the port stands in for a serial number");
    assert_eq!(found[2].nodes.len(), 6);
}

#[test]
fn a_camera_is_meant_by_serial_port_or_by_being_the_only_one() {
    let (_folder, found) = mount();
    let port = |c: &V4l2Config, serial| choose(&found, c, serial).map(|f| f.info.port);
    assert_eq!(port(&config(Some("A1B2"), None), None).unwrap(), "1-2");
    assert_eq!(port(&config(None, Some("1-3")), None).unwrap(), "1-3");
    assert_eq!(
        port(&config(Some("A1B2"), None), Some("1-3")).unwrap(),
        "1-3",
        "the call's serial has the word"
    );
    assert_eq!(port(&config(None, Some("4-1")), None).unwrap(), "4-1", "another family's, but named");
    let e = port(&config(None, None), None).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert_eq!(
        e.to_string(),
        "set serial or port: no camera, or more than one, fits without them; there are: HD Pro Webcam C920 (serial A1B2) at 1-2, HD \
         Pro Webcam C920 at 1-3, Intel(R) RealSense(TM) 435 at 4-1 (driven by the backend realsense)"
    );
    let e = port(&config(Some("A1B2"), Some("1-3")), None).unwrap_err().to_string();
    assert!(e.starts_with("no camera with serial number \"A1B2\" at port 1-3; there are: "), "{e}");
    let only: Vec<_> = found.iter().filter(|f| f.info.port != "1-3").cloned().collect();
    assert_eq!(
        choose(&only, &config(None, None), None).unwrap().info.port,
        "1-2",
        "the RealSense does not count"
    );
    let e = choose(&[], &config(None, None), None).unwrap_err().to_string();
    assert!(e.ends_with("no camera is attached"), "{e}");
}

#[test]
fn two_of_one_serial_number_are_distinguished_by_port() {
    let folder = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(folder.path());
    tree.plug(&webcam("1-2", 0, "0001"));
    tree.plug(&webcam("1-4", 2, "0001"));
    let found = cameras(tree.root()).unwrap();
    let e = choose(&found, &config(Some("0001"), None), None).unwrap_err().to_string();
    assert!(e.contains("or more than one") && e.contains("at 1-2") && e.contains("at 1-4"), "{e}");
    assert_eq!(choose(&found, &config(Some("0001"), Some("1-4")), None).unwrap().info.port, "1-4");
}

#[test]
fn the_clock_of_a_camera_is_in_its_descriptor() {
    let (folder, found) = mount();
    let root = SysRoot::new(folder.path());
    assert_eq!(found[0].clock_hz(&root), None, "no descriptor");
    // Device descriptor; configuration of one control interface with its header of 13 bytes (UVC 1.5, table 3-3):
    // version 1.00, 15 MHz, streaming interface 1.
    let mut bytes = vec![18, 1];
    bytes.resize(18, 0);
    bytes.extend([9, 2, 31, 0, 1, 1, 0, 0x80, 50]);
    bytes.extend([9, 4, 0, 0, 0, 14, 1, 0, 0]);
    bytes.extend([13, 36, 1, 0, 1, 13, 0, 0xC0, 0xE1, 0xE4, 0, 1, 1]);
    std::fs::write(root.join("sys/bus/usb/devices/1-2/descriptors"), bytes).unwrap();
    assert_eq!(found[0].clock_hz(&root), Some(15_000_000));
}
