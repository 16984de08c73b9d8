//! A file system in memory for tests: any operation can be made to fail, writes can be short, space can run
//! out, and a crash leaves what was synced plus whatever a disk may have kept of the rest.
//!
//! The model of a crash is the weakest that POSIX allows. A name is durable only after its folder was synced;
//! names that are not may be there or not, each for itself. Bytes are durable only after their file was
//! synced; of the others each sector may be new, old or zero, whatever became of those before it, and the
//! file may have any length between. After a sync that failed, the bytes that it was for never become durable
//! (<https://wiki.postgresql.org/wiki/Fsync_Errors>).

use super::{DirEntry, Fs, ReadFile, WriteFile};
use depthrig_bus::sync::lock;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};

/// The unit that a disk writes completely or not at all, bytes.
const SECTOR: usize = 512;

/// A fault injected into a [`MemFs`], with the operation that it hits (numbered from 0, over all files).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    /// The operation of this number fails, and no other.
    FailOnce(u64, io::ErrorKind),
    /// The operation of this number and all after it fail.
    FailFrom(u64, io::ErrorKind),
    /// Every write takes at most this many bytes.
    ShortWrites(usize),
    /// The operation of this number takes one byte if it is a write, and no other does.
    ShortOnce(u64),
}

#[derive(Debug, Default, Clone)]
struct Node {
    data: Vec<u8>,
    /// The first bytes of `data` that are durable.
    synced: usize,
    /// Durable bytes after those that were cut off or replaced since.
    old: Vec<u8>,
    /// A sync failed: what was not durable then never becomes so.
    stuck: bool,
}

/// A change of names that is not durable yet: the file of this number went from one name to another.
#[derive(Debug, Clone)]
struct Move {
    file: u64,
    from: Option<PathBuf>,
    to: Option<PathBuf>,
}

#[derive(Debug, Default)]
struct State {
    nodes: BTreeMap<u64, Node>,
    names: BTreeMap<PathBuf, u64>,
    /// The names that survive every crash.
    durable: BTreeMap<PathBuf, u64>,
    moves: Vec<Move>,
    next: u64,
    dirs: BTreeSet<PathBuf>,
    /// Folders that are locked, each by a lock with a number of its own.
    locks: BTreeMap<PathBuf, u64>,
    ops: u64,
    log: Vec<String>,
    faults: Vec<Fault>,
    capacity: Option<u64>,
    /// Names and bytes changed so far, however often.
    changes: u64,
}

/// A file system in memory; clones share it.
#[derive(Debug, Clone, Default)]
pub struct MemFs(Arc<Mutex<State>>);

/// An open file: a change of its name does not affect it.
struct MemFile {
    fs: MemFs,
    path: PathBuf,
    file: u64,
}

/// Releases the lock of this number, even if its folder was renamed.
struct Unlock(MemFs, u64);

impl Drop for Unlock {
    fn drop(&mut self) {
        self.0.state().locks.retain(|_, lock| *lock != self.1);
    }
}

impl State {
    fn used(&self) -> u64 {
        self.names.values().filter_map(|n| self.nodes.get(n)).map(|n| n.data.len() as u64).sum()
    }

    fn free(&self) -> u64 {
        self.capacity.map_or(u64::MAX, |c| c.saturating_sub(self.used()))
    }

