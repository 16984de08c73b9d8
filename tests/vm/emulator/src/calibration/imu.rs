//! The calibration of an IMU: sensitivity and bias of both sensors, and its pose.

use super::{Spread, rotation};

/// The calibration of an IMU, along the axes of the depth camera.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuCalibration {
    /// Correction of acceleration, m/s².
    pub accelerometer: ImuAxes,
    /// Correction of rotation, degrees per second.
    pub gyroscope: ImuAxes,
    /// From the depth camera to the IMU: `p_imu = R p_depth + t`, row after row.
    pub rotation: [f32; 9],
    /// Metres.
    pub translation_m: [f32; 3],
}

/// Correction of one sensor: `sensitivity * measured - bias`.
#[derive(Debug, Clone, PartialEq)]
pub struct ImuAxes {
    /// Row after row.
    pub sensitivity: [f32; 9],
    /// In the sensor's unit.
    pub bias: [f32; 3],
}

impl ImuCalibration {
    pub(super) fn new(spread: &Spread<'_>) -> Self {
        let axes = |name: &str, bias: f32| ImuAxes {
            sensitivity: core::array::from_fn(|at| {
                let off = spread.at(&format!("{name} {at}"));
                if at % 4 == 0 { 1.0 + 0.02 * off } else { 0.005 * off }
            }),
            bias: core::array::from_fn(|at| bias * spread.at(&format!("{name} bias {at}"))),
        };
        Self {
            accelerometer: axes("accelerometer", 0.2),
            gyroscope: axes("gyroscope", 0.3),
            rotation: rotation(["a", "b", "c"].map(|n| 0.01 * spread.at(&format!("imu angle {n}")))),
            translation_m: [
                -0.005_52 + 0.0002 * spread.at("imu x"),
                0.005_1 + 0.0002 * spread.at("imu y"),
                0.011_74 + 0.0002 * spread.at("imu z"),
            ],
        }
    }
}
