//! The folder of an export: files that get their name when they are complete, and the marks of what is done.
//!
//! While it grows it holds `.export.json` (what is being exported), and for each part that is done
//! `.part_NNNNN.rows` and then `.part_NNNNN.json`. When all is done `export.json` is written and these go.

use super::report::{PartRecord, REPORT_FILE};
use depthrig_recorder::fs::{self, Fs, ReadFile, WriteFile};
use depthrig_recorder::{Error, ErrorKind, Result};
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// The file that says what is being exported into the folder.
const STATE_FILE: &str = ".export.json";
/// The largest mark or report that is read back, bytes.
const JSON_MAX: u64 = 256 << 20;

/// The folder that an export is written to.
pub struct Output<'a> {
    fs: &'a dyn Fs,
    dir: PathBuf,
    files: AtomicU64,
    bytes: AtomicU64,
    /// Keeps a second export out of the folder.
    _lock: Box<dyn Send + Sync>,
}

/// A file that is being written; it gets its name in [`OutFile::finish`].
pub struct OutFile<'a> {
    fs: &'a dyn Fs,
    file: Box<dyn WriteFile>,
    part: PathBuf,
    path: PathBuf,
    written: u64,
    count: Option<(&'a AtomicU64, &'a AtomicU64)>,
}

/// State of the export in a folder.
pub(super) enum FolderState {
    /// No export, or one that was not finished: work on.
    Open,
    /// The same export, complete.
    Complete(Value),
}

fn json_error(path: &Path, e: serde_json::Error) -> Error {
    let what = format!("{} is not as depthrig wrote it; export into a new folder", path.display());
    Error::new(ErrorKind::Corrupt, what).with_source(e)
}

impl<'a> Output<'a> {
    /// Creates the folder, or finds an export of exactly `state` in it.
    pub(super) fn open(fs: &'a dyn Fs, dir: &Path, state: &Value) -> Result<(Self, FolderState)> {
        let entries = match fs.read_dir(dir) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                fs.create_dir_all(dir).map_err(|e| Error::io("create the folder", dir, e))?;
                Vec::new()
            }
            Err(e) => return Err(Error::io("use the folder", dir, e)),
        };
        let lock = fs.lock(dir).map_err(|e| match e.kind() {
            io::ErrorKind::WouldBlock => {
                let what = format!("another export is writing to {}; wait until it has ended", dir.display());
                Error::new(ErrorKind::AlreadyExists, what)
            }
            _ => Error::io("lock the folder", dir, e),
        })?;
        let files = AtomicU64::new(0);
        let bytes = AtomicU64::new(0);
        let out = Self { fs, dir: dir.to_owned(), files, bytes, _lock: lock };
        let has = |name: &str| entries.iter().any(|e| e.name == name);
        // The first file of an export is `.export.json`; when even that was cut off, its unnamed part is all there is.
        let unborn = entries.iter().all(|e| e.name == part_name(STATE_FILE));
        if unborn {
            out.write(STATE_FILE, &pretty(state)?)?;
            return Ok((out, FolderState::Open));
        }
        let known = if has(REPORT_FILE) { REPORT_FILE } else { STATE_FILE };
        if !has(known) {
            let first = entries.first().map_or("", |e| &e.name);
            let what = format!("{} is not empty (it holds {first}); choose a new folder", dir.display());
            return Err(Error::new(ErrorKind::AlreadyExists, what));
        }
        let found: Value = out.read_json(known)?;
        if let Some(differs) = difference(&found, state) {
            let what = format!(
                "{} holds an export that differs in its {differs}; choose a new folder",
                dir.display()
            );
            return Err(Error::new(ErrorKind::AlreadyExists, what));
        }
        let state = if known == REPORT_FILE { FolderState::Complete(found) } else { FolderState::Open };
        Ok((out, state))
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Creates a folder below; one that is there already is fine.
    ///
    /// # Errors
    /// As the file system says.
    pub fn folder(&self, name: &str) -> Result<()> {
        let path = self.dir.join(name);
        self.fs.create_dir_all(&path).map_err(|e| Error::io("create the folder", &path, e))
    }

    /// Begins the file `name`, a path below the folder; its own folder is there. A file that an earlier, killed run
    /// left under this name is replaced.
    ///
    /// # Errors
    /// As the file system says.
    pub fn create(&self, name: &str) -> Result<OutFile<'_>> {
        let mut file = self.begin(name)?;
        file.count = Some((&self.files, &self.bytes));
        Ok(file)
    }

    /// Begins a file that is not of the layout: needed until the export is complete, removed then because its name
    /// begins with `.part_`.
    pub(super) fn scratch(&self, name: &str) -> Result<OutFile<'_>> {
        debug_assert!(name.starts_with(".part_"));
        self.begin(name)
    }

    /// Opens the file `name`; `None` when it is not there.
    pub(super) fn open_file(&self, name: &str) -> Result<Option<Box<dyn ReadFile>>> {
        let path = self.dir.join(name);
        match self.fs.open(&path) {
            Ok(file) => Ok(Some(file)),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(e) => Err(Error::reading("open", &path, e)),
        }
    }

    /// Counts a file of the layout that an earlier run completed.
    pub(super) fn keep(&self, bytes: u64) {
        self.files.fetch_add(1, Ordering::Relaxed);
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
    }

    /// Removes the file `name`, if it is there.
    pub(super) fn remove(&self, name: &str) -> Result<()> {
        let path = self.dir.join(name);
        match self.fs.remove_file(&path) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(Error::io("remove", &path, e)),
            _ => Ok(()),
        }
    }

    /// Writes the file `name` in one step.
    ///
    /// # Errors
    /// As the file system says.
    pub fn file(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let mut file = self.create(name)?;
        file.append(bytes)?;
        file.finish().map(drop)
    }

    /// Files and bytes written through this.
    pub(super) fn written(&self) -> (u64, u64) {
        (self.files.load(Ordering::Relaxed), self.bytes.load(Ordering::Relaxed))
    }

    fn begin(&self, name: &str) -> Result<OutFile<'_>> {
        let path = self.dir.join(name);
        let file_name = path.file_name().unwrap_or_default().to_string_lossy();
        let part = path.with_file_name(part_name(&file_name));
        let create = || {
            match self.fs.remove_file(&part) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
            self.fs.create_new(&part)
        };
        let file = create().map_err(|e| Error::io("create", &part, e))?;
        Ok(OutFile { fs: self.fs, file, part, path, written: 0, count: None })
    }

    /// A file that is not of the layout and therefore not counted.
    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let mut file = self.begin(name)?;
        file.append(bytes)?;
        file.finish()?;
        self.sync_dir(&self.dir)
    }

    pub(super) fn sync_dir(&self, dir: &Path) -> Result<()> {
        self.fs.sync_dir(dir).map_err(|e| Error::io("sync the folder", dir, e))
    }

    fn read(&self, name: &str) -> Result<Option<Vec<u8>>> {
        let path = self.dir.join(name);
        let file = match self.fs.open(&path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(Error::reading("open", &path, e)),
        };
        let read = || {
            let mut bytes = vec![0; usize::try_from(file.size()?.min(JSON_MAX)).unwrap_or(0)];
            file.read_exact_at(&mut bytes, 0)?;
            Ok(bytes)
        };
        read().map(Some).map_err(|e| Error::reading("read", &path, e))
    }

    fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T> {
        let bytes = self.read(name)?.unwrap_or_default();
        serde_json::from_slice(&bytes).map_err(|e| json_error(&self.dir.join(name), e))
    }

    /// The record of a part that is done.
    pub(super) fn part(&self, part: usize) -> Result<Option<PartRecord>> {
        let name = mark(part, "json");
        let Some(bytes) = self.read(&name)? else { return Ok(None) };
        serde_json::from_slice(&bytes).map(Some).map_err(|e| json_error(&self.dir.join(name), e))
    }

    /// The rows of a part that is done.
    pub(super) fn rows(&self, part: usize) -> Result<Vec<u8>> {
        let name = mark(part, "rows");
        self.read(&name)?.ok_or_else(|| {
            let what = format!("{} has lost {name}; remove the folder and export again", self.dir.display());
            Error::new(ErrorKind::Corrupt, what)
        })
    }

    /// Marks a part as done; what it wrote is durable by then.
    pub(super) fn mark(&self, part: usize, record: &PartRecord, rows: &[u8]) -> Result<()> {
        self.write(&mark(part, "rows"), rows)?;
        let text = serde_json::to_value(record).map_err(|e| json_error(&self.dir, e))?;
        self.write(&mark(part, "json"), &pretty(&text)?)
    }

    /// Writes the report and removes the marks.
    pub(super) fn close(&self, report: &Value) -> Result<()> {
        self.write(REPORT_FILE, &pretty(report)?)?;
        self.clean()
    }

    /// Removes the marks; the state last, because without it the folder is nobody's.
    pub(super) fn clean(&self) -> Result<()> {
        let entries = self.fs.read_dir(&self.dir).map_err(|e| Error::reading("list", &self.dir, e))?;
        let marks = entries.iter().filter(|e| !e.is_dir && e.name.starts_with(".part_"));
        let state = entries.iter().filter(|e| e.name == STATE_FILE);
        for entry in marks.chain(state) {
            let path = self.dir.join(&entry.name);
            self.fs.remove_file(&path).map_err(|e| Error::io("remove", &path, e))?;
        }
        self.sync_dir(&self.dir)
    }
}

