//! A file system on which a recovery changes nothing: a dry run is a recovery on it, so both report the same.
//!
//! Written data stays in memory, except for the chunks of a copy: they lie in the original, where
//! [`DryFs::refer`] says they do.

use crate::fs::{DirEntry, Fs, ReadFile, WriteFile};
use depthrig_bus::files::folder_of;
use depthrig_bus::sync::lock;
use std::collections::BTreeMap;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

/// A file system over another one, which it never changes.
pub(super) struct DryFs {
    under: Arc<dyn Fs>,
    /// Names that differ here from the file system below; `None` for a removed one.
    names: Mutex<BTreeMap<PathBuf, Option<Place>>>,
}

/// Where the bytes of a file are.
#[derive(Clone)]
enum Place {
    /// In a file of the file system below, by its name there.
    Under(PathBuf),
    /// In memory.
    New(NewFile),
}

/// A file created by the dry run.
#[derive(Clone, Default)]
struct NewFile(Arc<Mutex<Pieces>>);

/// A file in pieces, in the order of their places.
#[derive(Default)]
struct Pieces {
    parts: Vec<Piece>,
    len: u64,
    /// The file of the pieces that are not in memory.
    original: Option<Arc<dyn ReadFile>>,
}

struct Piece {
    at: u64,
    len: u64,
    bytes: Bytes,
}

enum Bytes {
    Here(Vec<u8>),
    /// In the original, from this offset on.
    There(u64),
}

/// Bytes of a copy that lie in its original too.
#[derive(Debug, Clone, Copy)]
pub(super) struct Same {
    /// Where they begin in the copy.
    pub(super) at: u64,
    /// Where they begin in the original.
    pub(super) from: u64,
    pub(super) len: u64,
}

impl DryFs {
    pub(super) fn new(under: Arc<dyn Fs>) -> Self {
        Self { under, names: Mutex::default() }
    }

    /// Drops bytes of the file `copy` that were just written, as they are in `original`; in the order of their places.
    pub(super) fn refer(&self, copy: &Path, original: &Path, same: &[Same]) -> io::Result<()> {
        let Some(Place::New(file)) = self.place(copy)? else { return Ok(()) };
        let mut pieces = lock(&file.0);
        if pieces.original.is_none() {
            pieces.original = Some(self.open(original)?.into());
        }
        for same in same.iter().rev() {
            pieces.refer(*same);
        }
        Ok(())
    }

    fn names(&self) -> MutexGuard<'_, BTreeMap<PathBuf, Option<Place>>> {
        lock(&self.names)
    }

    /// The place of the file `path`; `None` if it does not exist.
    fn place(&self, path: &Path) -> io::Result<Option<Place>> {
        if let Some(place) = self.names().get(path) {
            return Ok(place.clone());
        }
        Ok(self.entry_under(path)?.map(|_| Place::Under(path.to_owned())))
    }

    /// The file `path` of the file system below.
    fn entry_under(&self, path: &Path) -> io::Result<Option<DirEntry>> {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let entries = self.under.read_dir(folder_of(path))?;
        Ok(entries.into_iter().find(|e| e.name == name && !e.is_dir))
    }

    fn len(&self, place: &Place) -> io::Result<u64> {
        match place {
            Place::Under(path) => Ok(self.entry_under(path)?.map_or(0, |e| e.len)),
            Place::New(file) => Ok(lock(&file.0).len),
        }
    }

    /// Returns the error that a change in the folder of `path` would return.
    fn check(&self, path: &Path) -> io::Result<()> {
        self.under.may_write(folder_of(path))
    }
}

impl fmt::Debug for DryFs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DryFs").field("under", &self.under).finish_non_exhaustive()
    }
}

impl Fs for DryFs {
    fn create_dir_all(&self, _dir: &Path) -> io::Result<()> {
        Err(io::ErrorKind::Unsupported.into())
    }

    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        self.check(path)?;
        if self.place(path)?.is_some() {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        let file = NewFile::default();
        self.names().insert(path.to_owned(), Some(Place::New(file.clone())));
        Ok(Box::new(file))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        let place = self.names().get(path).cloned();
        match place {
            None => self.under.open(path),
            Some(None) => Err(io::ErrorKind::NotFound.into()),
            Some(Some(Place::Under(path))) => self.under.open(&path),
            Some(Some(Place::New(file))) => Ok(Box::new(file)),
        }
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.check(from)?;
        self.check(to)?;
        let place = self.place(from)?.ok_or(io::ErrorKind::NotFound)?;
        let mut names = self.names();
        names.insert(from.to_owned(), None);
        names.insert(to.to_owned(), Some(place));
        Ok(())
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.check(path)?;
        self.place(path)?.ok_or(io::ErrorKind::NotFound)?;
        self.names().insert(path.to_owned(), None);
        Ok(())
    }

