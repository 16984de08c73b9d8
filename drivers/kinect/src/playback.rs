//! Plays an Azure Kinect `.mkv` as a camera: at the rate of its own clock, once or in a loop.
//!
//! **Streams** are `color`, `depth` (Z16, millimetres) and `ir` (16-bit grey), as of the camera itself. Colour recorded
//! as JPEG is decoded to `rgb8`, or kept as `mjpeg` where that is asked for; NV12 and YUY2 stay what they are; of BGRA
//! the unused byte is left out. Depth and infrared are written once, with their bytes swapped, into the receiver's
//! memory. Decoding has threads and a reader of its own, which are a few images ahead. An IMU track is the stream
//! `imu` ([`super::motion`]), played by the same clock.
//!
//! **Time.** Frames carry the device's clock of the recording, microseconds at mid-exposure, and come when that clock
//! says, counted from the first; so capture times have the spacing of the recording. The file has no frame counter:
//! numbers are derived from those times, so that frames the recorder lost are counted as lost. At another
//! [`rate`](PlaybackConfig::rate) the clock is stretched. Each further round of a loop follows the last frame by a
//! period, and the clock goes on.

use super::calibration::Calibration;
use super::modes::WiredSync;
use super::recording::{Facts, Pixels, Recording, Track, TrackKind};
use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, Name, PixelFormat, Pose};
use depthrig_driver::{
    Backend, Device, DeviceClock, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest,
    choose_profiles,
};
use std::path::{Path, PathBuf};

mod ahead;
mod cursor;
mod play;

/// The period of tracks that do not say theirs: 30 Hz.
const PERIOD_NS: u64 = 33_333_333;
/// A lens that the intrinsics miss by more than this is worth a warning, pixels.
const APPROXIMATE_PX: f64 = 0.05;

/// Which calibration goes with a recording.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum CalibrationSource {
    /// The one that is attached to it; without one it is refused.
    #[default]
    Recorded,
    /// The one in a file of its own.
    At(PathBuf),
    /// None: intrinsics are unknown.
    None,
}

impl CalibrationSource {
    /// The calibration of `recording`; `None` if none is requested.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] if it is missing or invalid; those of reading a file.
    pub fn load(&self, recording: &Recording) -> Result<Option<Calibration>> {
        match self {
            Self::None => Ok(None),
            Self::Recorded => recording.calibration().map(Some),
            Self::At(path) => {
                let failed = |e: std::io::Error| {
                    let kind = if e.kind() == std::io::ErrorKind::NotFound {
                        ErrorKind::NotFound
                    } else {
                        ErrorKind::Io
                    };
                    let what = format!("the Kinect's calibration {} cannot be read: {e}", path.display());
                    Error::new(kind, what).with_source(e)
                };
                let text =
                    depthrig_bus::files::read(path, depthrig_bus::files::TEXT_MAX_BYTES).map_err(failed)?;
                let named =
                    |e: Error| Error::new(e.kind(), format!("{}: {e}", path.display())).with_source(e);
                Calibration::parse(&text).map(Some).map_err(named)
            }
        }
    }
}

/// Which recording to play, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaybackConfig {
    /// The `.mkv` file.
    pub recording: PathBuf,
    /// Begin again at the end.
    pub looped: bool,
    /// Seconds of the recording per second: above 0. Infinite: as fast as frames are taken; frames then carry the
    /// time at which they were, and no device clock.
    pub rate: f64,
    /// Its calibration.
    pub calibration: CalibrationSource,
}

impl PlaybackConfig {
    /// Plays `recording` once at its own rate.
    pub fn new(recording: impl Into<PathBuf>) -> Self {
        let calibration = CalibrationSource::Recorded;
        Self { recording: recording.into(), looped: false, rate: 1.0, calibration }
    }

    fn is_paced(&self) -> bool {
        self.rate.is_finite()
    }
}

