//! The record of an installed model.
#![no_main]

use depthrig_cdm::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::record(bytes);
});
