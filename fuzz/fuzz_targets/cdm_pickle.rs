//! The list of tensors in a checkpoint of PyTorch: alone, and with storages around it.
#![no_main]

use depthrig_cdm::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::pickle(bytes);
    fuzzing::checkpoint(bytes);
});
