//! USB video without the kernel's camera driver: bulk transfers, controls and the vendor's channel through libusb.
//!
//! Invariants:
//! - the memory that libusb was given for a transfer is freed only when the transfer is not pending; memory of a
//!   transfer that does not complete is leaked, together with the open device it belongs to (`transfers.rs`, the only
//!   file with `unsafe`);
//! - every queue is bounded by the number of transfers, which is fixed at the start;
//! - interfaces are given back streaming before control, because the kernel's driver is bound again by the control
//!   interface, and does not bind when it finds a streaming interface still taken.
//!
//! Threads: each open device has one event thread, which runs libusb's event loop and nothing else. It is there rather
//! than an event loop inside of [`ImageSource::poll`](depthrig_usb::video::ImageSource::poll) because control requests
//! must be answered while nobody polls, and because a frame's arrival is then stamped when it arrives and not when the
//! capture thread comes back from the frame before. The capture thread waits for the event thread's word and resubmits
//! transfers itself. Clearing a halted endpoint can take seconds and so has a thread of its own while it lasts.
//!
//! Copies: the kernel copies a transfer from its own buffers into the transfer's when it is reaped, and whoever takes
//! the image copies it once from there into the loan. A frame that a device splits over several payloads is put
//! together in between, and counted ([`Statistics`]).
//!
//! Facts: UVC 1.5 class specification; librealsense `src/uvc` and `src/libusb` (Apache-2.0); libusb 1.0.27 as
//! `libusb1-sys` has it.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod budget;
mod bulk;
mod camera;
mod control;
mod errors;
mod frames;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
mod negotiate;
mod source;
mod stream;
mod transfers;

pub use bulk::BulkChannel;
pub use camera::{Camera, give_to_kernel};
pub use control::Port;
pub use rusb::Error as UsbError;
pub use source::{Settings, Source, Statistics, StreamMode};

/// Memory that the kernel counts against its limit for `transfers` transfers of `bytes` bytes each.
pub const fn transfer_memory(transfers: usize, bytes: usize) -> u64 {
    budget::needed(transfers, bytes)
}
