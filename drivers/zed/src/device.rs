//! Finding and opening a camera, and starting it.

use super::command::Vendor;
use super::conf::{FactoryCalibration, how_to_get, known_paths};
use super::find::{self, FoundCamera};
use super::hid::HidNode;
use super::mode::Side;
use super::motion::{Motion, Sample};
use super::stream::ZedStream;
use super::{CalibrationFile, ZedConfig, imu, profiles, settings};
use depthrig_bus::{ClockDomain, MetadataLevel};
use depthrig_driver::motion::IMU;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest,
};
use depthrig_usb::holder::holders_of;
use depthrig_usb::{SysRoot, scan};
use depthrig_v4l2::{DEFAULT_BUFFERS, FourCc, Mode, Node, Source, Stamp, Wanted};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};

mod unit;

/// Begins what is said of a calibration that was loaded.
const FACTORY: &str = "factory ";

/// The backend `zed`.
#[derive(Debug, Clone, Default)]
pub struct ZedBackend {
    config: ZedConfig,
    root: SysRoot,
}

impl ZedBackend {
    /// A backend for the camera that `config` selects.
    pub fn new(config: ZedConfig) -> Self {
        Self { config, root: SysRoot::default() }
    }

    /// The same, for a tree of `/sys` and `/dev` that is somewhere else.
    #[must_use]
    pub fn with_root(mut self, root: SysRoot) -> Self {
        self.root = root;
        self
    }

    fn found(&self) -> Result<Vec<FoundCamera>> {
        Ok(find::cameras(&self.root, &scan(&self.root)?))
    }
}

impl Backend for ZedBackend {
    fn name(&self) -> &'static str {
        "zed"
    }

    /// Every ZED that is attached. One whose IMU is not seen is asked for its serial number; where that fails,
    /// the number is left empty.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let info = |f: FoundCamera| {
            let serial = f.serial().map_or_else(|| flash_serial(&f).unwrap_or_default(), str::to_owned);
            let calibration = calibration(&self.config.calibration, &serial)
                .map_or_else(|e| format!("unusable: {e}"), |(_, source)| source);
            info(&f, serial, calibration)
        };
        Ok(self.found()?.into_iter().map(info).collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        settings::check(&self.config)?;
        let serial = serial.or(self.config.serial.as_deref());
        let candidates = find::candidates(self.found()?, self.config.port.as_deref(), serial)?.into_iter();
        // Where the number is known, there is one candidate. Else each is asked, and the last one's error is said.
        let mut last = None;
        for found in candidates {
            match ZedDevice::open(found, &self.config, &self.root) {
                Ok(device) if serial.is_none_or(|s| s == device.info.serial) => return Ok(Box::new(device)),
                Ok(other) => {
                    let what =
                        format!("there is no ZED with the serial number asked for, only {}", other.name());
                    last = Some(Error::new(ErrorKind::NotFound, what));
                }
                Err(e) => last = Some(e),
            }
        }
        Err(last.unwrap_or_else(|| Error::new(ErrorKind::NotFound, "there is no ZED")))
    }
}

/// An open camera.
struct ZedDevice {
    info: DeviceInfo,
    node: Node,
    modes: Vec<Mode>,
    profiles: Vec<StreamProfile>,
    /// The IMU, or why it cannot be read.
    unit: Result<HidNode>,
    config: ZedConfig,
    root: SysRoot,
}

impl ZedDevice {
    fn open(mut found: FoundCamera, config: &ZedConfig, root: &SysRoot) -> Result<Self> {
        let node = capture_node(&found)?;
        let serial = match vendor(node.path(), &found.describe()).and_then(|mut v| v.serial()) {
            Ok(flash) => flash,
            Err(e) => match found.serial() {
                Some(unit) => {
                    tracing::warn!(error = %e, serial = unit, "the ZED's flash gives no serial number; its IMU does");
                    unit.to_owned()
                }
                None => return Err(e),
            },
        };
        let unit = unit::open(&mut found, &serial, config.without_motion, root);
        let (calibration, source) = calibration(&config.calibration, &serial)?;
        let name = find::describe(found.model.name, &serial, &found.video.port);
        if calibration.is_none() && config.calibration == CalibrationFile::Known {
            tracing::warn!(
                camera = name,
                cure = how_to_get(&serial),
                "no factory calibration; it streams without"
            );
        }
        if found.video.speed_mbps > 0 && found.video.speed_mbps < 5000 {
            tracing::warn!(
                camera = name,
                mbps = found.video.speed_mbps,
                "the ZED is not on USB 3 and has few modes"
            );
        }
        let modes = node.modes(|f| f == FourCc(*b"YUYV"))?;
        let mut profiles = profiles::profiles(&name, &modes, calibration.as_ref())?;
        match &unit {
            Ok(_) => profiles.push(imu::profile()?),
            Err(_) if config.without_motion || found.model.motion.is_none() => {}
            Err(e) => tracing::warn!(camera = name, error = %e, "the IMU is not read"),
        }
        let info = info(&found, serial, source);
        Ok(Self { info, node, modes, profiles, unit, config: config.clone(), root: root.clone() })
    }

