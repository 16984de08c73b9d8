//! The configuration of a simulated camera, as plain values that a rig file maps onto.

use super::arm::{self, Arm};
use super::board::BoardScene;
use super::motion;
use core::ops::RangeInclusive;
use depthrig_bus::{HostTime, Pose, StreamName};
use depthrig_calib::PoseExt;
use depthrig_driver::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Gains of the colour camera; at the least one images are as they are rendered.
pub(crate) const GAINS: RangeInclusive<u32> = 16..=128;

/// One simulated camera.
///
/// All cameras of one [`super::SyntheticBackend`] stand on one mount in one world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(clippy::struct_excessive_bools)] // each is a fact of its own
pub struct SyntheticConfig {
    /// `d405`, `d415`, `d435`, `d455`, `l515`, `zed2i`, `kinect` or `generic`; see [`super::models`].
    pub model: String,
    /// Serial number; distinguishes two cameras of a model. Empty: derived from the model.
    pub serial: String,
    /// Seed of everything random: sensor noise, jitter, stalls.
    pub seed: u64,
    /// Pose of the camera on the mount (x right, y down, z forward, as an optical frame).
    pub pose_on_mount: Pose,
    /// Overrides of the model's default modes.
    pub streams: Vec<StreamOverride>,
    /// Whether the true depth is given too: `depth_true` in the view of `depth`, `depth_true_color` in that of `color`.
    pub truth: bool,
    /// Whether it has an IMU, as the stream `imu`: see [`super::imu`].
    pub motion: bool,
    /// The device's clock and its transport.
    pub clock: ClockSim,
    /// Scheduled faults.
    pub faults: Vec<ScheduledFault>,
    /// Poses of the mount that are rendered; they are shown to and fro.
    pub poses: u32,
    /// How many poses the mount passes per second.
    pub pose_rate_hz: f64,
    /// When this camera exposes, as a fraction of its frame period after the rig's tick, 0..1.
    pub phase: f64,
    /// Folder of the render cache.
    pub cache_dir: PathBuf,
    /// No images: a pattern that costs one memory copy per frame and can be checked. Any size is allowed.
    pub cheap: bool,
    /// Gain of the colour camera, 16 to 128; 16 shows the scene as it is rendered. Can be changed while it streams.
    pub gain: u32,
    /// Frames that the device keeps while nobody fetches them; older ones are lost.
    pub ring_frames: u32,
    /// A printed board in front of the mount, which then stands still.
    pub board: Option<BoardScene>,
    /// A robot's arm on the table that moves, [`super::arm`]; the mount then stands still.
    pub arm: bool,
}

impl Default for SyntheticConfig {
    fn default() -> Self {
        Self {
            model: "generic".into(),
            serial: String::new(),
            seed: 1,
            pose_on_mount: Pose::IDENTITY,
            streams: Vec::new(),
            truth: false,
            motion: false,
            clock: ClockSim::default(),
            faults: Vec::new(),
            poses: 12,
            pose_rate_hz: 15.0,
            phase: 0.0,
            cache_dir: default_cache_dir(),
            cheap: false,
            gain: *GAINS.start(),
            ring_frames: 8,
            board: None,
            arm: false,
        }
    }
}

/// Where rendered images are kept when nothing is said: `$XDG_CACHE_HOME/depthrig/synthetic`, else
/// `~/.cache/depthrig/synthetic`, else a folder of the system's temporary directory.
pub fn default_cache_dir() -> PathBuf {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
    absolute("XDG_CACHE_HOME")
        .or_else(|| absolute("HOME").map(|home| home.join(".cache")))
        .unwrap_or_else(std::env::temp_dir)
        .join("depthrig")
        .join("synthetic")
}

/// A change to the default mode of one stream; what is `None` stays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreamOverride {
    /// `color`, `depth`, `depth_true`, `depth_true_color` or `imu`, which has one mode only.
    pub stream: StreamName,
    /// Width and height in pixels.
    #[serde(default)]
    pub size: Option<(u32, u32)>,
    /// Frame rate.
    #[serde(default)]
    pub rate_hz: Option<f64>,
}

/// A device's clock, and how its frames travel to the computer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClockSim {
    /// Value of the counter (of microseconds) when the device is switched on; near `2^counter_bits` it
    /// wraps soon.
    pub start_ticks: u64,
    /// Width of the counter in bits.
    pub counter_bits: u32,
    /// How much faster than the computer's clock it runs, parts per million.
    pub drift_ppm: f64,
    /// Size of the slow wander of the rate as the device warms and cools, parts per million.
    pub thermal_ppm: f64,
    /// Period of that wander, seconds.
    pub thermal_period_s: f64,
    /// Standard deviation of the device's own stamps, microseconds.
    pub stamp_jitter_us: f64,
    /// The least time from the end of the exposure to the last byte, milliseconds.
    pub latency_ms: f64,
    /// Mean of the exponential extra latency, milliseconds.
    pub latency_jitter_ms: f64,
    /// Probability per frame that the transport halts.
    pub stall_probability: f64,
    /// Shortest and longest such halt, milliseconds; what arrives meanwhile comes in one batch after it.
    pub stall_ms: (f64, f64),
    /// Moments at which the device restarts its clock and its frame counter, seconds after streaming began.
    pub reset_at_s: Vec<f64>,
}

