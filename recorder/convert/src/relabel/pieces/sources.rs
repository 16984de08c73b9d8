//! The datasets of an input, cut into segments.

use super::{Fetched, PieceSource, SkippedPiece};
use crate::store::{Place, Remote};
use depthrig_bus::files::folder_of;
use depthrig_recorder::{Dataset, Error, ErrorKind, Result, SESSION_FILE};
use std::path::{Path, PathBuf};

const UNFINISHED: &str =
    "it is being recorded, or its recording was cut off: wait until it ends, or run `depthrig recover`";

/// A dataset of the input.
pub(super) enum Listed {
    Usable(Box<Usable>),
    Skipped(SkippedPiece),
}

/// A dataset whose segments become pieces.
pub(super) struct Usable {
    pub(super) name: String,
    /// Of a bucket: without segments.
    pub(super) dataset: Dataset,
    /// Where it lies in a bucket.
    remote: Option<Remote>,
    /// Files with their bytes, in order.
    segments: Vec<(String, u64)>,
    session_crc32: u32,
}

/// A segment of a dataset.
#[derive(Clone, Copy)]
pub(super) struct Segment<'a> {
    pub(super) listed: &'a Usable,
    index: usize,
    pub(super) file: &'a String,
    bytes: u64,
}

impl Listed {
    fn new(
        name: String,
        dataset: Dataset,
        remote: Option<Remote>,
        segments: Vec<(String, u64)>,
    ) -> Result<Self> {
        let session = dataset.session();
        let is_part = |file: &str| Path::new(file).extension().is_some_and(|e| e == "part");
        let is_unfinished = session.outcome.is_none() || segments.iter().any(|(file, _)| is_part(file));
        if is_unfinished || segments.is_empty() {
            let why = if is_unfinished { UNFINISHED } else { "it has no segment" };
            return Ok(Self::skipped(name, why.to_owned()));
        }
        let session_crc32 = crc32fast::hash(session.to_toml()?.as_bytes());
        Ok(Self::Usable(Box::new(Usable { name, dataset, remote, segments, session_crc32 })))
    }

    const fn skipped(dataset: String, why: String) -> Self {
        Self::Skipped(SkippedPiece { dataset, segment: None, why })
    }

    /// Its segments; or one thing that is skipped.
    pub(super) fn units(&self) -> Vec<Result<Segment<'_>, &SkippedPiece>> {
        match self {
            Self::Skipped(skipped) => vec![Err(skipped)],
            Self::Usable(listed) => {
                let segments = listed.segments.iter().enumerate();
                segments
                    .map(|(index, (file, bytes))| Ok(Segment { listed, index, file, bytes: *bytes }))
                    .collect()
            }
        }
    }
}

impl Segment<'_> {
    /// The name of its piece: `DATASET_0003` of `seg_0003.mcap`.
    pub(super) fn piece(&self) -> String {
        let number = self.file.trim_start_matches("seg_").trim_end_matches(".mcap");
        format!("{}_{number}", self.listed.name)
    }

    pub(super) fn source(&self) -> PieceSource {
        PieceSource {
            dataset: self.listed.name.clone(),
            segment: self.file.clone(),
            bytes: self.bytes,
            session_crc32: self.listed.session_crc32,
        }
    }

    /// The dataset with this segment alone, on this computer.
    pub(super) fn fetch(&self) -> Result<Fetched> {
        let dataset = &self.listed.dataset;
        let gone = || {
            Error::new(
                ErrorKind::NotFound,
                format!("{} is gone from {}", self.file, dataset.path().display()),
            )
        };
        let Some(remote) = &self.listed.remote else {
            let dataset = dataset.segment(self.index).ok_or_else(gone)?;
            return Ok(Fetched { dataset, copy: None });
        };
        let copy = dataset.path().join(self.file);
        // What a run that was killed in this folder has left may be half of it.
        drop(std::fs::remove_file(&copy));
        remote.fetch(self.file, &copy)?;
        let opened = Dataset::open(dataset.path())?;
        let index = opened.segments().iter().position(|path| *path == copy).ok_or_else(gone)?;
        Ok(Fetched { dataset: opened.segment(index).ok_or_else(gone)?, copy: Some(copy) })
    }
}