    fn name(&self) -> String {
        find::describe(&self.info.model, &self.info.serial, &self.info.port)
    }
}

impl Device for ZedDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let name = self.name();
        let Self { node, modes, profiles, unit, config, root, .. } = *self;
        if let (Some(_), Err(e)) = (requests.iter().find(|r| r.stream.as_str() == IMU), &unit) {
            return Err(Error::new(e.kind(), format!("{name}: there is no stream \"{IMU}\": {e}")));
        }
        let chosen = profiles::choose(&name, &profiles, requests)?;
        let (imu, mut halves): (Vec<_>, Vec<_>) = chosen.into_iter().partition(|p| p.format.is_motion());
        let imu = imu.into_iter().next();
        let Some(half) = halves.first() else {
            let (Some(motion), Some((profile, samples))) = start_unit(&name, unit, imu)? else {
                return Err(Error::new(ErrorKind::Unsupported, format!("{name}: no stream was asked for")));
            };
            return Ok(Box::new(ZedStream::without_images(name, motion).with_imu(profile, samples)));
        };
        let Some(mode) = modes.iter().find(|m| is_mode_of(m, half)) else {
            return Err(Error::new(ErrorKind::Unsupported, format!("{name}: has no {}", half.describe())));
        };
        let path = node.path().to_owned();
        let named = |e: Error| named(&name, &root, &path, e);
        settings::apply_controls(&node, &config).map_err(named)?;
        let layout = node.set_mode(mode).map_err(named)?;
        // Nothing is asked of the camera on this thread once it streams.
        let vendor = settings::has_commands(&config).then(|| vendor(&path, &name)).transpose()?;
        // Only once the images are ours: the process that has them has the IMU too.
        let (motion, imu) = start_unit(&name, unit, imu)?;
        let stride = (layout.bytes_per_line as usize).max(2 * mode.width as usize);
        let images = Source::start(vec![Wanted::plain(node)], DEFAULT_BUFFERS).map_err(named)?;
        if images.stamp(0) == Stamp::Unknown {
            for p in &mut halves {
                (p.clock, p.metadata) = (profiles::clock(ClockDomain::Arrival), MetadataLevel::Arrival);
            }
        }
        let settled = vendor.map(|v| settle(&name, v, &config, mode)).transpose()?;
        let halves = halves.into_iter().map(|p| (side_of(&p), p)).collect();
        let stream = ZedStream::new(name, halves, Box::new(images), stride, motion, settled);
        Ok(Box::new(match imu {
            Some((profile, samples)) => stream.with_imu(profile, samples),
            None => stream,
        }))
    }
}

fn is_mode_of(mode: &Mode, profile: &StreamProfile) -> bool {
    (mode.width, mode.height) == (2 * profile.width, profile.height)
        && (mode.interval.rate_hz() - profile.rate_hz).abs() < 0.01
}

fn side_of(profile: &StreamProfile) -> Side {
    if profile.stream.as_str() == profiles::STREAMS[1] { Side::Right } else { Side::Left }
}

fn info(found: &FoundCamera, serial: String, mut calibration: String) -> DeviceInfo {
    if calibration.starts_with(FACTORY) && found.model.motion.is_some() {
        calibration += imu::NO_POSE;
    }
    DeviceInfo {
        backend: "zed",
        model: found.model.name.to_owned(),
        serial,
        firmware: found.firmware(),
        port: found.video.port.clone(),
        calibration,
        motion: found.model.motion.map_or_else(String::new, |_| imu::NOT_CORRECTED.to_owned()),
    }
}