impl Default for ClockSim {
    fn default() -> Self {
        Self {
            start_ticks: 1_000_000,
            counter_bits: 32,
            drift_ppm: 0.0,
            thermal_ppm: 0.0,
            thermal_period_s: 600.0,
            stamp_jitter_us: 1.0,
            latency_ms: 3.0,
            latency_jitter_ms: 0.4,
            stall_probability: 0.0,
            stall_ms: (20.0, 200.0),
            reset_at_s: Vec::new(),
        }
    }
}

/// A fault and its moment.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduledFault {
    /// When, in seconds after the device first began to stream.
    pub at_s: f64,
    /// Kind of the fault.
    pub kind: FaultKind,
    /// For how long, where that matters: until the replug, the end of the stall, …; how far for
    /// `time_backwards`.
    #[serde(default = "one_second")]
    pub duration_s: f64,
    /// How many frames of every stream, where that matters.
    #[serde(default = "one")]
    pub count: u32,
}

const fn one_second() -> f64 {
    1.0
}

const fn one() -> u32 {
    1
}

/// Kind of a fault of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum FaultKind {
    /// The cable is pulled, and plugged in again after `duration_s`; the device then starts afresh.
    Unplug,
    /// The device sends nothing for `duration_s`; the frames of that time are lost.
    Stall,
    /// The driver's call does not return for `duration_s`, as a stuck system call.
    Hang,
    /// `count` frames arrive with half of their bytes.
    HalfFrame,
    /// `count` frames arrive with more bytes than a frame has.
    WrongSize,
    /// `count` frames arrive flagged as damaged.
    Damaged,
    /// `count` frames arrive twice.
    Repeated,
    /// The device's clock jumps back by `duration_s`; its frame counter goes on.
    TimeBackwards,
    /// The device restarts clock and frame counter.
    ClockReset,
    /// The device loses `count` frames.
    Skip,
    /// Opening fails for `duration_s` because somebody else holds the device.
    OpenBusy,
}

impl FaultKind {
    /// Every fault.
    pub const ALL: [Self; 11] = [
        Self::Unplug,
        Self::Stall,
        Self::Hang,
        Self::HalfFrame,
        Self::WrongSize,
        Self::Damaged,
        Self::Repeated,
        Self::TimeBackwards,
        Self::ClockReset,
        Self::Skip,
        Self::OpenBusy,
    ];
}

impl SyntheticConfig {
    /// The serial number, made up when none is configured.
    pub fn serial_or_default(&self) -> String {
        if self.serial.is_empty() { format!("sim-{}", self.model) } else { self.serial.clone() }
    }

    /// Where the camera really is on the mount.
    pub(crate) fn true_pose(&self) -> Pose {
        self.board.as_ref().map_or(self.pose_on_mount, |b| self.pose_on_mount.compose(&b.displaced))
    }

    /// Poses of the mount, or of the arm, that are rendered: beside a board nothing but the board moves.
    pub(crate) const fn rendered_poses(&self) -> u32 {
        match self {
            Self { board: Some(_), .. } => 1,
            Self { arm: true, .. } => arm::POSES,
            _ => self.poses,
        }
    }

    /// The pose that is shown at `t`.
    pub(crate) fn pose_at(&self, world_start: HostTime, t: HostTime) -> u32 {
        if self.arm && self.board.is_none() {
            return Arm::pose_at(t);
        }
        motion::to_and_fro(motion::steps(world_start, t, self.pose_rate_hz), self.rendered_poses())
    }

    /// How messages name the camera.
    pub fn label(&self) -> String {
        format!("synthetic camera {} ({})", self.serial_or_default(), self.model)
    }

