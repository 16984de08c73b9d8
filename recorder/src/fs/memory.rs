//! A file system in memory for tests: any operation can be made to fail, writes can be short, space can
//! run out, and a crash leaves what was synced plus a chosen part of what was not.

use super::{DirEntry, Fs, ReadFile, WriteFile};
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What goes wrong on a [`MemFs`], and at which operation (numbered from 0, over all files).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The operation of this number fails, and no other.
    FailOnce(u64, io::ErrorKind),
    /// The operation of this number and all after it fail.
    FailFrom(u64, io::ErrorKind),
    /// Every write takes at most this many bytes.
    ShortWrites(usize),
}

#[derive(Debug, Default, Clone)]
struct Node {
    data: Vec<u8>,
    synced: usize,
}

#[derive(Debug, Default)]
struct State {
    files: BTreeMap<PathBuf, Node>,
    dirs: BTreeSet<PathBuf>,
    ops: u64,
    log: Vec<String>,
    faults: Vec<Fault>,
    capacity: Option<u64>,
}

/// A file system in memory; clones share it.
#[derive(Debug, Clone, Default)]
pub struct MemFs(Arc<Mutex<State>>);

struct MemFile {
    fs: MemFs,
    path: PathBuf,
}

impl State {
    fn used(&self) -> u64 {
        self.files.values().map(|n| n.data.len() as u64).sum()
    }

    fn free(&self) -> u64 {
        self.capacity.map_or(u64::MAX, |c| c.saturating_sub(self.used()))
    }

