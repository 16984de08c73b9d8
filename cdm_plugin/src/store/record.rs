//! `model.toml`: the record of an installed model.

use super::Import;
use crate::durable::Written;
use crate::weights::{Report, Weights};
use crate::{ChannelOrder, Encoder};
use depthrig_bus::clock::UtcPair;
use serde::{Deserialize, Serialize};
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// The form of the file that is written and read here.
const FORMAT: u32 = 1;

/// Record of an installed model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// The form of this file: 1.
    pub format: u32,
    /// The size of the network.
    pub encoder: Encoder,
    /// The order of the colour channels that it is given.
    pub channel_order: ChannelOrder,
    /// The shorter side of its input, pixels.
    pub input_size: u32,
    /// Raw depth beyond this is taken for a hole, metres.
    pub max_depth_m: f64,
    /// Whether its numbers were ever trained; those of [`write_seeded`](crate::weights::write_seeded) were not.
    pub trained: bool,
    /// The cameras that it is for.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// When it was installed, UTC.
    pub installed: String,
    /// The program that installed it.
    pub installed_by: String,
    /// Names of superfluous tensors in the file.
    #[serde(default)]
    pub left_out: Vec<String>,
    /// The weights as they lie here.
    pub weights: WeightsRecord,
    /// Where they came from.
    pub source: Source,
}

/// The weights as they lie in the model's folder.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WeightsRecord {
    /// SHA-256 of the file, in hexadecimal.
    pub sha256: String,
    /// Its size.
    pub bytes: u64,
    /// How many tensors it has.
    pub tensors: usize,
}

/// Where weights came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Source {
    /// A file on this computer.
    File {
        /// The file.
        path: String,
        /// SHA-256 of it, in hexadecimal.
        sha256: String,
        /// Its size.
        bytes: u64,
    },
    /// A server.
    Fetched {
        /// The address that was asked for.
        url: String,
        /// Revision of the repository, if the server reported it.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        revision: Option<String>,
        /// SHA-256 of the file, in hexadecimal.
        sha256: String,
        /// Reference of the hash: `given`, `known`, `server` or `nothing`.
        compared_with: String,
        /// Its size.
        bytes: u64,
        /// Its licence, as far as known.
        licence: String,
    },
}

impl Source {
    /// The file of `weights`, all of which is read for its hash.
    ///
    /// # Errors
    /// [`crate::ErrorKind::Io`] when it cannot be read.
    pub fn file(weights: &Weights) -> crate::Result<Self> {
        let path = std::path::absolute(weights.path()).unwrap_or_else(|_| weights.path().to_owned());
        let sha256 = weights.sha256()?;
        Ok(Self::File { path: path.display().to_string(), sha256, bytes: weights.file_bytes() })
    }
}

impl Record {
    /// The text of the file.
    pub(super) fn to_toml(&self) -> String {
        // Numbers, text and tables: none of it can fail to be TOML.
        toml::to_string(self).unwrap_or_default()
    }

    pub(super) fn from_toml(text: &str) -> Result<Self, String> {
        let record: Self = toml::from_str(text).map_err(|e| e.message().to_owned())?;
        if record.format != FORMAT {
            return Err(format!("is of form {}, and this program knows {FORMAT}", record.format));
        }
        Ok(record)
    }
}

/// The record of weights that were installed now.
pub(super) fn of(import: &Import, weights: &Weights, report: &Report, written: Written) -> Record {
    let now = UtcPair::sample().utc_ns;
    let now = OffsetDateTime::from_unix_timestamp(now / 1_000_000_000).unwrap_or(OffsetDateTime::UNIX_EPOCH);
    Record {
        format: FORMAT,
        encoder: report.encoder,
        channel_order: import.channel_order,
        input_size: import.input_size,
        max_depth_m: import.max_depth_m,
        trained: !weights.is_untrained(),
        cameras: import.cameras.clone(),
        installed: now.format(&Rfc3339).unwrap_or_default(),
        installed_by: concat!("depthrig ", env!("CARGO_PKG_VERSION")).to_owned(),
        left_out: report.extra.iter().map(|e| e.name.clone()).collect(),
        weights: WeightsRecord { sha256: written.sha256, bytes: written.bytes, tensors: report.good },
        source: import.source.clone(),
    }
}

/// For the fuzz target: reads a record, and sees that writing it changes nothing.
#[cfg(any(test, feature = "testing"))]
pub(crate) fn fuzz(text: &str) -> bool {
    let Ok(record) = Record::from_toml(text) else { return false };
    let again = Record::from_toml(&record.to_toml());
    // Compared as text, because a record may hold NaN.
    assert!(
        again.is_ok_and(|again| again.to_toml() == record.to_toml()),
        "a record changes by being written and read"
    );
    true
}
