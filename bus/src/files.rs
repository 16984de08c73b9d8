//! Opens files that a user or a dataset names: regular files only, and without waiting. Writes small ones: complete or
//! not at all ([`NewFile`]).
//!
//! Opening a FIFO waits for its writer, and reading a device may never end. Every read of a path that depthrig did not
//! create itself opens it here.
//!
//! ```
//! # fn main() -> std::io::Result<()> {
//! let text = depthrig_bus::files::read_to_string("Cargo.toml".as_ref(), 1 << 20)?;
//! assert!(text.contains("depthrig-bus"));
//! assert!(depthrig_bus::files::open("/dev/zero".as_ref()).is_err());
//! # Ok(())
//! # }
//! ```

mod new_file;

pub use new_file::{NewFile, folder_of, replace, sync_folder_of};

use rustix::fs::{FileType, Mode, OFlags};
use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

/// Largest file that a person writes by hand, such as a rig file: 16 MiB.
pub const TEXT_MAX_BYTES: u64 = 16 << 20;
/// Largest file of one image: 1 GiB.
pub const IMAGE_MAX_BYTES: u64 = 1 << 30;

/// Opens the regular file `path` for reading.
///
/// # Errors
/// As the operating system reports; `InvalidInput` naming the file type if it is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    // Asked first, because opening alone already acts on some devices, and again of what was opened.
    regular(FileType::from_raw_mode(rustix::fs::stat(path)?.st_mode))?;
    let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
    let file = rustix::fs::open(path, flags, Mode::empty())?;
    regular(FileType::from_raw_mode(rustix::fs::fstat(&file)?.st_mode))?;
    Ok(File::from(file))
}

/// Opens the folder `path`, to lock or to sync it.
///
/// # Errors
/// As the operating system reports.
pub fn open_folder(path: &Path) -> io::Result<File> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    Ok(File::from(rustix::fs::open(path, flags, Mode::empty())?))
}

/// Reads all of the regular file `path`, which has `most` bytes at most.
///
/// # Errors
/// As [`open`]; `FileTooLarge` when it has more.
pub fn read(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    let file = open(path)?;
    let len = file.metadata()?.len();
    let too_large = |bytes: u64| {
        let what = format!("it has {bytes} bytes or more, {most} is the limit");
        io::Error::new(io::ErrorKind::FileTooLarge, what)
    };
    if len > most {
        return Err(too_large(len));
    }
    let mut bytes = Vec::with_capacity(usize::try_from(len).unwrap_or(0));
    // It may grow, and what procfs makes up has no length.
    file.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(too_large(bytes.len() as u64));
    }
    Ok(bytes)
}

/// The same as UTF-8 text.
///
/// # Errors
/// As [`read`]; `InvalidData` when it is not UTF-8.
pub fn read_to_string(path: &Path, most: u64) -> io::Result<String> {
    String::from_utf8(read(path, most)?)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "it is not UTF-8 text"))
}

fn regular(is: FileType) -> io::Result<()> {
    let (kind, what) = match is {
        FileType::RegularFile => return Ok(()),
        FileType::Directory => (io::ErrorKind::IsADirectory, "a folder"),
        FileType::Fifo => (io::ErrorKind::InvalidInput, "a FIFO"),
        FileType::Socket => (io::ErrorKind::InvalidInput, "a socket"),
        FileType::CharacterDevice | FileType::BlockDevice => (io::ErrorKind::InvalidInput, "a device"),
        _ => (io::ErrorKind::InvalidInput, "something else"),
    };
    Err(io::Error::new(kind, format!("it is {what}; a regular file is needed")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::net::UnixListener;
    use std::sync::mpsc::sync_channel;
    use std::time::Duration;

    /// The error of reading `path`; panics when reading waits.
    fn refused(path: &Path) -> io::Error {
        let (sender, receiver) = sync_channel(1);
        let path = path.to_owned();
        std::thread::spawn(move || sender.send(read(&path, 1 << 20)));
        let read = receiver.recv_timeout(Duration::from_secs(30)).expect("reading waits for ever");
        read.expect_err("it was read")
    }

    #[test]
    fn only_regular_files_are_opened_and_nothing_waits() {
        let dir = tempfile::tempdir().unwrap();
        let fifo = dir.path().join("fifo");
        rustix::fs::mknodat(rustix::fs::CWD, &fifo, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(&fifo, &link).unwrap();
        let socket = dir.path().join("socket");
        let _listener = UnixListener::bind(&socket).unwrap();
        for (path, what) in [
            (fifo.as_path(), "a FIFO"),
            (&link, "a FIFO"),
            (&socket, "a socket"),
            (dir.path(), "a folder"),
            (Path::new("/dev/zero"), "a device"),
            (Path::new("/dev/tty"), "a device"),
        ] {
            let e = refused(path);
            assert_eq!(
                e.to_string(),
                format!("it is {what}; a regular file is needed"),
                "{}",
                path.display()
            );
        }
        assert_eq!(refused(&dir.path().join("none")).kind(), io::ErrorKind::NotFound);
        assert!(open_folder(&fifo).is_err() && open_folder(dir.path()).is_ok());
    }

    #[test]
    fn a_file_is_read_up_to_its_limit_and_not_beyond() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f");
        std::fs::write(&path, b"12345").unwrap();
        assert_eq!(read(&path, 5).unwrap(), b"12345");
        assert_eq!(read(&path, 4).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
        let sparse = std::fs::File::create(dir.path().join("sparse")).unwrap();
        sparse.set_len(1 << 40).unwrap();
        assert_eq!(refused(&dir.path().join("sparse")).kind(), io::ErrorKind::FileTooLarge);
        // No length, and yet it has text.
        assert!(!read(Path::new("/proc/self/status"), 1 << 20).unwrap().is_empty());
        assert_eq!(read(Path::new("/proc/self/status"), 10).unwrap_err().kind(), io::ErrorKind::FileTooLarge);
    }
}
