//! What the fuzz targets in `fuzz/` call, and the test that runs their corpus: bytes that may be anything, through
//! the ways in that a file has. `docs/fuzzing.md` says how they are run.
//!
//! A panic is a finding; so is a broken promise, which is why there are assertions here. Each function returns how
//! far its input came, so that a corpus which no longer reaches anything is noticed.

use crate::fs::{Fs, MemFs};
use crate::recorder::topics::Topics;
use crate::{
    Dataset, PixelMode, RecorderOptions, SESSION_FILE, Session, SetRange, VerifyOptions, verify_with,
};
use std::path::Path;
use std::sync::Arc;

pub mod mcap;

/// A folder in memory with one file in it.
fn folder(name: &str, bytes: &[u8]) -> (Arc<dyn Fs>, &'static Path) {
    let (fs, dir) = (MemFs::new(), Path::new("/d"));
    // Cannot fail: nothing fails on this file system unless told to.
    drop(fs.create_dir_all(dir));
    fs.put(&dir.join(name), bytes.to_vec());
    (Arc::new(fs), dir)
}

/// A segment on its own in a folder, opened, read and verified; the number of its sets that can be decoded.
///
/// # Panics
/// When what `verify` finds whole cannot be read.
pub fn segment(bytes: &[u8]) -> u64 {
    let (fs, dir) = folder("seg_0000.mcap", bytes);
    let options = VerifyOptions { decode: true, ..VerifyOptions::default() };
    let report = verify_with(&fs, dir, &options).ok();
    let Ok(dataset) = Dataset::open_with(fs, dir) else { return 0 };
    drop(dataset.info());
    let good = |mode| dataset.sets_with(SetRange::ALL, mode).filter_map(Result::ok).count() as u64;
    let (decoded, marked) = (good(PixelMode::Decoded), good(PixelMode::None));
    // The missing session.toml is always found; anything else that is wrong with the file has a place in it.
    let broken_here = |f: &crate::Finding| f.severity > crate::Severity::Note && f.file != SESSION_FILE;
    if let Some(report) = report.filter(|r| !r.findings.iter().any(broken_here)) {
        let sets = report.sets;
        assert_eq!((decoded, marked), (sets, sets), "verified as whole, and not all sets can be read");
    }
    decoded
}

/// A `session.toml`, alone in its folder: read, used as a recorder would, written and read again; whether it
/// could be read.
///
/// # Panics
/// When a session changes by being written and read.
pub fn session(bytes: &[u8]) -> bool {
    let (fs, dir) = folder(SESSION_FILE, bytes);
    drop(verify_with(&fs, dir, &VerifyOptions::default()));
    let Ok(dataset) = Dataset::open_with(fs, dir) else { return false };
    drop(dataset.info());
    let session = dataset.session();
    if session.check().is_ok() {
        drop(Topics::new(session, &RecorderOptions::default()).preamble(session, 0));
    }
    // Compared as text, because a session may hold NaN.
    if let Ok(text) = session.to_toml() {
        let again = Session::from_toml(&text, dir).and_then(|s| s.to_toml());
        assert!(again.is_ok_and(|again| again == text), "a session changes by being written and read");
    }
    true
}
