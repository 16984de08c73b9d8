//! What can be asked of a running rig, whoever asks: the HTTP API, the command line in process, or a test.

use crate::Result;
use crate::status::{RecordingStatus, RigStatus};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// A running rig, as its control sees it. Every call returns quickly; `record_stop` may take as long as the
/// disk needs to take what is still queued.
pub trait Control: Send + Sync {
    /// Everything there is to know about the rig now.
    fn status(&self) -> RigStatus;

    /// The rig's configuration as TOML text.
    fn config_text(&self) -> String;

    /// Starts a recording.
    ///
    /// # Errors
    /// `InUse` when one is going on, `BadInput` for a name that exists, `NoSpace`, `PermissionDenied`.
    fn record_start(&self, request: &RecordRequest) -> Result<RecordingStatus>;

    /// Ends the recording and closes its files.
    ///
    /// # Errors
    /// `WrongState` when none is going on.
    fn record_stop(&self) -> Result<RecordingStatus>;

    /// Adds a timed note to the recording.
    ///
    /// # Errors
    /// `WrongState` when none is going on, `BadInput` for an empty note.
    fn record_note(&self, text: &str) -> Result<()>;

    /// Asks the daemon to end.
    fn request_stop(&self);
}

/// What a recording is to be.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecordRequest {
    /// Folder that the dataset's folder is made in; the rig's default when `None`.
    pub directory: Option<PathBuf>,
    /// Name of the dataset; `YYYYMMDD_HHMM_<scene>` when `None`.
    pub name: Option<String>,
    /// Scene label.
    pub scene: String,
    /// Who records.
    pub operator: String,
    /// Free notes.
    pub notes: String,
}
