//! `depthrig sessions`: lists the datasets in a folder.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use anyhow::Result;
use clap::ValueEnum;
use depthrig_daemon::client::Client;
use depthrig_daemon::config::RecordingConfig;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{CatalogEntry, Health, Mark, catalog};
use std::path::{Path, PathBuf};
use time::{OffsetDateTime, UtcOffset};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Only the metadata of each dataset is read, no images; `depthrig verify` checks all data.
Exit codes: 0 all listed datasets are good, 1 the folder cannot be read, 3 some have losses, are unfinished or damaged.

Examples:
  depthrig sessions
  depthrig sessions /data --sort size --reverse
  depthrig sessions /data --filter kitchen --json | jq '.[] | select(.health != \"whole\") | .path'";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct SessionsArgs {
    /// Folder to search, with subfolders [default: the running rig's, else datasets]
    #[arg(value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Sort key
    #[arg(long, value_enum, default_value = "start", value_name = "KEY")]
    sort: Sort,
    /// Reverse the order
    #[arg(long)]
    reverse: bool,
    /// Only datasets with TEXT in name, scene or operator; ignores case
    #[arg(long, value_name = "TEXT")]
    filter: Option<String>,
    /// Only datasets with TEXT in their scene; ignores case
    #[arg(long, value_name = "TEXT")]
    scene: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Sort key of the list; ties are ordered by path.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Sort {
    /// Start time, latest last
    Start,
    /// Name
    Name,
    /// Scene
    Scene,
    /// Length, longest last
    Length,
    /// Number of sets, most last
    Sets,
    /// Size, largest last
    Size,
    /// Health, worst last
    Health,
}

/// Lists the datasets.
pub fn run(args: &SessionsArgs, context: &Context) -> Result<Exit> {
    let folder = args.folder.clone().unwrap_or_else(|| recordings_folder(context));
    let mut entries = catalog(&RealFs, &folder)?;
    mark_recordings(&mut entries, context);
    entries.retain(|e| is_wanted(e, args));
    sort(&mut entries, args.sort);
    if args.reverse {
        entries.reverse();
    }
    if args.json {
        out::json(&entries)?;
    } else {
        out::line(text(&entries, &folder.display().to_string()))?;
    }
    Ok(if entries.iter().any(|e| e.health.is_bad()) { Exit::Lost } else { Exit::Good })
}

/// Recording folder of the running rig, else the default of a configuration.
fn recordings_folder(context: &Context) -> PathBuf {
    let of_rig = || {
        let client = Client::connect(&context.runtime().ok()?, context.global.rig.as_ref()).ok()?;
        let recording = client.record_status().ok()??;
        Some(PathBuf::from(recording.path).parent()?.to_owned())
    };
    of_rig().unwrap_or_else(|| RecordingConfig::default().directory)
}

/// Marks the dataset that a running rig records now as good, although it is unfinished.
fn mark_recordings(entries: &mut [CatalogEntry], context: &Context) {
    let Ok(runtime) = context.runtime() else { return };
    for rig in runtime.running_rigs() {
        let Ok(client) = Client::connect(&runtime, Some(&rig)) else { continue };
        let Ok(Some(recording)) = client.record_status() else { continue };
        let Some(path) = recording.active.then(|| Path::new(&recording.path).canonicalize().ok()).flatten()
        else {
            continue;
        };
        let mut unfinished = entries.iter_mut().filter(|e| e.health == Health::Unfinished);
        if let Some(entry) = unfinished.find(|e| e.path.canonicalize().is_ok_and(|p| p == path)) {
            (entry.health, entry.sets, entry.why) = (Health::Recording, recording.sets, Vec::new());
            entry.duration_ns = (recording.duration_s * 1e9) as i64;
        }
    }
}

fn is_wanted(e: &CatalogEntry, args: &SessionsArgs) -> bool {
    let has = |text: &str, part: &str| text.to_lowercase().contains(&part.to_lowercase());
    args.scene.as_ref().is_none_or(|part| has(&e.scene, part))
        && args
            .filter
            .as_ref()
            .is_none_or(|part| [&e.name, &e.scene, &e.operator].into_iter().any(|text| has(text, part)))
}

