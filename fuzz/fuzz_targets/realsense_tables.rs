//! A calibration table of a RealSense D400.
#![no_main]

use depthrig_realsense::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::tables(bytes);
});
