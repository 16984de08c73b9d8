//! Cameras that another process serves (`external`). The streams of the process are checked when it offers them.

use super::{BackendConfig, CameraSettings, Family, Found, Identified, OpenContext, Reader, Service, Source};
use crate::config::value::{not_empty, resolve, shown};
use core::time::Duration;
use depthrig_driver::{Backend, Result};
use depthrig_external::{ExternalBackend, ExternalConfig, NAME, Place};
use depthrig_usb::UsbDevice;
use std::path::{Path, PathBuf};

/// The longest that a process may be waited for, seconds: one that boots longer is better started before the rig.
const LONGEST_START_S: f64 = 120.0;
/// The longest silence, seconds: a process that hangs keeps its camera from the rig for so long.
const LONGEST_SILENCE_S: f64 = 14.0;

/// OAK cameras, whose processor is a Movidius Myriad X: before its firmware is uploaded, with it, in its boot loader, and
/// started from flash (XLink `src/pc/protocols/usb_host.cpp`, Apache-2.0).
const MOVIDIUS: u16 = 0x03e7;
const OAK_UNBOOTED: u16 = 0x2485;
const OAK_BOOTED: [u16; 3] = [0xf63b, 0xf63c, 0xf63d];

pub(super) const FAMILY: Family = Family {
    has_stereo: true,
    has_ports: true,
    identify,
    ..Family::new(NAME, |r| Some(BackendConfig::new(read(r))))
};

/// An OAK, which a process drives: nobody else asks it anything, because that would start its firmware.
fn identify(d: &UsbDevice, _: &[UsbDevice]) -> Option<Identified> {
    if d.vendor_id != MOVIDIUS {
        return None;
    }
    if d.product_id == OAK_UNBOOTED {
        return Some(Identified::Camera(Found::of("OAK, not booted", d)));
    }
    // Only its firmware has a serial number.
    let idle_serial = (!d.serial.is_empty()).then(|| d.serial.clone());
    let is_oak = OAK_BOOTED.contains(&d.product_id);
    is_oak.then(|| Identified::Camera(Found { idle_serial, ..Found::of("OAK", d) }))
}

fn read(r: &Reader<'_>) -> ExternalConfig {
    let s = r.section;
    let d = ExternalConfig::default();
    let command = s.or("command", Vec::<String>::new(), |c| match c.first() {
        Some(program) if program.trim().is_empty() => Err("names no program".to_owned()),
        None => Err("is empty; write [\"program\", \"argument\", …], or leave it out".to_owned()),
        _ => Ok(()),
    });
    let directory = s.or("directory", None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    if directory.is_some() && !s.has("command") {
        let why = "is where `command` runs, which is not given";
        s.problem(s.at_key("directory"), format!("{} {why}", s.key_of("directory")));
    }
    let seconds = |key, default: Duration, least: f64, most: f64| {
        let check = |v: &f64| {
            let good = (least..=most).contains(v);
            if good {
                Ok(())
            } else {
                Err(format!("is {} s; it must be within {least} and {most}", shown(v)))
            }
        };
        Duration::from_secs_f64(s.or(key, default.as_secs_f64(), check))
    };
    ExternalConfig {
        command,
        directory: resolve(r.base, directory.as_deref().unwrap_or(Path::new("."))),
        start_timeout: seconds("start_timeout_s", d.start_timeout, 0.1, LONGEST_START_S),
        heartbeat_timeout: seconds("heartbeat_timeout_s", d.heartbeat_timeout, 0.5, LONGEST_SILENCE_S),
    }
}

impl CameraSettings for ExternalConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, context: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        let place = Place {
            runtime: context.runtime.clone(),
            rig: context.rig.clone(),
            camera: context.camera.clone(),
        };
        Ok(Box::new(ExternalBackend::new(self.clone(), place)))
    }

    fn source(&self) -> Source<'_> {
        Source::Served(Service { command: &self.command, directory: &self.directory })
    }

    /// The driver waits for the process, for its first message and for its first frame, each with a limit of its own.
    fn extra_open_time(&self) -> Duration {
        self.start_timeout * 2 + self.heartbeat_timeout
    }
}
