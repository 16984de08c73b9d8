//! The devices on the USB with their interfaces and nodes, found by topology: what `/dev/videoN` is called never
//! matters.
//!
//! Sources: the kernel's `Documentation/ABI/{stable/sysfs-bus-usb,testing/sysfs-bus-usb}` for the files, and
//! `Documentation/ABI/stable/sysfs-class-video4linux`'s `index` and `name`.

use super::SysRoot;
use super::root::read_text;
use depthrig_driver::{Error, ErrorKind, Result};
use std::io;
use std::path::{Path, PathBuf};

/// A device on the USB; the root hubs that are part of the computer are left out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbDevice {
    /// Bus and the chain of ports, such as `4-1.2`: the same for as long as the cable stays where it is.
    pub port: String,
    /// Number of the bus, which is another for the USB2 and the USB3 half of one socket.
    pub bus_number: u16,
    /// Number on the bus; another after every replug.
    pub device_number: u16,
    /// Vendor, such as 0x8086.
    pub vendor_id: u16,
    /// Product of the vendor.
    pub product_id: u16,
    /// `bcdDevice` of the descriptor, 4 digits.
    pub device_version: u16,
    /// Class of the device; 9 is a hub.
    pub class: u8,
    /// Manufacturer, as the device reports it; empty if unknown.
    pub manufacturer: String,
    /// Product name, as the device reports it; empty if unknown.
    pub product: String,
    /// `iSerial`; empty if unknown. On a RealSense it is not the printed serial number.
    pub serial: String,
    /// Speed of the link, Mbit/s: 12, 480, 5000, 10000, 20000. 0 when unknown.
    pub speed_mbps: u32,
    /// USB version that the device says it keeps to, as BCD: 0x0200, 0x0210, 0x0320. 0 when unknown.
    pub usb_version: u16,
    /// The host controller that serves the device, such as `0000:00:14.0`; every bus of it shares the bandwidth.
    pub controller: String,
    /// Whether the kernel may put the device to sleep.
    pub power_control: PowerControl,
    /// `/dev/bus/usb/004/007`: what libusb opens.
    pub node: PathBuf,
    /// Interfaces of the active configuration by number.
    pub interfaces: Vec<UsbInterface>,
}

/// Whether the kernel may suspend an idle device (`power/control`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PowerControl {
    /// Never.
    On,
    /// After a while of no use.
    Auto,
    /// The kernel does not say.
    Unknown,
}

/// An interface of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbInterface {
    /// `bInterfaceNumber`.
    pub number: u8,
    /// `bInterfaceClass`: 0x0e is video, 0x03 HID, 0xff the vendor's own.
    pub class: u8,
    /// `bInterfaceSubClass`: of video, 1 is control and 2 streaming.
    pub subclass: u8,
    /// `bInterfaceProtocol`.
    pub protocol: u8,
    /// The driver that holds it: `uvcvideo`, `usbhid`, `usbfs` (a program, through libusb).
    pub driver: Option<String>,
    /// Its video nodes in the order of their numbers. uvcvideo hangs the nodes of all streaming interfaces on the
    /// control interface of their function.
    pub video_nodes: Vec<VideoNode>,
    /// Its raw HID nodes.
    pub hidraw_nodes: Vec<PathBuf>,
}

/// A node of V4L2. Whether images or metadata come out of it, only the node itself says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VideoNode {
    /// `/dev/video4`, below the root that was asked.
    pub path: PathBuf,
    /// The 4 of `video4`; it changes between starts of the computer.
    pub number: u32,
    /// Place among the nodes of its device, from 0.
    pub index: u32,
    /// The driver's name for it.
    pub name: String,
    /// The kernel's name of the device it belongs to: `4-1.2:1.0`, `vivid.0`.
    pub parent: String,
}

