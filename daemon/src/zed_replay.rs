//! Depth for a recorded stereo camera, in several modes at once: `depthrig zed replay`.
//!
//! The raw eyes of a dataset, a folder of side-by-side pictures or an SVO2 file become a new dataset with rectified
//! colour, and for each mode depth, confidence and, if asked for, disparity. Each pair is read and rectified once. The
//! dataset grows beside its final name, segment by segment: a run that was killed goes on behind the last finished one.
//! What the modes are and what they are not: docs/zed-replay.md.

use depthrig_bus::{HostTime, PixelFormat, StageStep, StreamId};
use depthrig_calib::PoseExt;
use depthrig_calib::Rectifier;
use depthrig_calib::stereo::{Description, Matcher, Preset};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{
    ColorCodec, Computed, Dataset, Error, ErrorKind, RecordFrame, RecordSet, Recorder, RecorderOptions,
    Result, StreamAccount, StreamRecord, Summary, UtcSource, VerifyOptions, VerifyReport, verify_with,
};
use engine::{Done, Engine, State};
use input::{Facts, Input};
use pictures::{Color, Maker, Numbers};
use serde::Serialize;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

mod engine;
mod input;
mod modes;
mod pictures;
mod swapped;
mod work;

pub use depthrig_cdm::NetworkPixels;
pub use depthrig_drivers::zed::replay::OpenOptions;
pub use modes::{Mode, NetworkChoice};

/// What a killed run repeats at most: the pairs of this much recorded time.
const SEGMENT_NS: i64 = 10_000_000_000;
/// Pairs in work beyond one for each thread.
const AHEAD: usize = 2;
/// Sets that wait for the recorder's encoders.
const QUEUE_SETS: usize = 2;

/// How a recording is replayed.
#[derive(Debug, Clone, PartialEq)]
pub struct ZedReplayOptions {
    /// The modes, in the order of the streams.
    pub modes: Vec<Mode>,
    /// The network of [`Mode::Neural`].
    pub network: Option<NetworkChoice>,
    /// Of a dataset with several stereo cameras the one that is meant; for other recordings what it is called.
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

/// What is being done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Depth is made and written.
    Replay,
    /// The new dataset is proven.
    Verify,
}

/// Is told how far a step is, of how much, and may end the work.
pub type ZedReplayProgress<'a> = &'a mut dyn FnMut(Step, u64, u64) -> ControlFlow<()>;

/// What was made.
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
    /// What one should know, in words.
    pub notes: Vec<String>,
    /// Sets that an earlier run had made.
    pub resumed: u64,
    /// Pairs that this run worked on at once.
    pub jobs: usize,
    /// Memory that pairs and matchers took at most, bytes.
    pub memory_bytes: u64,
    /// Processor time of this run.
    pub cpu: CpuReport,
    /// Whether it was ended from outside; run again, it goes on.
    pub ended: bool,
    /// Whether the new dataset is whole.
    pub verified: Option<VerifyReport>,
}

/// A mode of a replay.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModeReport {
    /// The end of its streams' names.
    pub mode: String,
    /// What the recording calls it.
    pub recorded_as: String,
    /// The program or network with its version.
    pub producer: String,
    /// Every setting that its pixels depend on.
    pub parameters: String,
    /// Frames in the new dataset.
    pub frames: u64,
    /// Processor time of its matching in this run, seconds; of a matcher with several threads the calling one's.
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
    /// Matching, all modes.
    pub stereo_s: f64,
    /// Disparity to depth.
    pub depth_s: f64,
    /// The whole process from the first pair to the last, encoding and writing included; without verifying.
    pub total_s: f64,
}

