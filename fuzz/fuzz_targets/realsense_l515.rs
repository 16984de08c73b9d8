//! The tables of a RealSense L515.
#![no_main]

use depthrig_drivers::fuzzing::realsense;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    realsense::l515(bytes);
});
