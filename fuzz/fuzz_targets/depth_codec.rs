//! The depth codec: decodes arbitrary bytes, and round-trips any image.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::depth_codec(bytes);
});
