use super::*;
use depthrig_usb::fake::{FakeDevice, FakeTree};
use depthrig_usb::scan;
use std::os::unix::fs::symlink;

fn video(port: &str, node: u32, speed: u32) -> FakeDevice {
    FakeDevice {
        id: (0x2b03, 0xf880),
        strings: ["Technologies, Inc.", "ZED 2i", ""],
        speed,
        interfaces: vec![
            (0, 0x0e, 1, "uvcvideo", vec![node, node + 1], vec![]),
            (1, 0x0e, 2, "uvcvideo", vec![], vec![]),
        ],
        ..FakeDevice::new(port, 0)
    }
}

fn motion(port: &str, serial: &'static str, hidraw: u32) -> FakeDevice {
    FakeDevice {
        id: (0x2b03, 0xf881),
        strings: ["STEREOLABS", "ZED-2i HID INTERFACE", serial],
        speed: 12,
        interfaces: vec![(0, 0x03, 0, "usbhid", vec![], vec![hidraw])],
        ..FakeDevice::new(port, 0)
    }
}

/// Makes `a` and `b` one socket, as the kernel links them.
fn one_socket(tree: &FakeTree, a: &str, b: &str) {
    let folder = |port: &str| {
        let (hub, number) = match port.rsplit_once('.') {
            Some((hub, number)) => (hub.to_owned(), number),
            None => port.split_once('-').map(|(bus, n)| (format!("usb{bus}"), n)).unwrap(),
        };
        format!("sys/devices/ports/{hub}-port{number}")
    };
    for port in [a, b] {
        tree.file(format!("{}/state", folder(port)), "configured");
    }
    let at = |path: String| tree.root().join(path).canonicalize().unwrap();
    symlink(at(folder(b)), at(folder(a)).join("peer")).unwrap();
    symlink(at(folder(a)), at(format!("sys/bus/usb/devices/{a}")).join("port")).unwrap();
}

fn found(tree: &FakeTree) -> Vec<FoundCamera> {
    cameras(tree.root(), &scan(tree.root()).unwrap())
}

fn pairs(tree: &FakeTree) -> Vec<(String, Option<String>)> {
    found(tree).into_iter().map(|f| (f.video.port.clone(), f.serial().map(str::to_owned))).collect()
}

fn pair(port: &str, serial: &str) -> (String, Option<String>) {
    (port.to_owned(), Some(serial.to_owned()))
}

#[test]
fn on_usb_2_both_halves_are_behind_the_cameras_hub() {
    let dir = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(dir.path());
    // The IMUs come first, and in the other order than the cameras.
    tree.plug(&motion("1-3.2", "222", 0));
    tree.plug(&motion("1-4.2", "111", 1));
    tree.plug(&video("1-4.1", 4, 480));
    tree.plug(&video("1-3.1", 0, 480));
    tree.plug(&FakeDevice::new("4-1", 8));
    assert_eq!(pairs(&tree), [pair("1-3.1", "222"), pair("1-4.1", "111")]);
    let camera = &found(&tree)[0];
    assert_eq!(camera.describe(), "ZED 2i 222 at USB port 1-3.1");
    assert!(camera.motion.as_ref().unwrap().interfaces[0].hidraw_nodes[0].ends_with("dev/hidraw0"));
    assert_eq!(camera.firmware(), "80.209 (IMU 80.209)");
}

#[test]
fn on_usb_3_the_kernel_says_which_ports_are_one_socket() {
    let dir = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(dir.path());
    tree.plug(&video("2-1", 0, 5000));
    tree.plug(&video("2-2", 4, 5000));
    // Behind a hub, whose two halves are at 1-9 and 2-5.
    tree.plug(&video("2-5.3", 8, 5000));
    // Numbers of the ports do not agree, so that guessing by them goes wrong.
    tree.plug(&motion("1-2.2", "111", 0));
    tree.plug(&motion("1-1.2", "222", 1));
    tree.plug(&motion("1-9.3.2", "333", 2));
    one_socket(&tree, "2-1", "1-2");
    one_socket(&tree, "2-2", "1-1");
    one_socket(&tree, "2-5.3", "1-9.3");
    assert_eq!(pairs(&tree), [pair("2-1", "111"), pair("2-2", "222"), pair("2-5.3", "333")]);
}

#[test]
fn without_that_only_one_of_each_is_a_pair() {
    let dir = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(dir.path());
    tree.plug(&video("2-1", 0, 5000));
    assert_eq!(pairs(&tree), [("2-1".to_owned(), None)]);
    tree.plug(&motion("1-7.2", "111", 0));
    assert_eq!(pairs(&tree), [pair("2-1", "111")]);
    tree.plug(&motion("1-8.2", "222", 1));
    assert_eq!(pairs(&tree), [("2-1".to_owned(), None)], "either could be it");
    let devices = scan(tree.root()).unwrap();
    let port = |serial: &str| imu(&devices, MODELS[0], serial).map(|d| d.port.as_str());
    assert_eq!(
        [port("222"), port("333"), port("")],
        [Some("1-8.2"), None, None],
        "until the camera says its number"
    );
    // One of another model is not asked for.
    let other = FakeDevice { id: (0x2b03, 0xf781), ..motion("1-2.2", "333", 2) };
    let dir = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(dir.path());
    tree.plug(&video("2-1", 0, 5000));
    tree.plug(&other);
    assert_eq!(pairs(&tree), [("2-1".to_owned(), None)]);
}

#[test]
fn the_rig_says_which_camera_it_means() {
    let dir = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(dir.path());
    let none = candidates(found(&tree), None, None).unwrap_err();
    assert_eq!(none.kind(), ErrorKind::NotFound);
    assert!(none.to_string().contains("there is no ZED; is it plugged in?; no ZED is attached"), "{none}");
    tree.plug(&video("1-3.1", 0, 480));
    tree.plug(&motion("1-3.2", "222", 0));
    let ports = |port, serial| {
        let found = candidates(found(&tree), port, serial)?;
        Ok::<_, Error>(found.into_iter().map(|f| f.video.port).collect::<Vec<_>>())
    };
    assert_eq!(ports(None, None).unwrap(), ["1-3.1"]);
    tree.plug(&video("1-4.1", 4, 480));
    let which = ports(None, None).unwrap_err().to_string();
    assert!(
        which.contains("several ZEDs are attached; select one")
            && which.contains("ZED 2i 222 at USB port 1-3.1, ZED 2i at"),
        "{which}"
    );
    assert_eq!(ports(Some("1-3.1"), None).unwrap(), ["1-3.1"]);
    // That of the second is not known before it is opened.
    assert_eq!(ports(None, Some("222")).unwrap(), ["1-3.1", "1-4.1"]);
    assert_eq!(ports(None, Some("333")).unwrap(), ["1-4.1"]);
    assert!(
        ports(Some("1-3.1"), Some("333")).unwrap_err().to_string().contains("no such ZED at USB port 1-3.1")
    );
}
