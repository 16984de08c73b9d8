//! PNG and JPEG of a colour stream.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::color_codec(bytes);
});
