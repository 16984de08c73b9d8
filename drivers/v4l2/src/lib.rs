//! Cameras at the kernel's video nodes (V4L2).
//!
//! **Division between the crate `v4l` and us.** `v4l` opens nodes, lists sizes and frame intervals, sets the
//! interval, and gives the kernel's structures and request numbers. The rest is a small layer of our own
//! (`v4l2/ioctl.rs`), because in `v4l` 0.14 the stream panics when a camera fails to stop, holds one buffer at a time,
//! and cannot set the format of a metadata node; listing controls, formats and capabilities panics on names that are
//! not UTF-8 and on types newer than itself; and it lacks requests to extension units.
//!
//! **Memory.** An image is copied once, from the kernel's buffer into the slot that subscribers read
//! ([`MemoryChoice::Mmap`]), or not at all by us, when the kernel writes into that slot itself
//! ([`MemoryChoice::UserPointer`]; `uvcvideo` and `vivid` can, drivers whose devices need contiguous memory cannot).
//! [`depthrig_driver::unpack::copied_bytes`] counts.
//!
//! **Time.** Where the camera's metadata node gives payload headers and their clock ticks as it should
//! (`v4l2/tick.rs`), frames are stamped by the device: when it began to capture the image, by USB video's own
//! definition. Else by the kernel: when the first packet of the image came, or the last, as its flags say; and where
//! the kernel's stamp is not of the monotonic clock, when we got the image. A kernel stamp that lies after that is
//! moved back to it and the frame is flagged as uncertain in time: `vivid` stamps 30 ms ahead. Streaming into user
//! memory goes by the kernel's stamps.
//!
//! **Accounts.** A buffer that is flagged as damaged or too short is a counted drop; so is every number that the
//! kernel's counter skips. `uvcvideo` itself throws damaged images away, which shows as such a gap.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

use depthrig_driver::{Backend, Device, DeviceInfo, Result};
use depthrig_usb::SysRoot;
use std::path::PathBuf;

mod config;
mod controls;
mod device;
mod error;
mod find;
mod ioctl;
mod lent;
mod metadata;
mod node;
mod offer;
mod panel;
mod queue;
mod source;
mod stream;
mod tick;

pub use config::{BUFFERS, ClockChoice, GivenIntrinsics, MemoryChoice, MjpegChoice, V4l2Config};
pub use depthrig_usb::uvc::formats::FourCc;
pub use metadata::{MetadataFormat, payload_header};
pub use node::{Capability, Interval, Layout, Mode, Node};
pub use source::{DEFAULT_BUFFERS, Source, Stamp, Wanted};

/// The name of the backend.
const NAME: &str = "v4l2";

/// The backend `v4l2`: any camera at the kernel's video nodes.
#[derive(Debug, Clone)]
pub struct V4l2Backend {
    config: V4l2Config,
    root: SysRoot,
}

impl V4l2Backend {
    /// A backend for the one camera of `config`. Nothing is opened before it is asked for.
    pub fn new(config: V4l2Config) -> Self {
        Self { config, root: SysRoot::default() }
    }

    /// The nodes that the camera's images come from, for tools that look beside the backend. The numbers change
    /// with every plug.
    ///
    /// # Errors
    /// Those of [`Backend::open`].
    pub fn nodes(&self) -> Result<Vec<PathBuf>> {
        let found = find::choose(&find::cameras(&self.root)?, &self.config, None)?;
        Ok(found.open(&self.root)?.iter().map(|pair| pair.video.path().to_owned()).collect())
    }
}

impl Backend for V4l2Backend {
    fn name(&self) -> &'static str {
        NAME
    }

    /// Every camera at a video node that no other backend drives.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let found = find::cameras(&self.root)?;
        Ok(found.into_iter().filter(|f| f.family().is_none()).map(|f| f.info).collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let found = find::choose(&find::cameras(&self.root)?, &self.config, serial)?;
        Ok(Box::new(device::V4l2Device::open(found, self.config.clone(), self.root.clone())?))
    }
}
