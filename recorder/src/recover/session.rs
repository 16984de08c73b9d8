//! Updates `session.toml` after a recovery.

use super::facts::Facts;
use super::head::{own_head, proven_head, session_in};
use super::{Job, RecoverAction};
use crate::container::scan::SegmentReader;
use crate::verify::broken_session;
use crate::{Dataset, Error, ErrorKind, Outcome, Result, SESSION_FILE, Session, SetCounts};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The drop reason of sets that were handed over and are in no segment.
const IN_CRASH: &str = "lost_in_crash";

/// The session that a recovery uses.
pub(super) struct Chosen {
    pub(super) session: Session,
    /// Whether it is that of `session.toml`.
    pub(super) stored: bool,
}

/// The session: that of `session.toml`, or of a segment where that one is gone, damaged or not of these segments.
pub(super) fn choose(job: &mut Job<'_>, segments: &[PathBuf]) -> Result<Chosen> {
    let mut stored = match Session::load(&**job.fs, job.dir) {
        Ok(session) => session,
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::Corrupt | ErrorKind::Truncated) => {
            job.report.notes.push(e.to_string());
            return from_segments(job, segments);
        }
        Err(e) => return Err(e),
    };
    if job.options.unfinished_only {
        return Ok(Chosen { session: stored, stored: true });
    }
    for path in segments {
        let reader = SegmentReader::open_any(&**job.fs, path)?;
        let Some(head) = proven_head(&reader)? else { continue };
        let Some(said) = session_in(&head.preamble, &reader) else { continue };
        let better = broken_session(&said).is_empty() && !broken_session(&stored).is_empty();
        // One that another calibration was attached to is completed by attaching it again.
        let is_other_calibration = stored.calibration == said.calibration && !stored.is_calibrated_as(&said);
        if !better && stored.has_streams_of(&said) && !is_other_calibration {
            break;
        }
        let words = format!(
            "{SESSION_FILE} named another rig, other streams or another calibration than its segments and was mended from {}",
            file_name(path)
        );
        stored.rig = said.rig;
        stored.streams = said.streams;
        stored.motion = said.motion;
        stored.signals = said.signals;
        stored.computed = said.computed;
        job.report.session_rebuilt = true;
        job.report.lost.push(words);
        break;
    }
    Ok(Chosen { session: stored, stored: true })
}

/// The name of a segment without what says that it is unfinished.
fn file_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.strip_suffix(".part").unwrap_or(&name).to_owned()
}

/// Writes `session.toml` if it changed, or lacks the outcome of the recording.
pub(super) fn settle(job: &mut Job<'_>, mut session: Session, all: &[Facts]) -> Result<()> {
    let changed = job.report.segments.iter().any(|s| s.action != RecoverAction::None);
    let mut lost: Vec<String> = all.iter().flat_map(|f| f.lost.iter().cloned()).collect();
    if job.report.session_rebuilt {
        // The losses so far are of the session; those of segments follow.
        lost.extend(job.report.lost.first().cloned());
    }
    let as_it_was = !changed && !job.report.session_rebuilt;
    let recorded: u64 = all.iter().map(|f| f.sets).sum();
    let says = |o: &Outcome| o.sets_recorded == recorded && lost.iter().all(|l| o.lost.contains(l));
    if as_it_was && session.outcome.as_ref().is_some_and(says) {
        return Ok(());
    }
    let outcome = outcome(&session, all, lost, job);
    if session.outcome.as_ref() == Some(&outcome) {
        return Ok(());
    }
    if let Some(before) = session.outcome.as_ref().filter(|_| as_it_was) {
        // A recovery before this one copied the segment and was ended before it could say so here.
        let unsaid = |l: &&String| !before.lost.contains(l);
        let new: Vec<_> = outcome.lost.iter().filter(unsaid).cloned().collect();
        for words in new {
            if !job.report.lost.contains(&words) {
                job.report.lost.push(words);
            }
        }
    }
    session.outcome = Some(outcome);
    job.report.changed = true;
    session.save(&**job.fs, job.dir)
}

