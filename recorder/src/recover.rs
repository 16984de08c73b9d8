//! Repairs a dataset after a crash, a full disk or a damaged sector.
//!
//! Each segment that is unfinished, torn or damaged is copied, set by whole set, into a new file beside it; the
//! copy is read back and compared, and only then takes the old one's place, in one rename. Until then nothing
//! of the old file is touched, so that a crash of the recovery itself costs nothing: the next one begins anew.
//! Losses are listed in the report, in the file (`depthrig.recovered`) and in `session.toml`.

use crate::container::segment::{file_name, sync_folder_of};
use crate::dataset::{segment_number, segments_in};
use crate::fs::{DirEntry, Fs, RealFs, lock_with_retries};
use crate::recorder::RESERVE_FILE;
use crate::session::SESSION_TMP;
use crate::verify::{Judge, broken_session};
use crate::{Error, ErrorKind, Result, SESSION_FILE, Session};
use core::ops::ControlFlow;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod dry;
mod facts;
mod head;
mod lost;
mod segment;
mod session;

use dry::DryFs;
use facts::Facts;
use segment::{Before, Choice, Rebuild, Rebuilt};
use session::Chosen;

/// Extension of a copy until it is verified.
const TEMPORARY: &str = "mcap.recovering";
/// Copies of one segment at most: each leaves out the parts that the one before showed to be damaged.
const TRIES: u32 = 8;
/// Missing segments at most that are replaced by empty ones.
const GONE_MAX: usize = 1000;
/// The limit of a dry run, for its report.
const UNKNOWN_IN_DRY_RUN: &str =
    "nothing was written: a disk that fails or fills up meanwhile would stop the recovery";

/// How to recover.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RecoverOptions {
    /// Work on a copy in memory and change nothing: the report is that of a recovery, except for a disk that fails or
    /// fills up meanwhile.
    pub dry_run: bool,
    /// Take segments that have their index and their final name as complete, without reading what was finished long
    /// ago.
    pub unfinished_only: bool,
}

/// Progress of a recovery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecoverProgress {
    /// Bytes done.
    pub done_bytes: u64,
    /// Bytes of all segments.
    pub total_bytes: u64,
}

/// The action taken on a segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RecoverAction {
    /// It was complete.
    None,
    /// It was complete and got its final name.
    Finished,
    /// It was copied, set by set.
    Rebuilt,
}

/// A range of bytes without a complete record.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LostBytes {
    /// The first one.
    pub from: u64,
    /// The one after the last.
    pub to: u64,
    /// Why they were given up.
    pub why: String,
}

/// The state of a segment, and the action taken on it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct RecoveredSegment {
    /// Its name before.
    pub file: String,
    /// The action taken.
    pub action: RecoverAction,
    /// Whole sets in it.
    pub sets: u64,
    /// Its bytes before.
    pub bytes: u64,
    /// Bytes at its end, after the last whole record.
    pub tail_bytes: u64,
    /// Sets that were begun and not finished, or hit by damage.
    pub torn_sets: u64,
    /// Where something was lost.
    pub lost_bytes: Vec<LostBytes>,
    /// Ids between the whole sets around a damaged place, first and last.
    pub sets_missing: Vec<(u64, u64)>,
    /// Sets that are lost, at most: those ids, and what the accounts count beyond them.
    pub sets_lost: u64,
    /// Losses in words.
    pub lost: Vec<String>,
}

/// Report of a recovery.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct RecoverReport {
    /// The dataset.
    pub path: PathBuf,
    /// Whether it was a dry run.
    pub dry_run: bool,
    /// Whether anything was changed, or would be.
    pub changed: bool,
    /// Its segments.
    pub segments: Vec<RecoveredSegment>,
    /// Whether `session.toml` had to be rebuilt.
    pub session_rebuilt: bool,
    /// Leftovers that were removed.
    pub removed: Vec<String>,
    /// Whole sets in the dataset.
    pub sets: u64,
    /// Losses that this recovery found, in words; empty if there was nothing to do.
    pub lost: Vec<String>,
    /// Other observations.
    pub notes: Vec<String>,
}

/// Recovers the dataset in the folder `path`. Once it succeeded, doing it again changes nothing.
///
/// # Errors
/// [`ErrorKind::InUse`] when the dataset is being recorded, [`ErrorKind::NotADataset`] when nothing was ever
/// recorded there, [`ErrorKind::DiskFull`] when a segment's copy finds no room, [`ErrorKind::Interrupted`] when
/// `progress` breaks, else as the disk says. No error makes readable data unreadable.
pub fn recover(
    path: &Path,
    options: &RecoverOptions,
    progress: &mut dyn FnMut(RecoverProgress) -> ControlFlow<()>,
) -> Result<RecoverReport> {
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    recover_with(&fs, path, options, progress)
}

