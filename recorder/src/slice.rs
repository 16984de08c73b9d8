//! Cutting and joining: a part of a dataset as a dataset of its own, a dataset without some of its sets, and parts of one session together
//! again.
//!
//! Sets are copied as they lie in the file, proven on the way and never packed anew. What counts over the whole
//! recording (accounts, checkpoints, the session's outcome) is written for what the new dataset holds. One thread
//! reads each input ahead by a set; memory does not grow with the length of the datasets.
//!
//! The new dataset grows in a folder named `OUT.part`, which is locked, and gets its name when everything in it
//! is durable. So `OUT` is complete or not there, and the inputs are only read.

use crate::dataset::Dataset;
use crate::fs::Fs;
use crate::recorder::topics::SESSION_METADATA;
use crate::select::SetSpan;
use crate::{Derived, Error, ErrorKind, RecorderOptions, RemovedSets, Result, Session};
use depthrig_bus::UtcPair;
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

mod books;
mod folder;
mod join;
mod output;
mod session;
mod track;

use join::Join;
use track::{Input, Piece, Tracks, tracks};

/// How the new dataset is divided; the defaults are those of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SliceOptions {
    /// A segment is closed before the set that would begin beyond this size, bytes.
    pub segment_max_bytes: u64,
    /// A segment is closed before the set that begins this long after its first one, nanoseconds.
    pub segment_max_ns: i64,
}

impl Default for SliceOptions {
    fn default() -> Self {
        let o = RecorderOptions::default();
        Self { segment_max_bytes: o.segment_max_bytes, segment_max_ns: o.segment_max_ns }
    }
}

/// Report on the new dataset.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct SliceReport {
    /// The new dataset.
    pub path: PathBuf,
    /// Its sets.
    pub sets: u64,
    /// Id of the first set.
    pub first_set: u64,
    /// Id of the last set.
    pub last_set: u64,
    /// Time from the first set to the last, nanoseconds.
    pub duration_ns: i64,
    /// Its segments.
    pub segments: u32,
    /// Bytes of its segments.
    pub bytes: u64,
    /// Sets that were in several inputs and are in it once.
    pub repeated: u64,
    /// Whether nothing is missing between its first set and its last, as far as the recording says.
    pub complete: bool,
    /// Losses, in words; empty when `complete`.
    pub lost: Vec<String>,
}

/// Callback with the bytes read and the bytes to read; a break ends the work.
pub type SliceProgress<'a> = &'a mut dyn FnMut(u64, u64) -> ControlFlow<()>;

/// Writes the sets of `span` as the new dataset `out`.
///
/// # Errors
/// [`ErrorKind::BadInput`] when no set is in the span, [`ErrorKind::AlreadyExists`] when `out` or what is left of
/// an earlier try is there, [`ErrorKind::InUse`] while somebody else makes `out`, [`ErrorKind::DiskFull`],
/// [`ErrorKind::Cancelled`], and as reading and writing do. `out` is not there then.
pub fn trim(
    fs: &dyn Fs,
    dataset: &Dataset,
    out: &Path,
    span: SetSpan,
    options: &SliceOptions,
    progress: SliceProgress<'_>,
) -> Result<SliceReport> {
    crate::check_outside(out, dataset.path())?;
    let mut sets = dataset.set_reader()?;
    let numbers = span.numbers(&mut sets)?;
    let times = sets.times();
    let part = track::Range {
        from_utc_ns: times[numbers.start],
        to_utc_ns: times[numbers.end - 1],
        begins: numbers.start == 0,
        ends: numbers.end == times.len(),
        // Notes after the last set and before the next one belong to the last set.
        notes_from_utc_ns: if numbers.start == 0 { i64::MIN } else { times[numbers.start] },
        notes_to_utc_ns: times.get(numbers.end).map_or(i64::MAX, |next| next - 1),
        prunes: false,
    };
    drop(sets);
    let inputs = [Input::new(dataset)];
    let pieces = (0..dataset.segments().len()).map(|segment| Piece { input: 0, segment }).collect();
    let mut session = session::trimmed(dataset.session(), out, &part);
    session.derived.push(derived("trim", &inputs, part.from_utc_ns, part.to_utc_ns));
    Join::new(&inputs, part, *options).run(fs, &[pieces], session, out, progress)
}

