//! Status of the daemon: the one structure behind `status`, `top`, `/v1/status` and `/metrics`.

mod hosts;

pub use hosts::{
    HostRefineStatus, HostState, HostStatus, HostsStatus, JoinState, MirrorState, MirrorStatus, PartStatus,
    SessionStatus,
};

use depthrig_recorder::Episode;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The whole rig at one moment.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RigStatus {
    /// The rig's name.
    pub rig: String,
    /// Version of depthrig.
    pub version: String,
    /// The daemon's process.
    pub pid: u32,
    /// How long it has run, seconds.
    pub uptime_s: f64,
    /// The moment of this status, nanoseconds since 1970 UTC.
    pub utc_ns: i64,
    /// How far the scenes of simulated cameras are rendered, while they are: until then their images are coarse.
    pub preparing: Option<PreparingStatus>,
    /// Cameras in the order of the configuration.
    pub cameras: Vec<CameraStatus>,
    /// Signals that are published, and those that the rig file names.
    #[serde(default)]
    pub signals: Vec<SignalStatus>,
    /// The clock of the session, in a rig of several computers.
    #[serde(default)]
    pub link: Option<LinkStatus>,
    /// The other computers, on the one that records.
    #[serde(default)]
    pub hosts: Option<HostsStatus>,
    /// The program that publishes the rig to ROS 2, if the daemon starts one.
    #[serde(default)]
    pub ros2: Option<Ros2Status>,
    /// The set assembler.
    pub sets: SetStatus,
    /// The recording in progress, or the last one.
    pub recording: Option<RecordingStatus>,
    /// Shared memory.
    pub shared_memory: SharedMemoryStatus,
    /// CPU that the daemon used over the last second or so, in cores.
    pub cpu_cores: f64,
    /// The replay, when the cameras are those of a dataset.
    pub replay: Option<ReplayStatus>,
}

/// A signal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SignalStatus {
    /// Its name, `DEVICE/SIGNAL`.
    pub signal: String,
    /// Whether the rig file requires it.
    pub required: bool,
    /// Whether samples come.
    pub state: SignalState,
    /// How long ago the last sample came, seconds; `None` before the first.
    pub age_s: Option<f64>,
    /// Samples that came since the rig started, or since it was published anew.
    pub samples: u64,
    /// Samples that were replaced on the channel before they were read.
    pub missed: u64,
}

/// The program that publishes the rig to ROS 2.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ros2Status {
    /// Its process; `None` while it does not run.
    pub pid: Option<u32>,
    /// Why it does not run.
    pub why: Option<String>,
}

/// The clock of a session of several computers, as this one knows it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LinkStatus {
    /// Name of this computer in the rig.
    pub host: String,
    /// The packets of the clock are not signed.
    pub insecure: bool,
    /// The computer whose clock is that of the session; `None` if it is this one.
    pub recorder: Option<String>,
    /// Whether it answers.
    pub state: LinkState,
    /// Its clock minus this one, seconds; `None` before the first answer.
    pub offset_s: Option<f64>,
    /// The offset is wrong by no more than this, microseconds.
    pub uncertainty_us: Option<f64>,
    /// Rate of its clock over this one, minus one, in parts per million.
    pub rate_ppm: Option<f64>,
    /// Counts steps of the clocks.
    pub epoch: Option<u32>,
    /// Time on the way of the newest answer or refusal, both ways together, microseconds.
    pub round_trip_us: Option<f64>,
    /// How long ago the newest answer came, seconds.
    pub age_s: Option<f64>,
    /// Questions asked; on the recorder's computer those it answered.
    pub exchanges: u64,
    /// Packets that were of no use.
    pub refused: u64,
}

/// Whether the clock of the session is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// It is this computer's.
    Own,
    /// Answers come.
    Live,
    /// No answer came for two seconds; the offset is that of before, with an uncertainty that grows.
    Silent,
    /// There was no answer yet.
    Unknown,
    /// It answers, but not this computer, which has not been given its key yet.
    Unkeyed,
}

/// Whether samples of a signal come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SignalState {
    /// They do.
    Live,
    /// Its publisher is there and silent for longer than the rig file allows.
    Silent,
    /// Nobody publishes it.
    Missing,
}

/// How far the scenes of simulated cameras are rendered.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct PreparingStatus {
    /// Images rendered.
    pub images: u64,
    /// Images to be rendered.
    pub images_total: u64,
    /// Share done, 0 to 1.
    pub share: f64,
    /// Why it does not go on, if so.
    pub error: Option<String>,
}

