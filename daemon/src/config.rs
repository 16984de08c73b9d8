//! The rig's configuration: the TOML file, checked, with defaults filled in.
//!
//! `default_rig.toml` explains every key; a test keeps it complete and its defaults true. Every problem of a file
//! is reported, each with its line, because a rig is edited on a headless computer where each attempt costs a
//! restart. Reading a configuration touches no camera and no file but its own.

mod camera;
pub(crate) mod controls;
mod error;
mod link;
pub(crate) mod pose;
pub(crate) mod read;
mod refine;
mod rig;
mod ros2;
pub(crate) mod stereo;
#[cfg(test)]
mod tests;
pub(crate) mod value;
pub(crate) mod wanted;

pub use crate::family::BackendConfig;
pub use depthrig_cdm::Precision;
pub use depthrig_cdm::stage::{CdmConfig, EngineChoice, RefineConfig, RefineModel};
pub use depthrig_recorder::{ColorCodec, DepthCodec};
pub use error::{ConfigError, Problem};
pub use stereo::StereoConfig;

use crate::family::{FAMILIES, Family};
use depthrig_bus::{CameraName, Name, Pose, RigName, SignalName, StreamId, StreamName};
use depthrig_calibrate::file::{CalibratedCamera, Calibration, DepthCorrection, lens_position};
use depthrig_driver::{StreamProfile, StreamRequest};
use depthrig_stereo::StereoOptions;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The highest rate that a camera or the sets may have, Hz.
pub const MAX_RATE_HZ: f64 = 1000.0;
/// The most sets that may wait for the encoders: waiting sets keep their slots in shared memory, and with the frames
/// that the set thread holds and those being encoded they must stay below the 16 that a subscriber may hold.
pub const MAX_QUEUE_SETS: usize = 6;
/// The most threads that encode; each may keep one more set's slots.
pub const MAX_WORKERS: usize = 4;
/// The most cameras that a rig may have: as many as a frame set's mask has bits.
pub const MAX_CAMERAS: usize = 64;

/// A rig: one mount on one computer.
#[derive(Debug, Clone, PartialEq)]
pub struct RigConfig {
    /// Its name, the `<rig>` of its channels.
    pub rig: RigName,
    /// Shared memory.
    pub bus: BusConfig,
    /// The set assembler.
    pub sets: SetsConfig,
    /// Recordings.
    pub recording: RecordingConfig,
    /// The control API.
    pub control: ControlConfig,
    /// Supervision of the cameras.
    pub supervisor: SupervisorConfig,
    /// Settings of depth refinement.
    pub cdm: CdmConfig,
    /// Calibration of the mount, absolute: intrinsics and poses found with a board.
    pub calibration: Option<PathBuf>,
    /// The text of that file; empty until the rig starts.
    pub calibration_text: String,
    /// The cameras in the order of the file; at least one, names unique.
    pub cameras: Vec<CameraConfig>,
    /// Signals that the file names; others are recorded as well.
    pub signals: Vec<SignalConfig>,
    /// Its part in a rig of several computers.
    pub link: Option<LinkConfig>,
    /// The program that publishes the rig to ROS 2.
    pub ros2: Option<Ros2Config>,
    /// The file's text.
    pub text: String,
    /// The file, if it came from one; absolute.
    pub path: Option<PathBuf>,
}

/// The part of this computer in a rig of several computers.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkConfig {
    /// Name of this computer, unique in the rig.
    pub host: Name,
    /// Its role there.
    pub role: LinkRole,
    /// Packets of the clock are not signed.
    pub insecure: bool,
    /// The other computers, which record when this one does.
    pub hosts: Vec<HostConfig>,
}

/// The program that publishes the rig to ROS 2, which the daemon starts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ros2Config {
    /// The program and its arguments; empty: `depthrig-ros2`, of the Python environment that this program is in, or found by `PATH`.
    pub command: Vec<String>,
    /// Where it runs.
    pub directory: PathBuf,
}

/// Another computer of the rig, as the one that records reaches it.
#[derive(Debug, Clone, PartialEq)]
pub struct HostConfig {
    /// Its name in the rig.
    pub name: Name,
    /// The way to its daemon's control socket.
    pub reach: Reach,
    /// Its streams that subscribers of this computer read.
    pub mirror: Vec<StreamId>,
    /// Refinement on this computer of the depth of its mirrored cameras; `None`: not at all.
    pub refine: Option<RefineConfig>,
}

