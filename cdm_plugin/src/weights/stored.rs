//! The file that weights lie in: read piece by piece, and mapped only for an engine that computes with it in place.
//!
//! A mapped file that becomes shorter ends the process with SIGBUS where it is read; a read becomes an error. So looking
//! at a checkpoint, importing it and converting it read, and an engine that needs addresses maps.
#![allow(unsafe_code)] // a mapping is memory that the file system may change

use crate::{Error, ErrorKind, Result};
use core::ops::Range;
use memmap2::Mmap;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Bytes that are read by their place.
pub(crate) trait ReadAt {
    /// How many there are.
    fn len(&self) -> usize;
    /// Fills `part` with those from `at` on.
    fn read_at(&self, at: usize, part: &mut [u8]) -> io::Result<()>;
}

impl ReadAt for &[u8] {
    fn len(&self) -> usize {
        <[u8]>::len(self)
    }

    fn read_at(&self, at: usize, part: &mut [u8]) -> io::Result<()> {
        let from = at.checked_add(part.len()).and_then(|end| self.get(at..end));
        part.copy_from_slice(from.ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }
}

/// The bytes in `range`, which lies within `file`.
pub(crate) fn part(file: &dyn ReadAt, range: Range<usize>) -> io::Result<Vec<u8>> {
    if range.start > range.end || range.end > file.len() {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let mut part = vec![0; range.len()];
    file.read_at(range.start, &mut part)?;
    Ok(part)
}

/// Reads `file` from its beginning to its end.
pub(crate) struct Stream<'a> {
    file: &'a dyn ReadAt,
    at: u64,
}

impl<'a> Stream<'a> {
    pub(crate) const fn new(file: &'a dyn ReadAt) -> Self {
        Self { file, at: 0 }
    }
}

impl Read for Stream<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        let left = (self.file.len() as u64).saturating_sub(self.at);
        let n = to.len().min(usize::try_from(left).unwrap_or(usize::MAX));
        if n > 0 {
            self.file.read_at(self.at as usize, &mut to[..n])?;
        }
        self.at += n as u64;
        Ok(n)
    }
}

impl Seek for Stream<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let (from, by) = match to {
            SeekFrom::Start(at) => (at, 0),
            SeekFrom::End(by) => (self.file.len() as u64, by),
            SeekFrom::Current(by) => (self.at, by),
        };
        self.at = from.checked_add_signed(by).ok_or(io::ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}

/// An open file of weights.
#[derive(Debug)]
pub(crate) struct Stored {
    path: PathBuf,
    file: File,
    len: usize,
    map: OnceLock<Mmap>,
}

impl Stored {
    /// Opens `path`, which is a regular file.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when there is no such file, [`ErrorKind::Io`] when it cannot be read.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let failed = |e: io::Error| failed(path, e);
        // Asked by name first: opening a FIFO would wait for who writes to it.
        let meta = std::fs::metadata(path).map_err(failed)?;
        if !meta.is_file() {
            let what = if meta.is_dir() { "a folder" } else { "no regular file" };
            let message = format!("{} is {what}; the file of a model's weights is needed", path.display());
            return Err(Error::new(ErrorKind::Io, message));
        }
        let file = File::open(path).map_err(failed)?;
        let len = file.metadata().map_err(failed)?.len();
        let len = usize::try_from(len).map_err(|_| failed(io::ErrorKind::FileTooLarge.into()))?;
        Ok(Self { path: path.into(), file, len, map: OnceLock::new() })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The whole file in memory, for an engine that reads its tensors in place.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when it became shorter since it was opened, or cannot be mapped.
    pub(crate) fn mapped(&self) -> Result<&[u8]> {
        if let Some(map) = self.map.get() {
            return Ok(map);
        }
        let failed = |e: io::Error| failed(&self.path, e);
        if self.file.metadata().map_err(failed)?.len() < self.len as u64 {
            return Err(failed(io::ErrorKind::UnexpectedEof.into()));
        }
        // SAFETY: the map is read-only. depthrig never changes the weights of an installed model: new ones are renamed
        // over them and removed ones lose their name, both of which leave this map's inode alone. Somebody who truncates
        // the file by hand while an engine runs makes this process end with SIGBUS, as with any mapped file.
        let map = unsafe { Mmap::map(&self.file) }.map_err(failed)?;
        Ok(self.map.get_or_init(|| map))
    }
}

impl ReadAt for Stored {
    fn len(&self) -> usize {
        self.len
    }

    fn read_at(&self, at: usize, part: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(part, at as u64)
    }
}

/// That the file at `path` could not be read, and what to do.
pub(crate) fn failed(path: &Path, e: io::Error) -> Error {
    let kind = if e.kind() == io::ErrorKind::NotFound { ErrorKind::NotFound } else { ErrorKind::Io };
    let what = match e.kind() {
        io::ErrorKind::NotFound => "there is no such file".to_owned(),
        io::ErrorKind::UnexpectedEof => {
            "it became shorter while it was read; is it still being written or copied? try again when that is done"
                .to_owned()
        }
        _ => format!("cannot be read: {e}"),
    };
    Error::new(kind, format!("{}: {what}", path.display())).with_source(e)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reading a map beyond the end of its file would end the process.
    #[test]
    fn a_file_that_became_shorter_is_not_mapped() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("weights");
        std::fs::write(&path, vec![7; 100_000]).unwrap();
        let whole = Stored::open(&path).unwrap();
        assert_eq!(whole.mapped().unwrap().len(), 100_000);
        let shorter = Stored::open(&path).unwrap();
        File::options().write(true).open(&path).unwrap().set_len(10).unwrap();
        let e = shorter.mapped().unwrap_err();
        assert!(e.kind() == ErrorKind::Io && e.to_string().contains("became shorter"), "{e}");
    }
}
