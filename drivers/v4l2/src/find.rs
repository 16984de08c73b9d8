//! Which cameras are attached, and which of them a rig means.

use super::config::V4l2Config;
use super::node::{Capability, Node};
use depthrig_driver::{DeviceInfo, Error, ErrorKind, Result};
use depthrig_usb::uvc::descriptors::Configuration;
use depthrig_usb::{SysRoot, UsbDevice, VideoNode, health, scan, video_nodes};
use std::path::PathBuf;

/// An attached camera, not opened.
#[derive(Debug, Clone)]
pub(super) struct FoundCamera {
    pub(super) info: DeviceInfo,
    /// Its nodes by interface and number, whatever they are.
    nodes: Vec<VideoNode>,
    pub(super) usb: Option<UsbDevice>,
}

/// A capture node with the metadata node of its interface.
pub(super) struct NodePair {
    pub(super) video: Node,
    pub(super) metadata: Option<Node>,
}

/// The family that has a driver of its own for a USB device, by its vendor.
pub(super) const fn family(vendor_id: u16) -> Option<&'static str> {
    match vendor_id {
        0x8086 => Some("realsense"),
        0x2B03 => Some("zed"),
        _ => None,
    }
}

/// Every camera at a video node: those on USB, without being opened, and those elsewhere, which must be asked.
pub(super) fn cameras(root: &SysRoot) -> Result<Vec<FoundCamera>> {
    let mut found: Vec<FoundCamera> = scan(root)?.into_iter().filter_map(on_usb).collect();
    for node in video_nodes(root)? {
        // A node that cannot be opened cannot be identified.
        let capability = match Node::open(&node.path) {
            Ok(opened) => opened.capability().clone(),
            Err(e) => {
                tracing::debug!(node = %node.path.display(), error = %e, "a video node is left out");
                continue;
            }
        };
        if !capability.is_capture() && !capability.is_metadata() {
            continue;
        }
        match found.iter_mut().find(|f| f.usb.is_none() && f.info.port == capability.bus) {
            Some(camera) => camera.nodes.push(node),
            None => found.push(elsewhere(&capability, node)),
        }
    }
    Ok(found)
}

fn on_usb(usb: UsbDevice) -> Option<FoundCamera> {
    let nodes: Vec<_> = usb.video_nodes().cloned().collect();
    let name = nodes.first()?.name.clone();
    // uvcvideo: "HD Webcam C920: HD Webcam C920", cut off where the field ends.
    let name = if usb.product.is_empty() { name } else { usb.product.clone() };
    let info = DeviceInfo {
        backend: super::NAME,
        model: name,
        serial: if usb.serial.is_empty() { usb.port.clone() } else { usb.serial.clone() },
        firmware: format!("{:x}.{:02x}", usb.device_version >> 8, usb.device_version & 0xFF),
        port: usb.port.clone(),
        calibration: "none".to_owned(),
        motion: String::new(),
    };
    Some(FoundCamera { info, nodes, usb: Some(usb) })
}

fn elsewhere(capability: &Capability, node: VideoNode) -> FoundCamera {
    let info = DeviceInfo {
        backend: super::NAME,
        model: capability.card.clone(),
        serial: capability.bus.clone(),
        firmware: String::new(),
        port: capability.bus.clone(),
        calibration: "none".to_owned(),
        motion: String::new(),
    };
    FoundCamera { info, nodes: vec![node], usb: None }
}

impl FoundCamera {
    /// `HD Webcam (serial 1234) at 4-1.2`, for messages.
    pub(super) fn describe(&self) -> String {
        let DeviceInfo { model, serial, port, .. } = &self.info;
        if serial == port {
            format!("{model} at {port}")
        } else {
            format!("{model} (serial {serial}) at {port}")
        }
    }

    /// Whether this is its port: of a camera on no USB also the kernel's name of the device, such as `vivid.0`.
    fn is_at(&self, port: &str) -> bool {
        self.info.port == port || (self.usb.is_none() && self.nodes.iter().any(|n| n.parent == port))
    }

