//! The verdict on a dataset in sentences: the first thing that a reader sees.

use super::html::count;
use super::{Report, SetsAccount, StreamReport, Verdict};
use crate::catalog::{CatalogEntry, Health};

/// Sentences of each kind at most; the rest is counted.
const LINES_MAX: usize = 12;

/// Before anything is known.
pub(super) const fn unknown() -> Verdict {
    Verdict { health: Health::Whole, headline: String::new(), why: Vec::new(), remarks: Vec::new() }
}

/// The verdict on what was gathered, and on what the folder says of itself.
pub(super) fn of(report: &Report, catalog: Option<&CatalogEntry>) -> Verdict {
    let mut health = catalog.map_or(Health::Whole, |c| c.health);
    let mut why: Vec<String> = catalog.map(|c| c.why.clone()).unwrap_or_default();
    let unfinished =
        matches!(health, Health::Unfinished | Health::Recording) || !report.unfinished.is_empty();
    if !report.unfinished.is_empty() && health == Health::Whole {
        health = Health::Unfinished;
    }
    if report.problem_count > 0 {
        // An unfinished segment ends in the middle, which is not damage.
        if !unfinished {
            health = Health::Damaged;
        }
        why.extend(report.problems.iter().filter(|p| !unfinished || !p.contains(".part")).cloned());
    }
    let lost = report.sets.counts.as_ref().map_or(0, SetsAccount::dropped_total);
    if lost > 0 && health == Health::Whole {
        health = Health::Lost;
        why.push(format!("{lost} sets were not recorded"));
    }
    let balanced = report.sets.counts.as_ref().is_none_or(SetsAccount::balances)
        && (report.streams.iter().filter_map(|s| s.account.as_ref()))
            .chain(report.motion.iter().filter_map(|u| u.account.as_ref()))
            .chain(report.signals.iter().filter_map(|s| s.account.as_ref()))
            .all(crate::StreamAccount::balances);
    if !balanced {
        health = Health::Damaged;
        why.push("an account does not balance: a frame or a set vanished without a reason".to_owned());
    }
    why.dedup();
    shorten(&mut why);
    let mut remarks = remarks(report);
    shorten(&mut remarks);
    let headline = headline(report, health, lost, remarks.is_empty());
    Verdict { health, headline, why, remarks }
}

fn headline(report: &Report, health: Health, lost: u64, plain: bool) -> String {
    let sets = report.sets.count;
    let path = report.path.display();
    match health {
        Health::Whole if plain => format!("Whole: all {sets} sets are here, each with every stream."),
        Health::Whole if report.sets.incomplete > 0 => {
            let incomplete = report.sets.incomplete;
            format!(
                "Whole: all {sets} sets that were taken are here, {incomplete} of them without every stream."
            )
        }
        Health::Whole => {
            format!("Whole: all {sets} sets are here, each with every stream. Read the remarks.")
        }
        Health::Recording => format!("Still being recorded: this is what is on disk so far, {sets} sets."),
        // A crash loses sets that were not counted yet.
        Health::Lost if lost == 0 => {
            format!("Something was lost, although no set is counted as lost: {sets} sets are here.")
        }
        Health::Lost => {
            let offered = report.sets.counts.as_ref().map_or(sets + lost, |c| c.offered);
            format!("Something was lost: {lost} of {offered} sets were not recorded.")
        }
        Health::Unfinished => {
            format!(
                "Not finished: {sets} sets can be read as they are. Finish it with: depthrig recover {path}"
            )
        }
        Health::Damaged => {
            format!("Damaged: {sets} sets can be read. Find out where with: depthrig verify {path}")
        }
    }
}

fn remarks(report: &Report) -> Vec<String> {
    let mut remarks = Vec::new();
    for u in report.motion.iter().filter(|u| u.lost_batches > 0) {
        remarks.push(format!("{}: {} batches of samples were not recorded.", u.record.id, u.lost_batches));
    }
    remarks.extend(report.signals.iter().flat_map(|s| &s.remarks).map(|what| format!("{what}.")));
    let sets = &report.sets;
    // Streams of one camera with the same losses share a line.
    let mut lines: Vec<(Vec<String>, String)> = Vec::new();
    for s in report.streams.iter().filter(|s| s.missing > 0) {
        let story = missing(s, sets.count, sets.duration_ns);
        match lines.iter_mut().find(|(_, said)| *said == story) {
            Some((names, _)) => names.push(s.record.id.to_string()),
            None => lines.push((vec![s.record.id.to_string()], story)),
        }
    }
    remarks.extend(lines.into_iter().map(|(names, story)| format!("{}: {story}.", some_of(&names))));
    for s in &report.streams {
        if let Some(a) = s.account.as_ref().filter(|a| a.dropped.total() > 0) {
            let reasons: Vec<_> = a.dropped.nonzero().map(|(r, n)| format!("{n} {}", r.name())).collect();
            remarks.push(format!(
                "{}: {} of {} captured frames were lost before their channel: {}.",
                a.stream,
                a.dropped.total(),
                a.captured,
                reasons.join(", ")
            ));
        }
    }
    if sets.beyond_limit > 0 {
        let limit = sets.spread_limit_ns.unwrap_or(0) as f64 / 1e6;
        remarks.push(format!(
            "{} of {} sets have frames more than {limit:.1} ms apart, {:.1} ms at most.",
            sets.beyond_limit,
            sets.count,
            sets.spread_ns.max as f64 / 1e6
        ));
    }
    for s in report.streams.iter().filter(|s| s.clock.restarts > 0) {
        remarks.push(format!("{}: its clock map had {}.", s.record.id, count(s.clock.restarts, "restart")));
    }
    for (at, by) in &report.host_clock.steps {
        let at = *at as f64 / 1e9;
        let by = *by as f64 / 1e6;
        remarks.push(format!(
            "The wall clock was set by {by:+.1} ms at {at:.1} s; recorded times did not jump."
        ));
    }
    let without: Vec<_> = report
        .streams
        .iter()
        .filter(|s| !s.record.intrinsics.is_known())
        .map(|s| s.record.id.to_string())
        .collect();
    if !without.is_empty() {
        remarks.push(format!("Without calibration: {}.", some_of(&without)));
    }
    remarks
}

fn missing(s: &StreamReport, sets: u64, duration_ns: i64) -> String {
    let at = |ns: i64| format!("{:.1} s", ns as f64 / 1e9);
    let story = format!("missing in {} of {sets} sets", s.missing);
    let Some((from, to)) = s.missing_ns.filter(|_| s.last_ns.is_some()) else {
        return story + ": no frame at all";
    };
    let near = 2 * duration_ns / i64::try_from(sets.max(1)).unwrap_or(1);
    match (from <= near, to >= duration_ns - near) {
        (true, true) => story,
        (true, false) => format!("{story}, until {}", at(to)),
        (false, true) => format!("{story}, from {} to the end", at(from)),
        (false, false) => format!("{story}, between {} and {}", at(from), at(to)),
    }
}

/// A few of the names, and how many more there are.
fn some_of(names: &[String]) -> String {
    match names.len() {
        0..=4 => names.join(", "),
        n => format!("{} and {} more", names[..3].join(", "), n - 3),
    }
}

fn shorten(lines: &mut Vec<String>) {
    if lines.len() > LINES_MAX {
        let more = lines.len() - LINES_MAX;
        lines.truncate(LINES_MAX);
        lines.push(format!("… and {more} more."));
    }
}
