//! Messages between a process that serves a camera and the daemon, both directions.
#![no_main]

use depthrig_external::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::handshake(bytes);
});
