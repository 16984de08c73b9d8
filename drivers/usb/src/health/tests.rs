//! Each complaint appears when it should, names what it must, and stays away otherwise.

use super::*;
use crate::fake::{FakeDevice, FakeTree};
use crate::scan;

fn only(device: &FakeDevice) -> UsbDevice {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.plug(device);
    scan(tree.root()).unwrap().remove(0)
}

#[test]
fn usb2_is_complained_about_for_devices_that_could_do_better() {
    let d435 = FakeDevice::new("3-2", 0);
    let slow = FakeDevice { speed: 480, version: " 2.10", ..d435.clone() };
    let said = slow_link(&only(&slow)).unwrap();
    assert!(said.contains("USB port 3-2") && said.contains("480 Mbit/s") && said.contains("USB3"), "{said}");
    assert_eq!(slow_link(&only(&d435)), None);
    let webcam = FakeDevice { id: (0x046d, 0x0825), version: " 2.00", ..slow.clone() };
    assert_eq!(slow_link(&only(&webcam)), None, "a webcam of USB2 is where it belongs");
    // Known by its number, whatever version it claims.
    assert!(slow_link(&only(&FakeDevice { version: " 2.00", ..slow.clone() })).is_some());
    assert!(slow_link(&only(&FakeDevice { id: (0x1234, 1), ..slow })).is_some(), "USB 2.1 is a USB3 device");
}

#[test]
fn sleep_is_complained_about_when_the_kernel_may() {
    let d435 = FakeDevice::new("3-2", 0);
    assert_eq!(may_sleep(&only(&d435)), None);
    let said = may_sleep(&only(&FakeDevice { power: "auto", ..d435 })).unwrap();
    assert!(said.contains("/sys/bus/usb/devices/3-2/power/control"), "{said}");
}

#[test]
fn the_limit_of_usbfs_is_held_against_the_need() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    let need = |mb: u64| usbfs_too_small(tree.root(), mb << 20);
    assert_eq!(need(1000), None, "the kernel does not say");
    tree.file(USBFS_LIMIT, "16");
    assert_eq!((usbfs_limit_mb(tree.root()), need(16)), (Some(16), None));
    let said = need(40).unwrap();
    assert!(said.contains("16 MB") && said.contains("40 MB"), "{said}");
    assert!(said.contains("echo 64 > /sys/module/usbcore/parameters/usbfs_memory_mb"), "{said}");
    assert!(usbfs_too_small(tree.root(), (16 << 20) + 1).is_some(), "a byte too much");
    tree.file(USBFS_LIMIT, "0");
    assert_eq!(need(1000), None, "no limit");
}

#[test]
fn an_opening_that_failed_says_why_and_what_to_do() {
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    tree.process(4711, "obs", &["/dev/video2"]);
    let node = tree.root().join("dev/video2");
    for (errno, kind, parts) in [
        (16, ErrorKind::Busy, ["obs (process 4711)", "end that program"]),
        (13, ErrorKind::PermissionDenied, ["depthrig install", "dev/video2"]),
        (1, ErrorKind::PermissionDenied, ["depthrig install", "dev/video2"]),
        (2, ErrorKind::NotFound, ["no such node", "attached?"]),
        (19, ErrorKind::Disconnected, ["gone", "dev/video2"]),
        (6, ErrorKind::Disconnected, ["gone", "dev/video2"]),
        (5, ErrorKind::Io, ["D435 12", "Input/output error"]),
    ] {
        let e = open_error(tree.root(), "D435 12", &node, io::Error::from_raw_os_error(errno));
        assert_eq!(e.kind(), kind, "{e}");
        for part in parts.into_iter().chain(["D435 12"]) {
            assert!(e.to_string().contains(part), "{part} in {e}");
        }
        assert!(std::error::Error::source(&e).is_some());
    }
}
