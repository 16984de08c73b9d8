//! The description that a RealSense camera gives of itself.
#![no_main]

use depthrig_drivers::fuzzing::realsense;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    realsense::gvd(bytes);
});
