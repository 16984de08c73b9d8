//! Proves that a dataset is complete and intact, or lists the places where it is not.
//!
//! Checked are: the checksums of data, summary, chunks and attachments; the index against the data, record by
//! record; that every set has what its commit mark lists, of the length and with the checksum that it lists, and
//! that the mark lists or excuses every stream; order, times and spreads; the accounts, of sets, of streams and in
//! the header of each frame; what IMUs sent; that segments follow each other; signals; calibration; and on request that
//! every image decodes and every single sample equals that of its batch.
//!
//! Without that request an image is unpacked only where nothing else proves its bytes, see `segment`.

use crate::dataset::segments_in;
use crate::fs::{Fs, RealFs};
use crate::{Dataset, ErrorKind, Result, SESSION_FILE, Session};
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod images;
mod index;
mod judge;
mod motion;
mod records;
mod seen;
mod segment;
mod sets;
mod signals;

pub(crate) use judge::{Judge, broken_session};
use sets::Walk;

/// Findings beyond these are counted and not kept: a file of noise must not fill the memory.
const FINDINGS_MAX: usize = 10_000;
/// Bytes between two reports of progress.
const REPORT_BYTES: u64 = 4 << 20;

/// Checks beyond the usual.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct VerifyOptions {
    /// Decode every image as well.
    pub decode: bool,
    /// Report sets whose frames are further apart than this, nanoseconds, whatever the session says.
    pub max_spread_ns: Option<i64>,
    /// Threads that unpack and decode images; 0: as many as there are cores.
    pub threads: usize,
}

impl VerifyOptions {
    fn threads(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            n => n,
        }
    }
}

/// Progress of a verification.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct VerifyProgress {
    /// Bytes that were read.
    pub bytes: u64,
    /// Bytes of all segments.
    pub total_bytes: u64,
}

/// Reports progress to the caller, who decides whether to go on.
struct Watch<'a> {
    on_progress: &'a mut dyn FnMut(VerifyProgress) -> ControlFlow<()>,
    done: u64,
    reported: u64,
    total: u64,
    stopped: bool,
}

impl Watch<'_> {
    /// Whether to stop, after `bytes` more.
    fn advance(&mut self, bytes: u64) -> bool {
        self.done += bytes;
        if self.done.saturating_sub(self.reported) >= REPORT_BYTES {
            self.reported = self.done;
            let progress = VerifyProgress { bytes: self.done.min(self.total), total_bytes: self.total };
            self.stopped |= (self.on_progress)(progress).is_break();
        }
        self.stopped
    }
}

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Good to know; nothing is wrong with the data.
    Note,
    /// A loss that the dataset itself records.
    Lost,
    /// Damage: the data contradicts itself or the session.
    Broken,
}

/// One finding of a verification.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// In which file, by name.
    pub file: String,
    /// At which byte, where there is one.
    pub offset: Option<u64>,
    /// The finding in words.
    pub message: String,
}

/// Report of a verification: findings, and how much was checked.
#[derive(Debug, Clone, Serialize)]
#[non_exhaustive]
pub struct VerifyReport {
    /// The dataset.
    pub path: PathBuf,
    /// Findings, worst first.
    pub findings: Vec<Finding>,
    /// Whole sets.
    pub sets: u64,
    /// Their frames.
    pub frames: u64,
    /// Samples of IMUs.
    pub motion_samples: u64,
    /// Samples of signals.
    pub signal_samples: u64,
    /// Bytes read.
    pub bytes: u64,
    /// Segments read.
    pub segments: u32,
    /// Whether the images were decoded.
    pub decoded: bool,
    /// Whether it was stopped before the end; the rest was not looked at.
    pub stopped: bool,
    /// Streams that no camera gave, with what computed them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub computed: Vec<crate::Computed>,
}

impl VerifyReport {
    /// The worst severity; `None` without findings.
    pub fn worst(&self) -> Option<Severity> {
        self.findings.iter().map(|f| f.severity).max()
    }

    /// The first finding of damage; `None` if the dataset is intact.
    pub fn broken(&self) -> Option<&Finding> {
        self.findings.iter().find(|f| f.severity == Severity::Broken)
    }

    /// The losses.
    pub fn lost(&self) -> impl Iterator<Item = &Finding> {
        self.findings.iter().filter(|f| f.severity == Severity::Lost)
    }

    /// Whether the dataset is intact and lost nothing.
    pub fn is_whole(&self) -> bool {
        self.worst() < Some(Severity::Lost)
    }
}

/// Verifies the dataset `path`.
///
/// # Errors
/// As [`Dataset::open`] if the path is not a dataset. Damage is a finding, not an error.
pub fn verify(path: &Path, options: &VerifyOptions) -> Result<VerifyReport> {
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    verify_with(&fs, path, options)
}

/// The same on another file system.
///
/// # Errors
/// As [`verify`].
pub fn verify_with(fs: &Arc<dyn Fs>, path: &Path, options: &VerifyOptions) -> Result<VerifyReport> {
    verify_watched(fs, path, options, &mut |_| ControlFlow::Continue(()))
}

