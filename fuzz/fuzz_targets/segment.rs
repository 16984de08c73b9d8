//! A segment of a dataset: opened, read, verified.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::{fuzz_mutator, fuzz_target};

mod mutator;

fuzz_target!(|bytes: &[u8]| {
    fuzzing::segment(bytes);
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    mutator::mutate(data, size, max_size, seed)
});
