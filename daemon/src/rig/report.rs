//! The rig in numbers: its status, the diagnostics that go into a recording, and losses.

use super::Inner;
use crate::camera::{Camera, State};
use crate::status::{
    CameraState, CameraStatus, PreparingStatus, RecordingStatus, RefineState, RigStatus, SetStatus,
    SharedMemoryStatus, SkewStatus,
};
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, UtcPair, shm};
use depthrig_recorder::{Diagnostic, Level};
use depthrig_sim::synthetic::DrawingProgress;
use std::sync::atomic::Ordering;

/// Everything there is to know about the rig now.
pub fn status(inner: &Inner) -> RigStatus {
    let now = HostTime::now();
    let cameras: Vec<_> = inner.cameras.iter().map(|c| camera(inner, c, now)).collect();
    let reserved = |c: &Camera| -> u64 {
        c.state().all_streams().map(|s| (s.slots() * s.profile.frame_bytes()) as u64).sum()
    };
    let slots = inner.cameras.iter().filter_map(|c| c.state().streams.iter().map(|s| s.slots()).min()).min();
    // A statement of its own: its lock is taken again below.
    let signals = inner.recording().signal_states(&inner.config.signals, now);
    RigStatus {
        rig: inner.config.rig.to_string(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        pid: std::process::id(),
        uptime_s: inner.started.elapsed().as_secs_f64(),
        utc_ns: UtcPair::sample().utc_ns(now),
        preparing: inner.drawing().map(preparing),
        cameras,
        signals,
        link: inner.link.as_ref().map(|link| link.status(now)),
        hosts: inner.hosts.as_ref().map(|hosts| hosts.status()),
        ros2: inner.ros2.as_ref().map(|ros2| ros2.status()),
        sets: sets(inner),
        recording: recording(inner),
        shared_memory: SharedMemoryStatus {
            free_bytes: shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap_or(0),
            slots: slots.unwrap_or(0),
            reserved_bytes: inner.cameras.iter().map(|c| reserved(c)).sum(),
        },
        cpu_cores: inner.cpu_millicores.load(Ordering::Relaxed) as f64 / 1000.0,
        replay: None,
    }
}

fn recording(inner: &Inner) -> Option<RecordingStatus> {
    let mut status = lock(&inner.recording).status()?;
    // Sets that wait for refined depth are still on their way to it.
    status.closing |= status.active && inner.closing.load(Ordering::Relaxed);
    Some(status)
}

fn preparing(progress: DrawingProgress) -> PreparingStatus {
    PreparingStatus {
        images: progress.done as u64,
        images_total: progress.total as u64,
        share: progress.done as f64 / progress.total.max(1) as f64,
        error: progress.error,
    }
}

fn sets(inner: &Inner) -> SetStatus {
    let accounts = inner.set_accounts();
    let spreads = inner.spreads();
    let ms = |ns: i64| ns as f64 / 1e6;
    SetStatus {
        nominal_hz: inner.config.sets.rate_hz,
        sent: accounts.sent,
        incomplete: accounts.incomplete,
        spread_p50_ms: ms(spreads.quantile_ns(0.5)),
        spread_p95_ms: ms(spreads.quantile_ns(0.95)),
        spread_p99_ms: ms(spreads.quantile_ns(0.99)),
        spread_max_ms: ms(spreads.max_ns()),
        skews: lock(&inner.skews)
            .iter()
            .map(|(id, skews)| SkewStatus {
                stream: id.to_string(),
                median_ms: ms(skews.median_ns()),
                p95_ms: ms(skews.quantile_ns(0.95)),
            })
            .collect(),
    }
}

fn camera(inner: &Inner, camera: &Camera, now: HostTime) -> CameraStatus {
    let state = camera.state();
    let info = state.info.clone().unwrap_or_default();
    let accounts = inner.set_accounts();
    let temperature_c = state.streams.iter().find_map(|s| s.books().temperature_c).map(f64::from);
    let mount = crate::camera::calibration_status(
        &camera.config,
        &info,
        temperature_c,
        UtcPair::sample().utc_ns(now),
    );
    CameraStatus {
        name: camera.config.name.to_string(),
        backend: camera.config.backend.name().to_owned(),
        model: info.model,
        serial: info.serial,
        firmware: info.firmware,
        port: info.port,
        calibration: info.calibration,
        state: state.phase,
        state_for_s: state.since.elapsed().as_secs_f64(),
        message: state.message.clone(),
        warnings: {
            let notice = lock(&camera.notice);
            let doubts = mount.iter().flat_map(|m| m.warnings.iter().map(|w| format!("calibration: {w}")));
            notice.iter().cloned().chain(silent_units(inner, &state, now)).chain(doubts).collect()
        },
        reconnects: state.reconnects,
        refine: state.refinement.as_ref().map(|refinement| refinement.status()),
        mount,
        streams: state
            .all_streams()
            .map(|s| {
                // The account is older than the books that are read here, and never ahead of them.
                let mut status = s.status(accounts.streams.get(&s.id).copied().unwrap_or_default(), now);
                status.in_sets = status.in_sets.with_delivered(status.delivered);
                status
            })
            .collect(),
    }
}

/// Warnings about IMUs that are silent while their camera streams.
fn silent_units<'s>(inner: &'s Inner, state: &'s State, now: HostTime) -> impl Iterator<Item = String> + 's {
    let stall_s = inner.config.supervisor.stall_s;
    let streaming = state.phase == CameraState::Streaming;
    let units = state.streams.iter().filter(move |s| streaming && s.profile.format.is_motion());
    units.filter_map(move |s| {
        let since = s.books().last_frame.map_or(state.since, |t| t.max(state.since));
        let silent_s = now.since_ns(since) as f64 * 1e-9;
        (silent_s > stall_s.max(3.0 / s.profile.rate_hz))
            .then(|| format!("no motion samples of {} for {silent_s:.1} s; its images go on", s.id.stream))
    })
}

/// The status as `diagnostic_msgs` see it: one entry per camera and one for the sets.
pub fn diagnostics(status: &RigStatus) -> Vec<Diagnostic> {
    let mut all: Vec<_> = status.cameras.iter().map(|c| diagnose(&status.rig, c)).collect();
    let s = &status.sets;
    all.push(Diagnostic {
        level: if s.incomplete > 0 { Level::Warn } else { Level::Ok },
        name: format!("{}/sets", status.rig),
        message: format!("{} sets, {} incomplete", s.sent, s.incomplete),
        hardware_id: String::new(),
        values: vec![
            ("spread_p50_ms".to_owned(), format!("{:.3}", s.spread_p50_ms)),
            ("spread_p99_ms".to_owned(), format!("{:.3}", s.spread_p99_ms)),
            ("cpu_cores".to_owned(), format!("{:.2}", status.cpu_cores)),
        ],
    });
    all
}

fn diagnose(rig: &str, camera: &CameraStatus) -> Diagnostic {
    let mut values = vec![("reconnects".to_owned(), camera.reconnects.to_string())];
    for s in &camera.streams {
        let name = s.id.rsplit('/').next().unwrap_or(&s.id);
        let mut value = |key: &str, text: String| values.push((format!("{name}.{key}"), text));
        value("rate_hz", format!("{:.2}", s.rate_hz));
        if let Some(hz) = s.samples_hz {
            value("samples_hz", format!("{hz:.1}"));
        }
        value("captured", s.captured.to_string());
        value("delivered", s.delivered.to_string());
        for (reason, n) in &s.dropped {
            value(&format!("dropped_{reason}"), n.to_string());
        }
        value("latency_p99_ms", format!("{:.3}", s.latency_p99_ms));
        value("clock_epoch", s.clock.epoch.to_string());
        value("clock_rate_ppm", format!("{:.2}", s.clock.rate_ppm));
        value("clock_uncertainty_us", format!("{:.1}", s.clock.uncertainty_us));
        value("clock_residual_p99_us", format!("{:.1}", s.clock.residual_p99_us));
    }
    values.extend(camera.warnings.iter().map(|w| ("warning".to_owned(), w.clone())));
    if let Some(refine) = &camera.refine {
        values.push(("refine.state".to_owned(), refine.state.name().to_owned()));
        values.push(("refine.engine".to_owned(), refine.engine.clone()));
        values.push(("refine.model".to_owned(), refine.model.clone()));
        values.extend(refine.message.iter().map(|m| ("refine.message".to_owned(), m.clone())));
        let steps = refine.steps_p50_ms.iter();
        values.extend(steps.map(|(step, ms)| (format!("refine.{step}_p50_ms"), format!("{ms:.3}"))));
    }
    Diagnostic {
        level: match camera.state {
            CameraState::Streaming if camera.warnings.is_empty() => Level::Ok,
            CameraState::Failed => Level::Error,
            _ => Level::Warn,
        },
        name: format!("{rig}/{}", camera.name),
        message: camera.message.clone().unwrap_or_else(|| camera.state.name().to_owned()),
        hardware_id: camera.serial.clone(),
        values,
    }
}

/// The cameras that are away and never gave a frame, one line each.
pub fn silent(status: &RigStatus) -> Vec<String> {
    let away = |c: &&CameraStatus| !matches!(c.state, CameraState::Streaming | CameraState::Failed);
    let silent = |c: &&CameraStatus| c.streams.iter().all(|s| s.captured == 0);
    let line = |c: &CameraStatus| Some(format!("camera {}: no frame: {}", c.name, c.message.as_ref()?));
    status.cameras.iter().filter(away).filter(silent).filter_map(line).collect()
}

/// Losses over the rig's life, one line each.
pub fn lost(status: &RigStatus) -> Vec<String> {
    let mut lost = Vec::new();
    for camera in &status.cameras {
        if camera.state == CameraState::Failed {
            let why = camera.message.as_deref().unwrap_or("no reason known");
            lost.push(format!("camera {} failed: {why}", camera.name));
        }
        if let Some(refine) = camera.refine.as_ref().filter(|r| r.state == RefineState::Failed) {
            let why = refine.message.as_deref().unwrap_or("no reason known");
            lost.push(format!("camera {}: no refined depth: {why}", camera.name));
        }
        // A pair superseded by a newer one is no loss: that is how the stage keeps up.
        for s in camera.streams.iter().filter(|s| !s.derived && !s.dropped.is_empty()) {
            let reasons: Vec<_> = s.dropped.iter().map(|(r, n)| format!("{n} {r}")).collect();
            let what = if s.samples_hz.is_some() { "batches" } else { "frames" };
            lost.push(format!(
                "{}: {} of {} {what} ({})",
                s.id,
                s.dropped.values().sum::<u64>(),
                s.captured,
                reasons.join(", ")
            ));
        }
    }
    if let Some(recording) = &status.recording {
        let reasons: Vec<_> = recording.dropped.iter().map(|(r, n)| format!("{n} {r}")).collect();
        // The error of a finished recording names its dropped sets already.
        match &recording.error {
            Some(e) => lost.push(format!("recording {}: {e}", recording.path)),
            None if reasons.is_empty() => {}
            None => {
                lost.push(format!("recording {}: sets not recorded: {}", recording.path, reasons.join(", ")));
            }
        }
    }
    lost
}
