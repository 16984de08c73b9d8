//! Maps libusb's errors to errors of a camera that say what to do.

use depthrig_driver::{Error, ErrorKind};
use depthrig_usb::{SysRoot, UsbDevice, health};
use rusb::Error as Usb;

/// The error for `e` while doing `what` with the camera that `label` names.
pub(super) fn failed(label: &str, what: &str, e: Usb) -> Error {
    let (kind, text) = match e {
        Usb::NoDevice => (ErrorKind::Disconnected, "the camera is gone".to_owned()),
        Usb::Timeout => (ErrorKind::Io, "the camera did not answer in time".to_owned()),
        Usb::Pipe => (ErrorKind::Protocol, "the camera refuses".to_owned()),
        Usb::Busy => (ErrorKind::Busy, "it is in use".to_owned()),
        Usb::Access => (ErrorKind::PermissionDenied, format!("not permitted; {}", health::RULE_CURE)),
        other => (ErrorKind::Io, other.to_string()),
    };
    Error::new(kind, format!("{label}: {what}: {text}")).with_source(e)
}

/// The error for `e` when the device was to be opened or claimed: names who holds it, or the udev rule.
pub(super) fn not_opened(root: &SysRoot, device: &UsbDevice, e: Usb) -> Error {
    let label = device.describe();
    match e {
        Usb::Busy => health::busy(root, &label, &device.node).with_source(e),
        Usb::Access => health::denied(&label, &device.node).with_source(e),
        _ => failed(&label, "opening it through libusb", e),
    }
}
