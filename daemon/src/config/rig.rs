//! From the tables of the file to [`RigConfig`], with the checks that concern more than one key.

use super::read::{FromToml, Report, Section};
use super::value::{above_zero, not_empty, rate, resolve, within};
use super::{
    BusConfig, ColorCodec, ConfigError, ControlConfig, DepthCodec, MAX_CAMERAS, Phase, Port, RecordingConfig,
    RigConfig, SetsConfig, SignalConfig, SupervisorConfig, camera, link, refine, ros2,
};
use crate::family::Family;
use depthrig_bus::{RigName, SignalName};
use std::path::{Path, PathBuf};
use toml::de::DeTable;

/// Everything that `text` says, or every problem that it has. Its cameras are of `families`.
pub(super) fn parse(text: &str, path: Option<&Path>, families: &[Family]) -> Result<RigConfig, ConfigError> {
    let shown = path.map_or_else(|| "configuration".to_owned(), |p| p.display().to_string());
    let path = path.map(absolute);
    let report = Report::new(text);
    let config = read(&report, text, path.as_deref(), families);
    match (report.into_problems(), config) {
        (problems, Some(config)) if problems.is_empty() => Ok(config),
        (problems, _) => Err(ConfigError::new(shown, problems)),
    }
}

/// As [`parse`], for callers that look at the report. `None` only after a problem was noted.
pub(super) fn read(
    report: &Report<'_>,
    text: &str,
    path: Option<&Path>,
    families: &[Family],
) -> Option<RigConfig> {
    let (document, errors) = DeTable::parse_recoverable(text);
    // A table parsed from damaged text is guesswork; checking it would only add noise.
    if !errors.is_empty() {
        for e in errors {
            report.problem(e.span().map_or(0, |s| s.start), e.message().replace('\n', ", "));
        }
        return None;
    }
    let base = path.and_then(Path::parent).map(Path::to_owned);
    let base = base.or_else(|| std::env::current_dir().ok()).unwrap_or_default();
    let top = Section::top(report, document.get_ref());
    let rig = top.required::<RigName>("rig", "\"mount\"");
    let calibration = top.or("calibration", None, |path: &Option<PathBuf>| match path {
        Some(path) => not_empty(path),
        None => Ok(()),
    });
    let calibration = calibration.map(|path| resolve(&base, &path));
    let bus = bus(&top);
    let sets = sets(&top);
    let recording = recording(&top, &base);
    let control = control(&top);
    let supervisor = supervisor(&top);
    let cdm = refine::cdm(&top, &base);
    let cameras = cameras(&top, &base, families);
    let signals = signals(&top);
    let link = link::read(&top, &base);
    let ros2 = ros2::read(&top, &base);
    check_set_rate(&top, &sets, &cameras);
    top.finish();
    let text = text.to_owned();
    let path = path.map(Path::to_owned);
    let mut cameras = cameras.into_iter().collect::<Option<Vec<_>>>()?;
    // Networks run in the library that is named once for all of them.
    for stereo in cameras.iter_mut().filter_map(|c| c.stereo.as_mut()) {
        stereo.library.clone_from(&cdm.library);
    }
    Some(RigConfig {
        rig: rig?.value,
        bus,
        sets,
        recording,
        control,
        supervisor,
        cdm,
        calibration,
        calibration_text: String::new(),
        cameras,
        signals,
        link,
        ros2,
        text,
        path,
    })
}

fn bus(top: &Section<'_, '_>) -> BusConfig {
    let s = top.table("bus", "[bus]");
    let slots = s.or("slots", BusConfig::default().slots, within(depthrig_bus::shm::MIN_SLOTS..=1024));
    s.finish();
    BusConfig { slots }
}

fn sets(top: &Section<'_, '_>) -> SetsConfig {
    let d = SetsConfig::default();
    let s = top.table("sets", "[sets]");
    let rate_hz = s.or("rate_hz", d.rate_hz, |hz| rate(*hz));
    let max_wait_ms = s.or("max_wait_ms", None, |wait: &Option<f64>| match wait {
        Some(ms) => above_zero(60_000.0)(ms),
        None => Ok(()),
    });
    let phase = s.choice("phase", &[("auto", Phase::Auto), ("fixed", Phase::Fixed)], d.phase);
    s.finish();
    SetsConfig { rate_hz, max_wait_ms, phase }
}

const COLOR: [(&str, ColorCodec); 3] =
    [("jpeg", ColorCodec::Jpeg), ("png", ColorCodec::Png), ("raw", ColorCodec::Raw)];

fn recording(top: &Section<'_, '_>, base: &Path) -> RecordingConfig {
    let d = RecordingConfig::default();
    let s = top.table("recording", "[recording]");
    let directory = s.or("directory", d.directory, |p| not_empty(p));
    let allow = s.or("allow", d.allow, |paths: &Vec<PathBuf>| paths.iter().try_for_each(|p| not_empty(p)));
    let config = RecordingConfig {
        directory: resolve(base, &directory),
        allow: allow.iter().map(|p| resolve(base, p)).collect(),
        jpeg_quality: s.or("jpeg_quality", d.jpeg_quality, within(1..=100)),
        color: s.choice("color", &COLOR, d.color),
        depth: s.choice("depth", &[("zstd", DepthCodec::Zstd), ("rank", DepthCodec::Rank)], d.depth),
        segment_max_mb: s.or("segment_max_mb", d.segment_max_mb, within(1..=1 << 20)),
        segment_max_s: s.or("segment_max_s", d.segment_max_s, within(1..=86_400)),
        workers: s.or("workers", d.workers, within(0..=super::MAX_WORKERS)),
        queue_sets: s.or("queue_sets", d.queue_sets, within(1..=super::MAX_QUEUE_SETS)),
        reserve_mb: s.or("reserve_mb", d.reserve_mb, within(0..=1 << 30)),
        min_minutes: s.or("min_minutes", d.min_minutes, within(0..=100_000)),
        recover_on_start: s.or("recover_on_start", d.recover_on_start, |_| Ok(())),
    };
    s.finish();
    config
}

