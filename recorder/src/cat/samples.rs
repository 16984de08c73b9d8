//! Samples of IMUs and signals: listed, or written as a CSV or NPY file each.

use super::growing::GrowingFile;
use super::motion::{self, MotionRow};
use super::signal::{self, SignalRow};
use super::{FramesDone, SetChoice, make_folder_of, new_folder};
use crate::dataset::{Dataset, DatasetSet, PixelMode, SetReader};
use crate::fs::Fs;
use crate::npy;
use crate::{Error, ErrorKind, Result, Session};
use depthrig_bus::{MotionSample, SignalDescription, SignalSample, StreamId};
use serde::Serialize;
use std::ops::{ControlFlow, Range};
use std::path::Path;
use std::sync::Arc;

/// Format of a file of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SampleForm {
    /// A line a sample under one line of names; empty where the sample has no such number.
    #[default]
    Csv,
    /// A NumPy array of records with the same names; NaN where the sample has no such number.
    Npy,
}

impl SampleForm {
    const fn extension(self) -> &'static str {
        match self {
            Self::Csv => "csv",
            Self::Npy => "npy",
        }
    }
}

/// One sample: a line of the file, or a JSON object with the same names.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
#[non_exhaustive]
pub enum SampleRow {
    /// Of an IMU.
    Motion(MotionRow),
    /// Of a signal.
    Signal(SignalRow),
}

impl SampleRow {
    /// The row as a line.
    pub fn csv(&self) -> String {
        match self {
            Self::Motion(row) => row.csv(),
            Self::Signal(row) => row.csv(),
        }
    }
}

/// Names of the IMUs and signals of a session, which have samples and no images.
pub fn sampled(session: &Session) -> impl Iterator<Item = &StreamId> {
    session.motion.iter().map(|u| &u.id).chain(session.signals.iter().map(|s| &s.id))
}

/// The IMU or signal that is listed.
enum Source {
    /// The IMU of this index.
    Motion(usize),
    Signal(usize, Arc<SignalDescription>),
}

/// A sample and its set.
enum Sample<'a> {
    Motion(&'a MotionSample),
    Signal(&'a SignalSample),
}

impl Source {
    fn new(session: &Session, id: &StreamId) -> Result<Self> {
        if let Some(unit) = session.motion.iter().position(|u| u.id == *id) {
            return Ok(Self::Motion(unit));
        }
        if let Some(signal) = session.signals.iter().position(|s| s.id == *id) {
            return Ok(Self::Signal(signal, Arc::clone(&session.signals[signal].description)));
        }
        let names: Vec<_> = sampled(session).map(ToString::to_string).collect();
        let has = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let what = format!("there is no IMU or signal {id}; the dataset has {has}");
        Err(Error::new(ErrorKind::BadInput, what))
    }

    /// The names of the columns as a line.
    fn head(&self) -> String {
        match self {
            Self::Motion(_) => MotionRow::COLUMNS.join(","),
            Self::Signal(_, description) => signal::head(description),
        }
    }

    /// The columns of the NPY file with NumPy's names of their kinds.
    fn columns(&self) -> Result<Vec<(&str, &'static str, usize)>> {
        match self {
            Self::Motion(_) => Ok(motion::columns()),
            Self::Signal(_, description) => signal::columns(description),
        }
    }
}

impl Sample<'_> {
    fn row(&self, set: &DatasetSet) -> SampleRow {
        match self {
            Self::Motion(sample) => SampleRow::Motion(MotionRow::new(set, sample)),
            Self::Signal(sample) => SampleRow::Signal(SignalRow::new(set, sample)),
        }
    }

    /// The record of the NPY file.
    fn record(&self, set: &DatasetSet) -> Vec<u8> {
        match self {
            Self::Motion(sample) => {
                let mut record = set.id.to_le_bytes().to_vec();
                record.extend(sample.time_ns.saturating_add(set.utc_offset_ns).to_le_bytes());
                record.extend(sample.to_bytes());
                record
            }
            Self::Signal(sample) => signal::record(set, sample),
        }
    }
}

/// The chosen sets of an IMU or a signal.
struct Chosen {
    sets: SetReader,
    numbers: Range<usize>,
    source: Source,
}

impl Chosen {
    fn new(dataset: &Dataset, id: &StreamId, choice: SetChoice) -> Result<Self> {
        let source = Source::new(dataset.session(), id)?;
        let mut sets = dataset.set_reader()?;
        let numbers = choice.numbers(&mut sets)?;
        Ok(Self { sets, numbers, source })
    }

