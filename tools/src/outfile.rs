//! Output files of commands, written without losing existing files.
//!
//! An existing file is replaced only with `--overwrite`, and an input never, whatever name or link leads to it. Bytes
//! go to a new file beside it first, which gets the name when it is complete.

use crate::exit::UsageError;
use anyhow::{Context as _, Result};
use depthrig_bus::files::{NewFile, folder_of};
use std::io::{self, Write as _};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// The option of every command that writes files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::Args)]
pub struct Overwrite {
    /// Replace existing files, but never an input
    #[arg(long)]
    pub overwrite: bool,
}

/// An output file that was checked to destroy nothing.
#[derive(Debug)]
pub struct OutFile {
    path: PathBuf,
    overwrite: bool,
}

impl OutFile {
    /// Checks that `path` can be written without loss. Commands call this before they begin their work.
    ///
    /// # Errors
    /// A usage error when `path` is one of `inputs`, exists and may not be replaced, or is not a regular file.
    pub fn new(path: &Path, overwrite: Overwrite, inputs: &[&Path]) -> Result<Self> {
        let refused = |what: String| Err(UsageError(format!("{}: {what}", path.display())).into());
        let out = Self { path: path.to_owned(), overwrite: overwrite.overwrite };
        if path.file_name().is_none() {
            return refused("invalid file name".into());
        }
        if path.symlink_metadata().is_err() {
            return Ok(out);
        }
        if let Some(input) = inputs.iter().find(|input| is_same(path, input)) {
            return refused(format!("is the input {}; name another file", input.display()));
        }
        match path.metadata() {
            Ok(meta) if meta.is_dir() => refused("is a folder; name a file".into()),
            Ok(meta) if !meta.is_file() => refused("is not a regular file; name another".into()),
            _ if !out.overwrite => refused(EXISTS.into()),
            _ => Ok(out),
        }
    }

    /// The name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that `other` is a different file.
    ///
    /// # Errors
    /// A usage error that names both.
    pub fn differs_from(&self, other: &Self) -> Result<()> {
        let place = |path: &Path| {
            (folder_of(path).canonicalize().ok(), path.file_name().map(std::ffi::OsStr::to_owned))
        };
        if place(&self.path) != place(&other.path) && !is_same(&self.path, &other.path) {
            return Ok(());
        }
        let text = format!("{} and {} are one file; name two", self.path.display(), other.path.display());
        Err(UsageError(text).into())
    }

    /// Writes the file, which is there when it is complete.
    ///
    /// # Errors
    /// When it cannot be written, or exists by now; the message names it.
    pub fn write(&self, bytes: &[u8]) -> Result<()> {
        let unwritable = || format!("{}: cannot be written", self.path.display());
        let mut file = NewFile::beside(&self.path).with_context(unwritable)?;
        file.write_all(bytes).with_context(unwritable)?;
        if self.overwrite {
            return file.replace().with_context(unwritable);
        }
        match file.create() {
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {
                Err(UsageError(format!("{}: {EXISTS}", self.path.display())).into())
            }
            created => created.with_context(unwritable),
        }
    }
}

const EXISTS: &str = "exists; name another file, or replace it with --overwrite";

/// Whether both names lead to one file, through links too.
fn is_same(a: &Path, b: &Path) -> bool {
    let identity = |path: &Path| path.metadata().ok().map(|m| (m.dev(), m.ino()));
    identity(a).is_some_and(|a| identity(b) == Some(a))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    const KEEP: Overwrite = Overwrite { overwrite: false };
    const REPLACE: Overwrite = Overwrite { overwrite: true };

    fn refused(path: &Path, overwrite: Overwrite, inputs: &[&Path]) -> String {
        let e = OutFile::new(path, overwrite, inputs).unwrap_err();
        assert!(e.is::<UsageError>(), "{e}");
        e.to_string()
    }

    #[test]
    fn what_exists_is_replaced_only_when_that_was_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        OutFile::new(&path, KEEP, &[]).unwrap().write(b"one").unwrap();
        assert!(
            refused(&path, KEEP, &[]).contains("exists; name another file, or replace it with --overwrite")
        );
        OutFile::new(&path, REPLACE, &[]).unwrap().write(b"two").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two");
        // It came into being after the check.
        let late = OutFile::new(&dir.path().join("b"), KEEP, &[]).unwrap();
        std::fs::write(late.path(), b"somebody's").unwrap();
        assert!(late.write(b"ours").unwrap_err().to_string().contains("exists"));
        assert_eq!(std::fs::read(late.path()).unwrap(), b"somebody's");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 2, "nothing is left behind");
    }

    #[test]
    fn an_input_is_never_replaced_by_any_of_its_names() {
        let dir = tempfile::tempdir().unwrap();
        let input = dir.path().join("z.png");
        std::fs::write(&input, b"depth").unwrap();
        let soft = dir.path().join("soft.png");
        symlink(&input, &soft).unwrap();
        let hard = dir.path().join("hard.png");
        std::fs::hard_link(&input, &hard).unwrap();
        let round = dir.path().join("../").join(dir.path().file_name().unwrap()).join("z.png");
        for name in [&input, &soft, &hard, &round] {
            assert!(refused(name, REPLACE, &[&input]).contains("is the input"), "{}", name.display());
        }
        assert!(refused(&input, REPLACE, &[&soft]).contains("is the input"));
    }

    #[test]
    fn links_are_replaced_and_not_followed() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("target");
        std::fs::write(&target, b"precious").unwrap();
        let path = dir.path().join("out.npy");
        symlink(&target, &path).unwrap();
        symlink(&target, dir.path().join("out.npy.part")).unwrap();
        symlink(&target, dir.path().join(format!(".out.npy.{}-0.part", std::process::id()))).unwrap();
        assert!(refused(&path, KEEP, &[]).contains("exists"));
        OutFile::new(&path, REPLACE, &[]).unwrap().write(b"new").unwrap();
        assert_eq!(std::fs::read(&target).unwrap(), b"precious");
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        // A dangling link counts as existing too.
        let loose = dir.path().join("loose");
        symlink(dir.path().join("nowhere"), &loose).unwrap();
        assert!(refused(&loose, KEEP, &[]).contains("exists"));
    }

    #[test]
    fn folders_and_devices_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        assert!(refused(dir.path(), REPLACE, &[]).contains("is a folder"));
        assert!(refused(Path::new("/dev/null"), REPLACE, &[]).contains("not a regular file"));
        assert!(refused(Path::new("/"), REPLACE, &[]).contains("invalid file name"));
    }

    #[test]
    fn two_outputs_are_two_files() {
        let dir = tempfile::tempdir().unwrap();
        let new = |name: &str| OutFile::new(&dir.path().join(name), REPLACE, &[]).unwrap();
        new("a").differs_from(&new("b")).unwrap();
        assert!(new("a").differs_from(&new("./a")).is_err());
        new("a").write(b"x").unwrap();
        std::fs::hard_link(dir.path().join("a"), dir.path().join("b")).unwrap();
        assert!(new("a").differs_from(&new("b")).is_err());
    }
}
