//! The traits that every camera family implements, and what a device says of itself.

use crate::controls::ControlPanel;
use crate::{Error, ErrorKind, FrameSink, Result};
use core::time::Duration;
use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, PixelFormat, Pose, StreamName};
use std::sync::Weak;

/// A camera family: finds devices and opens them.
pub trait Backend: Send {
    /// The family's name as used in rig configurations: `synthetic`, `files`, …
    fn name(&self) -> &'static str;

    /// The devices that could be opened now.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] or [`ErrorKind::Io`] when the system cannot be asked.
    fn discover(&self) -> Result<Vec<DeviceInfo>>;

    /// Opens the device with the serial number `serial`; `None` means the only one there is.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] (also when `None` is ambiguous, naming the candidates), [`ErrorKind::Busy`],
    /// [`ErrorKind::PermissionDenied`], [`ErrorKind::BadInput`], [`ErrorKind::Io`].
    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>>;
}

/// An open camera that is not streaming.
pub trait Device: Send {
    /// Description of the device, as it reports it.
    fn info(&self) -> &DeviceInfo;

    /// Every stream mode the device can deliver.
    fn profiles(&self) -> &[StreamProfile];

    /// Starts the requested streams together; an empty request means the default mode of every stream.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] naming the modes there are, [`ErrorKind::Disconnected`],
    /// [`ErrorKind::Busy`], [`ErrorKind::Io`].
    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>>;
}

/// A streaming camera. Dropping it stops the device.
pub trait Stream: Send {
    /// The streams that are delivered; the index into this list is the `stream` of every [`FrameSink`] call.
    fn profiles(&self) -> &[StreamProfile];

