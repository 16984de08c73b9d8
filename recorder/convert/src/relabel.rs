//! Refined depth for a dataset that was recorded without, in a copy of it.
//!
//! First everything is refined, on several threads, into files beside the new dataset: this takes hours, and a run that
//! was killed goes on with these files. Then the copy is recorded from the dataset and these files, verified, and gets
//! its name; the files go. The source is only read, its images are kept as they are stored, and OUT is complete or
//! absent.

use crate::{ExportOptions, export, import};
use depthrig_bus::files::folder_of;
use depthrig_bus::{StreamId, StreamName};
use depthrig_cdm::stage::{CdmConfig, RefineConfig};
use depthrig_cdm::stage::{Installed, Plan, REFINED, Refiners};
use depthrig_cdm::{Description, Refiner};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{
    ColorCodec, Compression, Dataset, DepthCodec, Error, ErrorKind, PixelMode, RecorderOptions, Result,
    Session, VerifyReport,
};
use refine::Refine;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use write::Write;

mod pieces;
mod refine;
mod write;

pub use pieces::{PieceAccount, PieceSource, Pieces, PiecesReport, SkippedPiece, relabel_pieces};

/// How a dataset is given refined depth.
#[derive(Debug, Clone, PartialEq)]
pub struct RelabelOptions {
    /// The refiner, for every camera.
    pub refine: RefineConfig,
    /// Where models and libraries are.
    pub cdm: CdmConfig,
    /// Images that are worked on at once.
    pub workers: usize,
    /// Threads of each refiner.
    pub threads: usize,
}

/// The step in progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Images are refined.
    Refine,
    /// The new dataset is written.
    Write,
}

/// Called with the step, how far it is and of how much; may end the work.
pub type RelabelProgress<'a> = &'a mut dyn FnMut(Step, u64, u64) -> ControlFlow<()>;

/// Result of relabelling.
#[derive(Debug, Serialize)]
pub struct RelabelReport {
    /// The new dataset; it is not there when `ended`.
    pub path: PathBuf,
    /// Each new stream with its engine.
    pub streams: Vec<RelabelledStream>,
    /// Sets of the new dataset.
    pub sets: u64,
    /// Bytes of the new dataset.
    pub bytes: u64,
    /// Parts that an earlier run had refined.
    pub parts_resumed: u64,
    /// Sets and images of the source that could not be read.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Whether it was ended from outside; run again, it goes on.
    pub ended: bool,
    /// Verification of the new dataset.
    pub verified: Option<VerifyReport>,
}

/// A stream of refined depth.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RelabelledStream {
    /// Its name.
    pub stream: String,
    /// The engine that computed it.
    pub engine: String,
    /// The model, if there was one.
    pub model: String,
    /// A remark on the engine, where it is not the expected one.
    pub note: Option<String>,
    /// Frames in the new dataset.
    pub frames: u64,
    /// Sets that lack colour or depth, and therefore have none.
    pub unpaired: u64,
    /// Pixels of all refined images.
    pub pixels: u64,
    /// Pixels that had no depth in the view of colour.
    pub holes_before: u64,
    /// Pixels that have none now.
    pub holes: u64,
}

/// Form of the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    /// A copy of it.
    Whole,
    /// A dataset of one of its segments, with bytes that depend on that and the refiner alone.
    Piece,
}

/// A camera that gets refined depth.
struct Camera {
    /// Indices of its streams in the session.
    color: usize,
    depth: usize,
    id: StreamId,
    /// Index of its engine.
    engine: usize,
    /// Why this engine and not the one that one would expect.
    note: Option<String>,
}

/// A refiner, as often as there are threads.
struct Engine {
    plan: Plan,
    note: Option<String>,
    description: Description,
    free: Mutex<Vec<Box<dyn Refiner>>>,
}

/// Gives `dataset` refined depth in a copy of it, the new folder `out`. Intermediate files are in `OUT.relabel`.
///
/// # Errors
/// [`ErrorKind::BadInput`] when no camera has colour and depth, when there is refined depth already, when depth has no
/// mapping into the view of colour, and when the refiner cannot be created or fails; [`ErrorKind::AlreadyExists`] when
/// `out` is there or the remains of another run do not fit; and errors of reading and writing.
pub fn relabel(
    dataset: &Dataset,
    out: &Path,
    options: &RelabelOptions,
    progress: RelabelProgress<'_>,
) -> Result<RelabelReport> {
    let refiners = Installed::new(options.cdm.clone());
    relabel_with(&refiners, dataset, out, options, progress)
}

