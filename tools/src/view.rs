//! The status of a rig as text: what `status` prints and `top` refreshes.

pub mod hosts;

use crate::printable::{BOLD, GREEN, RED, RESET, YELLOW};
use crate::{out, printable};
use core::fmt::Write as _;
use depthrig_bus::DropReason;
use depthrig_daemon::status::{
    CameraState, CameraStatus, LinkState, LinkStatus, PreparingStatus, RecordingStatus, RefineState,
    RefineStatus, ReplayStatus, RigStatus, Ros2Status, SignalState, SignalStatus, StreamStatus,
};
use depthrig_recorder::report::page;
use std::collections::BTreeMap;

/// Style of the output.
#[derive(Debug, Clone, Copy)]
pub struct Style {
    /// Columns of the terminal; narrow ones get fewer columns of numbers.
    pub width: usize,
    /// Whether to use colour.
    pub color: bool,
}

impl Style {
    fn paint(self, color: &str, text: &str) -> String {
        if self.color { format!("{color}{text}{RESET}") } else { text.to_owned() }
    }

    const fn is_wide(self) -> bool {
        self.width >= 126
    }
}

fn preparing(p: &PreparingStatus, style: Style) -> String {
    let state = match &p.error {
        Some(e) => e.clone(),
        None => format!(
            "{:.0} % of the simulated cameras' images are rendered; coarse until then",
            100.0 * p.share
        ),
    };
    format!("{}  {state}", style.paint(BOLD, "preparing"))
}

/// Formats the complete status, without a newline at the end.
pub fn status(rig: &RigStatus, style: Style) -> String {
    let mut lines = vec![
        format!(
            "{}  depthrig {}, process {}, up {}, {:.2} cores",
            style.paint(BOLD, &format!("rig {}", rig.rig)),
            rig.version,
            rig.pid,
            out::seconds(rig.uptime_s),
            rig.cpu_cores
        ),
        format!(
            "sets    {} sent at {} Hz, {} incomplete; spread p50 {:.1}, p95 {:.1}, max {:.1} ms",
            rig.sets.sent,
            page::number(rig.sets.nominal_hz),
            rig.sets.incomplete,
            rig.sets.spread_p50_ms,
            rig.sets.spread_p95_ms,
            rig.sets.spread_max_ms
        ),
    ];
    lines.extend(rig.preparing.as_ref().map(|p| preparing(p, style)));
    lines.extend(rig.replay.iter().map(|r| format!("replay  {}", replay(r))));
    lines.extend(rig.link.iter().flat_map(|l| link(l, style)));
    lines.extend(rig.hosts.iter().flat_map(|h| hosts::lines(h, style)));
    lines.extend(rig.ros2.as_ref().map(|program| ros2(program, style)));
    lines.extend(rig.recording.iter().flat_map(|r| recording(r, style)));
    lines.push(format!(
        "memory  /dev/shm {} free; {} slots a stream, {} in all",
        out::bytes(rig.shared_memory.free_bytes),
        rig.shared_memory.slots,
        out::bytes(rig.shared_memory.reserved_bytes)
    ));
    lines.push(String::new());
    lines.extend(streams(rig, style));
    lines.extend(signals(rig, style));
    lines.extend(poor_metadata(rig));
    let of_camera = |c: &CameraStatus| Some(refined(&c.name, c.refine.as_ref()?, slowest_hz(c), style));
    lines.extend(rig.cameras.iter().filter_map(of_camera));
    lines.extend(calibrated(rig, style));
    let troubles: Vec<_> = rig.cameras.iter().filter_map(|c| trouble(c, style)).collect();
    if !troubles.is_empty() {
        lines.push(String::new());
        lines.extend(troubles);
    }
    lines.join("\n")
}

