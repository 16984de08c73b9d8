//! Which devices are cameras, and of which family.

use super::{UsbDevice, VideoNode};
use depthrig_drivers::kinect::live::find as kinect;
use depthrig_drivers::realsense::models as d400;
use std::path::PathBuf;

/// USB class of video, and its subclass of controlling interfaces (UVC 1.5 class specification, tables ).
const VIDEO_CONTROL: (u8, u8) = (0x0e, 0x01);
const STEREOLABS: u16 = 0x2b03;
/// ZED 2i: camera, and the inertial sensor that hangs beside it on one hub (zed-open-capture `include/defines.hpp`).
const ZED_2I: (u16, u16) = (0xf880, 0xf881);
/// L515 and its recovery mode (librealsense 2.54 `src/l500/l500-private.h`).
const L515: u16 = 0x0b64;
const L515_RECOVERY: u16 = 0x0b55;

/// OAK cameras, whose processor is a Movidius Myriad X: before its firmware is uploaded, with it, in its boot loader, and
/// started from flash (XLink `src/pc/protocols/usb_host.cpp`, Apache-2.0).
const MOVIDIUS: u16 = 0x03e7;
const OAK_UNBOOTED: u16 = 0x2485;
const OAK_BOOTED: [u16; 3] = [0xf63b, 0xf63c, 0xf63d];

/// A family of cameras that are driven alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Family {
    /// RealSense D400.
    D400,
    /// RealSense L515.
    L515,
    /// ZED 2i.
    Zed,
    /// Azure Kinect.
    Kinect,
    /// Any other USB video camera.
    Uvc,
    /// A video device that is on no USB.
    Platform,
    /// OAK, which another process drives.
    Oak,
    /// A camera that another process serves.
    External,
}

impl Family {
    /// The driver's name in a rig file.
    pub const fn backend(self) -> &'static str {
        match self {
            Self::D400 => "realsense",
            Self::L515 => "l515",
            Self::Zed => "zed",
            Self::Kinect => depthrig_drivers::kinect::NAME,
            Self::Uvc | Self::Platform => "v4l2",
            Self::Oak | Self::External => depthrig_drivers::external::NAME,
        }
    }
}

/// A camera as the bus shows it.
pub(super) struct Candidate {
    pub(super) family: Family,
    pub(super) model: String,
    pub(super) port: String,
    pub(super) usb: Option<UsbDevice>,
    pub(super) nodes: Vec<VideoNode>,
    pub(super) hidraw: Vec<PathBuf>,
    /// The serial number as rig files have it, where the bus already shows it.
    pub(super) serial: Option<String>,
    /// The problem with how it is attached.
    pub(super) problem: Option<String>,
}

/// The cameras among `devices` and `platform` nodes, each with its port, and attached devices that are unusable.
pub(super) fn cameras(
    devices: &[UsbDevice],
    platform: impl Iterator<Item = (String, VideoNode)>,
) -> (Vec<Candidate>, Vec<String>) {
    let mut cameras = Vec::new();
    let mut unusable = Vec::new();
    let kinects = kinect::cameras(devices);
    for d in devices {
        // The halves of a Kinect are one camera, which goes by its depth half.
        if let Some(found) = kinects.iter().find(|k| k.depth == *d) {
            cameras.push(kinect_camera(found));
            continue;
        }
        if kinects.iter().any(|k| k.color.as_ref() == Some(d)) {
            continue;
        }
        match family(d) {
            Ok(Some((family, model))) => cameras.push(Candidate {
                family,
                model,
                port: d.port.clone(),
                nodes: d.video_nodes().cloned().collect(),
                hidraw: hidraw(d, devices),
                usb: Some(d.clone()),
                serial: None,
                problem: None,
            }),
            Ok(None) => {}
            Err(why) => unusable.push(format!("{}: {why}", d.describe())),
        }
    }
    for (place, node) in platform {
        match cameras.iter_mut().find(|c| c.usb.is_none() && c.port == place) {
            Some(camera) => camera.nodes.push(node),
            None => cameras.push(Candidate {
                family: Family::Platform,
                model: node.name.clone(),
                port: place,
                usb: None,
                nodes: vec![node],
                hidraw: Vec::new(),
                serial: None,
                problem: None,
            }),
        }
    }
    (cameras, unusable)
}

