//! Shared by cameras on the USB: the devices on it, read from `/sys` and `/proc` alone (no device is opened or
//! disturbed), the USB Video Class ([`uvc`]), image controls ([`controls`]), and raw images as a transport gives them
//! ([`video`]).
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

#[cfg(any(test, feature = "testing"))]
pub mod fake;
pub mod health;
pub mod holder;
mod root;
mod tree;
pub mod uvc;
pub mod video;

pub use depthrig_driver::controls;
pub use root::SysRoot;
pub use tree::{PowerControl, UsbDevice, UsbInterface, VideoNode, scan, video_nodes};
