//! Another calibration for a dataset that is recorded: everything in it that says where its cameras are and how they see.
//!
//! That is `session.toml`, and in each segment the session's copy, `/tf_static`, the camera information and the header of each
//! frame. Images are not touched. Each segment is copied beside itself with those messages replaced; when all copies are durable,
//! `session.toml` is replaced and then each segment, one rename each. A kill before the first of these leaves the dataset as it
//! was; a kill between two leaves segments of the old calibration, which `info` and `verify` name and the same call replaces.

use crate::container::segment::sync_folder_of;
use crate::fs::Fs;
use crate::session::SessionText;
use crate::{Dataset, Edit, Error, ErrorKind, Result, Session, StreamCalibration, UnitCalibration};
use core::ops::ControlFlow;
use depthrig_bus::{Intrinsics, Pose, StreamId};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

mod segment;

/// Extension of a copy until all are complete, after `seg_0000.mcap.`.
pub(crate) const TEMPORARY: &str = "recalibrated";
/// Beside the copies there is `session.toml`, bytes.
const MARGIN_BYTES: u64 = 16 << 20;

/// Another calibration of a dataset.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Recalibration {
    /// The text of the calibration, kept in `session.toml`.
    pub text: String,
    /// Streams with new intrinsics or another pose; others stay as they are.
    pub streams: Vec<StreamCalibration>,
    /// IMUs with another pose.
    pub motion: Vec<UnitCalibration>,
}

/// Result of [`recalibrate`].
#[derive(Debug, Clone, PartialEq)]
pub struct Recalibrated {
    /// Changes of the session, all of them in its history.
    pub edits: Vec<Edit>,
    /// Segments that were replaced.
    pub segments: usize,
}

/// Callback with the bytes copied and the bytes to copy; a break ends the work.
pub type RecalibrateProgress<'a> = &'a mut dyn FnMut(u64, u64) -> ControlFlow<()>;

/// Gives the dataset `dir` another calibration, with the earlier one in its history.
///
/// # Errors
/// As [`crate::edit`]; [`ErrorKind::BadInput`] for a stream that it does not have, [`ErrorKind::Corrupt`] for a damaged segment,
/// [`ErrorKind::DiskFull`] when a copy of the segments does not fit, [`ErrorKind::Cancelled`]. The dataset is then
/// as it was.
pub fn recalibrate(
    fs: &dyn Fs,
    dir: &Path,
    new: &Recalibration,
    progress: RecalibrateProgress<'_>,
) -> Result<Recalibrated> {
    let mut file = SessionText::open(fs, dir)?;
    remove_leftovers(fs, dir)?;
    file.set_calibration(&new.text)?;
    for stream in &new.streams {
        file.calibrate_stream(stream)?;
    }
    for unit in &new.motion {
        file.calibrate_unit(unit)?;
    }
    let old = old_segments(fs, dir, file.session())?;
    let mut copies = Copies { fs, made: Vec::new() };
    copies.make(dir, &old, file.session(), progress)?;
    let edits = file.save()?;
    let segments = copies.put_in_place()?;
    Ok(Recalibrated { edits, segments })
}

/// Files of a run that was cut off.
fn remove_leftovers(fs: &dyn Fs, dir: &Path) -> Result<()> {
    let entries = fs.read_dir(dir).map_err(|e| Error::reading("open", dir, e))?;
    for entry in entries.iter().filter(|e| !e.is_dir) {
        let segment = entry.name.strip_suffix(TEMPORARY).and_then(|n| n.strip_suffix('.'));
        if segment.and_then(crate::dataset::segment_number).is_some() {
            let path = dir.join(&entry.name);
            fs.remove_file(&path).map_err(|e| Error::io("remove", &path, e))?;
        }
    }
    Ok(())
}