/// Makes depth of `input` in every mode and records it as the new dataset `out`. What is needed until then is in
/// `OUT.zedreplay`.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the input is no recording of two eyes with their calibration, when the eyes are swapped,
/// and when a mode cannot be made; [`ErrorKind::AlreadyExists`] when `out` is there or what is left of another run does
/// not fit; [`ErrorKind::InUse`] when another run works on it; and what reading and writing say.
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
    let mut input = Input::open(input, options.camera.as_deref(), &options.open)?;
    let mut plan = Plan::new(&mut input, out, options)?;
    swapped::check(&mut input, &plan.maker, options)?;
    let fs: Arc<dyn Fs> = Arc::new(RealFs);
    let work = work::Work::open(out, &plan.identity(options))?;
    let mut report = plan.report(out);
    let copy = work.dataset();
    let whole = Dataset::open(&copy).is_ok_and(|d| d.session().outcome.is_some());
    if whole {
        report.resumed = plan.facts.total;
    } else {
        let summary = record(&mut input, &mut plan, &fs, &copy, &mut report, progress)?;
        let Some(summary) = summary else {
            report.ended = true;
            return Ok(report);
        };
        if !summary.complete {
            let why = summary.lost.join("; ");
            let what =
                format!("the dataset in {} is not whole: {why}; run it again to go on", copy.display());
            return Err(Error::new(ErrorKind::Io, what));
        }
    }
    if progress(Step::Verify, 0, 1).is_break() {
        report.ended = true;
        return Ok(report);
    }
    let mut verified = verify_with(&fs, &copy, &VerifyOptions::default())?;
    if !verified.is_whole() {
        let first = verified.findings.first().map_or_else(String::new, |f| f.message.clone());
        let what = format!(
            "the dataset in {} does not verify: {first}; remove {} and begin anew",
            copy.display(),
            work.path().display()
        );
        return Err(Error::new(ErrorKind::Corrupt, what));
    }
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
        return bad(format!("depth from {near} m to {far} m is no range; write metres, such as 0.3 and 20"));
    }
    if !(1e-6..=1.0).contains(&options.depth_unit_m) {
        return bad(format!(
            "a depth unit of {} m makes no sense; write metres, such as 0.001",
            options.depth_unit_m
        ));
    }
    for (n, mode) in options.modes.iter().enumerate() {
        if options.modes[..n].contains(mode) {
            return bad(format!("mode {mode} is asked for twice"));
        }
    }
    if options.modes.is_empty() {
        return bad("no mode is asked for; name one, such as quality".to_owned());
    }
    Ok(())
}

/// All that is known before the first pair is matched.
struct Plan {
    facts: Facts,
    maker: Arc<Maker>,
    modes: Vec<modes::ModeMaker>,
    /// The first matcher of each mode.
    first: Vec<Box<dyn Matcher>>,
    unavailable: Vec<String>,
    notes: Vec<String>,
    /// The streams of the output: colour, then those of each mode.
    streams: Vec<StreamRecord>,
    session: depthrig_recorder::Session,
    jobs: usize,
    memory_bytes: u64,
    color: ColorCodec,
}

impl Plan {
    fn new(input: &mut Input, out: &Path, options: &ZedReplayOptions) -> Result<Self> {
        let facts = input.facts().clone();
        let c = &facts.calibration;
        let rectifier = Rectifier::new(&c.left, &c.right, &c.right_in_left, facts.size).map_err(|e| {
            Error::new(ErrorKind::BadInput, format!("the calibration ({}): {e}", facts.calibration_origin))
                .with_source(e)
        })?;
        let (mut modes, mut first, mut unavailable) = (Vec::new(), Vec::new(), Vec::new());
        for mode in &options.modes {
            if *mode == Mode::Neural && options.network.is_none() {
                unavailable.push(format!("{mode}: {}", modes::NO_NETWORK));
                continue;
            }
            let (maker, matcher) = modes::open(*mode, &rectifier, options)?;
            modes.push(maker);
            first.push(matcher);
        }
        if modes.is_empty() {
            return Err(Error::new(ErrorKind::BadInput, unavailable.join("; ")));
        }
        let searched = modes::geometry(&rectifier).disparities(options.range_m.0);
        let nearest = rectifier.intrinsics().fx * rectifier.baseline_m() / searched as f64;
        let mut notes = Vec::new();
        if nearest > options.range_m.0 {
            let (w, h) = facts.size;
            notes.push(format!(
                "at {w}x{h} the presets see no nearer than {nearest:.2} m: they search {searched} disparities at most"
            ));
        }
        let maker = Maker {
            rectifier,
            colors: options.modes.contains(&Mode::Neural) && options.network.is_some(),
            depth_unit_m: options.depth_unit_m,
            range_m: options.range_m,
            disparity: options.disparity,
        };
        let mut plan = Self {
            facts,
            maker: Arc::new(maker),
            modes,
            first,
            unavailable,
            notes,
            streams: Vec::new(),
            session: depthrig_recorder::Session::new("", ""),
            jobs: 1,
            memory_bytes: 0,
            color: options.color,
        };
        plan.jobs =
            (1..=options.jobs.max(1)).rev().find(|n| plan.memory(*n) <= options.memory_bytes).unwrap_or(1);
        plan.memory_bytes = plan.memory(plan.jobs);
        plan.describe(out)?;
        Ok(plan)
    }

