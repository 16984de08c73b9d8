//! Progress of a recording, and its summary.

use super::DiskStatus;
use crate::msgs::SetCounts;
use crate::{EpisodeCounts, Error, Result};
use std::path::PathBuf;
use std::sync::Arc;

/// Progress of a recording.
#[derive(Debug, Clone, serde::Serialize)]
#[non_exhaustive]
pub struct Progress {
    /// Sets offered, recorded and dropped by reason; the difference is not settled yet.
    pub sets: SetCounts,
    /// Frames written.
    pub frames: u64,
    /// Bytes written.
    pub bytes: u64,
    /// Segments begun.
    pub segments: u32,
    /// Sets that wait to be encoded.
    pub encode_queue: usize,
    /// Encoded bytes that wait to be written.
    pub backlog_bytes: u64,
    /// Time from the first set to the last, nanoseconds.
    pub duration_ns: i64,
    /// State of the disk.
    pub disk: DiskStatus,
    /// Episodes so far.
    pub episodes: EpisodeCounts,
    /// Why the recording ended before its time, if it did.
    #[serde(serialize_with = "as_text")]
    pub error: Option<Arc<Error>>,
}

#[allow(clippy::ref_option)] // the signature that serde asks for
fn as_text<S: serde::Serializer>(e: &Option<Arc<Error>>, s: S) -> Result<S::Ok, S::Error> {
    match e {
        Some(e) => s.serialize_some(&e.to_string()),
        None => s.serialize_none(),
    }
}

/// Summary of a finished recording.
#[derive(Debug, Clone, serde::Serialize)]
#[non_exhaustive]
pub struct Summary {
    /// The dataset's folder.
    pub path: PathBuf,
    /// Sets offered, recorded and dropped by reason.
    pub sets: SetCounts,
    /// Frames in the dataset.
    pub frames: u64,
    /// Bytes of its segments.
    pub bytes: u64,
    /// Its segments.
    pub segments: u32,
    /// Time from the first set to the last, nanoseconds.
    pub duration_ns: i64,
    /// Whether every set handed over is there and every segment is complete.
    pub complete: bool,
    /// Losses in words; empty when `complete`.
    pub lost: Vec<String>,
}
