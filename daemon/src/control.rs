//! Calls on a running rig, from any side: the HTTP API, the command line in process, or a test.

use crate::Result;
use crate::status::{RecordingStatus, ReplayStatus, RigStatus};
use depthrig_bus::UtcPair;
use depthrig_recorder::{RecorderOptions, Session};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// A running rig, as its control sees it. Every call returns quickly; `record_stop` may take as long as the
/// disk needs for the sets that are still queued.
pub trait Control: Send + Sync {
    /// Everything there is to know about the rig now.
    fn status(&self) -> RigStatus;

    /// The rig's configuration as TOML text.
    fn config_text(&self) -> String;

    /// Folders in or below which a recording that is asked for over the API may go; none: anywhere.
    fn recording_roots(&self) -> Vec<PathBuf> {
        Vec::new()
    }

    /// Starts a recording.
    ///
    /// # Errors
    /// `InUse` when one is going on, `BadInput` for an existing name or an invalid time, `NoSpace` when the disk
    /// has too little room, now or for as long as it is to last, `PermissionDenied`.
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

    /// The streams of the rig now, for viewers of its live channels; `None` for a rig without channels.
    fn live(&self) -> Option<LiveRig> {
        None
    }

    /// The controls of the replay, when the rig is one.
    fn replay(&self) -> Option<&dyn ReplayControl> {
        None
    }
}

/// The streams of a rig as a recording that began now would list them, those included that are not recorded.
#[derive(Debug, Clone)]
pub struct LiveRig {
    /// The streams and IMUs.
    pub session: Session,
    /// How their images are stored.
    pub options: RecorderOptions,
    /// Both clocks of their times: in a replay those of the dataset.
    pub utc: UtcPair,
}

/// Calls on a replay. A call that publishes a set returns when that was done, or after 3 s.
pub trait ReplayControl: Send + Sync {
    /// How far it has come.
    fn status(&self) -> ReplayStatus;

    /// Stops where it is.
    ///
    /// # Errors
    /// None today.
    fn pause(&self) -> Result<ReplayStatus>;

    /// Plays on.
    ///
    /// # Errors
    /// `WrongState` at the end.
    fn resume(&self) -> Result<ReplayStatus>;

    /// Goes to the set that `to` names and publishes it at once, paused or not.
    ///
    /// # Errors
    /// `BadInput` when there is no such place, `NotFound` for an id that no set has, `WrongState` for a place before
    /// the present one while it is recorded.
    fn seek(&self, to: &SeekRequest) -> Result<ReplayStatus>;

    /// Plays so many sets, the first one at once, and pauses. A negative number goes back to the set so far before
    /// the last one, publishes it and pauses.
    ///
    /// # Errors
    /// `BadInput` for 0, `WrongState` at the end, at the beginning, or backwards while it is recorded.
    fn step(&self, sets: i64) -> Result<ReplayStatus>;

    /// Changes the speed; sets already published stay, later ones are neither skipped nor bunched.
    ///
    /// # Errors
    /// `BadInput` outside of 0.1 to 10, `WrongState` when its subscribers pace it.
    fn set_rate(&self, rate: f64) -> Result<ReplayStatus>;

    /// Whether to begin again at the end.
    ///
    /// # Errors
    /// `WrongState` while it is recorded.
    fn set_loop(&self, on: bool) -> Result<ReplayStatus>;
}

/// A place in a replay: one of the fields.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SeekRequest {
    /// The set at, or first after, so many seconds after the first set.
    pub seconds: Option<f64>,
    /// The set of this number, from 0.
    pub set: Option<u64>,
    /// The set with this id in the only dataset.
    pub id: Option<u64>,
}

/// Options of a recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
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
    /// The recording ends by itself after so long, seconds; above 0. By this computer's clock, also in a replay.
    pub max_duration_s: Option<f64>,
    /// Begin even when its disk is expected to be full too soon.
    pub force: bool,
}
