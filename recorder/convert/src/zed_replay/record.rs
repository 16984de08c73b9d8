//! One run over the pairs that are not recorded yet: from the engine, in order, into the dataset that grows.

use super::engine::{Cpu, Done, Engine, State};
use super::images::{Color, Numbers};
use super::input::Input;
use super::modes::Group;
use super::plan::{AHEAD, Plan, QUEUE_SETS};
use super::work::{self, RecordedClock};
use super::{CpuReport, Step, ZedReplayProgress, ZedReplayReport};
use depthrig_bus::clock::process_cpu_ns;
use depthrig_bus::{HostTime, StageStep};
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{
    Error, ErrorKind, Pixels, RecordFrame, RecordSet, Recorder, RecorderOptions, Result, Resumed,
    StreamAccount, StreamRecord, Summary,
};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A killed run repeats at most this: the pairs of this much recorded time.
const SEGMENT_NS: i64 = 10_000_000_000;
/// Time between looks at a recorder that has no room.
const PAUSE: Duration = Duration::from_millis(2);

/// Makes depth of all pairs that are not in `copy` yet; `None` when it was ended.
pub(super) fn record(
    input: &mut Input,
    plan: &mut Plan,
    fs: &Arc<dyn Fs>,
    copy: &Path,
    report: &mut ZedReplayReport,
    progress: ZedReplayProgress<'_>,
) -> Result<Option<Summary>> {
    let clock = RecordedClock::new(plan.session.started_utc_ns);
    let (recorder, resumed) = open(plan, fs, copy, &clock)?;
    let at = match resumed.last_set {
        Some(last) => input.go_behind(last)?,
        None => 0,
    };
    let written = resumed.frames / plan.streams.len().max(1) as u64;
    report.resumed = resumed.sets;
    if resumed.sets > written {
        report.notes.push(format!("{} sets of earlier runs are without a pair", resumed.sets - written));
    }
    let begin = process_cpu_ns();
    let began = HostTime::now();
    let first = std::mem::take(&mut plan.first);
    let plan = &*plan;
    let engine = Engine {
        input: Mutex::new(input),
        maker: &plan.maker,
        groups: &plan.groups,
        modes: plan.modes.len(),
        most: plan.groups.iter().map(|g| g.most.min(plan.jobs)).collect(),
        jobs: plan.jobs,
        window: plan.jobs + AHEAD,
        state: Mutex::new(State::new(first)),
        wake: std::sync::Condvar::new(),
    };
    let mut sink =
        Sink { plan, recorder: &recorder, clock: &clock, report: &mut *report, written, epoch: None, at };
    let all = engine.run(&mut |done| {
        if let Some(done) = done {
            sink.take(done)?;
        }
        Ok(progress(Step::Replay, sink.at, plan.facts.total.max(sink.at)))
    })?;
    let pairs = (sink.written, sink.written - written);
    if !all {
        // Dropped unfinished: its finished segments are gone on with.
        return Ok(None);
    }
    let account = |s: &StreamRecord| StreamAccount {
        stream: s.id.clone(),
        captured: pairs.0,
        delivered: pairs.0,
        dropped: depthrig_bus::DropCounts::default(),
    };
    let units = plan.facts.accounts.iter().cloned();
    recorder.update_accounts(plan.streams.iter().map(account).chain(units).collect());
    let summary = recorder.finish()?;
    let cpu = engine.into_cpu();
    for problem in input.take_lost() {
        report.lose(problem);
    }
    tell_cost(report, &plan.groups, &cpu, pairs.1, process_cpu_ns() - begin);
    tracing::info!(
        sets = summary.sets.recorded,
        after_s = began.elapsed().as_secs_f64(),
        "depth is computed"
    );
    Ok(Some(summary))
}

/// The recorder of a dataset that begins or goes on, and how far that is.
fn open(plan: &Plan, fs: &Arc<dyn Fs>, copy: &Path, clock: &RecordedClock) -> Result<(Recorder, Resumed)> {
    let options = RecorderOptions {
        color: plan.color,
        segment_max_ns: SEGMENT_NS,
        queue_sets: QUEUE_SETS,
        workers: plan.jobs.min(4),
        ..RecorderOptions::default()
    };
    if !copy.join(depthrig_recorder::SESSION_FILE).exists() {
        // Killed before there was anything to go on with.
        work::remove(copy)?;
    }
    if copy.exists() {
        return Recorder::resume(Arc::clone(fs), clock.source(), copy, options);
    }
    let new = Recorder::create_with(Arc::clone(fs), clock.source(), copy, plan.session.clone(), options)?;
    Ok((new, Resumed { sets: 0, frames: 0, last_set: None }))
}

