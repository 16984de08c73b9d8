//! The `l515` backend: the RealSense L515, a camera that scans with a laser, through the kernel's video driver.
//!
//! It is not a D400: depth and infrared come turned, its tables are its own, and only the kernel reaches it here. What
//! is the same is shared with the D400: transport, account of the metadata, control thread, streams. It is out of
//! production and its firmware is frozen. Source: librealsense v2.54, `src/l500` (Apache-2.0).

mod backend;
mod device;
mod profiles;

pub use backend::L515Backend;

use super::models::Model;
use super::protocol::firmware::Firmware;
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;

/// Name of the backend in rig files.
pub const NAME: &str = "l515";
/// Name of the family, for messages.
const FAMILY: &str = "RealSense L515";

/// An L515 and how it is to be set. What is left out stays as the camera has it after power-on.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct L515Config {
    /// Serial number, as printed on the camera; `None`: the one at `port`, or the only one.
    pub serial: Option<String>,
    /// Port path on the bus, such as `4-1.2`.
    pub port: Option<String>,
    /// Controls of depth by the names of [`super::protocol::l515::Control`].
    pub controls: BTreeMap<String, i32>,
    /// Controls of the colour image by their V4L2 names.
    pub color_controls: BTreeMap<String, ControlValue>,
}

const fn model(name: &'static str, product: u16) -> Model {
    Model {
        name,
        product,
        color_module: true,
        depth_unit_m: 0.000_25,
        least_firmware: Firmware([1, 4, 1, 0]),
        depth_size: (640, 480),
        color_size: (1280, 720),
        sync: false,
    }
}

/// The camera as it was sold, and before.
static MODELS: [Model; 2] = [model("L515", 0x0B64), model("L515 (before production)", 0x0B3D)];
