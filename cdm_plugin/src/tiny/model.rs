//! The trained network and the record of its training, both part of the program.

use crate::durable::hex;
use crate::model::model_id;
use crate::{Error, ErrorKind, Result};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::path::Path;
use std::sync::{Arc, OnceLock};

/// The network: ONNX, `python/src/depthrig/lab/nets/export.py`.
pub(super) const BYTES: &[u8] = include_bytes!("../../models/tiny.onnx");
/// The record of its training, TOML: data, settings, and how good it is.
pub const RECORD: &str = include_str!("../../models/tiny.toml");
/// Larger networks of others are refused, bytes.
const FILE_MAX_BYTES: u64 = 64 << 20;

/// The network of the program, in short.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TinyModel {
    /// Id in headers and reports: `tiny` and the beginning of the hash, such as `tiny@1f2e3d4c`; `untrained-tiny@…` where its
    /// record says so.
    pub id: String,
    /// SHA-256 of the network, in hexadecimal digits.
    pub sha256: String,
    /// Size of the network, bytes.
    pub bytes: u64,
    /// Whether it was trained.
    pub is_trained: bool,
    /// Whether `engine = "auto"` may choose it: its record says so, and is of this network.
    pub is_default: bool,
}

/// A network of this form that somebody trained for their own camera.
#[derive(Debug, Clone)]
pub struct TinyFile {
    /// Id in headers and reports: the file's name without its ending, and the beginning of its hash.
    pub id: String,
    pub(super) bytes: Arc<[u8]>,
}

impl TinyFile {
    /// Reads the file that `depthrig.lab.train` writes: ONNX. The form of the network is checked when it is opened.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when the file is not there, [`ErrorKind::BadModel`] when it cannot be read or is too large.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = depthrig_bus::files::read(path, FILE_MAX_BYTES).map_err(|e| {
            let missing = e.kind() == std::io::ErrorKind::NotFound;
            let kind = if missing { ErrorKind::NotFound } else { ErrorKind::BadModel };
            let message = format!(
                "{}: cannot be read: {e}; name the tiny.onnx that depthrig.lab.train wrote",
                path.display()
            );
            Error::new(kind, message).with_source(e)
        })?;
        let name = path.file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
        let id = model_id(&name, &hex(&Sha256::digest(&bytes)), true);
        Ok(Self { id, bytes: bytes.into() })
    }
}

/// Whether a path is one of a [`TinyFile`]: it ends in `.onnx`.
pub fn is_tiny_file(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "onnx")
}

/// The part of the record that the program acts on.
#[derive(Debug, Deserialize)]
struct Record {
    sha256: String,
    #[serde(default)]
    default: bool,
    #[serde(default = "yes")]
    trained: bool,
}

const fn yes() -> bool {
    true
}

/// The network of this program; hashed at the first call.
pub fn model() -> &'static TinyModel {
    static MODEL: OnceLock<TinyModel> = OnceLock::new();
    MODEL.get_or_init(|| read(BYTES, RECORD))
}

fn read(bytes: &[u8], record: &str) -> TinyModel {
    let sha256 = hex(&Sha256::digest(bytes));
    let record: Option<Record> = toml::from_str(record).ok();
    let is_trained = record.as_ref().is_none_or(|r| r.trained);
    let is_default = record.is_some_and(|r| r.default && r.trained && r.sha256 == sha256);
    let id = model_id("tiny", &sha256, is_trained);
    TinyModel { id, sha256, bytes: bytes.len() as u64, is_trained, is_default }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_record_is_of_the_network_and_the_network_is_small() {
        let record: Record = toml::from_str(RECORD).unwrap();
        assert_eq!(
            record.sha256,
            model().sha256,
            "models/tiny.toml is the record of another models/tiny.onnx"
        );
        assert_eq!((record.default, record.trained), (model().is_default, model().is_trained));
        assert!(model().bytes <= 4 << 20, "{} bytes", model().bytes);
        assert!(model().id.ends_with(&format!("tiny@{}", &model().sha256[..8])), "{}", model().id);
        let licence = toml::from_str::<toml::Table>(RECORD).unwrap();
        assert_eq!(licence["licence"].as_str(), Some("MIT OR Apache-2.0"));
    }

    #[test]
    fn only_a_record_of_this_very_network_makes_it_a_default() {
        let hash = hex(&Sha256::digest(b"network"));
        let of = |record: &str| read(b"network", record).is_default;
        assert!(of(&format!("sha256 = \"{hash}\"\ndefault = true\n[metrics]\nl1 = 0.1")));
        assert!(!of(&format!("sha256 = \"{hash}\"\ndefault = false")));
        assert!(!of(&format!("sha256 = \"{hash}\"")));
        assert!(!of(&format!("sha256 = \"{}\"\ndefault = true", hash.replace(['0', '1', 'a'], "2"))));
        assert!(!of(&format!("sha256 = \"{hash}\"\ndefault = true\ntrained = false")));
        assert!(!of("default = true") && !of("not TOML"));
    }
}
