//! Faults of a camera's connection and permissions, in messages that say what to do.
//!
//! The drivers put these into their errors and `depthrig doctor` prints them, so that both say the same.

use super::holder::holders_of;
use super::{PowerControl, SysRoot, UsbDevice};
use depthrig_driver::{Error, ErrorKind};
use std::io;
use std::path::Path;

/// How to print and write the udev rule.
pub const RULE_CURE: &str = "install depthrig's udev rule (`depthrig install --print` shows it, `sudo depthrig install --apply` writes it)";

/// The kernel's default limit for the USB transfers of all programs together, MB.
/// Source: the kernel's `Documentation/admin-guide/kernel-parameters.txt`, `usbcore.usbfs_memory_mb`.
pub const USBFS_DEFAULT_MB: u32 = 16;

/// File of the limit, below the root.
pub const USBFS_LIMIT: &str = "sys/module/usbcore/parameters/usbfs_memory_mb";

/// Speed below which a USB3 device runs as a USB2 device, Mbit/s.
const SUPERSPEED_MBPS: u32 = 5000;

/// The error for a node that somebody else uses; `device` names the camera for the message.
pub fn busy(root: &SysRoot, device: &str, node: &Path) -> Error {
    let holder = holders_of(root, node).describe();
    Error::new(
        ErrorKind::Busy,
        format!(
            "{device} is in use: {} is held by {holder}; end that program, or let it give the camera back",
            node.display()
        ),
    )
}

/// The error for a node that this user may not open.
pub fn denied(device: &str, node: &Path) -> Error {
    Error::new(
        ErrorKind::PermissionDenied,
        format!(
            "{device}: this user may not open {}; {RULE_CURE} and plug the camera in again, or add the user to the \
             group that owns the node",
            node.display()
        ),
    )
}

/// The error for what happened when `node` of the camera `device` was opened or first asked: names the holder, the
/// rule, or what the system said.
pub fn open_error(root: &SysRoot, device: &str, node: &Path, e: io::Error) -> Error {
    let plain = |kind, what: &str| Error::new(kind, format!("{device}: {}: {what}", node.display()));
    let error = match e.kind() {
        io::ErrorKind::ResourceBusy => busy(root, device, node),
        io::ErrorKind::PermissionDenied => denied(device, node),
        io::ErrorKind::NotFound => plain(ErrorKind::NotFound, "no such node; is the camera attached?"),
        // ENODEV and ENXIO: the node is still there, the device behind it is not.
        _ if matches!(e.raw_os_error(), Some(19 | 6)) => plain(ErrorKind::Disconnected, "the camera is gone"),
        _ => plain(ErrorKind::Io, &e.to_string()),
    };
    error.with_source(e)
}

/// Warning for a USB3 camera that runs as a USB2 device; `None` for any other.
pub fn slow_link(device: &UsbDevice) -> Option<String> {
    (is_usb3_device(device) && (1..SUPERSPEED_MBPS).contains(&device.speed_mbps)).then(|| {
        format!(
            "USB port {} runs it as USB2 ({} Mbit/s), which offers fewer modes and carries few streams: move it to a USB3 \
             socket, with a USB3 cable that is pushed in fully",
            device.port, device.speed_mbps
        )
    })
}

/// Whether the device could run at USB3 speed: known cameras, and any device of USB 2.1 or later, which a USB3 device
/// calls itself on a USB2 link (USB 3.2 specification, section 9.2.6.6).
pub fn is_usb3_device(device: &UsbDevice) -> bool {
    /// RealSense D400 and L515, ZED 2i and Azure Kinect (librealsense `ds/d400/d400-private.h`; zed-open-capture
    /// `defines.hpp`; Azure-Kinect-Sensor-SDK `99-k4a.rules`).
    const KNOWN: [(u16, u16); 19] = [
        (0x045e, 0x097c),
        (0x045e, 0x097d),
        (0x8086, 0x0ad1),
        (0x8086, 0x0ad2),
        (0x8086, 0x0ad3),
        (0x8086, 0x0ad4),
        (0x8086, 0x0b07),
        (0x8086, 0x0b3a),
        (0x8086, 0x0b4b),
        (0x8086, 0x0b5b),
        (0x8086, 0x0b5c),
        (0x8086, 0x0b64),
        (0x8086, 0x1155),
        (0x8086, 0x1156),
        (0x2b03, 0xf580),
        (0x2b03, 0xf582),
        (0x2b03, 0xf682),
        (0x2b03, 0xf780),
        (0x2b03, 0xf880),
    ];
    device.usb_version >= 0x0210 || KNOWN.contains(&(device.vendor_id, device.product_id))
}

/// Warning when the kernel is allowed to put the camera to sleep; `None` when it is not.
pub fn may_sleep(device: &UsbDevice) -> Option<String> {
    (device.power_control == PowerControl::Auto).then(|| {
        format!(
            "the kernel may put it to sleep when it is idle (autosuspend), from which some cameras do not wake: \
             {RULE_CURE}, or write `on` to /sys/bus/usb/devices/{}/power/control",
            device.port
        )
    })
}

/// Limit for the USB transfers of all programs together, MB; 0 means unlimited. `None` when the kernel does not say.
pub fn usbfs_limit_mb(root: &SysRoot) -> Option<u32> {
    root.read(USBFS_LIMIT)?.parse().ok()
}

/// Warning when the transfers of the libusb path, `needed` bytes, do not fit below the kernel's limit; `None` when
/// they do, or when the kernel does not say.
pub fn usbfs_too_small(root: &SysRoot, needed: u64) -> Option<String> {
    let limit = usbfs_limit_mb(root)?;
    let needed_mb = needed.div_ceil(1 << 20);
    (limit != 0 && needed_mb > u64::from(limit)).then(|| {
        // Half as much again: the kernel counts its own overhead and other programs.
        let enough = (needed_mb * 3 / 2).next_multiple_of(64);
        format!(
            "the kernel lets programs have {limit} MB in USB transfers, {needed_mb} MB are needed; as root: \
             `echo {enough} > /{USBFS_LIMIT}`, and `usbcore.usbfs_memory_mb={enough}` on the kernel's command line \
             to keep it"
        )
    })
}

#[cfg(test)]
mod tests;
