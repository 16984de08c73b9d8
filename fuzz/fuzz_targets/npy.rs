//! An NPY file, as an import of images reads it.
#![no_main]

use depthrig_convert::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::npy(bytes);
});