fn kinect_camera(found: &kinect::FoundCamera) -> Candidate {
    let color = found.color.as_ref();
    Candidate {
        family: Family::Kinect,
        model: kinect::MODEL.to_owned(),
        port: found.depth.port.clone(),
        nodes: color.into_iter().flat_map(|d| d.video_nodes().cloned()).collect(),
        hidraw: Vec::new(),
        usb: Some(found.depth.clone()),
        serial: found.serial().map(str::to_owned),
        problem: color.is_none().then(|| {
            "its colour camera is not on the bus, without which libk4a does not open it: plug it in again, with its power \
             supply"
                .to_owned()
        }),
    }
}

/// The family of a device with its model; `None` when it is not a camera, an error when it is an unusable one.
fn family(d: &UsbDevice) -> Result<Option<(Family, String)>, &'static str> {
    if d.vendor_id == d400::VENDOR {
        if let Some(model) = d400::of_product(d.product_id) {
            return Ok(Some((Family::D400, model.name.to_owned())));
        }
        if d.product_id == L515 {
            return Ok(Some((Family::L515, "L515".to_owned())));
        }
        if d.product_id == L515_RECOVERY {
            return Err("it is in recovery mode: its firmware was lost; write it again with Intel's tools");
        }
        if let Some(why) = d400::undriven(d.product_id) {
            return Err(why);
        }
    }
    if (d.vendor_id, d.product_id) == (kinect::VENDOR, kinect::COLOR) {
        return Err(
            "it is an Azure Kinect whose depth camera is not on the bus: plug it in again, with its power supply",
        );
    }
    if (d.vendor_id, d.product_id) == (STEREOLABS, ZED_2I.0) {
        return Ok(Some((Family::Zed, "ZED 2i".to_owned())));
    }
    if d.vendor_id == MOVIDIUS && d.product_id == OAK_UNBOOTED {
        return Ok(Some((Family::Oak, "OAK, not booted".to_owned())));
    }
    if d.vendor_id == MOVIDIUS && OAK_BOOTED.contains(&d.product_id) {
        return Ok(Some((Family::Oak, "OAK".to_owned())));
    }
    let is_video = d.interfaces.iter().any(|i| (i.class, i.subclass) == VIDEO_CONTROL);
    let name = if d.product.is_empty() { d.id() } else { d.product.clone() };
    Ok(is_video.then_some((Family::Uvc, name)))
}

/// The serial number that the descriptors of an OAK have: only its firmware has one.
pub(super) fn oak_serial(d: &UsbDevice) -> Option<String> {
    (d.product_id != OAK_UNBOOTED && !d.serial.is_empty()).then(|| d.serial.clone())
}

/// The raw HID nodes of a camera; a ZED 2i has them on a device beside itself.
fn hidraw(d: &UsbDevice, all: &[UsbDevice]) -> Vec<PathBuf> {
    let hub = |port: &str| port.rsplit_once('.').map(|(hub, _)| hub.to_owned());
    let beside = |other: &&UsbDevice| {
        (d.vendor_id, d.product_id) == (STEREOLABS, ZED_2I.0)
            && (other.vendor_id, other.product_id) == (STEREOLABS, ZED_2I.1)
            // The hub is one for USB2 and one for USB3, of the same ports below their buses.
            && hub(&other.port).map(|p| without_bus(&p)) == hub(&d.port).map(|p| without_bus(&p))
    };
    let sources = all.iter().filter(beside).chain([d]);
    sources.flat_map(|d| d.interfaces.iter().flat_map(|i| i.hidraw_nodes.iter().cloned())).collect()
}

fn without_bus(port: &str) -> String {
    port.split_once('-').map_or(port, |(_, ports)| ports).to_owned()
}
