//! A calibration table of a RealSense D400.
#![no_main]

use depthrig_drivers::fuzzing::realsense;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    realsense::tables(bytes);
});
