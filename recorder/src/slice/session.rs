//! `session.toml` of a part, and whether several parts are of one session.

use super::track::Range;
use crate::dataset::Dataset;
use crate::{Error, ErrorKind, Outcome, Result, Session, SetCounts, SetDrop};
use std::path::Path;

// Words of the lines that a join itself writes about gaps. These are determined anew from the sets each time.

/// The end of one of a gap between two inputs.
pub(super) const IN_NO_INPUT: &str = "in none of the inputs";
/// The end of the one of all gaps that nobody knows a reason of.
pub(super) const UNEXPLAINED: &str = "and no account tells why";
/// In one of a gap whose reason is in the file; the reason follows.
pub(super) const NOT_THERE: &str = "are not there: ";

// Beginnings of lines that hold as long as no set is on the other side; the id of the set follows.

/// Nobody knows how many sets are missing before it.
pub(super) const BEFORE: &str = "what came before set ";
/// Nobody knows how many sets are missing after it.
pub(super) const AFTER: &str = "what came after set ";

/// The session of the part of a dataset, without its outcome.
pub(super) fn trimmed(source: &Session, out: &Path, range: &Range) -> Session {
    let mut session = named(source, out);
    session.notes.retain(|n| range.has_note(n.utc_ns));
    session.cut_episodes(range.from_utc_ns..=range.to_utc_ns, |utc_ns| range.has_note(utc_ns));
    session
}

/// The session of several parts together, without its outcome.
pub(super) fn merged(datasets: &[Dataset], out: &Path) -> Session {
    let mut session = datasets.first().map_or_else(|| Session::new("", ""), |d| named(d.session(), out));
    for other in datasets.iter().skip(1).map(Dataset::session) {
        if other.signals.len() > session.signals.len() {
            session.signals.clone_from(&other.signals);
        }
        for note in other.notes.iter().filter(|n| !session.notes.contains(n)).cloned().collect::<Vec<_>>() {
            session.notes.push(note);
        }
        session.join_episodes(&other.episodes);
        for step in other.derived.iter().filter(|d| !session.derived.contains(d)).cloned().collect::<Vec<_>>()
        {
            session.derived.push(step);
        }
    }
    session.notes.sort_by_key(|n| n.utc_ns);
    session.derived.sort_by_key(|d| d.utc_ns);
    session
}

fn named(source: &Session, out: &Path) -> Session {
    let mut session = source.clone();
    if let Some(name) = out.file_name() {
        session.name = name.to_string_lossy().into_owned();
    }
    session.outcome = None;
    session
}

/// Losses that a source states in words of its own, as far as they hold for sets from `first` to `last`. Counts are
/// counted anew.
pub(super) fn lost_in_words(source: &Session, first: u64, last: u64) -> Vec<String> {
    let Some(outcome) = &source.outcome else { return Vec::new() };
    let known = |reason: &str| SetDrop::ALL.iter().any(|r| r.name() == reason);
    let dropped = outcome.sets_dropped.iter().filter(|(reason, _)| known(reason));
    let counts: Vec<_> = dropped.map(|(reason, n)| count_line(*n, outcome.sets_offered, reason)).collect();
    let holds = |line: &&String| !counts.contains(line) && !is_gap(line) && !is_filled(line, first, last);
    outcome.lost.iter().filter(holds).cloned().collect()
}

/// Whether a line is about a gap between sets, or before the first one.
fn is_gap(line: &str) -> bool {
    let between = [" sets before set ", " sets between set "].iter().any(|words| line.contains(*words));
    (between && line.contains(NOT_THERE)) || line.ends_with(IN_NO_INPUT) || line.ends_with(UNEXPLAINED)
}

/// Whether a line is about sets missing before or after a set, where others are now.
fn is_filled(line: &str, first: u64, last: u64) -> bool {
    let set = |begin: &str| line.strip_prefix(begin)?.split(' ').next()?.parse::<u64>().ok();
    set(BEFORE).is_some_and(|id| first < id) || set(AFTER).is_some_and(|id| id < last)
}

/// Whether two lines are about the same end.
pub(super) fn is_same_end(a: &str, b: &str) -> bool {
    [BEFORE, AFTER].iter().any(|begin| a.starts_with(*begin) && b.starts_with(*begin))
}

