//! The rig's status as Prometheus metrics.
//!
//! Every scrape is built from one [`RigStatus`], so its numbers belong together and there are no other
//! counters that could disagree with `depthrig status`. Units are base units (seconds, bytes, hertz, ratios), as
//! Prometheus wants; quantiles are gauges over the last frames, because they are computed in the daemon.

mod family;
#[cfg(test)]
mod tests;

use crate::status::{
    CameraState, ClockStatus, HostState, HostStatus, LinkState, RecordingStatus, RefineState, RefineStatus,
    RigStatus, SetAccount, SetStatus, StreamStatus,
};
use depthrig_bus::DropReason;
use family::{Families, Labels, Unit};
use std::collections::BTreeMap;

/// The content type of [`render`]'s text.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The metrics of a rig as OpenMetrics text, which every Prometheus reads.
pub fn render(status: &RigStatus) -> String {
    let mut f = Families::default();
    daemon(&mut f, status);
    for camera in &status.cameras {
        cameras(&mut f, camera);
        if let Some(refine) = &camera.refine {
            refined(&mut f, &Labels::new(&[("camera", &camera.name)]), refine);
        }
        for stream in &camera.streams {
            let name = stream.id.split_once('/').map_or(stream.id.as_str(), |(_, name)| name);
            let labels = Labels::new(&[("camera", &camera.name), ("stream", name)]);
            frames(&mut f, &labels, stream);
            clock(&mut f, &labels, &stream.clock);
            set_frames(&mut f, &labels, &stream.in_sets);
        }
    }
    for host in status.hosts.iter().flat_map(|h| &h.hosts) {
        hosts(&mut f, host);
    }
    for part in status.hosts.iter().filter_map(|h| h.session.as_ref()).flat_map(|s| &s.parts) {
        let labels = Labels::new(&[("host", &part.host), ("part", &part.name)]);
        let there = "Bytes of the part of the newest recording that the host made.";
        f.gauge("part_size", there, Unit::Bytes, &labels, part.bytes as f64);
        f.gauge("part_pulled", "Bytes of it that are here.", Unit::Bytes, &labels, part.pulled_bytes as f64);
    }
    if let Some(link) = &status.link {
        let labels = Labels::new(&[("host", &link.host)]);
        let is_known = matches!(link.state, LinkState::Own | LinkState::Live);
        f.gauge("link_up", "1 while the clock of the session is known.", Unit::None, &labels, flag(is_known));
        if let Some(us) = link.uncertainty_us {
            let help = "Bound of the error of the session's clock.";
            f.gauge("link_uncertainty", help, Unit::Seconds, &labels, us / 1e6);
        }
    }
    sets(&mut f, &status.sets);
    if let Some(recording) = &status.recording {
        record(&mut f, recording);
    }
    f.into_text()
}

fn hosts(f: &mut Families, host: &HostStatus) {
    let labels = Labels::new(&[("host", &host.host)]);
    let is_up = host.state == HostState::Connected;
    f.gauge(
        "host_up",
        "1 while the daemon of the host answers as part of the rig.",
        Unit::None,
        &labels,
        flag(is_up),
    );
    let cameras = "Cameras of the host that stream.";
    f.gauge("host_cameras", cameras, Unit::None, &labels, host.streaming as f64);
}

fn daemon(f: &mut Families, s: &RigStatus) {
    let none = Labels::default();
    let labels = Labels::new(&[("rig", &s.rig), ("version", &s.version)]);
    f.gauge("build_info", "Always 1; what runs.", Unit::None, &labels, 1.0);
    f.gauge("uptime", "How long the daemon has run.", Unit::Seconds, &none, s.uptime_s);
    f.gauge(
        "cpu_usage",
        "CPU used by the daemon over the last second, in cores.",
        Unit::Cores,
        &none,
        s.cpu_cores,
    );
    let memory = &s.shared_memory;
    f.gauge("shared_memory_free", "Free in /dev/shm.", Unit::Bytes, &none, memory.free_bytes as f64);
    f.gauge(
        "shared_memory_reserved",
        "All slots of all streams.",
        Unit::Bytes,
        &none,
        memory.reserved_bytes as f64,
    );
    f.gauge("shared_memory_slots", "Slots of each stream.", Unit::None, &none, memory.slots as f64);
}

