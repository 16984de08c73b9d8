//! `session.toml`: read, written and read again.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::session(bytes);
});
