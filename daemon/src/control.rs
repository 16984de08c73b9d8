//! Calls on a running rig, from any side: the HTTP API, the command line in process, or a test.

use crate::doctor::Examined;
pub use crate::losses::{LossBucket, Losses, RecordingLosses};
use crate::sets::Rhythm;
use crate::status::{RecordingStatus, ReplayStatus, RigStatus};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{HostTime, RigName, RuntimeDir, UtcPair};
use depthrig_calibrate::file::CalibratedCamera;
use depthrig_calibrate::mount::UncertaintyMap;
use depthrig_driver::controls::ControlValue;
use depthrig_link::{Key, Reading};
use depthrig_recorder::{Episode, EpisodeOutcome, Mark, RecorderOptions, Session};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::Arc;

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

    /// The folder that recordings go into.
    ///
    /// # Errors
    /// `WrongState` of a rig that has none.
    fn recordings(&self) -> Result<PathBuf> {
        Err(Error::new(ErrorKind::WrongState, "this rig replays datasets and has no folder of recordings"))
    }
    /// Shows datasets beside the rig, if it can.
    fn shows(&self) -> Option<&dyn Shows> {
        None
    }
    /// Examines the rig's cameras, their links, memory and disk, without measuring the disk.
    ///
    /// # Errors
    /// `WrongState` of a rig without cameras, and when the system cannot be read at all.
    fn doctor(&self) -> Result<Examined> {
        Err(Error::new(ErrorKind::WrongState, "this rig replays datasets and has no cameras to examine"))
    }
    /// Uncertainty of the calibration in use over the images of each calibrated camera; none of a replay.
    fn calibration(&self) -> Vec<CalibratedImage> {
        Vec::new()
    }
    /// The controls of the cameras that can be changed while they stream.
    ///
    /// # Errors
    /// `WrongState` of a rig without cameras, `Other` when the rig file cannot be read any more.
    fn controls(&self) -> Result<ControlList> {
        Err(no_controls())
    }
    /// Changes a control of a running camera; no file changes. A recording gets a note.
    ///
    /// # Errors
    /// `NotFound` for an unknown camera, `WrongState` for one whose controls cannot be changed now, `BadInput` for an unknown control or a
    /// value that it does not take, `Other` when the camera refuses.
    fn set_control(&self, _: &ControlRequest) -> Result<CameraControls> {
        Err(no_controls())
    }
    /// Sets the controls of a camera that were changed back to the rig file's values, and those that it does not have to what they are after
    /// power-on.
    ///
    /// # Errors
    /// As [`Self::set_control`].
    fn revert_controls(&self, _camera: &str) -> Result<CameraControls> {
        Err(no_controls())
    }
    /// Previews how the rig file changes when the changed controls are written into it.
    ///
    /// # Errors
    /// `WrongState` for a rig without a file, `Other` when it cannot be read or edited as text.
    fn control_changes(&self) -> Result<ControlChanges> {
        Err(no_controls())
    }
    /// Writes the changed controls into the rig file, if that does what `fingerprint` stands for.
    ///
    /// # Errors
    /// As [`Self::control_changes`]; `WrongState` when the file or a control has changed since, `PermissionDenied`, `NoSpace`.
    fn save_controls(&self, _fingerprint: &str) -> Result<ControlChanges> {
        Err(no_controls())
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

    /// Takes the key and the ticks of the computer that records the session, and says which streams there are.
    ///
    /// # Errors
    /// `WrongState` of a rig whose clock is that of the session, or that has no other computers.
    fn follow(&self, _: &FollowRequest) -> Result<GridStreams> {
        let what = "this rig follows the clock of no other computer ([link] with recorder in its rig file)";
        Err(Error::new(ErrorKind::WrongState, what))
    }

    /// Adds a timed note to the recording.
    ///
    /// # Errors
    /// `WrongState` when none is going on, `BadInput` for an empty note.
    fn record_note(&self, text: &str) -> Result<()>;

    /// Begins, ends or judges an episode of the recording.
    ///
    /// # Errors
    /// `WrongState` when no recording is going on or no episode is running, `InUse` when one is, `NotFound` for an unknown one, `BadInput` for a
    /// task that is too long.
    fn episode(&self, request: &EpisodeRequest) -> Result<Episode>;

    /// Episodes of the recording in progress, or of the last one; `None` before the first.
    fn episodes(&self) -> Option<RecordingEpisodes> {
        None
    }

    /// When the recording in progress, or the last one, lost something; `None` before the first.
    fn record_losses(&self) -> Option<RecordingLosses> {
        None
    }

    /// The clock of the session minus this computer's at a time of this computer's; `None` if it is not known, or this computer's.
    fn session_clock(&self, _at: HostTime) -> Option<Reading> {
        None
    }

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

/// Key and ticks of the computer that records a session, for the others.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FollowRequest {
    /// Signs the packets of its clock; none if nobody signs them.
    #[serde(default)]
    pub key: Option<Key>,
    /// Where the ticks lie: nanoseconds after a whole period on its clock.
    pub phase_ns: i64,
}

/// The streams that such ticks are chosen for.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct GridStreams {
    /// On the clock of the session; empty while that is unknown.
    pub streams: Vec<Rhythm>,
}

fn no_controls() -> Error {
    Error::new(ErrorKind::WrongState, "this rig replays datasets and has no cameras to control")
}

