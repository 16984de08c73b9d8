//! A segment of a dataset: opened, read, verified.
#![no_main]

use depthrig_recorder::fuzzing;
use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};

fuzz_target!(|bytes: &[u8]| {
    fuzzing::segment(bytes);
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    mcap_mutator(data, size, max_size, seed)
});

/// libFuzzer's mutations, where the format of the file leaves room for them.
fn mcap_mutator(data: &mut [u8], size: usize, max_size: usize, seed: u32) -> usize {
    let mut change = |bytes: &[u8]| {
        let mut room = bytes.to_vec();
        room.resize(bytes.len() + 64, 0);
        let len = fuzzer_mutate(&mut room, bytes.len(), bytes.len() + 64);
        room.truncate(len);
        room
    };
    match fuzzing::mcap::mutate(&data[..size], u64::from(seed), &mut change) {
        Some(out) if out.len() <= max_size => {
            data[..out.len()].copy_from_slice(&out);
            out.len()
        }
        _ => fuzzer_mutate(data, size, max_size),
    }
}