    /// The family that has a driver of its own for it.
    pub(super) fn family(&self) -> Option<&'static str> {
        self.usb.as_ref().and_then(|u| family(u.vendor_id))
    }

    /// Ticks a second of the clock in its payload headers, as its descriptor says.
    pub(super) fn clock_hz(&self, root: &SysRoot) -> Option<u32> {
        let usb = self.usb.as_ref()?;
        let file = root.join("sys/bus/usb/devices").join(&usb.port).join("descriptors");
        let bytes = std::fs::read(file).ok()?;
        // The device descriptor has 18 bytes; configurations follow.
        let configuration = Configuration::parse(bytes.get(18..)?).ok()?;
        configuration.controls.first().map(|c| c.clock_hz).filter(|hz| *hz > 0)
    }

    /// Opens its nodes: those that give images, each with the metadata node that follows it on its interface.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] (with the cure), [`ErrorKind::Busy`] (naming the holder),
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Unsupported`] when it gives no images.
    pub(super) fn open(&self, root: &SysRoot) -> Result<Vec<NodePair>> {
        let mut pairs: Vec<(String, NodePair)> = Vec::new();
        for node in &self.nodes {
            let opened = Node::open(&node.path).map_err(|e| match e.kind() {
                ErrorKind::PermissionDenied => health::denied(&self.describe(), &node.path).with_source(e),
                ErrorKind::Busy => health::busy(root, &self.describe(), &node.path).with_source(e),
                _ => e,
            })?;
            let capability = opened.capability();
            if capability.is_capture() && capability.can_stream() {
                pairs.push((node.parent.clone(), NodePair { video: opened, metadata: None }));
            } else if capability.is_metadata()
                && let Some((parent, pair)) = pairs.last_mut()
                && *parent == node.parent
            {
                pair.metadata = Some(opened);
            }
        }
        if pairs.is_empty() {
            let what = format!("{} gives no images: none of its nodes captures video", self.describe());
            return Err(Error::new(ErrorKind::Unsupported, what));
        }
        Ok(pairs.into_iter().map(|(_, pair)| pair).collect())
    }

    /// The paths of its nodes, for finding out who holds one.
    pub(super) fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        self.nodes.iter().map(|n| &n.path)
    }
}

/// The camera that `config` and `serial` mean. One that another family drives must be named.
///
/// # Errors
/// [`ErrorKind::NotFound`] with what there is.
pub(super) fn choose(
    found: &[FoundCamera],
    config: &V4l2Config,
    serial: Option<&str>,
) -> Result<FoundCamera> {
    let serial = serial.or(config.serial.as_deref());
    let port = config.port.as_deref();
    let named = serial.is_some() || port.is_some();
    let fits = |f: &FoundCamera| {
        serial.is_none_or(|s| f.info.serial == s)
            && port.is_none_or(|p| f.is_at(p))
            && (named || f.family().is_none())
    };
    let mut fitting = found.iter().filter(|f| fits(f));
    if let (Some(one), None) = (fitting.next(), fitting.next()) {
        return Ok(one.clone());
    }
    let wanted = match (serial, port) {
        (Some(s), Some(p)) => format!("no camera with serial number \"{s}\" at port {p}"),
        (Some(s), None) => format!("no camera, or more than one, with serial number \"{s}\""),
        (None, Some(p)) => format!("no camera at port {p}"),
        (None, None) => "set serial or port: no camera, or more than one, fits without them".to_owned(),
    };
    let list: Vec<_> = found
        .iter()
        .map(|f| match f.family() {
            Some(family) => format!("{} (driven by the backend {family})", f.describe()),
            None => f.describe(),
        })
        .collect();
    let there = if list.is_empty() {
        "no camera is attached".to_owned()
    } else {
        format!("there are: {}", list.join(", "))
    };
    Err(Error::new(ErrorKind::NotFound, format!("{wanted}; {there}")))
}

#[cfg(test)]
mod tests;
