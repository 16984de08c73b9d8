//! The IMU of a camera that is opened, and switching it on.

use super::{BATCH, Imu, Sensors};
use crate::iio::{self, Found, Sensor, Switch};
use crate::motion::{self, IMU};
use crate::realsense::protocol::hwm::HardwareMonitor;
use crate::realsense::protocol::imu::{ImuCalibration, Place, Rates, rates_of};
use crate::usb::SysRoot;
use crate::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};
use depthrig_bus::MetadataLevel;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};

const ACCELERATION: [&str; 3] = ["in_accel_x", "in_accel_y", "in_accel_z"];
const ROTATION: [&str; 3] = ["in_anglvel_x", "in_anglvel_y", "in_anglvel_z"];

/// An IMU that is not streaming.
#[derive(Debug, Clone)]
pub(in crate::realsense) struct Unit {
    accelerometer: Found,
    gyroscope: Found,
    calibration: ImuCalibration,
    rates: &'static [Rates],
}

/// An IMU whose sensors are being switched on.
pub(in crate::realsense) struct Opening {
    pub(super) label: String,
    pub(super) calibration: ImuCalibration,
    pub(super) rates: Rates,
    pub(super) starting: Receiver<Result<Sensors>>,
    pub(super) stop: SyncSender<()>,
}

/// The requests for images, and that for the IMU.
pub(in crate::realsense) struct Separated {
    pub(in crate::realsense) images: Vec<StreamRequest>,
    pub(in crate::realsense) imu: Option<StreamRequest>,
}

/// Separates the request for the IMU from those for images. It is delivered beside images alone: the clock of both is asked
/// while they stream.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the IMU is all that is asked for.
pub(in crate::realsense) fn separated(label: &str, requests: &[StreamRequest]) -> Result<Separated> {
    let (imu, images): (Vec<_>, Vec<_>) = requests.iter().cloned().partition(|r| r.stream.as_str() == IMU);
    if images.is_empty() && !imu.is_empty() {
        let text =
            format!("{label}: the stream \"{IMU}\" alone is not delivered; list depth or color beside it");
        return Err(Error::new(ErrorKind::Unsupported, text));
    }
    Ok(Separated { images, imu: imu.into_iter().next() })
}

/// The IMU with the mode that was asked for; nothing where it was not.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the model has none; why it cannot be read, with the cure.
pub(in crate::realsense) fn choose_imu(
    label: &str,
    offered: &[StreamProfile],
    asked: Option<&StreamRequest>,
    unit: Option<Result<Unit>>,
) -> Result<Option<(Unit, StreamProfile)>> {
    let Some(request) = asked else { return Ok(None) };
    let unit = unit.ok_or_else(|| {
        Error::new(
            ErrorKind::Unsupported,
            format!("{label}: there is no stream \"{IMU}\": the model has no IMU"),
        )
    })?;
    let unit = unit.map_err(|e| {
        Error::new(e.kind(), format!("{label}: there is no stream \"{IMU}\": {e}")).with_source(e)
    })?;
    let chosen = choose_profiles(label, offered, core::slice::from_ref(request))?;
    Ok(chosen.into_iter().next().map(|profile| (unit, profile)))
}

impl Unit {
    /// The IMU of the camera at `port`.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when the kernel shows no sensors of it, with the cure; those of its table.
    pub(in crate::realsense) fn find(
        root: &SysRoot,
        port: &str,
        monitor: &mut dyn HardwareMonitor,
        place: Place,
        chip: u8,
        product: u16,
    ) -> Result<Self> {
        let sensors = iio::on_port(root, port);
        let named = |name: &str| sensors.iter().find(|s| s.name == name).cloned();
        let (Some(accelerometer), Some(gyroscope)) = (named("accel_3d"), named("gyro_3d")) else {
            let text = "the kernel shows no sensors of its IMU: load the modules hid-sensor-hub, hid-sensor-accel-3d and \
                        hid-sensor-gyro-3d";
            return Err(Error::new(ErrorKind::NotFound, text));
        };
        let calibration = ImuCalibration::read(monitor, place, product)?;
        Ok(Self { accelerometer, gyroscope, calibration, rates: rates_of(place, chip) })
    }

    /// Whether sensitivity and bias are the camera's own.
    pub(in crate::realsense) const fn is_calibrated(&self) -> bool {
        self.calibration.is_calibrated
    }

