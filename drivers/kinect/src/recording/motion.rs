//! Samples of a Kinect's accelerometer and gyroscope. SDK (MIT), `include/k4ainternal/matroska_common.h`.

use depthrig_driver::bytes::{f32s_at, u64_at};

/// Bytes of a sample.
pub const SAMPLE_BYTES: usize = 40;

/// One sample, with times of its own on the device's clock.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MotionSample {
    /// When the accelerometer was read, nanoseconds.
    pub accelerometer_ns: u64,
    /// Acceleration, m/s², along the sensor's axes.
    pub acceleration: [f32; 3],
    /// When the gyroscope was read, nanoseconds.
    pub gyroscope_ns: u64,
    /// Rate of rotation, rad/s, about the sensor's axes.
    pub rotation: [f32; 3],
}

/// The samples of a frame of the IMU track. The SDK writes one to a frame and many frames to a block; a frame of
/// several is taken apart as well. An incomplete sample at its end is ignored.
pub fn motion_samples(frame: &[u8]) -> impl Iterator<Item = MotionSample> + '_ {
    frame.chunks_exact(SAMPLE_BYTES).filter_map(|s| {
        Some(MotionSample {
            accelerometer_ns: u64_at(s, 0)?,
            acceleration: f32s_at(s, 8)?,
            gyroscope_ns: u64_at(s, 20)?,
            rotation: f32s_at(s, 28)?,
        })
    })
}
