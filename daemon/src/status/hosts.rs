//! The other computers of a rig, as the one that records sees them.

use super::{CameraStatus, RefineStatus};
use serde::{Deserialize, Serialize};

/// The other computers, and what became of their parts of the newest recording.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct HostsStatus {
    /// In the order of the rig file.
    pub hosts: Vec<HostStatus>,
    /// The newest recording that they have parts of; `None` before the first.
    pub session: Option<SessionStatus>,
}

impl HostsStatus {
    /// Whether a computer is away or refused, has no part of a recording that goes on, records without the session's clock, or sends no frames of a
    /// stream.
    pub fn is_ill(&self) -> bool {
        self.hosts.iter().any(|host| {
            let is_ill = host.state != HostState::Connected || host.why.is_some();
            let is_timeless = host.recording.is_some() && !host.has_clock;
            is_ill || is_timeless || host.mirrors.iter().any(|mirror| mirror.why.is_some())
        }) || self.session.as_ref().is_some_and(|s| s.joined == JoinState::Failed)
    }
}

/// Another computer of the rig.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct HostStatus {
    /// Its name in the rig.
    pub host: String,
    /// Whether its daemon answers.
    pub state: HostState,
    /// The fault and its cure; `None` if all is well.
    pub why: Option<String>,
    /// Its cameras.
    pub cameras: usize,
    /// Those that stream.
    pub streaming: usize,
    /// The session's clock is known there.
    pub has_clock: bool,
    /// The recording that goes on there.
    pub recording: Option<String>,
    /// Its streams that subscribers of this computer read.
    pub mirrors: Vec<MirrorStatus>,
    /// Its cameras whose depth is refined on this computer.
    pub refined: Vec<HostRefineStatus>,
    /// Its cameras with the streams that are on the bus of this computer: accounts are those of its own daemon at the last look, rates those of this
    /// one, and a camera is stalled while its frames do not come here.
    pub mirrored: Vec<CameraStatus>,
}

/// A camera of another computer whose depth is refined on this one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HostRefineStatus {
    /// The camera.
    pub camera: String,
    /// Its state; `None` until frames of colour and depth have come.
    pub refine: Option<RefineStatus>,
}

/// A stream of another computer that subscribers of this one read.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MirrorStatus {
    /// The stream, `CAMERA/STREAM`.
    pub stream: String,
    /// Whether its frames come.
    pub state: MirrorState,
    /// Why they do not; `None` while they do, or the computer is away.
    pub why: Option<String>,
    /// Coding of the newest frame on the way: `raw`, `jpeg` or `rank`; `None` before the first.
    pub coding: Option<String>,
    /// Frames a second, published here.
    pub rate_hz: f64,
    /// Frames that were published here.
    pub frames: u64,
    /// Frames that were left out, because the way is too slow or was cut.
    pub skipped: u64,
}

/// State of a mirrored stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MirrorState {
    /// They do.
    Live,
    /// Nobody here reads the stream, so none is asked for.
    Unread,
    /// They do not.
    Waiting,
}

/// Whether the daemon of another computer answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HostState {
    /// It does.
    Connected,
    /// It does not; capture and recording go on here, and there.
    #[default]
    Absent,
    /// It answers and cannot be part of this rig.
    Refused,
}

/// A recording of several computers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SessionStatus {
    /// Name of the recording on this computer.
    pub name: String,
    /// Parts that other computers recorded.
    pub parts: Vec<PartStatus>,
    /// Whether all are one dataset.
    pub joined: JoinState,
    /// Name of that dataset.
    pub dataset: Option<String>,
    /// Why they are not.
    pub why: Option<String>,
}

/// The part of a recording that another computer made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PartStatus {
    /// The computer.
    pub host: String,
    /// Name of the recording, there and here.
    pub name: String,
    /// Bytes there so far.
    pub bytes: u64,
    /// Bytes of them that are here.
    pub pulled_bytes: u64,
    /// All are here, and equal.
    pub is_complete: bool,
    /// Why it does not go on.
    pub why: Option<String>,
}

/// Whether the parts of a recording are one dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JoinState {
    /// Not yet: the recording goes on, or a part is not here.
    #[default]
    Waiting,
    /// It is being written.
    Joining,
    /// They are, and it was verified.
    Done,
    /// They could not be joined; the parts are as they were.
    Failed,
}
