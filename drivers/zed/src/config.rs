//! The configuration of a ZED in a rig.

use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A ZED and its settings. A setting that is `None` stays as the camera has it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ZedConfig {
    /// Serial number; `None`: the one at `port`, or the only one.
    pub serial: Option<String>,
    /// Port path of the video half on the bus, such as `4-1`.
    pub port: Option<String>,
    /// Where the factory calibration is.
    pub calibration: CalibrationFile,
    /// Whether the camera regulates exposure and gain.
    pub auto_exposure: Option<bool>,
    /// Exposure of both cameras, percent of the longest at the frame rate; setting it switches the regulation off.
    pub exposure_percent: Option<u8>,
    /// Gain of both cameras, percent; setting it switches the regulation off.
    pub gain_percent: Option<u8>,
    /// The light on the front.
    pub led: Option<bool>,
    /// Controls of the kernel by their names: `white_balance_temperature`, …
    pub controls: BTreeMap<String, ControlValue>,
    /// Do without the IMU.
    pub without_motion: bool,
}

/// Where the factory calibration is.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum CalibrationFile {
    /// Where the vendor's programs keep it; without a file there, the camera streams uncalibrated and says so.
    #[default]
    Known,
    /// In this file, which must be there.
    At(PathBuf),
    /// Nowhere: the camera streams uncalibrated.
    None,
}
