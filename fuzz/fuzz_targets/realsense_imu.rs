//! The table of a RealSense IMU.
#![no_main]

use depthrig_realsense::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::imu(bytes);
});