fn cameras(f: &mut Families, c: &crate::status::CameraStatus) {
    let labels = Labels::new(&[("camera", &c.name)]);
    for state in CameraState::ALL {
        let labels = labels.with("state", state.name());
        f.gauge(
            "camera_state",
            "1 for the state that the camera is in.",
            Unit::None,
            &labels,
            flag(c.state == state),
        );
    }
    f.gauge(
        "camera_state_age",
        "How long the camera has been in its state.",
        Unit::Seconds,
        &labels,
        c.state_for_s,
    );
    f.counter(
        "camera_reconnects",
        "Times the camera was lost and came back.",
        Unit::None,
        &labels,
        c.reconnects,
    );
    let labels = labels.with("backend", &c.backend).with("model", &c.model).with("serial", &c.serial);
    let labels = labels.with("firmware", &c.firmware);
    f.gauge("camera_info", "Always 1; what the camera is.", Unit::None, &labels, 1.0);
}

fn refined(f: &mut Families, labels: &Labels, r: &RefineStatus) {
    for state in RefineState::ALL {
        let labels = labels.with("state", state.name());
        let help = "1 for the state that the refining of the camera's depth is in.";
        f.gauge("refine_state", help, Unit::None, &labels, flag(r.state == state));
    }
    let info = labels.with("engine", &r.engine).with("model", &r.model);
    f.gauge("refine_info", "Always 1; what refines the camera's depth.", Unit::None, &info, 1.0);
    f.declare_counter("refine_skipped", SKIPPED, Unit::None);
    for skip in crate::stage::Skip::ALL {
        let n = r.skipped.get(skip.name()).copied().unwrap_or(0);
        f.counter("refine_skipped", SKIPPED, Unit::None, &labels.with("reason", skip.name()), n);
    }
    let help = "Depth frames beyond the rate asked for.";
    f.counter("refine_not_due", help, Unit::None, labels, r.not_due);
    let help = "Times the refining came back after it had failed.";
    f.counter("refine_restarts", help, Unit::None, labels, r.restarts);
    for (quantile, steps) in [("0.5", &r.steps_p50_ms), ("0.99", &r.steps_p99_ms)] {
        for (step, ms) in steps {
            let labels = labels.with("step", step).with("quantile", quantile);
            let help = "How long a step of refining took, over the last frames.";
            f.gauge("refine_step", help, Unit::Seconds, &labels, ms / 1e3);
        }
    }
}

const SKIPPED: &str = "Pairs of images that were due and not refined, by reason.";

fn frames(f: &mut Families, labels: &Labels, s: &StreamStatus) {
    f.counter(
        "frames_captured",
        "Frames the device captured: delivered + dropped.",
        Unit::None,
        labels,
        s.captured,
    );
    f.counter("frames_delivered", "Frames published.", Unit::None, labels, s.delivered);
    for (reason, n) in all_reasons(&s.dropped) {
        let labels = labels.with("reason", reason);
        f.counter(
            "frames_dropped",
            "Frames lost before they were published, by reason.",
            Unit::None,
            &labels,
            n,
        );
    }
    f.gauge("frame_rate_nominal", "Frame rate asked of the device.", Unit::Hertz, labels, s.nominal_hz);
    f.gauge("frame_rate", "Frame rate delivered over the last seconds.", Unit::Hertz, labels, s.rate_hz);
    if let Some(age) = s.last_frame_age_ms {
        f.gauge("frame_age", "Time since the last frame.", Unit::Seconds, labels, age / 1e3);
    }
    for (quantile, ms) in [("0.5", s.latency_p50_ms), ("0.99", s.latency_p99_ms)] {
        let labels = labels.with("quantile", quantile);
        f.gauge(
            "frame_latency",
            "From capture to published, over the last frames.",
            Unit::Seconds,
            &labels,
            ms / 1e3,
        );
    }
}

fn clock(f: &mut Families, labels: &Labels, c: &ClockStatus) {
    let help = "How much faster the device's clock runs than the host's, as a fraction.";
    f.gauge("clock_rate_error", help, Unit::Ratio, labels, c.rate_ppm / 1e6);
    let help = "Stated uncertainty of the newest capture time.";
    f.gauge("clock_uncertainty", help, Unit::Seconds, labels, c.uncertainty_us / 1e6);
    for (quantile, us) in [("0.5", c.residual_p50_us), ("0.99", c.residual_p99_us)] {
        let labels = labels.with("quantile", quantile);
        f.gauge("clock_residual", "How late arrivals are against the map.", Unit::Seconds, &labels, us / 1e6);
    }
    f.gauge("clock_epoch", "Number of the clock map in force.", Unit::None, labels, f64::from(c.epoch));
    f.counter(
        "metadata_lost_frames",
        "Frames whose own metadata did not come.",
        Unit::None,
        labels,
        c.metadata_lost,
    );
    let help = "Frames whose capture time is flagged uncertain.";
    f.counter("clock_uncertain_frames", help, Unit::None, labels, c.uncertain_frames);
}