/// The clock of a session of several computers: a line, and the cure if it does not answer.
fn link(link: &LinkStatus, style: Style) -> Vec<String> {
    let host = &link.host;
    let Some(recorder) = &link.recorder else {
        let answered = out::count(link.exchanges, "question");
        return vec![format!("link    {host}: the clock of the session is here, {answered} answered")];
    };
    let within_us = link.uncertainty_us.unwrap_or_default();
    let clock = format!(
        "{host}: {recorder} is {:+.6} s, within {within_us:.0} us",
        link.offset_s.unwrap_or_default()
    );
    let age_s = link.age_s.unwrap_or_default();
    let cure = || "        run depthrig there with listen in [link], let UDP pass its firewall".to_owned();
    match link.state {
        LinkState::Own | LinkState::Live => vec![format!("link    {clock}")],
        LinkState::Silent => {
            vec![
                format!("link    {clock}, {}", style.paint(RED, &format!("silent for {age_s:.0} s"))),
                cure(),
            ]
        }
        LinkState::Unkeyed => vec![
            format!(
                "link    {host}: {}",
                style.paint(RED, &format!("{recorder} answers, but has given no key yet"))
            ),
            "        depthrig status there says whether it reaches this computer by ssh".to_owned(),
        ],
        LinkState::Unknown => {
            vec![
                format!("link    {host}: {}", style.paint(RED, &format!("{recorder} does not answer"))),
                cure(),
            ]
        }
    }
}

/// A line for the program that publishes the rig to ROS 2.
fn ros2(program: &Ros2Status, style: Style) -> String {
    match (program.pid, &program.why) {
        (Some(pid), None) => format!("ros2    depthrig-ros2 runs, process {pid}"),
        (_, why) => format!("ros2    {}", style.paint(RED, why.as_deref().unwrap_or("it does not run"))),
    }
}

/// A line for each signal.
fn signals(rig: &RigStatus, style: Style) -> Vec<String> {
    let line = |s: &SignalStatus| {
        let required = if s.required { ", required" } else { "" };
        let age = s.age_s.map_or_else(String::new, |age| format!(", the last {age:.1} s ago"));
        let came = format!("{}{age}, missed {}", out::count(s.samples, "sample"), s.missed);
        let bad = |text: &str| if s.required { style.paint(RED, text) } else { style.paint(YELLOW, text) };
        let state = match s.state {
            SignalState::Live => came,
            SignalState::Silent => format!("{}: {came}", bad("silent")),
            SignalState::Missing => bad("nobody publishes it"),
        };
        format!("signal  {}{required}: {state}", s.signal)
    };
    rig.signals.iter().map(line).collect()
}

/// Says how old the cameras' calibrations are and what they are worth, or that several cameras have none.
fn calibrated(rig: &RigStatus, style: Style) -> Vec<String> {
    if rig.replay.is_some() {
        return Vec::new();
    }
    if rig.cameras.len() > 1 && rig.cameras.iter().all(|c| c.mount.is_none()) {
        return vec!["mount   not calibrated: poses are those of the rig file".to_owned()];
    }
    let lines = |c: &CameraStatus| {
        let Some(mount) = &c.mount else { return Vec::new() };
        let age = match mount.age_days {
            Some(d) if d >= 1.0 => format!("{d:.0} days old"),
            Some(_) => "of today".to_owned(),
            None => format!("of {}", mount.created),
        };
        out::item("", &format!("{}: calibration {age}: {}", c.name, mount.worth), style.width)
    };
    rig.cameras.iter().flat_map(lines).collect()
}

/// Describes the state of a replay on one line.
pub fn replay(r: &ReplayStatus) -> String {
    let state = match (r.done, r.paused) {
        (true, _) => "at its end",
        (false, true) => "paused",
        (false, false) => "playing",
    };
    let speed = if r.as_fast_as_possible {
        "as fast as its subscribers read".to_owned()
    } else {
        format!("{} x", r.rate)
    };
    let set = r.set.map_or_else(
        || "no set yet".to_owned(),
        |n| format!("set {n} of 0 to {}", r.length_sets.saturating_sub(1)),
    );
    let round = if r.looped || r.rounds > 1 { format!(", round {}", r.rounds) } else { String::new() };
    let waiting = r.waiting_for.as_ref().map_or_else(String::new, |c| format!("; waits for {c}"));
    format!(
        "{state} at {:.3} of {:.3} s, {set}, {speed}{round}, lost {}{waiting}",
        r.position_s,
        r.length_s,
        r.lost.len()
    )
}

