//! Reading a dataset: its session, its sets in order and in constant memory, and what is in it.

use crate::container::scan::SegmentReader;
use crate::fs::{DirEntry, Fs, RealFs};
use crate::recorder::topics::SESSION_METADATA;
use crate::{Error, ErrorKind, Result, SESSION_FILE, Session};
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub(crate) mod decode;
mod filter;
mod index;
mod info;
mod removed;
mod sets;
mod signals;

pub(crate) use decode::check_stored;
#[cfg(any(test, feature = "testing"))]
pub(crate) use decode::color_decodes;
pub use decode::jpeg_pixels;
pub use filter::PixelFilter;
pub use index::SetReader;
pub use info::{AttachedCalibration, DatasetInfo, MotionInfo, SignalInfo, SpreadStats, StreamInfo};
pub(crate) use info::{MotionCount, image_chunks};
pub(crate) use removed::Removed;
pub use sets::{DatasetFrame, DatasetSet, PixelMode, SetRange, Sets};
pub(crate) use sets::{Kind, kind_of, kinds};
pub(crate) use signals::SignalCount;

/// A dataset opened for reading: a folder, or one segment of one.
#[derive(Debug, Clone)]
pub struct Dataset {
    fs: Arc<dyn Fs>,
    path: PathBuf,
    session: Session,
    segments: Vec<PathBuf>,
    filter: Option<PixelFilter>,
}

impl Dataset {
    /// Opens the dataset `path`, a folder or a single segment file.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::NotADataset`], [`ErrorKind::Foreign`] for an MCAP file of
    /// somebody else, [`ErrorKind::Version`] for a dataset of a later version.
    pub fn open(path: &Path) -> Result<Self> {
        Self::open_with(Arc::new(RealFs), path)
    }

    /// The same on another file system.
    ///
    /// # Errors
    /// As [`Dataset::open`].
    pub fn open_with(fs: Arc<dyn Fs>, path: &Path) -> Result<Self> {
        let entries = match fs.read_dir(path) {
            Ok(entries) => entries,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && fs.open(path).is_err() => {
                return Err(Error::reading("open", path, e));
            }
            Err(e) if e.kind() == std::io::ErrorKind::PermissionDenied => {
                return Err(Error::reading("open", path, e));
            }
            // A file: one segment on its own.
            Err(_) => {
                let session = session_of(&*fs, path)?;
                return Ok(Self {
                    fs,
                    path: path.to_owned(),
                    session,
                    segments: vec![path.to_owned()],
                    filter: None,
                });
            }
        };
        let has_session = entries.iter().any(|e| !e.is_dir && e.name == SESSION_FILE);
        let segments = segments_in(&entries, path);
        let session = match (has_session, segments.first()) {
            (true, _) => Session::load(&*fs, path)?,
            (false, Some(first)) => session_of(&*fs, first)?,
            (false, None) => {
                return Err(Error::new(
                    ErrorKind::NotADataset,
                    format!(
                        "{} is not a dataset: it holds neither {SESSION_FILE} nor seg_0000.mcap",
                        path.display()
                    ),
                ));
            }
        };
        Ok(Self { fs, path: path.to_owned(), session, segments, filter: None })
    }

    /// The same dataset, read with changed pixels: those of [`DatasetFrame::decoded`] and of [`PixelMode::Decoded`].
    #[must_use]
    pub fn filtered(self, filter: PixelFilter) -> Self {
        Self { filter: Some(filter), ..self }
    }

    /// The same dataset with only the segment of this index in [`Dataset::segments`]; `None` when it has none of that index.
    #[must_use]
    pub fn segment(&self, index: usize) -> Option<Self> {
        let segments = vec![self.segments.get(index)?.clone()];
        Some(Self { segments, ..self.clone() })
    }

    /// The filter through which its pixels are read.
    pub const fn filter(&self) -> Option<&PixelFilter> {
        self.filter.as_ref()
    }

    /// The session: what was recorded, by whom, with which rig.
    pub const fn session(&self) -> &Session {
        &self.session
    }