impl HostConfig {
    /// Cameras whose colour and `depth` are mirrored.
    pub fn refined_cameras(&self, depth: &str) -> Vec<CameraName> {
        let has = |camera: &CameraName, stream: &str| {
            self.mirror.iter().any(|id| id.camera == *camera && id.stream.as_str() == stream)
        };
        let of_color = self.mirror.iter().filter(|id| id.stream.as_str() == "color");
        of_color.map(|id| &id.camera).filter(|camera| has(camera, depth)).cloned().collect()
    }
}

/// The way to the control socket of another daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reach {
    /// With OpenSSH.
    Ssh {
        /// `user@address`, or a `Host` of the user's `~/.ssh/config`.
        destination: String,
        /// Its path there; `None`: in the folder of that user's rigs.
        socket: Option<PathBuf>,
    },
    /// A socket on this computer that something else connects with it.
    Socket(PathBuf),
}

/// Whose clock is that of the session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkRole {
    /// This computer's; it answers questions about it at this address.
    Recorder(SocketAddr),
    /// That of the computer at this address.
    Camera(SocketAddr),
}

/// A signal that the rig needs.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalConfig {
    /// Its name, `DEVICE/SIGNAL`.
    pub name: SignalName,
    /// No recording begins while it is silent.
    pub required: bool,
    /// It is silent when no sample came for so long, seconds.
    pub silent_s: f64,
}

/// Shared memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BusConfig {
    /// Slots that each stream gets when `/dev/shm` is large enough.
    pub slots: usize,
}

/// The set assembler.
#[derive(Debug, Clone, PartialEq)]
pub struct SetsConfig {
    /// Sets per second.
    pub rate_hz: f64,
    /// How long after its tick a set waits for late frames, milliseconds; `None`: the assembler chooses.
    pub max_wait_ms: Option<f64>,
    /// Where in time the ticks lie.
    pub phase: Phase,
}

/// Where in time the ticks of the sets lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Phase {
    /// Where the frames of the cameras lie closest together.
    #[default]
    Auto,
    /// On whole multiples of the period of the host's clock.
    Fixed,
}

/// Recordings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingConfig {
    /// Folder that holds the folders of the datasets; absolute.
    pub directory: PathBuf,
    /// Folders besides it, absolute, in or below which `record start` may put a dataset.
    pub allow: Vec<PathBuf>,
    /// JPEG quality of colour, 1 to 100.
    pub jpeg_quality: u8,
    /// How colour is stored.
    pub color: ColorCodec,
    /// How depth of 16 bit is stored.
    pub depth: DepthCodec,
    /// A segment is closed at this size, MiB.
    pub segment_max_mb: u64,
    /// A segment is closed after this long, seconds.
    pub segment_max_s: u64,
    /// Threads that encode; 0: chosen by the number of cores.
    pub workers: usize,
    /// Sets that may wait to be encoded.
    pub queue_sets: usize,
    /// The recording ends cleanly when the disk has less than this left, MiB.
    pub reserve_mb: u64,
    /// A recording is refused when the disk is expected to take less than so many minutes of it; 0: never.
    pub min_minutes: u64,
    /// Whether datasets that were left unfinished here are recovered at the start.
    pub recover_on_start: bool,
}

/// The control API. The Unix socket is always there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlConfig {
    /// Where the API and the live page are also served, for this computer alone.
    pub tcp: Port,
    /// Where viewers that speak Foxglove's protocol are served, for this computer alone.
    pub foxglove: Port,
}

/// A port on the loopback interface.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Port {
    /// [`Port::DEFAULT`], or any other if another program, such as another rig, listens there.
    #[default]
    Any,
    /// This address and no other.
    At(SocketAddr),
    /// None.
    Off,
}

impl Port {
    /// Where the live page is if nothing else is configured.
    pub const DEFAULT: SocketAddr = SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, 8642));
    /// The port that viewers with Foxglove's protocol propose.
    pub const FOXGLOVE: u16 = 8765;

    /// A port of the loopback interface.
    pub const fn loopback(port: u16) -> Self {
        Self::At(SocketAddr::V4(SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)))
    }
}

/// Supervision of the cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct SupervisorConfig {
    /// A camera without a frame for this long is stalled and opened again, seconds.
    pub stall_s: f64,
    /// First pause before a lost camera is opened again, seconds.
    pub backoff_min_s: f64,
    /// The pause doubles up to this, seconds.
    pub backoff_max_s: f64,
    /// Whether camera threads ask for a higher priority.
    pub raise_priority: bool,
}

