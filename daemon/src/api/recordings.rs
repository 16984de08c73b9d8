//! The recordings of the rig on the live page: a list, an image of each, its report, and a person's judgement.

use super::allowed;
use super::page::REPORT;
use crate::control::Control;
use crate::status::RecordingStatus;
use crate::{Error, ErrorKind, Result};
use axum::http::{HeaderName, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::lock;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::preview::preview;
use depthrig_recorder::report::REPORT_FILE;
use depthrig_recorder::{
    CatalogEntry, Dataset, Health, Mark, PixelMode, SessionChanges, catalog, edit, look_at,
};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Recordings of a list at the most.
const MAX_LISTED: usize = 50;
/// Columns of an image of a recording at the most.
const IMAGE_COLUMNS: u32 = 320;
/// Sets that are looked into for such an image.
const IMAGE_TRIES: usize = 8;
/// The longest report that is sent, bytes; reports are below one megabyte.
const MAX_REPORT_BYTES: u64 = 32 << 20;
/// How long the address of a report holds.
const TICKET_TIME: Duration = Duration::from_mins(1);
/// Addresses of reports that hold at once; the oldest end first.
const MAX_TICKETS: usize = 16;
/// A report has styles and images in it, and no scripts.
const REPORT_POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'; \
     frame-ancestors 'none'; sandbox";

/// The newest recordings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recordings {
    /// Their folder.
    pub directory: PathBuf,
    /// Older ones that are left out.
    pub more: usize,
    /// The newest first.
    pub recordings: Vec<Recording>,
}

/// A recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recording {
    /// Its entry in the catalog. `name` is the path of its folder below that of the recordings.
    #[serde(flatten)]
    pub entry: CatalogEntry,
    /// Whether it has a report.
    pub has_report: bool,
}

/// A recording by its name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NameRequest {
    /// The path of its folder below that of the recordings.
    pub name: String,
}

/// A judgement of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MarkRequest {
    /// The path of its folder below that of the recordings.
    pub name: String,
    /// The judgement; `null` takes it back.
    pub mark: Option<Mark>,
}

/// Where a report can be read for a minute.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportPage {
    /// Its path on this server; needs no token.
    pub path: String,
}

/// The list.
pub(super) fn list(rig: &dyn Control) -> Result<Recordings> {
    let directory = rig.recordings()?;
    let mut entries = if directory.is_dir() { catalog(&RealFs, &directory)? } else { Vec::new() };
    entries.sort_by_key(|e| core::cmp::Reverse(e.started_utc_ns));
    let more = entries.len().saturating_sub(MAX_LISTED);
    entries.truncate(MAX_LISTED);
    let running = rig.status().recording;
    let recordings = entries.into_iter().map(|e| recording(e, &directory, running.as_ref())).collect();
    Ok(Recordings { directory, more, recordings })
}

fn recording(mut entry: CatalogEntry, directory: &Path, running: Option<&RecordingStatus>) -> Recording {
    if let Some(now) = running.filter(|r| r.active && Path::new(&r.path) == entry.path) {
        entry.health = Health::Recording;
        entry.sets = now.sets;
        entry.duration_ns = (now.duration_s * 1e9) as i64;
        entry.why.clear();
    }
    if let Ok(below) = entry.path.strip_prefix(directory) {
        entry.name = below.display().to_string();
    }
    let has_report = entry.path.join(REPORT_FILE).is_file();
    Recording { entry, has_report }
}

/// The folder of the recording `name`.
pub(super) fn folder(rig: &dyn Control, name: &str) -> Result<PathBuf> {
    let directory = rig.recordings()?;
    let missing =
        || Error::new(ErrorKind::NotFound, format!("{} has no recording {name:?}", directory.display()));
    let path =
        allowed::below(&directory.join(name), core::slice::from_ref(&directory)).map_err(|_| missing())?;
    let is_the_folder = directory.canonicalize().is_ok_and(|directory| directory == path);
    if is_the_folder || !path.is_dir() { Err(missing()) } else { Ok(path) }
}

