//! A ZED's factory calibration; also its command blocks and IMU records.
#![no_main]

use depthrig_zed::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::conf(bytes);
});
