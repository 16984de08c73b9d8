//! The files of a session's folder.

use super::bad;
use crate::bytecamera::images::MAX_FILE;
use crate::bytecamera::names;
use depthrig_recorder::fs::{Fs, ReadFile};
use depthrig_recorder::{Error, Result};
use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

/// A file as a stream of bytes.
pub(super) struct Bytes {
    pub(super) file: Box<dyn ReadFile>,
    pub(super) at: u64,
    pub(super) size: u64,
}

impl Read for Bytes {
    fn read(&mut self, buf: &mut [u8]) -> io::Result<usize> {
        let n = buf.len().min(usize::try_from(self.size - self.at).unwrap_or(usize::MAX));
        self.file.read_exact_at(&mut buf[..n], self.at)?;
        self.at += n as u64;
        Ok(n)
    }
}

/// Folder, prefix and ending: what the files of a stream have in common.
pub(super) type Key = (String, String, String);

/// The files of each folder, prefix and ending by their numbers, with the name where it is not the plain one.
pub(super) type FoundFiles = BTreeMap<Key, BTreeMap<u32, Option<String>>>;

/// The part of a path, relative to the session's folder, that all files of a stream share.
pub(super) fn key_of(file: &str) -> Option<Key> {
    let (folder, name) = file.split_once('/')?;
    let (prefix, _, ending) = names::file_parts(name)?;
    Some((folder.to_owned(), prefix.to_owned(), ending.to_owned()))
}

pub(super) fn list(fs: &dyn Fs, dir: &Path) -> Result<FoundFiles> {
    let mut found = FoundFiles::new();
    for folder in fs.read_dir(dir).map_err(|e| Error::reading("list", dir, e))? {
        if !folder.is_dir || !folder.name.starts_with("camera_") {
            continue;
        }
        let path = dir.join(&folder.name);
        for file in fs.read_dir(&path).map_err(|e| Error::reading("list", &path, e))? {
            let Some((prefix, n, ending)) = names::file_parts(&file.name).filter(|_| !file.is_dir) else {
                continue;
            };
            let plain = format!("{prefix}_{n}.{ending}");
            let key = (folder.name.clone(), prefix.to_owned(), ending.to_owned());
            let name = (file.name != plain).then(|| file.name.clone());
            if found.entry(key).or_default().insert(n, name).is_some() {
                return Err(bad(
                    &path,
                    format_args!(
                        "number {n} of {prefix}_N.{ending} is there twice, as {plain} and with leading zeros"
                    ),
                ));
            }
        }
    }
    Ok(found)
}

/// The first folder in `dir` that looks like a session: a person gave the folder around it.
pub(super) fn session_within(fs: &dyn Fs, dir: &Path) -> Option<PathBuf> {
    let mut folders: Vec<_> = fs.read_dir(dir).ok()?.into_iter().filter(|e| e.is_dir).collect();
    folders.sort_by(|a, b| a.name.cmp(&b.name));
    folders.into_iter().map(|e| dir.join(e.name)).find(|folder| list(fs, folder).is_ok_and(|f| !f.is_empty()))
}

/// A whole file; `None` when it is not there.
pub(super) fn read_file(fs: &dyn Fs, path: &Path) -> Result<Option<Vec<u8>>> {
    let file = match fs.open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::reading("open", path, e)),
    };
    let size = file.size().map_err(|e| Error::reading("read", path, e))?;
    if size > MAX_FILE {
        return Err(bad(path, format_args!("it has {size} bytes, more than any image")));
    }
    let mut bytes = vec![0; size as usize];
    file.read_exact_at(&mut bytes, 0).map_err(|e| Error::reading("read", path, e))?;
    Ok(Some(bytes))
}
