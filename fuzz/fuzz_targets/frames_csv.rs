//! A line of the `frames.csv` of an export.
#![no_main]

use depthrig_convert::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::frames_csv(bytes);
});
