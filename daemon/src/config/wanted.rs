//! The streams that a rig file asks a camera for.

use depthrig_driver::StreamRequest;

/// A `[[camera.stream]]` and where it stands.
pub(crate) struct WantedStream {
    pub(crate) request: StreamRequest,
    pub(crate) at: usize,
}
