//! Camera families: all that the daemon knows of one is in its file here, and one line of [`FAMILIES`] adds it.
//!
//! A family is a type of settings that implements [`CameraSettings`], and a [`Family`] that reads them from a `[[camera]]`
//! table. Its driver is a crate in `drivers/`, which knows no configuration.

mod bus;
mod external;
mod files;
pub(crate) mod kinect;
mod l515;
mod reader;
mod realsense;
mod settings;
mod source;
mod synthetic;
#[cfg(test)]
mod tests;
mod v4l2;
mod zed;

pub use bus::{Found, Identified, ImuFiles, Probe, ProbeFn, hidraw, is_video};
pub use reader::Reader;
pub use settings::{AnySettings, BackendConfig, CameraSettings, OpenContext, Preparation, Unmet};
pub use source::{Offered, Selector, Service, Source};

use depthrig_usb::UsbDevice;

/// The families, in the order in which messages list them.
pub const FAMILIES: &[Family] = &[
    synthetic::FAMILY,
    files::FAMILY,
    realsense::FAMILY,
    l515::FAMILY,
    v4l2::FAMILY,
    zed::FAMILY,
    external::FAMILY,
    kinect::FAMILY,
];

/// The family of video devices that are on no USB.
pub const PLATFORM: &Family = &v4l2::FAMILY;
/// The family of cameras that other processes serve.
pub const SERVED: &Family = &external::FAMILY;

/// A family of cameras that one driver reads.
#[derive(Clone, Copy)]
pub struct Family {
    /// Its name in a rig file: `backend = "NAME"`.
    pub name: &'static str,
    /// Whether its cameras may have left and right images, from which `[camera.stereo]` computes depth.
    pub has_stereo: bool,
    /// Whether the ports of its cameras can be those of attached devices.
    pub has_ports: bool,
    /// Reads its keys of a `[[camera]]` table; `None` after a problem that leaves nothing to build on.
    pub read: fn(&Reader<'_>) -> Option<BackendConfig>,
    /// Creates a driver that asks an attached camera for its description and modes; `None` for a family that has none.
    pub probe: Option<ProbeFn>,
    /// Recognises its cameras among all devices on the USB.
    pub identify: fn(&UsbDevice, &[UsbDevice]) -> Option<Identified>,
    /// The files that the IMU of an attached camera is read through.
    pub imu: ImuFiles,
}

impl Family {
    /// A family of cameras that are no devices: simulated, or played from files.
    pub const fn new(name: &'static str, read: fn(&Reader<'_>) -> Option<BackendConfig>) -> Self {
        Self {
            name,
            has_stereo: false,
            has_ports: false,
            read,
            probe: None,
            identify: |_, _| None,
            imu: ImuFiles::None,
        }
    }
}

/// The family that `device` is a camera of, among all `devices` on the USB, with its answer.
pub fn identify(device: &UsbDevice, devices: &[UsbDevice]) -> Option<(&'static Family, Identified)> {
    let answers = FAMILIES.iter().filter_map(|f| Some((f, (f.identify)(device, devices)?)));
    answers.min_by_key(|(_, answer)| matches!(answer, Identified::Generic(_)))
}

/// The family `name`.
pub fn find(name: &str) -> Option<&'static Family> {
    FAMILIES.iter().find(|f| f.name == name)
}