/// The same on another file system.
///
/// # Errors
/// As [`recover`].
pub fn recover_with(
    fs: &Arc<dyn Fs>,
    path: &Path,
    options: &RecoverOptions,
    progress: &mut dyn FnMut(RecoverProgress) -> ControlFlow<()>,
) -> Result<RecoverReport> {
    let entries = fs.read_dir(path).map_err(|e| Error::reading("open the folder", path, e))?;
    check_names(path, &entries)?;
    let mut notes = Vec::new();
    let lock = lock_with_retries(&**fs, path);
    match &lock {
        Ok(_) => {}
        Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => {
            let what = format!("{} is being recorded right now; stop the recording first", path.display());
            return Err(Error::new(ErrorKind::InUse, what));
        }
        Err(e) => {
            notes.push(format!("the folder cannot be locked ({e}): make sure that nobody records into it"));
        }
    }
    // Again, now that nobody else changes anything.
    let entries = fs.read_dir(path).map_err(|e| Error::reading("open the folder", path, e))?;
    let dry = options.dry_run.then(|| Arc::new(DryFs::new(Arc::clone(fs))));
    let unchanged = dry.clone().map(|dry| dry as Arc<dyn Fs>);
    let fs = unchanged.as_ref().unwrap_or(fs);
    let mut job = Job {
        fs,
        dry,
        dir: path,
        options: *options,
        progress,
        done: 0,
        total: entries.iter().filter(|e| segment_number(&e.name).is_some()).map(|e| e.len).sum(),
        report: RecoverReport {
            path: path.to_owned(),
            dry_run: options.dry_run,
            changed: false,
            segments: Vec::new(),
            session_rebuilt: false,
            removed: Vec::new(),
            sets: 0,
            lost: Vec::new(),
            notes,
        },
    };
    let done = job.run(&entries);
    let mut report = job.report;
    if report.dry_run && report.changed {
        report.notes.push(UNKNOWN_IN_DRY_RUN.to_owned());
    }
    drop(lock);
    done.map(|()| report)
}

/// The datasets in `folder` that `rig` left unfinished and that nobody records now, sorted.
///
/// # Errors
/// As reading the folder does; a folder that is not there holds none.
pub fn unfinished_in(fs: &Arc<dyn Fs>, folder: &Path, rig: &str) -> Result<Vec<PathBuf>> {
    let entries = match fs.read_dir(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        entries => entries.map_err(|e| Error::reading("open the folder", folder, e))?,
    };
    let mut found = Vec::new();
    // `NAME.part` is an unfinished output of `trim` or `merge`, not a recording.
    for entry in entries.iter().filter(|e| e.is_dir && !is_part(Path::new(&e.name))) {
        let dir = folder.join(&entry.name);
        let Ok(inside) = fs.read_dir(&dir) else { continue };
        let part = inside
            .iter()
            .any(|e| segment_number(&e.name).is_some() && e.name.strip_suffix(".part").is_some());
        let session = match Session::load(&**fs, &dir) {
            Ok(session) if session.outcome.is_some() && !part => continue,
            Ok(session) => session,
            Err(_) => {
                let segments = segments_in(&inside, &dir).into_iter();
                let mut readable =
                    segments.filter_map(|s| crate::Dataset::open_with(Arc::clone(fs), &s).ok());
                let Some(dataset) = readable.next() else { continue };
                dataset.session().clone()
            }
        };
        let locked = fs.lock(&dir).err().is_some_and(|e| e.kind() == std::io::ErrorKind::WouldBlock);
        if session.rig == rig && !locked {
            found.push(dir);
        }
    }
    Ok(found)
}

/// Refuses folders that are not datasets, and ones that have a segment twice.
fn check_names(path: &Path, entries: &[DirEntry]) -> Result<()> {
    let mut numbers: Vec<_> =
        entries.iter().filter(|e| !e.is_dir).filter_map(|e| segment_number(&e.name)).collect();
    numbers.sort_unstable();
    if let Some(pair) = numbers.windows(2).find(|w| w[0] == w[1]) {
        let name = file_name(pair[0]);
        return Err(Error::new(
            ErrorKind::Corrupt,
            format!(
                "{} holds both {name} and {name}.part, which depthrig never leaves; move one of them away",
                path.display()
            ),
        ));
    }
    if numbers.is_empty() && !entries.iter().any(|e| e.name == SESSION_FILE) {
        return Err(Error::new(
            ErrorKind::NotADataset,
            format!("{} is not a dataset: it holds neither {SESSION_FILE} nor a segment", path.display()),
        ));
    }
    Ok(())
}

