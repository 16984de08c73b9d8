//! An open L515 that is not streaming: identity, calibration, modes, settings.

use super::profiles::{self, Tables};
use super::{L515Config, NAME};
use crate::calibration::{FACTORY, NONE};
use crate::family::Family;
use crate::find::FoundCamera;
use crate::imu::{Unit, choose_imu, separated};
use crate::launch::{Launch, in_camera};
use crate::memory::Memory;
use crate::options;
use crate::protocol::gvd::L515Gvd;
use crate::protocol::hwm::HardwareMonitor;
use crate::protocol::imu::Place;
use crate::protocol::l515::Control;
use crate::transport::{Function, Mode, Transport};
use depthrig_driver::{Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest};
use depthrig_usb::SysRoot;
use std::sync::Arc;

/// A camera's identity, and the link to it.
pub(super) struct Opened {
    pub(super) transport: Box<dyn Transport>,
    pub(super) gvd: L515Gvd,
    monitor: Box<dyn HardwareMonitor>,
    found: FoundCamera,
}

impl Opened {
    /// Asks the camera behind `transport` who it is.
    ///
    /// # Errors
    /// Those of the hardware monitor.
    pub(super) fn new(found: FoundCamera, transport: impl Transport + 'static) -> Result<Self> {
        let mut transport: Box<dyn Transport> = Box::new(transport);
        let mut monitor = transport.monitor()?;
        let gvd = L515Gvd::read(&mut monitor)
            .map_err(|e| Error::new(e.kind(), format!("{}: {e}", found.describe())).with_source(e))?;
        Ok(Self { transport, gvd, monitor, found })
    }

    /// `L515 f0123456 (USB port 4-1.2)`, for messages.
    pub(super) fn label(&self) -> String {
        format!("{} {} (USB port {})", self.found.model.name, self.gvd.serial, self.found.usb.port)
    }

    /// The camera's identity.
    pub(super) fn info(&mut self) -> DeviceInfo {
        let calibration = if Tables::read(&mut self.monitor).is_ok() { FACTORY } else { NONE };
        self.info_with(calibration)
    }

    fn info_with(&self, calibration: &str) -> DeviceInfo {
        DeviceInfo {
            backend: NAME,
            model: self.found.model.name.to_owned(),
            serial: self.gvd.serial.clone(),
            firmware: self.gvd.firmware.to_string(),
            port: self.found.usb.port.clone(),
            calibration: calibration.to_owned(),
            motion: String::new(),
        }
    }
}

/// An open L515.
pub(super) struct L515Device {
    opened: Opened,
    label: String,
    config: L515Config,
    info: DeviceInfo,
    modes: Vec<Mode>,
    profiles: Vec<StreamProfile>,
    memory: Arc<Memory>,
    /// The IMU, or why it cannot be read.
    unit: Result<Unit>,
}

impl L515Device {
    /// Reads calibration and modes of an opened camera.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when it is not calibrated; [`ErrorKind::Protocol`] when its tables are damaged; those
    /// of the hardware monitor.
    pub(super) fn new(
        mut opened: Opened,
        config: L515Config,
        root: &SysRoot,
        memory: Arc<Memory>,
    ) -> Result<Self> {
        let label = opened.label();
        let in_camera = |e: Error| Error::new(e.kind(), format!("{label}: {e}")).with_source(e);
        let tables = Tables::read(&mut opened.monitor).map_err(in_camera)?;
        let modes = opened.transport.modes().to_vec();
        let mut profiles = profiles::offered(&tables, &modes).map_err(in_camera)?;
        let product = opened.found.model.product;
        let port = opened.found.usb.port.clone();
        let unit = Unit::find(root, &port, opened.monitor.as_mut(), Place::L515, 0, product);
        match &unit {
            Ok(unit) => profiles.extend(unit.profiles()?),
            Err(e) => tracing::info!(camera = %label, "it has no stream imu: {e}"),
        }
        let mut info = opened.info_with(FACTORY);
        info.motion = unit.iter().map(Unit::stated).collect();
        Ok(Self { opened, label, config, info, modes, profiles, memory, unit })
    }

    /// Writes what the rig asks for into the camera, which does not stream yet.
    fn configure(&mut self, chosen: &[StreamProfile]) -> Result<()> {
        let Self { opened, label, config, .. } = self;
        for (name, value) in &config.controls {
            let control = Control::from_name(name).ok_or_else(|| {
                let known = Control::ALL.map(Control::name).join(", ");
                Error::new(
                    ErrorKind::BadInput,
                    format!("controls: there is no \"{name}\"; there are {known}"),
                )
            })?;
            let now = control.set(&mut opened.monitor, *value)?;
            if now != *value {
                let text = format!("controls: {name} was set to {value} and the camera reports {now}");
                return Err(Error::new(ErrorKind::Protocol, text));
            }
            tracing::info!(camera = %label, "{name} set to {value}");
        }
        if config.color_controls.is_empty() {
            return Ok(());
        }
        if !chosen.iter().any(|p| p.stream.as_str() == "color") {
            let text = "color_controls are set, but colour is not among the streams";
            return Err(Error::new(ErrorKind::BadInput, text));
        }
        let mut color = opened.transport.image_controls(Function::Color)?;
        options::set_named(label, "color_controls", color.as_mut(), config.color_controls.iter())
    }
}

impl Device for L515Device {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(mut self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let label = self.label.clone();
        let in_camera = |e| in_camera(&label, e);
        let asked = separated(requests);
        let (profiles, plan) = match &asked.images {
            Some(images) => profiles::plan(&label, &self.profiles, &self.modes, images)?,
            None => Default::default(),
        };
        self.configure(&profiles).map_err(in_camera)?;
        let Self { opened: Opened { mut transport, monitor, .. }, memory, profiles: offered, unit, .. } =
            *self;
        let imu = choose_imu(&label, &offered, asked.imu.as_ref(), Some(unit))?;
        let launch = Launch {
            family: Family::L515,
            label: label.clone(),
            profiles,
            plan,
            monitor,
            memory,
            imu,
            panel: None,
        };
        launch.start(transport.as_mut()).map_err(in_camera)
    }
}
