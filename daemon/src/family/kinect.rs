//! Azure Kinect (`kinect`), attached or recorded. Limits that only the camera knows (the range of its controls, its jacks)
//! are checked when it is started.

mod requirements;

pub(crate) use requirements::Facts;

use super::{
    BackendConfig, CameraSettings, Family, Found, Identified, Offered, OpenContext, Probe, Reader, Selector,
    Source, Unmet,
};
use crate::config::controls;
use crate::config::read::Section;
use crate::config::value::{not_empty, resolve, within};
use crate::config::wanted::WantedStream;
use core::ops::RangeInclusive;
use depthrig_driver::{Backend, Result, StreamProfile, StreamRequest};
use depthrig_kinect::live::{
    self, CONTROLS, LiveBackend, LiveConfig, Places, STREAMS, check_libraries, find,
};
use depthrig_kinect::playback::{CalibrationSource, PlaybackBackend, PlaybackConfig};
use depthrig_kinect::{DepthMode, NAME, WiredSync};
use depthrig_usb::UsbDevice;
use std::path::{Path, PathBuf};

/// The longest period of images, microseconds; at a faster rate the camera is refused when it is started.
const LONGEST_PERIOD_US: i32 = 200_000;

/// How fast a recording may play, seconds of it per second.
const RATES: RangeInclusive<f64> = 0.05..=20.0;

/// Kernel memory that a Kinect's USB transfers take: libk4a keeps up to 10 MB for depth (`usbstreaming.c`), and
/// colour has its own; one camera gets by with the kernel's 16 MB, two need 32 (Azure-Kinect-Sensor-SDK issue 485).
pub(crate) const TRANSFERS: u64 = 16 << 20;

pub(super) const FAMILY: Family =
    Family { has_ports: true, probe: Some(probe), identify, ..Family::new(NAME, |r| Some(read(r))) };

/// The halves of a Kinect are one camera, which goes by its depth half.
fn identify(d: &UsbDevice, all: &[UsbDevice]) -> Option<Identified> {
    if d.vendor_id != find::VENDOR {
        return None;
    }
    let cameras = find::cameras(all);
    if let Some(found) = cameras.iter().find(|k| k.depth == *d) {
        let color = found.color.as_ref();
        return Some(Identified::Camera(Found {
            model: find::MODEL.to_owned(),
            nodes: color.into_iter().flat_map(|d| d.video_nodes().cloned()).collect(),
            serial: found.serial().map(str::to_owned),
            problem: color.is_none().then(|| {
                "its colour camera is not on the bus, without which libk4a does not open it: plug it in again, with its \
                 power supply"
                    .to_owned()
            }),
            ..Found::default()
        }));
    }
    if cameras.iter().any(|k| k.color.as_ref() == Some(d)) {
        return Some(Identified::Part);
    }
    (d.product_id == find::COLOR).then_some(Identified::Unusable(
        "it is an Azure Kinect whose depth camera is not on the bus: plug it in again, with its power supply",
    ))
}

fn read(r: &Reader<'_>) -> BackendConfig {
    let s = r.section;
    r.check_streams("a Kinect", &STREAMS);
    if s.has("recording") {
        return BackendConfig::new(recorded(s, r.base));
    }
    BackendConfig::new(attached(s, r.base, r.streams))
}

/// A recording that plays: its device is not asked for anything.
fn recorded(s: &Section<'_, '_>, base: &Path) -> PlaybackConfig {
    let path = |key| s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    PlaybackConfig {
        recording: path("recording").map(|p| resolve(base, &p)).unwrap_or_default(),
        looped: s.get::<bool>("loop").is_some_and(|looped| looped.value),
        rate: s.or("rate", 1.0, within(RATES)),
        calibration: match path("calibration") {
            None => CalibrationSource::Recorded,
            Some(none) if none.as_os_str() == "none" => CalibrationSource::None,
            Some(path) => CalibrationSource::At(resolve(base, &path)),
        },
    }
}

