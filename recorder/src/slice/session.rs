//! `session.toml` of a part, and whether several parts are of one session.

use super::lane::Range;
use crate::dataset::Dataset;
use crate::{Error, ErrorKind, Result, Session};
use std::path::Path;

/// The end of the lines that a join itself writes of gaps. They are found anew from the sets each time.
pub(super) const IN_NO_INPUT: &str = "in none of the inputs";

/// The session of the part of a dataset, without its outcome.
pub(super) fn trimmed(source: &Session, out: &Path, range: &Range) -> Session {
    let mut session = named(source, out);
    session.notes.retain(|n| range.has_note(n.utc_ns));
    session
}

/// The session of several parts together, without its outcome.
pub(super) fn merged(datasets: &[Dataset], out: &Path) -> Session {
    let mut session = datasets.first().map_or_else(|| Session::new("", ""), |d| named(d.session(), out));
    for other in datasets.iter().skip(1).map(Dataset::session) {
        for note in other.notes.iter().filter(|n| !session.notes.contains(n)).cloned().collect::<Vec<_>>() {
            session.notes.push(note);
        }
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

/// What a source says was lost in words of its own: the counts are counted anew.
pub(super) fn lost_in_words(source: &Session) -> Vec<String> {
    let Some(outcome) = &source.outcome else { return Vec::new() };
    let count = |(reason, n): (&String, &u64)| count_line(*n, outcome.sets_offered, reason);
    let counts: Vec<_> = outcome.sets_dropped.iter().map(count).collect();
    let lines = outcome.lost.iter().filter(|line| !counts.contains(line) && !line.ends_with(IN_NO_INPUT));
    lines.cloned().collect()
}

/// The line of `lost` that a recorder writes of a count.
pub(super) fn count_line(n: u64, offered: u64, reason: &str) -> String {
    format!("{n} of {offered} sets were not recorded: {reason}")
}

/// Refuses two datasets of different sessions, and says in what they differ.
pub(super) fn must_be_one(a: &Dataset, b: &Dataset) -> Result<()> {
    let (x, y) = (a.session(), b.session());
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
    let (xs, ys) = (names(x), names(y));
    check(format!("the streams are {} and {}", xs.join(", "), ys.join(", ")), xs == ys);
    for (s, t) in x.streams.iter().zip(&y.streams).filter(|(s, t)| s.id == t.id) {
        check(format!("{} has another calibration", s.id), (s.intrinsics, s.pose) == (t.intrinsics, t.pose));
        check(format!("{} has another depth unit", s.id), s.depth_unit_m == t.depth_unit_m);
        let device = (&s.model, &s.serial) == (&t.model, &t.serial);
        check(format!("{} is of another camera", s.id), device);
        let picture = (s.format, s.width, s.height) == (t.format, t.width, t.height);
        check(format!("{} has other pictures", s.id), picture);
        let rest = (&s.calibration, s.rate_hz) == (&t.calibration, t.rate_hz);
        check(format!("{} is described otherwise", s.id), rest);
    }
    let names = |s: &Session| s.motion.iter().map(|u| u.id.to_string()).collect::<Vec<_>>();
    let (xs, ys) = (names(x), names(y));
    check(format!("the motion units are [{}] and [{}]", xs.join(", "), ys.join(", ")), xs == ys);
    for (u, v) in x.motion.iter().zip(&y.motion).filter(|(u, v)| u.id == v.id && u != v) {
        check(
            format!("the motion unit {} has another pose or device, or is described otherwise", u.id),
            u == v,
        );
    }
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
