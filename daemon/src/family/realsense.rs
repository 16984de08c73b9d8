//! RealSense D400 (`realsense`). Limits that only the camera knows (the range of its laser, its controls' names)
//! are checked when it is started; the rest is checked here.

use super::{
    BackendConfig, CameraSettings, Family, Found, Identified, ImuFiles, OpenContext, Probe, Reader, Selector,
    Source,
};
use crate::config::controls;
use crate::config::value::{not_empty, resolve, shown, within};
use depthrig_bus::StreamName;
use depthrig_driver::motion::IMU;
use depthrig_driver::{Backend, Result, StreamRequest};
use depthrig_realsense::config::{Emitter, MetadataWish, TransportChoice};
use depthrig_realsense::protocol::sync::SyncMode;
use depthrig_realsense::{NAME, RealsenseBackend, RealsenseConfig, models};
use depthrig_usb::UsbDevice;
use std::path::PathBuf;

const TRANSPORTS: [(&str, TransportChoice); 3] = [
    ("auto", TransportChoice::Auto),
    ("kernel", TransportChoice::Kernel),
    ("libusb", TransportChoice::Libusb),
];
const METADATA: [(&str, MetadataWish); 3] =
    [("full", MetadataWish::Full), ("header", MetadataWish::Header), ("none", MetadataWish::None)];
const EMITTERS: [(&str, Emitter); 4] =
    [("off", Emitter::Off), ("laser", Emitter::Laser), ("auto", Emitter::Auto), ("led", Emitter::Led)];
const SYNC: [(&str, SyncMode); 5] = [
    ("free", SyncMode::Free),
    ("master", SyncMode::Master),
    ("slave", SyncMode::Slave),
    ("full_slave", SyncMode::FullSlave),
    ("genlock", SyncMode::Genlock(1)),
];
const STREAMS: [&str; 5] = ["depth", "color", "ir_left", "ir_right", IMU];

/// The longest exposure that any model takes, microseconds; a model may take less.
const MAX_EXPOSURE_US: u32 = 200_000;
/// The strongest laser of any model, milliwatts.
const MAX_LASER_MW: u16 = 360;

pub(super) const FAMILY: Family = Family {
    has_ports: true,
    probe: Some(probe),
    identify,
    imu: ImuFiles::Iio,
    ..Family::new(NAME, |r| Some(BackendConfig::new(read(r))))
};

fn identify(d: &UsbDevice, _: &[UsbDevice]) -> Option<Identified> {
    if d.vendor_id != models::VENDOR {
        return None;
    }
    let model = models::of_product(d.product_id).map(|m| Identified::Camera(Found::of(m.name, d)));
    model.or_else(|| models::undriven(d.product_id).map(Identified::Unusable))
}

fn read(r: &Reader<'_>) -> RealsenseConfig {
    let s = r.section;
    let d = RealsenseConfig::default();
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let preset = s.or("preset", None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    let config = RealsenseConfig {
        serial: text("serial"),
        port: text("port"),
        transport: s.choice("transport", &TRANSPORTS, d.transport),
        metadata: s.choice("metadata", &METADATA, d.metadata),
        emitter: s.choose("emitter", &EMITTERS),
        laser_power_mw: s.or("laser_power_mw", None, optional(within(0..=MAX_LASER_MW))),
        exposure_us: s.or("exposure_us", None, optional(within(1..=MAX_EXPOSURE_US))),
        auto_exposure: s.get::<bool>("auto_exposure").map(|f| f.value),
        gain: s.or("gain", None, optional(within(1..=1000))),
        preset: preset.map(|p| resolve(r.base, &p)),
        sync: s.choose("sync", &SYNC),
        color_controls: controls::read(s, "color_controls", "color_controls = { }"),
        depth_unit_m: s.or("depth_unit_m", None, optional(depth_unit)),
        allow_uncalibrated: s.or("allow_uncalibrated", d.allow_uncalibrated, |_| Ok(())),
        reset_when_silent: s.or("reset_when_silent", d.reset_when_silent, |_| Ok(())),
    };
    if config.auto_exposure == Some(true) {
        for (key, is_set) in [("exposure_us", config.exposure_us.is_some()), ("gain", config.gain.is_some())]
        {
            if is_set {
                let why = "cannot be set while auto_exposure is true; keep one";
                s.problem(s.at_key(key), format!("{} {why}", s.key_of(key)));
            }
        }
    }
    r.check_streams("a RealSense D400", &STREAMS);
    r.check_color_controls(&config.color_controls);
    config
}

fn probe(p: &Probe<'_>) -> Box<dyn Backend> {
    Box::new(RealsenseBackend::new(RealsenseConfig {
        port: Some(p.port.to_owned()),
        // Listed all the same, with the calibration `none`.
        allow_uncalibrated: true,
        ..RealsenseConfig::default()
    }))
}

/// The streams that are started when the file names none: the imagers behind depth are asked for by name.
pub(super) fn default_streams() -> Vec<StreamRequest> {
    let request = |name| StreamName::new(name).ok().map(StreamRequest::any);
    ["depth", "color"].into_iter().filter_map(request).collect()
}

/// `check` for a key that may be missing.
fn optional<T>(
    check: impl FnOnce(&T) -> Result<(), String>,
) -> impl FnOnce(&Option<T>) -> Result<(), String> {
    move |v| v.as_ref().map_or(Ok(()), check)
}

/// From a micrometre to a centimetre; a camera takes less of it.
#[allow(clippy::trivially_copy_pass_by_ref)] // as a check of a key is called
fn depth_unit(unit: &f64) -> Result<(), String> {
    if (1e-6..=0.01).contains(unit) {
        Ok(())
    } else {
        Err(format!("is {}; it must be within 0.000001 and 0.01 (0.001 are millimetres)", shown(unit)))
    }
}

impl CameraSettings for RealsenseConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(RealsenseBackend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        let libusb = self.transport == TransportChoice::Libusb;
        Source::Attached(Selector {
            serial: self.serial.as_deref(),
            port: self.port.as_deref(),
            libusb,
            needs_calibration: !self.allow_uncalibrated,
            kernel_metadata: !libusb,
            ..Selector::default()
        })
    }

    fn default_streams(&self) -> Vec<StreamRequest> {
        default_streams()
    }
}
