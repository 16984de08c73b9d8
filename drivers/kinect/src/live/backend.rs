//! The backend for attached Kinects: finds the selected one, opens it and reads its identity.

use super::config::LiveConfig;
use super::find::{self, FoundCamera};
use super::handle::{self, Handle};
use super::library::{self, Loaded, Places};
use super::profiles;
use super::stream::LiveStream;
use super::{controls, find::MODEL};
use crate::NAME;
use crate::calibration::Calibration;
use crate::modes::WiredSync;
use crate::motion;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest,
};
use depthrig_usb::holder::holders_of;
use depthrig_usb::{SysRoot, health, scan};
use std::sync::{MutexGuard, TryLockError};

/// How long another camera's opening is waited for.
const OPENING: Duration = Duration::from_secs(10);

/// The backend `kinect` for an attached camera.
#[derive(Debug, Clone, Default)]
pub struct LiveBackend {
    config: LiveConfig,
    root: SysRoot,
}

impl LiveBackend {
    /// A backend for the camera that `config` selects. Nothing is loaded before it is used.
    pub fn new(config: LiveConfig) -> Self {
        Self { config, root: SysRoot::default() }
    }

    /// The same, for a tree of `/sys` and `/dev` that is somewhere else.
    #[must_use]
    pub fn with_root(mut self, root: SysRoot) -> Self {
        self.root = root;
        self
    }

    /// The cameras on the bus; empty if it cannot be read, since libk4a has its own access to it.
    fn on_bus(&self) -> Vec<FoundCamera> {
        scan(&self.root).map(|d| find::cameras(&d)).unwrap_or_default()
    }

    /// Opens every camera that can be, and says why the others cannot.
    fn open_all(&self, library: &'static Loaded) -> (Vec<(Handle, DeviceInfo)>, Vec<Error>) {
        let on_bus = self.on_bus();
        let mut opened = Vec::new();
        let mut failed = Vec::new();
        for index in 0..handle::count(library) {
            let asked = Handle::open(library, index).and_then(|camera| {
                let info = info(&camera, &camera.serial()?, &on_bus);
                Ok((camera, info))
            });
            match asked {
                Ok(camera) => opened.push(camera),
                Err(e) => failed.push(e),
            }
        }
        (opened, failed)
    }

    /// The selected serial number, if any: the one given, or that of the camera at the given port.
    fn wanted(&self, serial: Option<&str>) -> Result<Option<String>> {
        if let Some(serial) = serial.or(self.config.serial.as_deref()) {
            return Ok(Some(serial.to_owned()));
        }
        let Some(port) = &self.config.port else { return Ok(None) };
        let on_bus = self.on_bus();
        let found = find::at_port(&on_bus, port)?;
        match found.serial() {
            Some(serial) => Ok(Some(serial.to_owned())),
            None if on_bus.len() == 1 => Ok(None),
            None => {
                let what = format!(
                    "{}: its descriptors have no serial number; name it by `serial`",
                    found.describe()
                );
                Err(Error::new(ErrorKind::NotFound, what))
            }
        }
    }

    /// The error for a selection that no camera matches.
    fn not_found(&self, wanted: Option<&str>, others: &[DeviceInfo], failed: Vec<Error>) -> Error {
        let on_bus = self.on_bus();
        let is_there = |s: &str| on_bus.iter().find(|f| f.serial() == Some(s));
        let selected = wanted.and_then(is_there).or(if wanted.is_none() { on_bus.first() } else { None });
        let known_absent =
            wanted.is_some_and(|s| is_there(s).is_none() && on_bus.iter().all(|f| f.serial().is_some()));
        let mut list: Vec<String> = others.iter().map(|i| format!("{MODEL} {}", i.serial)).collect();
        list.extend(failed.iter().map(|e| format!("one that cannot be asked ({e})")));
        // The bus shows every serial number and not this one: those that cannot be opened are others.
        let failure = failed.into_iter().next_back().filter(|_| on_bus.is_empty() || !known_absent);
        if let Some(e) = failure {
            let name = selected
                .map_or_else(|| find::describe(wanted.unwrap_or_default(), ""), FoundCamera::describe);
            let held = match (e.kind(), selected) {
                (ErrorKind::Busy, Some(f)) => {
                    format!("; it is held by {}", holders_of(&self.root, &f.depth.node).describe())
                }
                _ => String::new(),
            };
            return Error::new(e.kind(), format!("{name}: {e}{held}")).with_source(e);
        }
        let attached = if list.is_empty() {
            match on_bus.first() {
                Some(f) => format!("{} is attached, but libk4a does not see it", f.describe()),
                None => "none is attached; is it plugged in, and has it its power supply?".to_owned(),
            }
        } else {
            format!("there are: {}", list.join(", "))
        };
        let what = match wanted {
            Some(serial) => format!("there is no {MODEL} with serial number {serial}; {attached}"),
            None if list.is_empty() => format!("there is no {MODEL}: {attached}"),
            None => format!("several {MODEL}s are attached; select one with serial = \"…\"; {attached}"),
        };
        Error::new(ErrorKind::NotFound, what)
    }
}

