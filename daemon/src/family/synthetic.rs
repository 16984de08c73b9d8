//! Simulated cameras (`synthetic`).
//!
//! The driver knows the limits of its numbers, so it is the one that is asked, key by key: each value is put into an
//! otherwise default configuration, and the driver's error is reported at the key's own line.

use super::{BackendConfig, CameraSettings, Family, Offered, OpenContext, Preparation, Reader, Source};
use crate::config::pose::pose;
use crate::config::read::{FromToml, Located, Section, nearest};
use crate::config::value::resolve;
use depthrig_bus::files;
use depthrig_calibrate::board::{Board, Drawing, Paper};
use depthrig_driver::{Backend, Error, ErrorKind, Result, StreamRequest, choose_profiles};
use depthrig_sim::synthetic::board::{Black, BoardMotion, BoardScene, Sheet};
use depthrig_sim::synthetic::models::MODELS;
use depthrig_sim::synthetic::{
    self, ClockSim, Drawing as SceneDrawing, FaultKind, ScheduledFault, StreamOverride, SyntheticBackend,
    SyntheticConfig, imu, profiles,
};
use std::path::{Path, PathBuf};

/// A description of a board is no longer than this, bytes.
const BOARD_MAX_BYTES: u64 = 64 << 10;

pub(super) const FAMILY: Family = Family::new("synthetic", |r| Some(BackendConfig::new(read(r))));

fn read(r: &Reader<'_>) -> SyntheticConfig {
    let s = r.section;
    let name = r.name;
    let streams = r.streams;
    let d = SyntheticConfig::default();
    // Two cameras of one model must differ in their serial numbers, and the name is unique already.
    let serial = s.get::<String>("serial").map_or_else(|| format!("sim-{name}"), |f| f.value);
    let mut config = SyntheticConfig {
        model: model(s, d.model),
        serial,
        seed: field(s, "seed", d.seed, |c, v| c.seed = v),
        pose_on_mount: r.pose,
        streams: Vec::new(),
        truth: field(s, "truth", d.truth, |c, v| c.truth = v),
        // Who asks for its stream by name need not switch it on besides.
        motion: field(s, "motion", d.motion, |c, v| c.motion = v)
            || streams.iter().any(|w| w.request.stream.as_str() == imu::STREAM),
        clock: clock(s),
        faults: s.tables("fault", "[[camera.fault]]").into_iter().flatten().filter_map(fault).collect(),
        poses: field(s, "poses", d.poses, |c, v| c.poses = v),
        pose_rate_hz: field(s, "pose_rate_hz", d.pose_rate_hz, |c, v| c.pose_rate_hz = v),
        phase: field(s, "phase", d.phase, |c, v| c.phase = v),
        cache_dir: s.get::<PathBuf>("cache_dir").map_or(d.cache_dir, |f| resolve(r.base, &f.value)),
        cheap: field(s, "cheap", d.cheap, |c, v| c.cheap = v),
        gain: field(s, "gain", d.gain, |c, v| c.gain = v),
        ring_frames: field(s, "ring_frames", d.ring_frames, |c, v| c.ring_frames = v),
        board: s.has("board").then(|| board(s, r.base)),
        arm: field(s, "arm", d.arm, |c, v| c.arm = v),
    };
    for wanted in streams {
        let StreamRequest { stream, size, rate_hz, .. } = wanted.request.clone();
        config.streams.push(StreamOverride { stream, size, rate_hz });
        // Each alone, so that each has its own problem; problems elsewhere were reported already.
        let problem = problem_of(|c| {
            (c.model, c.truth, c.cheap) = (config.model.clone(), config.truth, config.cheap);
            c.motion = config.motion;
            c.streams.extend(config.streams.last().cloned());
        });
        let problem = problem.or_else(|| {
            let modes = profiles(&config).ok()?;
            Some(choose_profiles("it", &modes, std::slice::from_ref(&wanted.request)).err()?.to_string())
        });
        if let Some(why) = problem {
            s.problem(wanted.at, format!("[[camera]] \"{name}\": {why}"));
        }
    }
    config
}

