//! Refined depth for recordings by many machines: each segment becomes a dataset of its own, a piece.
//!
//! A piece is what one segment and the refiner determine, byte by byte: who makes it, when, and in which order does not
//! matter. It has its name once it is complete, with its account in it, and is then left alone. So any part of a run can
//! be made anywhere, and again. `merge` joins the pieces of a recording.

use super::{Form, RelabelOptions, RelabelReport, RelabelledStream, Step, make, pairs, plan};
use crate::RunPart;
use crate::store::{Place, Remote};
use depthrig_bus::HostTime;
use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::files::replace;
use depthrig_cdm::Precision;
use depthrig_cdm::stage::{Installed, RefineModel, Refiners};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Dataset, Error, ErrorKind, Result, SESSION_FILE};
use serde::{Deserialize, Serialize};
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

mod sources;

use sources::{Listed, Segment, list};

/// Version of the accounts, and of the rules that make a piece of a segment.
const FORMAT: u32 = 1;
/// The arguments of a run, beside its pieces.
const RUN_FILE: &str = "relabel.json";
const OTHER_FOLDER: &str = "give this run another folder";
/// The account of a piece, in it.
const ACCOUNT_FILE: &str = "account.json";

/// A part of a run.
#[derive(Debug, Clone)]
pub struct Pieces {
    /// A dataset, or a folder of datasets.
    pub input: Place,
    /// Where the pieces go.
    pub out: Place,
    /// This part: of the segments of all datasets, in the order of their names.
    pub part: RunPart,
    /// Folder for copies of what lies in buckets.
    pub scratch: PathBuf,
}

/// Source of a piece.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PieceSource {
    /// The dataset, by its folder.
    pub dataset: String,
    /// The segment, by its file.
    pub segment: String,
    /// Bytes of that file.
    pub bytes: u64,
    /// CRC-32 of the session as text.
    pub session_crc32: u32,
}

/// Account of a piece: `account.json` in its folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PieceAccount {
    /// Version of this account.
    pub format: u32,
    /// Its source.
    pub source: PieceSource,
    /// Its sets.
    pub sets: u64,
    /// Bytes of its segment.
    pub bytes: u64,
    /// Its refined streams.
    pub streams: Vec<RelabelledStream>,
    /// Sets and images of the source that could not be read.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
}

/// A segment or a dataset that was left out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SkippedPiece {
    /// The dataset.
    pub dataset: String,
    /// The segment; `None` for all of the dataset.
    pub segment: Option<String>,
    /// The reason.
    pub why: String,
}

/// Account of the work.
#[derive(Debug, Clone, Default, Serialize)]
pub struct PiecesReport {
    /// Where the pieces are.
    pub out: String,
    /// Pieces of this part, without those that were skipped.
    pub pieces: u64,
    /// Pieces of this part that were there before.
    pub pieces_found: u64,
    /// Pieces of this part that are missing at the end.
    pub pieces_missing: u64,
    /// Segments and datasets that were left out, and why.
    pub skipped: Vec<SkippedPiece>,
    /// Sets of all pieces of this part.
    pub sets: u64,
    /// Bytes of their segments.
    pub bytes: u64,
    /// Their refined streams, added up by name.
    pub streams: Vec<RelabelledStream>,
    /// Sets and images of their sources that could not be read.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Frames refined now.
    pub frames: u64,
    /// Time on the clock, seconds.
    pub seconds: f64,
    /// CPU time of the process, seconds.
    pub cpu_seconds: f64,
    /// Frames for each CPU second; 0 when none was refined.
    pub frames_per_core_second: f64,
}

/// Called with the name of a piece, the step, how far it is and of how much; may end the work.
pub type PiecesProgress<'a> = &'a mut dyn FnMut(&str, Step, u64, u64) -> ControlFlow<()>;

/// Result for a piece.
enum Outcome {
    Found(PieceAccount),
    Made(PieceAccount),
    Skipped(String),
    Ended,
}