    /// Calls `each` with every sample and its set; a break ends it.
    fn walk(
        &mut self,
        each: &mut dyn FnMut(&DatasetSet, Sample<'_>) -> Result<ControlFlow<()>>,
    ) -> Result<FramesDone> {
        let mut done = FramesDone::default();
        self.sets.problems().to_vec().into_iter().for_each(|p| done.lose(p));
        for number in self.numbers.clone() {
            let set = match self.sets.read(number, PixelMode::None) {
                Ok(set) => set,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => {
                    done.lose(e.to_string());
                    continue;
                }
            };
            done.sets += 1;
            let samples: Vec<Sample<'_>> = match &self.source {
                Source::Motion(unit) => {
                    let batches = set.motion.iter().filter(|m| m.unit == *unit);
                    batches.flat_map(|m| &m.samples).map(Sample::Motion).collect()
                }
                Source::Signal(signal, _) => {
                    let parts = set.signals.iter().filter(|s| s.signal == *signal);
                    parts.flat_map(|s| &s.samples).map(Sample::Signal).collect()
                }
            };
            for sample in samples {
                if each(&set, sample)?.is_break() {
                    done.ended = true;
                    return Ok(done);
                }
                done.frames += 1;
            }
        }
        Ok(done)
    }
}

/// Calls `head` with the names of the columns and then `each` with a row per sample of the IMU or signal `id` in the chosen
/// sets; what is counted are samples.
///
/// # Errors
/// [`ErrorKind::BadInput`] for one that is not there, and as [`list_frames`](super::list_frames).
pub fn list_samples(
    dataset: &Dataset,
    id: &StreamId,
    sets: SetChoice,
    head: &mut dyn FnMut(String),
    each: &mut dyn FnMut(SampleRow) -> ControlFlow<()>,
) -> Result<FramesDone> {
    let mut chosen = Chosen::new(dataset, id, sets)?;
    head(chosen.source.head());
    chosen.walk(&mut |set, sample| Ok(each(sample.row(set))))
}

/// Writes `CAM/UNIT.csv` (or `.npy`) below the new folder `out` for each of `ids`, IMUs and signals; what is counted are samples. A file that
/// is not finished is named `.part`.
///
/// # Errors
/// As [`list_samples`]; [`ErrorKind::AlreadyExists`] when `out` holds anything; and as writing does.
pub fn export_samples(
    fs: &dyn Fs,
    dataset: &Dataset,
    ids: &[StreamId],
    sets: SetChoice,
    form: SampleForm,
    out: &Path,
    progress: &mut dyn FnMut(u64) -> ControlFlow<()>,
) -> Result<FramesDone> {
    crate::check_outside(out, dataset.path())?;
    let mut chosen: Vec<_> = ids.iter().map(|id| Chosen::new(dataset, id, sets)).collect::<Result<_>>()?;
    if form == SampleForm::Npy {
        // Before a folder is made for what cannot be written.
        for chosen in &chosen {
            chosen.source.columns()?;
        }
    }
    new_folder(fs, out)?;
    let mut total = FramesDone::default();
    for (id, chosen) in ids.iter().zip(&mut chosen) {
        let path = out.join(id.camera.as_str()).join(format!("{}.{}", id.stream, form.extension()));
        make_folder_of(fs, &path)?;
        let mut file = GrowingFile::create(fs, &path)?;
        match form {
            SampleForm::Csv => file.put(format!("{}\n", chosen.source.head()).as_bytes())?,
            // The length stands at the head: they are counted first.
            SampleForm::Npy => {
                let n = chosen.walk(&mut |_, _| Ok(ControlFlow::Continue(())))?.frames;
                file.put(&npy::records(&chosen.source.columns()?, n))?;
            }
        }
        let before = total.frames;
        let done = chosen.walk(&mut |set, sample| {
            match form {
                SampleForm::Csv => {
                    let mut line = sample.row(set).csv();
                    line.push('\n');
                    file.put(line.as_bytes())?;
                }
                SampleForm::Npy => file.put(&sample.record(set))?,
            }
            total.frames += 1;
            // Not for each sample: the call would cost more than the sample.
            Ok(if total.frames % 1024 == 0 { progress(total.frames) } else { ControlFlow::Continue(()) })
        })?;
        total.sets = total.sets.max(done.sets);
        total.frames = before + done.frames;
        total.bytes += file.bytes;
        // Of the same sets for each unit.
        total.lost = total.lost.max(done.lost);
        if total.problems.is_empty() {
            total.problems = done.problems;
        }
        if done.ended {
            total.ended = true;
            return Ok(total);
        }
        file.finish()?;
    }
    Ok(total)
}