fn recording(r: &RecordingStatus, style: Style) -> Vec<String> {
    let word = if r.active { style.paint(RED, "record ") } else { "last   ".to_owned() };
    let left = r.disk_seconds_left.filter(|_| r.active);
    let mut lines = vec![
        format!(
            "{word} {}: {}, {}, lost {}, {} in {}",
            r.name,
            out::seconds(r.duration_s),
            out::count(r.sets, "set"),
            out::reasons(&r.dropped),
            out::bytes(r.bytes),
            out::count(r.segments, "segment")
        ),
        format!(
            "disk    {} free{}; {}",
            out::bytes(r.disk_free_bytes),
            left.map_or_else(String::new, |s| format!(", enough for {}", out::seconds(s))),
            r.path
        ),
    ];
    lines.extend(r.error.iter().map(|e| style.paint(RED, &format!("        {e}"))));
    lines
}

/// Makes the cells of a stream's row.
type Row = fn(&CameraStatus, &StreamStatus) -> Vec<String>;

fn streams(rig: &RigStatus, style: Style) -> Vec<String> {
    let rows = rig.cameras.iter().flat_map(|c| c.streams.iter().map(move |s| (c, s)));
    let (header, cells): (&[&str], Row) = if style.is_wide() {
        (
            &[
                "stream", "state", "image", "format", "Hz", "frames", "lost", "p50 ms", "p99 ms", "clock",
                "metadata", "ppm", "±us",
            ],
            |c, s| {
                let mut row = narrow(c, s);
                row.insert(3, s.format.clone());
                row.insert(5, s.delivered.to_string());
                row.insert(7, format!("{:.1}", s.latency_p50_ms));
                row.insert(9, s.clock.domain.clone());
                row.insert(10, s.clock.metadata.clone());
                row
            },
        )
    } else {
        (&["stream", "state", "image", "Hz", "lost", "p99 ms", "ppm", "±us"], narrow)
    };
    let cameras: Vec<_> = rows.clone().map(|(c, _)| c).collect();
    let table = out::table(header, if style.is_wide() { 4 } else { 3 }, rows.map(|(c, s)| cells(c, s)));
    let paint = |(i, line): (usize, &str)| match i.checked_sub(1).and_then(|i| cameras.get(i)) {
        None if i == 0 => style.paint(BOLD, line),
        None => line.to_owned(),
        Some(camera) => match color_of(camera.state) {
            Some(color) => style.paint(color, line),
            None => line.to_owned(),
        },
    };
    table.lines().enumerate().map(paint).collect()
}

/// Lists streams whose times do not come from the device's metadata.
fn poor_metadata(rig: &RigStatus) -> Option<String> {
    let is_poor = |s: &&StreamStatus| !matches!(s.clock.metadata.as_str(), "" | "full" | "simulated");
    // Images from files have no device that could say more.
    let cameras = rig.cameras.iter().filter(|c| c.backend != "files");
    let poor = cameras.flat_map(|c| c.streams.iter()).filter(is_poor);
    let mut by_level = BTreeMap::<&str, Vec<&str>>::new();
    for s in poor {
        by_level.entry(s.clock.metadata.as_str()).or_default().push(&s.id);
    }
    let facts: Vec<_> =
        by_level.into_iter().map(|(level, ids)| format!("{level} only: {}", ids.join(", "))).collect();
    (!facts.is_empty()).then(|| format!("metadata  {}", facts.join("; ")))
}

/// The rate of the slowest of a camera's streams of images.
fn slowest_hz(camera: &CameraStatus) -> Option<f64> {
    let images = camera.streams.iter().filter(|s| !s.derived && s.samples_hz.is_none());
    images.map(|s| s.nominal_hz).min_by(f64::total_cmp)
}

