//! The depth codec: packed pictures from nowhere, and any picture there and back.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::depth_codec(bytes);
});
