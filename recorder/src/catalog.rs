//! The datasets of a folder at a glance: who, what, when, how much, and whether each is well.
//!
//! Nothing but `session.toml` and the last kilobyte of each segment is read, so that a thousand datasets take a
//! moment. What this says of a dataset is therefore what it says of itself; only [`crate::verify()`] proves it.

use crate::dataset::{segment_number, segments_in};
use crate::fs::Fs;
use crate::{Error, ErrorKind, Mark, Outcome, Result, SESSION_FILE, Session};
use serde::Serialize;
use std::path::{Path, PathBuf};

mod footer;

/// How a dataset is, by its own account.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Health {
    /// Closed, and every set is there.
    Whole,
    /// It is being recorded now.
    Recording,
    /// Closed, but it says itself that something was not recorded.
    Lost,
    /// It was never closed: `depthrig recover` finishes it.
    Unfinished,
    /// It is not what it says it is, or cannot be read.
    Damaged,
}

impl Health {
    /// The name used in tables and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Whole => "whole",
            Self::Recording => "recording",
            Self::Lost => "lost",
            Self::Unfinished => "unfinished",
            Self::Damaged => "damaged",
        }
    }

    /// Whether somebody should look at it.
    pub const fn is_bad(self) -> bool {
        !matches!(self, Self::Whole | Self::Recording)
    }
}

/// One dataset of a folder.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct CatalogEntry {
    /// Its folder.
    pub path: PathBuf,
    /// The session's name; the folder's when the session cannot be read.
    pub name: String,
    /// The scene in front of the cameras.
    pub scene: String,
    /// Who recorded it.
    pub operator: String,
    /// A person's judgement.
    pub mark: Option<Mark>,
    /// The rig's name.
    pub rig: String,
    /// When it began, UTC nanoseconds since 1970; `None` when nothing says so.
    pub started_utc_ns: Option<i64>,
    /// From its first set to its last as far as finished segments say, nanoseconds.
    pub duration_ns: i64,
    /// Sets in finished segments.
    pub sets: u64,
    /// Sets that were not recorded, as its session says.
    pub sets_lost: u64,
    /// Recorded streams.
    pub streams: usize,
    /// Segments.
    pub segments: usize,
    /// Bytes of its segments.
    pub bytes: u64,
    /// How it is.
    pub health: Health,
    /// Why it is not complete: losses, and what to do.
    pub why: Vec<String>,
}

/// The datasets in `dir`, and in those of its folders that are not datasets themselves; `dir` may be a dataset too.
/// Sorted by path. A dataset that cannot be read is in the list and says why.
///
/// # Errors
/// When `dir` cannot be read.
pub fn catalog(fs: &dyn Fs, dir: &Path) -> Result<Vec<CatalogEntry>> {
    if is_dataset(fs, dir).map_err(|e| Error::reading("list", dir, e))? {
        return Ok(vec![look_at(fs, dir)]);
    }
    let mut found = Vec::new();
    for child in folders(fs, dir).map_err(|e| Error::reading("list", dir, e))? {
        if is_dataset(fs, &child).unwrap_or(false) {
            found.push(look_at(fs, &child));
            continue;
        }
        // A folder that may not be looked into holds no dataset of this user.
        let inner = folders(fs, &child).unwrap_or_default();
        let datasets = inner.iter().filter(|f| is_dataset(fs, f).unwrap_or(false));
        found.extend(datasets.map(|f| look_at(fs, f)));
    }
    Ok(found)
}

/// The folders in `dir`, hidden ones left out.
fn folders(fs: &dyn Fs, dir: &Path) -> std::io::Result<Vec<PathBuf>> {
    let entries = fs.read_dir(dir)?;
    Ok(entries.iter().filter(|e| e.is_dir && !e.name.starts_with('.')).map(|e| dir.join(&e.name)).collect())
}

fn is_dataset(fs: &dyn Fs, dir: &Path) -> std::io::Result<bool> {
    let entries = fs.read_dir(dir)?;
    Ok(entries.iter().any(|e| !e.is_dir && (e.name == SESSION_FILE || segment_number(&e.name).is_some())))
}

