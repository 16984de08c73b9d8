//! The codes by which a camera refuses a request.

use super::Request;
use core::fmt;
use depthrig_driver::{Error, ErrorKind};

/// A negative answer of the hardware monitor (librealsense `src/hw-monitor.h`, `hwmon_response`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Code(pub i32);

impl Code {
    /// The camera does not know the opcode.
    pub const WRONG_COMMAND: Self = Self(-1);
    /// A parameter is out of range.
    pub const WRONG_PARAMETER: Self = Self(-6);
    /// The camera cannot answer yet.
    pub const NOT_READY: Self = Self(-7);
    /// There is nothing to return.
    pub const NO_DATA: Self = Self(-21);
    /// The table was never written.
    pub const TABLE_IS_EMPTY: Self = Self(-25);
    /// The table is locked.
    pub const TABLE_IS_LOCKED: Self = Self(-27);
    /// The camera waited in vain for one of its parts.
    pub const TIMEOUT: Self = Self(-32);
    /// This model cannot do it.
    pub const NOT_SUPPORTED: Self = Self(-58);

    /// Its meaning; `None` for an unknown number.
    pub const fn text(self) -> Option<&'static str> {
        Some(match self {
            Self::WRONG_COMMAND => "it does not know this request",
            Self::WRONG_PARAMETER => "a parameter is wrong",
            Self::NOT_READY => "its hardware is not ready",
            Self::NO_DATA => "it has no data to return",
            Self::TABLE_IS_EMPTY => "the table is empty",
            Self::TABLE_IS_LOCKED => "the table is locked",
            Self::TIMEOUT => "one of its parts did not answer in time",
            Self::NOT_SUPPORTED => "this model or firmware does not support it",
            _ => return None,
        })
    }

    /// The kind of error that it is for a supervisor.
    pub const fn kind(self) -> ErrorKind {
        match self {
            Self::WRONG_COMMAND | Self::NOT_SUPPORTED => ErrorKind::Unsupported,
            Self::NOT_READY | Self::TIMEOUT => ErrorKind::Busy,
            Self::NO_DATA | Self::TABLE_IS_EMPTY => ErrorKind::NotFound,
            _ => ErrorKind::Protocol,
        }
    }

    /// The error of a request that was refused with this code.
    pub(super) fn into_error(self, request: &Request) -> Error {
        Error::new(self.kind(), format!("the camera refused {request}: {self}"))
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.text() {
            Some(text) => write!(f, "{text} (code {})", self.0),
            None => write!(f, "code {}", self.0),
        }
    }
}
