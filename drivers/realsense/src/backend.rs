//! The backend: finds D400 cameras on the USB, opens the one that the rig selects, restarts one on request.

use super::calibration::Calibration;
use super::config::{MetadataWish, RealsenseConfig, TransportChoice};
use super::device::{Opened, RealsenseDevice};
use super::find::{self, FoundCamera};
use super::kernel::Kernel;
use super::memory::Memory;
use super::protocol::hwm::{HardwareMonitor, Request};
use super::transport::Transport;
use super::{NAME, libusb};
use depthrig_driver::{Backend, Device, DeviceInfo, Error, ErrorKind, Result};
use depthrig_usb as usb;
use depthrig_usb::SysRoot;
use std::sync::Arc;

/// The backend `realsense`: one rig camera each.
#[derive(Debug, Default)]
pub struct RealsenseBackend {
    config: RealsenseConfig,
    root: SysRoot,
    memory: Arc<Memory>,
}

impl RealsenseBackend {
    /// A backend for the camera that `config` selects. Nothing is touched before it is opened.
    pub fn new(config: RealsenseConfig) -> Self {
        Self { config, ..Self::default() }
    }

    /// Restarts the camera that the configuration and `serial` mean, also one that streams: it leaves the bus and comes
    /// back after some seconds.
    ///
    /// # Errors
    /// Those of [`Backend::open`].
    pub fn reset(&self, serial: Option<&str>) -> Result<DeviceInfo> {
        let mut opened = self.find(serial)?;
        opened.monitor.command(&Request::reset())?;
        Ok(opened.info(""))
    }

    /// Opens the selected camera.
    fn find(&self, serial: Option<&str>) -> Result<Opened> {
        let wanted = serial.or(self.config.serial.as_deref());
        let is_other = |s: &str| wanted.is_some_and(|w| !w.eq_ignore_ascii_case(s));
        let devices = usb::scan(&self.root)?;
        let unusable = find::unusable(&devices);
        let candidates = find::candidates(
            find::D400,
            find::cameras(devices),
            self.config.port.as_deref(),
            wanted,
            &unusable,
        )?;
        let mut others = Vec::new();
        let mut failed = Vec::new();
        for found in candidates {
            // A camera that is known to be another one is not disturbed; it may be streaming.
            if let Some(serial) = identity::of(&found.usb).filter(|s| is_other(s)) {
                others.push(format!("{} {serial} (USB port {})", found.model.name, found.usb.port));
                continue;
            }
            match self.ask(&found) {
                Ok(opened) if is_other(&opened.gvd.serial) => others.push(opened.label()),
                Ok(opened) => return Ok(opened),
                Err(e) => {
                    others.push(format!("{}, which could not be asked ({e})", found.describe()));
                    failed.push(e);
                }
            }
        }
        match failed.pop() {
            // The only camera there is: what is wrong with it is what is wrong.
            Some(e) if others.len() == 1 => return Err(e),
            _ => {}
        }
        let serial = wanted.unwrap_or_default();
        let at = self.config.port.as_ref().map_or_else(String::new, |p| format!(" at USB port {p}"));
        let text = format!(
            "no RealSense D400 with the serial number \"{serial}\"{at}; there are: {}",
            others.join(", ")
        );
        Err(Error::new(ErrorKind::NotFound, text))
    }

    /// Opens a camera and has it say who it is.
    fn ask(&self, found: &FoundCamera) -> Result<Opened> {
        let opened = Opened::new(found.clone(), self.connect(found)?)?;
        identity::note(&found.usb, &opened.gvd.serial);
        Ok(opened)
    }

    fn connect(&self, found: &FoundCamera) -> Result<Box<dyn Transport>> {
        if found.usb.interfaces.is_empty() {
            let text = format!("{}: the kernel has not configured it yet", found.describe());
            return Err(Error::new(ErrorKind::NotFound, text));
        }
        let by_kernel = match self.config.transport {
            TransportChoice::Kernel => true,
            TransportChoice::Libusb => false,
            TransportChoice::Auto => Kernel::has_bound(found),
        };
        if !by_kernel {
            return libusb::open(&self.root, found);
        }
        let wish = match self.config.metadata {
            _ if self.memory.is_mute() => MetadataWish::None,
            wish => wish,
        };
        Ok(Box::new(Kernel::open(&self.root, &self.bound(found), wish)?))
    }

    /// The camera with its nodes. A program that had it through libusb and was killed leaves it without a driver.
    fn bound(&self, found: &FoundCamera) -> FoundCamera {
        let mut found = found.clone();
        if !Kernel::has_bound(&found) {
            match depthrig_libusb::give_to_kernel(&self.root, &found.usb) {
                Ok(0) => {}
                Ok(_) => {
                    tracing::info!("{}: the kernel's driver is bound again", found.describe());
                    let port = found.usb.port.clone();
                    let now = usb::scan(&self.root).unwrap_or_default().into_iter().find(|d| d.port == port);
                    found.usb = now.unwrap_or(found.usb);
                }
                Err(e) => tracing::debug!("{}: its driver cannot be bound: {e}", found.describe()),
            }
        }
        found
    }
}

/// Which serial number is at which place, so that cameras in use need not be asked again.
mod identity {
    use depthrig_bus::sync::lock;
    use depthrig_usb::UsbDevice;
    use std::collections::BTreeMap;
    use std::sync::Mutex;

    /// By bus and number on it, which is another after every replug.
    static KNOWN: Mutex<BTreeMap<(u16, u16), (String, String)>> = Mutex::new(BTreeMap::new());
    /// Numbers on a bus go up to 127; no computer has so many buses.
    const MOST: usize = 1024;

    pub(super) fn of(device: &UsbDevice) -> Option<String> {
        let known = lock(&KNOWN);
        let (port, serial) = known.get(&(device.bus_number, device.device_number))?;
        (*port == device.port).then(|| serial.clone())
    }

    pub(super) fn note(device: &UsbDevice, serial: &str) {
        let mut known = lock(&KNOWN);
        if known.len() >= MOST {
            known.clear();
        }
        known.insert((device.bus_number, device.device_number), (device.port.clone(), serial.to_owned()));
    }
}

impl Backend for RealsenseBackend {
    fn name(&self) -> &'static str {
        NAME
    }

    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let found = find::cameras(usb::scan(&self.root)?);
        let mut infos = Vec::new();
        for found in found {
            let here = self.config.port.as_ref().is_none_or(|p| *p == found.usb.port);
            if !here {
                continue;
            }
            match self.ask(&found) {
                Ok(mut opened) => {
                    let word = Calibration::word(&mut opened.monitor, found.model);
                    infos.push(opened.info(word));
                }
                Err(e) => tracing::warn!("{} does not say who it is: {e}", found.describe()),
            }
        }
        if let Some(serial) = &self.config.serial {
            infos.retain(|i| i.serial.eq_ignore_ascii_case(serial));
        }
        Ok(infos)
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let mut opened = self.find(serial)?;
        if self.config.reset_when_silent && self.memory.take_reset() {
            let label = opened.label();
            opened.monitor.command(&Request::reset())?;
            let text = format!(
                "{label}: it sent no image although its streams were started twice; it is restarted (hardware reset)"
            );
            tracing::warn!("{text}");
            return Err(Error::new(ErrorKind::Disconnected, text));
        }
        opened.transport.check_free()?;
        let device = RealsenseDevice::new(opened, self.config.clone(), &self.root, Arc::clone(&self.memory))?;
        Ok(Box::new(device))
    }
}
