//! The factory calibration of an Azure Kinect: JSON text, and what follows from it for every mode.
//!
//! Keys, order of the parameters, frames and the change from the raw sensor to a mode are those of the Azure Kinect
//! Sensor SDK (MIT): `src/calibration/calibration.c`, `src/transformation/mode_specific_calibration.c` and
//! `intrinsic_transformation.c`. The SDK computes in 32 bits, this in 64.

use super::modes::{ColorResolution, Cut, DepthMode};
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_calib::PoseExt;
use depthrig_driver::{Error, ErrorKind, Result};
use glam::{DAffine3, DMat3, DQuat, DVec3};

mod json;
mod model;

pub use model::{LensModel, RawIntrinsics};

/// Metric radius of a camera whose calibration does not say it: 120 degrees of view.
const DEFAULT_RADIUS: f64 = 1.7;

/// One camera of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraCalibration {
    /// Its lens and sensor.
    pub intrinsics: RawIntrinsics,
    /// How far from the axis on the plane z = 1 the lens was measured.
    pub metric_radius: f64,
    /// The device's frame as this camera sees it: `p_camera = R p_device + t`, metres.
    pub camera_from_device: Pose,
    /// Pixels of the raw sensor that the intrinsics are for.
    pub sensor: (u32, u32),
}

/// Gyroscope or accelerometer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionCalibration {
    /// The device's frame as the sensor sees it: `p_sensor = R p_device + t`, metres.
    pub sensor_from_device: Pose,
}

/// The factory calibration of one device. Its frame, "the device", is that of the depth camera but for what the file
/// says of that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// Depth and infrared.
    pub depth: CameraCalibration,
    /// Colour.
    pub color: CameraCalibration,
    /// The gyroscope, if the file has it.
    pub gyroscope: Option<MotionCalibration>,
    /// The accelerometer, if the file has it.
    pub accelerometer: Option<MotionCalibration>,
}

impl Calibration {
    /// Reads and checks the JSON text of a device (`READ_CALIBRATION`, `calibration.json` in a recording). A zero byte
    /// at its end, as the device sends it, is ignored.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with the key of a value that is missing, not a number, or out of range for a Kinect.
    pub fn parse(text: &[u8]) -> Result<Self> {
        json::parse(text)
    }

    /// Intrinsics of depth and infrared in `mode`.
    ///
    /// ```text
    /// cx_px = cx · sensor width − offset − 0.5      fx_px = fx · sensor width
    /// ```
    pub fn depth_intrinsics(&self, mode: DepthMode) -> Intrinsics {
        self.depth.intrinsics.at(mode.cut())
    }

    /// Intrinsics of colour at `resolution`. Early devices were calibrated in the 16:9 middle of the sensor; their
    /// numbers are moved to the whole sensor first.
    pub fn color_intrinsics(&self, resolution: ColorResolution) -> Intrinsics {
        let (width, height) = self.color.sensor;
        let raw = self.color.intrinsics;
        let whole = if u64::from(width) * 9 == u64::from(height) * 16 {
            // 4096x2304 lies 384 rows below the first of 4096x3072.
            RawIntrinsics { cy: (raw.cy * 2304.0 + 384.0) / 3072.0, fy: raw.fy * 2304.0 / 3072.0, ..raw }
        } else {
            raw
        };
        whole.at(resolution.cut())
    }

    /// The depth camera's frame as the colour camera sees it: `p_color = R p_depth + t`, metres.
    pub fn color_from_depth(&self) -> Pose {
        self.color.camera_from_device.compose(&self.depth.camera_from_device.inverse())
    }

    /// Pose of depth and infrared in the device.
    pub fn depth_in_device(&self) -> Pose {
        self.depth.camera_from_device.inverse()
    }

    /// Pose of colour in the device.
    pub fn color_in_device(&self) -> Pose {
        self.color.camera_from_device.inverse()
    }

    /// How far [`Self::depth_intrinsics`] and [`Self::color_intrinsics`] may be off for this device, pixels: 0 for
    /// every device that was sold. The lens model of some prototypes ([`LensModel::Rational6Kt`]) has terms that
    /// [`Intrinsics`] cannot express.
    pub fn approximation_px(&self, depth: Option<DepthMode>, color: Option<ColorResolution>) -> f64 {
        let of = |c: &CameraCalibration, cut: Cut| c.intrinsics.approximation_px(cut, c.metric_radius);
        let depth = depth.map_or(0.0, |m| of(&self.depth, m.cut()));
        color.map_or(depth, |r| depth.max(of(&self.color, r.cut())))
    }

    /// The JSON text with all of it, for a device that is emulated.
    pub fn build(&self) -> String {
        json::build(self)
    }
}

/// A pose out of nine numbers, row after row, and three.
///
/// # Errors
/// The reason if the nine are not a rotation, or the device would be larger than a metre.
fn pose(rotation: [f64; 9], translation_m: [f64; 3]) -> core::result::Result<Pose, String> {
    let matrix = DMat3::from_cols_array(&rotation).transpose();
    let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
    if off.iter().any(|e| e.is_nan() || e.abs() > 1e-3) || matrix.determinant() < 0.0 {
        return Err(format!("Rotation {rotation:?} is not a rotation"));
    }
    let t = DVec3::from_array(translation_m);
    if t.length().is_nan() || t.length() > 1.0 {
        return Err(format!("Translation {translation_m:?} is more than a metre"));
    }
    let turn = DQuat::from_mat3(&matrix).normalize();
    Ok(Pose::from_affine(&DAffine3::from_rotation_translation(turn, t)))
}

impl RawIntrinsics {
    /// The intrinsics of an image that is `cut` out of the sensor.
    fn at(&self, cut: Cut) -> Intrinsics {
        let width = f64::from(cut.sensor.0);
        let height = f64::from(cut.sensor.1);
        let pinhole = Intrinsics::pinhole(
            self.fx * width,
            self.fy * height,
            // The file counts from the corner of the first pixel, frame headers from its centre.
            self.cx * width - f64::from(cut.offset.0) - 0.5,
            self.cy * height - f64::from(cut.offset.1) - 0.5,
        );
        let [k1, k2, k3, k4, k5, k6] = self.k;
        let coeffs = [k1, k2, self.p1, self.p2, k3, k4, k5, k6];
        Intrinsics { coeffs, model: Distortion::Rational as u32, ..pinhole }
    }
}

fn bad(what: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::BadInput, format!("the Kinect's calibration: {what}"))
}

#[cfg(test)]
mod tests;
