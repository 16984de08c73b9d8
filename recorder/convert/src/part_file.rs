//! The file that one process writes before it gets its name.

use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;

/// Opens `path` to read and write it, made where it is missing, and locks it. What a killed process left in it is there.
///
/// # Errors
/// `WouldBlock` while another process has it, and those of opening it.
pub fn open_part(path: &Path) -> io::Result<File> {
    loop {
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path)?;
        match file.try_lock() {
            Err(TryLockError::WouldBlock) => return Err(io::ErrorKind::WouldBlock.into()),
            // Some network file systems have no locks.
            Err(TryLockError::Error(_)) | Ok(()) => {}
        }
        // Between opening and locking another process may have completed it and given it its name.
        if is_named(&file, path) {
            return Ok(file);
        }
    }
}

/// Compares the file that is open with the one that `path` names.
fn is_named(file: &File, path: &Path) -> bool {
    let both = file.metadata().and_then(|open| Ok((open, path.metadata()?)));
    both.is_ok_and(|(open, named)| (open.dev(), open.ino()) == (named.dev(), named.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read as _, Write as _};

    #[test]
    fn a_file_of_another_process_is_refused_and_one_that_was_left_is_gone_on_with() {
        let dir = tempfile::tempdir().unwrap();
        let part = dir.path().join("a.part");
        let mut first = open_part(&part).unwrap();
        first.write_all(b"left").unwrap();
        assert_eq!(open_part(&part).unwrap_err().kind(), io::ErrorKind::WouldBlock);
        drop(first);
        let mut text = String::new();
        open_part(&part).unwrap().read_to_string(&mut text).unwrap();
        assert_eq!(text, "left");
    }

    #[test]
    fn a_file_that_got_its_name_is_not_the_part_any_more() {
        let dir = tempfile::tempdir().unwrap();
        let part = dir.path().join("a.part");
        let opened = open_part(&part).unwrap();
        assert!(is_named(&opened, &part));
        std::fs::rename(&part, dir.path().join("a")).unwrap();
        assert!(!is_named(&opened, &part), "it has another name");
        std::fs::write(&part, "of another process").unwrap();
        assert!(!is_named(&opened, &part) && is_named(&opened, &dir.path().join("a")));
    }

    /// Processes that take turns with one name: none ever writes to a file that was completed.
    #[test]
    fn a_file_that_got_its_name_meanwhile_is_never_opened() {
        let dir = tempfile::tempdir().unwrap();
        let part = dir.path().join("a.part");
        std::thread::scope(|scope| {
            for thread in 0..4 {
                let part = &part;
                let dir = dir.path();
                scope.spawn(move || {
                    for _ in 0..5000 {
                        let Ok(mut file) = open_part(part) else { continue };
                        assert_eq!(file.metadata().unwrap().len(), 0, "a completed file");
                        file.write_all(b"done").unwrap();
                        std::fs::rename(part, dir.join(format!("{thread}"))).unwrap();
                    }
                });
            }
        });
    }
}
