//! A file that is named `….part` while it grows.

use crate::fs::{self, Fs, WriteFile};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Bytes that are written together.
const CHUNK: usize = 64 << 10;

/// A new file that gets its name when it is complete.
pub(super) struct GrowingFile<'a> {
    fs: &'a dyn Fs,
    out: Box<dyn WriteFile>,
    path: PathBuf,
    part: PathBuf,
    /// Bytes that are not written yet.
    waiting: Vec<u8>,
    /// All bytes so far.
    pub(super) bytes: u64,
}

impl<'a> GrowingFile<'a> {
    /// Creates the part of `path`.
    pub(super) fn create(fs: &'a dyn Fs, path: &Path) -> Result<Self> {
        let mut part = path.as_os_str().to_owned();
        part.push(".part");
        let part = PathBuf::from(part);
        let out = fs.create_new(&part).map_err(|e| Error::io("create", &part, e))?;
        Ok(Self { fs, out, path: path.to_owned(), part, waiting: Vec::new(), bytes: 0 })
    }

    /// Appends `bytes`.
    pub(super) fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.waiting.extend_from_slice(bytes);
        self.bytes += bytes.len() as u64;
        if self.waiting.len() < CHUNK { Ok(()) } else { self.flush() }
    }

    /// Writes what waits.
    pub(super) fn flush(&mut self) -> Result<()> {
        fs::write_all(&mut *self.out, &self.waiting).map_err(|e| Error::io("write", &self.part, e))?;
        self.waiting.clear();
        Ok(())
    }

    /// Makes the file durable and gives it its name.
    pub(super) fn finish(mut self) -> Result<()> {
        self.flush()?;
        self.out.sync_all().map_err(|e| Error::io("sync", &self.part, e))?;
        self.fs.rename(&self.part, &self.path).map_err(|e| Error::io("rename", &self.part, e))?;
        let dir = self.path.parent().unwrap_or(&self.path);
        self.fs.sync_dir(dir).map_err(|e| Error::io("sync the folder", dir, e))
    }
}
