//! The `calibration.json` of an export.
#![no_main]

use depthrig_convert::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::calibration_json(bytes);
});