    /// Bytes that `jobs` threads take: matchers, and pairs from reading to encoding.
    fn memory(&self, jobs: usize) -> u64 {
        let of = |m: &modes::ModeMaker| m.description.memory_bytes.saturating_mul(m.most.min(jobs) as u64);
        let matchers: u64 = self.modes.iter().map(of).sum();
        let pairs = (jobs + AHEAD + QUEUE_SETS + 1) as u64;
        matchers.saturating_add(self.maker.pair_bytes(self.modes.len()).saturating_mul(pairs))
    }

    /// The session and its streams.
    fn describe(&mut self, out: &Path) -> Result<()> {
        let facts = &self.facts;
        let rectifier = &self.maker.rectifier;
        let view = StreamRecord {
            id: stream_id(&facts.camera, "color")?,
            model: facts.model.clone(),
            serial: facts.serial.clone(),
            format: PixelFormat::Rgb8,
            width: facts.size.0,
            height: facts.size.1,
            rate_hz: facts.rate_hz,
            depth_unit_m: 0.0,
            calibration: format!("rectified with: {}", facts.calibration_origin),
            intrinsics: *rectifier.intrinsics(),
            pose: facts.pose.compose(&rectifier.left_view_in_left()),
        };
        let mut computed = vec![Computed {
            stream: view.id.clone(),
            name: "rectified".to_owned(),
            producer: format!("depthrig-rectify {}", env!("CARGO_PKG_VERSION")),
            parameters: format!(
                "focal_px={} baseline_m={}",
                rectifier.intrinsics().fx,
                rectifier.baseline_m()
            ),
            from: facts.from[..1].to_vec(),
        }];
        let mut streams = vec![view.clone()];
        let unit = self.maker.depth_unit_m;
        for mode in &self.modes {
            let mut add = |what: &str, format, depth_unit_m| {
                let id = stream_id(&facts.camera, &format!("{what}_{}", mode.name))?;
                let Description { producer, parameters, .. } = &mode.description;
                let (near, far) = self.maker.range_m;
                computed.push(Computed {
                    stream: id.clone(),
                    name: mode.recorded.clone(),
                    producer: producer.clone(),
                    parameters: format!("{parameters} min_depth_m={near} max_depth_m={far}"),
                    from: facts.from.clone(),
                });
                streams.push(StreamRecord { id, format, depth_unit_m, ..view.clone() });
                Ok::<_, Error>(())
            };
            add("depth", PixelFormat::Z16, unit)?;
            add("confidence", PixelFormat::Confidence8, 0.0)?;
            if self.maker.disparity {
                add("disparity", PixelFormat::DisparityF32, 0.0)?;
            }
        }
        let mut session = facts.session.clone();
        session.name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
        (session.streams, session.computed) = (streams.clone(), computed);
        if !self.unavailable.is_empty() {
            let all: Vec<_> = self.unavailable.iter().cloned().map(toml::Value::from).collect();
            let table = toml::Table::from_iter([("unavailable".to_owned(), all.into())]);
            session.extra.insert("zed_replay".to_owned(), table.into());
        }
        (self.session, self.streams) = (session, streams);
        Ok(())
    }

