//! Attached devices as a family recognises them.

use depthrig_driver::Backend;
use depthrig_usb::{SysRoot, UsbDevice, VideoNode};
use std::path::PathBuf;

/// USB class of video, and its subclass of controlling interfaces (UVC 1.5 class specification, tables ).
const VIDEO_CONTROL: (u8, u8) = (0x0e, 0x01);

/// A family's answer about a device on the USB.
#[derive(Debug)]
pub enum Identified {
    /// A camera of the family.
    Camera(Found),
    /// A camera of the family if no other one knows it.
    Generic(Found),
    /// A part of a camera that another device stands for.
    Part,
    /// A camera that is unusable: why, and what to do.
    Unusable(&'static str),
}

/// A camera as the bus shows it.
#[derive(Debug, Default)]
pub struct Found {
    /// Model, else the device's own name.
    pub model: String,
    /// Its video nodes.
    pub nodes: Vec<VideoNode>,
    /// Its raw HID nodes.
    pub hidraw: Vec<PathBuf>,
    /// Serial number as rig files have it, if the bus shows it.
    pub serial: Option<String>,
    /// Serial number that is shown only while nobody uses the camera.
    pub idle_serial: Option<String>,
    /// The problem with how it is attached.
    pub problem: Option<String>,
}

impl Found {
    /// A camera that is the device `d` alone.
    pub fn of(model: impl Into<String>, d: &UsbDevice) -> Self {
        let nodes = d.video_nodes().cloned().collect();
        Self { model: model.into(), nodes, hidraw: hidraw(d).collect(), ..Self::default() }
    }
}

/// The raw HID nodes of a device.
pub fn hidraw(d: &UsbDevice) -> impl Iterator<Item = PathBuf> {
    d.interfaces.iter().flat_map(|i| i.hidraw_nodes.iter().cloned())
}

/// Whether a device is a USB video camera.
pub fn is_video(d: &UsbDevice) -> bool {
    d.interfaces.iter().any(|i| (i.class, i.subclass) == VIDEO_CONTROL)
}

/// The files that an IMU is read through, if it is not read with the images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImuFiles {
    /// None.
    None,
    /// The raw HID nodes.
    Hidraw,
    /// The kernel's industrial I/O sensors at the same port.
    Iio,
}

/// Creates the driver of an attached camera.
pub type ProbeFn = fn(&Probe<'_>) -> Box<dyn Backend>;

/// The attached camera that is asked.
pub struct Probe<'c> {
    /// Its port.
    pub port: &'c str,
    /// The folder that `/sys` is in.
    pub root: &'c SysRoot,
    /// The cameras of the rig that is examined; empty without one.
    pub rig: &'c [super::BackendConfig],
}
