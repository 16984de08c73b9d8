//! The few file-system operations that a dataset needs, behind a trait so that tests can fail each of them.
//!
//! Writing is append only: nothing seeks back, so a torn file is always a good file with a bad end.

use core::fmt;
use core::time::Duration;
use depthrig_bus::files;
use rustix::fs::{CWD, RenameFlags};
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;

mod memory;
pub use memory::{Fault, MemFs};

/// One name in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DirEntry {
    /// The name without its folder.
    pub name: String,
    /// Bytes of a file; unspecified for a folder.
    pub len: u64,
    /// Whether it is a folder.
    pub is_dir: bool,
}

/// A file system that datasets are written to and read from.
pub trait Fs: Send + Sync + fmt::Debug {
    /// Creates the folder and its parents; a folder that is there already is fine.
    ///
    /// # Errors
    /// As the operating system says.
    fn create_dir_all(&self, dir: &Path) -> io::Result<()>;
    /// Creates a file that must not exist and opens it for appending.
    ///
    /// # Errors
    /// `AlreadyExists` when the file exists, else as the operating system says.
    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>>;
    /// Opens a regular file for reading, without waiting.
    ///
    /// # Errors
    /// As the operating system says.
    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>>;
    /// Renames a file, replacing what is there; or a folder, if nothing or an empty folder has the new name.
    ///
    /// # Errors
    /// As the operating system says.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Exchanges the names of two folders in one step.
    ///
    /// # Errors
    /// `Unsupported` where the file system does not offer it, else as the operating system says.
    fn exchange(&self, _a: &Path, _b: &Path) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }
    /// Removes a file.
    ///
    /// # Errors
    /// As the operating system says.
    fn remove_file(&self, path: &Path) -> io::Result<()>;
    /// Removes an empty folder.
    ///
    /// # Errors
    /// As the operating system says; `Unsupported` where the file system does not offer it.
    fn remove_dir(&self, _dir: &Path) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }
    /// Makes the names in a folder durable.
    ///
    /// # Errors
    /// As the operating system says.
    fn sync_dir(&self, dir: &Path) -> io::Result<()>;
    /// The names in a folder, sorted.
    ///
    /// # Errors
    /// As the operating system says.
    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>>;
    /// Bytes that this user may still write below `dir`.
    ///
    /// # Errors
    /// As the operating system says.
    fn available_space(&self, dir: &Path) -> io::Result<u64>;
    /// Whether this user may create, rename and remove files in `dir`, as far as that is known without doing it.
    ///
    /// # Errors
    /// The error that such a change would return.
    fn may_write(&self, _dir: &Path) -> io::Result<()> {
        Ok(())
    }
    /// Locks the folder `dir` against other processes until the result is dropped; the end of the process releases it.
    /// A file system that only one process sees needs no lock.
    ///
    /// # Errors
    /// `WouldBlock` when another one has it, else as the operating system says.
    fn lock(&self, _dir: &Path) -> io::Result<Box<dyn Send + Sync>> {
        Ok(Box::new(()))
    }
    /// Makes the data of a file durable that another writer wrote.
    ///
    /// # Errors
    /// `Unsupported` where that cannot be done, else as the operating system says.
    fn sync_file(&self, _path: &Path) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }
}

/// A file that is being appended to.
pub trait WriteFile: Send {
    /// Appends some of `bytes` and says how many; fewer than all is allowed, as with `write(2)`.
    ///
    /// # Errors
    /// As the operating system says; nothing of `bytes` was written then.
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize>;
    /// Cuts the file to `len` bytes; the next write appends there.
    ///
    /// # Errors
    /// As the operating system says.
    fn truncate(&mut self, len: u64) -> io::Result<()>;
    /// Makes the data written so far durable.
    ///
    /// # Errors
    /// As the operating system says.
    fn sync_data(&mut self) -> io::Result<()>;
    /// Makes data and metadata durable.
    ///
    /// # Errors
    /// As the operating system says.
    fn sync_all(&mut self) -> io::Result<()>;
    /// Returns a sync of the data written so far, to run on another thread while this one goes on writing; `None` where
    /// that is not possible.
    fn sync_beside(&self) -> Option<SyncBeside> {
        None
    }
}

/// A sync to be run on a thread of its own.
pub type SyncBeside = Box<dyn FnOnce() -> io::Result<()> + Send>;

/// A file that is read at offsets.
pub trait ReadFile: Send + Sync {
    /// Fills `buf` from `offset`.
    ///
    /// # Errors
    /// `UnexpectedEof` when the file ends before, else as the operating system says.
    fn read_exact_at(&self, buf: &mut [u8], offset: u64) -> io::Result<()>;
    /// Bytes in the file now.
    ///
    /// # Errors
    /// As the operating system says.
    fn size(&self) -> io::Result<u64>;
}

