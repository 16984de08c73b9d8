//! Inputs of the fuzz targets, for tests: seeds, a selection of what the fuzzer found, and every input that failed once.
//!
//! One archive a target, `fuzz/corpus/TARGET.zip`; `tools/corpus.py` unpacks and packs them.
#![allow(clippy::unwrap_used)] // test support: a failure here is a failed test

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