    fn node(&mut self, file: u64) -> io::Result<&mut Node> {
        self.nodes.get_mut(&file).ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    /// Renames a folder with all below it, unless the new name exists.
    fn rename_dir(&mut self, from: &Path, to: &Path) -> io::Result<()> {
        if self.names.keys().chain(&self.dirs).any(|p| p.starts_with(to) && p != to) {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        let moved = |p: PathBuf| p.strip_prefix(from).map(|rest| to.join(rest)).unwrap_or(p);
        let renamed =
            |names: BTreeMap<PathBuf, u64>| names.into_iter().map(|(p, file)| (moved(p), file)).collect();
        self.names = renamed(std::mem::take(&mut self.names));
        self.durable = renamed(std::mem::take(&mut self.durable));
        for m in &mut self.moves {
            m.from = m.from.take().map(moved);
            m.to = m.to.take().map(moved);
        }
        // Joining an empty rest leaves a slash at the end, which no path of a folder has here.
        let tidy = |p: PathBuf| -> PathBuf { p.components().collect() };
        self.dirs = std::mem::take(&mut self.dirs).into_iter().map(moved).map(tidy).collect();
        // A lock belongs to the folder, not to its name.
        let locks = std::mem::take(&mut self.locks).into_iter();
        self.locks = locks.map(|(p, lock)| (tidy(moved(p)), lock)).collect();
        self.changes += 1;
        Ok(())
    }

    fn moved(&mut self, file: u64, from: Option<&Path>, to: Option<&Path>) {
        self.moves.push(Move { file, from: from.map(Path::to_owned), to: to.map(Path::to_owned) });
        self.changes += 1;
    }

    /// Applies the changes that `keep` selects to `names`.
    fn settle(&self, names: &mut BTreeMap<PathBuf, u64>, mut keep: impl FnMut(&Move) -> bool) {
        for m in self.moves.iter().filter(|m| keep(m)) {
            if let Some(from) = m.from.as_ref().filter(|from| names.get(*from) == Some(&m.file)) {
                names.remove(from);
            }
            if let Some(to) = &m.to {
                names.insert(to.clone(), m.file);
            }
        }
    }

    fn fails(&self, n: u64) -> Option<io::Error> {
        self.faults.iter().find_map(|fault| match *fault {
            Fault::FailOnce(at, kind) if n == at => Some(kind.into()),
            Fault::FailFrom(at, kind) if n >= at => Some(kind.into()),
            _ => None,
        })
    }
}

impl Node {
    /// The contents that a crash leaves; `choose(n)` is any number below `n`.
    fn crashed(&self, choose: &mut dyn FnMut(usize) -> usize) -> Vec<u8> {
        let durable_len = self.synced + self.old.len();
        let least = durable_len.min(self.data.len());
        let most = durable_len.max(self.data.len());
        let len = match choose(4) {
            0 => least,
            1 => most,
            _ => least + choose(most - least + 1),
        };
        let mut out = vec![0; len];
        let sure = self.synced.min(len);
        out[..sure].copy_from_slice(&self.data[..sure]);
        let mut at = sure;
        while at < len {
            let to = (at / SECTOR + 1) * SECTOR;
            let to = to.min(len);
            let new = self.data.get(at..to.min(self.data.len())).unwrap_or_default();
            let old = self.old.get(at - self.synced..).unwrap_or_default();
            let old = &old[..old.len().min(to - at)];
            match choose(4) {
                // As it was on the disk before: old bytes, or zeros where there were none.
                0 => out[at..at + old.len()].copy_from_slice(old),
                // Torn within the sector.
                1 => {
                    let n = choose(new.len() + 1);
                    out[at..at + old.len()].copy_from_slice(old);
                    out[at..at + n].copy_from_slice(&new[..n]);
                }
                _ => out[at..at + new.len()].copy_from_slice(new),
            }
            at = to;
        }
        out
    }
}

impl MemFs {
    /// An empty file system.
    pub fn new() -> Self {
        Self::default()
    }

    /// The same file system with a fault added.
    pub fn with_fault(self, fault: Fault) -> Self {
        self.state().faults.push(fault);
        self
    }

    /// The same file system that holds `bytes` at most.
    pub fn with_capacity(self, bytes: u64) -> Self {
        self.state().capacity = Some(bytes);
        self
    }

    /// Operations requested so far.
    pub fn ops(&self) -> u64 {
        self.state().ops
    }

    /// Changes of names and bytes so far; states with equal counts are equal.
    pub fn changes(&self) -> u64 {
        self.state().changes
    }

    /// The operations so far, each as a line.
    pub fn log(&self) -> Vec<String> {
        self.state().log.clone()
    }

    /// The bytes of a file.
    pub fn contents(&self, path: &Path) -> Option<Vec<u8>> {
        let state = self.state();
        state.nodes.get(state.names.get(path)?).map(|n| n.data.clone())
    }

    /// Durable bytes of the file whose durable name is `path`; 0 if it does not exist.
    pub fn synced(&self, path: &Path) -> usize {
        let state = self.state();
        state.durable.get(path).and_then(|file| state.nodes.get(file)).map_or(0, |n| n.synced)
    }

    /// Puts a file there, as durable.
    pub fn put(&self, path: &Path, data: Vec<u8>) {
        let mut state = self.state();
        let file = state.next;
        state.next += 1;
        state.nodes.insert(file, Node { synced: data.len(), data, ..Node::default() });
        state.names.insert(path.to_owned(), file);
        state.durable.insert(path.to_owned(), file);
    }

    /// The files after a crash that keeps every name: of each file the synced bytes and `keep(unsynced bytes)` of the
    /// rest. Faults, limits, locks and counts are gone.
    pub fn after_crash(&self, mut keep: impl FnMut(usize) -> usize) -> Self {
        let state = self.state();
        let left = Self::new();
        left.state().dirs.clone_from(&state.dirs);
        for (path, file) in &state.names {
            let Some(node) = state.nodes.get(file) else { continue };
            let unsynced = node.data.len().saturating_sub(node.synced);
            let len = node.synced + keep(unsynced).min(unsynced);
            left.put(path, node.data[..len].to_vec());
        }
        left
    }

    /// The files after a crash of the whole computer; `choose(n)`, any number below `n`, decides what the disk kept.
    /// Faults, limits, locks and counts are gone.
    pub fn crash(&self, choose: &mut dyn FnMut(usize) -> usize) -> Self {
        let state = self.state();
        let mut names = state.durable.clone();
        let style = choose(3);
        state.settle(&mut names, |_| style == 1 || (style == 2 && choose(2) == 1));
        let left = Self::new();
        left.state().dirs.clone_from(&state.dirs);
        for (path, file) in names {
            let Some(node) = state.nodes.get(&file) else { continue };
            left.put(&path, node.crashed(choose));
        }
        left
    }

    fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.0)
    }