/// Appends all of `bytes`, however many writes that takes.
///
/// # Errors
/// As the operating system reports.
pub fn write_all(file: &mut dyn WriteFile, mut bytes: &[u8]) -> io::Result<()> {
    while !bytes.is_empty() {
        match file.write(bytes) {
            Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
            Ok(n) => bytes = &bytes[n..],
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
    Ok(())
}

/// Retries for a lock that is taken, and the wait before each.
const LOCK_TRIES: u32 = 20;
const LOCK_WAIT: Duration = Duration::from_millis(25);

/// Locks the folder as [`Fs::lock`]. A child process inherits the locks of its parent until it runs its own
/// program: a released lock may look taken for a moment, so it is tried again.
pub(crate) fn lock_with_retries(fs: &dyn Fs, dir: &Path) -> io::Result<Box<dyn Send + Sync>> {
    for _ in 0..LOCK_TRIES {
        match fs.lock(dir) {
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => std::thread::sleep(LOCK_WAIT),
            done => return done,
        }
    }
    fs.lock(dir)
}

/// Replaces the small file `path` so that a crash leaves the old or the new one, never a mixture. Only where a
/// file of this name with the ending `tmp` cannot belong to others: it is removed.
pub(crate) fn replace(fs: &dyn Fs, path: &Path, bytes: &[u8]) -> io::Result<()> {
    replace_by(fs, &path.with_extension("tmp"), path, bytes)
}

/// The same by way of the file `tmp` in the same folder, which is removed if it is there.
pub(crate) fn replace_by(fs: &dyn Fs, tmp: &Path, path: &Path, bytes: &[u8]) -> io::Result<()> {
    match fs.remove_file(tmp) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut file = fs.create_new(tmp)?;
    write_all(&mut *file, bytes)?;
    file.sync_all()?;
    drop(file);
    fs.rename(tmp, path)?;
    path.parent().map_or(Ok(()), |dir| fs.sync_dir(dir))
}

/// The file system of this computer.
#[derive(Debug, Clone, Copy, Default)]
pub struct RealFs;

struct RealFile(File);

impl Fs for RealFs {
    fn create_dir_all(&self, dir: &Path) -> io::Result<()> {
        depthrig_bus::umask::create_dir_all(dir)
    }

    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        let file = OpenOptions::new().append(true).create_new(true).open(path)?;
        Ok(Box::new(RealFile(file)))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        Ok(Box::new(RealFile(files::open(path)?)))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        std::fs::rename(from, to)
    }

    fn exchange(&self, a: &Path, b: &Path) -> io::Result<()> {
        use rustix::io::Errno;
        match rustix::fs::renameat_with(CWD, a, CWD, b, RenameFlags::EXCHANGE) {
            // So say file systems that know no flags of a renaming, and kernels without them.
            Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => Err(io::ErrorKind::Unsupported.into()),
            done => Ok(done?),
        }
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        std::fs::remove_file(path)
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        std::fs::remove_dir(dir)
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
        files::open_folder(dir)?.sync_all()
    }

    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        let mut entries = Vec::new();
        for entry in std::fs::read_dir(dir)? {
            let entry = entry?;
            let meta = entry.metadata()?;
            entries.push(DirEntry {
                name: entry.file_name().to_string_lossy().into_owned(),
                len: meta.len(),
                is_dir: meta.is_dir(),
            });
        }
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        let s = rustix::fs::statvfs(dir)?;
        Ok(s.f_bavail * s.f_frsize)
    }

    fn may_write(&self, dir: &Path) -> io::Result<()> {
        use rustix::fs::Access;
        Ok(rustix::fs::access(dir, Access::WRITE_OK | Access::EXEC_OK)?)
    }

    fn lock(&self, dir: &Path) -> io::Result<Box<dyn Send + Sync>> {
        let dir = files::open_folder(dir)?;
        dir.try_lock()?;
        Ok(Box::new(dir))
    }

    fn sync_file(&self, path: &Path) -> io::Result<()> {
        files::open(path)?.sync_all()
    }
}

impl WriteFile for RealFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write(bytes)
    }

    fn truncate(&mut self, len: u64) -> io::Result<()> {
        self.0.set_len(len)
    }

    fn sync_data(&mut self) -> io::Result<()> {
        self.0.sync_data()
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.0.sync_all()
    }

    fn sync_beside(&self) -> Option<SyncBeside> {
        let file = self.0.try_clone().ok()?;
        Some(Box::new(move || file.sync_data()))
    }
}

impl ReadFile for RealFile {
    fn read_exact_at(&self, buf: &mut [u8], offset: u64) -> io::Result<()> {
        self.0.read_exact_at(buf, offset)
    }

    fn size(&self) -> io::Result<u64> {
        Ok(self.0.metadata()?.len())
    }
}
