//! The control API: HTTP/JSON on the rig's Unix socket and, when configured, on a loopback port.
//!
//! `api/openapi.json` describes it, and a test holds the two together. The server lives in one thread of its own
//! with a single-threaded runtime, so the rest of the daemon knows nothing of async; calls of [`Control`] run on a
//! few extra threads, so a recording that takes long to close does not make `status` wait.
//!
//! **Who may call.** The socket has mode 0600 in a folder of mode 0700: the user that runs the rig. A port must be
//! loopback and is open to every user of the computer, so its requests carry a token that only that user can read (file
//! `RIG.token` beside the socket); `/metrics` and the files of the live page need none, and the
//! page's WebSocket has it in its first message, viewers with Foxglove's protocol, which have a port of their own, in the path of their address. Web pages in that user's browser are kept out by three rules: the `Host` must be a loopback name (against
//! DNS rebinding), an `Origin` must be this server's (against WebSockets from other pages), and a POST must be `application/json`, which a page
//! of another origin may not send without asking first, and nobody answers that question (against CSRF).
//!
//! **Who may wait.** Socket and port have places of their own, so that nobody on the port can keep the socket from being
//! answered; heads, bodies and answers have time limits, bodies a size limit.

mod allowed;
mod events;
mod files;
mod foxglove;
mod frames;
mod guard;
mod limits;
mod live;
mod page;
mod recordings;
mod reply;
mod requests;
mod routes;
mod serve;
mod socket;
mod token;

pub use events::{CaptureEvent, MAX_FOLLOWERS};
pub use files::{
    BytesRequest, FileDigest, FileRequest, MAX_PART_BYTES, RecordingFile, RecordingFiles, digest_of,
    is_served,
};
pub use page::PageAddress;
pub use recordings::{MarkRequest, NameRequest, Recording, Recordings, ReportPage};
pub(crate) use reply::{ErrorBody, kind_of_name};
pub use requests::{CameraRequest, FingerprintRequest, LoopRequest, NoteRequest, RateRequest, StepRequest};
pub use routes::{Health, HealthReason, OPENAPI, ROUTES, Route};
pub use serve::ServerHandle;

use crate::Result;
use crate::config::ControlConfig;
use crate::control::Control;
use depthrig_bus::{RigName, RuntimeDir};
use std::sync::Arc;

/// The largest request body, bytes; notes are the longest thing anybody sends.
pub const MAX_BODY_BYTES: usize = 64 << 10;
/// The most connections at once, of the socket and of the port each; more wait until one ends.
pub const MAX_CONNECTIONS: usize = 64;
/// The header of every answer that names the server: `depthrig/0.1.0`.
pub const SERVER_HEADER: &str = "server";

/// Serves `control`, and the images of its rig, on the rig's Unix socket below `runtime` and on loopback ports.
///
/// The caller holds the rig's lock: only then is a socket file that is already there the rest of a process that
/// died, and removed. It returns when both accept connections; dropping the handle ends the service.
///
/// # Errors
/// `InUse` when something answers on the socket or the port is taken, `BadInput` for an address that is not
/// loopback, `PermissionDenied`, `Other`.
pub fn serve(
    control: Arc<dyn Control>,
    runtime: &RuntimeDir,
    rig: &RigName,
    ports: ControlConfig,
) -> Result<ServerHandle> {
    ServerHandle::start(control, runtime, rig, ports)
}
