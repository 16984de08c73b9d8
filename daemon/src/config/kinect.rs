//! The keys of a `kinect` camera. Limits that only the camera knows (the range of its controls, its jacks) are checked
//! when it is started.

use super::KinectSettings;
use super::controls;
use super::read::Section;
use super::value::{not_empty, resolve, within};
use super::wanted::WantedStream;
use core::ops::RangeInclusive;
use depthrig_drivers::kinect::live::{CONTROLS, LiveConfig, Places, STREAMS};
use depthrig_drivers::kinect::playback::{CalibrationSource, PlaybackConfig};
use depthrig_drivers::kinect::{DepthMode, WiredSync};
use std::path::{Path, PathBuf};

/// The longest period of images, microseconds; at a faster rate the camera is refused when it is started.
const LONGEST_PERIOD_US: i32 = 200_000;

/// How fast a recording may play, seconds of it per second.
const RATES: RangeInclusive<f64> = 0.05..=20.0;

/// Reads the settings of a camera that is asked for `streams`.
pub(super) fn read(s: &Section<'_, '_>, base: &Path, streams: &[WantedStream]) -> KinectSettings {
    for wanted in streams {
        let name = wanted.request.stream.as_str();
        if !STREAMS.contains(&name) {
            let why = format!("a Kinect has no stream \"{name}\"; it has: {}", STREAMS.join(", "));
            s.problem(wanted.at, why);
        }
    }
    if s.has("recording") {
        return KinectSettings::Recorded(recorded(s, base));
    }
    KinectSettings::Live(live(s, base, streams))
}

/// A recording that plays: its device is not asked for anything.
fn recorded(s: &Section<'_, '_>, base: &Path) -> PlaybackConfig {
    let path = |key| s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    PlaybackConfig {
        recording: path("recording").map(|p| resolve(base, &p)).unwrap_or_default(),
        looped: s.get::<bool>("loop").is_some_and(|looped| looped.value),
        rate: s.or("rate", 1.0, within(RATES)),
        calibration: match path("calibration") {
            None => CalibrationSource::Recorded,
            Some(none) if none.as_os_str() == "none" => CalibrationSource::None,
            Some(path) => CalibrationSource::At(resolve(base, &path)),
        },
    }
}

fn live(s: &Section<'_, '_>, base: &Path, streams: &[WantedStream]) -> LiveConfig {
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let path = |key| {
        let path = s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
        path.map(|p| resolve(base, &p))
    };
    let config = LiveConfig {
        serial: text("serial"),
        port: text("port"),
        places: Places { library: path("library"), engine: path("depth_engine") },
        depth_mode: s.choose("depth_mode", &DepthMode::ALL.map(|m| (m.name(), m))),
        sync: s.choice("sync", &WiredSync::ALL.map(|m| (m.name(), m)), WiredSync::Standalone),
        subordinate_delay_us: s.or("subordinate_delay_us", 0, within(0..=LONGEST_PERIOD_US as u32)),
        depth_delay_us: s.or("depth_delay_us", 0, within(-LONGEST_PERIOD_US..=LONGEST_PERIOD_US)),
        color_controls: controls::read(s, "color_controls", "color_controls = { }"),
        dark: s.get::<bool>("led").is_some_and(|led| !led.value),
    };
    if config.subordinate_delay_us != 0 && config.sync != WiredSync::Subordinate {
        let why = "is set, but only sync = \"subordinate\" has it";
        s.problem(s.at_key("subordinate_delay_us"), format!("{} {why}", s.key_of("subordinate_delay_us")));
    }
    let known = |name: &String| CONTROLS.iter().any(|(n, _)| n == name);
    if let Some(name) = config.color_controls.keys().find(|name| !known(name)) {
        let names: Vec<_> = CONTROLS.iter().map(|(name, _)| *name).collect();
        let why = format!("has \"{name}\", which a Kinect has not; it has: {}", names.join(", "));
        s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
    }
    let asks =
        |stream: &str| streams.is_empty() || streams.iter().any(|w| w.request.stream.as_str() == stream);
    if !config.color_controls.is_empty() && !asks("color") {
        let why = "is set, but color is not among the streams of its [[camera.stream]] tables";
        s.problem(s.at_key("color_controls"), format!("{} {why}", s.key_of("color_controls")));
    }
    if config.depth_mode == Some(DepthMode::PassiveIr)
        && let Some(depth) = streams.iter().find(|w| w.request.stream.as_str() == "depth")
    {
        s.problem(depth.at, "depth_mode = \"passive_ir\" gives no depth; ask for ir");
    }
    config
}