/// The same with refiners from elsewhere.
///
/// # Errors
/// As [`relabel`].
pub fn relabel_with(
    refiners: &dyn Refiners,
    dataset: &Dataset,
    out: &Path,
    options: &RelabelOptions,
    progress: RelabelProgress<'_>,
) -> Result<RelabelReport> {
    depthrig_recorder::check_outside(out, dataset.path())?;
    if out.symlink_metadata().is_ok() {
        let message = format!("{} is there already; choose another name", out.display());
        return Err(Error::new(ErrorKind::AlreadyExists, message));
    }
    let planned = plan(refiners, dataset.session(), options)?;
    make(refiners, planned, dataset, out, options, Form::Whole, &mut |_, _| Ok(()), progress)
}

/// Called with the new dataset, which has a name of its own yet, before it gets that of `out`.
type Finish<'a> = &'a mut dyn FnMut(&Path, &RelabelReport) -> Result<()>;

#[allow(clippy::too_many_arguments)] // two callers, in this module
fn make(
    refiners: &dyn Refiners,
    (cameras, engines): (Vec<Camera>, Vec<Engine>),
    dataset: &Dataset,
    out: &Path,
    options: &RelabelOptions,
    form: Form,
    finish: Finish<'_>,
    progress: RelabelProgress<'_>,
) -> Result<RelabelReport> {
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let work = work_folder(out)?;
    let mut refine = Refine { refiners, cameras: &cameras, engines: &engines, options };
    let exported = export(
        &*fs,
        &mut refine,
        vec![dataset.clone()],
        &work.join("refined"),
        ExportOptions { workers: options.workers.max(1) },
        &mut |p| progress(Step::Refine, p.sets, p.total),
    )?;
    let mut report = RelabelReport {
        path: out.to_owned(),
        streams: streams(&cameras, &engines, &exported.counters),
        sets: 0,
        bytes: 0,
        parts_resumed: exported.parts_resumed,
        lost: 0,
        problems: Vec::new(),
        ended: exported.ended,
        verified: None,
    };
    if exported.ended {
        return Ok(report);
    }
    // The unfinished copy of a killed run is not continued: copying takes as long as reading.
    let copy = work.join("dataset");
    let remove = |dir: &Path| {
        std::fs::remove_dir_all(dir)
            .or_else(|e| if e.kind() == std::io::ErrorKind::NotFound { Ok(()) } else { Err(e) })
    };
    let failed = |what: &str, path: &Path, e: std::io::Error| {
        Error::new(ErrorKind::Io, format!("cannot {what} {}: {e}", path.display())).with_source(e)
    };
    remove(&copy).map_err(|e| failed("remove", &copy, e))?;
    let mut write = Write::new(dataset, out, &work.join("refined"), &cameras, &engines, form)?;
    let recorder = recorder_options(dataset, form)?;
    let copied =
        import(&mut write, Arc::clone(&fs), &copy, recorder, &mut |p| progress(Step::Write, p.done, p.total));
    let copied = copied?;
    report.lost = copied.facts.lost;
    report.problems.clone_from(&copied.facts.problems);
    if copied.ended {
        report.ended = true;
        return Ok(report);
    }
    (report.sets, report.bytes) = (copied.summary.sets.recorded, copied.summary.bytes);
    for (stream, frames) in report.streams.iter_mut().zip(write.written()) {
        stream.frames = *frames;
    }
    if let Some(broken) = copied.verified.broken() {
        let message = format!("the copy in {} does not verify: {}", copy.display(), broken.message);
        return Err(Error::new(ErrorKind::Corrupt, message));
    }
    // Data that the source lacks, the copy lacks too.
    for lost in copied.verified.lost() {
        report.lost += 1;
        report.problems.push(lost.message.clone());
    }
    report.verified = Some(copied.verified);
    finish(&copy, &report)?;
    fs.rename(&copy, out).map_err(|e| failed("rename", &copy, e))?;
    let parent = folder_of(out);
    fs.sync_dir(parent).map_err(|e| failed("sync the folder", parent, e))?;
    remove(&work).map_err(|e| failed("remove", &work, e))?;
    Ok(report)
}

/// `OUT.relabel`.
fn work_folder(out: &Path) -> Result<PathBuf> {
    let Some(name) = out.file_name() else {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("{} is not a valid name for a new dataset", out.display()),
        ));
    };
    let mut name = name.to_os_string();
    name.push(".relabel");
    Ok(out.with_file_name(name))
}

/// Streams of a camera that can get refined depth.
struct Pair {
    /// Indices in the session.
    color: usize,
    depth: usize,
    /// The new stream.
    id: StreamId,
}

