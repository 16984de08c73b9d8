//! The error of a driver: a kind that the supervisor acts on, what happened, and to which device.

use core::fmt;

/// What went wrong, as the supervisor needs to know it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// No such device, file or folder.
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

/// An error of a driver.
#[derive(Debug)]
pub struct Error {
    kind: ErrorKind,
    message: String,
    source: Option<Box<dyn std::error::Error + Send + Sync>>,
}

/// The result of a driver call.
pub type Result<T, E = Error> = core::result::Result<T, E>;

impl Error {
    /// An error of `kind` whose message says what happened, to which device or file, and what to do.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into(), source: None }
    }

    /// The same error with the error that caused it.
    pub fn with_source(mut self, source: impl std::error::Error + Send + Sync + 'static) -> Self {
        self.source = Some(Box::new(source));
        self
    }

    /// What went wrong, as the supervisor needs to know it.
    pub const fn kind(&self) -> ErrorKind {
        self.kind
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.source.as_deref().map(|s| s as _)
    }
}
