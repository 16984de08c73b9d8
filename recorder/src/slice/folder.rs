//! The folder in which a new dataset grows: locked all the while, and renamed when all in it is durable.

use crate::fs::{Fs, lock_with_retries};
use crate::{Error, ErrorKind, Result};
use std::io;
use std::path::{Path, PathBuf};

/// Beside the chunks there are heads, indexes and `session.toml`, bytes.
const MARGIN_BYTES: u64 = 16 << 20;

pub(super) struct Folder<'a> {
    fs: &'a dyn Fs,
    out: PathBuf,
    part: PathBuf,
    done: bool,
    /// Keeps a recovery and another run out until it has its name; `None` where the file system has no locks.
    _lock: Option<Box<dyn Send + Sync>>,
}

impl<'a> Folder<'a> {
    /// Makes `OUT.part`, if there is neither that nor `OUT`, and room for `bytes`.
    pub(super) fn create(fs: &'a dyn Fs, out: &Path, bytes: u64) -> Result<Self> {
        let name = out.file_name().ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                format!("{} is not a valid name for a new dataset", out.display()),
            )
        })?;
        let mut part = name.to_os_string();
        part.push(".part");
        let part = out.with_file_name(part);
        must_be_free(fs, out, "choose another name")?;
        fs.create_dir_all(&part).map_err(|e| Error::io("create the folder", &part, e))?;
        // First: nothing is said of, or done with, a folder that somebody else writes to.
        let lock = lock(fs, &part)?;
        let advice = "it is left of a run that was cut off; if nothing writes to it, remove it";
        if let Err(e) = must_be_free(fs, &part, advice) {
            // Removes an empty folder, which is of our making, and nothing else.
            let _ = fs.remove_dir(&part);
            return Err(e);
        }
        let folder = Self { fs, out: out.to_owned(), part, done: false, _lock: lock };
        let free = fs.available_space(&folder.part);
        let free = free.map_err(|e| Error::io("ask for the free space of", &folder.part, e))?;
        let needed = bytes.saturating_add(MARGIN_BYTES);
        if free < needed {
            return Err(Error::new(
                ErrorKind::DiskFull,
                format!(
                    "{} would take {} MB, its disk has {} MB left; free some space or choose another disk",
                    out.display(),
                    needed.div_ceil(1_000_000),
                    free / 1_000_000
                ),
            ));
        }
        Ok(folder)
    }

    /// Where to write.
    pub(super) fn path(&self) -> &Path {
        &self.part
    }

    /// Gives it its name. What is in it must be durable.
    pub(super) fn finish(mut self) -> Result<()> {
        // An empty folder of that name would be replaced; anything else of that name makes this fail.
        self.fs.rename(&self.part, &self.out).map_err(|e| Error::io("rename", &self.part, e))?;
        self.done = true;
        let parent = self.out.parent().unwrap_or(Path::new("."));
        self.fs.sync_dir(parent).map_err(|e| Error::io("sync the folder", parent, e))
    }
}

impl Drop for Folder<'_> {
    /// Removes an unfinished output: all of its files are ours. Files that cannot be removed stay in `OUT.part`.
    fn drop(&mut self) {
        if self.done {
            return;
        }
        for entry in self.fs.read_dir(&self.part).unwrap_or_default() {
            let _ = self.fs.remove_file(&self.part.join(entry.name));
        }
        if let Err(e) = self.fs.remove_dir(&self.part) {
            tracing::warn!("{} is left unfinished: {e}", self.part.display());
        }
    }
}

/// Locks the folder; goes on without a lock on a file system that has none.
fn lock(fs: &dyn Fs, part: &Path) -> Result<Option<Box<dyn Send + Sync>>> {
    let shown = part.display();
    match lock_with_retries(fs, part) {
        Ok(lock) => Ok(Some(lock)),
        Err(e) if e.kind() == io::ErrorKind::WouldBlock => {
            let advice = "wait until that has ended, or choose another name";
            let what = format!("{shown} is being written by another process; {advice}");
            Err(Error::new(ErrorKind::InUse, what))
        }
        Err(e) => {
            tracing::warn!("{shown} cannot be locked: {e}; do not run `depthrig recover` on it now");
            Ok(None)
        }
    }
}

/// Whether nothing of this name is there, or an empty folder.
fn must_be_free(fs: &dyn Fs, path: &Path, advice: &str) -> Result<()> {
    match fs.read_dir(path) {
        Ok(entries) if entries.is_empty() => Ok(()),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        Ok(_) => {
            let message = format!("{} is there already; {advice}", path.display());
            Err(Error::new(ErrorKind::AlreadyExists, message))
        }
        Err(e) => Err(Error::io("use the folder", path, e)),
    }
}
