//! The streams that a rig file asks a camera for.

use depthrig_drivers::StreamRequest;

/// A `[[camera.stream]]` and where it stands.
pub(super) struct WantedStream {
    pub(super) request: StreamRequest,
    pub(super) at: usize,
}