/// The line of a source that begins with these words.
pub(super) fn said(source: Option<&Session>, begin: &str) -> Option<String> {
    let outcome = source?.outcome.as_ref()?;
    outcome.lost.iter().find(|line| line.starts_with(begin)).cloned()
}

/// How a recording ended, as the account that comes after all in its file: where a write failed, the file has
/// none of what was lost from then on.
pub(super) fn last_account(outcome: &Outcome) -> SetCounts {
    let dropped = SetDrop::ALL.map(|reason| outcome.sets_dropped.get(reason.name()).copied().unwrap_or(0));
    SetCounts { offered: outcome.sets_offered, recorded: outcome.sets_recorded, dropped }
}

/// Whether nothing came after the set of this time, because the recording itself was closed with it.
pub(super) fn is_whole_end(source: &Session, utc_ns: i64) -> bool {
    source.derived.is_empty() && source.outcome.as_ref().is_some_and(|o| o.ended_utc_ns <= utc_ns)
}

/// Whether all sets of a source are between these times, as it says itself; `begins` when no set was offered
/// before.
pub(super) fn is_between(source: &Session, first_utc_ns: i64, last_utc_ns: i64, begins: bool) -> bool {
    let begins = source.derived.last().map_or(begins, |step| first_utc_ns <= step.first_utc_ns);
    begins && source.outcome.as_ref().is_some_and(|o| o.ended_utc_ns <= last_utc_ns)
}

/// The line of `lost` that a recorder writes of a count.
pub(super) fn count_line(n: u64, offered: u64, reason: &str) -> String {
    format!("{n} of {offered} sets were not recorded: {reason}")
}

/// Refuses two datasets of different sessions, and says in what they differ.
pub(super) fn must_be_one(a: &Dataset, b: &Dataset) -> Result<()> {
    let x = a.session();
    let y = b.session();
    let mut differ = Vec::new();
    let mut check = |what: String, same: bool| {
        if !same {
            differ.push(what);
        }
    };
    check(format!("the rig is {} and {}", x.rig, y.rig), x.rig == y.rig);
    check(
        format!("the recordings began at {} and {} (UTC ns)", x.started_utc_ns, y.started_utc_ns),
        x.started_utc_ns == y.started_utc_ns,
    );
    let names = |s: &Session| s.streams.iter().map(|s| s.id.to_string()).collect::<Vec<_>>();
    let xs = names(x);
    let ys = names(y);
    check(format!("the streams are {} and {}", xs.join(", "), ys.join(", ")), xs == ys);
    for (s, t) in x.streams.iter().zip(&y.streams).filter(|(s, t)| s.id == t.id) {
        check(format!("{} has another calibration", s.id), (s.intrinsics, s.pose) == (t.intrinsics, t.pose));
        check(format!("{} has another depth unit", s.id), s.depth_unit_m == t.depth_unit_m);
        let device = (&s.model, &s.serial) == (&t.model, &t.serial);
        check(format!("{} is of another camera", s.id), device);
        let image = (s.format, s.width, s.height) == (t.format, t.width, t.height);
        check(format!("{} has other images", s.id), image);
        let rest = (&s.calibration, s.rate_hz) == (&t.calibration, t.rate_hz);
        check(format!("{} is described otherwise", s.id), rest);
    }
    let names = |s: &Session| s.motion.iter().map(|u| u.id.to_string()).collect::<Vec<_>>();
    let xs = names(x);
    let ys = names(y);
    check(format!("the IMUs are [{}] and [{}]", xs.join(", "), ys.join(", ")), xs == ys);
    for (u, v) in x.motion.iter().zip(&y.motion).filter(|(u, v)| u.id == v.id && u != v) {
        check(format!("the IMU {} has another pose or device, or is described otherwise", u.id), u == v);
    }
    check("a signal has other fields".to_owned(), x.has_signals_as(y));
    if differ.is_empty() {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::BadInput,
        format!(
            "{} and {} are not of the same session: {}; only parts of one recording can be merged; \
             keep them as datasets beside each other",
            a.path().display(),
            b.path().display(),
            differ.join("; ")
        ),
    ))
}