/// Whether a segment has the name of an unfinished one.
fn is_part(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "part")
}

/// A running recovery.
struct Job<'a> {
    fs: &'a Arc<dyn Fs>,
    /// The same, when nothing is to be changed.
    dry: Option<Arc<DryFs>>,
    dir: &'a Path,
    options: RecoverOptions,
    progress: &'a mut dyn FnMut(RecoverProgress) -> ControlFlow<()>,
    done: u64,
    total: u64,
    report: RecoverReport,
}

impl Job<'_> {
    fn run(&mut self, entries: &[DirEntry]) -> Result<()> {
        self.remove_leftovers(entries)?;
        let chosen = session::choose(self, &segments_in(entries, self.dir))?;
        let segments = self.fill_gaps(entries)?;
        let mut judge = Judge::new(&chosen.session);
        let mut all: Vec<Facts> = Vec::new();
        let mut before = Before::of(&segments);
        for path in &segments {
            let facts = self.segment(path, &segments, &chosen, before, &mut judge)?;
            self.report.sets += facts.sets;
            before.add(&facts);
            all.push(facts);
        }
        self.report_progress(self.total)?;
        let broken = broken_session(&chosen.session);
        session::settle(self, chosen.session, &all)?;
        match broken.first() {
            Some(finding) if self.options.unfinished_only => self.report.notes.push(finding.message.clone()),
            Some(finding) => {
                let file = self.dir.join(SESSION_FILE);
                let what = format!(
                    "the segments are complete, but {} is not what it should be: {}; correct that line and recover \
                     again",
                    file.display(),
                    finding.message
                );
                return Err(Error::new(ErrorKind::Corrupt, what));
            }
            None => {}
        }
        Ok(())
    }

    /// The segments, with an empty one in the place of each missing one, so that its loss is stated like any other.
    fn fill_gaps(&mut self, entries: &[DirEntry]) -> Result<Vec<PathBuf>> {
        let segments = segments_in(entries, self.dir);
        let there: BTreeSet<u32> = entries.iter().filter_map(|e| segment_number(&e.name)).collect();
        let gone = there.last().map_or(0, |last| *last as usize + 1 - there.len());
        if gone == 0 || self.options.unfinished_only {
            return Ok(segments);
        }
        if gone > GONE_MAX {
            let what = format!(
                "{} cannot be recovered: {gone} of its segments are gone; put them back, or recover the segments on \
                 their own in a folder each",
                self.dir.display()
            );
            return Err(Error::new(ErrorKind::Corrupt, what));
        }
        let last = there.last().copied().unwrap_or(0);
        let names = (0..last).filter(|n| !there.contains(n)).map(file_name);
        for path in names.map(|name| self.dir.join(name)) {
            self.report.changed = true;
            self.fs.create_new(&path).map_err(|e| Error::io("create", &path, e))?;
            sync_folder_of(&**self.fs, &path)?;
        }
        let entries =
            self.fs.read_dir(self.dir).map_err(|e| Error::reading("open the folder", self.dir, e))?;
        Ok(segments_in(&entries, self.dir))
    }

    /// Reports the bytes done so far; an error if the caller ends the work.
    fn report_progress(&mut self, done: u64) -> Result<()> {
        let progress = RecoverProgress { done_bytes: done.min(self.total), total_bytes: self.total };
        match (self.progress)(progress) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Error::new(
                ErrorKind::Interrupted,
                format!("the recovery of {} was interrupted; begin it again", self.dir.display()),
            )),
        }
    }

    fn remove_leftovers(&mut self, entries: &[DirEntry]) -> Result<()> {
        for e in entries.iter().filter(|e| !e.is_dir) {
            let ours = e.name == RESERVE_FILE
                || e.name == SESSION_TMP
                || ["recovering", crate::recalibrate::TEMPORARY].iter().any(|end| {
                    let name = e.name.strip_suffix(end);
                    name.is_some_and(|n| segment_number(n.trim_end_matches('.')).is_some())
                });
            if !ours {
                continue;
            }
            let path = self.dir.join(&e.name);
            self.fs.remove_file(&path).map_err(|e| Error::io("remove", &path, e))?;
            self.report.changed = true;
            self.report.removed.push(e.name.clone());
        }
        Ok(())
    }

    /// Repairs one segment; returns the facts of the result.
    fn segment(
        &mut self,
        path: &Path,
        segments: &[PathBuf],
        chosen: &Chosen,
        before: Before,
        judge: &mut Judge,
    ) -> Result<Facts> {
        let fs = Arc::clone(self.fs);
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let part = is_part(path);
        let base = self.done;
        let mut segment = RecoveredSegment {
            file: name,
            action: RecoverAction::None,
            sets: 0,
            bytes: 0,
            tail_bytes: 0,
            torn_sets: 0,
            lost_bytes: Vec::new(),
            sets_missing: Vec::new(),
            sets_lost: 0,
            lost: Vec::new(),
        };
        let mut whole = facts::indexed(&*fs, path)?;
        let mut after = None;
        if self.options.unfinished_only && !part && whole.is_some() {
            // The ones after it are judged on their own, as this one was not read.
            *judge = Judge::lone(&chosen.session);
        } else if whole.is_some() {
            let verdict = judge.look(&*fs, path, &mut |bytes| self.report_progress(base + bytes))?;
            whole = whole.filter(|_| verdict.broken.is_empty());
            after = Some(verdict.after);
        }
        // A segment that an error kept from its final name may be complete in memory and not on the disk, and a later
        // sync that succeeds does not prove otherwise: it is copied.
        let doubtful = |f: &Facts| f.error.is_some() || !chosen.stored || chosen.session.outcome.is_some();
        let whole = match whole {
            Some(whole) if !part => Some(whole),
            Some(whole) if !doubtful(&whole) && self.finish(path)? => Some(whole),
            _ => None,
        };
        let facts = if let Some(whole) = whole {
            segment.action = if part { RecoverAction::Finished } else { RecoverAction::None };
            segment.bytes = whole.bytes;
            if let Some(after) = after {
                *judge = after;
            }
            whole
        } else {
            let dry = self.dry.clone();
            let job = Rebuild {
                fs: &*fs,
                dry: dry.as_deref(),
                dir: self.dir,
                path,
                segments,
                session: &chosen.session,
                before,
            };
            let Rebuilt { facts, lost, .. } = self.rebuild(&job, base, judge)?;
            segment.action = RecoverAction::Rebuilt;
            lost.fill_in(&mut segment);
            self.replace(path)?;
            facts
        };
        segment.sets = facts.sets;
        self.done += segment.bytes;
        self.report.changed |= segment.action != RecoverAction::None;
        self.report.lost.extend(segment.lost.iter().cloned());
        self.report.segments.push(segment);
        Ok(facts)
    }

    /// Copies a segment under its temporary name until `verify` finds no damage in the copy; each copy leaves out the
    /// findings of the one before. Chunks may have good checksums and yet contradict each other.
    fn rebuild(&mut self, job: &Rebuild<'_>, base: u64, judge: &mut Judge) -> Result<Rebuilt> {
        let fs = Arc::clone(self.fs);
        let mut choice = Choice::default();
        let mut tries = 0;
        loop {
            let rebuilt = job.run(&choice, &mut |bytes| self.report_progress(base + bytes))?;
            let copy = segment::temporary(job.path);
            let verdict = judge.look(&*fs, &copy, &mut |_| self.report_progress(base))?;
            let Some(first) = verdict.broken.first() else {
                *judge = verdict.after;
                return Ok(rebuilt);
            };
            tries += 1;
            if tries > TRIES || !choice.leave_out(&rebuilt, &verdict.broken) {
                // The next recovery removes it if this cannot.
                let _ = fs.remove_file(&copy);
                let what = format!(
                    "{} cannot be recovered: what can be read of it contradicts itself ({}); it was left as it is",
                    job.path.display(),
                    first.message
                );
                return Err(Error::new(ErrorKind::Corrupt, what));
            }
            fs.remove_file(&copy).map_err(|e| Error::io("remove", &copy, e))?;
        }
    }

    /// Gives a complete `.part` its final name; `false` when this file system cannot make it durable as it is.
    fn finish(&self, part: &Path) -> Result<bool> {
        match self.fs.sync_file(part) {
            Ok(()) => {}
            Err(e) if e.kind() == std::io::ErrorKind::Unsupported => return Ok(false),
            Err(e) => return Err(Error::io("sync", part, e)),
        }
        self.rename(part, &part.with_extension(""))?;
        Ok(true)
    }

    /// Puts the verified copy in the place of `path`, and gives that its final name. Each step is durable before
    /// the next one, and after each the dataset holds every set exactly once.
    fn replace(&self, path: &Path) -> Result<()> {
        self.rename(&segment::temporary(path), path)?;
        if is_part(path) {
            self.rename(path, &path.with_extension(""))?;
        }
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> Result<()> {
        self.fs.rename(from, to).map_err(|e| Error::io("rename", from, e))?;
        sync_folder_of(&**self.fs, to)
    }
}
