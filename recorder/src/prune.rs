//! Removing the sets of discarded episodes for good.
//!
//! The dataset is written anew beside the old one, without them, and verified. Then the two folders exchange their names in one step, and
//! the old one is removed. A process that is killed leaves one or the other under the dataset's name, and beside it a hidden folder, which
//! the next run removes. On a file system that cannot exchange names the old folder is renamed first: if killed just then, both are there
//! under other names, complete.

use crate::dataset::segment_number;
use crate::fs::Fs;
use crate::report::REPORT_FILE;
use crate::session::{SESSION_TMP, SessionText};
use crate::slice::without_discarded;
use crate::verify::{VerifyOptions, verify_watched};
use crate::{Dataset, Edit, Episode, Error, ErrorKind, Result, SESSION_FILE};
use depthrig_bus::UtcPair;
use serde::Serialize;
use std::ffi::OsString;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Callback with the step, the bytes done and the bytes to do; a break ends the work.
pub type PruneProgress<'a> = &'a mut dyn FnMut(&str, u64, u64) -> ControlFlow<()>;

/// Sets and episodes that pruning removes.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Prunable {
    /// Discarded episodes.
    pub episodes: Vec<Episode>,
    /// Sets in them, and in no other.
    pub sets: u64,
    /// Bytes of these sets.
    pub bytes: u64,
    /// Sets that stay.
    pub kept_sets: u64,
}

/// Sets and episodes that were removed.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Pruned {
    /// Episodes and sets.
    pub removed: Prunable,
    /// The folder of the old dataset, if it could not be removed.
    pub left: Option<PathBuf>,
    /// `report.html` went with them: it was about all sets.
    pub had_report: bool,
}

/// Looks for what [`prune`] would remove. Reads the indexes of all segments, and no set.
///
/// # Errors
/// As reading the indexes does.
pub fn prunable(dataset: &Dataset) -> Result<Prunable> {
    let session = dataset.session();
    let reader = dataset.set_reader()?;
    let mut found = Prunable {
        episodes: session.episodes.iter().filter(|e| e.discarded).cloned().collect(),
        ..Prunable::default()
    };
    for utc_ns in reader.times() {
        *(if session.is_discarded(*utc_ns) { &mut found.sets } else { &mut found.kept_sets }) += 1;
    }
    for segment in (0..dataset.segments().len()).filter_map(|segment| dataset.open_segment(segment)) {
        let segment = segment?;
        let discarded = segment.chunks.iter().filter(|c| session.is_discarded(c.start_time as i64));
        found.bytes += discarded.map(|c| c.length).sum::<u64>();
    }
    Ok(found)
}

