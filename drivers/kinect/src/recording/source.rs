//! Where a recording's bytes are: a file, or memory for tests and fuzzing.

use depthrig_driver::{Error, ErrorKind, Result};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Bytes that can be read anywhere.
pub trait ReadAt: Send {
    /// How many there are.
    fn size(&self) -> u64;

    /// Fills `to` with the bytes from `at` on.
    ///
    /// # Errors
    /// Those of reading; `UnexpectedEof` when there are fewer.
    fn read_at(&self, at: u64, to: &mut [u8]) -> io::Result<()>;
}

struct FileSource {
    file: File,
    size: u64,
}

impl ReadAt for FileSource {
    fn size(&self) -> u64 {
        self.size
    }

    fn read_at(&self, at: u64, to: &mut [u8]) -> io::Result<()> {
        self.file.read_exact_at(to, at)
    }
}

impl ReadAt for Vec<u8> {
    fn size(&self) -> u64 {
        self.len() as u64
    }

    fn read_at(&self, at: u64, to: &mut [u8]) -> io::Result<()> {
        let from = usize::try_from(at).ok().and_then(|at| self.get(at..)?.get(..to.len()));
        to.copy_from_slice(from.ok_or(io::ErrorKind::UnexpectedEof)?);
        Ok(())
    }
}

/// Opens a file.
pub(super) fn open(path: &Path) -> Result<Box<dyn ReadAt>> {
    let failed = |e: io::Error| {
        let kind = match e.kind() {
            io::ErrorKind::NotFound => ErrorKind::NotFound,
            io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
            _ => ErrorKind::Io,
        };
        Error::new(kind, format!("the recording {} cannot be opened: {e}", path.display())).with_source(e)
    };
    let file = depthrig_bus::files::open(path).map_err(failed)?;
    let facts = file.metadata().map_err(failed)?;
    // It is read once, from front to back; the kernel may read ahead further than it would.
    let _ = rustix::fs::fadvise(&file, 0, None, rustix::fs::Advice::Sequential);
    Ok(Box::new(FileSource { file, size: facts.len() }))
}