fn tell_cost(report: &mut ZedReplayReport, groups: &[Group], cpu: &Cpu, pairs: u64, total_ns: i64) {
    let seconds = |ns: i64| ns as f64 / 1e9;
    for (group, ns) in groups.iter().zip(&cpu.stereo) {
        let names: Vec<_> = group.modes.iter().map(|i| report.modes[*i].mode.clone()).collect();
        for i in &group.modes {
            let mode = &mut report.modes[*i];
            mode.stereo_s = seconds(*ns);
            mode.shared_with = names.iter().filter(|n| **n != mode.mode).cloned().collect();
        }
    }
    report.cpu = CpuReport {
        pairs,
        read_s: seconds(cpu.read),
        rectify_s: seconds(cpu.rectify),
        stereo_s: seconds(cpu.stereo.iter().sum()),
        depth_s: seconds(cpu.depth),
        total_s: seconds(total_ns),
    };
}

/// Takes the pairs of the engine, one by one.
struct Sink<'a> {
    plan: &'a Plan,
    recorder: &'a Recorder,
    clock: &'a RecordedClock,
    report: &'a mut ZedReplayReport,
    /// Pairs in the dataset.
    written: u64,
    /// Epoch of the camera's clock at the last pair.
    epoch: Option<u32>,
    /// Sets of the input that are done.
    at: u64,
}

impl Sink<'_> {
    fn take(&mut self, mut done: Done) -> Result<()> {
        self.at += 1;
        if let Some(problem) = done.problem.take() {
            self.report.lose(problem);
        }
        let set = self.set(done);
        self.clock.set(&set);
        while !self.recorder.has_room() {
            std::thread::sleep(PAUSE);
        }
        self.recorder.push(set).map_err(|e| {
            let cause = self.recorder.progress().error;
            let kind = cause.as_ref().map_or(ErrorKind::BadInput, |e| e.kind());
            Error::new(kind, e.to_string())
        })
    }

    /// The frames of a pair as a set.
    fn set(&mut self, done: Done) -> RecordSet {
        let head = done.head;
        let (Some(left), Some((views, computed))) = (head.left, done.computed) else {
            let missing = (0..self.plan.streams.len()).collect();
            return RecordSet {
                id: head.set,
                tick: head.tick,
                utc: head.utc,
                frames: Vec::new(),
                missing,
                motion: head.motion,
                signals: head.signals,
                spread_ns: 0,
            };
        };
        self.written += 1;
        let mut view = *left;
        (view.intrinsics, view.pose) = (self.plan.streams[0].intrinsics, self.plan.streams[0].pose);
        let header = |stream: usize| {
            let record = &self.plan.streams[stream];
            let steps = [0; StageStep::ALL.len()];
            let unit = record.depth_unit_m;
            let mut h =
                depthrig_cdm::stage::derived_header(&view, &view, record.format, unit, steps, self.epoch);
            h.set_names(&self.plan.session.rig, &record.id);
            let source = &self.plan.session.computed[stream];
            h.set_refiner(&source.producer, &source.name);
            (h.sequence, h.captured) = (self.written, self.written);
            h.dropped = [0; 8];
            h
        };
        let mut frames: Vec<RecordFrame> = Vec::with_capacity(self.plan.streams.len());
        let mut add = |pixels: Box<dyn Pixels>| {
            let stream = frames.len();
            frames.push(RecordFrame { stream, header: header(stream), pixels });
        };
        add(Box::new(Color(views)));
        for mode_frames in computed {
            add(Box::new(Numbers(mode_frames.depth)));
            add(Box::new(mode_frames.confidence));
            if let Some(disparity) = mode_frames.disparity {
                add(Box::new(Numbers(disparity)));
            }
        }
        self.epoch = Some(left.clock_epoch);
        RecordSet {
            id: head.set,
            tick: head.tick,
            utc: head.utc,
            frames,
            missing: Vec::new(),
            motion: head.motion,
            signals: head.signals,
            spread_ns: 0,
        }
    }
}
