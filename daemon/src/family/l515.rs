//! RealSense L515 (`l515`). The range of a control is checked by the camera when it is started.

use super::realsense::default_streams;
use super::{
    BackendConfig, CameraSettings, Family, Found, Identified, ImuFiles, OpenContext, Probe, Reader, Selector,
    Source,
};
use crate::config::controls;
use depthrig_driver::motion::IMU;
use depthrig_driver::{Backend, Result, StreamRequest};
use depthrig_realsense::l515::{L515Backend, L515Config, NAME};
use depthrig_realsense::models::VENDOR;
use depthrig_realsense::protocol::l515::Control;
use depthrig_usb::UsbDevice;

const STREAMS: [&str; 5] = ["depth", "color", "ir", "confidence", IMU];

/// L515 and its recovery mode (librealsense 2.54 `src/l500/l500-private.h`).
const PRODUCT: u16 = 0x0b64;
const RECOVERY: u16 = 0x0b55;

pub(super) const FAMILY: Family = Family {
    has_ports: true,
    probe: Some(probe),
    identify,
    imu: ImuFiles::Iio,
    ..Family::new(NAME, |r| Some(BackendConfig::new(read(r))))
};

fn identify(d: &UsbDevice, _: &[UsbDevice]) -> Option<Identified> {
    match (d.vendor_id, d.product_id) {
        (VENDOR, PRODUCT) => Some(Identified::Camera(Found::of("L515", d))),
        (VENDOR, RECOVERY) => Some(Identified::Unusable(
            "it is in recovery mode: its firmware was lost; write it again with Intel's tools",
        )),
        _ => None,
    }
}

fn read(r: &Reader<'_>) -> L515Config {
    let s = r.section;
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let mut settings = L515Config {
        serial: text("serial"),
        port: text("port"),
        color_controls: controls::read(s, "color_controls", "color_controls = { }"),
        ..L515Config::default()
    };
    for (name, found) in s.entries::<i32>("controls", "controls = { }") {
        if Control::from_name(&name).is_none() {
            let known = Control::ALL.map(Control::name).join(", ");
            let why = format!("has \"{name}\", which an L515 has not; it has: {known}");
            s.problem(found.at, format!("{} {why}", s.key_of("controls")));
        }
        settings.controls.insert(name, found.value);
    }
    r.check_streams("an L515", &STREAMS);
    r.check_color_controls(&settings.color_controls);
    settings
}

fn probe(p: &Probe<'_>) -> Box<dyn Backend> {
    Box::new(L515Backend::new(L515Config { port: Some(p.port.to_owned()), ..L515Config::default() }))
}

impl CameraSettings for L515Config {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(L515Backend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        let serial = self.serial.as_deref();
        let port = self.port.as_deref();
        Source::Attached(Selector { serial, port, needs_calibration: true, ..Selector::default() })
    }

    fn default_streams(&self) -> Vec<StreamRequest> {
        default_streams()
    }
}