impl UsbDevice {
    /// All of its video nodes, by interface and number.
    pub fn video_nodes(&self) -> impl Iterator<Item = &VideoNode> {
        self.interfaces.iter().flat_map(|i| &i.video_nodes)
    }

    /// `8086:0b07`.
    pub fn id(&self) -> String {
        format!("{:04x}:{:04x}", self.vendor_id, self.product_id)
    }

    /// `Intel RealSense 435 (8086:0b07) at USB port 4-1.2`, for messages.
    pub fn describe(&self) -> String {
        let name = if self.product.is_empty() { "USB device" } else { &self.product };
        format!("{name} ({}) at USB port {}", self.id(), self.port)
    }
}

/// The devices on the USB, in the order of their ports. Devices that come or go meanwhile are in it or not.
///
/// # Errors
/// [`ErrorKind::PermissionDenied`] or [`ErrorKind::Io`] when `/sys/bus/usb/devices` is there and cannot be listed. A
/// computer without USB has neither the folder nor devices.
pub fn scan(root: &SysRoot) -> Result<Vec<UsbDevice>> {
    let mut devices: Vec<_> = list(&root.join("sys/bus/usb/devices"))?
        .into_iter()
        // `usb1` is a root hub, `4-1:1.0` an interface.
        .filter(|(name, _)| name.starts_with(|c: char| c.is_ascii_digit()) && !name.contains(':'))
        .filter_map(|(name, path)| device(root, name, &path))
        .collect();
    devices.sort_by_cached_key(|d| port_key(&d.port));
    Ok(devices)
}

/// The video nodes that are on no USB device (`vivid`, cameras of the platform), by number.
///
/// # Errors
/// As those of [`scan`], for `/sys/class/video4linux`.
pub fn video_nodes(root: &SysRoot) -> Result<Vec<VideoNode>> {
    let mut nodes = Vec::new();
    for (name, path) in list(&root.join("sys/class/video4linux"))? {
        let Ok(real) = path.canonicalize() else { continue };
        let on_usb = real.ancestors().any(|dir| dir.join("bInterfaceNumber").exists());
        // …/vivid.0/video4linux/video3
        let parent = real.ancestors().nth(2).map(file_name).unwrap_or_default();
        if !on_usb {
            nodes.extend(video_node(root, &name, &real, &parent));
        }
    }
    nodes.sort_by_key(|n| n.number);
    Ok(nodes)
}

fn device(root: &SysRoot, port: String, path: &Path) -> Option<UsbDevice> {
    let real = path.canonicalize().ok()?;
    let text = |file: &str| read_text(&real.join(file)).unwrap_or_default();
    let bus_number = text("busnum").parse().ok()?;
    let device_number = text("devnum").parse().ok()?;
    // The kernel answers this when it is done with the device: until then it adds interface after interface, each with
    // its nodes, and what is listed in the meantime is a camera with parts missing. (usb_lock_device in the sysfs
    // attributes of the configuration.)
    let _ = text("bNumInterfaces");
    let root_hub = format!("usb{bus_number}");
    let controller =
        real.ancestors().find(|dir| file_name(dir) == root_hub).and_then(Path::parent).map(file_name);
    let mut interfaces: Vec<_> = list(&real)
        .ok()?
        .into_iter()
        .filter(|(name, _)| name.strip_prefix(&port).is_some_and(|rest| rest.starts_with(':')))
        .filter_map(|(name, path)| interface(root, &name, &path))
        .collect();
    interfaces.sort_by_key(|i| i.number);
    Some(UsbDevice {
        bus_number,
        device_number,
        vendor_id: hex16(&text("idVendor"))?,
        product_id: hex16(&text("idProduct"))?,
        device_version: hex16(&text("bcdDevice")).unwrap_or(0),
        class: hex8(&text("bDeviceClass")).unwrap_or(0),
        manufacturer: text("manufacturer"),
        product: text("product"),
        serial: text("serial"),
        // 1.5 is a speed too, and no camera's.
        speed_mbps: text("speed").parse::<f64>().unwrap_or(0.0) as u32,
        usb_version: version(&text("version")).unwrap_or(0),
        controller: controller.unwrap_or_default(),
        power_control: match text("power/control").as_str() {
            "on" => PowerControl::On,
            "auto" => PowerControl::Auto,
            _ => PowerControl::Unknown,
        },
        node: root.join(format!("dev/bus/usb/{bus_number:03}/{device_number:03}")),
        interfaces,
        port,
    })
}

