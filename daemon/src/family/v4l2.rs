//! Cameras at the kernel's video nodes (`v4l2`).

use super::{
    BackendConfig, CameraSettings, Family, Found, Identified, OpenContext, Probe, Selector, Source, is_video,
};
use crate::config::controls;
use crate::config::read::{Located, Section};
use crate::config::value::within;
use depthrig_bus::{Distortion, Intrinsics, StreamName};
use depthrig_driver::{Backend, Result};
use depthrig_usb::UsbDevice;
use depthrig_v4l2::{
    BUFFERS, ClockChoice, GivenIntrinsics, MemoryChoice, MjpegChoice, V4l2Backend, V4l2Config,
};

const MEMORY: [(&str, MemoryChoice); 2] =
    [("mmap", MemoryChoice::Mmap), ("userptr", MemoryChoice::UserPointer)];
const MJPEG: [(&str, MjpegChoice); 2] = [("decode", MjpegChoice::Decode), ("keep", MjpegChoice::Keep)];
const CLOCK: [(&str, ClockChoice); 2] = [("auto", ClockChoice::Auto), ("kernel", ClockChoice::Kernel)];

pub(super) const FAMILY: Family = Family {
    has_ports: true,
    probe: Some(probe),
    identify,
    ..Family::new("v4l2", |r| Some(BackendConfig::new(read(r.section))))
};

fn identify(d: &UsbDevice, _: &[UsbDevice]) -> Option<Identified> {
    let name = if d.product.is_empty() { d.id() } else { d.product.clone() };
    is_video(d).then(|| Identified::Generic(Found::of(name, d)))
}

fn read(s: &Section<'_, '_>) -> V4l2Config {
    let d = V4l2Config::default();
    let text = |key| {
        s.or(key, None, |v: &Option<String>| match v {
            Some(v) if v.is_empty() => Err("is empty".to_owned()),
            _ => Ok(()),
        })
    };
    V4l2Config {
        serial: text("serial"),
        port: text("port"),
        controls: controls::read(s, "controls", "[camera.controls]").into_iter().collect(),
        memory: s.choice("memory", &MEMORY, d.memory),
        mjpeg: s.choice("mjpeg", &MJPEG, d.mjpeg),
        clock: s.choice("clock", &CLOCK, d.clock),
        // A slower clock could not distinguish frames, and no camera has a faster one.
        device_clock_hz: s.or("device_clock_hz", None, |v: &Option<u32>| {
            v.map_or(Ok(()), |hz| within(1000..=1_000_000_000)(&hz))
        }),
        depth_unit_m: s.or("depth_unit_m", d.depth_unit_m, crate::config::value::above_zero(1.0)),
        intrinsics: s
            .tables("intrinsics", "[[camera.intrinsics]]")
            .into_iter()
            .flatten()
            .filter_map(intrinsics)
            .collect(),
        buffers: s.or("buffers", d.buffers, within(BUFFERS)),
    }
}

fn probe(p: &Probe<'_>) -> Box<dyn Backend> {
    Box::new(V4l2Backend::new(V4l2Config { port: Some(p.port.to_owned()), ..V4l2Config::default() }))
}

const MODELS: [(&str, Distortion); 5] = [
    ("none", Distortion::None),
    ("brown_conrady", Distortion::BrownConrady),
    ("inverse_brown_conrady", Distortion::InverseBrownConrady),
    ("kannala_brandt4", Distortion::KannalaBrandt4),
    ("rational", Distortion::Rational),
];

fn intrinsics(s: Section<'_, '_>) -> Option<GivenIntrinsics> {
    let stream = s.required::<StreamName>("stream", "\"color\"");
    let side = |key, example| {
        let found = s.required::<u32>(key, example);
        found.filter(|f| check(&s, key, f, &within(1..=16_384)(&f.value))).map(|f| f.value)
    };
    let width = side("width", "1280");
    let height = side("height", "720");
    let pixels = |key, example| {
        let found = s.required::<f64>(key, example);
        found.filter(|f| check(&s, key, f, &crate::config::value::above_zero(1e5)(&f.value))).map(|f| f.value)
    };
    let fx = pixels("fx", "910.5");
    let fy = pixels("fy", "909.8");
    let cx = pixels("cx", "640.2");
    let cy = pixels("cy", "361.7");
    let model = s.choice("model", &MODELS, Distortion::None);
    let most = match model {
        Distortion::Unknown | Distortion::None => 0,
        Distortion::BrownConrady | Distortion::InverseBrownConrady => 5,
        Distortion::KannalaBrandt4 => 4,
        _ => 8,
    };
    let given = s.or("coefficients", Vec::<f64>::new(), |c| {
        let n = c.len();
        if n <= most { Ok(()) } else { Err(format!("has {n} values; this model has {most}")) }
    });
    let mut coeffs = [0.0; 8];
    coeffs.iter_mut().zip(&given).for_each(|(to, from)| *to = *from);
    s.finish();
    let intrinsics = Intrinsics { coeffs, model: model as u32, ..Intrinsics::pinhole(fx?, fy?, cx?, cy?) };
    Some(GivenIntrinsics { stream: stream?.value, width: width?, height: height?, intrinsics })
}

/// Whether `outcome` is good; if not, it is noted.
fn check<T>(
    s: &Section<'_, '_>,
    key: &str,
    found: &Located<T>,
    outcome: &core::result::Result<(), String>,
) -> bool {
    if let Err(why) = outcome {
        s.problem(found.at, format!("{} {why}", s.key_of(key)));
    }
    outcome.is_ok()
}

impl CameraSettings for V4l2Config {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, _: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        Ok(Box::new(V4l2Backend::new(self.clone())))
    }

    fn source(&self) -> Source<'_> {
        let serial = self.serial.as_deref();
        let port = self.port.as_deref();
        Source::Attached(Selector { serial, port, ..Selector::default() })
    }
}
