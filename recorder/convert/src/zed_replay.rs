//! Depth for a recorded stereo camera, in several modes at once: `depthrig zed replay`.
//!
//! The raw left and right images of a dataset, a folder of side-by-side images or an SVO2 file become a new dataset with
//! rectified colour, and for each mode depth, confidence and, if asked for, disparity. Each pair is read and rectified
//! once. The dataset grows beside its final name, segment by segment: a run that was killed goes on behind the last
//! finished one.
//! The modes and their limits: docs/zed-replay.md.

use depthrig_calib::stereo::Preset;
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{
    ColorCodec, Dataset, Error, ErrorKind, Result, VerifyOptions, VerifyReport, verify_with,
};
use input::Input;
use plan::Plan;
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

mod alignment;
mod engine;
mod images;
mod input;
mod modes;
mod plan;
mod record;
mod work;

pub use depthrig_cdm::NetworkPixels;
pub use depthrig_stereo::Mode;
pub use depthrig_zed::replay::OpenOptions;
pub use modes::NetworkChoice;

/// Problems that a report names; the rest is counted.
const MAX_PROBLEMS: usize = 20;

/// How a recording is replayed.
#[derive(Debug, Clone, PartialEq)]
pub struct ZedReplayOptions {
    /// The modes, in the order of the streams.
    pub modes: Vec<Mode>,
    /// The network of [`Mode::Neural`].
    pub network: Option<NetworkChoice>,
    /// Camera to process if the dataset has several; for other recordings the name to give the camera.
    pub camera: Option<String>,
    /// Record disparity as well.
    pub disparity: bool,
    /// Depth outside of this is a hole, metres. The nearer end decides how many disparities are searched.
    pub range_m: (f64, f64),
    /// Metres per unit of depth.
    pub depth_unit_m: f64,
    /// How colour is stored.
    pub color: ColorCodec,
    /// Pairs and modes that are worked on at once.
    pub jobs: usize,
    /// Threads of each.
    pub threads: usize,
    /// Memory that pairs and matchers may take, bytes; it lowers `jobs`, to no less than one.
    pub memory_bytes: u64,
    /// Where calibration and times are that the recording itself does not have.
    pub open: OpenOptions,
}

impl Default for ZedReplayOptions {
    /// The classical modes from 0.3 to 20 m in millimetres, one job for each core, half of the memory that is free.
    fn default() -> Self {
        Self {
            modes: [Preset::Performance, Preset::Ultra, Preset::Quality].map(Mode::Preset).to_vec(),
            network: None,
            camera: None,
            disparity: false,
            range_m: (0.3, 20.0),
            depth_unit_m: 0.001,
            color: ColorCodec::Jpeg,
            jobs: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
            threads: 1,
            memory_bytes: work::available_memory() / 2,
            open: OpenOptions::default(),
        }
    }
}

/// The step in progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Depth is computed and written.
    Replay,
    /// The new dataset is proven.
    Verify,
}

/// Called with the step, how far it is and of how much; may end the work.
pub type ZedReplayProgress<'a> = &'a mut dyn FnMut(Step, u64, u64) -> ControlFlow<()>;

/// Result of computing depth.
#[derive(Debug, Serialize)]
pub struct ZedReplayReport {
    /// The new dataset; it is not there when `ended`.
    pub path: PathBuf,
    /// Its sets.
    pub sets: u64,
    /// Bytes of the dataset.
    pub bytes: u64,
    /// Each mode.
    pub modes: Vec<ModeReport>,
    /// Modes that were asked for and are not there, each with why.
    pub unavailable: Vec<String>,
    /// Pairs that could not be decoded, and sets that could not be read.
    pub lost: u64,
    /// The first of them, in words.
    pub problems: Vec<String>,
    /// Remarks, in words.
    pub notes: Vec<String>,
    /// Sets that an earlier run had written.
    pub resumed: u64,
    /// Pairs that this run worked on at once.
    pub jobs: usize,
    /// Memory that pairs and matchers took at most, bytes.
    pub memory_bytes: u64,
    /// Processor time of this run.
    pub cpu: CpuReport,
    /// Whether it was ended from outside; run again, it goes on.
    pub ended: bool,
    /// Verification of the new dataset.
    pub verified: Option<VerifyReport>,
}

impl ZedReplayReport {
    /// Counts unreadable data, and keeps it in words while there is room.
    fn lose(&mut self, problem: String) {
        self.lost += 1;
        if self.problems.len() < MAX_PROBLEMS {
            self.problems.push(problem);
        }
    }
}