/// Removes the sets of discarded episodes, and the episodes, from the finished dataset `dir`. Without such sets nothing changes.
///
/// # Errors
/// As [`crate::edit`] for a dataset that is being recorded or is in use; [`ErrorKind::Corrupt`] when it is damaged,
/// [`ErrorKind::BadInput`] when no set would stay, [`ErrorKind::DiskFull`], [`ErrorKind::Cancelled`], and as reading and writing do. The
/// dataset is as it was then.
pub fn prune(fs: &Arc<dyn Fs>, dir: &Path, progress: PruneProgress<'_>) -> Result<Pruned> {
    // Keeps recorders and edits out until the end.
    let _guard = SessionText::open(&**fs, dir)?;
    let new = beside(dir, "prune")?;
    for left in [beside(dir, "prune.part")?, beside(dir, "old")?, new.clone()] {
        clear(&**fs, &left, dir)?;
    }
    let dataset = Dataset::open_with(Arc::clone(fs), dir)?;
    let removed = prunable(&dataset)?;
    if removed.sets == 0 {
        return Ok(Pruned { removed, left: None, had_report: false });
    }
    if removed.kept_sets == 0 {
        let what = format!("all sets of {} are discarded; remove its folder instead", dir.display());
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    // What cannot be read would be lost with the old dataset.
    check(fs, dir, "verify", progress)?;
    let session = session_without(&dataset, &removed);
    let write = &mut |done, total| progress("prune", done, total);
    let written = without_discarded(&**fs, &dataset, &new, session, write)?;
    let checked = check(fs, &new, "verify again", progress).and_then(|()| {
        let what = || format!("{} sets were copied, not {}", written.sets, removed.kept_sets);
        let all = written.sets == removed.kept_sets;
        if all { Ok(()) } else { Err(Error::new(ErrorKind::Corrupt, what())) }
    });
    if let Err(e) = checked.and_then(|()| exchange(&**fs, dir, &new)) {
        let _ = clear(&**fs, &new, dir);
        return Err(e);
    }
    let entries = fs.read_dir(&new).unwrap_or_default();
    let had_report = entries.iter().any(|e| e.name == REPORT_FILE);
    let left = clear(&**fs, &new, dir).err().map(|_| new);
    Ok(Pruned { removed, left, had_report })
}

/// A hidden name beside the dataset.
fn beside(dir: &Path, ending: &str) -> Result<PathBuf> {
    let name = dir.file_name().ok_or_else(|| {
        Error::new(ErrorKind::BadInput, format!("{} is not the name of a dataset's folder", dir.display()))
    })?;
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden.push(".");
    hidden.push(ending);
    Ok(dir.with_file_name(hidden))
}

/// The session without the discarded episodes, with a line of history.
fn session_without(dataset: &Dataset, removed: &Prunable) -> crate::Session {
    let mut session = dataset.session().clone();
    session.episodes.retain(|e| !e.discarded);
    let numbers: Vec<String> = removed.episodes.iter().map(|e| e.number.to_string()).collect();
    session.history.push(Edit {
        utc_ns: UtcPair::sample().utc_ns,
        field: "pruned".to_owned(),
        before: format!("discarded episodes {}, {} sets", numbers.join(", "), removed.sets),
        after: String::new(),
        depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
    });
    session
}

fn check(fs: &Arc<dyn Fs>, dir: &Path, step: &str, progress: PruneProgress<'_>) -> Result<()> {
    let report =
        verify_watched(fs, dir, &VerifyOptions::default(), &mut |p| progress(step, p.bytes, p.total_bytes))?;
    if report.stopped {
        return Err(Error::new(ErrorKind::Cancelled, "it was ended before it was done; nothing was removed"));
    }
    report.broken().map_or(Ok(()), |finding| {
        let what = format!(
            "{} is damaged, nothing was removed: {}: {}; repair it first: depthrig recover",
            dir.display(),
            finding.file,
            finding.message
        );
        Err(Error::new(ErrorKind::Corrupt, what))
    })
}

/// Gives the new dataset the name of the old one, and the old one that of the new one.
fn exchange(fs: &dyn Fs, dir: &Path, new: &Path) -> Result<()> {
    let failed = |e| Error::io("exchange the folder", dir, e);
    match fs.exchange(dir, new) {
        Err(e) if e.kind() == io::ErrorKind::Unsupported => {
            let old = beside(dir, "old")?;
            fs.rename(dir, &old).map_err(failed)?;
            if let Err(e) = fs.rename(new, dir) {
                fs.rename(&old, dir).map_err(failed)?;
                return Err(failed(e));
            }
            fs.rename(&old, new).map_err(failed)?;
        }
        done => done.map_err(failed)?,
    }
    let parent = dir.parent().unwrap_or(Path::new("."));
    fs.sync_dir(parent).map_err(|e| Error::io("sync the folder", parent, e))
}

/// Removes a folder of an earlier dataset or try, if it is there. Files that are not depthrig's move into `dir`.
fn clear(fs: &dyn Fs, left: &Path, dir: &Path) -> Result<()> {
    let entries = match fs.read_dir(left) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(()),
        entries => entries.map_err(|e| Error::io("read the folder", left, e))?,
    };
    for entry in entries {
        let path = left.join(&entry.name);
        let is_ours = segment_number(&entry.name).is_some()
            || [SESSION_FILE, SESSION_TMP, REPORT_FILE].contains(&entry.name.as_str());
        if is_ours && !entry.is_dir {
            fs.remove_file(&path).map_err(|e| Error::io("remove", &path, e))?;
            continue;
        }
        let there = fs.read_dir(dir).map_err(|e| Error::io("read the folder", dir, e))?;
        // One of the same name stays where it is, and with it the folder.
        if !there.iter().any(|e| e.name == entry.name) {
            fs.rename(&path, &dir.join(&entry.name)).map_err(|e| Error::io("move", &path, e))?;
        }
    }
    fs.remove_dir(left).map_err(|e| Error::io("remove the folder", left, e))
}