fn control(top: &Section<'_, '_>) -> ControlConfig {
    let s = top.table("control", "[control]");
    let d = ControlConfig::default();
    let is_loopback = |port: &Port| match port {
        Port::At(a) if !a.ip().is_loopback() => Err(format!(
            "must be a loopback address such as 127.0.0.1:{}, not {a}: the API is not encrypted; forward a port over SSH \
             instead",
            a.port()
        )),
        _ => Ok(()),
    };
    let tcp = s.or("tcp", d.tcp, is_loopback);
    let foxglove = s.or("foxglove", d.foxglove, is_loopback);
    s.finish();
    ControlConfig { tcp, foxglove }
}

fn supervisor(top: &Section<'_, '_>) -> SupervisorConfig {
    let d = SupervisorConfig::default();
    let s = top.table("supervisor", "[supervisor]");
    let stall_s = s.or("stall_s", d.stall_s, above_zero(3600.0));
    let backoff_min_s = s.or("backoff_min_s", d.backoff_min_s, above_zero(3600.0));
    let backoff_max_s = s.or("backoff_max_s", d.backoff_max_s.max(backoff_min_s), |most: &f64| {
        above_zero(3600.0)(most)?;
        if *most < backoff_min_s {
            return Err(format!("is {most}, less than backoff_min_s, which is {backoff_min_s}"));
        }
        Ok(())
    });
    let raise_priority = s.or("raise_priority", d.raise_priority, |_| Ok(()));
    s.finish();
    SupervisorConfig { stall_s, backoff_min_s, backoff_max_s, raise_priority }
}

/// A camera that has a problem is `None`.
fn cameras(top: &Section<'_, '_>, base: &Path, families: &[Family]) -> Vec<Option<super::CameraConfig>> {
    let Some(sections) = top.tables("camera", "[[camera]]") else { return vec![None] };
    if sections.is_empty() {
        top.problem(top.at, "the rig has no camera; add a [[camera]] table");
    }
    if let Some(s) = sections.get(MAX_CAMERAS) {
        s.problem(s.at, format!("a rig has at most {MAX_CAMERAS} cameras"));
    }
    let mut names = Vec::new();
    sections.into_iter().map(|s| camera::read(s, base, families, &mut names)).collect()
}

fn signals(top: &Section<'_, '_>) -> Vec<SignalConfig> {
    let mut signals: Vec<SignalConfig> = Vec::new();
    for s in top.tables("signal", "[[signal]]").into_iter().flatten() {
        let name = s.required::<String>("name", "\"arm/joint_position\"");
        let required = s.or("required", false, |_| Ok(()));
        let silent_s = s.or("silent_s", 1.0, above_zero(3600.0));
        if let Some(found) = name {
            match found.value.parse::<SignalName>() {
                Err(e) => s.problem(found.at, e.to_string()),
                Ok(name) if signals.iter().any(|other| other.name == name) => {
                    s.problem(found.at, format!("signal {name} is named twice; remove one of its tables"));
                }
                Ok(name) => signals.push(SignalConfig { name, required, silent_s }),
            }
        }
        s.finish();
    }
    signals
}

/// Sets faster than every camera would all be incomplete. Only rates that the file itself gives are known here.
fn check_set_rate(top: &Section<'_, '_>, sets: &SetsConfig, cameras: &[Option<super::CameraConfig>]) {
    let fastest = |c: &Option<super::CameraConfig>| {
        let camera = c.as_ref()?;
        camera.backend.fastest_rate_hz(&camera.streams)
    };
    let Some(rates) = cameras.iter().map(fastest).collect::<Option<Vec<_>>>() else { return };
    let most = rates.into_iter().fold(0.0, f64::max);
    if most > 0.0 && sets.rate_hz > most {
        let s = top.table("sets", "[sets]");
        let at = s.get::<f64>("rate_hz").map_or(s.at, |f| f.at);
        let why =
            format!("is {} sets a second, but the fastest camera gives {most} frames a second", sets.rate_hz);
        top.problem(at, format!("{} {why}; lower it", s.key_of("rate_hz")));
    }
}

fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

impl<T: FromToml> FromToml for Option<T> {
    fn from_toml(value: &toml::de::DeValue<'_>) -> Result<Self, String> {
        T::from_toml(value).map(Some)
    }
}

impl FromToml for PathBuf {
    fn from_toml(value: &toml::de::DeValue<'_>) -> Result<Self, String> {
        String::from_toml(value).map(Self::from)
    }
}

impl FromToml for Port {
    fn from_toml(value: &toml::de::DeValue<'_>) -> Result<Self, String> {
        if let toml::de::DeValue::Integer(_) = value {
            return u16::from_toml(value).map(Self::loopback);
        }
        let text = String::from_toml(value)?;
        if text == "off" {
            return Ok(Self::Off);
        }
        text.parse().map(Self::At).map_err(|_| {
            format!("must be an address and a port such as \"127.0.0.1:8642\", or \"off\"; it is \"{text}\"")
        })
    }
}
