//! Single frames of a dataset: listed, or written as image files with `frames.csv` beside them.
//!
//! One set is in memory at a time, so the length of the dataset does not matter. Nothing is ever overwritten:
//! the folder is new or empty, and while it grows the list is named `frames.csv.part`.

use crate::dataset::{Dataset, DatasetFrame, DatasetSet, PixelMode, SetReader};
use crate::fs::{self, Fs};
use crate::select::{Moment, SetSpan, by_id, last_id, nearest};
use crate::still::{StillFormat, still};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{PixelFormat, StreamId};
use growing::GrowingFile;
use serde::Serialize;
use std::borrow::Cow;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};

mod growing;
mod motion;
mod row;
mod samples;
mod signal;
pub use motion::MotionRow;
pub use row::FrameRow;
pub use samples::{SampleForm, SampleRow, export_samples, list_samples, sampled};
pub use signal::SignalRow;

/// The list beside the images.
pub const FRAMES_FILE: &str = "frames.csv";

/// Which sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SetChoice {
    /// Those of a span.
    Span(SetSpan),
    /// The one of this id.
    Id(u64),
    /// The one nearest to a moment.
    Nearest(Moment),
}

impl Default for SetChoice {
    fn default() -> Self {
        Self::Span(SetSpan::default())
    }
}

impl SetChoice {
    /// The numbers of the chosen sets.
    fn numbers(self, sets: &mut SetReader) -> Result<Range<usize>> {
        Ok(match self {
            Self::Span(span) => span.numbers(sets)?,
            Self::Id(id) => {
                let n = by_id(sets, id)?;
                n..n + 1
            }
            Self::Nearest(moment) => {
                let n = nearest(sets, moment)?;
                n..n + 1
            }
        })
    }
}

/// Which frames.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct FrameChoice {
    /// Of which sets.
    pub sets: SetChoice,
    /// Every so many of these; 0 and 1 are all.
    pub every: usize,
    /// Of which streams; empty is all.
    pub streams: Vec<StreamId>,
}

/// Counts of what was listed or written.
#[derive(Debug, Clone, Default, Serialize)]
#[non_exhaustive]
pub struct FramesDone {
    /// Sets read.
    pub sets: u64,
    /// Frames listed or written.
    pub frames: u64,
    /// Bytes of the image files.
    pub bytes: u64,
    /// Sets and frames that could not be read.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Whether it was ended from outside before all was done.
    pub ended: bool,
}

/// Lines of [`FramesDone::problems`] that are kept.
const MAX_PROBLEMS: usize = 100;

impl FramesDone {
    fn lose(&mut self, problem: String) {
        self.lost += 1;
        if self.problems.len() < MAX_PROBLEMS {
            self.problems.push(problem);
        }
    }
}

/// Calls `each` with a row per chosen frame, in the order of the sets and in a set of the streams. No image is
/// read.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a stream that is not there or a choice without a set, [`ErrorKind::NotFound`] for
/// a set that is not there, [`ErrorKind::Io`]. A set that cannot be read is in [`FramesDone::problems`].
pub fn list_frames(
    dataset: &Dataset,
    choice: &FrameChoice,
    each: &mut dyn FnMut(FrameRow) -> ControlFlow<()>,
) -> Result<FramesDone> {
    let mut chosen = Chosen::new(dataset, choice)?;
    let mut done = FramesDone::default();
    while let Some(set) = chosen.next(PixelMode::None) {
        let Some(set) = set.or_lost(&mut done)? else { continue };
        done.sets += 1;
        for frame in chosen.frames(&set) {
            done.frames += 1;
            if each(chosen.row(&set, frame, None)).is_break() {
                done.ended = true;
                return Ok(done);
            }
        }
    }
    Ok(done)
}

