//! From a plan to a running stream: the images started, a gate for each stream, the control thread.

use super::control::Control;
use super::family::Family;
use super::imu::Unit;
use super::memory::Memory;
use super::panel::Panel;
use super::profiles::{self, Plan};
use super::protocol::hwm::HardwareMonitor;
use super::stream::{Parts, RealsenseStream, StreamState};
use super::transport::{Function, Started, Transport};
use core::time::Duration;
use depthrig_driver::{Error, Gate, Result, Stream, StreamProfile};
use depthrig_usb::video::{Image, ImageSource};
use std::sync::Arc;

/// How long is waited for images that do not come before the IMU is looked at again.
const SLICE: Duration = Duration::from_millis(20);

/// Everything needed to start the chosen streams.
pub(super) struct Launch {
    pub(super) family: Family,
    /// Model, serial number and port, for messages.
    pub(super) label: String,
    pub(super) profiles: Vec<StreamProfile>,
    pub(super) plan: Plan,
    pub(super) monitor: Box<dyn HardwareMonitor>,
    pub(super) memory: Arc<Memory>,
    /// The IMU and the mode that it is to have.
    pub(super) imu: Option<(Unit, StreamProfile)>,
    /// Its controls, if they can be changed while it streams.
    pub(super) panel: Option<Arc<Panel>>,
}

impl Launch {
    /// Starts it through `transport`.
    ///
    /// # Errors
    /// Those of [`Transport::start`].
    pub(super) fn start(self, transport: &mut dyn Transport) -> Result<Box<dyn Stream>> {
        let Self { family, label, mut profiles, plan, monitor, memory, imu, panel } = self;
        // The images' place in the list of streams is before that of the IMU.
        let imu = match imu {
            Some((unit, profile)) => {
                if !unit.is_calibrated() {
                    tracing::warn!(camera = %label, "its IMU is not calibrated; its samples are those of an ideal sensor");
                }
                Some((unit.start(profiles.len(), &profile, &label)?, profile))
            }
            None => None,
        };
        let started = if plan.modes.is_empty() {
            Started { images: Box::new(NoImages), headers: Vec::new() }
        } else {
            transport.start(&plan.modes)?
        };
        let sources = profiles::granted(&mut profiles, &plan, &started.headers);
        let (imu, imu_profile) = imu.unzip();
        for p in profiles.iter().chain(&imu_profile) {
            tracing::info!(
                camera = %label,
                transport = transport.name(),
                metadata = p.metadata.name(),
                "started {}",
                p.describe()
            );
        }
        let streams =
            profiles.iter().zip(&plan.streams).enumerate().map(|(i, (p, (source, unpack)))| StreamState {
                gate: Gate::new(i, p),
                source: *source,
                unpack: *unpack,
                frame_bytes: p.frame_bytes(),
            });
        let streams = streams.collect();
        profiles.extend(imu_profile);
        let port = transport.control(Function::Stereo)?;
        let control = Control::spawn(label.clone(), family, monitor, port)?;
        let parts =
            Parts { label, images: started.images, profiles, streams, sources, control, memory, imu, panel };
        Ok(Box::new(RealsenseStream::new(parts)))
    }
}

/// The images of a camera that delivers its IMU alone.
struct NoImages;

impl ImageSource for NoImages {
    fn poll(&mut self, timeout: Duration, _: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        std::thread::sleep(timeout.min(SLICE));
        Ok(false)
    }
}

/// The error with the camera it is about, which `label` names, unless it says so already.
pub(super) fn in_camera(label: &str, e: Error) -> Error {
    if e.to_string().contains(label) {
        e
    } else {
        Error::new(e.kind(), format!("{label}: {e}")).with_source(e)
    }
}
