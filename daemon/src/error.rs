//! The error of the daemon: a kind to match on (exit code, HTTP status), what happened and what to do.

/// Kind of an error, for callers that decide on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// The configuration or a request is invalid.
    BadInput,
    /// The requested item does not exist.
    NotFound,
    /// Somebody else holds it, or it is running already.
    InUse,
    /// The rig is in no state for this (stop without a recording, say).
    WrongState,
    /// Not enough memory or disk.
    NoSpace,
    /// This user may not.
    PermissionDenied,
    /// No daemon answers.
    Unreachable,
    /// Another reason.
    Other,
}

depthrig_bus::error_type! {
    /// An error of the daemon.
}

impl From<depthrig_bus::Error> for Error {
    fn from(e: depthrig_bus::Error) -> Self {
        use depthrig_bus::ErrorKind as Bus;
        let kind = match e.kind() {
            Bus::BadName => ErrorKind::BadInput,
            Bus::NotFound => ErrorKind::NotFound,
            Bus::InUse => ErrorKind::InUse,
            Bus::NoSpace => ErrorKind::NoSpace,
            Bus::PermissionDenied => ErrorKind::PermissionDenied,
            _ => ErrorKind::Other,
        };
        Self::new(kind, e.to_string()).with_source(e)
    }
}

impl From<depthrig_recorder::Error> for Error {
    fn from(e: depthrig_recorder::Error) -> Self {
        use depthrig_recorder::ErrorKind as Rec;
        let kind = match e.kind() {
            Rec::NotFound => ErrorKind::NotFound,
            Rec::PermissionDenied => ErrorKind::PermissionDenied,
            Rec::InUse => ErrorKind::InUse,
            Rec::DiskFull => ErrorKind::NoSpace,
            Rec::AlreadyExists | Rec::BadInput => ErrorKind::BadInput,
            _ => ErrorKind::Other,
        };
        Self::new(kind, e.to_string()).with_source(e)
    }
}

impl From<depthrig_driver::Error> for Error {
    fn from(e: depthrig_driver::Error) -> Self {
        use depthrig_driver::ErrorKind as Driver;
        let kind = match e.kind() {
            Driver::NotFound => ErrorKind::NotFound,
            Driver::Busy => ErrorKind::InUse,
            Driver::PermissionDenied => ErrorKind::PermissionDenied,
            Driver::BadInput | Driver::Unsupported => ErrorKind::BadInput,
            _ => ErrorKind::Other,
        };
        Self::new(kind, e.to_string()).with_source(e)
    }
}