/// The node that images come from; the video half has a metadata node as well.
fn capture_node(found: &FoundCamera) -> Result<Node> {
    let mut last = None;
    for n in found.video.video_nodes() {
        match Node::open(&n.path) {
            Ok(node) if node.capability().is_capture() => return Ok(node),
            Ok(_) => {}
            Err(e) => last = Some(e),
        }
    }
    Err(last.map_or_else(
        || {
            let what = format!(
                "{} has no video node; is the kernel's uvcvideo loaded, or does a program hold it through libusb?",
                found.describe()
            );
            Error::new(ErrorKind::NotFound, what)
        },
        |e| Error::new(e.kind(), format!("{}: {e}", found.describe())).with_source(e),
    ))
}

/// Opens the vendor commands on a node of their own, apart from the one that captures.
fn vendor(path: &Path, device: &str) -> Result<Vendor<Node>> {
    Vendor::new(Node::open(path)?, device)
}

fn flash_serial(found: &FoundCamera) -> Result<String> {
    vendor(capture_node(found)?.path(), &found.describe())?.serial()
}

/// The calibration and where it comes from, for [`DeviceInfo::calibration`].
fn calibration(wanted: &CalibrationFile, serial: &str) -> Result<(Option<FactoryCalibration>, String)> {
    let none = || (None, "none".to_owned());
    let path = match wanted {
        CalibrationFile::None => return Ok(none()),
        CalibrationFile::At(path) => path.clone(),
        CalibrationFile::Known => {
            let home = std::env::var_os("HOME").map(PathBuf::from);
            match known_paths(serial, home.as_deref()).into_iter().find(|p| p.exists()) {
                Some(path) => path,
                None => return Ok(none()),
            }
        }
    };
    let name = path.file_stem().unwrap_or_default().to_string_lossy();
    if let Some(of) =
        name.strip_prefix("SN").filter(|of| !of.is_empty() && of.bytes().all(|c| c.is_ascii_digit()))
        && of.trim_start_matches('0') != serial.trim_start_matches('0')
    {
        let what = format!(
            "{} is the calibration of the camera {of}, and this one is {serial}: {}",
            path.display(),
            how_to_get(serial)
        );
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    let loaded = FactoryCalibration::load(&path).map_err(|e| {
        // A file that the rig names is part of its configuration: trying again does not make it appear.
        let what = format!("{e}; {}", how_to_get(serial));
        Error::new(ErrorKind::BadInput, what).with_source(e)
    })?;
    Ok((Some(loaded), format!("{FACTORY}{}", path.display())))
}

/// Sets the camera on a thread of its own, after it began to stream, because starting may reset it and because
/// each command may take seconds. The thread is not waited for; it ends by itself.
fn settle(
    name: &str,
    mut vendor: Vendor<Node>,
    config: &ZedConfig,
    mode: &Mode,
) -> Result<Receiver<Result<()>>> {
    let (send, receive) = sync_channel(1);
    let config = config.clone();
    let rate_hz = mode.interval.rate_hz();
    std::thread::Builder::new()
        .name("zed-settings".to_owned())
        .spawn(move || {
            // The receiver is gone if the stream ended first.
            let _ = send.send(settings::apply(&mut vendor, &config, rate_hz));
        })
        .map_err(|e| {
            Error::new(ErrorKind::Io, format!("{name}: no thread for its settings")).with_source(e)
        })?;
    Ok(receive)
}

/// Starts the IMU: with a queue of its samples when `imu` is delivered, else for the temperatures alone, without
/// which the camera is as good.
#[allow(clippy::type_complexity)] // a stream and what feeds it
fn start_unit(
    name: &str,
    unit: Result<HidNode>,
    imu: Option<StreamProfile>,
) -> Result<(Option<Motion>, Option<(StreamProfile, Receiver<Sample>)>)> {
    let Ok(hid) = unit else { return Ok((None, None)) };
    if let Some(profile) = imu {
        let (motion, samples) = Motion::start_streaming(Box::new(hid), name)?;
        return Ok((Some(motion), Some((profile, samples))));
    }
    let started = Motion::start(Box::new(hid), name);
    let warn = |e: &Error| tracing::warn!(camera = name, error = %e, "the IMU is not read");
    Ok((started.inspect_err(warn).ok(), None))
}

/// The error with the camera's name, and for a camera that is held with that of the holder.
fn named(name: &str, root: &SysRoot, node: &Path, e: Error) -> Error {
    let held = match e.kind() {
        ErrorKind::Busy => format!("; it is held by {}", holders_of(root, node).describe()),
        _ => String::new(),
    };
    Error::new(e.kind(), format!("{name}: {e}{held}")).with_source(e)
}

#[cfg(test)]
mod tests;