/// The session as the last segment has it that can be read: it has the most notes.
fn from_segments(job: &mut Job<'_>, segments: &[PathBuf]) -> Result<Chosen> {
    for path in segments.iter().rev() {
        let reader = SegmentReader::open_any(&**job.fs, path)?;
        let session = match Dataset::open_with(Arc::clone(job.fs), path) {
            Ok(dataset) => Some(dataset.session().clone()),
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Err(_) => own_head(&reader)?.and_then(|head| session_in(&head.preamble, &reader)),
        };
        let Some(session) = session else { continue };
        let words = format!(
            "{SESSION_FILE} was gone or damaged and was rebuilt from {}; notes and changes after its beginning are \
             not in it",
            file_name(path)
        );
        job.report.session_rebuilt = true;
        job.report.lost.push(words);
        return Ok(Chosen { session, stored: false });
    }
    Err(Error::new(
        ErrorKind::NotADataset,
        format!(
            "nothing says what {} holds: {SESSION_FILE} is gone or damaged, and so are the heads of its segments",
            job.dir.display()
        ),
    ))
}

fn outcome(session: &Session, all: &[Facts], mut lost: Vec<String>, job: &mut Job<'_>) -> Outcome {
    let last = all.last();
    let recorded: u64 = all.iter().map(|f| f.sets).sum();
    let counts = all.iter().rev().find_map(|f| f.counts).unwrap_or_default();
    let ended = all.iter().rev().find_map(|f| f.last_log_time).map_or(session.started_utc_ns, |t| t as i64);
    let marked = all.iter().rev().find(|f| f.sets > 0).map_or(0, |f| f.offered);
    let before = session.outcome.as_ref();
    let offered = marked.max(counts.offered).max(before.map_or(0, |o| o.sets_offered)).max(recorded);
    let mut dropped: std::collections::BTreeMap<String, u64> = match before {
        Some(o) => o.sets_dropped.clone(),
        None => counts.dropped_by_reason().map(|(r, n)| (r.name().to_owned(), n)).collect(),
    };
    dropped.remove(IN_CRASH);
    // The counts of a damaged file may not add up. And where disk or encoders were behind, the last account has sets
    // that were refused after those that waited, which the marks then count without them.
    let known = dropped.values().fold(recorded, |sum, n| sum.saturating_add(*n));
    let offered = offered.max(known);
    let missing = offered.saturating_sub(known);
    let unaccounted = unaccounted(before, recorded, all);
    let mut say = |what: String, new: bool| {
        if new {
            job.report.lost.push(what.clone());
        }
        if !lost.contains(&what) {
            lost.push(what);
        }
    };
    if before.is_none() {
        match last {
            Some(Facts { error: Some(e), .. }) => say(format!("the recording ended before its time: {e}"), true),
            Some(Facts { last: true, .. }) => {}
            _ => say(
                "the recording was cut off: the sets that were still in memory then are lost, about a second's at \
                 most unless the disk or the encoders were behind"
                    .to_owned(),
                true,
            ),
        }
    }
    for (reason, n) in &dropped {
        say(format!("{n} of {offered} sets were not recorded: {reason}"), false);
    }
    if let Some(words) = unaccounted {
        say(words, true);
    }
    if missing > 0 {
        dropped.insert(IN_CRASH.to_owned(), missing);
        say(format!("{missing} of {offered} sets were handed over and are in no segment"), before.is_none());
    }
    if let Some(before) = before {
        for words in &before.lost {
            say(words.clone(), false);
        }
    }
    let mut outcome = Outcome::new(ended, &SetCounts::default(), lost);
    outcome.sets_offered = offered;
    outcome.sets_recorded = recorded;
    outcome.sets_dropped = dropped;
    outcome
}

/// Sets that `session.toml` counts and no segment accounts for, such as those of a missing one; in words.
fn unaccounted(before: Option<&Outcome>, recorded: u64, all: &[Facts]) -> Option<String> {
    let counted = before?.sets_recorded;
    let gone = counted.saturating_sub(recorded);
    let accounted = all.iter().fold(0u64, |sum, f| sum.saturating_add(f.sets_lost));
    let words = format!("{gone} of the {counted} sets that {SESSION_FILE} counts are in no segment");
    (gone > accounted).then_some(words)
}