/// A camera of the rig.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraConfig {
    /// Its name, unique in the rig.
    pub name: CameraName,
    /// Pose of the camera on the mount: `p_mount = R p_camera + t`, optical axes (x right, y down, z forward).
    pub pose: Pose,
    /// Streams to start and their modes; empty: every stream in its default mode.
    pub streams: Vec<StreamRequest>,
    /// Streams to record; `None`: all.
    pub record: Option<Vec<StreamName>>,
    /// How depth is computed from its left and right images; `None`: not at all.
    pub stereo: Option<StereoConfig>,
    /// How its depth is refined; `None`: not at all.
    pub refine: Option<RefineConfig>,
    /// Its family and that family's settings.
    pub backend: BackendConfig,
    /// Entries of the mount's calibration; empty until the rig starts.
    pub calibration: Vec<Arc<CameraCalibration>>,
    /// Corrections of its depth; empty until the rig starts.
    pub depth: Vec<Arc<DepthCorrection>>,
}

/// An entry of the mount's calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraCalibration {
    /// When it was made.
    pub created: String,
    /// Position of the lens that the rig file sets now.
    pub lens_position: Option<i64>,
    /// The entry.
    pub camera: CalibratedCamera,
}

impl CameraConfig {
    /// The correction of the depth that is refined, if `[camera.refine]` asks for it.
    pub fn refined_correction(&self) -> Option<&DepthCorrection> {
        let refine = self.refine.as_ref().filter(|r| r.corrected)?;
        self.depth.iter().find(|d| d.stream == refine.depth).map(|d| &**d)
    }

    /// Whether frames of `stream` belong into recordings.
    pub fn records(&self, stream: &StreamName) -> bool {
        self.record.as_ref().is_none_or(|list| list.contains(stream))
    }

    /// Whether frames of `stream` come so much later than their source frames that no set waits for them: they
    /// join the set of their pair when it is recorded, as refined depth does.
    pub(crate) fn joins_late(&self, stream: &StreamName) -> bool {
        // Without a stream that comes at once there would be no set to join.
        let at_once = |name: &str| name == depthrig_stereo::COLOR || depthrig_stereo::SIDES.contains(&name);
        self.stereo.is_some()
            && StereoOptions::is_late(stream.as_str())
            && (self.streams.is_empty() || self.streams.iter().any(|s| at_once(s.stream.as_str())))
    }

    /// Whether `stream` is computed here from others of the camera, and does not come from the device.
    pub(crate) fn is_computed_here(&self, stream: &StreamName) -> bool {
        let stereo = self.stereo.as_ref().is_some_and(|s| s.streams().iter().any(|n| n == stream.as_str()));
        stereo || crate::stream::is_derived(stream)
    }

    /// The streams that are computed from `profiles`, and whether each is recorded.
    ///
    /// # Errors
    /// `BadInput` when its depth is to be refined and colour or depth is not among them.
    pub(crate) fn derived_profiles(
        &self,
        profiles: &[StreamProfile],
    ) -> crate::Result<Vec<(StreamProfile, bool)>> {
        crate::stage::profiles(self.refine.as_ref(), self.record.as_deref(), profiles)
    }
}

impl Default for Ros2Config {
    fn default() -> Self {
        Self { command: Vec::new(), directory: PathBuf::from(".") }
    }
}

impl Default for BusConfig {
    fn default() -> Self {
        Self { slots: depthrig_bus::shm::DEFAULT_SLOTS }
    }
}

impl Default for SetsConfig {
    fn default() -> Self {
        Self { rate_hz: 5.0, max_wait_ms: None, phase: Phase::Auto }
    }
}

impl Default for RecordingConfig {
    fn default() -> Self {
        Self {
            directory: PathBuf::from("datasets"),
            allow: Vec::new(),
            jpeg_quality: 95,
            color: ColorCodec::Jpeg,
            depth: DepthCodec::Zstd,
            segment_max_mb: 1024,
            segment_max_s: 60,
            workers: 0,
            queue_sets: 6,
            reserve_mb: 2048,
            min_minutes: 1,
            recover_on_start: true,
        }
    }
}

impl Default for ControlConfig {
    fn default() -> Self {
        Self { tcp: Port::Any, foxglove: Port::Off }
    }
}

impl Default for SupervisorConfig {
    fn default() -> Self {
        Self { stall_s: 1.0, backoff_min_s: 0.1, backoff_max_s: 1.0, raise_priority: true }
    }
}

