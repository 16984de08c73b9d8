//! Makes one dataset of the parts of a recording that several computers made.
//!
//! The parts are replayed on channels of their own, without a frame left out, and that replay is recorded: the sets of one tick become one
//! set, images stay as they were stored, and times are those of the session's clock ([`crate::replay`]). The dataset grows in a hidden
//! folder and gets its name when it is verified and has every frame of the parts.

use crate::config::RecordingConfig;
use crate::control::RecordRequest;
use crate::hosts::JOINING;
use crate::recording;
use crate::replay::{Replay, ReplayOptions};
use crate::{Error, ErrorKind, Result};
use core::ops::ControlFlow;
use core::time::Duration;
use depthrig_bus::{RuntimeDir, shm, umask};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Dataset, Severity, VerifyOptions, adopt, verify_watched};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The folder beside the recordings in which a joined dataset grows.
const FOLDER: &str = ".joining";
/// From one look whether to stop to the next.
const LOOK: Duration = Duration::from_millis(100);

/// Joins `parts`, that of the computer whose clock is the session's first, into the new dataset `out`; the number of its sets. Its name, scene,
/// notes and episodes are those of the first part. The parts stay as they are, and `reserve_bytes` stay free on the disk.
///
/// # Errors
/// `InUse` when `out` exists or another session is being joined, `BadInput` when the parts do not belong together or one has no clock of the session,
/// `NoSpace`, and `Other` when it was stopped, or when the result is not what it should be; `out` does not exist then.
pub fn join(
    parts: &[PathBuf],
    out: &Path,
    runtime: &RuntimeDir,
    reserve_bytes: u64,
    stop: &AtomicBool,
) -> Result<u64> {
    if out.symlink_metadata().is_ok() {
        let what = format!("{} exists; a joined dataset is a new one", out.display());
        return Err(Error::new(ErrorKind::InUse, what));
    }
    let (Some(first), Some(name)) = (parts.first(), out.file_name().and_then(|n| n.to_str())) else {
        return Err(Error::new(
            ErrorKind::BadInput,
            "name the datasets to join, and a new folder for the result",
        ));
    };
    // A computer that was killed in its first moment has a part without a set.
    let parts: Vec<_> = parts.iter().filter(|part| has_sets(part)).cloned().collect();
    if parts.is_empty() {
        return Err(Error::new(ErrorKind::BadInput, "none of the parts has a set"));
    }
    let parts = parts.as_slice();
    let channels = RuntimeDir::at(&runtime.path().join(JOINING))?;
    let hidden = out.with_file_name(FOLDER);
    umask::create_dir_all(&hidden).map_err(|e| failed(&hidden, e))?;
    let joined = must_fit(parts, &hidden, reserve_bytes)
        .and_then(|()| grow(first, parts, &hidden.join(name), &channels, reserve_bytes, stop))
        .and_then(|sets| {
            fs::rename(hidden.join(name), out).map_err(|e| failed(out, e))?;
            Ok(sets)
        });
    // Another session's result may be in it.
    let _ = fs::remove_dir(&hidden);
    joined
}

/// Makes and checks the dataset `growing` of `parts` with the name, scene, notes and episodes of `first`; the number of its sets. After an error nothing
/// is left of it.
fn grow(
    first: &Path,
    parts: &[PathBuf],
    growing: &Path,
    channels: &RuntimeDir,
    reserve_bytes: u64,
    stop: &AtomicBool,
) -> Result<u64> {
    let options = ReplayOptions {
        as_fast_as_possible: true,
        in_background: true,
        by_utc: false,
        paused: true,
        ..ReplayOptions::default()
    };
    // It takes the lock of the channels: what lies in the hidden folder is nobody's.
    let replay = Replay::start(parts, channels, None, options)?;
    let checked = remove(growing)
        .map_err(|e| failed(growing, e))
        .and_then(|()| record(replay, growing, reserve_bytes, stop))
        .and_then(|()| {
            adopt(&RealFs, growing, Dataset::open(first)?.session())?;
            check(parts, growing, stop)
        });
    if checked.is_err()
        && let Err(e) = remove(growing)
    {
        tracing::warn!("{} is left: {e}", growing.display());
    }
    checked
}

fn failed(path: &Path, e: std::io::Error) -> Error {
    Error::new(ErrorKind::Other, format!("{}: {e}", path.display())).with_source(e)
}

