//! The devices on the USB, read from `/sys` and `/proc` alone: no device is opened or disturbed.

#[doc(hidden)]
pub mod fake;
pub mod health;
pub mod holder;
mod root;
mod tree;

pub use root::SysRoot;
pub use tree::{PowerControl, UsbDevice, UsbInterface, VideoNode, scan, video_nodes};