    /// Checks every number.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] naming the camera, the field and the bounds.
    pub fn validate(&self) -> Result<()> {
        let c = &self.clock;
        let pose = self.pose_on_mount.translation_m.iter().chain(&self.pose_on_mount.rotation_xyzw);
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite() && (0.0..1e9).contains(v));
        let problem = if !(1..=240).contains(&self.poses) {
            Some(format!("poses = {} is out of range 1..=240", self.poses))
        } else if !(self.pose_rate_hz > 0.0 && self.pose_rate_hz <= 1000.0) {
            Some(format!("pose_rate_hz = {} is out of range 0..=1000 (and above 0)", self.pose_rate_hz))
        } else if !(0.0..1.0).contains(&self.phase) {
            Some(format!("phase = {} is out of range 0..1 of a frame period", self.phase))
        } else if !pose.clone().all(|v| v.is_finite()) {
            Some("pose_on_mount has a value that is not finite".to_owned())
        } else if !(2..=1024).contains(&self.ring_frames) {
            Some(format!("ring_frames = {} is out of range 2..=1024", self.ring_frames))
        } else if !GAINS.contains(&self.gain) {
            let range = &GAINS;
            Some(format!("gain = {} is out of range {range:?}", self.gain))
        } else if !(16..=64).contains(&c.counter_bits) {
            Some(format!("clock.counter_bits = {} is out of range 16..=64", c.counter_bits))
        } else if !(c.drift_ppm.abs() <= 10_000.0 && c.thermal_ppm.abs() <= 10_000.0) {
            Some("clock.drift_ppm and clock.thermal_ppm must be within ±10000".to_owned())
        } else if !(c.thermal_period_s >= 1.0 && c.thermal_period_s.is_finite()) {
            Some(format!("clock.thermal_period_s = {} is below 1", c.thermal_period_s))
        } else if !finite(&[c.stamp_jitter_us, c.latency_ms, c.latency_jitter_ms, c.stall_ms.0, c.stall_ms.1])
        {
            Some("clock has a latency, jitter or stall that is negative or not a number".to_owned())
        } else if let Some(problem) = self.board.as_ref().and_then(BoardScene::problem) {
            Some(problem)
        } else if !(0.0..=1.0).contains(&c.stall_probability) || c.stall_ms.0 > c.stall_ms.1 {
            Some(
                "clock.stall_probability must be within 0..=1 and clock.stall_ms be [least, most]".to_owned(),
            )
        } else if !finite(&c.reset_at_s) {
            Some("clock.reset_at_s has a moment that is negative or not a number".to_owned())
        } else {
            self.faults.iter().find(|f| !finite(&[f.at_s, f.duration_s]) || f.count == 0).map(|f| {
                format!(
                    "fault {:?} at {} s: at_s and duration_s must be 0 or more, count 1 or more",
                    f.kind, f.at_s
                )
            })
        };
        match problem {
            None => Ok(()),
            Some(what) => Err(Error::new(ErrorKind::BadInput, format!("{}: {what}", self.label()))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn toml_maps_onto_it_and_unknown_keys_are_refused() {
        let text = r#"
            model = "d435"
            phase = 0.25
            pose_on_mount = { translation_m = [0.1, 0.0, 0.0], rotation_xyzw = [0.0, 0.0, 0.0, 1.0] }
            [clock]
            drift_ppm = 30.0
            [[streams]]
            stream = "depth"
            size = [848, 480]
            [[faults]]
            at_s = 2.0
            kind = "unplug"
        "#;
        let c: SyntheticConfig = toml::from_str(text).unwrap();
        c.validate().unwrap();
        assert_eq!((c.clock.drift_ppm, c.clock.counter_bits, c.poses), (30.0, 32, 12));
        assert_eq!(c.streams[0].size, Some((848, 480)));
        assert_eq!(
            (c.faults[0].kind, c.faults[0].duration_s, c.faults[0].count),
            (FaultKind::Unplug, 1.0, 1)
        );
        let e = toml::from_str::<SyntheticConfig>("modle = \"d435\"").unwrap_err();
        assert!(e.to_string().contains("unknown field `modle`"), "{e}");
        let e = toml::from_str::<SyntheticConfig>("[[faults]]\nat_s = 1.0\nkind = \"fire\"").unwrap_err();
        assert!(e.to_string().contains("unknown variant `fire`"), "{e}");
    }

    /// A change that makes a configuration invalid, and what the message must name.
    type Case = (fn(&mut SyntheticConfig), &'static str);

    #[test]
    fn each_impossible_number_is_named() {
        let cases: [Case; 9] = [
            (|c| c.poses = 0, "poses = 0"),
            (|c| c.pose_rate_hz = f64::NAN, "pose_rate_hz"),
            (|c| c.phase = 1.0, "phase = 1"),
            (|c| c.pose_on_mount.translation_m[1] = f64::INFINITY, "pose_on_mount"),
            (|c| c.ring_frames = 1, "ring_frames = 1"),
            (|c| c.clock.counter_bits = 8, "counter_bits = 8"),
            (|c| c.clock.drift_ppm = 1e6, "drift_ppm"),
            (|c| c.clock.stall_ms = (5.0, 1.0), "stall_ms"),
            (
                |c| {
                    c.faults.push(ScheduledFault {
                        at_s: -1.0,
                        kind: FaultKind::Hang,
                        duration_s: 1.0,
                        count: 1,
                    });
                },
                "Hang",
            ),
        ];
        for (change, named) in cases {
            let mut c = SyntheticConfig::default();
            c.validate().unwrap();
            change(&mut c);
            let e = c.validate().unwrap_err();
            assert!(e.to_string().contains(named) && e.to_string().contains("sim-generic"), "{e}");
            assert_eq!(e.kind(), ErrorKind::BadInput);
        }
    }
}
