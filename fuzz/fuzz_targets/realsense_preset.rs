//! A preset of a RealSense D400, as a person writes it.
#![no_main]

use depthrig_drivers::fuzzing::realsense;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    realsense::preset(bytes);
});
