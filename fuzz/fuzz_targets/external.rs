//! What a process that serves a camera says to the daemon, and the daemon to it.
#![no_main]

use depthrig_drivers::fuzzing::external;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    external::handshake(bytes);
});
