//! Cameras that another process serves over the bus: docs/external.md.
//!
//! The process is never believed: its offer is checked field by field, each frame against its mode, and its liveness
//! by its heart-beat and by a lock that the kernel frees with it. Nothing here waits for it without a limit. What it
//! sends is copied once, into the slot that subscribers read.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod backend;
pub(crate) mod device;
pub(crate) mod facts;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
mod intake;
mod log;
pub mod process;
mod rate_limiter;
mod stream;

pub use backend::ExternalBackend;
pub use depthrig_bus::external::{Place, served};

use core::time::Duration;
use depthrig_bus::external::{Beat, CAMERA_VARIABLE, ExternalReason, RIG_VARIABLE};
use depthrig_bus::runtime::RUNTIME_DIR_VARIABLE;
use process::{Owner, Program};
use std::path::PathBuf;

/// The backend's name in a rig file.
pub const NAME: &str = "external";

/// How a camera is served.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExternalConfig {
    /// Program to start, with its arguments; empty when somebody else starts it.
    pub command: Vec<String>,
    /// Where it runs.
    pub directory: PathBuf,
    /// How long it may take from being wanted to the first frame.
    pub start_timeout: Duration,
    /// Silence after which it is taken for hung.
    pub heartbeat_timeout: Duration,
}

impl Default for ExternalConfig {
    fn default() -> Self {
        Self {
            command: Vec::new(),
            directory: PathBuf::from("."),
            start_timeout: Duration::from_secs(10),
            heartbeat_timeout: Duration::from_secs(2),
        }
    }
}

impl ExternalConfig {
    /// The program that serves the camera at `place`.
    fn program(&self, place: &Place) -> Program {
        Program {
            owner: Owner::Camera(place.camera.to_string()),
            command: self.command.clone(),
            directory: self.directory.clone(),
            environment: vec![
                (RUNTIME_DIR_VARIABLE, place.runtime.path().into()),
                (RIG_VARIABLE, place.rig.as_str().into()),
                (CAMERA_VARIABLE, place.camera.as_str().into()),
            ],
        }
    }
}

/// Maps a reason that the process gives to an error kind for the supervisor.
const fn kind_of(reason: ExternalReason) -> depthrig_driver::ErrorKind {
    use depthrig_driver::ErrorKind;
    match reason {
        ExternalReason::Version | ExternalReason::Unsupported => ErrorKind::Unsupported,
        ExternalReason::Invalid => ErrorKind::BadInput,
        ExternalReason::NotFound => ErrorKind::NotFound,
        ExternalReason::Busy => ErrorKind::Busy,
        ExternalReason::Permission => ErrorKind::PermissionDenied,
        ExternalReason::Device => ErrorKind::Io,
        _ => ErrorKind::Disconnected,
    }
}

/// Describes the refusal of a process, for a message.
fn refusal(beat: &Beat) -> String {
    let text = beat.text();
    let reason = beat.reason.name();
    if text.is_empty() {
        return format!("its process {} refuses ({reason})", beat.pid);
    }
    format!("its process {} says ({reason}): {text}", beat.pid)
}

/// An error of the bus as one of a driver.
fn of_bus(e: depthrig_bus::Error) -> depthrig_driver::Error {
    use depthrig_bus::ErrorKind as Bus;
    let kind = match e.kind() {
        Bus::NotFound => depthrig_driver::ErrorKind::NotFound,
        Bus::InUse => depthrig_driver::ErrorKind::Busy,
        Bus::PermissionDenied => depthrig_driver::ErrorKind::PermissionDenied,
        Bus::VersionMismatch => depthrig_driver::ErrorKind::Protocol,
        _ => depthrig_driver::ErrorKind::Io,
    };
    depthrig_driver::Error::new(kind, e.to_string()).with_source(e)
}