/// The segments that do not say what `session` says, with their sizes.
fn old_segments(fs: &dyn Fs, dir: &Path, session: &Session) -> Result<Vec<Old>> {
    let entries = fs.read_dir(dir).map_err(|e| Error::reading("open", dir, e))?;
    let mut old = Vec::new();
    for path in crate::dataset::segments_in(&entries, dir) {
        if !segment::says(fs, &path, session)? {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let bytes = entries.iter().find(|e| e.name == name).map_or(0, |e| e.len);
            old.push(Old { path, bytes });
        }
    }
    Ok(old)
}

/// A segment of another calibration.
struct Old {
    path: PathBuf,
    bytes: u64,
}

/// Copies that are not in their places yet: removed when dropped.
struct Copies<'a> {
    fs: &'a dyn Fs,
    /// The copy and its segment.
    made: Vec<Made>,
}

struct Made {
    copy: PathBuf,
    segment: PathBuf,
}

impl Copies<'_> {
    fn make(
        &mut self,
        dir: &Path,
        old: &[Old],
        session: &Session,
        progress: RecalibrateProgress<'_>,
    ) -> Result<()> {
        let total: u64 = old.iter().map(|o| o.bytes).sum();
        let needed = total.saturating_add(MARGIN_BYTES);
        let free =
            self.fs.available_space(dir).map_err(|e| Error::io("ask for the free space of", dir, e))?;
        if !old.is_empty() && free < needed {
            return Err(Error::new(
                ErrorKind::DiskFull,
                format!(
                    "{}: its segments are copied before they are replaced, which takes {} MB; the disk has {} MB left; free some space",
                    dir.display(),
                    needed.div_ceil(1_000_000),
                    free / 1_000_000
                ),
            ));
        }
        let mut done = 0;
        for Old { path, bytes } in old {
            let mut copy = path.clone().into_os_string();
            copy.push(".");
            copy.push(TEMPORARY);
            let made = Made { copy: copy.into(), segment: path.clone() };
            let to = made.copy.clone();
            self.made.push(made);
            segment::copy(self.fs, path, &to, session, &mut |copied| progress(done + copied, total))?;
            done += bytes;
        }
        Ok(())
    }

    fn put_in_place(mut self) -> Result<usize> {
        let made = std::mem::take(&mut self.made);
        for Made { copy, segment } in &made {
            self.fs.rename(copy, segment).map_err(|e| Error::io("rename", copy, e))?;
            sync_folder_of(self.fs, segment)?;
        }
        Ok(made.len())
    }
}

impl Drop for Copies<'_> {
    fn drop(&mut self) {
        for Made { copy, .. } in &self.made {
            // One that was not begun is not there.
            let _ = self.fs.remove_file(copy);
        }
    }
}

/// Calibration of streams and IMUs by name.
#[derive(Debug, PartialEq)]
struct Calibrations {
    streams: BTreeMap<StreamId, (Intrinsics, Pose)>,
    units: BTreeMap<StreamId, Pose>,
}

impl Calibrations {
    fn of(session: &Session) -> Self {
        Self {
            streams: session.streams.iter().map(|s| (s.id.clone(), (s.intrinsics, s.pose))).collect(),
            units: session.motion.iter().map(|u| (u.id.clone(), u.pose)).collect(),
        }
    }
}

/// Segments of `dataset` whose calibration is not that of its `session.toml`, in words.
pub(crate) fn not_recalibrated(dataset: &Dataset) -> Vec<String> {
    if !dataset.is_folder() {
        return Vec::new();
    }
    let stale = dataset.segments().iter().filter(|path| {
        // What cannot be read is a finding of its own.
        !segment::says(dataset.fs(), path, dataset.session()).unwrap_or(true)
    });
    stale
        .map(|path| {
            format!(
                "{} has another calibration than session.toml: `depthrig edit --calibration` was cut off, or the file was \
                 edited by hand; run that command again",
                path.file_name().unwrap_or_default().to_string_lossy()
            )
        })
        .collect()
}
