//! The backend: finds L515 cameras on the USB and opens the one that the rig selects.

use super::device::{L515Device, Opened};
use super::{FAMILY, L515Config, MODELS, NAME};
use crate::config::MetadataWish;
use crate::find::{self, FoundCamera};
use crate::kernel::Kernel;
use crate::memory::Memory;
use crate::models::VENDOR;
use depthrig_driver::{Backend, Device, DeviceInfo, Error, ErrorKind, Result};
use depthrig_usb as usb;
use depthrig_usb::{SysRoot, UsbDevice};
use std::sync::Arc;

/// The backend `l515`: one rig camera each.
#[derive(Debug, Default)]
pub struct L515Backend {
    config: L515Config,
    root: SysRoot,
    memory: Arc<Memory>,
}

impl L515Backend {
    /// A backend for the camera that `config` selects. Nothing is touched before it is opened.
    pub fn new(config: L515Config) -> Self {
        Self { config, ..Self::default() }
    }

    /// Opens the nodes of a camera and has it say who it is.
    fn ask(&self, found: &FoundCamera) -> Result<Opened> {
        let wish = if self.memory.is_mute() { MetadataWish::None } else { MetadataWish::Full };
        if !Kernel::has_bound(found) {
            let text = format!(
                "{}: the kernel shows no video node of it; an L515 is reached through the module uvcvideo alone, so \
                 load it, and end what holds the camera through libusb",
                found.describe()
            );
            return Err(Error::new(ErrorKind::NotFound, text));
        }
        Opened::new(found.clone(), Kernel::open(&self.root, found, wish)?)
    }

    /// Opens the selected camera.
    fn find(&self, serial: Option<&str>) -> Result<Opened> {
        let wanted = serial.or(self.config.serial.as_deref());
        let found = cameras(usb::scan(&self.root)?);
        let mut candidates = find::candidates(FAMILY, found, self.config.port.as_deref(), wanted, &[])?;
        let Some(wanted) = wanted else {
            // There is exactly one, as `candidates` says.
            let only =
                candidates.pop().ok_or_else(|| Error::new(ErrorKind::NotFound, format!("no {FAMILY}")))?;
            return self.ask(&only);
        };
        let mut others = Vec::new();
        for found in &candidates {
            match self.ask(found) {
                Ok(opened) if opened.gvd.serial.eq_ignore_ascii_case(wanted) => return Ok(opened),
                Ok(opened) => others.push(opened.label()),
                Err(e) if candidates.len() == 1 => return Err(e),
                Err(e) => others.push(format!("{}, which could not be asked ({e})", found.describe())),
            }
        }
        let list = others.join(", ");
        let text = format!("no {FAMILY} with the serial number \"{wanted}\"; there are: {list}");
        Err(Error::new(ErrorKind::NotFound, text))
    }
}

/// The L515 among `devices`.
fn cameras(devices: Vec<UsbDevice>) -> Vec<FoundCamera> {
    let camera = |usb: UsbDevice| {
        let model = MODELS.iter().find(|m| usb.vendor_id == VENDOR && m.product == usb.product_id)?;
        Some(FoundCamera { model, usb })
    };
    devices.into_iter().filter_map(camera).collect()
}

impl Backend for L515Backend {
    fn name(&self) -> &'static str {
        NAME
    }

    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let mut infos = Vec::new();
        for found in cameras(usb::scan(&self.root)?) {
            match self.ask(&found) {
                Ok(mut opened) => infos.push(opened.info()),
                Err(e) => tracing::warn!("{} does not say who it is: {e}", found.describe()),
            }
        }
        let L515Config { serial, port, .. } = &self.config;
        infos.retain(|i| {
            serial.as_ref().is_none_or(|s| i.serial.eq_ignore_ascii_case(s))
                && port.as_ref().is_none_or(|p| i.port == *p)
        });
        Ok(infos)
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let mut opened = self.find(serial)?;
        opened.transport.check_free()?;
        Ok(Box::new(L515Device::new(opened, self.config.clone(), &self.root, Arc::clone(&self.memory))?))
    }
}
