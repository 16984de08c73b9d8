//! The daemon: one process that owns every camera of a rig.
//!
//! Floor 4. Rig configuration, supervision, set assembly, recording control, replay and the control API. It
//! contains no device protocol and no codec; those are in the floors below.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod control;
mod error;
pub mod sets;
pub mod status;

pub use error::{Error, ErrorKind, Result};