/// A replay. Seconds and sets are counted from the first set that is replayed.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(clippy::struct_excessive_bools)] // each is a fact of its own
pub struct ReplayStatus {
    /// The datasets' folders.
    pub datasets: Vec<String>,
    /// Whether it waits for a command, or plays no more than the requested sets.
    pub paused: bool,
    /// Whether everything was published.
    pub done: bool,
    /// The set that was published last, seconds after the first.
    pub position_s: f64,
    /// From the first set to the last, seconds.
    pub length_s: f64,
    /// Number of the set that was published last, from 0; `None` before the first.
    pub set: Option<u64>,
    /// Its id in its dataset.
    pub set_id: Option<u64>,
    /// Sets of one round.
    pub length_sets: u64,
    /// Speed against the original.
    pub rate: f64,
    /// Whether its subscribers pace it, and not the clock at `rate`.
    pub as_fast_as_possible: bool,
    /// Whether it begins again at the end.
    #[serde(rename = "loop")]
    pub looped: bool,
    /// Rounds begun.
    pub rounds: u64,
    /// Sets published.
    pub sets: u64,
    /// Frames published.
    pub frames: u64,
    /// The channel whose subscribers keep it waiting for more than a second.
    pub waiting_for: Option<String>,
    /// Data that could not be read or published, one line each (100 at most).
    pub lost: Vec<String>,
}

/// The state of a camera's supervisor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum CameraState {
    /// Being opened for the first time.
    #[default]
    Opening,
    /// Frames come.
    Streaming,
    /// Open, but no frame has come for too long.
    Stalled,
    /// Lost; it is being opened again, with growing pauses.
    Reconnecting,
    /// Given up: its configuration cannot work (the message says why).
    Failed,
    /// Its source came to its end (files that are not looped).
    Finished,
    /// Stopped with the rig.
    Stopped,
}

impl CameraState {
    /// Every state.
    pub const ALL: [Self; 7] = [
        Self::Opening,
        Self::Streaming,
        Self::Stalled,
        Self::Reconnecting,
        Self::Failed,
        Self::Finished,
        Self::Stopped,
    ];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Opening => "opening",
            Self::Streaming => "streaming",
            Self::Stalled => "stalled",
            Self::Reconnecting => "reconnecting",
            Self::Failed => "failed",
            Self::Finished => "finished",
            Self::Stopped => "stopped",
        }
    }
}

/// One camera.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CameraStatus {
    /// Its name in the rig.
    pub name: String,
    /// Its driver.
    pub backend: String,
    /// Model as the device says.
    pub model: String,
    /// Serial number as the device says.
    pub serial: String,
    /// Firmware as the device says.
    pub firmware: String,
    /// Where it is attached: USB port path, folder, …
    #[serde(default)]
    pub port: String,
    /// Where its calibration comes from.
    pub calibration: String,
    /// State of its supervisor.
    pub state: CameraState,
    /// How long it has been in this state, seconds.
    pub state_for_s: f64,
    /// Why it is in a state other than streaming.
    pub message: Option<String>,
    /// Problems although it streams, such as a calibration that does not fit.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// Times it was lost and came back.
    pub reconnects: u64,
    /// Its streams; computed ones come last.
    pub streams: Vec<StreamStatus>,
    /// How its depth is refined; `None` when that is not asked for.
    #[serde(default)]
    pub refine: Option<RefineStatus>,
    /// The calibration of the mount that it has; `None` without one.
    #[serde(default)]
    pub mount: Option<CalibrationStatus>,
}

/// How old a camera's calibration on the mount is, and what it is worth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationStatus {
    /// When it was made.
    pub created: String,
    /// Days since then; `None` for a date that cannot be read.
    pub age_days: Option<f64>,
    /// Its accuracy in words, on one line.
    pub worth: String,
    /// Standard deviation of the camera's place, millimetres; 0 for the reference.
    pub sigma_mm: f64,
    /// Standard deviation of its direction, degrees; 0 for the reference.
    pub sigma_deg: f64,
    /// Root mean square of the residuals, pixels.
    pub rms_px: f64,
    /// Residual of views that the intrinsics were not fitted to, pixels.
    pub held_out_px: Option<f64>,
    /// Standard deviation of the projection where it is largest, pixels.
    pub projection_worst_px: f64,
    /// Difference of projection between the calibrations of two halves of the views, pixels.
    pub halves_differ_px: Option<f64>,
    /// Their difference in place, millimetres.
    pub halves_differ_mm: Option<f64>,
    /// Why it may not hold, with the cure.
    pub warnings: Vec<String>,
}

