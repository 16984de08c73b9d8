//! Files mapped for reading.
#![allow(unsafe_code)] // a mapping is memory that the file system may change

use crate::{Error, ErrorKind, Result};
use memmap2::Mmap;
use std::fs::File;
use std::io;
use std::path::Path;

/// Maps the whole of `path`.
///
/// # Errors
/// [`ErrorKind::NotFound`] when there is no such file, [`ErrorKind::Io`] when it cannot be read.
pub(crate) fn read_only(path: &Path) -> Result<Mmap> {
    let failed = |e: io::Error| {
        let kind = if e.kind() == io::ErrorKind::NotFound { ErrorKind::NotFound } else { ErrorKind::Io };
        let what = match kind {
            ErrorKind::NotFound => "there is no such file".to_owned(),
            _ => format!("cannot be read: {e}"),
        };
        Error::new(kind, format!("{}: {what}", path.display())).with_source(e)
    };
    let file = File::open(path).map_err(failed)?;
    let meta = file.metadata().map_err(failed)?;
    if !meta.is_file() {
        let what = if meta.is_dir() { "a folder" } else { "no ordinary file" };
        let message = format!("{} is {what}; the file of a model's weights is needed", path.display());
        return Err(Error::new(ErrorKind::Io, message));
    }
    // SAFETY: the map is read-only. depthrig never changes the weights of an installed model: new ones are renamed over
    // them and removed ones lose their name, both of which leave this map's inode alone. Somebody who truncates the
    // file by hand while it is mapped makes this process end with SIGBUS, as with any mapped file.
    unsafe { Mmap::map(&file) }.map_err(failed)
}