/// The streams of a recording at its own rates, as they are recorded: JPEG stays JPEG.
///
/// # Errors
/// None that can happen: the names are good ones.
pub fn recorded_profiles(
    facts: &Facts,
    calibration: Option<&Calibration>,
) -> Result<Vec<(usize, StreamProfile)>> {
    let all = profiles(facts, calibration, 1.0)?;
    let is_stored = |p: &StreamProfile| p.format != PixelFormat::Rgb8 && !p.format.is_motion();
    Ok(all.into_iter().filter(|(_, p)| is_stored(p)).collect())
}

/// The IMU of a recording with its track, if it has one.
///
/// # Errors
/// None that can happen: the name is a good one.
pub fn recorded_motion(
    facts: &Facts,
    calibration: Option<&Calibration>,
) -> Result<Option<(usize, StreamProfile)>> {
    let all = profiles(facts, calibration, 1.0)?;
    Ok(all.into_iter().find(|(_, p)| p.format.is_motion()))
}

/// Every way in which the streams of a recording can be delivered, that of the default first, with their tracks.
fn profiles(
    facts: &Facts,
    calibration: Option<&Calibration>,
    rate: f64,
) -> Result<Vec<(usize, StreamProfile)>> {
    let mut all = Vec::new();
    for (i, track) in facts.tracks.iter().enumerate() {
        if track.kind == TrackKind::Motion {
            let clock = DeviceClock::microseconds(64);
            all.push((i, super::motion::profile(calibration, rate, clock, MetadataLevel::Full)?));
            continue;
        }
        let (name, formats): (_, &[PixelFormat]) = match (track.kind, track.pixels) {
            (TrackKind::Color, Some(Pixels::Mjpg)) => ("color", &[PixelFormat::Rgb8, PixelFormat::Mjpeg]),
            (TrackKind::Color, Some(Pixels::Nv12)) => ("color", &[PixelFormat::Nv12]),
            (TrackKind::Color, Some(Pixels::Yuy2)) => ("color", &[PixelFormat::Yuyv]),
            (TrackKind::Color, Some(Pixels::Bgra)) => ("color", &[PixelFormat::Bgr8]),
            (TrackKind::Depth, Some(_)) => ("depth", &[PixelFormat::Z16]),
            (TrackKind::Infrared, Some(_)) => ("ir", &[PixelFormat::Mono16]),
            _ => continue,
        };
        let (intrinsics, pose) = geometry(facts, track, calibration);
        for format in formats {
            let stream = Name::new(name)
                .map_err(|e| Error::new(ErrorKind::BadInput, format!("stream {name}")).with_source(e))?;
            let rate_hz = 1e9 / track.period_ns.unwrap_or(PERIOD_NS) as f64;
            all.push((
                i,
                StreamProfile {
                    stream,
                    format: *format,
                    width: track.width,
                    height: track.height,
                    rate_hz: (rate_hz * rate * 100.0).round().max(1.0) / 100.0,
                    depth_unit_m: if format.is_depth() { 0.001 } else { 0.0 },
                    intrinsics,
                    pose_in_device: pose,
                    clock: DeviceClock::microseconds(64),
                    // Reckoned from the device's times.
                    sequence_bits: 64,
                    metadata: MetadataLevel::Full,
                },
            ));
        }
    }
    Ok(all)
}

/// Intrinsics and pose of a track. Colour of a size that Kinects do not have has none: which part of the sensor it
/// shows is unknown.
fn geometry(facts: &Facts, track: &Track, calibration: Option<&Calibration>) -> (Intrinsics, Pose) {
    let Some(c) = calibration else { return (Intrinsics::default(), Pose::IDENTITY) };
    if track.kind == TrackKind::Color {
        let resolution = super::ColorResolution::from_size(track.width, track.height);
        (resolution.map(|r| c.color_intrinsics(r)).unwrap_or_default(), c.color_in_device())
    } else {
        (facts.depth_mode.map(|m| c.depth_intrinsics(m)).unwrap_or_default(), c.depth_in_device())
    }
}

/// A recording as the camera of a rig.
#[derive(Debug, Clone)]
pub struct PlaybackBackend {
    config: PlaybackConfig,
}

impl PlaybackBackend {
    /// A backend for the one recording of `config`. Nothing is read before it is opened.
    pub const fn new(config: PlaybackConfig) -> Self {
        Self { config }
    }

