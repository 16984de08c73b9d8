//! The report of the demo: one table and a few lines, and everything as JSON.

use super::live::{DepthSeen, RefinedSeen};
use super::replayed::Replayed;
use super::seeded::Seeded;
use super::{is_depth, mode_name};
use crate::commands::verify;
use crate::exit::Exit;
use crate::out;
use depthrig_daemon::rig::RigSummary;
use depthrig_daemon::status::{CameraState, CameraStatus, RefineState, RigStatus, StreamStatus};
use depthrig_recorder::{SetDrop, SignalInfo, VerifyReport};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Results of the demo.
#[derive(Debug, Serialize)]
pub struct DemoReport {
    /// From the start of the rig to the first frame of every camera, seconds; rendering not counted.
    pub start_s: f64,
    /// From the request to stop to the end of the last thread, with the recording already closed, seconds.
    pub stop_s: f64,
    /// The rig while it was recording.
    pub live: RigStatus,
    /// Depth as a subscriber saw it, by depth mode: the name of a camera, with the mode's where it has several.
    pub depth: BTreeMap<String, DepthSeen>,
    /// Refined depth as a subscriber saw it, by camera.
    pub refined: BTreeMap<String, RefinedSeen>,
    /// A camera depth model of random weights, end to end.
    pub seeded: Seeded,
    /// Millimetres per unit of depth, by depth mode.
    pub units_mm: BTreeMap<String, f64>,
    /// Images of each depth mode in the recording.
    pub recorded: BTreeMap<String, u64>,
    /// Signals in the recording: those of the simulated arm.
    pub signals: Vec<SignalInfo>,
    /// Depth modes that the rig asks for and that are not there, with the reason.
    pub unavailable: Vec<String>,
    /// Depth modes whose network was never trained.
    pub untrained: Vec<String>,
    /// Sets that the subscriber got.
    pub sets_seen: u64,
    /// Frames of those sets that the subscriber did not have: those of the first set were sent before it subscribed.
    pub frames_unread: u64,
    /// Final summary of the rig.
    pub summary: RigSummary,
    /// Result of `depthrig verify --decode`.
    pub verify: VerifyReport,
    /// Result of the replay.
    pub replay: Replayed,
    /// The dataset.
    pub dataset: PathBuf,
    /// Its quality report, an HTML file.
    pub quality_report: PathBuf,
    /// Its segments.
    pub segments: Vec<PathBuf>,
    /// Contact sheet of the cameras' images.
    pub contact_sheet: PathBuf,
}

impl DemoReport {
    /// Exit code: 1 if something is wrong. Frames lost on a busy computer are counted and listed, but are not a
    /// failure.
    pub fn exit(&self) -> Exit {
        if self.wrong().is_empty() { Exit::Good } else { Exit::Failed }
    }

    /// Failures, one line each.
    fn wrong(&self) -> Vec<String> {
        let mut wrong = Vec::new();
        for camera in &self.summary.status.cameras {
            let because =
                |message: &Option<String>| message.clone().unwrap_or_else(|| "no reason known".into());
            if camera.state == CameraState::Failed {
                wrong.push(format!("camera {} failed: {}", camera.name, because(&camera.message)));
            }
            if let Some(refine) = camera.refine.as_ref().filter(|r| r.state == RefineState::Failed) {
                wrong.push(format!("camera {}: no refined depth: {}", camera.name, because(&refine.message)));
            }
        }
        wrong.extend(self.recording_fault());
        if verify::exit(&self.verify) == Exit::Failed {
            wrong.push(format!("the dataset: {}", verify::summary(&self.verify)));
        }
        if !self.replay.is_right() {
            wrong.push("the replay differs from what was live".to_owned());
        }
        let silent =
            self.summary.status.cameras.iter().flat_map(depth_streams).filter(|(s, _)| s.delivered == 0);
        wrong.extend(silent.map(|(_, mode)| format!("{mode} gave no frame")));
        wrong
    }

    /// Fault of the recording; sets lost on a busy computer are not a fault.
    fn recording_fault(&self) -> Option<String> {
        let Some(summary) = &self.summary.recording else { return Some("nothing was recorded".to_owned()) };
        let status = self.summary.status.recording.as_ref();
        let is_busy =
            |reason: &str| [SetDrop::EncoderBusy, SetDrop::DiskSlow].iter().any(|r| r.name() == reason);
        let faults = status.map(|s| s.dropped.iter().filter(|(reason, n)| **n > 0 && !is_busy(reason)));
        let faults: Vec<String> =
            faults.into_iter().flatten().map(|(reason, n)| format!("{n} sets {reason}")).collect();
        if faults.is_empty() && summary.sets.recorded > 0 {
            return None;
        }
        let because = status.and_then(|s| s.error.as_deref()).unwrap_or("no set came");
        Some(format!(
            "the recording: {}{because}",
            faults.iter().map(|f| format!("{f}; ")).collect::<Vec<_>>().concat()
        ))
    }

