//! The error of the crate: a kind to match on, and what happened to what.

use core::fmt;
use std::sync::Arc;

/// What went wrong, for callers that decide on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// A camera has no calibration.
    NoCalibration,
    /// A picture has another size than the one that was agreed on.
    SizeMismatch,
    /// Numbers that cannot be those of a camera, a pose or a picture.
    BadInput,
    /// A file could not be written.
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

/// Refuses a slice that is not of the agreed length.
pub(crate) fn check_len(
    what: &str,
    have: usize,
    (width, height): (usize, usize),
    per_pixel: usize,
) -> Result<()> {
    let want = width * height * per_pixel;
    if have == want {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::SizeMismatch,
        format!(
            "{what} has {have} elements where {width}x{height} pixels have {want}; give it the size that was agreed on"
        ),
    ))
}