impl RigConfig {
    /// Is true if depth of any camera is refined, of this computer or of another one.
    pub fn has_refined(&self) -> bool {
        let hosts = self.link.iter().flat_map(|link| &link.hosts);
        self.cameras.iter().any(|c| c.refine.is_some()) || hosts.into_iter().any(|h| h.refine.is_some())
    }

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when the file cannot be read (with the system's error as source), or with every problem
    /// that it has. It converts into [`crate::Error`] of kind `BadInput`, `NotFound` or `PermissionDenied`.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = depthrig_bus::files::read_to_string(path, depthrig_bus::files::TEXT_MAX_BYTES)
            .map_err(|e| ConfigError::unreadable(path, e))?;
        Self::parse(&text, Some(path))
    }

    /// Reads `text`, which came from the file `path` if any: relative paths are taken from that file's folder,
    /// else from the working directory.
    ///
    /// # Errors
    /// [`ConfigError`] with every problem of the text.
    pub fn parse(text: &str, path: Option<&Path>) -> Result<Self, ConfigError> {
        Self::parse_with(text, path, FAMILIES)
    }

    /// As [`Self::parse`], for cameras of `families`.
    pub(crate) fn parse_with(
        text: &str,
        path: Option<&Path>,
        families: &[Family],
    ) -> Result<Self, ConfigError> {
        rig::parse(text, path, families)
    }

    /// The commented default configuration: the seven cameras of the mount, simulated. It runs as it is.
    pub const fn default_text() -> &'static str {
        include_str!("../default_rig.toml")
    }

    /// The commented rig of the paper: its seven real cameras and their ten depth modes. It needs them to run.
    pub const fn paper_text() -> &'static str {
        include_str!("../paper_rig.toml")
    }

    /// Reads the mount's calibration, if the rig has one, into its cameras.
    ///
    /// # Errors
    /// `NotFound`, `PermissionDenied` or `BadInput` for a file that cannot be read or is wrong, or that has none of the cameras, or no
    /// correction of depth that a camera asks for.
    pub fn read_calibration(&mut self) -> crate::Result<()> {
        self.read_calibration_file()?;
        for camera in &self.cameras {
            let Some(refine) = camera.refine.as_ref().filter(|r| r.corrected) else { continue };
            if camera.refined_correction().is_none() {
                return Err(crate::Error::new(
                    crate::ErrorKind::BadInput,
                    format!(
                        "camera {}: [camera.refine] corrected = true, and the rig's calibration has no correction of {}/{}; `depthrig \
                         calibrate depth` makes one, and calibration = \"calibration.toml\" in the rig names its file",
                        camera.name, camera.name, refine.depth
                    ),
                ));
            }
        }
        Ok(())
    }

    fn read_calibration_file(&mut self) -> crate::Result<()> {
        let Some(path) = &self.calibration else { return Ok(()) };
        let shown = path.display();
        let bad = |why: String| crate::Error::new(crate::ErrorKind::BadInput, format!("{shown}: {why}"));
        let text = depthrig_bus::files::read_to_string(path, depthrig_bus::files::TEXT_MAX_BYTES)
            .map_err(|e| ConfigError::unreadable(path, e))?;
        let file = Calibration::from_toml(&text).map_err(|e| bad(e.to_string()))?;
        self.calibration_text = text;
        let mut used = false;
        for camera in &mut self.cameras {
            let entries = file.of_camera(camera.name.as_str());
            let lens_position = lens_position(&self.text, camera.name.as_str());
            let entry = |entry: &CalibratedCamera| {
                Arc::new(CameraCalibration {
                    created: file.created.clone(),
                    lens_position,
                    camera: entry.clone(),
                })
            };
            camera.calibration = entries.map(entry).collect();
            let corrections = file.depth.iter().filter(|d| d.camera == camera.name.as_str());
            camera.depth = corrections.map(|d| Arc::new(d.clone())).collect();
            used |= !camera.calibration.is_empty() || !camera.depth.is_empty();
        }
        if !used {
            let names: Vec<&str> = file.cameras.iter().map(|c| c.name.as_str()).collect();
            return Err(bad(format!(
                "has none of the rig's cameras; it has {}; give both the same names",
                names.join(", ")
            )));
        }
        Ok(())
    }

    /// The camera `name`.
    pub fn camera(&self, name: &str) -> Option<&CameraConfig> {
        self.cameras.iter().find(|c| c.name.as_str() == name)
    }
}