/// A small JPEG from its middle.
pub(super) fn image(rig: &dyn Control, name: &str) -> Result<Response> {
    let mut sets = Dataset::open(&folder(rig, name)?)?.set_reader()?;
    let middle = sets.times().len() / 2;
    let none =
        || Error::new(ErrorKind::NotFound, format!("recording {name:?} has no image in colour or grey"));
    let is_seen =
        |f: &depthrig_recorder::DatasetFrame| f.header.pixel_format().is_some_and(|p| !p.is_depth());
    // A set may be incomplete, and a damaged one says nothing of its neighbours.
    let around = (middle..sets.times().len()).chain(0..middle).take(IMAGE_TRIES);
    let mut frames = around.filter_map(|number| {
        let set = sets.read(number, PixelMode::Stored).ok()?;
        set.frames.into_iter().find(is_seen)
    });
    let frame = frames.next().ok_or_else(none)?;
    let image = preview(&frame.header, &frame.decoded()?, IMAGE_COLUMNS)?;
    let kind = (header::CONTENT_TYPE, "image/jpeg");
    Ok(([kind, (header::CACHE_CONTROL, "private, max-age=3600")], image.bytes).into_response())
}

/// Writes a judgement down.
pub(super) fn mark(rig: &dyn Control, request: &MarkRequest) -> Result<Recording> {
    let path = folder(rig, &request.name)?;
    let changes = SessionChanges { mark: Some(request.mark), ..SessionChanges::default() };
    edit(&RealFs, &path, &changes)?;
    // One that is being recorded is not edited.
    Ok(recording(look_at(&RealFs, &path), &rig.recordings()?, None))
}

/// Addresses of reports.
#[derive(Debug, Clone, Default)]
pub(super) struct Tickets(Arc<Mutex<VecDeque<Ticket>>>);

#[derive(Debug)]
struct Ticket {
    text: String,
    report: PathBuf,
    ends: HostTime,
}

impl Tickets {
    /// An address for the report of a recording.
    pub(super) fn issue(&self, rig: &dyn Control, name: &str) -> Result<ReportPage> {
        let report = folder(rig, name)?.join(REPORT_FILE);
        if !report.is_file() {
            let what = format!("recording {name:?} has no report yet; write it with: depthrig report {name}");
            return Err(Error::new(ErrorKind::NotFound, what));
        }
        let text = super::token::random_text().map_err(|e| {
            Error::new(ErrorKind::Other, "no random numbers for the address of a report").with_source(e)
        })?;
        let path = format!("{REPORT}{text}");
        let mut tickets = lock(&self.0);
        while tickets.len() >= MAX_TICKETS {
            tickets.pop_front();
        }
        tickets.push_back(Ticket { text, report, ends: HostTime::now().plus(TICKET_TIME) });
        Ok(ReportPage { path })
    }

    /// The report at an address.
    pub(super) fn report(&self, ticket: &str) -> Result<Response> {
        let mut tickets = lock(&self.0);
        tickets.retain(|t| !t.ends.from_now().is_zero());
        let found = tickets.iter().find(|t| t.text == ticket).map(|t| t.report.clone());
        drop(tickets);
        let gone = || {
            Error::new(
                ErrorKind::NotFound,
                "the address of this report has expired; open it from the page again",
            )
        };
        let path = found.ok_or_else(gone)?;
        let read = |e: std::io::Error| {
            Error::new(ErrorKind::Other, format!("{} cannot be read", path.display())).with_source(e)
        };
        if std::fs::metadata(&path).map_err(read)?.len() > MAX_REPORT_BYTES {
            return Err(Error::new(ErrorKind::Other, format!("{} is too long for a report", path.display())));
        }
        let html = std::fs::read(&path).map_err(read)?;
        let headers: [(HeaderName, &str); 5] = [
            (header::CONTENT_TYPE, "text/html; charset=utf-8"),
            (header::CONTENT_SECURITY_POLICY, REPORT_POLICY),
            (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
            (header::REFERRER_POLICY, "no-referrer"),
            (header::CACHE_CONTROL, "no-store"),
        ];
        Ok((headers.map(|(name, value)| (name, HeaderValue::from_static(value))), html).into_response())
    }
}
