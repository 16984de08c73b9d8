//! The keys of a `zed` camera. What the camera itself decides (its modes, its controls) is checked when it is started.

use super::ZedSettings;
use super::camera::WantedStream;
use super::controls;
use super::read::Section;
use super::rig::{not_empty, resolve, within};
use depthrig_drivers::zed::{CalibrationFile, STREAMS};
use std::path::{Path, PathBuf};

/// Reads the settings of a camera that is asked for `streams`.
pub(super) fn read(s: &Section<'_, '_>, base: &Path, streams: &[WantedStream]) -> ZedSettings {
    let text = |key| s.or(key, None, |t: &Option<String>| controls::not_blank(t.as_deref()));
    let percent = |key| s.or(key, None, |p: &Option<u8>| p.as_ref().map_or(Ok(()), within(0..=100)));
    let flag = |key| s.get::<bool>(key).map(|f| f.value);
    let calibration = s.or("calibration", None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    let config = ZedSettings {
        serial: text("serial"),
        port: text("port"),
        calibration: match calibration {
            None => CalibrationFile::Known,
            Some(none) if none.as_os_str() == "none" => CalibrationFile::None,
            Some(path) => CalibrationFile::At(resolve(base, &path)),
        },
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
    for wanted in streams {
        let name = wanted.request.stream.as_str();
        if !STREAMS.contains(&name) {
            let why = format!("a ZED has no stream \"{name}\"; it has: {}", STREAMS.join(", "));
            s.problem(wanted.at, why);
        }
    }
    config
}