    /// Gives a folder with all below it another name, unless something is there.
    fn rename_dir(&mut self, from: &Path, to: &Path) -> io::Result<()> {
        if self.files.keys().chain(&self.dirs).any(|p| p.starts_with(to) && p != to) {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        let moved = |p: PathBuf| p.strip_prefix(from).map(|rest| to.join(rest)).unwrap_or(p);
        self.files = std::mem::take(&mut self.files).into_iter().map(|(p, node)| (moved(p), node)).collect();
        // Joining an empty rest leaves a slash at the end, which no path of a folder has here.
        let tidy = |p: PathBuf| p.components().collect();
        self.dirs = std::mem::take(&mut self.dirs).into_iter().map(moved).map(tidy).collect();
        Ok(())
    }

    fn node(&mut self, path: &Path) -> io::Result<&mut Node> {
        self.files.get_mut(path).ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

impl MemFs {
    /// An empty file system.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same file system with a fault added.
    pub fn with_fault(self, fault: Fault) -> Self {
        self.lock().faults.push(fault);
        self
    }

    /// The same file system that holds `bytes` at most.
    pub fn with_capacity(self, bytes: u64) -> Self {
        self.lock().capacity = Some(bytes);
        self
    }

    /// How many operations were asked for so far.
    pub fn ops(&self) -> u64 {
        self.lock().ops
    }

    /// The operations so far, each as a line.
    pub fn log(&self) -> Vec<String> {
        self.lock().log.clone()
    }

    /// The bytes of a file.
    pub fn contents(&self, path: &Path) -> Option<Vec<u8>> {
        self.lock().files.get(path).map(|n| n.data.clone())
    }

    /// Puts a file there, as synced.
    pub fn put(&self, path: &Path, data: Vec<u8>) {
        let synced = data.len();
        self.lock().files.insert(path.to_owned(), Node { data, synced });
    }

    /// What a crash leaves: of each file the synced bytes and `keep(unsynced bytes)` of the rest. Faults,
    /// limits and counts are gone.
    pub fn after_crash(&self, mut keep: impl FnMut(usize) -> usize) -> Self {
        let state = self.lock();
        let mut files = state.files.clone();
        for node in files.values_mut() {
            let unsynced = node.data.len().saturating_sub(node.synced);
            node.data.truncate(node.synced + keep(unsynced).min(unsynced));
        }
        Self(Arc::new(Mutex::new(State { files, dirs: state.dirs.clone(), ..State::default() })))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Counts an operation, and fails it if a fault says so.
    fn op(&self, what: &str, path: &Path) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.lock();
        let n = state.ops;
        state.ops += 1;
        state.log.push(format!("{what} {}", path.display()));
        for fault in &state.faults {
            match *fault {
                Fault::FailOnce(at, kind) if n == at => return Err(kind.into()),
                Fault::FailFrom(at, kind) if n >= at => return Err(kind.into()),
                _ => {}
            }
        }
        Ok(state)
    }
}

impl Fs for MemFs {
    fn create_dir_all(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.op("mkdir", dir)?;
        state.dirs.extend(dir.ancestors().map(Path::to_owned));
        Ok(())
    }

    fn create_new(&self, path: &Path) -> io::Result<Box<dyn WriteFile>> {
        let mut state = self.op("create", path)?;
        if state.files.contains_key(path) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        if !path.parent().is_some_and(|dir| state.dirs.contains(dir)) {
            return Err(io::ErrorKind::NotFound.into());
        }
        state.files.insert(path.to_owned(), Node::default());
        Ok(Box::new(MemFile { fs: self.clone(), path: path.to_owned() }))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        self.op("open", path)?.node(path)?;
        Ok(Box::new(MemFile { fs: self.clone(), path: path.to_owned() }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut state = self.op("rename", from)?;
        if state.dirs.contains(from) {
            return state.rename_dir(from, to);
        }
        let node = state.files.remove(from).ok_or(io::ErrorKind::NotFound)?;
        state.files.insert(to.to_owned(), node);
        Ok(())
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        let removed = self.op("remove", path)?.files.remove(path);
        removed.map(|_| ()).ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.op("rmdir", dir)?;
        if state.files.keys().chain(&state.dirs).any(|p| p.parent() == Some(dir)) {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        if state.dirs.remove(dir) { Ok(()) } else { Err(io::ErrorKind::NotFound.into()) }
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        self.op("syncdir", dir).map(|_| ())
    }

    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        let state = self.op("readdir", dir)?;
        if !state.dirs.contains(dir) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let name = |p: &Path| p.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let mut entries: Vec<_> = state
            .files
            .iter()
            .filter(|(p, _)| p.parent() == Some(dir))
            .map(|(p, n)| DirEntry { name: name(p), len: n.data.len() as u64, is_dir: false })
            .collect();
        let dirs = state.dirs.iter().filter(|p| p.parent() == Some(dir));
        entries.extend(dirs.map(|p| DirEntry { name: name(p), len: 0, is_dir: true }));
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        self.op("statvfs", dir).map(|state| state.free())
    }
}

impl WriteFile for MemFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.fs.op("write", &self.path)?;
        let mut n = bytes.len();
        for fault in &state.faults {
            if let Fault::ShortWrites(most) = *fault {
                n = n.min(most.max(1));
            }
        }
        n = n.min(usize::try_from(state.free()).unwrap_or(usize::MAX));
        if n == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        state.node(&self.path)?.data.extend_from_slice(&bytes[..n]);
        Ok(n)
    }

    fn truncate(&mut self, len: u64) -> io::Result<()> {
        let mut state = self.fs.op("truncate", &self.path)?;
        let node = state.node(&self.path)?;
        node.data.truncate(len as usize);
        node.synced = node.synced.min(len as usize);
        Ok(())
    }

    fn sync_data(&mut self) -> io::Result<()> {
        let mut state = self.fs.op("sync", &self.path)?;
        let node = state.node(&self.path)?;
        node.synced = node.data.len();
        Ok(())
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

impl ReadFile for MemFile {
    fn read_exact_at(&self, buf: &mut [u8], offset: u64) -> io::Result<()> {
        let mut state = self.fs.op("read", &self.path)?;
        let data = &state.node(&self.path)?.data;
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let part = data.get(start..start.saturating_add(buf.len())).ok_or(io::ErrorKind::UnexpectedEof)?;
        buf.copy_from_slice(part);
        Ok(())
    }

    fn size(&self) -> io::Result<u64> {
        Ok(self.fs.lock().node(&self.path)?.data.len() as u64)
    }
}
