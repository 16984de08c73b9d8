//! A probe block of USB video.
#![no_main]

use depthrig_usb::uvc::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::probe(bytes);
});