    fn load(&self) -> Result<RecordedDevice> {
        let config = self.config.clone();
        if config.rate.is_nan() || config.rate <= 0.0 {
            let what = format!("invalid rate {}; choose one above 0", config.rate);
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        let recording = Recording::open(&config.recording)?;
        let calibration = config.calibration.load(&recording)?;
        let facts = recording.facts();
        if let Some(c) = &calibration {
            let off = c.approximation_px(facts.depth_mode, facts.color_mode.map(|m| m.resolution));
            if off > APPROXIMATE_PX {
                let name = config.recording.display();
                tracing::warn!(
                    "{name}: the prototype's lens is not expressed exactly; pixels are off by up to {off:.2}"
                );
            }
        }
        let rate = if config.is_paced() { config.rate } else { 1.0 };
        let mut all = profiles(facts, calibration.as_ref(), rate)?;
        if !config.is_paced() {
            let clock = DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel };
            for (_, p) in &mut all {
                (p.clock, p.metadata) = (clock, MetadataLevel::Kernel);
            }
        }
        let profiles = all.iter().map(|(_, p)| p.clone()).collect();
        let mut info = info(facts, &config);
        info.calibration = super::motion::stated(&info.calibration, calibration.as_ref());
        Ok(RecordedDevice { info, all, profiles, recording, config })
    }
}

/// The device as the recording describes it.
fn info(facts: &Facts, config: &PlaybackConfig) -> DeviceInfo {
    let place = std::fs::canonicalize(&config.recording).unwrap_or_else(|_| config.recording.clone());
    let firmware = match (facts.color_firmware.as_str(), facts.depth_firmware.as_str()) {
        ("", "") => String::new(),
        (color, depth) => format!("color {color}, depth {depth}"),
    };
    DeviceInfo {
        backend: super::NAME,
        model: "Azure Kinect".to_owned(),
        serial: serial(facts, &place),
        firmware,
        port: place.display().to_string(),
        calibration: match &config.calibration {
            CalibrationSource::Recorded => "factory".to_owned(),
            CalibrationSource::At(path) => format!("file {}", path.display()),
            CalibrationSource::None => "none".to_owned(),
        },
        motion: super::motion::CORRECTED.to_owned(),
    }
}

/// The serial number of a recording's device; without one in the file, the file's name, so that two recordings differ.
pub fn serial(facts: &Facts, path: &Path) -> String {
    let named = || path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    if facts.serial.is_empty() { named() } else { facts.serial.clone() }
}

impl Backend for PlaybackBackend {
    fn name(&self) -> &'static str {
        super::NAME
    }

    /// The one camera, opened as it would be played.
    ///
    /// # Errors
    /// Those of [`Self::open`]: a recording that was named and cannot be played is worth saying.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        Ok(vec![self.load()?.info])
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let device = self.load()?;
        match serial {
            Some(wanted) if wanted != device.info.serial => Err(Error::new(
                ErrorKind::NotFound,
                format!(
                    "{} is of the Kinect with serial number \"{}\", not \"{wanted}\"",
                    device.info.port, device.info.serial
                ),
            )),
            _ => Ok(Box::new(device)),
        }
    }
}

/// A recording that was opened and is ready to play.
struct RecordedDevice {
    info: DeviceInfo,
    /// Tracks and how they can be delivered.
    all: Vec<(usize, StreamProfile)>,
    profiles: Vec<StreamProfile>,
    recording: Recording,
    config: PlaybackConfig,
}

impl Device for RecordedDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let name = format!("Kinect {} ({})", self.info.serial, self.info.port);
        let chosen = choose_profiles(&name, &self.profiles, requests)?;
        let tracks =
            chosen.iter().filter_map(|p| self.all.iter().find(|(_, a)| a == p).map(|(track, _)| *track));
        let tracks = tracks.collect::<Vec<_>>();
        let is_triggered = self.recording.facts().wired_sync == WiredSync::Subordinate;
        let Self { recording, config, .. } = *self;
        Ok(Box::new(play::Player::new(name, chosen, &tracks, is_triggered, recording, &config)?))
    }
}
