//! Drives an [`Importer`]: records what it reads as a dataset, and verifies that.

use depthrig_bus::UtcPair;
use depthrig_bus::sync::lock;
use depthrig_recorder::Dataset;
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{
    Error, ErrorKind, RecordSet, Recorder, RecorderOptions, Result, Session, StreamAccount, Summary,
    VerifyOptions, VerifyReport, verify_with,
};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// One layout that can become a dataset. It reads one set at a time.
pub trait Importer {
    /// The name of the layout.
    fn format(&self) -> &'static str;

    /// Who recorded what with which cameras. Its table `import` in `extra` says where each fact comes from.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when it cannot be a dataset.
    fn session(&mut self) -> Result<Session>;

    /// The next set; `None` at the end. An image that cannot be read is counted in [`ImportFacts`].
    ///
    /// # Errors
    /// Failures that end the import.
    fn next(&mut self) -> Result<Option<RecordSet>>;

    /// How much of how much has been read, in any unit.
    fn progress(&self) -> ImportProgress;

    /// Counts and losses, after the last set.
    fn facts(&self) -> ImportFacts;
}

/// How far an import has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImportProgress {
    /// Read so far.
    pub done: u64,
    /// There is in all.
    pub total: u64,
}

/// Counts and losses of an import.
#[derive(Debug, Clone, Default, Serialize)]
#[non_exhaustive]
pub struct ImportFacts {
    /// `captured = delivered + Σ dropped` of each stream, as far as the source says.
    pub accounts: Vec<StreamAccount>,
    /// Images and sets that could not be imported.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Assumptions, inferences and omissions, a sentence each.
    pub stated: Vec<String>,
    /// How much of what was there a dataset does not hold, by what it is, such as `motion_samples`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub left_out: BTreeMap<String, u64>,
}

impl ImportFacts {
    /// Counts something that could not be imported.
    pub fn lose(&mut self, problem: String) {
        self.lost += 1;
        if self.problems.len() < super::report::MAX_PROBLEMS {
            self.problems.push(problem);
        }
    }
}

/// Result of an import.
#[derive(Debug, Serialize)]
#[non_exhaustive]
pub struct ImportReport {
    /// The layout.
    pub format: String,
    /// Summary of the recording.
    pub summary: Summary,
    /// Counts and losses.
    pub facts: ImportFacts,
    /// Whether the dataset is complete.
    pub verified: VerifyReport,
    /// Whether it was ended from outside before all was read.
    pub ended: bool,
}

/// Time between looks at a recorder that has no room.
const PAUSE: Duration = Duration::from_millis(2);

/// Reads everything from `importer`, records it as the dataset `out`, a new folder, and verifies it.
///
/// # Errors
/// As [`Importer`] and [`Recorder::create`]; what was recorded before a failure is left in `out` and is named in
/// the message.
pub fn import(
    importer: &mut dyn Importer,
    fs: Arc<dyn Fs>,
    out: &Path,
    options: RecorderOptions,
    progress: &mut dyn FnMut(ImportProgress) -> ControlFlow<()>,
) -> Result<ImportReport> {
    let session = importer.session()?;
    let mut table = session.extra.get("import").and_then(toml::Value::as_table).cloned().unwrap_or_default();
    let start = UtcPair { utc_ns: session.started_utc_ns, ..UtcPair::default() };
    let pair = Arc::new(Mutex::new(start));
    let clock = {
        let pair = Arc::clone(&pair);
        Arc::new(move || *lock(&pair))
    };
    let queue_sets = options.queue_sets.max(1);
    let backlog = options.backlog_max_bytes;
    let recorder = Recorder::create_with(Arc::clone(&fs), clock, out, session, options)?;
    let cut = |e: Error| {
        let what = format!(
            "{e}; what was read before stays in {} as an incomplete dataset: remove it",
            out.display()
        );
        Error::new(e.kind(), what).with_source(e)
    };
    let mut ended = false;
    while let Some(set) = importer.next().map_err(cut)? {
        *lock(&pair) =
            UtcPair { mono: set.tick, utc_ns: set.utc.utc_ns(set.tick), width_ns: set.utc.width_ns };
        // A set that finds no room would be refused: wait for it, nothing is live here.
        loop {
            let p = recorder.progress();
            if p.error.is_some() || (p.encode_queue < queue_sets && p.backlog_bytes < backlog) {
                break;
            }
            std::thread::sleep(PAUSE);
        }
        if let Err(e) = recorder.push(set) {
            let cause = recorder.progress().error;
            let kind = cause.as_ref().map_or(ErrorKind::BadInput, |e| e.kind());
            return Err(cut(Error::new(kind, e.to_string())));
        }
        if progress(importer.progress()).is_break() {
            ended = true;
            break;
        }
    }
    let facts = importer.facts();
    recorder.update_accounts(facts.accounts.clone());
    conclude(&mut table, &facts, ended);
    recorder.state("import", table);
    let summary = recorder.finish()?;
    let verified = verify_with(&fs, out, &VerifyOptions::default())?;
    // A dataset that was verified can be opened.
    drop(Dataset::open_with(fs, out)?);
    Ok(ImportReport { format: importer.format().to_owned(), summary, facts, verified, ended })
}

/// Puts into the table `import` what is known at the end: all that is stated, what could not be imported and what was left
/// out.
fn conclude(table: &mut toml::Table, facts: &ImportFacts, ended: bool) {
    let number = |n: u64| toml::Value::from(i64::try_from(n).unwrap_or(i64::MAX));
    table.insert("stated".to_owned(), facts.stated.clone().into());
    table.insert("ended_early".to_owned(), ended.into());
    table.insert("lost".to_owned(), number(facts.lost));
    if !facts.left_out.is_empty() {
        let left_out = facts.left_out.iter().map(|(what, n)| (what.clone(), number(*n)));
        table.insert("left_out".to_owned(), left_out.collect::<toml::Table>().into());
    }
}

/// The table `import` of a session: from where, and what was assumed.
pub(super) fn table(format: &str, path: &Path, facts: &ImportFacts) -> toml::Value {
    let mut table = toml::Table::new();
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    table.insert("format".to_owned(), format.to_owned().into());
    table.insert("from".to_owned(), name.into());
    table.insert("depthrig_version".to_owned(), env!("CARGO_PKG_VERSION").into());
    let stated: Vec<toml::Value> = facts.stated.iter().cloned().map(Into::into).collect();
    table.insert("stated".to_owned(), stated.into());
    table.into()
}