/// The highest rate among the streams that `config` starts on `requests`, Hz.
fn fastest_rate_hz(config: &SyntheticConfig, requests: &[StreamRequest]) -> Result<f64> {
    let chosen = choose_profiles("", &profiles(config)?, requests)?;
    let images = chosen.iter().filter(|p| !p.format.is_motion());
    Ok(images.map(|p| p.rate_hz).fold(0.0, f64::max))
}

fn model(s: &Section<'_, '_>, default: String) -> String {
    let Some(Located { value, at }) = s.get::<String>("model") else { return default };
    if let Some(why) = problem_of(|c| c.model.clone_from(&value)) {
        let near = nearest(&value, MODELS.iter().map(|m| m.name));
        let advice = near.map(|near| format!("; did you mean \"{near}\"?")).unwrap_or_default();
        s.problem(at, format!("{}: {why}{advice}", s.key_of("model")));
        return default;
    }
    value
}

fn clock(camera: &Section<'_, '_>) -> ClockSim {
    let table = camera.table("clock", "[camera.clock]");
    let s = &table;
    let d = ClockSim::default();
    let config = ClockSim {
        start_ticks: field(s, "start_ticks", d.start_ticks, |c, v| c.clock.start_ticks = v),
        counter_bits: field(s, "counter_bits", d.counter_bits, |c, v| c.clock.counter_bits = v),
        drift_ppm: field(s, "drift_ppm", d.drift_ppm, |c, v| c.clock.drift_ppm = v),
        thermal_ppm: field(s, "thermal_ppm", d.thermal_ppm, |c, v| c.clock.thermal_ppm = v),
        thermal_period_s: field(s, "thermal_period_s", d.thermal_period_s, |c, v| {
            c.clock.thermal_period_s = v;
        }),
        stamp_jitter_us: field(s, "stamp_jitter_us", d.stamp_jitter_us, |c, v| c.clock.stamp_jitter_us = v),
        latency_ms: field(s, "latency_ms", d.latency_ms, |c, v| c.clock.latency_ms = v),
        latency_jitter_ms: field(s, "latency_jitter_ms", d.latency_jitter_ms, |c, v| {
            c.clock.latency_jitter_ms = v;
        }),
        stall_probability: field(s, "stall_probability", d.stall_probability, |c, v| {
            c.clock.stall_probability = v;
        }),
        stall_ms: field(s, "stall_ms", d.stall_ms.into(), |c, v: [f64; 2]| c.clock.stall_ms = v.into())
            .into(),
        reset_at_s: field(s, "reset_at_s", d.reset_at_s, |c, v| c.clock.reset_at_s = v),
    };
    table.finish();
    config
}

fn board(camera: &Section<'_, '_>, base: &Path) -> BoardScene {
    let table = camera.table("board", "[camera.board]");
    let s = &table;
    let d = BoardScene::default();
    let with = |change: &dyn Fn(&mut BoardScene)| {
        let mut board = BoardScene::default();
        change(&mut board);
        Some(board)
    };
    let motions = BoardMotion::ALL.map(|m| (wire_name(m), m));
    let motions = motions.each_ref().map(|(name, motion)| (name.as_str(), *motion));
    let scene = BoardScene {
        file: s.required::<PathBuf>("file", "\"board.toml\"").map_or(d.file, |f| resolve(base, &f.value)),
        sheet: d.sheet,
        motion: s.choose("motion", &motions).unwrap_or(d.motion),
        seed: field(s, "seed", d.seed, |_, _| ()),
        hold_s: field(s, "hold_s", d.hold_s, |c, v| c.board = with(&|b| b.hold_s = v)),
        displaced: pose(s, "displaced", "displaced = { }"),
        depth_scale: field(s, "depth_scale", d.depth_scale, |c, v| {
            c.board = with(&|b| b.depth_scale = v);
        }),
        depth_offset_mm: field(s, "depth_offset_mm", d.depth_offset_mm, |c, v| {
            c.board = with(&|b| b.depth_offset_mm = v);
        }),
    };
    table.finish();
    scene
}