    /// Waits at most `timeout` for the device, then hands every frame that is ready to `sink`.
    ///
    /// A driver returns within `timeout` plus what writing one frame takes. A device that makes it hang all
    /// the same is given up by [`crate::capture::Capture`].
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Protocol`], [`ErrorKind::Io`], [`ErrorKind::BadInput`]:
    /// after any of them the stream is unusable and must be dropped. A damaged frame is not an error but a
    /// counted drop.
    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll>;

    /// The controls that can be changed while it streams, as long as it does; `None` when the driver sets them at the start alone.
    fn controls(&self) -> Option<Weak<dyn ControlPanel>> {
        None
    }
}

/// Result of [`Stream::poll`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Poll {
    /// At least one frame came, delivered or dropped.
    Frame,
    /// Nothing came in time.
    Idle,
    /// The source is at its end and will deliver no more (recorded files that are not looped).
    End,
}

/// Description of a device, as it reports it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct DeviceInfo {
    /// Name of its [`Backend`].
    pub backend: &'static str,
    /// Model, such as `D435`.
    pub model: String,
    /// Serial number; distinguishes two cameras of a model.
    pub serial: String,
    /// Firmware version; empty if unknown.
    pub firmware: String,
    /// Where it is attached: USB port path, folder, …
    pub port: String,
    /// Where its calibration comes from: `factory`, `simulated`, `file …`, `none`.
    pub calibration: String,
    /// Whether its IMU's samples are corrected for bias and scale, and with which numbers, in words for a dataset;
    /// empty when it has no IMU or nothing is known.
    pub motion: String,
}

/// One stream mode: what the frames are and which clock stamps them.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamProfile {
    /// `color`, `depth`, …
    pub stream: StreamName,
    /// Pixel format.
    pub format: PixelFormat,
    /// Pixels per row; of an IMU the most samples of a batch.
    pub width: u32,
    /// Rows; 1 of an IMU.
    pub height: u32,
    /// Nominal frame rate; of an IMU full batches a second.
    pub rate_hz: f64,
    /// Metres per unit of depth; 0 when the pixels are not depth.
    pub depth_unit_m: f64,
    /// Intrinsics at this size.
    pub intrinsics: Intrinsics,
    /// Pose of this stream's optical frame in the device's frame.
    pub pose_in_device: Pose,
    /// The clock behind its time stamps.
    pub clock: DeviceClock,
    /// Width of the device's frame counter in bits.
    pub sequence_bits: u32,
    /// Source of the frames' times. Of a device that is not started it is the best that can be hoped for; the
    /// running stream knows what the kernel granted.
    pub metadata: MetadataLevel,
}

impl StreamProfile {
    /// Bytes of one frame; for MJPEG the most that one may have.
    pub const fn frame_bytes(&self) -> usize {
        self.format.frame_bytes(self.width, self.height)
    }

    /// Nominal time between two frames, nanoseconds.
    pub fn period_ns(&self) -> u64 {
        (1e9 / self.rate_hz).round() as u64
    }

    /// Most samples a second of an IMU.
    pub fn samples_hz(&self) -> f64 {
        self.rate_hz * f64::from(self.width)
    }

    /// `depth 1280x720 z16 30 Hz`, for messages; of an IMU `imu motion 200 Hz in batches of up to 8`.
    pub fn describe(&self) -> String {
        if self.format.is_motion() {
            return format!(
                "{} motion {} Hz in batches of up to {}",
                self.stream,
                self.samples_hz(),
                self.width
            );
        }
        format!("{} {} Hz", self.image(), self.rate_hz)
    }

    fn image(&self) -> String {
        format!("{} {}x{} {}", self.stream, self.width, self.height, self.format.name())
    }

    /// `depth 1280x720 z16 30, 15, 6 Hz; depth 848x480 z16 90 Hz`, for messages: modes that differ in their rate alone are one.
    pub fn describe_all<'a>(profiles: impl Iterator<Item = &'a Self>) -> String {
        let mut modes: Vec<(String, Vec<String>)> = Vec::new();
        for p in profiles {
            if p.format.is_motion() {
                modes.push((p.describe(), Vec::new()));
                continue;
            }
            let image = p.image();
            match modes.iter_mut().find(|(of, _)| *of == image) {
                Some((_, rates)) => rates.push(p.rate_hz.to_string()),
                None => modes.push((image, vec![p.rate_hz.to_string()])),
            }
        }
        let shown = |(of, rates): &(String, Vec<String>)| {
            if rates.is_empty() { of.clone() } else { format!("{of} {} Hz", rates.join(", ")) }
        };
        modes.iter().map(shown).collect::<Vec<_>>().join("; ")
    }
}

/// A device's clock as its counter presents it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DeviceClock {
    /// Width of the counter in bits.
    pub counter_bits: u32,
    /// Nanoseconds per tick, as picoseconds so that it stays exact.
    pub tick_ps: u64,
    /// [`ClockDomain::Device`] when the counter is the device's own; with the other domains the counter is
    /// host time in nanoseconds and is used as it is.
    pub domain: ClockDomain,
}

impl DeviceClock {
    /// A device counter of `counter_bits` bits that ticks every microsecond, as most cameras have.
    pub const fn microseconds(counter_bits: u32) -> Self {
        Self { counter_bits, tick_ps: 1_000_000, domain: ClockDomain::Device }
    }

    /// Nanoseconds per tick.
    pub const fn tick_ns(&self) -> f64 {
        self.tick_ps as f64 / 1000.0
    }
}

/// A wish for one stream; what is `None` is left to the device's default.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamRequest {
    /// Which stream.
    pub stream: StreamName,
    /// Width and height in pixels.
    pub size: Option<(u32, u32)>,
    /// Frame rate.
    pub rate_hz: Option<f64>,
    /// Pixel format.
    pub format: Option<PixelFormat>,
}

impl StreamRequest {
    /// A wish for `stream` in its default mode.
    pub const fn any(stream: StreamName) -> Self {
        Self { stream, size: None, rate_hz: None, format: None }
    }

    fn fits(&self, p: &StreamProfile) -> bool {
        self.stream == p.stream
            && self.size.is_none_or(|s| s == (p.width, p.height))
            && self.rate_hz.is_none_or(|r| (r - p.rate_hz).abs() < 0.01)
            && self.format.is_none_or(|f| f == p.format)
    }
}

/// Picks one profile for every request out of `available` (the first that fits is the default mode); an
/// empty request picks the first mode of every stream.
///
/// # Errors
/// [`ErrorKind::Unsupported`] naming `device` and the modes that the stream has.
pub fn choose_profiles(
    device: &str,
    available: &[StreamProfile],
    requests: &[StreamRequest],
) -> Result<Vec<StreamProfile>> {
    let mut chosen: Vec<StreamProfile> = Vec::new();
    if requests.is_empty() {
        for p in available {
            if chosen.iter().all(|c| c.stream != p.stream) {
                chosen.push(p.clone());
            }
        }
        return Ok(chosen);
    }
    for r in requests {
        let profile = available.iter().find(|p| r.fits(p)).ok_or_else(|| {
            let is_known = available.iter().any(|p| p.stream == r.stream);
            let shown = available.iter().filter(|p| !is_known || p.stream == r.stream);
            let modes = StreamProfile::describe_all(shown);
            let stream = &r.stream;
            Error::new(
                ErrorKind::Unsupported,
                format!("{device} has no such mode of \"{stream}\"; it has: {modes}"),
            )
        })?;
        if chosen.iter().any(|c| c.stream == profile.stream) {
            return Err(Error::new(
                ErrorKind::Unsupported,
                format!("{device}: stream \"{}\" was asked for twice", r.stream),
            ));
        }
        chosen.push(profile.clone());
    }
    Ok(chosen)
}
