//! The report of the demo: one table and a few lines, and everything as JSON.

use super::live::{DepthSeen, RefinedSeen};
use super::replayed::Replayed;
use super::seeded::Seeded;
use super::{is_depth, mode_name};
use crate::commands::verify;
use crate::exit::Exit;
use crate::out;
use depthrig_daemon::rig::RigSummary;
use depthrig_daemon::status::{CameraStatus, RigStatus, StreamStatus};
use depthrig_recorder::VerifyReport;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Everything that the demo found out.
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
    /// Pictures of each depth mode in the recording.
    pub recorded: BTreeMap<String, u64>,
    /// Depth modes that the rig asks for and that are not there, with the reason.
    pub unavailable: Vec<String>,
    /// Sets that the subscriber got.
    pub sets_seen: u64,
    /// Frames of those sets that the subscriber did not have: those of the first set were sent before it subscribed.
    pub frames_unread: u64,
    /// The rig's last words.
    pub summary: RigSummary,
    /// What `depthrig verify --decode` says of the dataset.
    pub verify: VerifyReport,
    /// What came out of the replay.
    pub replay: Replayed,
    /// The dataset.
    pub dataset: PathBuf,
    /// Its quality report, a page to look at.
    pub quality_report: PathBuf,
    /// Its segments.
    pub segments: Vec<PathBuf>,
    /// The picture of what the cameras saw.
    pub contact_sheet: PathBuf,
}

impl DemoReport {
    /// 1 when something is wrong, 3 when something was lost.
    pub fn exit(&self) -> Exit {
        if verify::exit(&self.verify) == Exit::Failed || !self.replay.is_right() {
            return Exit::Failed;
        }
        let whole = self.summary.lost.is_empty()
            && verify::exit(&self.verify) == Exit::Good
            && self.replay.is_complete()
            && self.has_every_mode();
        if whole { Exit::Good } else { Exit::Lost }
    }

    /// Whether pictures of each depth mode of the live rig are in the recording.
    fn has_every_mode(&self) -> bool {
        self.live.cameras.iter().all(|camera| {
            depth_streams(camera)
                .all(|(_, mode)| self.recorded.get(&mode).is_some_and(|pictures| *pictures > 0))
        })
    }

    /// The report for people.
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
                ok(recording.is_some_and(|r| r.complete)),
                recording.map_or(0, |r| r.sets.recorded),
                recording.map_or(0, |r| r.frames),
                out::bytes(recording.map_or(0, |r| r.bytes))
            ),
            format!(
                "{} modes    {} depth modes in it: {}",
                ok(self.has_every_mode()),
                self.recorded.len(),
                self.recorded.iter().map(|(mode, n)| format!("{mode} {n}")).collect::<Vec<_>>().join(", ")
            ),
            format!("{} verify   {}", ok(self.verify.is_whole()), verify::summary(&self.verify)),
            format!(
                "{} replay   {} of {} frames received; {} depth pictures equal the live ones bit by bit, {} differ",
                ok(self.replay.is_right() && self.replay.is_complete()),
                self.replay.received,
                self.replay.published,
                self.replay.depth_equal,
                self.replay.depth_different
            ),
        ];
        lines.extend(self.unavailable.iter().map(|why| format!("--   mode     {why}")));
        lines.extend(self.refined_lines());
        let lost = self.summary.lost.iter().chain(&self.replay.lost);
        lines.extend(lost.map(|lost| format!("lost      {lost}")));
        lines.push(String::new());
        lines.push(format!(
            "pictures  {}  (colour, depth by mode, refined depth)",
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

    /// What was refined live and by what, and what a model of random weights did.
    fn refined_lines(&self) -> Vec<String> {
        let mut lines = vec![String::new()];
        let frames: u64 = self.refined.values().map(|r| r.frames).sum();
        let engine = self.refined.values().map(|r| r.engine.as_str()).find(|e| !e.is_empty());
        let verdict = if frames > 0 { "ok  " } else { "LOOK" };
        lines.push(format!(
            "{verdict} refined  {frames} frames of depth_refined by {}, which fills holes along colour and uses no model",
            engine.unwrap_or("nothing")
        ));
        let percent = |d: &DepthSeen| format!("{:.0} %", d.fill_percent);
        let error = |d: &DepthSeen| d.strict_l1_mm.map_or_else(|| "-".into(), |mm| format!("{mm:.0} mm"));
        let row = |(name, refined): (&String, &RefinedSeen)| {
            let raw = self.depth.get(name);
            let live = self.live.cameras.iter().find(|c| c.name == *name).and_then(|c| c.refine.as_ref());
            let step = |s: &str| {
                live.and_then(|r| r.steps_p50_ms.get(s)).map_or("-".into(), |ms| format!("{ms:.1}"))
            };
            let made = &refined.depth;
            let seen = made.pictures > 0;
            vec![
                name.clone(),
                raw.map_or_else(|| "-".into(), percent),
                if seen { percent(made) } else { "-".into() },
                raw.map_or_else(|| "-".into(), error),
                error(made),
                step("wait"),
                step("register"),
                step("infer"),
            ]
        };
        let header = &["camera", "raw", "filled", "raw error", "filled error", "wait ms", "register", "fill"];
        lines.push(out::table(header, 1, self.refined.iter().map(row)));
        lines.push(
            "raw and filled: pixels with depth; errors: mean distance from the true depth over every pixel that has one, a \
             missing one counting as 0 m; raw in its own view, filled in that of colour, which sees more"
                .to_owned(),
        );
        let s = &self.seeded;
        lines.push(match &s.missing {
            Some(why) => format!("--   model    a camera depth model is not shown: {why}"),
            None => format!(
                "ok   model    {} ran {}: first frame after {:.1} s, network {:.0} ms, all steps {:.0} ms; its weights are \
                 random, so what it gives is no depth",
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
            vec![
                mode.clone(),
                camera.model.clone(),
                camera.backend.clone(),
                color.map_or_else(|| "-".into(), size),
                size(depth),
                self.units(&mode),
                format!("{:.1}", depth.rate_hz),
                depth.delivered.to_string(),
                depth.dropped.values().sum::<u64>().to_string(),
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

/// The streams of a camera that are depth modes, with their names.
fn depth_streams(camera: &CameraStatus) -> impl Iterator<Item = (&StreamStatus, String)> {
    camera.streams.iter().filter_map(|s| {
        let (_, stream) = s.id.split_once('/')?;
        is_depth(stream).then(|| (s, mode_name(&camera.name, stream)))
    })
}

/// Pictures of each depth mode in a dataset whose streams have so many.
pub fn modes<'a>(streams: impl IntoIterator<Item = (&'a str, u64)>) -> BTreeMap<String, u64> {
    let mode = |(id, frames): (&str, u64)| {
        let (camera, stream) = id.split_once('/')?;
        is_depth(stream).then(|| (mode_name(camera, stream), frames))
    };
    streams.into_iter().filter_map(mode).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_modes_of_a_dataset_are_its_depth_streams() {
        let found =
            modes([("d435/color", 5), ("d435/depth", 4), ("zed2i/depth_ultra", 3), ("zed2i/left", 5)]);
        let wanted = [("d435".to_owned(), 4), ("zed2i ultra".to_owned(), 3)];
        assert_eq!(found, BTreeMap::from(wanted));
    }
}
