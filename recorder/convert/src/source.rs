//! A dataset as something to be exported: its sets by number, cut into parts.

use super::report::{DatasetIdentity, SegmentIdentity};
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{Dataset, SetReader};
use depthrig_recorder::{Error, Result, Session};
use std::ops::Range;

/// Sets of a part at most: small enough that a killed export repeats little, large enough that opening a segment
/// for it costs nothing.
pub const PART_SETS: usize = 100;

/// A dataset to be exported.
pub struct Source {
    dataset: Dataset,
    reader: SetReader,
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
    /// Reads the indexes of all segments; no set is read.
    ///
    /// # Errors
    /// [`depthrig_recorder::ErrorKind::Io`] when the disk cannot be read.
    pub fn new(dataset: Dataset) -> Result<Self> {
        let reader = dataset.set_reader()?;
        Ok(Self { dataset, reader })
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
        self.segments().into_iter().flat_map(cut).collect()
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