/// The same with progress reports, until `on_progress` breaks.
///
/// # Errors
/// As [`verify`].
pub fn verify_watched(
    fs: &Arc<dyn Fs>,
    path: &Path,
    options: &VerifyOptions,
    on_progress: &mut dyn FnMut(VerifyProgress) -> ControlFlow<()>,
) -> Result<VerifyReport> {
    let mut findings = Findings::default();
    let (session, segments, outcome) = open(fs, path, &mut findings)?;
    check_session(&session, &mut findings);
    check_names(&segments, path, &mut findings);
    let sizes = segments.iter().filter_map(|s| fs.open(s).and_then(|f| f.size()).ok());
    let mut watch = Watch { on_progress, done: 0, reported: 0, total: sizes.sum(), stopped: false };
    let mut walk = Walk::new(&session, *options);
    for path in &segments {
        segment::segment(&mut walk, &**fs, path, &mut findings, &mut watch);
        if watch.stopped {
            break;
        }
    }
    let stopped = watch.stopped;
    if let Ok(dataset) = Dataset::open_with(Arc::clone(fs), path) {
        for stale in crate::recalibrate::not_recalibrated(&dataset) {
            findings.add(Severity::Broken, SESSION_FILE, None, stale);
        }
    }
    walk.finish(outcome.then_some(&session).filter(|_| !stopped), &mut findings);
    Ok(VerifyReport {
        path: path.to_owned(),
        findings: findings.sorted(),
        sets: walk.sets,
        frames: walk.frames,
        motion_samples: walk.units.samples(),
        signal_samples: walk.signals.samples(),
        bytes: walk.bytes,
        segments: segments.len() as u32,
        decoded: options.decode,
        stopped,
        computed: session.computed,
    })
}

#[derive(Default)]
struct Findings {
    kept: Vec<Finding>,
    /// Those beyond [`FINDINGS_MAX`], and the worst of them.
    more: u64,
    worst: Option<Severity>,
}

impl Findings {
    fn add(&mut self, severity: Severity, file: &str, offset: Option<u64>, message: impl Into<String>) {
        let message = message.into();
        if severity == Severity::Broken {
            tracing::debug!(file, "{message}");
        }
        self.push(Finding { severity, file: file.to_owned(), offset, message });
    }

    fn push(&mut self, finding: Finding) {
        if self.kept.len() < FINDINGS_MAX {
            self.kept.push(finding);
        } else {
            self.more += 1;
            self.worst = self.worst.max(Some(finding.severity));
        }
    }

    fn append(&mut self, other: Self) {
        other.kept.into_iter().for_each(|f| self.push(f));
        self.more += other.more;
        self.worst = self.worst.max(other.worst);
    }

    /// All of them, worst first; what was found first stays first.
    fn sorted(mut self) -> Vec<Finding> {
        if let Some(severity) = self.worst {
            let message = format!("{} more findings are not listed", self.more);
            self.kept.push(Finding { severity, file: "all".to_owned(), offset: None, message });
        }
        self.kept.sort_by_key(|f| std::cmp::Reverse(f.severity));
        self.kept
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
}

/// Session, segments, and whether the session is that of the whole dataset rather than of one segment.
fn open(fs: &Arc<dyn Fs>, path: &Path, findings: &mut Findings) -> Result<(Session, Vec<PathBuf>, bool)> {
    let error = match Dataset::open_with(Arc::clone(fs), path) {
        Ok(d) => {
            let is_folder = d.segments() != [path];
            if is_folder && fs.open(&path.join(SESSION_FILE)).is_err() {
                findings.add(
                    Severity::Broken,
                    SESSION_FILE,
                    None,
                    format!("{SESSION_FILE} is missing; the session is read from the segments"),
                );
                return Ok((d.session().clone(), d.segments().to_vec(), false));
            }
            return Ok((d.session().clone(), d.segments().to_vec(), is_folder));
        }
        Err(e) => e,
    };
    // A damaged session.toml must not hide what the segments hold.
    let segments: Vec<_> = match fs.read_dir(path) {
        Ok(entries) => segments_in(&entries, path),
        Err(_) => return Err(error),
    };
    if error.kind() != ErrorKind::Corrupt {
        return Err(error);
    }
    for segment in &segments {
        if let Ok(d) = Dataset::open_with(Arc::clone(fs), segment) {
            findings.add(Severity::Broken, SESSION_FILE, None, error.to_string());
            return Ok((d.session().clone(), segments, false));
        }
    }
    Err(error)
}

fn check_session(session: &Session, findings: &mut Findings) {
    let is_there = |id: &depthrig_bus::StreamId| session.streams.iter().any(|s| s.id == *id);
    for computed in session.computed.iter().filter(|c| !is_there(&c.stream)) {
        let what =
            format!("{} is said to be {}, but there is no such stream", computed.stream, computed.name);
        findings.add(Severity::Broken, SESSION_FILE, None, what);
    }
    for u in session.motion.iter().filter(|u| u.calibration.is_empty()) {
        let what = format!("{} does not say where its pose comes from", u.id);
        findings.add(Severity::Note, SESSION_FILE, None, what);
    }
    for s in &session.streams {
        if s.format.is_depth() && s.depth_unit_m <= 0.0 {
            let what = format!("{} is depth without a unit: its numbers mean nothing", s.id);
            findings.add(Severity::Broken, SESSION_FILE, None, what);
        }
        if !s.intrinsics.is_known() {
            let what = format!("{} has no calibration", s.id);
            findings.add(Severity::Note, SESSION_FILE, None, what);
        } else if s.calibration.is_empty() {
            let what = format!("{} does not say where its calibration comes from", s.id);
            findings.add(Severity::Note, SESSION_FILE, None, what);
        }
    }
}

/// Segments must be numbered without a gap and be finished.
fn check_names(segments: &[PathBuf], path: &Path, findings: &mut Findings) {
    if segments == [path] {
        return;
    }
    if segments.is_empty() {
        findings.add(Severity::Broken, &file_name(path), None, "there are no segments");
    }
    for (i, segment) in segments.iter().enumerate() {
        let name = file_name(segment);
        let expected = crate::container::segment::file_name(i as u32);
        if name.strip_suffix(".part").unwrap_or(&name) != expected {
            let what = format!("{expected} is missing, {name} is in its place");
            findings.add(Severity::Broken, &expected, None, what);
            break;
        }
    }
}
