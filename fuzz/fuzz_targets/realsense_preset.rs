//! A preset of a RealSense D400, as a person writes it.
#![no_main]

use depthrig_realsense::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::preset(bytes);
});