/// Makes the pieces of a part that are missing.
///
/// # Errors
/// [`ErrorKind::BadInput`] for an input without a dataset, a refiner that cannot be created, and when
/// the pieces that are there are of other arguments or of another state of their source; [`ErrorKind::InUse`] when another
/// process makes the same piece; and errors of reading and writing. What was made before stays, and a later run goes on.
pub fn relabel_pieces(
    run: &Pieces,
    options: &RelabelOptions,
    progress: PiecesProgress<'_>,
) -> Result<PiecesReport> {
    let refiners = Installed::new(options.cdm.clone());
    let work = Work { run, options, refiners: &refiners };
    let start = HostTime::now();
    let cpu = process_cpu_ns();
    let listed = list(&run.input, &run.scratch)?;
    if let (Place::Local(out), Place::Local(input)) = (&run.out, &run.input) {
        depthrig_recorder::check_outside(out, input)?;
    }
    work.run.out.agrees_on(RUN_FILE, &work.arguments()?, OTHER_FOLDER)?;
    let mut report = PiecesReport { out: run.out.to_string(), ..PiecesReport::default() };
    let units = listed.iter().flat_map(Listed::units);
    let mine = units.enumerate().filter(|(i, _)| run.part.has(*i as u64)).map(|(_, unit)| unit);
    let mut is_ended = false;
    for unit in mine {
        report.pieces += 1;
        let outcome = match unit {
            _ if is_ended => Outcome::Ended,
            Ok(segment) => work.piece(&segment, progress)?,
            Err(why) => Outcome::Skipped(why.why.clone()),
        };
        match outcome {
            Outcome::Found(account) => {
                report.pieces_found += 1;
                report.add(account);
            }
            Outcome::Made(account) => {
                report.frames += account.streams.iter().map(|s| s.frames).sum::<u64>();
                report.add(account);
            }
            Outcome::Skipped(why) => {
                report.pieces -= 1;
                report.skipped.push(unit_of(unit, why));
            }
            Outcome::Ended => {
                is_ended = true;
                report.pieces_missing += 1;
            }
        }
    }
    report.seconds = start.elapsed().as_secs_f64();
    report.cpu_seconds = (process_cpu_ns() - cpu) as f64 * 1e-9;
    if report.frames > 0 && report.cpu_seconds > 0.0 {
        report.frames_per_core_second = report.frames as f64 / report.cpu_seconds;
    }
    Ok(report)
}

/// The name of something that was skipped: a segment, or the dataset that has none that can be used.
fn unit_of(unit: Result<Segment<'_>, &SkippedPiece>, why: String) -> SkippedPiece {
    match unit {
        Ok(segment) => {
            SkippedPiece { dataset: segment.listed.name.clone(), segment: Some(segment.file.clone()), why }
        }
        Err(skipped) => skipped.clone(),
    }
}

impl PiecesReport {
    fn add(&mut self, account: PieceAccount) {
        self.sets += account.sets;
        self.bytes += account.bytes;
        self.lost += account.lost;
        let room = crate::report::MAX_PROBLEMS.saturating_sub(self.problems.len());
        self.problems.extend(account.problems.into_iter().take(room));
        for new in account.streams {
            let same = |s: &&mut RelabelledStream| {
                (&s.stream, &s.engine, &s.model) == (&new.stream, &new.engine, &new.model)
            };
            match self.streams.iter_mut().find(same) {
                Some(sum) => {
                    sum.frames += new.frames;
                    sum.unpaired += new.unpaired;
                    sum.pixels += new.pixels;
                    sum.holes_before += new.holes_before;
                    sum.holes += new.holes;
                }
                None => self.streams.push(new),
            }
        }
    }
}

struct Work<'a> {
    run: &'a Pieces,
    options: &'a RelabelOptions,
    refiners: &'a dyn Refiners,
}

/// The arguments of a run: the same bytes from every part.
#[derive(Serialize)]
struct Run<'a> {
    format: u32,
    depthrig_version: &'a str,
    engine: String,
    model: Option<String>,
    device: &'a str,
    /// Other than `fp32`, which files of before do not name.
    #[serde(skip_serializing_if = "Option::is_none")]
    precision: Option<&'static str>,
    input_size: Option<u32>,
    is_aligned: bool,
    fill_reach: f64,
}