/// A stream that the calibration in use has images of.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibratedImage {
    /// The stream, `camera/stream`.
    pub stream: String,
    /// When the calibration was made.
    pub created: String,
    /// Columns of the images.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Uncertainty of projection over the image; `None` where the calibration's file does not have it.
    pub uncertainty: Option<UncertaintyOfImage>,
}

/// Uncertainty of projection over an image, as the calibration's report shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct UncertaintyOfImage {
    /// Distance of the points that are projected, metres.
    pub distance_m: f64,
    /// Width of a pixel at that distance, in the middle of the image, millimetres.
    pub pixel_mm: f64,
    /// Places along x; the first and the last are the borders of the image.
    pub columns: usize,
    /// Standard deviation in the worst direction, pixels, row by row; `None` where the lens shows nothing.
    pub sigma_px: Vec<Option<f64>>,
    /// In the middle of the image.
    pub middle_px: f64,
    /// The largest.
    pub worst_px: f64,
}

impl CalibratedImage {
    /// The image of an entry of a calibration that was made at `created`.
    pub fn of(entry: &CalibratedCamera, created: &str) -> Self {
        let uncertainty = |map: &UncertaintyMap| UncertaintyOfImage {
            distance_m: map.distance_m,
            pixel_mm: map.distance_m * 1e3 / entry.intrinsics.fx,
            columns: map.columns,
            sigma_px: map.sigma_px.iter().map(|s| Some(*s).filter(|s| s.is_finite())).collect(),
            middle_px: map.middle_px(),
            worst_px: map.worst_px(),
        };
        Self {
            stream: format!("{}/{}", entry.name, entry.stream),
            created: created.to_owned(),
            width: entry.width,
            height: entry.height,
            uncertainty: entry.uncertainty.as_ref().map(uncertainty),
        }
    }
}

/// The controls of a rig's cameras.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControlList {
    /// The rig file; `None` for the built-in configuration.
    pub file: Option<PathBuf>,
    /// In the order of the rig file.
    pub cameras: Vec<CameraControls>,
}

/// The controls of a camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraControls {
    /// Its name.
    pub camera: String,
    /// Why it has no controls.
    pub problem: Option<String>,
    /// Those that can be changed while it streams.
    pub controls: Vec<ControlInfo>,
}

/// A control.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ControlInfo {
    /// Where it is in the camera's table of the rig file: `gain`, or `color_controls.brightness`.
    pub name: String,
    /// `integer`, `boolean` or `menu`.
    pub kind: &'static str,
    /// The least value.
    pub minimum: i64,
    /// The greatest value.
    pub maximum: i64,
    /// The distance between values.
    pub step: u64,
    /// The value after power-on.
    pub default: Option<ControlValue>,
    /// The items of a menu.
    pub items: Vec<ControlItem>,
    /// The value now; `None` when it cannot be read.
    pub value: Option<ControlValue>,
    /// The rig file's value; `None` where it leaves the control alone.
    pub in_file: Option<ControlValue>,
    /// Whether it has an effect now: an automatic may have it.
    pub is_active: bool,
    /// Whether it cannot be changed at all.
    pub is_read_only: bool,
}

/// An item of a menu.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ControlItem {
    /// Its number.
    pub value: i64,
    /// Its name.
    pub name: String,
}

/// A change of a control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlRequest {
    /// The camera.
    pub camera: String,
    /// The control, as the list names it.
    pub name: String,
    /// Its new value.
    pub value: ControlValue,
}

/// Changes of a rig file that have not been made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ControlChanges {
    /// The rig file.
    pub file: PathBuf,
    /// A unified diff; empty if nothing differs.
    pub diff: String,
    /// Stands for the file as it is and for the change.
    pub fingerprint: String,
}

/// Shows datasets beside a rig, as rigs of their own that no other program sees.
pub trait Shows: Send + Sync {
    /// Shows the dataset in the folder `dataset` until the answer is dropped; the same one for all who ask for the same dataset.
    ///
    /// # Errors
    /// `NotFound`, `BadInput` for what is not a dataset, `InUse` while another one is shown, `NoSpace` when shared memory is too small.
    fn show(&self, dataset: &Path) -> Result<Arc<Shown>>;
}

/// A dataset that is shown.
pub struct Shown {
    /// Its control, a replay's.
    pub control: Arc<dyn Control>,
    /// Where its channels are.
    pub runtime: RuntimeDir,
    /// The rig's name there.
    pub rig: RigName,
    /// Ends it when dropped.
    pub replay: Box<dyn Send + Sync>,
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

/// How a recording ends.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StopRequest {
    /// A judgement of it.
    pub mark: Option<Mark>,
}

/// Change of an episode, a demonstration within a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "action", rename_all = "snake_case", deny_unknown_fields)]
pub enum EpisodeRequest {
    /// One begins.
    Start {
        /// The task.
        #[serde(default)]
        task: String,
    },
    /// The one that runs ends and is kept.
    Stop {
        /// Judgement of the task.
        #[serde(default)]
        outcome: Option<EpisodeOutcome>,
    },
    /// One is not to be used.
    Discard {
        /// Which; without it the one that runs, which ends, else the last one.
        #[serde(default)]
        number: Option<u32>,
    },
    /// One that has ended is judged, and kept.
    Mark {
        /// Judgement of the task; `None` takes it back.
        #[serde(default)]
        outcome: Option<EpisodeOutcome>,
        /// Which; without it the last one.
        #[serde(default)]
        number: Option<u32>,
    },
}

/// The episodes of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingEpisodes {
    /// The dataset's folder.
    pub path: String,
    /// They, by number.
    pub episodes: Vec<Episode>,
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
