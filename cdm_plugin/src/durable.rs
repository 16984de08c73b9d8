//! Files that are complete or absent, with their checksum.

use crate::{Error, ErrorKind, Result};
use depthrig_bus::files::NewFile;
use sha2::{Digest, Sha256};
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// A written file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Written {
    pub bytes: u64,
    /// In hexadecimal.
    pub sha256: String,
}

/// A writer that counts and hashes.
struct Hashing<W> {
    inner: W,
    hash: Sha256,
    bytes: u64,
}

impl<W: Write> Write for Hashing<W> {
    fn write(&mut self, part: &[u8]) -> io::Result<usize> {
        let n = self.inner.write(part)?;
        self.hash.update(&part[..n]);
        self.bytes += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Writes `path`, which is not there before `write` has ended well and its bytes are on the disk. A file that has the name
/// already is replaced in one step; who has it open or mapped keeps the old one.
///
/// # Errors
/// [`ErrorKind::Io`] naming the file; nothing is left behind then.
pub(crate) fn create(path: &Path, write: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<Written> {
    let failed = |e: io::Error| cannot_write(path, e);
    let file = NewFile::beside(path).map_err(failed)?;
    let mut out = Hashing { inner: BufWriter::with_capacity(1 << 20, file), hash: Sha256::new(), bytes: 0 };
    write(&mut out).map_err(failed)?;
    let file = out.inner.into_inner().map_err(|e| failed(e.into_error()))?;
    file.replace().map_err(failed)?;
    Ok(Written { bytes: out.bytes, sha256: hex(&out.hash.finalize()) })
}

/// That `path` could not be written, and what to do.
pub(crate) fn cannot_write(path: &Path, e: io::Error) -> Error {
    let cure = match e.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => "; make room, or name another folder",
        io::ErrorKind::PermissionDenied => "; name a folder that you may write to",
        io::ErrorKind::NotFound => "; its folder does not exist",
        _ => "",
    };
    Error::new(ErrorKind::Io, format!("{} cannot be written: {e}{cure}", path.display())).with_source(e)
}

/// Bytes in hexadecimal.
pub(crate) fn hex(bytes: &[u8]) -> String {
    use core::fmt::Write as _;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, b| {
        let _ = write!(text, "{b:02x}"); // into a string: cannot fail
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_there_when_it_is_whole() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        let written = create(&path, |out| out.write_all(b"abc")).unwrap();
        // sha256sum of "abc", the example of FIPS 180-2.
        assert_eq!(written.sha256, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!((written.bytes, std::fs::read(&path).unwrap()), (3, b"abc".to_vec()));
        let e = create(&path, |out| {
            out.write_all(b"xyz")?;
            Err(io::ErrorKind::StorageFull.into())
        })
        .unwrap_err();
        assert!(e.to_string().contains("make room"), "{e}");
        assert_eq!(std::fs::read(&path).unwrap(), b"abc");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left behind");
        let e = create(&dir.path().join("no/a"), |_| Ok(())).unwrap_err();
        assert!(e.kind() == ErrorKind::Io && e.to_string().contains("folder does not exist"), "{e}");
    }
}
