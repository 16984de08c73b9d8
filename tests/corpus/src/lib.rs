//! Inputs of the fuzz targets, for tests: seeds, a selection of what the fuzzer found, and every input that failed once.
//!
//! One archive a target, `fuzz/corpus/TARGET.zip`; `tools/corpus.py` unpacks and packs them.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // test support: a failure here is a failed test

use std::io::Read;
use std::path::Path;

/// An input of a fuzz target.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Input {
    /// Its name: `seed_…` was written by hand, `crash_…` failed once, any other is the hash of its bytes.
    pub name: String,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

impl Input {
    /// Whether it was written by hand, to reach a certain part of the code.
    pub fn is_seed(&self) -> bool {
        self.name.starts_with("seed_")
    }
}

/// Every input of `target`, in the order of their names.
///
/// # Panics
/// When the archive is missing, damaged or empty.
pub fn inputs(target: &str) -> Vec<Input> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../../fuzz/corpus/{target}.zip"));
    let file = std::fs::File::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut archive = zip::ZipArchive::new(file).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let mut inputs = Vec::with_capacity(archive.len());
    for i in 0..archive.len() {
        let mut member = archive.by_index(i).unwrap();
        let name = member.name().unwrap().into_owned();
        let mut bytes = Vec::new();
        member.read_to_end(&mut bytes).unwrap();
        inputs.push(Input { name, bytes });
    }
    assert!(!inputs.is_empty(), "{} holds no input", path.display());
    inputs.sort();
    inputs
}

/// Changes an input by up to four bytes, by cutting it, or by repeating a part of it.
fn mutated(bytes: &[u8], mut seed: u64) -> Vec<u8> {
    let mut next = |below: usize| {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        (seed >> 11) as usize % below.max(1)
    };
    let mut out = bytes.to_vec();
    for _ in 0..=next(4) {
        let at = next(out.len());
        let value = [0, 0xFF, 0x80, 0x7F, next(256) as u8][next(5)];
        match next(8) {
            0 => out.truncate(at),
            1 => {
                let part = out.get(at..(at + next(40)).min(out.len())).unwrap_or_default().to_vec();
                out.splice(at.min(out.len())..at.min(out.len()), part);
            }
            _ => out.iter_mut().skip(at).take(1 + next(4)).for_each(|b| *b = value),
        }
    }
    out
}

/// Gives `reached` each input of `target`, and each with 300 mutations (100 000 with `DEPTHRIG_LONG=1`). It returns how
/// far an input came.
///
/// # Panics
/// When a seed no longer reaches anything, or the target has no seed.
pub fn run(target: &str, reached: impl Fn(&[u8]) -> u64) {
    let mutations = if std::env::var_os("DEPTHRIG_LONG").is_some() { 100_000 } else { 300 };
    let mut seeds = 0;
    for input in inputs(target) {
        println!("{target}/{}", input.name);
        let far = reached(&input.bytes);
        for n in 1..=mutations {
            reached(&mutated(&input.bytes, u64::wrapping_mul(n, 0x9E37_79B9_7F4A_7C15)));
        }
        if input.is_seed() {
            seeds += 1;
            assert!(far > 0, "{target}/{} reaches nothing: write the seeds again", input.name);
        }
    }
    assert!(seeds > 0, "{target} has no seeds");
}
