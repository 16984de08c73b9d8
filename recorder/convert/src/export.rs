//! Drives an [`Exporter`]: cuts the work into parts, works on several at once, and goes on where a run was killed.

use super::folder::{FolderState, OutFile, Output};
use super::report::{ExportReport, PartRecord, StreamCount};
use super::source::{EpisodeUse, PART_SETS, Part, Source};
use crossbeam::channel::{Sender, bounded};
use depthrig_bus::StreamId;
use depthrig_bus::sync::lock;
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{Dataset, DatasetSet, PixelMode, SetReader};
use depthrig_recorder::{Error, ErrorKind, Result};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// One layout that datasets can be exported to.
///
/// The files must follow from the datasets and [`Exporter::options`] alone, and no two parts may share a file: then
/// an export that was interrupted ends as one that was not.
pub trait Exporter: Sync {
    /// The name of the layout.
    fn format(&self) -> &'static str;

    /// The sets of a dataset with episodes that are exported.
    fn episodes(&self) -> EpisodeUse {
        EpisodeUse::Kept
    }

    /// Whether the samples of this signal are exported; known once it is planned.
    fn takes(&self, _signal: &StreamId) -> bool {
        false
    }

    /// The options that decide what is written, as recorded in `export.json`. A folder is resumed with equal ones only.
    fn options(&self) -> Value;

    /// Checks whether these datasets can be exported and says how. Nothing is written yet.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when they cannot.
    fn plan(&mut self, sources: &[Source]) -> Result<Plan>;

    /// Exports one part. Called on several threads at once.
    ///
    /// # Errors
    /// Failures that end the export. A frame that cannot be exported is [`PartOut::lose`], not an error.
    fn part(
        &self,
        source: &Source,
        part: &Part,
        sets: &mut PartSets<'_>,
        out: &mut PartOut<'_>,
    ) -> Result<()>;

    /// Writes what needs all parts, such as lists of all frames. Called again when it was interrupted.
    ///
    /// # Errors
    /// Failures that end the export.
    fn finish(&self, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()>;
}

/// How datasets are going to be exported.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// The parts in the order in which [`Exporter::finish`] sees them.
    pub parts: Vec<Part>,
    /// Folders that are needed, paths below the folder of the export.
    pub folders: Vec<String>,
    /// Changes and omissions by the layout or the options, a sentence each.
    pub losses: Vec<String>,
}

impl Plan {
    /// Every set of every dataset, cut at the ends of segments and after [`PART_SETS`] sets.
    pub fn by_segment(sources: &[Source]) -> Self {
        let parts = sources.iter().enumerate().flat_map(|(i, s)| s.parts(i, PART_SETS)).collect();
        Self { parts, ..Self::default() }
    }
}

/// How an export is done. None of this changes what is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExportOptions {
    /// Parts that are worked on at once.
    pub workers: usize,
}

impl Default for ExportOptions {
    /// One for each core.
    fn default() -> Self {
        Self { workers: std::thread::available_parallelism().map_or(1, std::num::NonZero::get) }
    }
}

/// How far an export has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExportProgress {
    /// Sets read, those of earlier runs included.
    pub sets: u64,
    /// Sets to be read in all.
    pub total: u64,
}

/// The sets of a part, one after the other.
pub struct PartSets<'a> {
    reader: &'a mut SetReader,
    numbers: Range<usize>,
    stop: &'a AtomicBool,
    tick: &'a Sender<()>,
}

/// Where a part writes to.
pub struct PartOut<'a> {
    out: &'a Output<'a>,
    /// Folders of the files that were written.
    folders: BTreeSet<PathBuf>,
    record: PartRecord,
    rows: Vec<u8>,
}

/// The parts, all done.
pub struct Parts<'a> {
    out: &'a Output<'a>,
    plan: &'a [Part],
    records: Vec<PartRecord>,
}

impl PartSets<'_> {
    /// The next set that can be read, with its number in the dataset; `None` at the end. What cannot be read is
    /// counted as lost.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the disk fails or the export is being ended.
    pub fn next(&mut self, mode: PixelMode, out: &mut PartOut<'_>) -> Result<Option<(usize, DatasetSet)>> {
        for number in self.numbers.by_ref() {
            if self.stop.load(Ordering::Relaxed) {
                return Err(Error::new(ErrorKind::Io, "the export was ended"));
            }
            let read = self.reader.read(number, mode);
            // The receiver lives as long as any worker does.
            let _ = self.tick.send(());
            match read {
                Ok(set) => {
                    out.record.sets += 1;
                    let missing = &mut out.record.missing;
                    for stream in &set.missing {
                        missing[*stream] += 1;
                    }
                    return Ok(Some((number, set)));
                }
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => out.lose(e.to_string()),
            }
        }
        Ok(None)
    }
}

