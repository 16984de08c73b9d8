//! Payload headers and the records of a metadata node.
#![no_main]

use depthrig_realsense::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::metadata(bytes);
});
