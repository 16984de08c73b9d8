//! A dataset as something to be exported: its sets by number, cut into parts.

use super::report::{DatasetIdentity, SegmentIdentity};
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{Dataset, Episode, Error, ErrorKind, Result, Session, SetReader};
use std::ops::Range;

/// Sets of a part at most: small enough that a killed export repeats little, large enough that opening a segment
/// for it costs nothing.
pub const PART_SETS: usize = 100;

/// The sets of a dataset with episodes that an export takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeUse {
    /// All of them.
    All,
    /// Those that are in no discarded episode.
    Kept,
    /// Those of each used episode, as a source of its own.
    Each,
}

/// A dataset to be exported, or one episode of it.
pub struct Source {
    dataset: Dataset,
    reader: SetReader,
    /// Numbers of the sets to be exported.
    spans: Vec<Range<usize>>,
    takes: EpisodeUse,
    episode: Option<Episode>,
    is_first: bool,
}

/// Consecutive sets of one segment, exported as one piece of work.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Index of the dataset.
    pub source: usize,
    /// Numbers of the sets in the dataset, from 0.
    pub sets: Range<usize>,
}

impl Source {
    /// The parts of `dataset` to be exported, as one source, or as one for each of its episodes, when it has any. Of single episodes
    /// those that were cut off are left out. Reads the indexes of all segments; no set is read.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the disk cannot be read, [`ErrorKind::BadInput`] when the dataset has episodes and none is left.
    pub fn all_of(dataset: &Dataset, takes: EpisodeUse) -> Result<Vec<Self>> {
        let reader = dataset.set_reader()?;
        let episodes = if takes == EpisodeUse::All { Vec::new() } else { dataset.session().episodes.clone() };
        let all = 0..reader.times().len();
        let numbers = |e: &Episode| {
            let times = reader.times();
            let first = times.partition_point(|t| *t < e.start_utc_ns);
            first..times.partition_point(|t| e.end_utc_ns.is_none_or(|end| *t <= end)).max(first)
        };
        let spans: Vec<(Vec<Range<usize>>, Option<Episode>)> = if episodes.is_empty() {
            vec![(vec![all], None)]
        } else if takes == EpisodeUse::Each {
            let used = episodes.iter().filter(|e| e.is_used()).map(|e| (vec![numbers(e)], Some(e.clone())));
            used.filter(|(spans, _)| !spans[0].is_empty()).collect()
        } else {
            vec![(without(all, episodes.iter().filter(|e| e.discarded).map(numbers)), None)]
        };
        if !episodes.is_empty() && spans.iter().all(|(spans, _)| spans.is_empty()) {
            let path = dataset.path().display();
            let n = episodes.len();
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "{path}: none of its {n} episodes can be exported: discarded, cut off or empty; judge one with: depthrig edit \
                     {path} --episode N=success"
                ),
            ));
        }
        let one = |(i, (spans, episode))| Self {
            dataset: dataset.clone(),
            reader: reader.fork(),
            spans,
            takes,
            episode,
            is_first: i == 0,
        };
        Ok(spans.into_iter().enumerate().map(one).collect())
    }

    /// The episode that it is; `None` for a dataset.
    pub const fn episode(&self) -> Option<&Episode> {
        self.episode.as_ref()
    }

    /// Whether it is the first one of its dataset.
    pub const fn is_first(&self) -> bool {
        self.is_first
    }

    /// Numbers of the sets to be exported, increasing.
    pub fn numbers(&self) -> impl Iterator<Item = usize> + '_ {
        self.spans.iter().cloned().flatten()
    }

    /// Which episodes and sets of its dataset are left out, in words; `None` for none.
    pub fn left_out(&self) -> Option<String> {
        if self.takes == EpisodeUse::All {
            return None;
        }
        let session = self.session();
        let is_out = |e: &&Episode| if self.episode.is_some() { !e.is_used() } else { e.discarded };
        let mut left: Vec<_> = session
            .episodes
            .iter()
            .filter(is_out)
            .map(|e| format!("episode {} ({})", e.number, e.state()))
            .collect();
        if self.episode.is_some() {
            left.push("sets outside of episodes".to_owned());
        }
        (!left.is_empty()).then(|| format!("{}: left out: {}", session.name, left.join(", ")))
    }

    /// The dataset.
    pub const fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// The session: what was recorded, by whom, with which rig.
    pub const fn session(&self) -> &Session {
        self.dataset.session()
    }

    /// Log time of each set, UTC nanoseconds since 1970, increasing.
    pub fn times(&self) -> &[i64] {
        self.reader.times()
    }

    /// Segments that cannot be read, one line each.
    pub fn problems(&self) -> &[String] {
        self.reader.problems()
    }

    /// The sets of each segment that has any.
    pub fn segments(&self) -> Vec<Range<usize>> {
        self.reader.segment_numbers()
    }

    /// Another reader of the same sets.
    pub fn reader(&self) -> SetReader {
        self.reader.fork()
    }

    /// Parts of at most `most` sets, none across the end of a segment; `source` is the index of this dataset.
    pub fn parts(&self, source: usize, most: usize) -> Vec<Part> {
        let most = most.max(1);
        let cut = |segment: Range<usize>| {
            let end = segment.end;
            segment.step_by(most).map(move |at| Part { source, sets: at..end.min(at.saturating_add(most)) })
        };
        let within = |segment: Range<usize>| {
            self.spans.iter().map(move |span| span.start.max(segment.start)..span.end.min(segment.end))
        };
        self.segments().into_iter().flat_map(within).flat_map(cut).collect()
    }

    /// The facts that distinguish this dataset from any other, and from itself after a change.
    pub(super) fn identity(&self, fs: &dyn Fs) -> Result<DatasetIdentity> {
        let session = self.session();
        let segment = |path: &std::path::PathBuf| {
            let size = fs.open(path).and_then(|f| f.size()).map_err(|e| Error::reading("open", path, e))?;
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            Ok(SegmentIdentity { name, bytes: size })
        };
        Ok(DatasetIdentity {
            name: session.name.clone(),
            rig: session.rig.clone(),
            scene: session.scene.clone(),
            started_utc_ns: session.started_utc_ns,
            first_set_utc_ns: self.times().first().copied(),
            last_set_utc_ns: self.times().last().copied(),
            sets: self.times().len() as u64,
            session_crc32: crc32fast::hash(session.to_toml()?.as_bytes()),
            segments: self.dataset.segments().iter().map(segment).collect::<Result<_>>()?,
        })
    }
}

/// The numbers of `all` that are in none of `others`, which increase.
fn without(all: Range<usize>, others: impl Iterator<Item = Range<usize>>) -> Vec<Range<usize>> {
    let mut spans = Vec::new();
    let mut at = all.start;
    for other in others {
        spans.push(at..other.start);
        at = at.max(other.end);
    }
    spans.push(at..all.end);
    spans.retain(|span| span.start < span.end);
    spans
}