/// Reads the catalog entry of the dataset `dir`. Errors are part of the entry.
pub fn look_at(fs: &dyn Fs, dir: &Path) -> CatalogEntry {
    let folder =
        dir.file_name().map_or_else(|| dir.display().to_string(), |n| n.to_string_lossy().into_owned());
    let mut entry = CatalogEntry {
        path: dir.to_owned(),
        name: folder,
        scene: String::new(),
        operator: String::new(),
        mark: None,
        rig: String::new(),
        started_utc_ns: None,
        duration_ns: 0,
        sets: 0,
        sets_lost: 0,
        streams: 0,
        segments: 0,
        bytes: 0,
        health: Health::Whole,
        why: Vec::new(),
    };
    let segments = match fs.read_dir(dir) {
        Ok(entries) => {
            let named = entries.iter().filter(|e| !e.is_dir && segment_number(&e.name).is_some());
            entry.bytes = named.map(|e| e.len).sum();
            segments_in(&entries, dir)
        }
        Err(e) => {
            entry.is(Health::Damaged, Error::reading("list", dir, e).to_string());
            return entry;
        }
    };
    entry.segments = segments.len();
    look_at_segments(fs, dir, &segments, &mut entry);
    let session = match Session::load(fs, dir) {
        Ok(session) => session,
        Err(e) if e.kind() == ErrorKind::NotFound => {
            entry.is(Health::Damaged, format!("{SESSION_FILE} is missing; the segments hold a copy of it"));
            return entry;
        }
        Err(e) => {
            entry.is(Health::Damaged, e.to_string());
            return entry;
        }
    };
    entry.name.clone_from(&session.name);
    entry.scene.clone_from(&session.scene);
    entry.operator.clone_from(&session.operator);
    entry.mark = session.mark;
    entry.rig.clone_from(&session.rig);
    entry.started_utc_ns = Some(session.started_utc_ns);
    entry.streams = session.streams.len();
    match &session.outcome {
        None if entry.health < Health::Unfinished && entry.health != Health::Recording => {
            entry.is(Health::Unfinished, recover(dir, "the recording was not closed"));
        }
        None => {}
        Some(o) => {
            entry.sets_lost = o.sets_dropped.values().fold(0, |sum: u64, n| sum.saturating_add(*n));
            if entry.health == Health::Whole && o.sets_recorded != entry.sets {
                let what =
                    format!("{SESSION_FILE} says {} sets, the segments hold {}", o.sets_recorded, entry.sets);
                entry.is(Health::Damaged, what);
            }
            if !o.complete {
                for words in losses(entry.sets_lost, o) {
                    entry.is(Health::Lost, words);
                }
            }
            for words in session.import_losses() {
                entry.is(Health::Lost, words);
            }
        }
    }
    entry
}

/// Losses of an incomplete recording in its own words, or else how many sets were counted.
fn losses(sets: u64, outcome: &Outcome) -> Vec<String> {
    if !outcome.lost.is_empty() {
        return outcome.lost.clone();
    }
    vec![if sets > 0 {
        format!("{sets} sets were not recorded")
    } else {
        "the recording is not complete and does not say why".to_owned()
    }]
}

/// Sets, times and state of the segments.
fn look_at_segments(fs: &dyn Fs, dir: &Path, segments: &[PathBuf], entry: &mut CatalogEntry) {
    let mut times: Option<(i64, i64)> = None;
    for (i, path) in segments.iter().enumerate() {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if segment_number(&name) != Some(i as u32) {
            let expected = crate::container::segment::file_name(i as u32);
            entry.is(Health::Damaged, format!("{expected} is missing, {name} is in its place"));
            break;
        }
        if name.ends_with(".part") {
            entry.is(Health::Unfinished, recover(dir, &format!("{name} was not finished")));
            continue;
        }
        match footer::read(fs, path) {
            Ok(facts) => {
                entry.sets += facts.sets;
                if let Some((from, to)) = facts.times {
                    times = Some(times.map_or((from, to), |(a, b)| (a.min(from), b.max(to))));
                }
            }
            Err(e) => entry.is(Health::Damaged, e.to_string()),
        }
    }
    if segments.is_empty() {
        entry.is(Health::Damaged, "there are no segments".to_owned());
    }
    entry.duration_ns = times.map_or(0, |(from, to)| to.saturating_sub(from));
}

fn recover(dir: &Path, what: &str) -> String {
    format!("{what}: run depthrig recover {}", dir.display())
}

impl CatalogEntry {
    /// Says why; the worst counts.
    fn is(&mut self, health: Health, why: String) {
        self.health = self.health.max(health);
        self.why.push(why);
    }
}
