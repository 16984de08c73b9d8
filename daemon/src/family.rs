//! Camera families: all that the daemon knows of one is in its file here, and one line of [`FAMILIES`] adds it.
//!
//! A family is a type of settings that implements [`CameraSettings`], and a [`Family`] that reads them from a `[[camera]]`
//! table. Its driver is a folder of `depthrig-drivers`, which knows no configuration.

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

pub use reader::Reader;
pub use settings::{AnySettings, BackendConfig, CameraSettings, OpenContext, Preparation, Unmet};
pub use source::{Offered, Selector, Service, Source};

use depthrig_drivers::Backend;
use depthrig_drivers::usb::SysRoot;

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
    pub rig: &'c [BackendConfig],
}

/// The family `name`.
pub fn find(name: &str) -> Option<&'static Family> {
    FAMILIES.iter().find(|f| f.name == name)
}
