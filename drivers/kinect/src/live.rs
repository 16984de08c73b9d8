//! A Kinect that is attached, through Microsoft's own library, which is loaded when the first one is opened.
//!
//! **Why a library.** A Kinect sends the raw phases of its depth sensor. What turns them into depth, the depth engine,
//! is closed, runs on the graphics card, and has no open stand-in. It comes with `libk4a` 1.4 ([`CURE`] says from
//! where). Nothing of it is needed to build or to run without a Kinect.
//!
//! **Streams.** `color`, `depth` (Z16, millimetres) and `ir` (16-bit grey), all at one rate; what each is asked for
//! chooses the mode. Every image is written once: copied or decoded out of libk4a's memory into the receiver's.
//!
//! **Time.** Each image has the device's clock at mid-exposure, microseconds, and `CLOCK_MONOTONIC` at the end of its
//! transfer. The device has no frame counter: numbers are derived from its times.
//!
//! **Threads.** All calls are made by the camera's own thread. libk4a has threads of its own, so that the library is
//! never unloaded; one that hangs takes the camera's thread with it, which [`depthrig_driver::capture::Capture`] then gives up.

mod backend;
mod config;
mod controls;
pub(super) mod counter;
mod ffi;
pub mod find;
mod handle;
mod journal;
mod library;
mod profiles;
mod stream;

pub use backend::LiveBackend;
pub use config::LiveConfig;
pub use controls::NAMES as CONTROLS;
pub use library::{CURE, ENGINE, Places, VARIABLE, find as find_library, load_engine};
pub use profiles::{STREAMS, wire_bits_per_s};

use depthrig_driver::Result;
use std::path::PathBuf;

/// Loads libk4a and, unless colour is all that is wanted, the depth engine, as a camera would; says which files they
/// are.
///
/// # Errors
/// [`depthrig_driver::ErrorKind::BadInput`] with what to install.
pub fn check_libraries(places: &Places, with_depth: bool) -> Result<(PathBuf, Option<PathBuf>)> {
    let library = library::load(places)?;
    let engine = if with_depth { load_engine(places, &library.path)? } else { None };
    Ok((library.path.clone(), engine))
}
