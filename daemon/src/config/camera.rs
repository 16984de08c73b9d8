//! From a `[[camera]]` table to [`CameraConfig`]: the keys that all families share.

use super::pose::pose;
use super::read::{Located, Section};
use super::value::rate;
use super::wanted::WantedStream;
use super::{CameraConfig, StereoConfig, refine, stereo};
use crate::family::{Family, Reader};
use depthrig_bus::{CameraName, Name, PixelFormat, StreamName};
use depthrig_driver::StreamRequest;
use std::path::Path;

/// Reads one camera of one of `families`; `None` after a problem that leaves nothing to build on. `taken` are the names so far.
pub(super) fn read(
    mut s: Section<'_, '_>,
    base: &Path,
    families: &[Family],
    taken: &mut Vec<CameraName>,
) -> Option<CameraConfig> {
    let name = s.required::<CameraName>("name", "\"d435\"");
    if let Some(Located { value: name, at }) = &name {
        s.set_name(name.as_str());
        if taken.contains(name) {
            s.problem(
                *at,
                format!("camera name \"{name}\" is taken by an earlier camera; names must be unique"),
            );
        }
        taken.push(name.clone());
    }
    if !s.has("backend") {
        s.required::<String>("backend", "\"synthetic\"");
    }
    let names: Vec<_> = families.iter().map(|f| (f.name, f)).collect();
    let family = s.choose("backend", &names);
    let pose = pose(&s, "pose", "pose = { }");
    let wanted = streams(&s);
    let streams: Vec<_> = wanted.iter().map(|w| w.request.clone()).collect();
    let has_stereo = family.is_some_and(|f| f.has_stereo);
    let stereo = if has_stereo { stereo::read(&s, base) } else { None };
    let depth = stereo.as_ref().map_or_else(|| "depth".to_owned(), StereoConfig::first_depth);
    let refine = refine::read(&s, base, &wanted, &depth, refine::TABLE);
    let record = record(&s, &streams, refine.is_some());
    // Which keys belong to an unknown family is unknown too.
    let family = family?;
    let backend = (family.read)(&Reader {
        section: &s,
        base,
        name: name.as_ref().map_or("", |n| n.value.as_str()),
        pose,
        streams: &wanted,
        stereo: stereo.as_ref(),
    });
    s.finish();
    let name = name?.value;
    let backend = backend?;
    let streams = if streams.is_empty() { backend.default_streams() } else { streams };
    Some(CameraConfig {
        name,
        pose,
        streams,
        record,
        stereo,
        refine,
        backend,
        calibration: Vec::new(),
        depth: Vec::new(),
    })
}

fn streams(camera: &Section<'_, '_>) -> Vec<WantedStream> {
    let formats = PixelFormat::ALL.map(|f| (f.name(), f));
    let mut wanted: Vec<WantedStream> = Vec::new();
    for mut s in camera.tables("stream", "[[camera.stream]]").unwrap_or_default() {
        let name = s.required::<StreamName>("name", "\"depth\"");
        if let Some(Located { value, at }) = &name {
            s.set_name(value.as_str());
            if wanted.iter().any(|w| w.request.stream == *value) {
                s.problem(*at, format!("stream \"{value}\" is listed twice; keep one"));
            }
        }
        let side = |v: &u32| match v {
            1..=16_384 => Ok(()),
            _ => Err(format!("is {v} pixels; it must be within 1 and 16384")),
        };
        let width = s.or("width", None, |w| w.as_ref().map_or(Ok(()), side));
        let height = s.or("height", None, |h| h.as_ref().map_or(Ok(()), side));
        // A side that is given and wrong has its own problem already.
        if s.has("width") != s.has("height") {
            let (given, missing) = if s.has("width") { ("width", "height") } else { ("height", "width") };
            s.problem(s.at, format!("{} needs {missing} as well", s.key_of(given)));
        }
        let rate_hz = s.or("rate_hz", None, |r| r.map_or(Ok(()), rate));
        let format = s.choose("format", &formats);
        let at = s.at;
        s.finish();
        if let Some(name) = name {
            let request = StreamRequest { stream: name.value, size: width.zip(height), rate_hz, format };
            wanted.push(WantedStream { request, at });
        }
    }
    wanted
}

fn record(camera: &Section<'_, '_>, streams: &[StreamRequest], refined: bool) -> Option<Vec<StreamName>> {
    let Located { value, at } = camera.get::<Vec<Name>>("record")?;
    let computed = |r: &Name| refine::COMPUTED.contains(&r.as_str());
    if let Some(name) = value.iter().find(|r| computed(r) && !refined) {
        let why = format!("names \"{name}\", which only a camera with {} has", refine::TABLE);
        camera.problem(at, format!("{} {why}", camera.key_of("record")));
    }
    let unknown =
        value.iter().find(|r| !streams.is_empty() && !computed(r) && streams.iter().all(|s| s.stream != **r));
    if let Some(name) = unknown {
        let why = format!("names \"{name}\", which is not among the streams of its [[camera.stream]] tables");
        camera.problem(at, format!("{} {why}", camera.key_of("record")));
    }
    Some(value)
}
