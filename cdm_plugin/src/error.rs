//! The error of the crate: a kind to match on, and what happened to what.

use core::fmt;
use std::sync::Arc;

/// What went wrong, for callers that decide on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// Two pictures that belong together have different sizes.
    SizeMismatch,
    /// A setting or a picture cannot be used as it is.
    BadInput,
    /// A model, a file or a library is not where it should be.
    NotFound,
    /// A checkpoint is damaged, or is not of the network that it should be.
    BadModel,
    /// What was asked for exists, but not in this engine, library or build.
    Unsupported,
    /// The engine's library is missing, or is of a version that cannot be used.
    NoEngine,
    /// The device has too little memory.
    OutOfMemory,
    /// The engine failed while it ran.
    Engine,
    /// Something could not be fetched.
    Network,
    /// A file could not be read or written.
    Io,
}

/// An error of this crate.
#[derive(Debug, Clone)]
pub struct Error {
    kind: ErrorKind,
    message: String,
    source: Option<Arc<dyn std::error::Error + Send + Sync>>,
}

/// The result of a call into this crate.
pub type Result<T, E = Error> = core::result::Result<T, E>;

impl Error {
    /// An error of `kind` whose message says what happened, to what, and what to do.
    pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
        Self { kind, message: message.into(), source: None }
    }

    /// The same with what caused it.
    pub fn with_source(self, source: impl std::error::Error + Send + Sync + 'static) -> Self {
        Self { source: Some(Arc::new(source)), ..self }
    }

    /// What went wrong, for callers that decide on it.
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
        self.source.as_ref().map(|s| &**s as &(dyn std::error::Error + 'static))
    }
}