impl<'a> PartOut<'a> {
    /// Begins a file that is removed before the export is complete, as [`Output::scratch`].
    pub(super) fn scratch(&self, name: &str) -> Result<OutFile<'a>> {
        self.out.scratch(name)
    }
}

impl PartOut<'_> {
    /// Begins a file, as [`Output::create`].
    ///
    /// # Errors
    /// As the file system says.
    pub fn create(&mut self, name: &str) -> Result<OutFile<'_>> {
        self.record.files += 1;
        self.remember(name);
        self.out.create(name)
    }

    /// Writes a file in one step, as [`Output::file`].
    ///
    /// # Errors
    /// As the file system says.
    pub fn file(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        self.out.file(name, bytes)?;
        self.record.files += 1;
        self.add_bytes(bytes.len() as u64);
        self.remember(name);
        Ok(())
    }

    fn remember(&mut self, name: &str) {
        if let Some(folder) = Path::new(name).parent().filter(|f| !self.folders.contains(*f)) {
            self.folders.insert(folder.to_owned());
        }
    }

    /// Counts bytes of a file that was begun with [`PartOut::create`].
    pub const fn add_bytes(&mut self, bytes: u64) {
        self.record.bytes += bytes;
    }

    /// Counts an exported frame of the stream with this index.
    pub fn frame(&mut self, stream: usize) {
        self.record.frames[stream] += 1;
    }

    /// Takes back that the set which was read last is exported: it is left out, which is counted.
    pub fn leave_out(&mut self) {
        self.record.sets = self.record.sets.saturating_sub(1);
        self.count("sets that were left out", 1);
    }

    /// Counts a frame that could not be exported.
    pub fn lose(&mut self, problem: String) {
        self.record.lose(problem);
    }

    /// Adds to a counter of the report.
    pub fn count(&mut self, counter: &str, n: u64) {
        if n > 0 {
            *self.record.counters.entry(counter.to_owned()).or_default() += n;
        }
    }

    /// Bytes of this part for [`Exporter::finish`], in the order of the parts. Kept on disk until then, in memory only
    /// while the part is worked on.
    pub const fn rows(&mut self) -> &mut Vec<u8> {
        &mut self.rows
    }

    /// Small value of this part for [`Exporter::finish`]; all of them are in memory then.
    pub const fn extra(&mut self) -> &mut Value {
        &mut self.record.extra
    }
}

impl Parts<'_> {
    /// Each part with its record, in the order of the plan.
    pub fn iter(&self) -> impl Iterator<Item = (&Part, &PartRecord)> {
        self.plan.iter().zip(&self.records)
    }

    /// The rows of each part of the dataset with index `source` in the order of the plan, read one by one.
    pub fn rows(&self, source: usize) -> impl Iterator<Item = Result<Vec<u8>>> {
        let of_source = self.plan.iter().enumerate().filter(move |(_, p)| p.source == source);
        of_source.map(|(i, _)| self.out.rows(i))
    }
}