    /// Counts an operation, and fails it if a fault says so.
    fn op(&self, what: &str, path: &Path) -> io::Result<MutexGuard<'_, State>> {
        let mut state = self.state();
        let n = state.ops;
        state.ops += 1;
        state.log.push(format!("{what} {}", path.display()));
        match state.fails(n) {
            Some(e) => Err(e),
            None => Ok(state),
        }
    }

    fn sync(&self, path: &Path, file: u64) -> io::Result<()> {
        match self.op("sync", path) {
            Ok(mut state) => {
                let node = state.node(file)?;
                if !node.stuck {
                    node.synced = node.data.len();
                    node.old.clear();
                }
                Ok(())
            }
            Err(e) => {
                if let Ok(node) = self.state().node(file) {
                    node.stuck = true;
                }
                Err(e)
            }
        }
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
        if state.names.contains_key(path) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        if !path.parent().is_some_and(|dir| state.dirs.contains(dir)) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let file = state.next;
        state.next += 1;
        state.nodes.insert(file, Node::default());
        state.names.insert(path.to_owned(), file);
        state.moved(file, None, Some(path));
        Ok(Box::new(MemFile { fs: self.clone(), path: path.to_owned(), file }))
    }

    fn open(&self, path: &Path) -> io::Result<Box<dyn ReadFile>> {
        let file = self.op("open", path)?.names.get(path).copied().ok_or(io::ErrorKind::NotFound)?;
        Ok(Box::new(MemFile { fs: self.clone(), path: path.to_owned(), file }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut state = self.op("rename", from)?;
        if state.dirs.contains(from) {
            return state.rename_dir(from, to);
        }
        let file = state.names.remove(from).ok_or(io::ErrorKind::NotFound)?;
        state.names.insert(to.to_owned(), file);
        state.moved(file, Some(from), Some(to));
        Ok(())
    }

    fn exchange(&self, a: &Path, b: &Path) -> io::Result<()> {
        let mut state = self.op("exchange", a)?;
        if ![a, b].iter().all(|dir| state.dirs.contains(*dir)) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let between = a.with_extension("exchange");
        state.rename_dir(a, &between)?;
        state.rename_dir(b, a)?;
        state.rename_dir(&between, b)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        let mut state = self.op("remove", path)?;
        let file = state.names.remove(path).ok_or(io::ErrorKind::NotFound)?;
        state.moved(file, Some(path), None);
        Ok(())
    }

    fn remove_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.op("rmdir", dir)?;
        if state.names.keys().chain(&state.dirs).any(|p| p.parent() == Some(dir)) {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        // Another folder of this name is not locked.
        state.locks.remove(dir);
        if state.dirs.remove(dir) { Ok(()) } else { Err(io::ErrorKind::NotFound.into()) }
    }

    fn sync_dir(&self, dir: &Path) -> io::Result<()> {
        let mut state = self.op("syncdir", dir)?;
        let inside = |p: &Option<PathBuf>| p.as_ref().is_none_or(|p| p.parent() == Some(dir));
        let mut durable = std::mem::take(&mut state.durable);
        state.settle(&mut durable, |m| inside(&m.from) && inside(&m.to));
        state.durable = durable;
        state.moves.retain(|m| !(inside(&m.from) && inside(&m.to)));
        Ok(())
    }

    fn read_dir(&self, dir: &Path) -> io::Result<Vec<DirEntry>> {
        let state = self.op("readdir", dir)?;
        if !state.dirs.contains(dir) {
            return Err(io::ErrorKind::NotFound.into());
        }
        let name = |p: &Path| p.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let len = |file: &u64| state.nodes.get(file).map_or(0, |n| n.data.len() as u64);
        let mut entries: Vec<_> = state
            .names
            .iter()
            .filter(|(p, _)| p.parent() == Some(dir))
            .map(|(p, file)| DirEntry { name: name(p), len: len(file), is_dir: false })
            .collect();
        let dirs = state.dirs.iter().filter(|p| p.parent() == Some(dir));
        entries.extend(dirs.map(|p| DirEntry { name: name(p), len: 0, is_dir: true }));
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(entries)
    }

    fn available_space(&self, dir: &Path) -> io::Result<u64> {
        self.op("statvfs", dir).map(|state| state.free())
    }

    fn sync_file(&self, path: &Path) -> io::Result<()> {
        let file = self.state().names.get(path).copied().ok_or(io::ErrorKind::NotFound)?;
        self.sync(path, file)
    }

    fn lock(&self, dir: &Path) -> io::Result<Box<dyn Send + Sync>> {
        let mut state = self.op("lock", dir)?;
        if state.locks.contains_key(dir) {
            return Err(io::ErrorKind::WouldBlock.into());
        }
        let lock = state.next;
        state.next += 1;
        state.locks.insert(dir.to_owned(), lock);
        Ok(Box::new(Unlock(self.clone(), lock)))
    }
}

impl WriteFile for MemFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut state = self.fs.op("write", &self.path)?;
        let this = state.ops - 1;
        let mut n = bytes.len();
        for fault in &state.faults {
            match *fault {
                Fault::ShortWrites(most) => n = n.min(most.max(1)),
                Fault::ShortOnce(at) if at == this => n = n.min(1),
                _ => {}
            }
        }
        n = n.min(usize::try_from(state.free()).unwrap_or(usize::MAX));
        if n == 0 && !bytes.is_empty() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        state.changes += 1;
        state.node(self.file)?.data.extend_from_slice(&bytes[..n]);
        Ok(n)
    }

    fn truncate(&mut self, len: u64) -> io::Result<()> {
        let mut state = self.fs.op("truncate", &self.path)?;
        state.changes += 1;
        let node = state.node(self.file)?;
        let len = (len as usize).min(node.data.len());
        if len < node.synced {
            let mut old = node.data[len..node.synced].to_vec();
            old.append(&mut node.old);
            node.old = old;
            node.synced = len;
        }
        node.data.truncate(len);
        Ok(())
    }

    fn sync_data(&mut self) -> io::Result<()> {
        self.fs.sync(&self.path, self.file)
    }

    fn sync_all(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

impl ReadFile for MemFile {
    fn read_exact_at(&self, buf: &mut [u8], offset: u64) -> io::Result<()> {
        let mut state = self.fs.op("read", &self.path)?;
        let data = &state.node(self.file)?.data;
        let start = usize::try_from(offset).unwrap_or(usize::MAX);
        let part = data.get(start..start.saturating_add(buf.len())).ok_or(io::ErrorKind::UnexpectedEof)?;
        buf.copy_from_slice(part);
        Ok(())
    }

    fn size(&self) -> io::Result<u64> {
        Ok(self.fs.state().node(self.file)?.data.len() as u64)
    }
}
