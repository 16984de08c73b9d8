//! `calibration.json`: what the images are of, and how a pixel becomes a ray and a distance.

use super::images::MAX_SIDE;
use depthrig_recorder::{Error, ErrorKind, Result, Session, StreamRecord};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The version of the file.
const VERSION: &str = "depthrig.bytecameradepth/1";

/// The file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Calibration {
    pub format: String,
    pub session: SessionFacts,
    pub streams: Vec<StreamFacts>,
}

/// Who recorded what.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub(super) struct SessionFacts {
    pub name: String,
    pub rig: String,
    #[serde(default)]
    pub scene: String,
    #[serde(default)]
    pub operator: String,
    #[serde(default)]
    pub host: String,
    pub started_utc_ns: i64,
    #[serde(default)]
    pub depthrig_version: String,
    #[serde(default)]
    pub rig_config: String,
}

/// One stream: the images `folder/prefix_N.ending`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct StreamFacts {
    pub folder: String,
    pub prefix: String,
    pub ending: String,
    /// Other folders with the same files: the colour of a stereo camera is in the folder of each of its depth modes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub copies: Vec<String>,
    /// The pixel format in the recording, where the files have another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded_format: Option<String>,
    /// Metres per unit in the recording, where the files have another unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recorded_depth_unit_m: Option<f64>,
    /// Description of the files: format, size, `depth_unit_m`, intrinsics with distortion, pose, where they come from.
    #[serde(flatten)]
    pub stream: StreamRecord,
}

impl Calibration {
    pub(super) fn new(session: &Session, streams: Vec<StreamFacts>) -> Self {
        Self {
            format: VERSION.to_owned(),
            session: SessionFacts {
                name: session.name.clone(),
                rig: session.rig.clone(),
                scene: session.scene.clone(),
                operator: session.operator.clone(),
                host: session.host.clone(),
                started_utc_ns: session.started_utc_ns,
                depthrig_version: session.depthrig_version.clone(),
                rig_config: session.rig_config.clone(),
            },
            streams,
        }
    }

    pub(super) fn text(&self) -> Result<Vec<u8>> {
        let mut text = serde_json::to_vec_pretty(self)
            .map_err(|e| Error::new(ErrorKind::BadInput, "calibration cannot be written").with_source(e))?;
        text.push(b'\n');
        Ok(text)
    }

    pub(super) fn parse(text: &[u8], path: &Path) -> Result<Self> {
        let bad = |why: String| Error::new(ErrorKind::BadRecording, format!("{}: {why}", path.display()));
        let read: Self = serde_json::from_slice(text).map_err(|e| bad(format!("{e}")))?;
        if read.format != VERSION {
            return Err(bad(format!(
                "its format is \"{}\", this depthrig reads \"{VERSION}\"; remove the file to import without it",
                read.format
            )));
        }
        for (i, s) in read.streams.iter().enumerate() {
            let id = &s.stream.id;
            let same = |o: &StreamFacts| {
                o.stream.id == *id || (&o.folder, &o.prefix, &o.ending) == (&s.folder, &s.prefix, &s.ending)
            };
            if read.streams[..i].iter().any(same) {
                return Err(bad(format!("stream {id} or its files are there twice")));
            }
            if !matches!(s.ending.as_str(), "png" | "npy") {
                return Err(bad(format!(
                    "stream {id} is in \"{}\" files; png and npy can be read",
                    s.ending
                )));
            }
            let size = [s.stream.width, s.stream.height];
            if !size.iter().all(|side| (1..=MAX_SIDE).contains(side)) {
                return Err(bad(format!("stream {id} is {}x{}, an invalid image size", size[0], size[1])));
            }
            let is_folder = |name: &String| !name.contains(['/', ',']) && !name.starts_with('.');
            if !is_folder(&s.folder) || s.prefix.contains(['/', ',']) || !s.copies.iter().all(is_folder) {
                return Err(bad(format!("stream {id} lies in \"{}\", an invalid folder name", s.folder)));
            }
        }
        Ok(read)
    }
}