fn interface(root: &SysRoot, name: &str, path: &Path) -> Option<UsbInterface> {
    let number = |file: &str| hex8(&read_text(&path.join(file))?);
    let mut video_nodes: Vec<_> = list(&path.join("video4linux"))
        .unwrap_or_default()
        .into_iter()
        .filter_map(|(node, path)| video_node(root, &node, &path, name))
        .collect();
    video_nodes.sort_by_key(|n| n.number);
    // `…/0003:2B03:F881.0004/hidraw/hidraw2`
    let mut hidraw_nodes: Vec<_> = list(path)
        .unwrap_or_default()
        .into_iter()
        .flat_map(|(_, hid)| list(&hid.join("hidraw")).unwrap_or_default())
        .map(|(node, _)| root.join("dev").join(node))
        .collect();
    hidraw_nodes.sort();
    Some(UsbInterface {
        number: number("bInterfaceNumber")?,
        class: number("bInterfaceClass").unwrap_or(0),
        subclass: number("bInterfaceSubClass").unwrap_or(0),
        protocol: number("bInterfaceProtocol").unwrap_or(0),
        driver: std::fs::read_link(path.join("driver")).ok().map(|link| file_name(&link)),
        video_nodes,
        hidraw_nodes,
    })
}

/// The node that the folder `path`, named `name`, stands for; `None` for `v4l-subdev0`, `vbi0` and their like.
fn video_node(root: &SysRoot, name: &str, path: &Path, parent: &str) -> Option<VideoNode> {
    let number = name.strip_prefix("video")?.parse().ok()?;
    Some(VideoNode {
        path: root.join("dev").join(name),
        number,
        index: read_text(&path.join("index")).and_then(|t| t.parse().ok()).unwrap_or(0),
        name: read_text(&path.join("name")).unwrap_or_default(),
        parent: parent.to_owned(),
    })
}

/// Names and paths of the entries of a folder; empty when the folder does not exist.
fn list(dir: &Path) -> Result<Vec<(String, PathBuf)>> {
    let failed = |e: io::Error| {
        let denied = e.kind() == io::ErrorKind::PermissionDenied;
        let kind = if denied { ErrorKind::PermissionDenied } else { ErrorKind::Io };
        Error::new(kind, format!("{} cannot be listed: {e}; is /sys mounted?", dir.display())).with_source(e)
    };
    let entries = match std::fs::read_dir(dir) {
        Ok(entries) => entries,
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return Ok(Vec::new());
        }
        Err(e) => return Err(failed(e)),
    };
    // An entry that cannot be read is a device that is just leaving.
    Ok(entries.flatten().map(|e| (e.file_name().to_string_lossy().into_owned(), e.path())).collect())
}

/// Sorts `4-1.10` after `4-1.2`.
fn port_key(port: &str) -> Vec<u32> {
    port.split(['-', '.']).map(|part| part.parse().unwrap_or(u32::MAX)).collect()
}

/// ` 3.20` as 0x0320.
fn version(text: &str) -> Option<u16> {
    let (major, minor) = text.split_once('.')?;
    hex16(&format!("{major:0>2}{minor:0<2}"))
}

fn hex16(text: &str) -> Option<u16> {
    u16::from_str_radix(text, 16).ok()
}

fn hex8(text: &str) -> Option<u8> {
    u8::from_str_radix(text, 16).ok()
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests;