/// Exports `datasets` into the folder `out`, which is new or holds an unfinished export of the same datasets with the
/// same options. An export that is complete already is left as it is.
///
/// `progress` is called with the progress so far and may end the export; running it again goes on from there.
///
/// # Errors
/// [`ErrorKind::AlreadyExists`] when `out` holds anything else or another export is writing to it,
/// [`ErrorKind::BadInput`] when the layout cannot hold the datasets, and what reading and writing say.
pub fn export(
    fs: &dyn Fs,
    exporter: &mut dyn Exporter,
    datasets: Vec<Dataset>,
    out: &Path,
    options: ExportOptions,
    progress: &mut dyn FnMut(ExportProgress) -> ControlFlow<()>,
) -> Result<ExportReport> {
    datasets.iter().try_for_each(|d| depthrig_recorder::check_outside(out, d.path()))?;
    let filters: Vec<String> =
        datasets.iter().filter_map(|d| d.filter().map(|f| f.name().to_owned())).collect();
    let mut sources = Vec::new();
    for dataset in datasets {
        sources.extend(Source::all_of(&dataset, exporter.episodes())?);
    }
    let plan = exporter.plan(&sources)?;
    let mut options_written = exporter.options();
    if let Some(written) = options_written.as_object_mut().filter(|_| !filters.is_empty()) {
        written.insert("filters".to_owned(), json!(filters));
    }
    let mut report = ExportReport {
        format: exporter.format().to_owned(),
        depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
        options: options_written,
        datasets: firsts(&sources).map(|s| s.identity(fs)).collect::<Result<_>>()?,
        streams: Vec::new(),
        sets: 0,
        frames: 0,
        files: 0,
        bytes: 0,
        losses: [
            plan.losses.clone(),
            firsts(&sources).filter_map(Source::left_out).collect(),
            firsts(&sources).filter_map(|s| beside_images(s, exporter)).collect(),
            filters,
        ]
        .concat(),
        counters: std::collections::BTreeMap::new(),
        lost: 0,
        problems: Vec::new(),
        ended: false,
        parts_resumed: 0,
        parts: plan.parts.len() as u64,
    };
    let state = json!({
        "format": report.format,
        "depthrig_version": report.depthrig_version,
        "options": report.options,
        "datasets": report.datasets,
    });
    let (out, found) = Output::open(fs, out, &state)?;
    if let FolderState::Complete(found) = found {
        out.clean()?;
        let complete = serde_json::from_value(found).map_err(|e| {
            let what = format!("the report in {} is not as depthrig wrote it", out.dir().display());
            Error::new(ErrorKind::Corrupt, what).with_source(e)
        });
        return complete.map(|done| ExportReport {
            parts_resumed: report.parts,
            parts: report.parts,
            ..done
        });
    }
    for folder in &plan.folders {
        out.folder(folder)?;
    }
    let exporter = &*exporter;
    let work = Work { exporter, sources: &sources, plan: &plan, out: &out };
    let Some((records, resumed)) = work.parts(options, progress)? else {
        report.ended = true;
        return Ok(report);
    };
    report.parts_resumed = resumed;
    let parts = Parts { out: &out, plan: &plan.parts, records };
    let before = out.written();
    exporter.finish(&sources, &parts, &out)?;
    let after = out.written();
    (report.files, report.bytes) = (after.0 - before.0, after.1 - before.1);
    for source in firsts(&sources) {
        for problem in source.problems() {
            report.lost += 1;
            report.problems.push(problem.clone());
        }
    }
    parts.records.iter().for_each(|record| report.add(record));
    report.streams = streams(&sources, &parts);
    for folder in &plan.folders {
        out.sync_dir(&out.dir().join(folder))?;
    }
    let json = serde_json::to_value(&report)
        .map_err(|e| Error::new(ErrorKind::BadInput, "the report cannot be written").with_source(e))?;
    out.close(&json)?;
    Ok(report)
}

/// One source of each dataset.
fn firsts(sources: &[Source]) -> impl Iterator<Item = &Source> {
    sources.iter().filter(|s| s.is_first())
}

/// The loss of a dataset with IMUs, whose samples no layout takes, or with signals that this one does not take.
fn beside_images(source: &Source, exporter: &dyn Exporter) -> Option<String> {
    let session = source.session();
    let units = session.motion.iter().map(|u| u.id.to_string());
    let signals = session.signals.iter().filter(|s| !exporter.takes(&s.id)).map(|s| s.id.to_string());
    let left: Vec<_> = units.chain(signals).collect();
    (!left.is_empty()).then(|| {
        let name = &session.name;
        let left = left.join(", ");
        format!("{name}: the samples of {left} are left out; `depthrig cat --stream` writes them")
    })
}

fn streams(sources: &[Source], parts: &Parts<'_>) -> Vec<StreamCount> {
    let mut counts = Vec::new();
    // Sources of one dataset follow each other.
    let mut end = 0;
    for dataset in sources.chunk_by(|_, next| !next.is_first()) {
        let range = end..end + dataset.len();
        end = range.end;
        let source = &dataset[0];
        for (stream, s) in source.session().streams.iter().enumerate() {
            let of = |counts: fn(&PartRecord) -> &[u64]| {
                let of_source = parts.iter().filter(|(p, _)| range.contains(&p.source));
                of_source.map(|(_, r)| counts(r).get(stream).copied().unwrap_or(0)).sum()
            };
            counts.push(StreamCount {
                dataset: source.session().name.clone(),
                stream: s.id.to_string(),
                frames: of(|r| &r.frames),
                missing: of(|r| &r.missing),
            });
        }
    }
    counts
}