    /// What decides the pixels: a run goes on only with the same.
    fn identity(&self, options: &ZedReplayOptions) -> serde_json::Value {
        let mode = |m: &modes::ModeMaker| {
            let d = &m.description;
            serde_json::json!({ "name": m.name, "producer": d.producer, "parameters": d.parameters })
        };
        let c = &self.facts.calibration;
        serde_json::json!({
            "depthrig_version": env!("CARGO_PKG_VERSION"),
            "input": self.facts.identity,
            "modes": self.modes.iter().map(mode).collect::<Vec<_>>(),
            "calibration": format!("{:?} {:?} {:?}", c.left, c.right, c.right_in_left),
            "disparity": options.disparity,
            "range_m": options.range_m,
            "depth_unit_m": options.depth_unit_m,
            "color": options.color,
        })
    }

    fn report(&self, out: &Path) -> ZedReplayReport {
        let mode = |m: &modes::ModeMaker| ModeReport {
            mode: m.name.clone(),
            recorded_as: m.recorded.clone(),
            producer: m.description.producer.clone(),
            parameters: m.description.parameters.clone(),
            frames: 0,
            stereo_s: 0.0,
        };
        ZedReplayReport {
            path: out.to_owned(),
            sets: 0,
            bytes: 0,
            modes: self.modes.iter().map(mode).collect(),
            unavailable: self.unavailable.clone(),
            lost: 0,
            problems: Vec::new(),
            notes: self.notes.clone(),
            resumed: 0,
            jobs: self.jobs,
            memory_bytes: self.memory_bytes,
            cpu: CpuReport::default(),
            ended: false,
            verified: None,
        }
    }

    /// The frames of a pair as a set.
    fn set(&self, done: Done, written: &mut u64, epoch: &mut Option<u32>) -> RecordSet {
        let head = done.head;
        let (Some(left), Some((views, made))) = (head.left, done.made) else {
            let missing = (0..self.streams.len()).collect();
            return RecordSet {
                id: head.set,
                tick: head.tick,
                utc: head.utc,
                frames: Vec::new(),
                missing,
                spread_ns: 0,
            };
        };
        *written += 1;
        let mut view = *left;
        (view.intrinsics, view.pose) = (self.streams[0].intrinsics, self.streams[0].pose);
        let header = |stream: usize| {
            let record = &self.streams[stream];
            let steps = [0; StageStep::ALL.len()];
            let unit = record.depth_unit_m;
            let mut h =
                crate::stage::worker::derived_header(&view, &view, record.format, unit, steps, *epoch);
            h.set_names(&self.session.rig, &record.id);
            let made = &self.session.computed[stream];
            h.set_refiner(&made.producer, &made.name);
            (h.sequence, h.captured) = (*written, *written);
            h.dropped = [0; 8];
            h
        };
        let mut frames = vec![RecordFrame { stream: 0, header: header(0), pixels: Box::new(Color(views)) }];
        for made in made {
            let stream = frames.len();
            frames.push(RecordFrame {
                stream,
                header: header(stream),
                pixels: Box::new(Numbers(made.depth)),
            });
            let header_of = header(stream + 1);
            frames.push(RecordFrame {
                stream: stream + 1,
                header: header_of,
                pixels: Box::new(made.confidence),
            });
            if let Some(disparity) = made.disparity {
                let header_of = header(stream + 2);
                frames.push(RecordFrame {
                    stream: stream + 2,
                    header: header_of,
                    pixels: Box::new(Numbers(disparity)),
                });
            }
        }
        *epoch = Some(left.clock_epoch);
        RecordSet { id: head.set, tick: head.tick, utc: head.utc, frames, missing: Vec::new(), spread_ns: 0 }
    }
}

fn stream_id(camera: &str, stream: &str) -> Result<StreamId> {
    StreamId::new(camera, stream).map_err(|e| Error::new(ErrorKind::BadInput, e.to_string()))
}

