//! The error of a driver: a kind that the supervisor acts on, what happened, and to which device.

/// Kind of an error, as the supervisor needs to know it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The device, file or folder does not exist.
    NotFound,
    /// Somebody else holds the device.
    Busy,
    /// This user may not open it.
    PermissionDenied,
    /// The device went away while in use.
    Disconnected,
    /// The device answers, but sends no frames.
    Stalled,
    /// The device cannot do what was asked of it.
    Unsupported,
    /// A file or a setting is not what it must be.
    BadInput,
    /// The device sent something that its protocol does not allow.
    Protocol,
    /// The operating system refused for another reason.
    Io,
}

impl ErrorKind {
    /// Whether trying again later can help; `Unsupported` and `BadInput` stay what they are.
    pub const fn is_transient(self) -> bool {
        !matches!(self, Self::Unsupported | Self::BadInput)
    }
}

depthrig_bus::error_type! {
    /// An error of a driver.
}