/// The cameras of a dataset that can get refined depth; at least one.
fn pairs(session: &Session) -> Result<Vec<Pair>> {
    let bad = |message: String| Error::new(ErrorKind::BadInput, message);
    let find = |camera: &str, stream: &str| {
        let is = |s: &depthrig_recorder::StreamRecord| {
            s.id.camera.as_str() == camera && s.id.stream.as_str() == stream
        };
        session.streams.iter().position(is)
    };
    let mut pairs: Vec<Pair> = Vec::new();
    for (color, record) in session.streams.iter().enumerate().filter(|(_, s)| s.id.stream.as_str() == "color")
    {
        let name = record.id.camera.as_str();
        let Some(depth) = find(name, "depth") else { continue };
        if find(name, REFINED).is_some() {
            return Err(bad(format!(
                "{name}/{REFINED} is in the dataset already; relabel its source dataset"
            )));
        }
        let stream = StreamName::new(REFINED).map_err(|e| bad(e.to_string()))?;
        let id = StreamId { camera: record.id.camera.clone(), stream };
        pairs.push(Pair { color, depth, id });
    }
    if pairs.is_empty() {
        let names: Vec<_> = session.streams.iter().map(|s| s.id.to_string()).collect();
        return Err(bad(format!(
            "no camera of the dataset has both color and depth; it has {}",
            names.join(", ")
        )));
    }
    Ok(pairs)
}

/// The cameras that get refined depth, each with its engine.
fn plan(
    refiners: &dyn Refiners,
    session: &Session,
    options: &RelabelOptions,
) -> Result<(Vec<Camera>, Vec<Engine>)> {
    let mut cameras: Vec<Camera> = Vec::new();
    let mut engines: Vec<Engine> = Vec::new();
    for Pair { color, depth, id } in pairs(session)? {
        let plan = refiners.plan(&options.refine, &session.streams[depth].model);
        let note = plan.note.clone();
        let engine = if let Some(at) = engines.iter().position(|e| e.plan.is_as(&plan)) {
            at
        } else {
            engines.push(Engine::open(refiners, plan, options)?);
            engines.len() - 1
        };
        cameras.push(Camera { color, depth, id, engine, note });
    }
    Ok((cameras, engines))
}

impl Engine {
    fn open(refiners: &dyn Refiners, plan: Plan, options: &RelabelOptions) -> Result<Self> {
        let opened = refiners.open(&plan, options.threads.max(1)).map_err(|e| cannot(&plan, &e))?;
        let description = opened.refiner.describe().clone();
        Ok(Self { plan, note: opened.note, description, free: Mutex::new(vec![opened.refiner]) })
    }
}

fn cannot(plan: &Plan, e: &depthrig_cdm::Error) -> Error {
    Error::new(ErrorKind::BadInput, format!("{}: {e}", plan.describe())).with_source(e.clone())
}

fn streams(
    cameras: &[Camera],
    engines: &[Engine],
    counters: &BTreeMap<String, u64>,
) -> Vec<RelabelledStream> {
    let of = |camera: &Camera| {
        let engine = &engines[camera.engine];
        let count = |what| counters.get(&refine::counter(camera, what)).copied().unwrap_or(0);
        RelabelledStream {
            stream: camera.id.to_string(),
            engine: engine.description.engine.clone(),
            model: engine.description.model.clone(),
            note: engine.note.clone().or_else(|| camera.note.clone()),
            frames: 0,
            unpaired: count(refine::UNPAIRED),
            pixels: count(refine::PIXELS),
            holes_before: count(refine::HOLES_BEFORE),
            holes: count(refine::HOLES),
        }
    };
    cameras.iter().map(of).collect()
}

/// Images are stored as they are in the source; the first readable set shows how.
fn recorder_options(dataset: &Dataset, form: Form) -> Result<RecorderOptions> {
    let mut reader = dataset.set_reader()?;
    let numbers = 0..reader.times().len();
    let first = numbers.into_iter().find_map(|n| reader.read(n, PixelMode::Stored).ok());
    let codecs: Vec<&str> = first.iter().flat_map(|s| s.frames.iter().map(|f| f.codec)).collect();
    let mut options = RecorderOptions { compression: Compression::Zstd1, ..RecorderOptions::default() };
    if form == Form::Piece {
        // What is written each second would depend on how fast this computer is. An unfinished piece is begun anew anyway.
        options.sync_interval_ns = i64::MAX;
        (options.segment_max_bytes, options.segment_max_ns) = (u64::MAX, i64::MAX);
    }
    options.color = match () {
        () if codecs.contains(&"jpeg") => ColorCodec::Jpeg,
        () if codecs.contains(&"png") => ColorCodec::Png,
        () => ColorCodec::Raw,
    };
    options.depth = if codecs.contains(&"rank") { DepthCodec::Rank } else { DepthCodec::Zstd };
    Ok(options)
}