/// Where the refining of a camera's depth stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum RefineState {
    /// The engine is being started.
    Starting,
    /// Pairs of images are refined as they come.
    Running,
    /// It does not go (the message says why); the engine is tried again with growing pauses.
    Failed,
    /// Switched off.
    Off,
}

impl RefineState {
    /// Every state.
    pub const ALL: [Self; 4] = [Self::Starting, Self::Running, Self::Failed, Self::Off];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Failed => "failed",
            Self::Off => "off",
        }
    }
}

/// How a camera's depth is refined. The accounts are those of the stream `depth_refined`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefineStatus {
    /// Where it stands.
    pub state: RefineState,
    /// How long it has been in this state, seconds.
    pub state_for_s: f64,
    /// Why it does not run, or how it differs from the settings.
    pub message: Option<String>,
    /// The engine that runs, such as `fill` or `onnxruntime 1.31.1 cpu fp32`; empty before any did.
    pub engine: String,
    /// The model; empty when the engine needs none.
    pub model: String,
    /// Rate asked for, Hz.
    pub nominal_hz: f64,
    /// Rate over the last seconds, Hz.
    pub rate_hz: f64,
    /// Pairs of images that were due and not refined, by reason: `busy`, `no_color`, `unfit`, `engine`, `hung`,
    /// `no_slot`; reasons that never were are left out.
    pub skipped: BTreeMap<String, u64>,
    /// Depth frames beyond the rate asked for.
    pub not_due: u64,
    /// Times it came back after it had failed.
    pub restarts: u64,
    /// How long each step took, median over the last frames, milliseconds.
    pub steps_p50_ms: BTreeMap<String, f64>,
    /// 99th percentile.
    pub steps_p99_ms: BTreeMap<String, f64>,
}

/// One stream. `captured = delivered + Σ dropped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct StreamStatus {
    /// `camera/stream`.
    pub id: String,
    /// Whether it is computed from other streams of the camera; captured are then the pairs of images that were due.
    #[serde(default)]
    pub derived: bool,
    /// Pixel format.
    pub format: String,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Rate asked of the device, Hz.
    pub nominal_hz: f64,
    /// Rate delivered over the last seconds, Hz.
    pub rate_hz: f64,
    /// Of an IMU, whose frames are batches: samples a second, over the last seconds. `None` of images.
    #[serde(default)]
    pub samples_hz: Option<f64>,
    /// Frames the device captured.
    pub captured: u64,
    /// Frames published.
    pub delivered: u64,
    /// Frames lost, by reason; reasons without a loss are left out.
    pub dropped: BTreeMap<String, u64>,
    /// Milliseconds since the last frame; `None` before the first.
    pub last_frame_age_ms: Option<f64>,
    /// Capture to published, median over the last frames, milliseconds.
    pub latency_p50_ms: f64,
    /// Capture to published, 99th percentile, milliseconds.
    pub latency_p99_ms: f64,
    /// The clock map.
    pub clock: ClockStatus,
    /// Accounts of its delivered frames in the set assembler.
    pub in_sets: SetAccount,
}

/// Quality of a stream's clock map.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ClockStatus {
    /// `device`, `kernel` or `arrival`.
    pub domain: String,
    /// Source of the times: `full`, `header`, `kernel`, `arrival` or `simulated`
    /// ([`depthrig_bus::MetadataLevel`]).
    #[serde(default)]
    pub metadata: String,
    /// Frames of a better level whose own metadata did not come.
    #[serde(default)]
    pub metadata_lost: u64,
    /// Number of the map in force.
    pub epoch: u32,
    /// Device clock rate against the host's, parts per million.
    pub rate_ppm: f64,
    /// Stated uncertainty of the newest capture time, microseconds.
    pub uncertainty_us: f64,
    /// How late arrivals are against the map, median, microseconds.
    pub residual_p50_us: f64,
    /// 99th percentile, microseconds.
    pub residual_p99_us: f64,
    /// Frames flagged `time_uncertain`.
    pub uncertain_frames: u64,
}