/// Keeps other openings out: each opens every camera to learn who it is, so that two at once find each other's busy.
fn alone(library: &'static Loaded) -> Result<MutexGuard<'static, ()>> {
    let deadline = HostTime::now().plus(OPENING);
    loop {
        match library.opening.try_lock() {
            Ok(guard) => return Ok(guard),
            Err(TryLockError::Poisoned(guard)) => return Ok(guard.into_inner()),
            Err(TryLockError::WouldBlock) if deadline.from_now().is_zero() => {
                let what =
                    format!("another {MODEL} is being opened for {OPENING:?} already and hangs in libk4a");
                return Err(Error::new(ErrorKind::Busy, what));
            }
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}

fn info(camera: &Handle, serial: &str, on_bus: &[FoundCamera]) -> DeviceInfo {
    let found = on_bus.iter().find(|f| f.serial() == Some(serial)).or(match on_bus {
        [one] if one.serial().is_none() => Some(one),
        _ => None,
    });
    DeviceInfo {
        backend: NAME,
        model: MODEL.to_owned(),
        serial: serial.to_owned(),
        firmware: camera.firmware(),
        port: found.map_or_else(String::new, |f| f.depth.port.clone()),
        calibration: if calibration(camera).is_ok() { "factory" } else { "none" }.to_owned(),
        motion: motion::CORRECTED.to_owned(),
    }
}

fn calibration(camera: &Handle) -> Result<Calibration> {
    Calibration::parse(&camera.raw_calibration()?)
}

impl Backend for LiveBackend {
    fn name(&self) -> &'static str {
        NAME
    }

    /// Every Kinect that no process holds. Each is opened briefly.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        let library = library::load(&self.config.places)?;
        let _alone = alone(library)?;
        let (opened, failed) = self.open_all(library);
        for e in failed {
            tracing::warn!("a Kinect does not say who it is: {e}");
        }
        Ok(opened.into_iter().map(|(_, info)| info).collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let library = library::load(&self.config.places)?;
        let wanted = self.wanted(serial)?;
        let _alone = alone(library)?;
        let (opened, failed) = self.open_all(library);
        let is_selected = |i: &DeviceInfo| wanted.as_ref().is_none_or(|w| *w == i.serial);
        let (mut selected, others): (Vec<_>, Vec<_>) = opened.into_iter().partition(|(_, i)| is_selected(i));
        let is_only = wanted.is_some() || failed.is_empty();
        match (selected.len(), selected.pop()) {
            (1, Some((camera, info))) if is_only => LiveDevice::boxed(camera, info, self),
            (_, last) => {
                let rest = selected.into_iter().chain(last).chain(others).map(|(_, i)| i).collect::<Vec<_>>();
                Err(self.not_found(wanted.as_deref(), &rest, failed))
            }
        }
    }
}

/// An open camera.
struct LiveDevice {
    name: String,
    info: DeviceInfo,
    camera: Handle,
    profiles: Vec<StreamProfile>,
    config: LiveConfig,
    library: &'static Loaded,
}

impl LiveDevice {
    fn boxed(camera: Handle, info: DeviceInfo, of: &LiveBackend) -> Result<Box<dyn Device>> {
        let name = find::describe(&info.serial, &info.port);
        let calibration = calibration(&camera);
        if let Err(e) = &calibration {
            tracing::warn!(camera = name, error = %e, "it streams without a calibration");
        }
        if let Some(slow) =
            of.on_bus().iter().find(|f| f.depth.port == info.port).and_then(|f| health::slow_link(&f.depth))
        {
            tracing::warn!(camera = name, "{slow}");
        }
        let calibration = calibration.ok();
        let profiles = profiles::profiles(&of.config, calibration.as_ref())?;
        let library = library::load(&of.config.places)?;
        let calibration = motion::stated(&info.calibration, calibration.as_ref());
        let info = DeviceInfo { calibration, ..info };
        Ok(Box::new(Self { name, info, camera, profiles, config: of.config.clone(), library }))
    }
}

impl Device for LiveDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let Self { name, camera, profiles, config, library, .. } = *self;
        let named = |e: Error| Error::new(e.kind(), format!("{name}: {e}")).with_source(e);
        let plan = profiles::plan(&name, &config, &profiles, requests)?;
        check_jacks(&camera, config.sync).map_err(named)?;
        if plan.configuration.depth_mode != 0 {
            check_engine(&config.places, library).map_err(named)?;
        }
        controls::apply(&name, &camera, &config.color_controls)?;
        camera.start(&plan.configuration).map_err(named)?;
        if plan.profiles.iter().any(|p| p.format.is_motion()) {
            camera.start_imu().map_err(named)?;
        }
        for p in &plan.profiles {
            tracing::info!(camera = %name, library = %library.path.display(), "started {}", p.describe());
        }
        Ok(Box::new(LiveStream::new(name, camera, plan.profiles, config.sync)))
    }
}

/// libk4a refuses a part in a wired group without its cable; this says which.
fn check_jacks(camera: &Handle, sync: WiredSync) -> Result<()> {
    let wanted = match sync {
        WiredSync::Standalone => return Ok(()),
        WiredSync::Master => "Sync out",
        WiredSync::Subordinate => "Sync in",
    };
    let (into, out) = camera.sync_jacks()?;
    if if sync == WiredSync::Master { out } else { into } {
        return Ok(());
    }
    let what = format!("no cable is in its jack \"{wanted}\", which sync = \"{}\" needs", sync.name());
    Err(Error::new(ErrorKind::Io, what))
}

/// libk4a looks for the engine when depth is started, and then says only that it failed.
fn check_engine(places: &Places, library: &Loaded) -> Result<()> {
    library::load_engine(places, &library.path).map(|found| {
        if let Some(path) = found {
            tracing::debug!(engine = %path.display(), "the depth engine");
        }
    })
}