    /// Describes losses and their cure on one line; `None` without losses. Frames dropped by design, such as skipped
    /// pairs of computed depth, do not count.
    fn losses(&self) -> Option<String> {
        let status = &self.summary.status;
        let mut parts = Vec::new();
        for camera in &status.cameras {
            // The ground truth of a simulation is not a camera image.
            let streams = camera.streams.iter().filter(|s| !s.id.contains("/depth_true"));
            let frames: u64 = streams.map(lost_frames).sum();
            if frames > 0 {
                parts.push(format!("{frames} frames of {}", camera.name));
            }
        }
        parts.extend(self.unrecorded().map(|mode| format!("every frame of {mode}")));
        if let Some(recording) = &status.recording {
            let sets: u64 = recording.dropped.values().sum();
            if sets > 0 {
                parts.push(format!("{sets} sets of the recording"));
            }
        }
        let unpublished = self.replay.lost.len();
        if unpublished > 0 {
            parts.push(format!("{unpublished} reads of the replay"));
        }
        (!parts.is_empty()).then(|| {
            format!(
                "lost     {}: the computer was too busy, and each loss is counted in the dataset; close other programs and run it \
                 again",
                parts.join(", ")
            )
        })
    }

    /// Depth modes of the live rig of which nothing is in the recording: each frame came too late for its set.
    fn unrecorded(&self) -> impl Iterator<Item = String> {
        let modes = self.live.cameras.iter().flat_map(depth_streams).map(|(_, mode)| mode);
        modes.filter(|mode| self.recorded.get(mode).is_none_or(|images| *images == 0))
    }

    /// Formats the report as text.
    pub fn text(&self) -> String {
        let ok = |good: bool| if good { "ok  " } else { "LOOK" };
        let sets = &self.live.sets;
        let recording = self.summary.recording.as_ref();
        let mut lines = vec![
            out::table(
                &["depth mode", "model", "driver", "colour", "depth", "unit mm", "Hz", "frames", "lost", "p99 ms", "ppm", "±us", "fill", "error"],
                5,
                self.live.cameras.iter().flat_map(|camera| self.rows(camera)),
            ),
            "Hz, frames, lost, p99 (capture to published), ppm and ± (device clock against host) are of depth; error is \
             the mean distance from the true depth, where that is known"
                .to_owned(),
            String::new(),
            format!("{} start    every camera streaming after {:.2} s, stopped in {:.2} s", ok(true), self.start_s, self.stop_s),
            format!(
                "{} sets     {} seen, {} incomplete; frames of a set lie {:.1} ms apart (p50), {:.1} ms (p95)",
                ok(self.sets_seen > 0),
                self.sets_seen,
                sets.incomplete,
                sets.spread_p50_ms,
                sets.spread_p95_ms
            ),
            format!(
                "{} record   {} sets, {} frames, {}",
                ok(self.recording_fault().is_none()),
                recording.map_or(0, |r| r.sets.recorded),
                recording.map_or(0, |r| r.frames),
                out::bytes(recording.map_or(0, |r| r.bytes))
            ),
            format!(
                "{} modes    {} depth modes in it: {}",
                ok(self.unrecorded().next().is_none()),
                self.recorded.len(),
                self.recorded.iter().map(|(mode, n)| format!("{mode} {n}")).collect::<Vec<_>>().join(", ")
            ),
            format!(
                "{} signals  {} samples of the simulated arm: {}; {} lost",
                ok(self.signals.iter().all(|s| s.lost == 0)),
                self.signals.iter().map(|s| s.samples).sum::<u64>(),
                self.signals.iter().map(|s| s.signal.as_str()).collect::<Vec<_>>().join(", "),
                self.signals.iter().map(|s| s.lost).sum::<u64>()
            ),
            format!("{} verify   {}", ok(verify::exit(&self.verify) != Exit::Failed), verify::summary(&self.verify)),
            format!(
                "{} replay   {} of {} frames received; {} depth images equal the live ones bit by bit, {} differ",
                ok(self.replay.is_right()),
                self.replay.received,
                self.replay.published,
                self.replay.depth_equal,
                self.replay.depth_different
            ),
        ];
        lines.extend(self.unavailable.iter().map(|why| format!("--   mode     {why}")));
        lines.extend(self.refined_lines());
        lines.extend(self.losses().map(|lost| format!("note {lost}")));
        lines.extend(self.wrong().iter().map(|wrong| format!("LOOK wrong    {wrong}")));
        lines.push(String::new());
        lines.push(format!(
            "images    {}  (colour, depth, and depth with its holes filled, of each camera)",
            self.contact_sheet.display()
        ));
        lines.push(format!("report    {}", self.quality_report.display()));
        if let Some(segment) = self.segments.first() {
            lines.push(format!(
                "open it   rerun {0}     (or open that file in Foxglove or Lichtblick)",
                segment.display()
            ));
        }
        lines.join("\n")
    }

