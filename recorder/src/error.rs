//! The error of the recorder: a kind to match on, what happened to which file, and what to do about it.

use std::io;
use std::path::Path;

/// The kind of an error, for callers that decide on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum ErrorKind {
    /// The folder already holds a dataset or other files.
    AlreadyExists,
    /// The path does not exist.
    NotFound,
    /// The path is not a depthrig dataset.
    NotADataset,
    /// An MCAP file that depthrig did not write.
    Foreign,
    /// The file ends in the middle: it was cut, or its writer was killed.
    Truncated,
    /// The file to import is not a recording of the requested format, or is damaged beyond use.
    BadRecording,
    /// A checksum or an index does not agree with the data.
    Corrupt,
    /// The dataset was written by a later version.
    Version,
    /// The disk is full.
    DiskFull,
    /// This user may not read or write the path, or its file system is read-only.
    PermissionDenied,
    /// The dataset is being recorded or recovered right now.
    InUse,
    /// The caller asked to end before it was done.
    Interrupted,
    /// The caller's input cannot be recorded as it is.
    BadInput,
    /// The caller ended the work before it was done.
    Cancelled,
    /// Pixels could not be encoded or decoded.
    Codec,
    /// The operating system refused for another reason.
    Io,
}

/// The error of Linux when the device itself fails, such as at an unreadable sector (`errno(3)`).
const EIO: i32 = 5;
const DISK_FAILS: &str = ": the disk fails there (input/output error); copy what it still gives with `ddrescue` and go on with the copy";

depthrig_bus::error_type! {
    /// An error of the recorder.
}

impl Error {
    /// Whether it means a damaged file, rather than one that cannot be read.
    pub(crate) fn is_damage(&self) -> bool {
        use ErrorKind::{Corrupt, Foreign, NotADataset, Truncated, Version};
        matches!(self.kind(), Corrupt | Truncated | Version | NotADataset | Foreign)
    }

    /// A failed operation that reads `path`; `what` reads as in "cannot {what} {path}".
    pub fn reading(what: &str, path: &Path, e: io::Error) -> Self {
        if e.kind() != io::ErrorKind::PermissionDenied {
            return Self::io(what, path, e);
        }
        let path = path.display();
        let message = format!(
            "cannot {what} {path}: permission denied; this user may not read it, its owner changes that with: chmod -R \
             a+rX {path}"
        );
        Self::new(ErrorKind::PermissionDenied, message).with_source(e)
    }

    /// A failed operation that changes `path`, or needs to; `what` reads as in "cannot {what} {path}".
    pub fn io(what: &str, path: &Path, e: io::Error) -> Self {
        let (kind, advice) = match e.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                (ErrorKind::DiskFull, ": the disk is full; free some space or record to another disk")
            }
            io::ErrorKind::FileTooLarge => (
                ErrorKind::DiskFull,
                ": a file may not be so large here; raise the limit (ulimit -f) or use another disk",
            ),
            io::ErrorKind::PermissionDenied => {
                (ErrorKind::PermissionDenied, ": permission denied; choose a folder that this user may write")
            }
            io::ErrorKind::ReadOnlyFilesystem => {
                (ErrorKind::PermissionDenied, ": the file system is read-only; choose another folder")
            }
            io::ErrorKind::NotFound => (ErrorKind::NotFound, ": it does not exist"),
            io::ErrorKind::AlreadyExists => (ErrorKind::AlreadyExists, ": it exists already"),
            io::ErrorKind::UnexpectedEof => (ErrorKind::Truncated, ": it ends too early"),
            _ => (ErrorKind::Io, ""),
        };
        let advice = if e.raw_os_error() == Some(EIO) { DISK_FAILS } else { advice };
        let detail = if advice.is_empty() { format!(": {e}") } else { advice.to_owned() };
        Self::new(kind, format!("cannot {what} {}{detail}", path.display())).with_source(e)
    }
}
