//! libFuzzer's mutations, where the format of an MCAP file leaves room for them.

use depthrig_recorder::fuzzing::mcap;
use libfuzzer_sys::fuzzer_mutate;

/// Mutates `data` in place, as `fuzz_mutator!` asks.
pub fn mutate(data: &mut [u8], size: usize, max_size: usize, seed: u32) -> usize {
    let mut change = |bytes: &[u8]| {
        let mut room = bytes.to_vec();
        room.resize(bytes.len() + 64, 0);
        let len = fuzzer_mutate(&mut room, bytes.len(), bytes.len() + 64);
        room.truncate(len);
        room
    };
    match mcap::mutate(&data[..size], u64::from(seed), &mut change) {
        Some(out) if out.len() <= max_size => {
            data[..out.len()].copy_from_slice(&out);
            out.len()
        }
        _ => fuzzer_mutate(data, size, max_size),
    }
}