    /// Lines about live refinement, and about the model with random weights.
    fn refined_lines(&self) -> Vec<String> {
        let mut lines = vec![String::new()];
        let frames: u64 = self.refined.values().map(|r| r.frames).sum();
        let engine = self.refined.values().map(|r| r.engine.as_str()).find(|e| !e.is_empty());
        let verdict = if frames > 0 { "ok  " } else { "LOOK" };
        lines.push(format!(
            "{verdict} refined  {frames} frames of depth_refined by {}, which fills holes along colour and uses no model",
            engine.unwrap_or("nothing")
        ));
        let mm = |v: Option<f64>| v.map_or_else(|| "-".into(), |mm| format!("{mm:.1} mm"));
        let row = |(name, refined): (&String, &RefinedSeen)| {
            let live = self.live.cameras.iter().find(|c| c.name == *name).and_then(|c| c.refine.as_ref());
            let step = |s: &str| {
                live.and_then(|r| r.steps_p50_ms.get(s)).map_or("-".into(), |ms| format!("{ms:.1}"))
            };
            let percent = |v: f64| if refined.compared > 0 { format!("{v:.0} %") } else { "-".into() };
            vec![
                name.clone(),
                percent(refined.before_percent),
                percent(refined.after_percent),
                mm(refined.before_mm),
                mm(refined.after_mm),
                mm(refined.holes_mm),
                step("wait"),
                step("register"),
                step("infer"),
            ]
        };
        let header = &[
            "camera",
            "before",
            "after",
            "error before",
            "after",
            "in holes",
            "wait ms",
            "register",
            "fill",
        ];
        lines.push(out::table(header, 1, self.refined.iter().map(row)));
        lines.push(
            "before and after filling, both in the view of colour: pixels with a depth; mean distance from the true depth on \
             the same pixels, those that had a depth before; and in the holes, which had none"
                .to_owned(),
        );
        let s = &self.seeded;
        lines.push(match &s.missing {
            Some(why) => format!("--   model    a camera depth model is not shown: {why}"),
            None => format!(
                "ok   model    {} ran {}: first frame after {:.1} s, network {:.0} ms, all steps {:.0} ms; its weights are \
                 random, so its output is not depth",
                s.engine, s.model, s.first_frame_s, s.infer_ms, s.total_ms
            ),
        });
        lines
    }

    /// A row for each depth mode of a camera.
    fn rows(&self, camera: &CameraStatus) -> Vec<Vec<String>> {
        let size = |s: &StreamStatus| format!("{}x{}", s.width, s.height);
        let color = camera.streams.iter().find(|s| s.id.ends_with("/color"));
        let row = |(depth, mode): (&StreamStatus, String)| {
            let seen = self.depth.get(&mode);
            let untrained = if self.untrained.contains(&mode) { " (untrained)" } else { "" };
            vec![
                format!("{mode}{untrained}"),
                camera.model.clone(),
                camera.backend.clone(),
                color.map_or_else(|| "-".into(), size),
                size(depth),
                self.units(&mode),
                format!("{:.1}", depth.rate_hz),
                depth.delivered.to_string(),
                lost_frames(depth).to_string(),
                format!("{:.1}", depth.latency_p99_ms),
                format!("{:+.1}", depth.clock.rate_ppm),
                format!("{:.0}", depth.clock.uncertainty_us),
                seen.map_or_else(|| "-".into(), |d| format!("{:.0} %", d.fill_percent)),
                seen.and_then(|d| d.l1_mm).map_or_else(|| "-".into(), |mm| format!("{mm:.1} mm")),
            ]
        };
        depth_streams(camera).map(row).collect()
    }

    fn units(&self, mode: &str) -> String {
        let unit = self.units_mm.get(mode).copied();
        unit.map_or_else(|| "-".into(), |mm| format!("{}", (mm * 1e6).round() / 1e6))
    }
}

/// Frames of a stream that were lost.
fn lost_frames(stream: &StreamStatus) -> u64 {
    if stream.derived { 0 } else { lost(&stream.id, &stream.dropped) }
}

/// Frames of a stream that count as lost. Streams computed from others are dropped by design when the computer is too
/// slow.
fn lost(id: &str, dropped: &BTreeMap<String, u64>) -> u64 {
    let by_design = |reason: &str| reason == "queue_full" && is_computed(id);
    dropped.iter().filter(|(reason, _)| !by_design(reason)).map(|(_, n)| n).sum()
}

/// Returns whether a stream is computed by stereo matching.
fn is_computed(id: &str) -> bool {
    id.split_once('/').is_some_and(|(_, s)| s.starts_with("depth_") || s.starts_with("confidence_"))
}

/// The streams of a camera that are depth modes, with their names.
fn depth_streams(camera: &CameraStatus) -> impl Iterator<Item = (&StreamStatus, String)> {
    camera.streams.iter().filter_map(|s| {
        let (_, stream) = s.id.split_once('/')?;
        is_depth(stream).then(|| (s, mode_name(&camera.name, stream)))
    })
}

/// Counts images by depth mode, from the counts by stream.
pub fn modes<'a>(streams: impl IntoIterator<Item = (&'a str, u64)>) -> BTreeMap<String, u64> {
    let mode = |(id, frames): (&str, u64)| {
        let (camera, stream) = id.split_once('/')?;
        is_depth(stream).then(|| (mode_name(camera, stream), frames))
    };
    streams.into_iter().filter_map(mode).collect()
}

#[cfg(test)]
mod tests;
