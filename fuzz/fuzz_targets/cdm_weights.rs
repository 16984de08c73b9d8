//! A file of a model's weights: .safetensors, or a checkpoint of PyTorch.
#![no_main]

use depthrig_cdm::fuzzing;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::weights(bytes);
});
