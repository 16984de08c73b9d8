//! The IMU of a camera that is opened.

use super::revival::Revival;
use super::switch::{ACCELERATION, COLD, Pair, ROTATION, Switcher};
use super::{BATCH, Imu, Sensors};
use crate::iio::{self, FoundSensor, Sensor};
use crate::protocol::hwm::HardwareMonitor;
use crate::protocol::imu::{ImuCalibration, Place, Rates, rates_of};
use depthrig_bus::{HostTime, MetadataLevel};
use depthrig_driver::motion::{self, IMU};
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};
use depthrig_usb::SysRoot;

/// An IMU that is not streaming.
#[derive(Debug, Clone)]
pub(crate) struct Unit {
    root: SysRoot,
    accelerometer: FoundSensor,
    gyroscope: FoundSensor,
    calibration: ImuCalibration,
    rates: &'static [Rates],
}

/// An IMU whose sensors are being switched on.
pub(crate) struct Opening {
    pub(super) label: String,
    pub(super) calibration: ImuCalibration,
    pub(super) rates: Rates,
    pub(super) sensors: Sensors,
    pub(super) switcher: Switcher,
    pub(super) revival: Revival,
}

/// The requests for images, and that for the IMU.
pub(crate) struct Separated {
    /// `None`: no images at all. An empty list asks for the default streams.
    pub(crate) images: Option<Vec<StreamRequest>>,
    pub(crate) imu: Option<StreamRequest>,
}

/// Separates the request for the IMU from those for images.
pub(crate) fn separated(requests: &[StreamRequest]) -> Separated {
    let (imu, images): (Vec<_>, Vec<_>) = requests.iter().cloned().partition(|r| r.stream.as_str() == IMU);
    let is_alone = images.is_empty() && !imu.is_empty();
    Separated { images: (!is_alone).then_some(images), imu: imu.into_iter().next() }
}

/// The IMU with the mode that was asked for; nothing where it was not.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the model has none; why it cannot be read, with the cure.
pub(crate) fn choose_imu(
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
    pub(crate) fn find(
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
        let root = root.clone();
        Ok(Self { root, accelerometer, gyroscope, calibration, rates: rates_of(place, chip) })
    }

    /// Whether sensitivity and bias are the camera's own.
    pub(crate) const fn is_calibrated(&self) -> bool {
        self.calibration.is_calibrated
    }

    /// For [`depthrig_driver::DeviceInfo::motion`].
    pub(crate) fn stated(&self) -> String {
        self.calibration.stated()
    }

    /// The stream's modes, the default first.
    ///
    /// # Errors
    /// None that can happen: the name is a good one.
    pub(crate) fn profiles(&self) -> Result<Vec<StreamProfile>> {
        let clock = DeviceClock::microseconds(32);
        let profile =
            |r: &Rates| motion::profile(r.gyro_hz, BATCH, self.calibration.pose, clock, MetadataLevel::Full);
        self.rates.iter().map(profile).collect()
    }

    /// Opens the sensors and starts the thread that switches them on, as stream number `stream`.
    ///
    /// # Errors
    /// [`ErrorKind::PermissionDenied`] with the cure when this user may not read them; [`ErrorKind::Busy`] naming the
    /// program that does; [`ErrorKind::Io`].
    pub(crate) fn start(self, stream: usize, profile: &StreamProfile, label: &str) -> Result<Imu> {
        let samples_hz = profile.rate_hz * f64::from(profile.width);
        let rates = self.rates.iter().find(|r| (r.gyro_hz - samples_hz).abs() < 0.01).copied();
        let rates = rates.ok_or_else(|| {
            Error::new(
                ErrorKind::Unsupported,
                format!("{label}: its IMU has no {samples_hz} samples a second"),
            )
        })?;
        let Self { root, accelerometer, gyroscope, calibration, .. } = self;
        let open = |found: &FoundSensor, axes| {
            Sensor::open(&root, found, axes)
                .map_err(|e| Error::new(e.kind(), format!("{label}: its IMU: {e}")).with_source(e))
        };
        let sensors = Sensors {
            accelerometer: open(&accelerometer, ACCELERATION)?,
            gyroscope: open(&gyroscope, ROTATION)?,
        };
        let pair = Pair { accelerometer, gyroscope, rates, cold: COLD };
        let switcher = Switcher::spawn(pair, label)?;
        let revival = Revival::new(HostTime::now());
        let opening = Opening { label: label.to_owned(), calibration, rates, sensors, switcher, revival };
        Ok(Imu::new(stream, profile, opening))
    }
}
