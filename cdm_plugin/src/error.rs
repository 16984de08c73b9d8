//! The error of the crate: a kind to match on, and what happened to what.

/// Kind of an error, for callers that react to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// Two images that belong together have different sizes.
    SizeMismatch,
    /// A setting or an image cannot be used as it is.
    BadInput,
    /// A model, a file or a library is not where it should be.
    NotFound,
    /// A checkpoint is damaged, or is not of the network that it should be.
    BadModel,
    /// This engine, library or build does not support the request.
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

depthrig_bus::error_type! {
    /// An error of a depth model, its engine or its files.
}
