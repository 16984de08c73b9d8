//! An IMU in a folder: the files of its sensors, and pipes in place of their nodes.

use super::revival::Revival;
use super::switch::{ACCELERATION, Pair, ROTATION, Switcher};
use super::unit::Opening;
use super::{BATCH, Imu, Sensors};
use crate::iio::{FoundSensor, Sensor};
use crate::protocol::imu::{ImuCalibration, Place, rates_of};
use core::time::Duration;
use depthrig_bus::{HostTime, MetadataLevel, Pose};
use depthrig_driver::motion;
use depthrig_driver::{DeviceClock, StreamProfile};
use depthrig_usb::SysRoot;
use rustix::fs::{CWD, FileType, Mode, mknodat};
use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::path::Path;

/// Silence that is left alone, and how long silent sensors stay off.
const SILENCE: Duration = Duration::from_millis(200);
pub(crate) const COLD: Duration = Duration::from_millis(800);
/// Microseconds between two samples of either sensor.
const PERIOD_US: u32 = 2500;

/// The files of an IMU, and the ends of its pipes that the sensors write.
pub(crate) struct FakeImu {
    folder: tempfile::TempDir,
    pipes: Vec<File>,
    ticks: u32,
    /// The longest that silent sensors stay off.
    pub(crate) cold: Duration,
}

impl FakeImu {
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for (name, axes) in [("accel_3d", ACCELERATION), ("gyro_3d", ROTATION)] {
            let sensor = folder.path().join(name);
            std::fs::create_dir_all(sensor.join("scan_elements")).unwrap();
            std::fs::create_dir_all(sensor.join("buffer")).unwrap();
            for (at, element) in axes.into_iter().chain(["in_timestamp"]).enumerate() {
                let element = sensor.join("scan_elements").join(element);
                let kind = if at == 3 { "le:s64/64>>0" } else { "le:s32/32>>0" };
                std::fs::write(format!("{}_index", element.display()), format!("{at}\n")).unwrap();
                std::fs::write(format!("{}_type", element.display()), format!("{kind}\n")).unwrap();
            }
            mknodat(CWD, sensor.join("node"), FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        }
        Self { folder, pipes: Vec::new(), ticks: 0, cold: COLD }
    }

    fn found(&self, name: &str) -> FoundSensor {
        let folder = self.folder.path().join(name);
        FoundSensor { name: name.to_owned(), node: folder.join("node"), folder }
    }

    /// Its one mode.
    pub(crate) fn profile() -> StreamProfile {
        let clock = DeviceClock::microseconds(32);
        motion::profile(400.0, BATCH, Pose::IDENTITY, clock, MetadataLevel::Full).unwrap()
    }

    /// The driver of it, as stream number `stream`.
    pub(crate) fn open(&mut self, stream: usize) -> Imu {
        let accelerometer = self.found("accel_3d");
        let gyroscope = self.found("gyro_3d");
        let root = SysRoot::new(self.folder.path());
        let sensors = Sensors {
            accelerometer: Sensor::open(&root, &accelerometer, ACCELERATION).unwrap(),
            gyroscope: Sensor::open(&root, &gyroscope, ROTATION).unwrap(),
        };
        let pipe = |found: &FoundSensor| OpenOptions::new().write(true).open(&found.node).unwrap();
        self.pipes = vec![pipe(&accelerometer), pipe(&gyroscope)];
        let rates = rates_of(Place::L515, 0)[0];
        let pair = Pair { accelerometer, gyroscope, rates, cold: self.cold };
        let opening = Opening {
            label: "D435i".to_owned(),
            calibration: ImuCalibration::drawn(0),
            rates,
            sensors,
            switcher: Switcher::spawn(pair, "D435i").unwrap(),
            revival: Revival::new(HostTime::now()).with_silence(SILENCE),
        };
        Imu::new(stream, &Self::profile(), opening)
    }

    /// Whether both sensors are on.
    pub(crate) fn is_on(&self) -> bool {
        ["accel_3d", "gyro_3d"].iter().all(|name| self.text(name, "buffer/enable") == "1")
    }

    /// Whether both are off.
    pub(crate) fn is_off(&self) -> bool {
        ["accel_3d", "gyro_3d"].iter().all(|name| self.text(name, "buffer/enable") == "0")
    }

    pub(crate) fn text(&self, sensor: &str, file: &str) -> String {
        std::fs::read_to_string(self.folder.path().join(sensor).join(file)).unwrap_or_default()
    }

    /// The folder of a sensor's files.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Time passes without a sample that is sent.
    pub(crate) fn skip(&mut self, samples: u32) {
        self.ticks += samples * PERIOD_US;
    }

    /// Both sensors measure, or the first `sensors` of them.
    pub(crate) fn measure(&mut self, sensors: usize) {
        self.ticks += PERIOD_US;
        for pipe in self.pipes.iter_mut().take(sensors) {
            let mut scan = [1i32, 2, 3, 0].map(i32::to_le_bytes).concat();
            scan.extend((i64::from(self.ticks) * 1000).to_le_bytes());
            pipe.write_all(&scan).unwrap();
        }
    }
}
