//! Entry points of the fuzz targets in `fuzz/`, and the test that runs their corpus: arbitrary files of weights.
//!
//! A panic is a finding, and so is a tensor that lies outside of its file. Each function returns how far its input came.

use crate::weights::fuzzing;

/// A file of weights of any kind; the number of its tensors.
///
/// # Panics
/// When a tensor lies outside of the file, or has not as many bytes as its shape says.
pub fn weights(bytes: &[u8]) -> usize {
    fuzzing::file(bytes)
}

/// The list of tensors within a checkpoint of PyTorch; the number of values that it makes.
///
/// # Panics
/// When it makes more values than it has bytes.
pub fn pickle(bytes: &[u8]) -> usize {
    fuzzing::list(bytes)
}

/// A checkpoint of PyTorch around a list of tensors: what a mutated archive seldom reaches. The number of its tensors.
///
/// # Panics
/// As [`weights`].
pub fn checkpoint(bytes: &[u8]) -> usize {
    fuzzing::around(bytes)
}

/// The record of an installed model; whether it is one.
///
/// # Panics
/// When a record changes by being written and read.
pub fn record(bytes: &[u8]) -> bool {
    core::str::from_utf8(bytes).is_ok_and(crate::store::fuzz_record)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_corpus::inputs;

    /// Runs every input that is kept for a target, and sees that the seeds still reach what they were made for.
    fn run(target: &str, reached: impl Fn(&[u8]) -> usize, at_least: usize) {
        let mut seeds = 0;
        for input in inputs(target) {
            println!("{target}/{}", input.name);
            let far = reached(&input.bytes);
            if input.is_seed() {
                seeds += 1;
                assert!(far >= at_least, "{target}/{} reaches {far}: write the seeds again", input.name);
            }
        }
        assert!(seeds > 0, "{target} has no seeds");
    }

    #[test]
    fn kept_inputs_end_well() {
        run("cdm_weights", weights, 2);
        run("cdm_pickle", pickle, 20);
        run("cdm_record", |bytes| usize::from(record(bytes)), 1);
        // In the archive the storages are larger than the 64 bytes here; these fit.
        let halves = inputs("cdm_pickle").into_iter().find(|i| i.name == "seed_halves").unwrap();
        assert_eq!(checkpoint(&halves.bytes), 3);
        run("cdm_pickle", checkpoint, 0);
    }
}
