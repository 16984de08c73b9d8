//! What is on the USB, from what the kernel says in `/sys` and `/proc` alone: no device is opened and none is disturbed.

pub mod health;
pub mod holder;
#[doc(hidden)]
pub mod made;
mod root;
mod tree;

pub use root::SysRoot;
pub use tree::{PowerControl, UsbDevice, UsbInterface, VideoNode, scan, video_nodes};
