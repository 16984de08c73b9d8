//! Fake trees, read back.

use super::*;
use crate::fake::{FakeDevice, FakeTree};

#[test]
fn a_camera_is_read_with_everything_that_the_kernel_says() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice { power: "auto", ..FakeDevice::new("4-1.2", 10) });
    let found = scan(tree.root()).unwrap();
    let [camera] = found.as_slice() else { panic!("{found:?}") };
    assert_eq!((camera.port.as_str(), camera.bus_number), ("4-1.2", 4));
    assert_eq!((camera.id(), camera.device_version), ("8086:0b07".to_owned(), 0x50d1));
    assert_eq!((camera.speed_mbps, camera.usb_version, camera.class), (5000, 0x0320, 0xef));
    assert_eq!(camera.controller, "0000:00:14.0");
    assert_eq!(camera.power_control, PowerControl::Auto);
    assert_eq!((camera.product.as_str(), camera.serial.as_str()), ("Intel(R) RealSense(TM) 435", ""));
    assert_eq!(camera.node, tree.root().join("dev/bus/usb/004/002"));
    assert!(camera.node.exists());
    let nodes = |n: usize| camera.interfaces[n].video_nodes.iter().map(|n| n.number).collect::<Vec<_>>();
    assert_eq!((nodes(0), nodes(1), nodes(3)), (vec![10, 11, 12, 13], vec![], vec![14, 15]));
    assert_eq!(camera.interfaces[0].driver.as_deref(), Some("uvcvideo"));
    assert_eq!(camera.interfaces[5].driver, None);
    let node = camera.video_nodes().nth(1).unwrap();
    assert_eq!((node.index, node.parent.as_str()), (1, "4-1.2:1.0"));
    assert_eq!(node.path, tree.root().join("dev/video11"));
}

#[test]
fn ports_are_sorted_as_numbers_and_hubs_stand_before_what_hangs_on_them() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    let hub = FakeDevice { interfaces: vec![(0, 9, 0, "hub", vec![], vec![])], ..FakeDevice::new("2-1", 0) };
    for (port, node) in [("10-1", 30), ("2-1.10", 20), ("2-1.9", 10)] {
        tree.plug(&FakeDevice::new(port, node));
    }
    tree.plug(&hub);
    let ports: Vec<_> = scan(tree.root()).unwrap().into_iter().map(|d| d.port).collect();
    assert_eq!(ports, ["2-1", "2-1.9", "2-1.10", "10-1"]);
}

#[test]
fn two_buses_of_one_controller_have_its_name() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice::new("4-1", 0));
    tree.plug(&FakeDevice { speed: 480, version: " 2.10", ..FakeDevice::new("3-1", 10) });
    tree.plug(&FakeDevice { controller: "platform/vhci_hcd.0", ..FakeDevice::new("6-3", 20) });
    let found = scan(tree.root()).unwrap();
    let controllers: Vec<_> = found.iter().map(|d| d.controller.as_str()).collect();
    assert_eq!(controllers, ["0000:00:14.0", "0000:00:14.0", "vhci_hcd.0"]);
}

#[test]
fn raw_hid_nodes_are_found_below_their_interface() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    let interfaces = vec![(0, 3, 0, "usbhid", vec![], vec![2])];
    tree.plug(&FakeDevice { id: (0x2b03, 0xf881), interfaces, ..FakeDevice::new("1-4.2", 0) });
    let found = scan(tree.root()).unwrap();
    assert_eq!(found[0].interfaces[0].hidraw_nodes, [tree.root().join("dev/hidraw2")]);
}

#[test]
fn nodes_on_no_usb_device_are_listed_by_themselves() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice::new("4-1", 0));
    tree.platform_video("platform/vivid.0", 12, "vivid-000-vid-cap");
    tree.platform_video("platform/vivid.1", 7, "vivid-001-vid-cap");
    let nodes = video_nodes(tree.root()).unwrap();
    let found: Vec<_> = nodes.iter().map(|n| (n.number, n.parent.as_str(), n.name.as_str())).collect();
    assert_eq!(found, [(7, "vivid.1", "vivid-001-vid-cap"), (12, "vivid.0", "vivid-000-vid-cap")]);
}

#[test]
fn a_device_that_is_leaving_is_left_out_and_the_rest_stays() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice::new("4-1", 0));
    tree.plug(&FakeDevice::new("4-2", 10));
    let gone = tree.root().join("sys/devices/pci0000:00/0000:00:14.0/usb4/4-1");
    std::fs::remove_file(gone.join("idVendor")).unwrap();
    std::os::unix::fs::symlink("../nowhere", tree.root().join("sys/bus/usb/devices/4-3")).unwrap();
    let ports: Vec<_> = scan(tree.root()).unwrap().into_iter().map(|d| d.port).collect();
    assert_eq!(ports, ["4-2"]);
}

#[test]
fn strings_that_a_device_reports_cannot_move_the_cursor() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(&FakeDevice { strings: ["", "\u{1b}[2Jcamera\tone", "12\n34"], ..FakeDevice::new("4-1", 0) });
    let found = scan(tree.root()).unwrap();
    assert_eq!((found[0].product.as_str(), found[0].serial.as_str()), ("[2Jcamera one", "12 34"));
}

#[test]
fn a_computer_without_usb_has_no_devices() {
    let home = tempfile::tempdir().unwrap();
    let root = SysRoot::new(home.path());
    assert_eq!(scan(&root).unwrap(), []);
    assert_eq!(video_nodes(&root).unwrap(), []);
    assert!(scan(&SysRoot::default()).is_ok(), "the running system's");
}

#[test]
fn versions_are_read_as_the_kernel_prints_them() {
    for (text, bcd) in [("3.20", 0x0320), ("2.00", 0x0200), ("2.10", 0x0210), ("1.1", 0x0110)] {
        assert_eq!(version(text), Some(bcd), "{text}");
    }
    assert_eq!(version(""), None);
}
