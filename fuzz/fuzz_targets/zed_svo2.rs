//! An SVO2 file: its container, header, messages and JPEG strips. H.264 is left to its library.
#![no_main]

use depthrig_zed::replay::svo2;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    svo2::fuzz(bytes);
});
