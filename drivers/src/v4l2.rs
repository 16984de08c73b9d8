//! Cameras at the kernel's video nodes (V4L2).
//!
//! **What is the crate `v4l`'s and what is ours.** `v4l` opens nodes, lists sizes and frame intervals, sets the
//! interval, and gives the kernel's structures and request numbers. The rest is a small layer of our own
//! (`v4l2/ioctl.rs`), because in `v4l` 0.14 the stream panics when a camera fails to stop, holds one buffer at a time,
//! and cannot set the format of a metadata node; listing controls, formats and capabilities panics on names that are
//! not UTF-8 and on types newer than itself; and there are no requests to extension units.

pub mod controls;
mod error;
mod fourcc;
mod ioctl;
mod metadata;
mod node;
mod queue;
mod source;

pub use controls::{Control, ControlKind, ControlValue};
pub use fourcc::FourCc;
pub use metadata::{MetadataFormat, payload_header};
pub use node::{Capability, Interval, Layout, Mode, Node};
pub use source::{DEFAULT_BUFFERS, Source, Stamp, Wanted};
