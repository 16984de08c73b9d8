//! The factory calibration of an Azure Kinect.
#![no_main]

use depthrig_kinect::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::calibration(bytes);
});