/// Makes depth of all pairs that are not in `copy` yet; `None` when it was ended.
#[allow(clippy::too_many_lines)] // one loop, and what each thread of it is given
fn record(
    input: &mut Input,
    plan: &mut Plan,
    fs: &Arc<dyn Fs>,
    copy: &Path,
    report: &mut ZedReplayReport,
    progress: ZedReplayProgress<'_>,
) -> Result<Option<Summary>> {
    let options = RecorderOptions {
        color: plan.color,
        segment_max_ns: SEGMENT_NS,
        queue_sets: QUEUE_SETS,
        workers: plan.jobs.min(4),
        ..RecorderOptions::default()
    };
    let clock = work::RecordedClock::new(plan.session.started_utc_ns);
    let source: UtcSource = clock.source();
    if !copy.join(depthrig_recorder::SESSION_FILE).exists() {
        // Killed before there was anything to go on with.
        work::remove(copy)?;
    }
    let (recorder, resumed) = if copy.exists() {
        Recorder::resume(Arc::clone(fs), source, copy, options)?
    } else {
        let new = Recorder::create_with(Arc::clone(fs), source, copy, plan.session.clone(), options)?;
        (new, depthrig_recorder::Resumed { sets: 0, frames: 0, last_set: None })
    };
    let total = plan.facts.total;
    let mut at = 0;
    if let Some(last) = resumed.last_set {
        at = input.go_behind(last)?;
    }
    report.resumed = resumed.sets;
    let per_set = plan.streams.len().max(1) as u64;
    let mut written = resumed.frames / per_set;
    if resumed.sets > written {
        report.notes.push(format!("{} sets of earlier runs are without a pair", resumed.sets - written));
    }
    let (mut epoch, mut failure) = (None, None);
    let (begin, began) = (depthrig_bus::clock::process_cpu_ns(), HostTime::now());
    let first = std::mem::take(&mut plan.first);
    let plan = &*plan;
    let engine = Engine {
        input: Mutex::new(input),
        maker: &plan.maker,
        modes: &plan.modes,
        most: plan.modes.iter().map(|m| m.most.min(plan.jobs)).collect(),
        jobs: plan.jobs,
        window: plan.jobs + AHEAD,
        state: Mutex::new(State::new(first)),
        wake: std::sync::Condvar::new(),
    };
    let before = written;
    let mut sink = |done: Option<Done>| -> Result<ControlFlow<()>> {
        if let Some(mut done) = done {
            at += 1;
            if let Some(problem) = done.problem.take() {
                report.lost += 1;
                if report.problems.len() < MAX_PROBLEMS {
                    report.problems.push(problem);
                }
            }
            let set = plan.set(done, &mut written, &mut epoch);
            clock.set(&set);
            while !recorder.has_room() {
                std::thread::sleep(PAUSE);
            }
            if let Err(e) = recorder.push(set) {
                let cause = recorder.progress().error;
                let kind = cause.as_ref().map_or(ErrorKind::BadInput, |e| e.kind());
                failure = Some(Error::new(kind, e.to_string()));
                return Ok(ControlFlow::Break(()));
            }
        }
        Ok(progress(Step::Replay, at, total.max(at)))
    };
    let all = engine.run(&mut sink)?;
    if let Some(e) = failure {
        return Err(e);
    }
    if !all {
        // Dropped unfinished: its finished segments are gone on with.
        return Ok(None);
    }
    let account = |s: &StreamRecord| StreamAccount {
        stream: s.id.clone(),
        captured: written,
        delivered: written,
        dropped: depthrig_bus::DropCounts::default(),
    };
    recorder.update_accounts(plan.streams.iter().map(account).collect());
    let summary = recorder.finish()?;
    let cpu = engine.into_cpu();
    for problem in input.take_lost() {
        report.lost += 1;
        if report.problems.len() < MAX_PROBLEMS {
            report.problems.push(problem);
        }
    }
    let seconds = |ns: i64| ns as f64 / 1e9;
    for (mode, ns) in report.modes.iter_mut().zip(&cpu.stereo) {
        mode.stereo_s = seconds(*ns);
    }
    report.cpu = CpuReport {
        pairs: written - before,
        read_s: seconds(cpu.read),
        rectify_s: seconds(cpu.rectify),
        stereo_s: seconds(cpu.stereo.iter().sum()),
        depth_s: seconds(cpu.depth),
        total_s: seconds(depthrig_bus::clock::process_cpu_ns() - begin),
    };
    tracing::info!(sets = summary.sets.recorded, after_s = began.elapsed().as_secs_f64(), "depth is made");
    Ok(Some(summary))
}

/// Problems that a report names; the rest is counted.
const MAX_PROBLEMS: usize = 20;
/// Time between looks at a recorder that has no room.
const PAUSE: std::time::Duration = std::time::Duration::from_millis(2);