impl OutFile<'_> {
    /// Appends `bytes`.
    ///
    /// # Errors
    /// As the file system says.
    pub fn append(&mut self, bytes: &[u8]) -> Result<()> {
        self.written += bytes.len() as u64;
        fs::write_all(&mut *self.file, bytes).map_err(|e| Error::io("write", &self.part, e))
    }

    /// Makes the file durable and gives it its name; returns its bytes.
    ///
    /// # Errors
    /// As the file system says.
    pub fn finish(mut self) -> Result<u64> {
        self.file.sync_all().map_err(|e| Error::io("sync", &self.part, e))?;
        self.fs.rename(&self.part, &self.path).map_err(|e| Error::io("rename", &self.part, e))?;
        if let Some((files, bytes)) = self.count {
            files.fetch_add(1, Ordering::Relaxed);
            bytes.fetch_add(self.written, Ordering::Relaxed);
        }
        Ok(self.written)
    }
}

impl io::Write for OutFile<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n = self.file.write(bytes)?;
        self.written += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The name of a file that is not complete yet; hidden, so that no pattern for images finds it.
fn part_name(name: &str) -> String {
    format!(".{}.tmp", name.trim_start_matches('.'))
}

fn mark(part: usize, ending: &str) -> String {
    format!(".part_{part:05}.{ending}")
}

fn pretty(value: &Value) -> Result<Vec<u8>> {
    let mut text = serde_json::to_vec_pretty(value)
        .map_err(|e| Error::new(ErrorKind::BadInput, "a report cannot be written as JSON").with_source(e))?;
    text.push(b'\n');
    Ok(text)
}

/// The first key of `state` that `found` has otherwise.
fn difference(found: &Value, state: &Value) -> Option<String> {
    let state = state.as_object()?;
    state.iter().find(|(key, value)| found.get(key) != Some(value)).map(|(key, _)| key.clone())
}
