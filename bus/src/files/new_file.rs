//! Files that are complete or absent: written beside their name, synced, then renamed.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use rustix::fs::{CWD, RenameFlags, renameat_with};
use rustix::io::Errno;

/// A file being written beside the name that it is to have. Dropped before it got the name, it is removed.
#[derive(Debug)]
pub struct NewFile {
    file: File,
    part: PathBuf,
    path: PathBuf,
}

impl NewFile {
    /// Creates the file, hidden, in the folder of `path`. No link is followed and nothing that exists is touched.
    ///
    /// # Errors
    /// As the operating system reports; `InvalidInput` when `path` names no file.
    pub fn beside(path: &Path) -> io::Result<Self> {
        let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?.to_string_lossy();
        let mut taken = io::ErrorKind::AlreadyExists.into();
        // A process that was killed may have left a file, and another thread may write one of the same name.
        for n in 0..100 {
            let part = path.with_file_name(format!(".{name}.{}-{n}.part", std::process::id()));
            match OpenOptions::new().read(true).write(true).create_new(true).open(&part) {
                Ok(file) => return Ok(Self { file, part, path: path.to_owned() }),
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => taken = e,
                Err(e) => return Err(e),
            }
        }
        Err(taken)
    }

    /// The open file, to write at a place or to set its mode.
    pub const fn file(&mut self) -> &mut File {
        &mut self.file
    }

    /// Makes the bytes durable and gives the file its name, in place of whatever has it: the name is replaced, so a link's
    /// target stays as it is, and who has the old file open keeps it.
    ///
    /// # Errors
    /// As the operating system reports.
    pub fn replace(self) -> io::Result<()> {
        self.file.sync_all()?;
        std::fs::rename(&self.part, &self.path)?;
        sync_folder_of(&self.path)
    }

    /// The same, but `AlreadyExists` when something has the name.
    ///
    /// # Errors
    /// As the operating system reports.
    pub fn create(self) -> io::Result<()> {
        self.file.sync_all()?;
        match renameat_with(CWD, &self.part, CWD, &self.path, RenameFlags::NOREPLACE) {
            // Some network file systems do not know that flag. A second name is refused as well where there is one already.
            Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => {
                std::fs::hard_link(&self.part, &self.path)?;
            }
            renamed => renamed?,
        }
        sync_folder_of(&self.path)
    }
}

impl Write for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.file.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Drop for NewFile {
    fn drop(&mut self) {
        drop(std::fs::remove_file(&self.part)); // gone already when it was renamed
    }
}

/// Writes `bytes` as the file `path`, in place of whatever has the name; a crash leaves the old or the new one.
///
/// # Errors
/// As the operating system reports; nothing is left behind then.
pub fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = NewFile::beside(path)?;
    file.write_all(bytes)?;
    file.replace()
}

/// The folder that `path` lies in.
pub fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Makes the names in the folder of `path` durable, where its file system can sync a folder.
///
/// # Errors
/// As the operating system reports.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    match super::open_folder(folder_of(path))?.sync_all() {
        // What some network and FUSE file systems answer; their files are durable all the same.
        Err(e) if e.kind() == io::ErrorKind::InvalidInput => Ok(()),
        synced => synced,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> =
            std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_has_its_name_when_it_is_complete_and_nothing_is_left_of_another() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        let mut file = NewFile::beside(&path).unwrap();
        file.write_all(b"half").unwrap();
        assert!(!path.exists() && names(dir.path()).len() == 1);
        drop(file);
        assert_eq!(names(dir.path()), Vec::<String>::new());
        replace(&path, b"one").unwrap();
        replace(&path, b"two").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        let mut file = NewFile::beside(&path).unwrap();
        file.write_all(b"three").unwrap();
        assert_eq!(file.create().unwrap_err().kind(), io::ErrorKind::AlreadyExists);
        assert_eq!(
            (std::fs::read(&path).unwrap(), names(dir.path())),
            (b"two".to_vec(), vec!["a".to_owned()])
        );
    }

    #[test]
    fn links_are_replaced_and_not_followed() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("target");
        std::fs::write(&target, b"precious").unwrap();
        let path = dir.path().join("a");
        symlink(&target, &path).unwrap();
        symlink(&target, dir.path().join(format!(".a.{}-0.part", std::process::id()))).unwrap();
        replace(&path, b"new").unwrap();
        assert_eq!(
            (std::fs::read(&target).unwrap(), std::fs::read(&path).unwrap()),
            (b"precious".to_vec(), b"new".to_vec())
        );
        let loose = dir.path().join("loose");
        symlink(dir.path().join("nowhere"), &loose).unwrap();
        let taken = NewFile::beside(&loose).unwrap().create();
        assert_eq!(taken.unwrap_err().kind(), io::ErrorKind::AlreadyExists, "a dangling link is a name too");
    }

    #[test]
    fn the_folder_of_a_bare_name_is_the_current_one() {
        assert_eq!(folder_of(Path::new("a")), Path::new("."));
        assert_eq!(folder_of(Path::new("b/a")), Path::new("b"));
        assert!(NewFile::beside(Path::new("/")).is_err());
    }
}
