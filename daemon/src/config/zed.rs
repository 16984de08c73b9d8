//! The keys of a `zed` camera: one that is attached, or a recording of one (`input`). Limits that only the camera knows
//! (its modes, its controls) are checked when it is started.

use super::read::Section;
use super::value::{not_empty, rate, resolve, within};
use super::wanted::WantedStream;
use super::{BackendConfig, StereoConfig, ZedReplaySettings, ZedSettings};
use super::{controls, stereo};
use depthrig_drivers::motion::IMU;
use depthrig_drivers::zed::{CalibrationFile, STREAMS};
use std::path::{Path, PathBuf};

/// Keys that a camera that is attached has and a recording has not.
const LIVE_KEYS: [&str; 7] =
    ["port", "auto_exposure", "exposure_percent", "gain_percent", "led", "controls", "motion"];

/// Reads the settings of a camera that is asked for `streams`.
pub(super) fn read(
    s: &Section<'_, '_>,
    base: &Path,
    streams: &[WantedStream],
    depth: Option<&StereoConfig>,
) -> BackendConfig {
    let path = |key| s.or(key, None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    let serial = s.or("serial", None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let calibration = match path("calibration") {
        None => CalibrationFile::Known,
        Some(none) if none.as_os_str() == "none" => CalibrationFile::None,
        Some(path) => CalibrationFile::At(resolve(base, &path)),
    };
    // A recording has the left and right images alone.
    let own: &[&str] = if s.has("input") { &STREAMS } else { &[STREAMS[0], STREAMS[1], IMU] };
    stereo::check_streams(s, "a ZED", own, depth, streams);
    if depth.is_some() && calibration == CalibrationFile::None {
        let why = "stereo needs the factory calibration; remove calibration = \"none\", or [camera.stereo]";
        s.problem(s.at_key("calibration"), why);
    }
    if let Some(input) = path("input") {
        for key in LIVE_KEYS.into_iter().filter(|k| s.has(k)) {
            s.problem(
                s.at_key(key),
                format!(
                    "{} is for a camera that is attached, and input plays a recording; keep one",
                    s.key_of(key)
                ),
            );
        }
        return BackendConfig::ZedReplay(ZedReplaySettings {
            input: resolve(base, &input),
            serial,
            calibration,
            rate_hz: s.or("rate_hz", None, |r| r.map_or(Ok(()), rate)),
            looped: s.or("loop", false, |_| Ok(())),
        });
    }
    if depth.is_some_and(|d| d.every_pair) {
        s.problem(
            s.at,
            "[camera.stereo] every_pair = true is for a recording (input): a camera does not wait",
        );
    }
    BackendConfig::Zed(live(s, serial, calibration))
}

fn live(s: &Section<'_, '_>, serial: Option<String>, calibration: CalibrationFile) -> ZedSettings {
    let percent = |key| s.or(key, None, |p: &Option<u8>| p.as_ref().map_or(Ok(()), within(0..=100)));
    let flag = |key| s.get::<bool>(key).map(|f| f.value);
    let config = ZedSettings {
        serial,
        port: s.or("port", None, |t: &Option<String>| controls::not_blank(t.as_deref())),
        calibration,
        auto_exposure: flag("auto_exposure"),
        exposure_percent: percent("exposure_percent"),
        gain_percent: percent("gain_percent"),
        led: flag("led"),
        controls: controls::read(s, "controls", "controls = { }"),
        without_motion: flag("motion") == Some(false),
    };
    if config.auto_exposure == Some(true) {
        let set = [config.exposure_percent.is_some(), config.gain_percent.is_some()];
        for (key, _) in ["exposure_percent", "gain_percent"].into_iter().zip(set).filter(|(_, set)| *set) {
            let why = "cannot be set while auto_exposure is true; keep one";
            s.problem(s.at_key(key), format!("{} {why}", s.key_of(key)));
        }
    }
    config
}
