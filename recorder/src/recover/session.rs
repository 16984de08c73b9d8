//! What `session.toml` says after a recovery.

use super::facts::Facts;
use super::{Job, RecoverAction};
use crate::{Dataset, Error, ErrorKind, Outcome, Result, SESSION_FILE, Session, SetCounts};
use std::path::PathBuf;
use std::sync::Arc;

/// The reason under which sets are counted that were handed over and are in no segment.
const IN_CRASH: &str = "lost_in_crash";

/// Whether `session.toml` is gone or torn, as opposed to unreadable for now.
pub(super) fn is_damage(e: &Error) -> bool {
    matches!(e.kind(), ErrorKind::NotFound | ErrorKind::Corrupt | ErrorKind::Truncated)
}

/// Makes `session.toml` anew if it is gone, and writes how the recording ended if it does not say so.
pub(super) fn settle(
    job: &mut Job<'_>,
    session: Option<Session>,
    segments: &[PathBuf],
    all: &[Facts],
) -> Result<()> {
    let changed = job.report.segments.iter().any(|s| s.action != RecoverAction::None);
    let mut lost: Vec<String> = all.iter().flat_map(|f| f.lost.iter().cloned()).collect();
    let mut session = if let Some(session) = session {
        session
    } else {
        let (session, words) = from_segments(job, segments)?;
        job.report.session_rebuilt = true;
        job.report.lost.push(words.clone());
        lost.push(words);
        session
    };
    let as_it_was = !changed && !job.report.session_rebuilt;
    let says = |o: &Outcome| lost.iter().all(|l| o.lost.contains(l));
    if as_it_was && session.outcome.as_ref().is_some_and(says) {
        return Ok(());
    }
    let outcome = outcome(&session, all, lost, job);
    if session.outcome.as_ref() == Some(&outcome) {
        return Ok(());
    }
    if let Some(before) = session.outcome.as_ref().filter(|_| as_it_was) {
        // A recovery before this one copied the segment and was ended before it could say so here.
        job.report.lost.extend(outcome.lost.iter().filter(|l| !before.lost.contains(l)).cloned());
    }
    session.outcome = Some(outcome);
    job.report.changed = true;
    if job.options.dry_run {
        return Ok(());
    }
    session.save(&**job.fs, job.dir)
}

/// The session as the last segment tells it that can: it has the most notes.
fn from_segments(job: &Job<'_>, segments: &[PathBuf]) -> Result<(Session, String)> {
    for path in segments.iter().rev() {
        // It may have its final name by now.
        for path in [path.clone(), path.with_extension("")] {
            match Dataset::open_with(Arc::clone(job.fs), &path) {
                Ok(dataset) => {
                    let from = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                    let words = format!(
                        "{SESSION_FILE} was gone or damaged and was made anew from {from}; notes and changes after \
                         its beginning are not in it"
                    );
                    return Ok((dataset.session().clone(), words));
                }
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(_) => {}
            }
        }
    }
    Err(Error::new(
        ErrorKind::NotADataset,
        format!("{}: {SESSION_FILE} is damaged, and no segment holds a copy of it", job.dir.display()),
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
    // What a damaged file says may not fit. And where disk or encoders were behind, the last account has sets that were
    // refused after those that waited, which the marks then count without them.
    let known = dropped.values().fold(recorded, |sum, n| sum.saturating_add(*n));
    let offered = offered.max(known);
    let missing = offered.saturating_sub(known);
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
    (outcome.sets_offered, outcome.sets_recorded, outcome.sets_dropped) = (offered, recorded, dropped);
    outcome
}
