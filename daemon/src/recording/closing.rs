//! The end of a recording: its last sets are written while others need not wait for the disk.

use super::{Active, Recording};
use crate::Result;
use crate::status::RecordingStatus;
use depthrig_bus::sync::lock;
use depthrig_recorder::Summary;
use std::sync::Mutex;

/// A recording that takes no more sets and is being closed.
pub struct Finishing {
    pub(super) active: Active,
}

impl Finishing {
    /// Waits until everything is on disk.
    ///
    /// # Errors
    /// `Other` when the dataset could not be closed; the status is as complete as possible all the same.
    pub fn finish(mut self) -> (RecordingStatus, Result<Summary>) {
        self.active.refresh();
        let mut status = self.active.status;
        status.active = false;
        (status.encode_queue, status.backlog_bytes) = (0, 0);
        match self.active.recorder.finish() {
            Ok(summary) => {
                status.sets = summary.sets.recorded;
                status.dropped =
                    summary.sets.dropped_by_reason().map(|(r, n)| (r.name().to_owned(), n)).collect();
                status.frames = summary.frames;
                status.bytes = summary.bytes;
                status.segments = u64::from(summary.segments);
                status.duration_s = summary.duration_ns as f64 * 1e-9;
                if summary.complete {
                    tracing::info!(path = status.path, sets = status.sets, bytes = status.bytes, "recorded");
                } else {
                    let lost = summary.lost.join("; ");
                    tracing::error!(path = status.path, "the recording lost something: {lost}");
                    status.error = Some(lost);
                }
                (status, Ok(summary))
            }
            Err(e) => {
                status.error = Some(e.to_string());
                tracing::error!(path = status.path, error = %e, "the recording could not be closed");
                (status, Err(e.into()))
            }
        }
    }
}

/// Ends the recording and closes its files. Other users of `recording` need not wait for the disk.
///
/// # Errors
/// `WrongState` when none is going on, `Other` when the dataset could not be closed.
pub fn stop(recording: &Mutex<Recording>) -> Result<RecordingStatus> {
    let finishing = lock(recording).take()?;
    finish(recording, finishing)
}

/// Whether the recording has lasted as long as it was to: to be asked often.
pub fn is_due(recording: &Mutex<Recording>) -> bool {
    lock(recording).is_due()
}

/// Ends the recording, as [`stop`] does, if it has lasted as long as it was to. `None`: it is not
/// over yet, or none is going on. The moment it ends is that of its start and its length, however late the call comes.
pub fn stop_when_due(recording: &Mutex<Recording>) -> Option<Result<RecordingStatus>> {
    let mut idle = lock(recording);
    let finishing = if idle.is_due() { idle.take().ok()? } else { return None };
    drop(idle);
    tracing::info!(path = finishing.active.status.path, "the recording has lasted as long as it was to");
    Some(finish(recording, finishing))
}

fn finish(recording: &Mutex<Recording>, finishing: Finishing) -> Result<RecordingStatus> {
    let (status, result) = finishing.finish();
    let mut recording = lock(recording);
    // Another one may have begun while this one was being closed; its numbers are not these.
    if !recording.is_active() {
        recording.keep(status.clone(), result.as_ref().ok().cloned());
    }
    result.map(|_| status)
}
