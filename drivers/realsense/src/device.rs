//! An open D400 that is not streaming: identity, calibration, modes, settings.

use super::calibration::{Calibration, FACTORY, NONE, View};
use super::config::RealsenseConfig;
use super::family::Family;
use super::find::FoundCamera;
use super::imu::{Unit, choose_imu, separated};
use super::launch::{Launch, in_camera};
use super::memory::Memory;
use super::panel::Panel;
use super::profiles::{self, Basis};
use super::protocol::advanced::{self, UnitOrigin};
use super::protocol::gvd::Gvd;
use super::protocol::hwm::HardwareMonitor;
use super::protocol::imu::Place;
use super::protocol::preset::Preset;
use super::transport::{Function, Mode, Transport};
use super::{NAME, options};
use depthrig_driver::{Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest};
use depthrig_usb::SysRoot;
use std::sync::Arc;

/// An open D400.
pub(super) struct RealsenseDevice {
    transport: Box<dyn Transport>,
    monitor: Box<dyn HardwareMonitor>,
    config: RealsenseConfig,
    found: FoundCamera,
    gvd: Gvd,
    info: DeviceInfo,
    modes: Vec<Mode>,
    calibration: Option<Calibration>,
    profiles: Vec<StreamProfile>,
    memory: Arc<Memory>,
    /// The IMU, or why it cannot be read; `None` for a model without one.
    unit: Option<Result<Unit>>,
}

/// A camera's identity, and the link to it.
pub(super) struct Opened {
    pub(super) transport: Box<dyn Transport>,
    pub(super) monitor: Box<dyn HardwareMonitor>,
    pub(super) found: FoundCamera,
    pub(super) gvd: Gvd,
}

impl Opened {
    /// Asks the camera behind `transport` who it is.
    ///
    /// # Errors
    /// Those of the hardware monitor.
    pub(super) fn new(found: FoundCamera, mut transport: Box<dyn Transport>) -> Result<Self> {
        let mut monitor = transport.monitor()?;
        let gvd = Gvd::read(&mut monitor)
            .map_err(|e| Error::new(e.kind(), format!("{}: {e}", found.describe())).with_source(e))?;
        Ok(Self { transport, monitor, found, gvd })
    }

    /// The camera's identity.
    pub(super) fn info(&self, calibration: &str) -> DeviceInfo {
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

    /// `D435 0123456789ab (USB port 4-1.2)`, for messages.
    pub(super) fn label(&self) -> String {
        format!("{} {} (USB port {})", self.found.model.name, self.gvd.serial, self.found.usb.port)
    }
}

impl RealsenseDevice {
    /// Reads calibration and modes of an opened camera.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when it is not calibrated and `config` does not allow that; those of the hardware
    /// monitor.
    pub(super) fn new(
        mut opened: Opened,
        config: RealsenseConfig,
        root: &SysRoot,
        memory: Arc<Memory>,
    ) -> Result<Self> {
        let label = opened.label();
        let in_camera = |e: Error| Error::new(e.kind(), format!("{label}: {e}")).with_source(e);
        let model = opened.found.model;
        let gvd = &opened.gvd;
        if gvd.firmware < model.least_firmware {
            tracing::warn!(
                camera = %label,
                "its firmware {} is older than {}, the oldest known to answer as expected; update it with Intel's tool",
                gvd.firmware,
                model.least_firmware
            );
        }
        if (1..5000).contains(&opened.found.usb.speed_mbps) {
            tracing::warn!(
                camera = %label,
                "it is connected with {} Mbit/s (USB 2) at port {}, which leaves small modes alone; use a USB 3 port and \
                 cable, plugged in all the way",
                opened.found.usb.speed_mbps,
                opened.found.usb.port
            );
        }
        let calibration =
            Calibration::read(&mut opened.monitor, model, &config, &label).map_err(in_camera)?;
        let depth_unit_m =
            depth_unit(&mut opened.monitor, &config, model.product, &label).map_err(in_camera)?;
        let modes = opened.transport.modes().to_vec();
        let basis = Basis { model, modes: &modes, calibration: calibration.as_ref(), depth_unit_m };
        let mut profiles = profiles::offered(&basis).map_err(in_camera)?;
        let unit = gvd.imu.then(|| {
            let chip = gvd.accelerometer;
            Unit::find(
                root,
                &opened.found.usb.port,
                opened.monitor.as_mut(),
                Place::D4xx,
                chip,
                model.product,
            )
        });
        match &unit {
            Some(Ok(unit)) => profiles.extend(unit.profiles()?),
            Some(Err(e)) => tracing::info!(camera = %label, "it has no stream imu: {e}"),
            None => {}
        }
        let mut info = opened.info(if calibration.is_some() { FACTORY } else { NONE });
        info.motion = unit.iter().flatten().map(Unit::stated).collect();
        let Opened { transport, monitor, found, gvd } = opened;
        Ok(Self { transport, monitor, config, found, gvd, info, modes, calibration, profiles, memory, unit })
    }

    fn label(&self) -> String {
        format!("{} {} (USB port {})", self.info.model, self.info.serial, self.info.port)
    }