/// Whether a part has anything to join; one that cannot be read has, and its error is that of the join.
fn has_sets(part: &Path) -> bool {
    let info = Dataset::open(part).and_then(|dataset| dataset.info());
    info.map_or(true, |info| info.sets > 0)
}

/// The result is about as large as its parts; recordings must find room after it.
fn must_fit(parts: &[PathBuf], folder: &Path, reserve_bytes: u64) -> Result<()> {
    // The recorder of a replay leaves the default.
    let mut needed = reserve_bytes.max(recording::reserve_bytes(&RecordingConfig::default()));
    for part in parts {
        needed = needed.saturating_add(Dataset::open(part)?.info()?.bytes);
    }
    let free = shm::free_bytes(folder)?;
    if free >= needed {
        return Ok(());
    }
    Err(no_space(folder, free, needed))
}

fn no_space(folder: &Path, free: u64, needed: u64) -> Error {
    let what = format!(
        "{} has {} MB free, and {} MB are needed to join the parts and to record after that; make room, then call depthrig merge --hosts",
        folder.display(),
        free / 1_000_000,
        needed / 1_000_000
    );
    Error::new(ErrorKind::NoSpace, what)
}

fn remove(folder: &Path) -> std::io::Result<()> {
    match fs::remove_dir_all(folder) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e),
        _ => Ok(()),
    }
}

/// Records the replay to its end.
fn record(replay: Replay, growing: &Path, reserve_bytes: u64, stop: &AtomicBool) -> Result<()> {
    let control = replay.control();
    let directory = growing.parent().unwrap_or(growing);
    // Its size was held against the disk; how fast a replay writes says nothing about how long the disk lasts.
    let request = RecordRequest {
        directory: Some(directory.to_owned()),
        name: growing.file_name().map(|name| name.to_string_lossy().into_owned()),
        force: true,
        ..RecordRequest::default()
    };
    control.record_start(&request)?;
    if let Some(replay) = control.replay() {
        replay.resume()?;
    }
    while !replay.wait(LOOK) {
        if stop.load(Ordering::Relaxed) {
            return Err(stopped());
        }
        // A recording that began meanwhile comes first.
        let free = shm::free_bytes(directory)?;
        if free < reserve_bytes {
            return Err(no_space(directory, free, reserve_bytes));
        }
    }
    let summary = replay.stop();
    let recording = summary.recording.unwrap_or_default();
    let dropped = recording.dropped.iter().map(|(reason, n)| format!("{n} sets: {reason}"));
    let lost: Vec<_> = summary.status.lost.into_iter().chain(recording.error).chain(dropped).collect();
    if lost.is_empty() {
        return Ok(());
    }
    Err(Error::new(ErrorKind::Other, format!("not all of the parts arrived: {}", lost.join("; "))))
}

fn stopped() -> Error {
    Error::new(ErrorKind::Other, "stopped before it was done; the parts are as they were")
}

/// The result is sound, and has every frame of each part.
fn check(parts: &[PathBuf], joined: &Path, stop: &AtomicBool) -> Result<u64> {
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let report = verify_watched(&fs, joined, &VerifyOptions::default(), &mut |_| {
        if stop.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    if report.stopped {
        return Err(stopped());
    }
    if let Some(bad) = report.findings.iter().find(|f| f.severity == Severity::Broken) {
        let what = format!("the joined dataset is not sound, which is an error of depthrig: {}", bad.message);
        return Err(Error::new(ErrorKind::Other, what));
    }
    let mut expected = BTreeMap::new();
    for part in parts {
        for stream in Dataset::open(part)?.info()?.streams {
            *expected.entry(stream.stream).or_insert(0) += stream.frames;
        }
    }
    let streams = Dataset::open(joined)?.info()?.streams;
    let found: BTreeMap<_, _> = streams.into_iter().map(|s| (s.stream, s.frames)).collect();
    if let Some((stream, n)) = expected.iter().find(|(stream, n)| found.get(*stream) != Some(n)) {
        let has = found.get(stream).copied().unwrap_or_default();
        let what =
            format!("the joined dataset has {has} of {n} frames of {stream}, which is an error of depthrig");
        return Err(Error::new(ErrorKind::Other, what));
    }
    Ok(report.sets)
}