/// The datasets of a place, by name; copies of sessions in buckets lie in `scratch`.
pub(super) fn list(input: &Place, scratch: &Path) -> Result<Vec<Listed>> {
    let listed = match input {
        Place::Local(path) => local(path)?,
        Place::Remote(remote) => remotes(remote, scratch)?,
    };
    if listed.is_empty() {
        let what = format!("{input} is neither a dataset nor a folder of datasets");
        return Err(Error::new(ErrorKind::NotADataset, what));
    }
    Ok(listed)
}

fn local(path: &Path) -> Result<Vec<Listed>> {
    // `.` has a name, too.
    let path = std::fs::canonicalize(path).map_err(|e| Error::reading("open", path, e))?;
    match Dataset::open(&path) {
        Err(e) if e.kind() == ErrorKind::NotADataset && path.is_dir() => {}
        opened => return Ok(vec![of_folder(opened?)?]),
    }
    let entries = path.read_dir().map_err(|e| Error::reading("list", &path, e))?;
    let mut folders: Vec<PathBuf> = entries.filter_map(|e| e.ok().map(|e| e.path())).collect();
    folders.retain(|p| p.is_dir());
    folders.sort();
    let mut all = Vec::new();
    for folder in folders {
        match Dataset::open(&folder) {
            Ok(dataset) => all.push(of_folder(dataset)?),
            Err(e) if e.kind() == ErrorKind::NotADataset => {}
            Err(e) => all.push(Listed::skipped(file_name(&folder), e.to_string())),
        }
    }
    Ok(all)
}

fn of_folder(dataset: Dataset) -> Result<Listed> {
    let path = dataset.path().to_owned();
    // A single segment belongs to its folder.
    let folder = if path.is_dir() { path.as_path() } else { folder_of(&path) };
    let name = file_name(folder);
    let segment = |path: &PathBuf| {
        let bytes = path.metadata().map_err(|e| Error::reading("open", path, e))?.len();
        Ok((file_name(path), bytes))
    };
    let segments = dataset.segments().iter().map(segment).collect::<Result<_>>()?;
    Listed::new(name, dataset, None, segments)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn remotes(remote: &Remote, scratch: &Path) -> Result<Vec<Listed>> {
    let there = remote.list()?;
    if has_session(&there.files) {
        return Ok(vec![of_bucket(remote, there.files, scratch)?]);
    }
    let mut all = Vec::new();
    for folder in &there.folders {
        let below = remote.at(folder);
        let files = below.list()?.files;
        if has_session(&files) {
            all.push(of_bucket(&below, files, scratch)?);
        }
    }
    Ok(all)
}

fn has_session(files: &[(String, u64)]) -> bool {
    files.iter().any(|(name, _)| name == SESSION_FILE)
}

fn of_bucket(remote: &Remote, files: Vec<(String, u64)>, scratch: &Path) -> Result<Listed> {
    let name = remote.name().to_owned();
    let folder = scratch.join("sources").join(&name);
    depthrig_bus::umask::create_dir_all(&folder).map_err(|e| Error::io("create the folder", &folder, e))?;
    let session = folder.join(SESSION_FILE);
    remote.fetch(SESSION_FILE, &session)?;
    let dataset = match Dataset::open(&folder) {
        Ok(dataset) => dataset,
        Err(e) => return Ok(Listed::skipped(name, format!("{remote}: {e}"))),
    };
    let segments =
        files.into_iter().filter(|(file, _)| depthrig_recorder::segment_number(file).is_some()).collect();
    Listed::new(name, dataset, Some(remote.clone()), segments)
}