/// Joins datasets or single segments of one session, in the order of their times, as the new dataset `out`. A set that
/// is in several of them is in it once.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the inputs are not of one session or contradict each other; otherwise as [`trim`].
pub fn merge(
    fs: &dyn Fs,
    datasets: &[Dataset],
    out: &Path,
    options: &SliceOptions,
    progress: SliceProgress<'_>,
) -> Result<SliceReport> {
    let Some(first) = datasets.first() else {
        return Err(Error::new(ErrorKind::BadInput, "there is nothing to merge"));
    };
    datasets.iter().try_for_each(|d| crate::check_outside(out, d.path()))?;
    for other in &datasets[1..] {
        session::must_be_one(first, other)?;
    }
    let inputs: Vec<_> = datasets.iter().map(Input::new).collect();
    let Some(Tracks { all: tracks, times, unread }) = tracks(&inputs)? else {
        return Err(Error::new(ErrorKind::BadInput, "the inputs to merge hold no set"));
    };
    let mut session = session::merged(datasets, out);
    session.derived.push(derived("merge", &inputs, times.0, times.1));
    Join::new(&inputs, track::Range::ALL, *options).without(unread).run(fs, &tracks, session, out, progress)
}

/// Writes the dataset without the sets of discarded episodes as `out`, with this session, whose outcome is written anew.
///
/// # Errors
/// As [`trim`].
pub(crate) fn without_discarded(
    fs: &dyn Fs,
    dataset: &Dataset,
    out: &Path,
    mut session: Session,
    progress: SliceProgress<'_>,
) -> Result<SliceReport> {
    let inputs = [Input::new(dataset)];
    let pieces = (0..dataset.segments().len()).map(|segment| Piece { input: 0, segment }).collect();
    let times = dataset.set_reader()?.times().to_vec();
    let is_removed = |utc_ns: &i64| dataset.session().is_discarded(*utc_ns);
    let kept: Vec<i64> = times.iter().copied().filter(|utc_ns| !is_removed(utc_ns)).collect();
    let first_utc_ns = kept.first().copied().unwrap_or_default();
    let last_utc_ns = kept.last().copied().unwrap_or_default();
    session.outcome = None;
    let runs = times.chunk_by(|a, b| is_removed(a) == is_removed(b)).filter(|run| run.iter().all(is_removed));
    let removed =
        runs.filter_map(|run| Some(RemovedSets { first_utc_ns: *run.first()?, last_utc_ns: *run.last()? }));
    let step = derived("prune", &inputs, first_utc_ns, last_utc_ns);
    session.derived.push(Derived { removed: removed.collect(), ..step });
    let range = track::Range { prunes: true, ..track::Range::ALL };
    Join::new(&inputs, range, SliceOptions::default()).run(fs, &[pieces], session, out, progress)
}

/// The provenance of what is made from `inputs`, with sets from one log time to another.
fn derived(by: &str, inputs: &[Input<'_>], first_utc_ns: i64, last_utc_ns: i64) -> Derived {
    let name = |p: &Path| {
        p.file_name().map_or_else(|| p.display().to_string(), |n| n.to_string_lossy().into_owned())
    };
    Derived {
        by: by.to_owned(),
        utc_ns: UtcPair::sample().utc_ns,
        depthrig_version: env!("CARGO_PKG_VERSION").to_owned(),
        from: inputs.iter().map(|i| name(i.dataset.path())).collect(),
        first_utc_ns,
        last_utc_ns,
        // Known with the first set.
        offered_before: 0,
        removed: Vec::new(),
    }
}

/// Refuses a segment that is of another session than its dataset says.
fn check_segment(
    session: &Session,
    metadata: Option<&std::collections::BTreeMap<String, String>>,
    path: &Path,
) -> Result<()> {
    let says = |key: &str| metadata.and_then(|m| m.get(key)).map(String::as_str).unwrap_or_default();
    for (key, expected) in
        [("rig", session.rig.clone()), ("started_utc_ns", session.started_utc_ns.to_string())]
    {
        if says(key) != expected {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "{} is of another session: its {SESSION_METADATA} says {key} {}, not {expected}",
                    path.display(),
                    says(key)
                ),
            ));
        }
    }
    Ok(())
}
