//! Ways in for the fuzz targets.

use super::{Contents, gathered, parse, pickle, pth};

fn check(file: &[u8], contents: &Contents) -> usize {
    for (name, entry) in &contents.entries {
        let part = file.get(entry.bytes.clone());
        let part = part.unwrap_or_else(|| panic!("{name:?} lies outside of its file"));
        let numbers = entry.strides.as_ref().map_or_else(|| part.to_vec(), |s| gathered(part, entry, s));
        assert_eq!(numbers.len(), entry.count() * entry.dtype.bytes(), "{name:?}");
    }
    contents.entries.len()
}

/// A file of any kind.
pub(crate) fn file(bytes: &[u8]) -> usize {
    parse(&bytes).map_or(0, |(_, contents)| check(bytes, &contents))
}

/// A pickle alone.
pub(crate) fn list(bytes: &[u8]) -> usize {
    let made = pickle::read(bytes).map_or(0, |p| p.values.len());
    assert!(made <= bytes.len(), "{} bytes make {made} values", bytes.len());
    made
}

/// A pickle whose storages are all 64 bytes long, at a place that their name says.
pub(crate) fn around(bytes: &[u8]) -> usize {
    const LEN: usize = 64;
    let file = [0; 4 * LEN];
    let Ok(pickle) = pickle::read(bytes) else { return 0 };
    let place = |key: &str| {
        let n: usize = key.parse().ok().filter(|n| *n < 4)?;
        Some(n * LEN..(n + 1) * LEN)
    };
    pth::contents(&pickle, &place).map_or(0, |contents| check(&file, &contents))
}
