//! Where a camera's frames come from, as far as its settings say: the doctor plans a session by it.

use depthrig_driver::{Result, StreamProfile};
use std::path::Path;

/// Where a camera's frames come from.
#[derive(Debug)]
pub enum Source<'c> {
    /// An attached device.
    Attached(Selector<'c>),
    /// Another process.
    Served(Service<'c>),
    /// No device: a simulation, files, a recording. Its streams are known now, or the error that the session would get.
    Here(Result<Offered>),
}

/// Which attached device a camera selects, and how it is read.
#[derive(Debug, Default)]
pub struct Selector<'c> {
    /// Serial number.
    pub serial: Option<&'c str>,
    /// Port path on the USB, or the kernel's name of the device.
    pub port: Option<&'c str>,
    /// Whether it is read through libusb whatever the kernel offers.
    pub libusb: bool,
    /// Memory that the kernel counts for the transfers of a vendor's library, bytes.
    pub transfer_bytes: u64,
    /// Whether it is refused without a calibration.
    pub needs_calibration: bool,
    /// Whether the facts about its frames come from the kernel's metadata nodes.
    pub kernel_metadata: bool,
}

/// The process that serves a camera.
#[derive(Debug)]
pub struct Service<'c> {
    /// Program and arguments that start it; empty when it is started by itself.
    pub command: &'c [String],
    /// Folder that the command runs in.
    pub directory: &'c Path,
}

/// The streams of a camera without a device.
#[derive(Debug)]
pub struct Offered {
    /// The camera in words.
    pub device: String,
    /// Every mode of its streams.
    pub profiles: Vec<StreamProfile>,
}