    /// Writes what the rig asks for into the camera, which does not stream yet.
    fn configure(&mut self, label: &str, chosen: &[StreamProfile]) -> Result<()> {
        let Self { transport, monitor, config, found, gvd, .. } = self;
        if let Some(mode) = config.sync {
            mode.check(found.model.product, gvd.firmware, gvd.shutter)?;
            mode.write(monitor)?;
            tracing::info!(camera = %label, "sync mode set to {mode}");
        }
        if let Some(path) = &config.preset {
            for group in read_preset(path)?.write(monitor)? {
                tracing::info!(
                    camera = %label,
                    "preset {}: group {} was {:02x?}, now {:02x?}",
                    path.display(),
                    group.group.name(),
                    group.before,
                    group.after
                );
            }
        }
        let mut port = transport.control(Function::Stereo)?;
        let mut stereo = match config.gain {
            Some(_) => Some(transport.image_controls(Function::Stereo)?),
            None => None,
        };
        let mut color = None;
        if !config.color_controls.is_empty() {
            if !chosen.iter().any(|p| p.stream.as_str() == "color") {
                return Err(Error::new(
                    ErrorKind::BadInput,
                    "color_controls are set, but colour is not among the streams",
                ));
            }
            color = Some(transport.image_controls(color_function(found))?);
        }
        options::apply(
            config,
            label,
            port.as_mut(),
            stereo.as_mut().map(|c| c.as_mut() as _),
            color.as_mut().map(|c| c.as_mut() as _),
        )
    }
}

impl Device for RealsenseDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(mut self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let label = self.label();
        let in_camera = |e| in_camera(&label, e);
        let asked = separated(requests);
        let imu = choose_imu(&label, &self.profiles, asked.imu.as_ref(), self.unit.take())?;
        let (profiles, plan) = match &asked.images {
            Some(images) => profiles::plan(&label, &self.profiles, &self.modes, images)?,
            None => Default::default(),
        };
        self.configure(&label, &profiles).map_err(in_camera)?;
        self.warn_of_scaled(&label, &profiles);
        let panel = self.panel(&label, &profiles);
        let Self { mut transport, monitor, memory, .. } = *self;
        let family = Family::D4xx;
        let launch = Launch { family, label: label.clone(), profiles, plan, monitor, memory, imu, panel };
        launch.start(transport.as_mut()).map_err(in_camera)
    }
}

impl RealsenseDevice {
    /// The controls for use while it streams; without them it streams all the same.
    fn panel(&mut self, label: &str, chosen: &[StreamProfile]) -> Option<Arc<Panel>> {
        let has_color = chosen.iter().any(|p| p.stream.as_str() == "color");
        let color = has_color.then(|| color_function(&self.found));
        match Panel::new(label.to_owned(), self.transport.as_mut(), color) {
            Ok(panel) => Some(Arc::new(panel)),
            Err(e) => {
                tracing::info!(camera = %label, "its controls cannot be changed while it streams: {e}");
                None
            }
        }
    }

    /// A size that the calibration has no entry for gets scaled intrinsics, which is worth knowing.
    fn warn_of_scaled(&self, label: &str, chosen: &[StreamProfile]) {
        for p in chosen {
            let view = match p.stream.as_str() {
                "color" => View::Color,
                "ir_right" => View::Right,
                _ => View::Left,
            };
            let geometry = self.calibration.as_ref().map(|c| c.geometry(view, p.width, p.height));
            if geometry.is_some_and(|g| g.is_ok_and(|g| g.is_scaled)) {
                tracing::warn!(
                    camera = %label,
                    "its calibration has no entry for {}; the intrinsics are scaled and off by what the camera cuts away",
                    p.describe()
                );
            }
        }
    }
}

/// The function that has the colour image.
const fn color_function(found: &FoundCamera) -> Function {
    if found.model.color_module { Function::Color } else { Function::Stereo }
}

/// Metres per unit of depth, after it was set if the rig asks for that.
fn depth_unit(
    monitor: &mut dyn HardwareMonitor,
    config: &RealsenseConfig,
    product: u16,
    label: &str,
) -> Result<f64> {
    if let Some(wanted) = config.depth_unit_m {
        let (now, _) = advanced::depth_unit_m(monitor, product)?;
        if (now - wanted).abs() > 0.5e-6 {
            let before = advanced::set_depth_unit_m(monitor, wanted)?;
            tracing::info!(camera = %label, "depth unit set from {before} m to {wanted} m");
        }
    }
    let (unit, origin) = match advanced::depth_unit_m(monitor, product) {
        // Firmware without the request has advanced mode off.
        Err(e) if e.kind() == ErrorKind::Unsupported => {
            (advanced::default_depth_unit_m(product), UnitOrigin::Model)
        }
        answered => answered?,
    };
    if origin == UnitOrigin::Model {
        tracing::info!(camera = %label, "advanced mode is off; its depth unit is taken to be the model's, {unit} m");
    }
    Ok(unit)
}

fn read_preset(path: &std::path::Path) -> Result<Preset> {
    let text =
        depthrig_bus::files::read_to_string(path, depthrig_bus::files::TEXT_MAX_BYTES).map_err(|e| {
            let kind =
                if e.kind() == std::io::ErrorKind::NotFound { ErrorKind::BadInput } else { ErrorKind::Io };
            Error::new(kind, format!("preset {} cannot be read: {e}", path.display())).with_source(e)
        })?;
    Preset::parse(&text)
        .map_err(|e| Error::new(e.kind(), format!("preset {}: {e}", path.display())).with_source(e))
}
