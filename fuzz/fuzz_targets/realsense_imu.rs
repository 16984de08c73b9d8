//! The table of a RealSense IMU.
#![no_main]

use depthrig_drivers::fuzzing::realsense;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    realsense::imu(bytes);
});
