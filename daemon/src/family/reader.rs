//! The `[[camera]]` table that a family reads its keys from.

use crate::config::read::Section;
use crate::config::stereo::StereoConfig;
use crate::config::wanted::WantedStream;
use depthrig_bus::Pose;
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