/// Describes a camera's depth refinement on one line; `camera_hz` is the rate of the slowest of its streams.
fn refined(camera: &str, r: &RefineStatus, camera_hz: Option<f64>, style: Style) -> String {
    let color = match r.state {
        RefineState::Failed => Some(RED),
        RefineState::Running => None,
        _ => Some(YELLOW),
    };
    let state = color.map_or_else(|| r.state.name().to_owned(), |color| style.paint(color, r.state.name()));
    let mut line = format!("refined   {}: {state}", printable::line(camera));
    if !r.engine.is_empty() {
        let _ = write!(line, ", {}", r.engine);
    }
    if !r.model.is_empty() {
        let _ = write!(line, " with {}", r.model);
    }
    if r.state == RefineState::Running {
        let _ = write!(line, ", {:.1} of {:.1} Hz", r.rate_hz, r.nominal_hz);
        if let Some(camera_hz) = camera_hz
            && r.nominal_hz < camera_hz
        {
            let _ = write!(line, " (limited by rate_hz of [camera.refine]; camera {camera_hz:.1} Hz)");
        }
        let step = |name: &str| r.steps_p50_ms.get(name).copied().unwrap_or(0.0);
        let steps = ["wait", "register", "prepare", "infer", "finish"].map(|s| format!("{s} {:.1}", step(s)));
        let _ = write!(line, ", {:.1} ms ({})", step("total"), steps.join(", "));
    }
    if !r.skipped.is_empty() {
        let _ = write!(line, ", skipped {}", out::reasons(&r.skipped));
    }
    if let Some(why) = &r.message {
        let _ = write!(line, ": {why}");
    }
    line
}

/// Frames that a stream lost. Superseded frames of a stream that the rig computes do not count: skipping them is how it
/// keeps up.
fn lost(stream: &StreamStatus) -> u64 {
    let superseded = DropReason::QueueFull.name();
    stream.dropped.iter().filter(|(reason, _)| !stream.derived || *reason != superseded).map(|(_, n)| n).sum()
}

fn narrow(camera: &CameraStatus, stream: &StreamStatus) -> Vec<String> {
    let lost = lost(stream);
    vec![
        stream.id.clone(),
        match &camera.refine {
            Some(refine) if stream.derived => refine.state.name().to_owned(),
            _ => camera.state.name().to_owned(),
        },
        // An IMU has no image; its rate is that of its samples, its frames are batches.
        stream
            .samples_hz
            .map_or_else(|| format!("{}x{}", stream.width, stream.height), |_| "motion".to_owned()),
        format!("{:.1}", stream.samples_hz.unwrap_or(stream.rate_hz)),
        lost.to_string(),
        format!("{:.1}", stream.latency_p99_ms),
        format!("{:+.1}", stream.clock.rate_ppm),
        format!("{:.0}", stream.clock.uncertainty_us),
    ]
}

/// Describes why a camera is not streaming, or the losses of its streams.
fn trouble(camera: &CameraStatus, style: Style) -> Option<String> {
    let mut notes = Vec::new();
    if camera.state != CameraState::Streaming {
        let why = camera.message.as_deref().map_or_else(String::new, |why| format!(": {why}"));
        let text = format!("{} for {}{why}", camera.state.name(), out::seconds(camera.state_for_s));
        notes.push(color_of(camera.state).map_or_else(|| text.clone(), |color| style.paint(color, &text)));
    }
    notes.extend(camera.warnings.iter().map(|w| style.paint(YELLOW, w)));
    for stream in camera.streams.iter().filter(|s| s.clock.metadata_lost > 0) {
        notes.push(format!("{} had {} frames without metadata", stream.id, stream.clock.metadata_lost));
    }
    match camera.reconnects {
        0 => {}
        1 => notes.push("came back once".to_owned()),
        n => notes.push(format!("came back {n} times")),
    }
    for stream in camera.streams.iter().filter(|s| !s.derived && s.dropped.values().any(|n| *n > 0)) {
        notes.push(format!("{} lost {}", stream.id, out::reasons(&stream.dropped)));
    }
    (!notes.is_empty()).then(|| format!("{}: {}", camera.name, notes.join("; ")))
}

const fn color_of(state: CameraState) -> Option<&'static str> {
    match state {
        CameraState::Streaming => None,
        CameraState::Failed => Some(RED),
        CameraState::Finished | CameraState::Stopped => Some(GREEN),
        _ => Some(YELLOW),
    }
}

/// `line` cut to `width` visible characters; colour codes take no room and are never cut in half.
pub fn clip(line: &str, width: usize) -> String {
    let mut clipped = String::new();
    let mut shown = 0;
    let mut chars = line.chars();
    while let Some(c) = chars.next() {
        if c == '\x1b' {
            clipped.push(c);
            for c in chars.by_ref() {
                clipped.push(c);
                if c.is_ascii_alphabetic() {
                    break;
                }
            }
        } else if shown < width {
            clipped.push(c);
            shown += 1;
        }
    }
    clipped
}

#[cfg(test)]
pub mod tests;