    fn sync_dir(&self, _dir: &Path) -> io::Result<()> {
        Ok(())
    }

    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        let mut entries = self.under.read_dir(dir)?;
        let names = self.names().clone();
        entries.retain(|e| !names.contains_key(&dir.join(&e.name)));
        for (path, place) in names.iter().filter(|(path, _)| folder_of(path) == dir) {
            let (Some(place), Some(name)) = (place, path.file_name()) else { continue };
            let name = name.to_string_lossy().into_owned();
            entries.push(DirEntry { name, len: self.len(place)?, is_dir: false });
        }
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        let mut free = self.under.available_space(dir)?;
        let names = self.names().clone();
        let is_kept = |path: &Path| {
            names.values().flatten().any(|place| matches!(place, Place::Under(kept) if kept == path))
        };
        for (path, place) in &names {
            if let Some(Place::New(file)) = place {
                free = free.saturating_sub(lock(&file.0).len);
            }
            if !is_kept(path) {
                free = free.saturating_add(self.entry_under(path)?.map_or(0, |e| e.len));
            }
        }
        Ok(free)
    }

    fn may_write(&self, dir: &Path) -> io::Result<()> {
        self.under.may_write(dir)
    }

    fn sync_file(&self, _path: &Path) -> io::Result<()> {
        Ok(())
    }
}

impl Pieces {
    fn append(&mut self, bytes: &[u8]) {
        self.len += bytes.len() as u64;
        if let Some(Piece { len, bytes: Bytes::Here(here), .. }) = self.parts.last_mut() {
            here.extend_from_slice(bytes);
            *len += bytes.len() as u64;
            return;
        }
        let at = self.len - bytes.len() as u64;
        self.parts.push(Piece { at, len: bytes.len() as u64, bytes: Bytes::Here(bytes.to_vec()) });
    }

    /// Replaces bytes in memory with a reference, in one piece.
    fn refer(&mut self, same: Same) {
        let end = same.at + same.len;
        let holds = |p: &Piece| p.at <= same.at && end <= p.at + p.len;
        let Some(index) = self.parts.iter().rposition(holds) else { return };
        let piece = &mut self.parts[index];
        let Bytes::Here(here) = &mut piece.bytes else { return };
        let after = here.split_off((end - piece.at) as usize);
        here.truncate((same.at - piece.at) as usize);
        here.shrink_to_fit();
        piece.len = here.len() as u64;
        let mut put = vec![Piece { at: same.at, len: same.len, bytes: Bytes::There(same.from) }];
        if !after.is_empty() {
            put.push(Piece { at: end, len: after.len() as u64, bytes: Bytes::Here(after) });
        }
        let first = if piece.len == 0 { index } else { index + 1 };
        self.parts.splice(first..=index, put);
    }

    fn read(&self, buf: &mut [u8], offset: u64) -> io::Result<()> {
        if offset.checked_add(buf.len() as u64).is_none_or(|end| end > self.len) {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let mut done = 0;
        let mut index = self.parts.partition_point(|p| p.at + p.len <= offset);
        while done < buf.len() {
            let piece = self.parts.get(index).ok_or(io::ErrorKind::UnexpectedEof)?;
            let skip = offset + done as u64 - piece.at;
            let n = (piece.len - skip).min((buf.len() - done) as u64) as usize;
            let to = &mut buf[done..done + n];
            match &piece.bytes {
                Bytes::Here(here) => to.copy_from_slice(&here[skip as usize..skip as usize + n]),
                Bytes::There(from) => {
                    let original = self.original.as_ref().ok_or(io::ErrorKind::NotFound)?;
                    original.read_exact_at(to, from + skip)?;
                }
            }
            done += n;
            index += 1;
        }
        Ok(())
    }

    fn truncate(&mut self, len: u64) {
        self.parts.retain(|p| p.at < len);
        if let Some(last) = self.parts.last_mut().filter(|p| p.at + p.len > len) {
            last.len = len - last.at;
            if let Bytes::Here(here) = &mut last.bytes {
                here.truncate(last.len as usize);
            }
        }
        self.len = self.len.min(len);
    }
}

impl WriteFile for NewFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        lock(&self.0).append(bytes);
        Ok(bytes.len())
    }

    fn truncate(&mut self, len: u64) -> io::Result<()> {
        lock(&self.0).truncate(len);
        Ok(())
    }

    fn sync_data(&mut self) -> io::Result<()> {
        Ok(())
    }

    fn sync_all(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl ReadFile for NewFile {
    fn read_exact_at(&self, buf: &mut [u8], offset: u64) -> io::Result<()> {
        lock(&self.0).read(buf, offset)
    }

    fn size(&self) -> io::Result<u64> {
        Ok(lock(&self.0).len)
    }
}
