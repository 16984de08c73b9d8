//! The handle of an emulated camera: plug it in, unplug it, inject faults, read its accounts.

use crate::calibration::Calibration;
use crate::content::{self, hash};
use crate::device::{Device, spawn};
use crate::fault::Fault;
use crate::firmware::{Asked, Identity};
use crate::model::{Mode, Model};
use crate::shared::{Command, Presence, Session, Shared};
use crate::{Accounts, Error, ImuSample, Options, Result, Speed, vhci};
use core::time::Duration;
use depthrig_bus::HostTime;
use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread::JoinHandle;

/// How long a fault may wait for the device's thread, which may be busy sending.
const FAULT_TIMEOUT: Duration = Duration::from_secs(2);

/// How long a device may take to come or to go.
const TIMEOUT: Duration = Duration::from_secs(5);

/// An emulated camera. Dropping it unplugs it.
pub struct Camera {
    model: Arc<Model>,
    serial: String,
    options: Options,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    port: std::sync::Mutex<Option<u32>>,
    /// The other USB device in the same housing.
    companion: Option<Box<Camera>>,
}

static CREATED: AtomicU32 = AtomicU32::new(1);

fn new_serial(model: &Model) -> String {
    let number = CREATED.fetch_add(1, Ordering::Relaxed);
    match model.family {
        crate::model::Family::D400 => format!("{:012}", 830_000_000_000 + u64::from(number)),
        crate::model::Family::L515 => format!("f{number:07x}"),
        _ => format!("{}", 30_000_000 + number),
    }
}

impl Camera {
    /// Makes a camera of a model that comes with the emulator and plugs it in.
    ///
    /// # Errors
    /// When there is no such model, no virtual host controller, or no free port.
    pub fn plug(model: &str, options: Options) -> Result<Self> {
        let camera = Self::unplugged(Arc::new(Model::named(model)?), options)?;
        camera.replug()?;
        Ok(camera)
    }

    /// Makes a camera that is not plugged in.
    ///
    /// # Errors
    /// When its thread cannot be started.
    pub fn unplugged(model: Arc<Model>, options: Options) -> Result<Self> {
        Self::part(model, options, None)
    }

    /// One USB device of a camera; a companion follows `video`.
    fn part(model: Arc<Model>, options: Options, video: Option<Arc<Shared>>) -> Result<Self> {
        let serial = options.serial.clone().unwrap_or_else(|| new_serial(&model));
        let shared = Arc::new(Shared::new(model.streams().count())?);
        let companion = match &model.companion {
            Some(name) => {
                let options = Options { serial: Some(serial.clone()), speed: Speed::High, ..options.clone() };
                let part = Self::part(Arc::new(Model::named(name)?), options, Some(Arc::clone(&shared)))?;
                Some(Box::new(part))
            }
            None => None,
        };
        let device = Device::new(Arc::clone(&model), options.clone(), &serial, Arc::clone(&shared), video);
        let thread = Some(spawn(device, &format!("emu {serial}"))?);
        Ok(Self { model, serial, options, shared, thread, port: None.into(), companion })
    }

    fn port_slot(&self) -> std::sync::MutexGuard<'_, Option<u32>> {
        self.port.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Plugs it in again: into the port that it had.
    ///
    /// # Errors
    /// When it is plugged in, or the port does not become free.
    pub fn replug(&self) -> Result<()> {
        if self.shared.lock().presence != Presence::Unplugged {
            return Err(Error::new(format!("{} is plugged in already", self.serial)));
        }
        let mut slot = self.port_slot();
        let (line, port) = vhci::attach(self.options.hub, self.options.speed, *slot)?;
        *slot = Some(port);
        self.shared.ask(Command::Serve(line, Some(port)))?;
        self.shared.wait(TIMEOUT, |p| matches!(p, Presence::Plugged(_)))?;
        self.companion.as_ref().map_or(Ok(()), |c| c.replug())
    }

    /// Serves a host other than the kernel: `line` is the device's end of a USB/IP stream.
    ///
    /// # Errors
    /// When its thread does not take the line.
    pub fn serve(&self, line: UnixStream) -> Result<()> {
        self.shared.ask(Command::Serve(line, None))?;
        self.shared.wait(TIMEOUT, |p| matches!(p, Presence::Plugged(_)))
    }

    /// Pulls the plug. Returns when the device is off its port.
    ///
    /// # Errors
    /// When it does not go.
    pub fn unplug(&self) -> Result<()> {
        self.shared.ask(Command::Unplug(None))?;
        self.shared.wait(TIMEOUT, |p| p == Presence::Unplugged)?;
        self.companion.as_ref().map_or(Ok(()), |c| c.unplug())
    }

    /// Pulls the plug and puts it back after a time, by itself.
    ///
    /// # Errors
    /// When its thread does not take the command.
    pub fn unplug_for(&self, time: Duration) -> Result<()> {
        self.shared.ask(Command::Unplug(Some(time)))?;
        self.companion.as_ref().map_or(Ok(()), |c| c.unplug_for(time))
    }

