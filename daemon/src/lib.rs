//! The daemon: one process that owns every camera of a rig.
//!
//! Layer 4. Rig configuration, supervision, set assembly, recording control, replay and the control API. It
//! contains no device protocol and no codec; those are in the layers below.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod api;
pub mod attached;
mod camera;
pub mod client;
pub mod config;
pub mod control;
pub mod doctor;
mod error;
pub mod family;
mod foxglove;
pub mod hosts;
mod housekeeping;
pub mod joining;
mod link;
mod losses;
pub mod metrics;
mod mirror;
mod priority;
mod recording;
pub mod replay;
pub mod rig;
mod ros2;
pub mod sets;
mod showing;
mod sink;
pub mod stage;
pub mod status;
mod stream;
mod viewers;
mod wake;

pub use error::{Error, ErrorKind, Result};
pub use showing::Showing;
