//! A payload header of USB video, and transfers of a stream.
#![no_main]

use depthrig_libusb::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::payload(bytes);
});
