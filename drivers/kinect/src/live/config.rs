//! The configuration of an attached Kinect in a rig.

use super::library::Places;
use crate::modes::{DepthMode, WiredSync};
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;

/// An attached Kinect and how it is to be set. What is `None` stays as the camera has it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LiveConfig {
    /// Serial number; `None`: the one at `port`, or the only one.
    pub serial: Option<String>,
    /// Port path of the depth camera's half on the bus, such as `2-1.1`.
    pub port: Option<String>,
    /// Where libk4a and the depth engine are.
    pub places: Places,
    /// The mode of the depth camera; `None`: the one whose images have the size that is asked for.
    pub depth_mode: Option<DepthMode>,
    /// Part among Kinects that are wired together.
    pub sync: WiredSync,
    /// Colour after the master's pulse, microseconds; of a subordinate alone.
    pub subordinate_delay_us: u32,
    /// Depth after colour, microseconds; negative: before.
    pub depth_delay_us: i32,
    /// Colour controls by name: `exposure_us`, `gain`, …
    pub color_controls: BTreeMap<String, ControlValue>,
    /// Keep the light on the front dark while it streams.
    pub dark: bool,
}