fn sort(entries: &mut [CatalogEntry], by: Sort) {
    match by {
        Sort::Start => entries.sort_by_key(|e| e.started_utc_ns),
        Sort::Name => entries.sort_by(|a, b| a.name.cmp(&b.name)),
        Sort::Scene => entries.sort_by(|a, b| a.scene.cmp(&b.scene)),
        Sort::Length => entries.sort_by_key(|e| e.duration_ns),
        Sort::Sets => entries.sort_by_key(|e| e.sets),
        Sort::Size => entries.sort_by_key(|e| e.bytes),
        Sort::Health => entries.sort_by_key(|e| e.health),
    }
}

fn text(entries: &[CatalogEntry], folder: &str) -> String {
    if entries.is_empty() {
        return format!("no datasets in {folder}");
    }
    let mut lines = vec![out::table(
        &[
            "name", "scene", "operator", "start", "health", "mark", "length", "sets", "lost", "streams",
            "size",
        ],
        6,
        entries.iter().map(|e| {
            vec![
                short(&e.name, 44),
                short(&e.scene, 24),
                short(&e.operator, 16),
                e.started_utc_ns.map_or_else(|| "-".to_owned(), local),
                e.health.name().to_owned(),
                e.mark.map_or("-", Mark::name).to_owned(),
                out::seconds(e.duration_ns as f64 / 1e9),
                e.sets.to_string(),
                e.sets_lost.to_string(),
                e.streams.to_string(),
                out::bytes(e.bytes),
            ]
        }),
    )];
    let bad: Vec<_> = entries.iter().filter(|e| e.health.is_bad()).collect();
    let (sets, bytes) = entries.iter().fold((0, 0), |(s, b), e| (s + e.sets, b + e.bytes));
    lines.push(String::new());
    for e in &bad {
        let why = e.why.first().map_or("", String::as_str);
        let why = printable::line(why);
        lines.push(format!("{}: {}: {why}", e.health.name(), printable::path(&e.path)));
    }
    let all = format!(
        "{}, {}, {}",
        out::count(entries.len(), "dataset"),
        out::count(sets, "set"),
        out::bytes(bytes)
    );
    lines.push(if bad.is_empty() { all } else { format!("{all}; to check: {}", bad.len()) });
    lines.join("\n")
}

/// Puts text on one line of at most `most` characters; `-` for empty text.
fn short(text: &str, most: usize) -> String {
    let text: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    match text.trim() {
        "" => "-".to_owned(),
        text if text.chars().count() <= most => text.to_owned(),
        text => text.chars().take(most - 1).chain(['…']).collect(),
    }
}

/// Formats a time as `2026-08-21 14:05 +02:00`, in this computer's time zone at that time, else in UTC.
fn local(utc_ns: i64) -> String {
    let Ok(utc) = OffsetDateTime::from_unix_timestamp_nanos(i128::from(utc_ns)) else {
        return "-".to_owned();
    };
    let t = utc.to_offset(UtcOffset::local_offset_at(utc).unwrap_or(UtcOffset::UTC));
    let (hours, minutes, _) = t.offset().as_hms();
    let sign = if t.offset().is_negative() { '-' } else { '+' };
    format!(
        "{:04}-{:02}-{:02} {:02}:{:02} {sign}{:02}:{:02}",
        t.year(),
        u8::from(t.month()),
        t.day(),
        t.hour(),
        t.minute(),
        hours.unsigned_abs(),
        minutes.unsigned_abs()
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_stay_on_their_line() {
        assert_eq!(short("", 5), "-");
        assert_eq!(short(" a\nb\x1b[31m ", 20), "a b [31m");
        assert_eq!(short("Küchentisch", 5), "Küch…");
        assert_eq!(short("Küche", 5), "Küche");
    }
}