/// A mode of a replay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModeReport {
    /// The end of its streams' names.
    pub mode: String,
    /// Its name in the recording.
    pub recorded_as: String,
    /// The program or network with its version.
    pub producer: String,
    /// Every setting that its pixels depend on.
    pub parameters: String,
    /// Frames in the new dataset.
    pub frames: u64,
    /// Modes that came out of the same matching.
    pub shared_with: Vec<String>,
    /// Processor time of the matching that it came out of, in this run, seconds; of a matcher with several threads the
    /// calling one's. A matching that modes share is in each of them and once in [`CpuReport::stereo_s`].
    pub stereo_s: f64,
}

/// Processor time, seconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct CpuReport {
    /// Pairs that it was spent on.
    pub pairs: u64,
    /// Reading and decoding.
    pub read_s: f64,
    /// Rectifying.
    pub rectify_s: f64,
    /// Matching, all modes; presets share theirs.
    pub stereo_s: f64,
    /// Disparity to depth.
    pub depth_s: f64,
    /// The whole process from the first pair to the last, encoding and writing included; without verifying.
    pub total_s: f64,
}

/// Computes depth of `input` in every mode and records it as the new dataset `out`. Intermediate files are in
/// `OUT.zedreplay`.
///
/// # Errors
/// [`ErrorKind::BadRecording`] for an unsupported input, [`ErrorKind::BadInput`] when it has not left and right images
/// with their calibration, when these are swapped, and when a mode is unavailable; [`ErrorKind::AlreadyExists`] when
/// `out` is there or the remains of another run do not fit; [`ErrorKind::InUse`] when another run works on it; and
/// errors of reading and writing.
pub fn zed_replay(
    input: &Path,
    out: &Path,
    options: &ZedReplayOptions,
    progress: ZedReplayProgress<'_>,
) -> Result<ZedReplayReport> {
    if out.symlink_metadata().is_ok() {
        let message = format!("{} is there already; choose another name", out.display());
        return Err(Error::new(ErrorKind::AlreadyExists, message));
    }
    check(options)?;
    depthrig_recorder::check_outside(out, input)?;
    let mut input = Input::open(input, options.camera.as_deref(), &options.open)?;
    let mut plan = Plan::new(&mut input, out, options)?;
    let rows = alignment::check(&mut input, &plan.maker)?;
    plan.take_rows(rows.as_ref());
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let work = work::Work::open(out, &plan.identity(options))?;
    let mut report = plan.report(out);
    let copy = work.dataset();
    let complete = Dataset::open(&copy).is_ok_and(|d| d.session().outcome.is_some());
    if complete {
        report.resumed = plan.facts.total;
    } else {
        let summary = record::record(&mut input, &mut plan, &fs, &copy, &mut report, progress)?;
        let Some(summary) = summary else {
            report.ended = true;
            return Ok(report);
        };
        if !summary.complete {
            let why = summary.lost.join("; ");
            let what =
                format!("the dataset in {} is incomplete: {why}; run it again to go on", copy.display());
            return Err(Error::new(ErrorKind::Io, what));
        }
    }
    if progress(Step::Verify, 0, 1).is_break() {
        report.ended = true;
        return Ok(report);
    }
    let mut verified = verify_with(&fs, &copy, &VerifyOptions::default())?;
    if let Some(broken) = verified.broken() {
        let what = format!(
            "the dataset in {} does not verify: {}; remove {} and begin anew",
            copy.display(),
            broken.message,
            work.path().display()
        );
        return Err(Error::new(ErrorKind::Corrupt, what));
    }
    // Data that the recording lacks, this one lacks too.
    verified.lost().for_each(|f| report.lose(f.message.clone()));
    let _ = progress(Step::Verify, 1, 1);
    (report.sets, report.bytes) = (verified.sets, verified.bytes);
    let frames = verified.frames / plan.streams.len().max(1) as u64;
    report.modes.iter_mut().for_each(|m| m.frames = frames);
    out.clone_into(&mut verified.path);
    report.verified = Some(verified);
    work.finish(out)?;
    Ok(report)
}

fn check(options: &ZedReplayOptions) -> Result<()> {
    let bad = |what: String| Err(Error::new(ErrorKind::BadInput, what));
    let (near, far) = options.range_m;
    if !(near > 0.0 && near < far) {
        return bad(format!("invalid depth range {near} m to {far} m; write metres, such as 0.3 and 20"));
    }
    if !(1e-6..=1.0).contains(&options.depth_unit_m) {
        return bad(format!("invalid depth unit {} m; write metres, such as 0.001", options.depth_unit_m));
    }
    for (n, mode) in options.modes.iter().enumerate() {
        if options.modes[..n].contains(mode) {
            return bad(format!("mode {mode} is given twice"));
        }
    }
    if options.modes.is_empty() {
        return bad("no mode is given; name one, such as quality".to_owned());
    }
    Ok(())
}