    /// The stream's modes, the default first.
    ///
    /// # Errors
    /// None that can happen: the name is a good one.
    pub(in crate::realsense) fn profiles(&self) -> Result<Vec<StreamProfile>> {
        let clock = DeviceClock::microseconds(32);
        let profile =
            |r: &Rates| motion::profile(r.gyro_hz, BATCH, self.calibration.pose, clock, MetadataLevel::Full);
        self.rates.iter().map(profile).collect()
    }

    /// Starts the thread that switches the sensors on, as stream number `stream`.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] with the cure when this user may not read them; [`ErrorKind::Io`].
    pub(in crate::realsense) fn start(
        self,
        stream: usize,
        profile: &StreamProfile,
        label: &str,
    ) -> Result<Imu> {
        let samples_hz = profile.rate_hz * f64::from(profile.width);
        let rates = self.rates.iter().find(|r| (r.gyro_hz - samples_hz).abs() < 0.01).copied();
        let rates = rates.ok_or_else(|| {
            Error::new(
                ErrorKind::Unsupported,
                format!("{label}: its IMU has no {samples_hz} samples a second"),
            )
        })?;
        // Whether this user may is said at once, and not by the thread.
        let mut sensors = Sensors {
            accelerometer: Sensor::open(&self.accelerometer, ACCELERATION)?,
            gyroscope: Sensor::open(&self.gyroscope, ROTATION)?,
        };
        let (send, starting) = sync_channel(1);
        let (stop, stopped) = sync_channel::<()>(1);
        let Self { accelerometer, gyroscope, calibration, .. } = self;
        let thread = std::thread::Builder::new().name("realsense-imu".to_owned());
        let run = move || {
            let turn = switching(&accelerometer.folder);
            let switches = switch_on([&accelerometer, &gyroscope], &mut sensors, &rates, turn);
            let failed = match switches {
                Ok(switches) => {
                    // Nobody listens when the stream has ended meanwhile; then the wait below ends at once.
                    let _ = send.send(Ok(sensors));
                    // It ends when the stream is dropped.
                    let _ = stopped.recv();
                    switch_off(&accelerometer, turn, &switches)
                }
                Err(e) => {
                    let _ = send.send(Err(e));
                    Ok(())
                }
            };
            if let Err(e) = failed {
                tracing::debug!("the IMU is not switched off: {e}");
            }
        };
        thread.spawn(run).map_err(|e| {
            Error::new(ErrorKind::Io, format!("{label}: no thread for its IMU")).with_source(e)
        })?;
        let opening = Opening { label: label.to_owned(), calibration, rates, starting, stop };
        Ok(Imu::new(stream, profile, opening))
    }
}

/// Who switched which sensor on last: a stream that is ended late must not switch off the sensors of the next one.
static TURNS: Mutex<BTreeMap<PathBuf, u64>> = Mutex::new(BTreeMap::new());

fn switching(folder: &std::path::Path) -> u64 {
    let mut turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
    let turn = turns.entry(folder.to_owned()).or_default();
    *turn += 1;
    *turn
}

fn switch_on(found: [&Found; 2], sensors: &mut Sensors, rates: &Rates, turn: u64) -> Result<[Switch; 2]> {
    let [accelerometer, gyroscope] = found;
    let turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
    let accel = Switch::prepare(accelerometer, ACCELERATION)?;
    let gyro = Switch::prepare(gyroscope, ROTATION)?;
    accel.write("in_accel_sampling_frequency", rates.accel_selector)?;
    gyro.write("in_anglvel_sampling_frequency", rates.gyro_selector)?;
    if turns.get(&accelerometer.folder) == Some(&turn) {
        // What somebody left unread is not of this stream.
        sensors.accelerometer.drain(|_| {})?;
        sensors.gyroscope.drain(|_| {})?;
        accel.on()?;
        gyro.on()?;
    }
    Ok([accel, gyro])
}

fn switch_off(accelerometer: &Found, turn: u64, switches: &[Switch; 2]) -> Result<()> {
    let turns = TURNS.lock().unwrap_or_else(PoisonError::into_inner);
    if turns.get(&accelerometer.folder) == Some(&turn) {
        for switch in switches {
            switch.off()?;
        }
    }
    Ok(())
}