    /// Injects a fault. Requests that the host sends after this call meet it.
    ///
    /// # Errors
    /// When the fault names a stream that the camera has not.
    pub fn fault(&self, fault: Fault) -> Result<()> {
        if let Fault::Frames { stream, .. } | Fault::StallEndpoint { stream } = &fault {
            self.model.stream_index(stream)?;
        }
        let name = fault.name();
        let until = HostTime::now().plus(FAULT_TIMEOUT);
        let asked = || self.shared.lock().faults.get(name).copied();
        let before = asked();
        self.shared.ask(Command::Fault(fault))?;
        while asked() == before && !until.from_now().is_zero() {
            std::thread::sleep(Duration::from_micros(100));
        }
        Ok(())
    }

    /// Accounts of a stream.
    ///
    /// # Errors
    /// When the camera has no such stream.
    pub fn accounts(&self, stream: &str) -> Result<Accounts> {
        let index = self.model.stream_index(stream)?;
        Ok(self.shared.lock().accounts.get(index).copied().unwrap_or_default())
    }

    /// How often each kind of fault was asked for.
    pub fn faults(&self) -> BTreeMap<&'static str, u64> {
        self.shared.lock().faults.clone()
    }

    /// Requests to the hardware monitor without clock readings, oldest first; of very many the latest.
    pub fn asked(&self) -> Vec<Asked> {
        self.shared.lock().asked.iter().cloned().collect()
    }

    /// Opcodes that the hardware monitor was asked for and does not know.
    pub fn unknown_opcodes(&self) -> BTreeSet<u32> {
        self.shared.lock().unknown.clone()
    }

    /// The bytes of a frame as they travelled, by its stamp's index.
    ///
    /// # Errors
    /// When the camera has no such stream, or no such frame was due.
    pub fn expected(&self, stream: &str, index: u64) -> Result<Vec<u8>> {
        let session = self.session(stream, index)?;
        Ok(content::frame(&self.serial, self.model.stream_index(stream)? as u16, &session.mode, index))
    }

    /// The mode that a frame was sent in.
    ///
    /// # Errors
    /// Those of [`Self::expected`].
    pub fn mode(&self, stream: &str, index: u64) -> Result<Mode> {
        Ok(self.session(stream, index)?.mode)
    }

    /// When a frame was truly captured: the middle of its exposure, on the host's clock.
    ///
    /// # Errors
    /// Those of [`Self::expected`].
    pub fn true_capture(&self, stream: &str, index: u64) -> Result<HostTime> {
        Ok(self.session(stream, index)?.captured(index))
    }

    /// The camera's clock at the middle of a frame's exposure, microseconds.
    ///
    /// # Errors
    /// Those of [`Self::expected`].
    pub fn true_ticks(&self, stream: &str, index: u64) -> Result<u32> {
        let session = self.session(stream, index)?;
        let k = index.saturating_sub(session.first_index) as i64;
        Ok(session.clock.shown_us(session.first_ns + k * session.period_ns))
    }

    /// Samples of the IMU, oldest first; of very many the latest.
    pub fn imu_samples(&self) -> Vec<ImuSample> {
        self.shared.lock().imu.iter().copied().collect()
    }

    fn session(&self, stream: &str, index: u64) -> Result<Session> {
        let at = self.model.stream_index(stream)?;
        let state = self.shared.lock();
        let sessions = state.sessions.get(at);
        let found = sessions.and_then(|all| all.iter().rev().find(|s| s.first_index <= index)).copied();
        found.ok_or_else(|| Error::new(format!("{} {stream} had no frame {index}", self.serial)))
    }

    /// Its serial.
    pub fn serial(&self) -> &str {
        &self.serial
    }

    /// The serial in its USB descriptor: for a RealSense camera that of its chip.
    pub fn usb_serial(&self) -> String {
        Identity::new(&self.model, &self.serial).chip_serial
    }

    /// Hash that its stamps carry in place of its serial.
    pub fn serial_hash(&self) -> u64 {
        hash(&self.serial)
    }

    /// Its calibration.
    pub fn calibration(&self) -> Calibration {
        Calibration::new(&self.model, &self.serial)
    }

    /// The other USB device in the same housing: the IMU of a ZED 2i.
    pub fn companion(&self) -> Option<&Self> {
        self.companion.as_deref()
    }

    /// Its model.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// Whether it is on the bus.
    pub fn is_plugged(&self) -> bool {
        matches!(self.shared.lock().presence, Presence::Plugged(_))
    }

    /// Its name in sysfs (`2-1`): the same after every plugging. `None` until the kernel has seen it.
    pub fn port_path(&self) -> Option<String> {
        vhci::device_on((*self.port_slot())?)
    }

    /// The controller that it hangs on.
    pub fn hub(&self) -> u32 {
        self.options.hub
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        // When the thread does not take the command it has ended.
        let _ = self.shared.ask(Command::End);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Events that affect all cameras of one controller at once.
pub struct Hub;

impl Hub {
    /// A reset: every camera of the controller drops off the bus and comes back after a time.
    ///
    /// # Errors
    /// When a camera's thread does not take the command.
    pub fn reset<'a>(
        cameras: impl IntoIterator<Item = &'a Camera>,
        hub: u32,
        time: Duration,
    ) -> Result<usize> {
        let mut count = 0;
        for camera in cameras.into_iter().filter(|c| c.hub() == hub && c.is_plugged()) {
            camera.unplug_for(time)?;
            count += 1;
        }
        Ok(count)
    }
}
