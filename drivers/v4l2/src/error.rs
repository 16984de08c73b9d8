//! From the errors of system calls on a video node to what the supervisor acts on and the user reads.

use depthrig_driver::{Error, ErrorKind};
use rustix::io::Errno;
use std::io;
use std::path::Path;

/// The error of doing `what` on the node at `path`.
pub(super) fn node_error(path: &Path, what: &str, e: io::Error) -> Error {
    let errno = e.raw_os_error().map(Errno::from_raw_os_error);
    let (kind, cure) = match errno {
        Some(Errno::NOENT) => (ErrorKind::NotFound, "is the camera plugged in?"),
        Some(Errno::ACCESS | Errno::PERM) => (ErrorKind::PermissionDenied, depthrig_usb::health::RULE_CURE),
        Some(Errno::BUSY) => (ErrorKind::Busy, "another process streams from it; end that process"),
        Some(Errno::NODEV | Errno::NXIO) => (ErrorKind::Disconnected, "the camera was unplugged"),
        Some(Errno::NOTTY | Errno::OPNOTSUPP) => (ErrorKind::Unsupported, "its driver cannot do that"),
        Some(Errno::NOSPC) => (
            ErrorKind::Io,
            "the USB bus has no bandwidth left for it; use a smaller mode or another USB controller",
        ),
        Some(Errno::NOMEM) => (ErrorKind::Io, "the kernel has no memory for its buffers"),
        Some(Errno::PIPE | Errno::PROTO) => (ErrorKind::Protocol, "the camera refused"),
        Some(Errno::TIMEDOUT) => (ErrorKind::Stalled, "the camera did not answer"),
        _ => (ErrorKind::Io, "open it again, and plug it in anew if that does not help"),
    };
    Error::new(kind, format!("{}: {what}: {e}; {cure}", path.display())).with_source(e)
}

/// Whether the device behind the node is gone.
pub(super) fn is_gone(e: &io::Error) -> bool {
    matches!(e.raw_os_error().map(Errno::from_raw_os_error), Some(Errno::NODEV | Errno::NXIO))
}