struct Work<'a> {
    exporter: &'a dyn Exporter,
    sources: &'a [Source],
    plan: &'a Plan,
    out: &'a Output<'a>,
}

/// State shared by the threads.
struct Shared {
    next: AtomicUsize,
    stop: AtomicBool,
    failed: Mutex<Option<Error>>,
    records: Vec<Mutex<Option<PartRecord>>>,
}

impl Work<'_> {
    /// Does the parts that are not done yet; the record of each, and how many were done before. `None` when it was
    /// ended from outside.
    fn parts(
        &self,
        options: ExportOptions,
        progress: &mut dyn FnMut(ExportProgress) -> ControlFlow<()>,
    ) -> Result<Option<(Vec<PartRecord>, u64)>> {
        let parts = &self.plan.parts;
        let mut records = Vec::with_capacity(parts.len());
        let mut at = ExportProgress { sets: 0, total: 0 };
        let mut resumed = 0;
        for (i, part) in parts.iter().enumerate() {
            let record = self.out.part(i)?;
            at.total += part.sets.len() as u64;
            if record.is_some() {
                resumed += 1;
                at.sets += part.sets.len() as u64;
            }
            records.push(Mutex::new(record));
        }
        let shared = Shared {
            next: AtomicUsize::new(0),
            stop: AtomicBool::new(false),
            failed: Mutex::new(None),
            records,
        };
        let mut ended = progress(at).is_break();
        if !ended {
            let workers = options.workers.clamp(1, parts.len().max(1));
            // No room: `progress` may end the work before the next set but one.
            let (tick, ticks) = bounded(0);
            std::thread::scope(|scope| {
                for _ in 0..workers {
                    let tick = tick.clone();
                    let shared = &shared;
                    scope.spawn(move || self.worker(shared, &tick));
                }
                drop(tick);
                for () in ticks {
                    at.sets += 1;
                    if !ended && progress(at).is_break() {
                        ended = true;
                        shared.stop.store(true, Ordering::Relaxed);
                    }
                }
            });
        }
        if let Some(e) = shared.failed.into_inner().unwrap_or_else(PoisonError::into_inner)
            && !ended
        {
            return Err(e);
        }
        let records =
            shared.records.into_iter().map(|r| r.into_inner().unwrap_or_else(PoisonError::into_inner));
        Ok(records.collect::<Option<Vec<_>>>().map(|records| (records, resumed)))
    }

    fn worker(&self, shared: &Shared, tick: &Sender<()>) {
        let mut reader: Option<(usize, SetReader)> = None;
        loop {
            let i = shared.next.fetch_add(1, Ordering::Relaxed);
            let (Some(part), Some(record)) = (self.plan.parts.get(i), shared.records.get(i)) else { return };
            let slot = || lock(record);
            if shared.stop.load(Ordering::Relaxed) {
                return;
            }
            if slot().is_some() {
                continue;
            }
            if reader.as_ref().is_none_or(|(source, _)| *source != part.source) {
                reader = Some((part.source, self.sources[part.source].reader()));
            }
            let Some((_, reader)) = &mut reader else { return };
            match self.part(i, part, reader, shared, tick) {
                Ok(done) => *slot() = Some(done),
                Err(e) => {
                    shared.stop.store(true, Ordering::Relaxed);
                    // The first error is the reason; the other workers were only stopped.
                    lock(&shared.failed).get_or_insert(e);
                    return;
                }
            }
        }
    }

    fn part(
        &self,
        i: usize,
        part: &Part,
        reader: &mut SetReader,
        shared: &Shared,
        tick: &Sender<()>,
    ) -> Result<PartRecord> {
        let source = &self.sources[part.source];
        let streams = source.session().streams.len();
        let record =
            PartRecord { frames: vec![0; streams], missing: vec![0; streams], ..PartRecord::default() };
        let mut out = PartOut { out: self.out, folders: BTreeSet::new(), record, rows: Vec::new() };
        let mut sets = PartSets { reader, numbers: part.sets.clone(), stop: &shared.stop, tick };
        self.exporter.part(source, part, &mut sets, &mut out)?;
        for folder in &out.folders {
            self.out.sync_dir(&self.out.dir().join(folder))?;
        }
        self.out.mark(i, &out.record, &out.rows)?;
        Ok(out.record)
    }
}