fn set_frames(f: &mut Families, labels: &Labels, a: &SetAccount) {
    let SetAccount { used, decimated, late, out_of_order, overflow, missed, pending, unread } = *a;
    for (fate, n) in [
        ("used", used),
        ("decimated", decimated),
        ("late", late),
        ("out_of_order", out_of_order),
        ("overflow", overflow),
        ("missed", missed),
    ] {
        let labels = labels.with("fate", fate);
        f.counter(
            "set_frames",
            "What became of delivered frames in the set assembler.",
            Unit::None,
            &labels,
            n,
        );
    }
    f.gauge("set_frames_pending", "Frames waiting for their set.", Unit::None, labels, pending as f64);
    let help = "Delivered frames that the set assembler has not yet read.";
    f.gauge("set_frames_unread", help, Unit::None, labels, unread as f64);
}

fn sets(f: &mut Families, s: &SetStatus) {
    let none = Labels::default();
    f.gauge("set_rate_nominal", "Set rate asked for.", Unit::Hertz, &none, s.nominal_hz);
    f.counter("sets_sent", "Frame sets sent, incomplete ones included.", Unit::None, &none, s.sent);
    f.counter("sets_incomplete", "Frame sets sent that miss a stream.", Unit::None, &none, s.incomplete);
    let spreads = [
        ("0.5", s.spread_p50_ms),
        ("0.95", s.spread_p95_ms),
        ("0.99", s.spread_p99_ms),
        ("1", s.spread_max_ms),
    ];
    for (quantile, ms) in spreads {
        let labels = Labels::new(&[("quantile", quantile)]);
        let help = "Latest minus earliest capture time of a set; quantile 1 is the greatest.";
        f.gauge("set_spread", help, Unit::Seconds, &labels, ms / 1e3);
    }
}

fn record(f: &mut Families, r: &RecordingStatus) {
    let none = Labels::default();
    f.gauge(
        "recording_active",
        "1 while a recording goes on; all recording numbers are of the last one.",
        Unit::None,
        &none,
        flag(r.active),
    );
    f.gauge(
        "recording_failed",
        "1 when it ended early or lost something.",
        Unit::None,
        &none,
        flag(r.error.is_some()),
    );
    f.gauge("recording_duration", "Its length.", Unit::Seconds, &none, r.duration_s);
    f.counter("recording_sets", "Frame sets written.", Unit::None, &none, r.sets);
    f.counter("recording_frames", "Frames written.", Unit::None, &none, r.frames);
    f.counter("recording_written", "Bytes written.", Unit::Bytes, &none, r.bytes);
    f.counter("recording_segments", "Segments begun.", Unit::None, &none, r.segments);
    f.declare_counter("recording_sets_dropped", "Frame sets lost, by reason.", Unit::None);
    for (reason, n) in &r.dropped {
        let labels = Labels::new(&[("reason", reason)]);
        f.counter("recording_sets_dropped", "Frame sets lost, by reason.", Unit::None, &labels, *n);
    }
    f.gauge(
        "recording_disk_free",
        "Free on the disk of the recording.",
        Unit::Bytes,
        &none,
        r.disk_free_bytes as f64,
    );
    if let Some(left) = r.disk_seconds_left {
        f.gauge(
            "recording_disk_left",
            "Until that disk is full at the present rate.",
            Unit::Seconds,
            &none,
            left,
        );
    }
}

/// The counts of every reason, those without a loss included: a series that is there from the start can alert on
/// its first increase.
fn all_reasons(dropped: &BTreeMap<String, u64>) -> BTreeMap<&str, u64> {
    let mut all: BTreeMap<_, _> = DropReason::ALL.iter().map(|r| (r.name(), 0)).collect();
    all.extend(dropped.iter().map(|(reason, n)| (reason.as_str(), *n)));
    all
}

const fn flag(on: bool) -> f64 {
    if on { 1.0 } else { 0.0 }
}