/// Accounts of a stream's frames in the set assembler; of an IMU's batches in recordings:
/// `delivered = used + decimated + late + out_of_order + overflow + missed + pending + unread`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SetAccount {
    /// Became part of a set. Of an IMU: went with a recorded set.
    pub used: u64,
    /// Between two ticks, as most frames are. Of an IMU: came while nothing was recorded.
    pub decimated: u64,
    /// Came after their set had been sent.
    pub late: u64,
    /// Stamped not after their predecessor.
    pub out_of_order: u64,
    /// Pushed out by newer ones while waiting.
    pub overflow: u64,
    /// Replaced on the channel before the assembler read them.
    pub missed: u64,
    /// Waiting for their set now.
    pub pending: u64,
    /// Delivered, and not yet seen by the assembler, which reads when it next wakes.
    #[serde(default)]
    pub unread: u64,
}

impl SetAccount {
    /// The frames that have an end in the assembler, or wait there.
    pub const fn taken(&self) -> u64 {
        let Self { used, decimated, late, out_of_order, overflow, missed, pending, unread: _ } = *self;
        used + decimated + late + out_of_order + overflow + missed + pending
    }

    /// This account, taken before `delivered` was read, with the frames that came since then.
    #[must_use]
    pub const fn with_delivered(self, delivered: u64) -> Self {
        Self { unread: delivered.saturating_sub(self.taken()), ..self }
    }
}

/// The set assembler.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SetStatus {
    /// Rate asked for, Hz.
    pub nominal_hz: f64,
    /// Sets sent.
    pub sent: u64,
    /// Sets sent that miss a stream.
    pub incomplete: u64,
    /// Spread of a set (latest minus earliest capture time), median, milliseconds.
    pub spread_p50_ms: f64,
    /// 95th percentile.
    pub spread_p95_ms: f64,
    /// 99th percentile.
    pub spread_p99_ms: f64,
    /// Greatest.
    pub spread_max_ms: f64,
    /// How far the frames of each stream are from the moments that the sets stand for; the difference of two streams is their skew.
    #[serde(default)]
    pub skews: Vec<SkewStatus>,
}

/// Capture times of a stream's frames against the ticks of their sets, over the last minutes.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct SkewStatus {
    /// `camera/stream`.
    pub stream: String,
    /// Median, milliseconds; negative: before the tick.
    pub median_ms: f64,
    /// 95th percentile of its size, milliseconds.
    pub p95_ms: f64,
}

/// Shared memory of the bus.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct SharedMemoryStatus {
    /// Bytes still free in `/dev/shm`.
    pub free_bytes: u64,
    /// Slots of each stream.
    pub slots: usize,
    /// Bytes of all slots of all streams.
    pub reserved_bytes: u64,
}

/// A recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RecordingStatus {
    /// Whether it is still going on.
    pub active: bool,
    /// Whether it is being closed: no set is added any more, those that wait are written.
    #[serde(default)]
    pub closing: bool,
    /// The dataset's folder.
    pub path: String,
    /// Session name.
    pub name: String,
    /// Scene label.
    pub scene: String,
    /// Who records.
    pub operator: String,
    /// Start, nanoseconds since 1970 UTC.
    pub started_utc_ns: i64,
    /// Length so far, seconds.
    pub duration_s: f64,
    /// Sets written.
    pub sets: u64,
    /// Sets lost, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// Frames that recorded sets lack, by stream.
    #[serde(default)]
    pub missing: BTreeMap<String, u64>,
    /// Frames of recorded streams that were lost before they reached their channel, by reason.
    #[serde(default)]
    pub frames_dropped: BTreeMap<String, u64>,
    /// Frames written.
    pub frames: u64,
    /// Bytes written.
    pub bytes: u64,
    /// Segments begun.
    pub segments: u64,
    /// Sets that wait to be encoded.
    pub encode_queue: u64,
    /// Encoded bytes that wait for the disk.
    pub backlog_bytes: u64,
    /// Why it ended early or lost something.
    pub error: Option<String>,
    /// Bytes free on its disk.
    pub disk_free_bytes: u64,
    /// Seconds left at the present rate; `None` before a rate is known.
    pub disk_seconds_left: Option<f64>,
    /// Episodes that are kept, without one that runs.
    #[serde(default)]
    pub episodes: u32,
    /// Episodes that were discarded.
    #[serde(default)]
    pub episodes_discarded: u32,
    /// The episode that runs, or the last one.
    #[serde(default)]
    pub episode: Option<Episode>,
    /// A warning that needs attention: little room left, a disk that does not answer.
    #[serde(default)]
    pub warning: Option<String>,
}