impl Work<'_> {
    /// The arguments, as they lie beside the pieces.
    fn arguments(&self) -> Result<Vec<u8>> {
        let refine = &self.options.refine;
        let run = Run {
            format: FORMAT,
            depthrig_version: env!("CARGO_PKG_VERSION"),
            engine: format!("{:?}", refine.engine).to_lowercase(),
            // Folders differ from computer to computer; each frame names the hash.
            model: refine.model.as_ref().map(|model| match model {
                RefineModel::Installed(name) => name.clone(),
                RefineModel::File(path) => {
                    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
                }
            }),
            device: &refine.device,
            precision: (refine.precision != Precision::Fp32).then_some(refine.precision.name()),
            input_size: refine.input_size,
            is_aligned: refine.is_aligned,
            fill_reach: refine.fill_reach,
        };
        json(&run)
    }

    /// Writes the arguments beside the pieces; of a run with a refiner that works.
    fn record(&self) -> Result<()> {
        if let Place::Local(folder) = &self.run.out {
            depthrig_bus::umask::create_dir_all(folder)
                .map_err(|e| Error::io("create the folder", folder, e))?;
        }
        self.run.out.agree_on(RUN_FILE, &self.arguments()?, OTHER_FOLDER)
    }

    fn piece(&self, segment: &Segment<'_>, progress: PiecesProgress<'_>) -> Result<Outcome> {
        let name = segment.piece();
        let out = self.run.out.at(&name);
        let path = match &out {
            Place::Local(path) => path.clone(),
            Place::Remote(_) => self.run.scratch.join("pieces").join(&name),
        };
        let work = super::work_folder(&path)?;
        if let Some(account) = found(&out, &segment.source())? {
            tidy(&work);
            return Ok(Outcome::Found(account));
        }
        if let Err(e) = pairs(segment.listed.dataset.session()) {
            return Ok(Outcome::Skipped(e.to_string()));
        }
        let planned = plan(self.refiners, segment.listed.dataset.session(), self.options)?;
        self.record()?;
        let fetched = segment.fetch()?;
        let sets = fetched.dataset.set_reader()?;
        if sets.times().is_empty() {
            let why = sets.problems().first().cloned();
            return Ok(Outcome::Skipped(why.unwrap_or_else(|| "it holds no set".to_owned())));
        }
        drop(sets);
        let Some(_lock) = lock(&work)? else {
            let what =
                format!("{}: another process makes this piece; give each its own --shard", work.display());
            return Err(Error::new(ErrorKind::InUse, what));
        };
        // Another process may have made it meanwhile.
        if let Some(account) = found(&out, &segment.source())? {
            drop(std::fs::remove_dir_all(&work));
            return Ok(Outcome::Found(account));
        }
        let mut made = None;
        let mut finish = |folder: &Path, report: &RelabelReport| {
            let account = PieceAccount {
                format: FORMAT,
                source: segment.source(),
                sets: report.sets,
                bytes: report.bytes,
                streams: report.streams.clone(),
                lost: report.lost,
                problems: report.problems.clone(),
            };
            let file = folder.join(ACCOUNT_FILE);
            replace(&file, &json(&account)?).map_err(|e| Error::io("write", &file, e))?;
            made = Some(account);
            Ok(())
        };
        let done = make(
            self.refiners,
            planned,
            &fetched.dataset,
            &path,
            self.options,
            Form::Piece,
            &mut finish,
            &mut |step, done, total| progress(&name, step, done, total),
        );
        match done {
            Ok(_) => {}
            // The segment cannot be refined, such as one without calibration; others can.
            Err(e) if e.kind() == ErrorKind::BadInput => {
                drop(std::fs::remove_dir_all(&work));
                return Ok(Outcome::Skipped(e.to_string()));
            }
            Err(e) => return Err(e),
        }
        let Some(account) = made else { return Ok(Outcome::Ended) };
        if let Place::Remote(remote) = &out {
            put(&path, remote)?;
            std::fs::remove_dir_all(&path).map_err(|e| Error::io("remove", &path, e))?;
        }
        Ok(Outcome::Made(account))
    }
}

/// The account of a piece that is there, after a look at what it was made of.
fn found(out: &Place, source: &PieceSource) -> Result<Option<PieceAccount>> {
    let Some(text) = out.read(ACCOUNT_FILE)? else {
        return match out {
            Place::Local(path) if path.symlink_metadata().is_ok() => Err(Error::new(
                ErrorKind::BadInput,
                format!("{} is there and is not a piece; choose another folder", path.display()),
            )),
            _ => Ok(None),
        };
    };
    let account: PieceAccount = serde_json::from_slice(&text).map_err(|e| {
        let what = format!("{out}/{ACCOUNT_FILE} is not as it was written; remove {out}");
        Error::new(ErrorKind::Corrupt, what).with_source(e)
    })?;
    if account.source != *source {
        let what = format!(
            "{out} was made of another state of {}/{}; remove it, or choose another folder",
            source.dataset, source.segment
        );
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    Ok(Some(account))
}

/// Locks the folder for the work on a piece; `None` when another process has it.
fn lock(work: &Path) -> Result<Option<Box<dyn Send + Sync>>> {
    depthrig_bus::umask::create_dir_all(work).map_err(|e| Error::io("create the folder", work, e))?;
    match RealFs.lock(work) {
        Ok(lock) => Ok(Some(lock)),
        Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(None),
        Err(e) => Err(Error::io("lock the folder", work, e)),
    }
}

/// Removes what a process has left that was killed between the last two steps: naming a piece, and removing this folder.
fn tidy(work: &Path) {
    if work.is_dir() && RealFs.lock(work).is_ok() {
        drop(std::fs::remove_dir_all(work));
    }
}

/// Puts a piece; its account last, because that says that the piece is complete.
fn put(path: &Path, remote: &Remote) -> Result<()> {
    let entries = RealFs.read_dir(path).map_err(|e| Error::reading("list", path, e))?;
    let mut names: Vec<_> = entries.into_iter().filter(|e| !e.is_dir).map(|e| e.name).collect();
    names.sort_by_key(|name| (name == ACCOUNT_FILE, name == SESSION_FILE, name.clone()));
    for name in names {
        remote.put_file(&path.join(&name), &name)?;
    }
    Ok(())
}

fn json(value: &impl Serialize) -> Result<Vec<u8>> {
    let mut text = serde_json::to_vec_pretty(value).map_err(|e| {
        Error::new(ErrorKind::BadInput, "an account cannot be written as JSON").with_source(e)
    })?;
    text.push(b'\n');
    Ok(text)
}

/// A segment as a dataset, with the copy that is removed after the work.
struct Fetched {
    dataset: Dataset,
    copy: Option<PathBuf>,
}

impl Drop for Fetched {
    fn drop(&mut self) {
        if let Some(copy) = &self.copy {
            drop(std::fs::remove_file(copy));
        }
    }
}
