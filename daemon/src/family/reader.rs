//! The `[[camera]]` table that a family reads its keys from.

use crate::config::read::Section;
use crate::config::stereo::StereoConfig;
use crate::config::wanted::WantedStream;
use depthrig_bus::Pose;
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;
use std::path::Path;

/// A `[[camera]]` table, with the values of the keys that all families share.
pub struct Reader<'c> {
    /// The table.
    pub(crate) section: &'c Section<'c, 'c>,
    /// Folder that relative paths are taken from.
    pub(crate) base: &'c Path,
    /// The camera's name; empty when it is missing.
    pub(crate) name: &'c str,
    /// Pose of the camera on the mount.
    pub(crate) pose: Pose,
    /// The streams that it is asked for.
    pub(crate) streams: &'c [WantedStream],
    /// `[camera.stereo]`, if it is there and the family may have it.
    pub(crate) stereo: Option<&'c StereoConfig>,
}

impl Reader<'_> {
    /// Reports streams that the camera is asked for and does not have; `what` reads as in "a Kinect".
    pub(crate) fn check_streams(&self, what: &str, own: &[&str]) {
        for wanted in self.streams {
            let name = wanted.request.stream.as_str();
            if !own.contains(&name) {
                let why = format!("{what} has no stream \"{name}\"; it has: {}", own.join(", "));
                self.section.problem(wanted.at, why);
            }
        }
    }

    /// Reports controls of colour for a camera that is not asked for colour.
    pub(crate) fn check_color_controls(&self, controls: &BTreeMap<String, ControlValue>) {
        let asks_color =
            self.streams.is_empty() || self.streams.iter().any(|w| w.request.stream.as_str() == "color");
        if !controls.is_empty() && !asks_color {
            let s = self.section;
            let why = "is set, but color is not among the streams of its [[camera.stream]] tables";
            s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
        }
    }
}