/// Writes a file per chosen frame below the new folder `out`: `CAM/STREAM/SET.png` (or `.npy`, `.jpg`), and
/// `frames.csv`. Without `form` a stream's images are PNG where PNG holds every bit, else NPY.
///
/// `progress` is called with the sets done and the sets in all, and may end the export.
///
/// # Errors
/// As [`list_frames`]; [`ErrorKind::BadInput`] also when `form` cannot hold the images of a chosen stream;
/// [`ErrorKind::AlreadyExists`] when `out` holds anything; and as writing does.
pub fn export_frames(
    fs: &dyn Fs,
    dataset: &Dataset,
    choice: &FrameChoice,
    form: Option<StillFormat>,
    out: &Path,
    progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
) -> Result<FramesDone> {
    crate::check_outside(out, dataset.path())?;
    let mut chosen = Chosen::new(dataset, choice)?;
    chosen.check_form(form)?;
    let mut folder = Folder::create(fs, out)?;
    folder.line(&row::COLUMNS.join(","))?;
    let total = chosen.len() as u64;
    let mut done = FramesDone::default();
    let mut created = vec![false; dataset.session().streams.len()];
    let mut at = 0;
    while let Some(set) = chosen.next(PixelMode::Stored) {
        if progress(at, total).is_break() {
            done.ended = true;
            return folder.leave(done);
        }
        at += 1;
        let Some(set) = set.or_lost(&mut done)? else { continue };
        done.sets += 1;
        let frames: Vec<_> = chosen.frames(&set).collect();
        for (frame, file) in frames.iter().zip(files(&frames, form)) {
            let (form, file) = match file {
                Ok(file) => file,
                Err(e) => {
                    done.lose(format!("set {}: {e}", set.id));
                    continue;
                }
            };
            let name = chosen.file_name(&set, frame, form);
            if !std::mem::replace(&mut created[frame.stream], true) {
                folder.make_parent(&name)?;
            }
            folder.write(&name, &file)?;
            folder.line(&chosen.row(&set, frame, Some(name)).csv())?;
            done.frames += 1;
            done.bytes += file.len() as u64;
        }
    }
    progress(total, total).is_break();
    folder.finish()?;
    Ok(done)
}

/// Each frame's file, made on all cores; a set's frames are independent of each other.
fn files<'a>(
    frames: &[&'a DatasetFrame],
    form: Option<StillFormat>,
) -> Vec<Result<(StillFormat, Cow<'a, [u8]>)>> {
    let one = move |f: &&'a DatasetFrame| {
        let form = form.or_else(|| Some(StillFormat::of(f.header.pixel_format()?)));
        let form = form.unwrap_or(StillFormat::Npy);
        Ok((form, still(f, form)?))
    };
    let workers = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let share = frames.len().div_ceil(workers).max(1);
    let (mine, others) = frames.split_at(share.min(frames.len()));
    std::thread::scope(|scope| {
        let others: Vec<_> = others
            .chunks(share)
            .map(|part| scope.spawn(move || part.iter().map(one).collect::<Vec<_>>()))
            .collect();
        let mut done: Vec<_> = mine.iter().map(one).collect();
        for thread in others {
            match thread.join() {
                Ok(part) => done.extend(part),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        done
    })
}

/// The chosen sets, read one after the other.
struct Chosen<'a> {
    dataset: &'a Dataset,
    sets: SetReader,
    numbers: std::iter::StepBy<Range<usize>>,
    /// Whether the stream of this index is wanted.
    streams: Vec<bool>,
    /// Digits of a set's id in file names, so that names sort as sets do.
    digits: usize,
    /// Segments that cannot be read, reported once.
    problems: Vec<String>,
}

/// The next set, or why it cannot be read.
enum Next {
    Set(Box<DatasetSet>),
    Lost(String),
    Failed(Error),
}

impl Next {
    fn or_lost(self, done: &mut FramesDone) -> Result<Option<Box<DatasetSet>>> {
        match self {
            Self::Set(set) => Ok(Some(set)),
            Self::Lost(what) => {
                done.lose(what);
                Ok(None)
            }
            Self::Failed(e) => Err(e),
        }
    }
}

impl<'a> Chosen<'a> {
    fn new(dataset: &'a Dataset, choice: &FrameChoice) -> Result<Self> {
        let known = &dataset.session().streams;
        for wanted in &choice.streams {
            if !known.iter().any(|s| s.id == *wanted) {
                let names: Vec<_> = known.iter().map(|s| s.id.to_string()).collect();
                let what = if sampled(dataset.session()).any(|id| id == wanted) {
                    format!("{wanted} is an IMU or a signal and has no images; ask for these by themselves")
                } else {
                    format!("there is no stream {wanted}; the dataset has {}", names.join(", "))
                };
                return Err(Error::new(ErrorKind::BadInput, what));
            }
        }
        let streams =
            known.iter().map(|s| choice.streams.is_empty() || choice.streams.contains(&s.id)).collect();
        let mut sets = dataset.set_reader()?;
        let numbers = choice.sets.numbers(&mut sets)?;
        // Ids increase, so the last one is the longest.
        let digits = last_id(&mut sets)?.to_string().len().max(6);
        let mut problems = sets.problems().to_vec();
        problems.reverse();
        Ok(Self { dataset, sets, numbers: numbers.step_by(choice.every.max(1)), streams, digits, problems })
    }

    fn len(&self) -> usize {
        self.numbers.len()
    }

    fn next(&mut self, mode: PixelMode) -> Option<Next> {
        if let Some(problem) = self.problems.pop() {
            return Some(Next::Lost(problem));
        }
        Some(match self.sets.read(self.numbers.next()?, mode) {
            Ok(set) => Next::Set(Box::new(set)),
            Err(e) if e.kind() == ErrorKind::Io => Next::Failed(e),
            Err(e) => Next::Lost(e.to_string()),
        })
    }