/// A camera that is attached.
fn attached(s: &Section<'_, '_>, base: &Path, streams: &[WantedStream]) -> LiveConfig {
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let path = |key| {
        let path = s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
        path.map(|p| resolve(base, &p))
    };
    let config = LiveConfig {
        serial: text("serial"),
        port: text("port"),
        places: Places { library: path("library"), engine: path("depth_engine") },
        depth_mode: s.choose("depth_mode", &DepthMode::ALL.map(|m| (m.name(), m))),
        sync: s.choice("sync", &WiredSync::ALL.map(|m| (m.name(), m)), WiredSync::Standalone),
        subordinate_delay_us: s.or("subordinate_delay_us", 0, within(0..=LONGEST_PERIOD_US as u32)),
        depth_delay_us: s.or("depth_delay_us", 0, within(-LONGEST_PERIOD_US..=LONGEST_PERIOD_US)),
        color_controls: controls::read(s, "color_controls", "color_controls = { }"),
        dark: s.get::<bool>("led").is_some_and(|led| !led.value),
    };
    if config.subordinate_delay_us != 0 && config.sync != WiredSync::Subordinate {
        let why = "is set, but only sync = \"subordinate\" has it";
        s.problem(s.at_key("subordinate_delay_us"), format!("{} {why}", s.key_of("subordinate_delay_us")));
    }
    let known = |name: &String| CONTROLS.iter().any(|(n, _)| n == name);
    if let Some(name) = config.color_controls.keys().find(|name| !known(name)) {
        let names: Vec<_> = CONTROLS.iter().map(|(name, _)| *name).collect();
        let why = format!("has \"{name}\", which a Kinect has not; it has: {}", names.join(", "));
        s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
    }
    let asks =
        |stream: &str| streams.is_empty() || streams.iter().any(|w| w.request.stream.as_str() == stream);
    if !config.color_controls.is_empty() && !asks("color") {
        let why = "is set, but color is not among the streams of its [[camera.stream]] tables";
        s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
    }
    if config.depth_mode == Some(DepthMode::PassiveIr)
        && let Some(depth) = streams.iter().find(|w| w.request.stream.as_str() == "depth")
    {
        s.problem(depth.at, "depth_mode = \"passive_ir\" gives no depth; ask for ir");
    }
    config
}

fn probe(p: &Probe<'_>) -> Box<dyn Backend> {
    // Libraries are those that the rig's first Kinect names.
    let named = p.rig.iter().find_map(|c| c.settings::<LiveConfig>());
    let places = named.map(|live| live.places.clone()).unwrap_or_default();
    let config = LiveConfig { port: Some(p.port.to_owned()), places, ..LiveConfig::default() };
    Box::new(LiveBackend::new(config).with_root(p.root.clone()))
}

impl CameraSettings for LiveConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(LiveBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        let serial = self.serial.as_deref();
        let port = self.port.as_deref();
        Source::Attached(Selector { serial, port, transfer_bytes: TRANSFERS, ..Selector::default() })
    }

    fn wire_bits_per_s(&self, profile: &StreamProfile, with_depth: bool) -> Option<f64> {
        Some(live::wire_bits_per_s(profile, with_depth))
    }

    fn unmet(&self, streams: &[StreamRequest]) -> Vec<Unmet> {
        let is_set = |variable: &str| std::env::var_os(variable).is_some_and(|v| !v.is_empty());
        let wants_depth = streams.is_empty() || streams.iter().any(|s| s.stream.as_str() != "color");
        // Libraries are loaded, as they would be by the session.
        let load = |engine| check_libraries(&self.places, engine).map(drop).map_err(|e| e.to_string());
        let library = load(false);
        let engine = if wants_depth && library.is_ok() { load(true) } else { Ok(()) };
        let facts = Facts { library, engine, wants_depth, has_display: is_set("DISPLAY") };
        facts.unmet().into_iter().collect()
    }
}

impl CameraSettings for PlaybackConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(PlaybackBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        Source::Here(PlaybackBackend::new(self.clone()).open(None).map(|device| Offered {
            device: format!("Azure Kinect {} as recorded in {}", device.info().serial, device.info().port),
            profiles: device.profiles().to_vec(),
        }))
    }

    fn reads_files(&self) -> bool {
        true
    }

    fn check_input(&self) -> Result<()> {
        PlaybackBackend::new(self.clone()).discover().map(drop)
    }
}
