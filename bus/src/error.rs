//! The error of the bus: a kind to match on, what happened, and to which channel or path.

/// Kind of the error, for callers that match on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// A rig, camera or stream name breaks the rules of [`crate::Name`].
    BadName,
    /// The channel has no publisher.
    NotFound,
    /// Another process holds what can be held once.
    InUse,
    /// The two sides speak different versions of the bus.
    VersionMismatch,
    /// Too little shared memory, or no free slot in it.
    NoSpace,
    /// This user may not open the rig's files.
    PermissionDenied,
    /// A limit of the channel was reached (subscribers, held samples, sample size).
    LimitReached,
    /// Values, a time or a description break a rule of signals.
    Invalid,
    /// A signal's publisher was followed by one with other fields.
    Changed,
    /// Two samples of a signal are further apart than the caller allows.
    Gap,
    /// A time is not between two samples of a signal.
    Outside,
    /// The other side refuses, and says why.
    Refused,
    /// The operating system or iceoryx2 refused for another reason.
    Other,
}

/// Defines a crate's `Error` and `Result` for its `ErrorKind`.
///
/// Every crate of depthrig has an error of this form, and a type of its own, so that conversions between them are
/// explicit where one layer calls another.
#[doc(hidden)]
#[macro_export]
macro_rules! error_type {
    ($(#[$doc:meta])*) => {
        $(#[$doc])*
        #[derive(Debug, Clone)]
        pub struct Error {
            kind: ErrorKind,
            message: String,
            source: Option<std::sync::Arc<dyn std::error::Error + Send + Sync>>,
        }

        /// The result of a call of this crate.
        pub type Result<T, E = Error> = core::result::Result<T, E>;

        impl Error {
            /// An error of `kind` whose message says what happened, to what, and what to do.
            pub fn new(kind: ErrorKind, message: impl Into<String>) -> Self {
                Self { kind, message: message.into(), source: None }
            }

            /// The same error with the error that caused it.
            pub fn with_source(mut self, source: impl std::error::Error + Send + Sync + 'static) -> Self {
                self.source = Some(std::sync::Arc::new(source));
                self
            }

            /// Kind of the error, for callers that match on it.
            pub const fn kind(&self) -> ErrorKind {
                self.kind
            }
        }

        impl core::fmt::Display for Error {
            fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
                f.write_str(&self.message)
            }
        }

        impl std::error::Error for Error {
            fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
                self.source.as_deref().map(|s| s as _)
            }
        }
    };
}

error_type! {
    /// An error of the bus.
}
