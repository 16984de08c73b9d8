//! The description that a RealSense camera gives of itself.
#![no_main]

use depthrig_realsense::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::gvd(bytes);
});
