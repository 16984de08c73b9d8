//! The configuration of a D400 in a rig.

use super::protocol::sync::SyncMode;
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A D400 and how it is to be set. What is `None` stays as the camera has it after power-on.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RealsenseConfig {
    /// Module serial number, as printed on the camera; `None`: the one at `port`, or the only one.
    pub serial: Option<String>,
    /// Port path on the bus, such as `4-1.2`.
    pub port: Option<String>,
    /// Kernel driver or libusb.
    pub transport: TransportChoice,
    /// The most metadata that is asked of the kernel.
    pub metadata: MetadataWish,
    /// The projector.
    pub emitter: Option<Emitter>,
    /// Power of the projector, milliwatts.
    pub laser_power_mw: Option<u16>,
    /// Exposure of the stereo module, microseconds; turns its auto-exposure off.
    pub exposure_us: Option<u32>,
    /// Auto-exposure of the stereo module.
    pub auto_exposure: Option<bool>,
    /// Gain of the stereo module, in the camera's units.
    pub gain: Option<u32>,
    /// A file of advanced-mode groups ([`super::protocol::preset`]) that is written at the start.
    pub preset: Option<PathBuf>,
    /// Synchronisation between cameras, by cable.
    pub sync: Option<SyncMode>,
    /// Controls of the colour image by their V4L2 names.
    pub color_controls: BTreeMap<String, ControlValue>,
    /// Metres per unit of depth. It is written to the camera, which must be in advanced mode.
    pub depth_unit_m: Option<f64>,
    /// Whether a camera without factory calibration is used all the same; its intrinsics are unknown then.
    pub allow_uncalibrated: bool,
    /// Whether the camera is restarted (hardware reset) as the last resort when it sends no frame.
    pub reset_when_silent: bool,
}

/// How the camera is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum TransportChoice {
    /// The kernel's driver where it has bound the camera, else libusb.
    #[default]
    Auto,
    /// The kernel's video driver.
    Kernel,
    /// libusb, which takes the camera from the kernel's driver.
    Libusb,
}

/// The most metadata that is asked of the kernel; less than it grants is for tests and comparisons.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum MetadataWish {
    /// As much as there is.
    #[default]
    Full,
    /// The standard payload header.
    Header,
    /// None.
    None,
}

/// The projector, with the values of extension-unit control 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Emitter {
    /// Dark.
    Off = 0,
    /// Laser on.
    Laser = 1,
    /// The camera decides.
    Auto = 2,
    /// LED instead of the laser, where there is one.
    Led = 3,
}