    /// The path it was opened by.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The segment files in order; one that ends in `.part` was not finished.
    pub fn segments(&self) -> &[PathBuf] {
        &self.segments
    }

    /// The sets within `range` in order, with decoded pixels.
    pub fn sets(&self, range: SetRange) -> Sets {
        Sets::new(self, range, PixelMode::Decoded)
    }

    /// The sets within `range` in order, pixels as `mode` says.
    pub fn sets_with(&self, range: SetRange, mode: PixelMode) -> Sets {
        Sets::new(self, range, mode)
    }

    /// Counts, rates, spread, drops. Reads no images, so it is fast on datasets of any length.
    ///
    /// # Errors
    /// As reading the segments does.
    pub fn info(&self) -> Result<DatasetInfo> {
        info::gather(self)
    }

    /// Where it is read from.
    pub(crate) fn fs(&self) -> &dyn Fs {
        &*self.fs
    }

    /// Whether it was opened as a folder and not as one of its segments.
    pub(crate) fn is_folder(&self) -> bool {
        self.segments != [self.path.as_path()]
    }

    pub(crate) fn open_segment(&self, index: usize) -> Option<Result<SegmentReader>> {
        let path = self.segments.get(index)?;
        Some(SegmentReader::open(&*self.fs, path).and_then(|r| ours(&r).map(|()| r)))
    }
}

/// The number of a segment by the name of its file; `None` when it is the name of something else.
pub fn segment_number(name: &str) -> Option<u32> {
    let digits = name.strip_suffix(".part").unwrap_or(name).strip_suffix(".mcap")?.strip_prefix("seg_")?;
    let plain = digits.len() >= 4 && digits.bytes().all(|b| b.is_ascii_digit());
    plain.then(|| digits.parse().ok()).flatten()
}

/// The segments among the files of a folder, in the order of their numbers: `seg_9999` before `seg_10000`.
pub(crate) fn segments_in(entries: &[DirEntry], dir: &Path) -> Vec<PathBuf> {
    let files = entries.iter().filter(|e| !e.is_dir);
    let mut found: Vec<_> =
        files.filter_map(|e| Some((segment_number(&e.name)?, dir.join(&e.name)))).collect();
    found.sort();
    found.into_iter().map(|(_, path)| path).collect()
}

/// Refuses MCAP files that depthrig did not write.
fn ours(reader: &SegmentReader) -> Result<()> {
    if reader.metadata(SESSION_METADATA).is_some() {
        return Ok(());
    }
    if let (Some((offset, why)), true) = (&reader.cut, reader.metadata.is_empty()) {
        return Err(Error::new(
            ErrorKind::Truncated,
            format!("{} was cut before its first set, at byte {offset}: {why}", reader.path.display()),
        ));
    }
    Err(Error::new(
        ErrorKind::Foreign,
        format!(
            "{} is an MCAP file, but not one of depthrig: it has no metadata record \"{SESSION_METADATA}\"; \
             look at it with a general MCAP viewer",
            reader.path.display()
        ),
    ))
}

/// The session from the copy in a segment.
fn session_of(fs: &dyn Fs, segment: &Path) -> Result<Session> {
    let reader = SegmentReader::open(fs, segment)?;
    ours(&reader)?;
    let text = reader.metadata(SESSION_METADATA).and_then(|m| m.get("session_toml"));
    let text = text.map(String::as_str).unwrap_or_default();
    Session::from_toml(text, segment)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_are_ordered_by_number() {
        let names = [
            "notes.txt",
            "seg_00.mcap",
            "seg_0001.mcap",
            "seg_10000.mcap",
            "seg_9999.mcap",
            "seg_10001.mcap.part",
        ];
        let entries = names.map(|n| DirEntry { name: n.to_owned(), len: 1, is_dir: false });
        let expected = ["seg_0001.mcap", "seg_9999.mcap", "seg_10000.mcap", "seg_10001.mcap.part"];
        assert_eq!(segments_in(&entries, Path::new("")), expected.map(PathBuf::from));
    }
}
