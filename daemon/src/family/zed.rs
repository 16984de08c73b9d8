//! ZED (`zed`): one that is attached, or a recording of one (`input`). Limits that only the camera knows
//! (its modes, its controls) are checked when it is started.

use super::{
    BackendConfig, CameraSettings, Family, Found, Identified, ImuFiles, Offered, OpenContext, Probe, Reader,
    Selector, Source, hidraw,
};
use crate::config::read::Section;
use crate::config::value::{not_empty, rate, resolve, within};
use crate::config::{controls, stereo};
use depthrig_driver::motion::IMU;
use depthrig_driver::{Backend, Result, StreamRequest};
use depthrig_usb::UsbDevice;
use depthrig_zed::replay::{ZedPlaybackBackend, ZedPlaybackConfig};
use depthrig_zed::{CalibrationFile, STREAMS, ZedBackend, ZedConfig};
use std::path::PathBuf;

/// Keys that a camera that is attached has and a recording has not.
const LIVE_KEYS: [&str; 7] =
    ["port", "auto_exposure", "exposure_percent", "gain_percent", "led", "controls", "motion"];

const STEREOLABS: u16 = 0x2b03;
/// ZED 2i: camera, and the inertial sensor that hangs beside it on one hub (zed-open-capture `include/defines.hpp`).
const CAMERA: u16 = 0xf880;
const SENSORS: u16 = 0xf881;

pub(super) const FAMILY: Family = Family {
    has_stereo: true,
    has_ports: true,
    probe: Some(probe),
    identify,
    imu: ImuFiles::Hidraw,
    ..Family::new("zed", |r| Some(read(r)))
};

fn identify(d: &UsbDevice, all: &[UsbDevice]) -> Option<Identified> {
    if (d.vendor_id, d.product_id) != (STEREOLABS, CAMERA) {
        return None;
    }
    let hub = |port: &str| port.rsplit_once('.').map(|(hub, _)| without_bus(hub).to_owned());
    // The hub is one for USB2 and one for USB3, of the same ports below their buses.
    let beside = |other: &&UsbDevice| {
        (other.vendor_id, other.product_id) == (STEREOLABS, SENSORS) && hub(&other.port) == hub(&d.port)
    };
    let nodes = all.iter().filter(beside).chain([d]).flat_map(hidraw).collect();
    Some(Identified::Camera(Found { hidraw: nodes, ..Found::of("ZED 2i", d) }))
}

fn without_bus(port: &str) -> &str {
    port.split_once('-').map_or(port, |(_, ports)| ports)
}

fn read(r: &Reader<'_>) -> BackendConfig {
    let s = r.section;
    let depth = r.stereo;
    let path = |key| s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    let serial = s.or("serial", None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let calibration = match path("calibration") {
        None => CalibrationFile::Known,
        Some(none) if none.as_os_str() == "none" => CalibrationFile::None,
        Some(path) => CalibrationFile::At(resolve(r.base, &path)),
    };
    // A recording has the left and right images alone.
    let own: &[&str] = if s.has("input") { &STREAMS } else { &[STREAMS[0], STREAMS[1], IMU] };
    stereo::check_streams(s, "a ZED", own, depth, r.streams);
    if depth.is_some() && calibration == CalibrationFile::None {
        let why = "stereo needs the factory calibration; remove calibration = \"none\", or [camera.stereo]";
        s.problem(s.at_key("calibration"), why);
    }
    if let Some(input) = path("input") {
        for key in LIVE_KEYS.into_iter().filter(|k| s.has(k)) {
            s.problem(
                s.at_key(key),
                format!(
                    "{} is for a camera that is attached, and input plays a recording; keep one",
                    s.key_of(key)
                ),
            );
        }
        return BackendConfig::new(ZedPlaybackConfig {
            input: resolve(r.base, &input),
            serial,
            calibration,
            rate_hz: s.or("rate_hz", None, |r| r.map_or(Ok(()), rate)),
            looped: s.or("loop", false, |_| Ok(())),
        });
    }
    if depth.is_some_and(|d| d.every_pair) {
        s.problem(
            s.at,
            "[camera.stereo] every_pair = true is for a recording (input): a camera does not wait",
        );
    }
    BackendConfig::new(live(s, serial, calibration))
}

fn live(s: &Section<'_, '_>, serial: Option<String>, calibration: CalibrationFile) -> ZedConfig {
    let percent = |key| s.or(key, None, |p: &Option<u8>| p.as_ref().map_or(Ok(()), within(0..=100)));
    let flag = |key| s.get::<bool>(key).map(|f| f.value);
    let config = ZedConfig {
        serial,
        port: s.or("port", None, |t: &Option<String>| controls::not_blank(t.as_deref())),
        calibration,
        auto_exposure: flag("auto_exposure"),
        exposure_percent: percent("exposure_percent"),
        gain_percent: percent("gain_percent"),
        led: flag("led"),
        controls: controls::read(s, "controls", "controls = { }"),
        without_motion: flag("motion") == Some(false),
    };
    if config.auto_exposure == Some(true) {
        let set = [config.exposure_percent.is_some(), config.gain_percent.is_some()];
        for (key, _) in ["exposure_percent", "gain_percent"].into_iter().zip(set).filter(|(_, set)| *set) {
            let why = "cannot be set while auto_exposure is true; keep one";
            s.problem(s.at_key(key), format!("{} {why}", s.key_of(key)));
        }
    }
    config
}

fn probe(p: &Probe<'_>) -> Box<dyn Backend> {
    Box::new(ZedBackend::new(ZedConfig { port: Some(p.port.to_owned()), ..ZedConfig::default() }))
}

impl CameraSettings for ZedConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(ZedBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        let serial = self.serial.as_deref();
        let port = self.port.as_deref();
        Source::Attached(Selector { serial, port, ..Selector::default() })
    }
}

impl CameraSettings for ZedPlaybackConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(ZedPlaybackBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        Source::Here(ZedPlaybackBackend::new(self.clone()).open(None).map(|device| Offered {
            device: format!("recording {}", device.info().port),
            profiles: device.profiles().to_vec(),
        }))
    }

    fn fastest_rate_hz(&self, _: &[StreamRequest]) -> Option<f64> {
        self.rate_hz
    }

    fn reads_files(&self) -> bool {
        true
    }
}
