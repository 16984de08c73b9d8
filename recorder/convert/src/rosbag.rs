//! rosbag v2 files that librealsense recorded (`rs-record`, the viewer, `rs2::recorder`), as datasets.
//!
//! The reader is our own, because a recording that was cut is worth importing: the crate `rosbag` (0.6) needs the index
//! that is written last, maps the file, and unpacks a chunk to whatever size it claims. Here a bag is read from front to
//! back without its index, twice: once for what it holds, once for the images.

mod bag;
mod import;
mod messages;
mod sets;

pub use import::RosbagImport;

/// The name of the layout.
pub const FORMAT: &str = "rosbag";

/// Entry points of the fuzz targets.
#[cfg(any(test, feature = "testing"))]
pub(crate) mod fuzzing {
    pub(crate) use super::import::fuzz;
}