    fn frames<'s>(&self, set: &'s DatasetSet) -> impl Iterator<Item = &'s DatasetFrame> + use<'s> {
        let mut frames: Vec<_> =
            set.frames.iter().filter(|f| self.streams.get(f.stream) == Some(&true)).collect();
        frames.sort_by_key(|f| f.stream);
        frames.into_iter()
    }

    fn row(&self, set: &DatasetSet, frame: &DatasetFrame, file: Option<String>) -> FrameRow {
        let stream = &self.dataset.session().streams[frame.stream];
        FrameRow::new(stream.id.to_string(), set, frame, file)
    }

    fn file_name(&self, set: &DatasetSet, frame: &DatasetFrame, form: StillFormat) -> String {
        let id = &self.dataset.session().streams[frame.stream].id;
        let digits = self.digits;
        format!("{}/{}/{:0digits$}.{}", id.camera, id.stream, set.id, form.extension())
    }

    /// Refuses a form that cannot hold the images of a chosen stream, before anything is written.
    fn check_form(&mut self, form: Option<StillFormat>) -> Result<()> {
        let Some(form) = form else { return Ok(()) };
        let first = self.numbers.clone().find_map(|n| match self.sets.read(n, PixelMode::None) {
            Err(e) if e.kind() != ErrorKind::Io => None,
            read => Some(read),
        });
        let stored = first.transpose()?;
        for (i, s) in self.dataset.session().streams.iter().enumerate().filter(|(i, _)| self.streams[*i]) {
            let frame = stored.iter().flat_map(|set| &set.frames).find(|f| f.stream == i);
            let fits = match form {
                StillFormat::Npy => true,
                StillFormat::Png => StillFormat::of(s.format) == StillFormat::Png,
                // A camera may be missing in the first set: each later frame is looked at by itself.
                StillFormat::Jpeg => frame.map_or_else(
                    || matches!(s.format, PixelFormat::Rgb8 | PixelFormat::Bgr8 | PixelFormat::Mjpeg),
                    |f| matches!(f.codec, "jpeg" | "mjpeg"),
                ),
            };
            if !fits {
                let what = match form {
                    StillFormat::Jpeg => format!(
                        "{} is not stored as JPEG; choose other streams, or PNG or NPY instead of JPEG",
                        s.id
                    ),
                    _ => format!(
                        "{} has {} pixels, which a PNG cannot hold; choose other streams, or NPY instead of PNG",
                        s.id,
                        s.format.name()
                    ),
                };
                return Err(Error::new(ErrorKind::BadInput, what));
            }
        }
        Ok(())
    }
}

/// Creates the folder, or finds it empty.
fn new_folder(fs: &dyn Fs, dir: &Path) -> Result<()> {
    match fs.read_dir(dir) {
        Ok(entries) => {
            if let Some(first) = entries.first() {
                let what =
                    format!("{} is not empty (it holds {}); choose a new folder", dir.display(), first.name);
                return Err(Error::new(ErrorKind::AlreadyExists, what));
            }
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            fs.create_dir_all(dir).map_err(|e| Error::io("create the folder", dir, e))?;
        }
        Err(e) => return Err(Error::io("use the folder", dir, e)),
    }
    Ok(())
}

/// Creates the folder that `path` lies in.
fn make_folder_of(fs: &dyn Fs, path: &Path) -> Result<()> {
    let dir = path.parent().unwrap_or(path);
    fs.create_dir_all(dir).map_err(|e| Error::io("create the folder", dir, e))
}

/// The folder being written.
struct Folder<'a> {
    fs: &'a dyn Fs,
    dir: PathBuf,
    list: GrowingFile<'a>,
}

impl<'a> Folder<'a> {
    fn create(fs: &'a dyn Fs, dir: &Path) -> Result<Self> {
        new_folder(fs, dir)?;
        let list = GrowingFile::create(fs, &dir.join(FRAMES_FILE))?;
        Ok(Self { fs, dir: dir.to_owned(), list })
    }

    fn make_parent(&self, name: &str) -> Result<()> {
        make_folder_of(self.fs, &self.dir.join(name))
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        let path = self.dir.join(name);
        let mut file = self.fs.create_new(&path).map_err(|e| Error::io("create", &path, e))?;
        fs::write_all(&mut *file, bytes).map_err(|e| {
            // Half an image is worse than none. Where even that fails, the list does not name it.
            let _ = self.fs.remove_file(&path);
            Error::io("write", &path, e)
        })
    }

    fn line(&mut self, line: &str) -> Result<()> {
        self.list.put(line.as_bytes())?;
        self.list.put(b"\n")
    }

    /// Leaves the folder unfinished, the list with what is there.
    fn leave(mut self, done: FramesDone) -> Result<FramesDone> {
        self.list.flush()?;
        Ok(done)
    }

    fn finish(self) -> Result<()> {
        self.list.finish()
    }
}
