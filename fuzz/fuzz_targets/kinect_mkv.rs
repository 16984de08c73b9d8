//! An Azure Kinect `.mkv`.
#![no_main]

use depthrig_drivers::fuzzing::kinect;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    kinect::recording(bytes);
});