/// The print that a board's description stands for.
fn sheet(path: &Path) -> Result<Sheet> {
    let wrong = |why: String| Error::new(ErrorKind::BadInput, format!("board {}: {why}", path.display()));
    let text = files::read_to_string(path, BOARD_MAX_BYTES)
        .map_err(|e| wrong(format!("cannot be read ({e}); `depthrig calibrate board` writes one")))?;
    let board = Board::from_toml(&text).map_err(|e| wrong(e.to_string()))?;
    let drawing = Drawing::new(&board, Paper::around(&board)).map_err(|e| wrong(e.to_string()))?;
    let metres = board.scale() * 1e-3;
    let black = drawing.black.iter().map(|r| Black {
        x_m: r.x * metres,
        y_m: r.y * metres,
        width_m: r.width * metres,
        height_m: r.height * metres,
    });
    let size_m = [drawing.paper.width_mm * metres, drawing.paper.height_mm * metres];
    Ok(Sheet { size_m, black: black.collect() })
}

fn fault(s: Section<'_, '_>) -> Option<ScheduledFault> {
    let names = FaultKind::ALL.map(|kind| (wire_name(kind), kind));
    let kinds = names.each_ref().map(|(name, kind)| (name.as_str(), *kind));
    let at_s = s.required::<f64>("at_s", "3.0");
    if !s.has("kind") {
        s.required::<String>("kind", "\"unplug\"");
    }
    let kind = s.choose("kind", &kinds);
    let duration_s = s.or("duration_s", 1.0, |_| Ok(()));
    let count = s.or("count", 1, |_| Ok(()));
    let at = s.at;
    let fault =
        at_s.zip(kind).map(|(at_s, kind)| ScheduledFault { at_s: at_s.value, kind, duration_s, count });
    if let Some(why) = fault.and_then(|f| problem_of(|c| c.faults.push(f))) {
        s.problem(at, why);
    }
    s.finish();
    fault
}

/// The name that serde gives a variant.
fn wire_name(kind: impl serde::Serialize) -> String {
    serde_json::to_value(kind).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
}

/// The value of `key`, put into the configuration by `set`, else `default`.
fn field<T: FromToml + Clone>(
    s: &Section<'_, '_>,
    key: &'static str,
    default: T,
    set: impl FnOnce(&mut SyntheticConfig, T),
) -> T {
    let Some(Located { value, at }) = s.get::<T>(key) else { return default };
    match problem_of(|c| set(c, value.clone())) {
        None => value,
        Some(why) => {
            s.problem(at, format!("{}: {why}", s.key_of(key)));
            default
        }
    }
}

/// The driver's error for a default configuration after `change`.
fn problem_of(change: impl FnOnce(&mut SyntheticConfig)) -> Option<String> {
    let mut config = SyntheticConfig::default();
    change(&mut config);
    let text = profiles(&config).err()?.to_string();
    // The driver names the camera, which here is the default one; the caller knows the real one.
    Some(match text.strip_prefix(&config.label()) {
        Some(what) => what.strip_prefix(": ").map_or_else(|| format!("it{what}"), str::to_owned),
        None => text,
    })
}

impl CameraSettings for SyntheticConfig {
    fn name(&self) -> &'static str {
        FAMILY.name
    }

    fn driver(&self, context: &OpenContext<'_>) -> Result<Box<dyn Backend>> {
        let backend = SyntheticBackend::with_drawing(vec![self.clone()], context.began, context.drawing)?;
        Ok(Box::new(backend))
    }

    fn source(&self) -> Source<'_> {
        let device = format!("simulated {} {}", self.model, self.serial);
        Source::Here(profiles(self).map(|profiles| Offered { device, profiles }))
    }

    fn fastest_rate_hz(&self, streams: &[StreamRequest]) -> Option<f64> {
        fastest_rate_hz(self, streams).ok()
    }

    fn prepare(&mut self, given: &Preparation<'_>) -> Result<()> {
        self.pose_on_mount = given.pose;
        if let Some(dir) = given.cache_dir {
            dir.clone_into(&mut self.cache_dir);
        }
        if let Some(board) = &mut self.board {
            board.sheet = sheet(&board.file)?;
        }
        given.render.map_or(Ok(()), |progress| synthetic::prepare(self, progress))
    }

    fn add_to_drawing(&self, drawing: &SceneDrawing) -> Result<()> {
        drawing.plan(self)
    }
}
