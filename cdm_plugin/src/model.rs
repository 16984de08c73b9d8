//! A model ready for an engine: weights that were proven to be of its encoder, and how they want their input.

use crate::weights::verify;
use crate::{Encoder, Result, Weights};
use std::path::Path;
use std::sync::Arc;

/// The order of the colour channels that the network is given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ChannelOrder {
    /// As the official inference script feeds them: it turns blue-green-red around twice, so blue comes first, scaled by
    /// the mean and deviation of red.
    #[default]
    Bgr,
    /// Red, green, blue.
    Rgb,
}

/// A model ready for an engine.
#[derive(Debug, Clone)]
pub struct Model {
    /// Id in headers and reports: its name and the beginning of its hash, such as `cdm-d435@1f2e3d4c`; at most
    /// 31 bytes.
    pub id: String,
    /// The size of the network.
    pub encoder: Encoder,
    /// The weights, every name and shape of which was checked.
    pub weights: Arc<Weights>,
    /// The order of the colour channels.
    pub channel_order: ChannelOrder,
    /// The shorter side of the network's input when nothing else is asked for, pixels.
    pub input_size: u32,
    /// Raw depth beyond this is taken for a hole, metres (6 in the official script).
    pub max_depth_m: f64,
}

/// The shorter side of the network's input in the official script, pixels.
pub const INPUT_SIZE: u32 = 518;
/// Beyond this the official script takes raw depth for a hole, metres.
pub const MAX_DEPTH_M: f64 = 6.0;
/// The longest name of a model: with nine more bytes of its hash it fits into a header.
pub(crate) const MAX_NAME: usize = 22;
/// Prefix of the ids of untrained models in headers and reports.
const UNTRAINED: &str = "untrained-";

impl Model {
    /// A model from a checkpoint that is not installed, all of which is verified and hashed, and the settings of the
    /// official script; the fields may be changed afterwards.
    ///
    /// # Errors
    /// Those of [`Weights::open`] and [`verify()`](crate::weights::verify()).
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self> {
        let weights = Weights::open(path.as_ref())?;
        let encoder = verify(&weights)?;
        let name = path.as_ref().file_stem().map_or_else(String::new, |s| s.to_string_lossy().into_owned());
        let id = model_id(&name, &weights.sha256()?, !weights.is_untrained());
        Ok(Self::new(id, encoder, weights))
    }

    pub(crate) fn new(id: String, encoder: Encoder, weights: Weights) -> Self {
        Self {
            id,
            encoder,
            weights: Arc::new(weights),
            channel_order: ChannelOrder::default(),
            input_size: INPUT_SIZE,
            max_depth_m: MAX_DEPTH_M,
        }
    }

    /// Whether its numbers were ever trained; its [`Self::id`] begins with `untrained-` when not.
    pub fn is_trained(&self) -> bool {
        !self.id.starts_with(UNTRAINED.trim_end_matches('-'))
    }
}

/// [`Model::id`]: as much of the name as fits, and the beginning of the hash.
pub(crate) fn model_id(name: &str, sha256: &str, trained: bool) -> String {
    let plain = name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '-' });
    let mut id: String = plain.collect();
    if !trained && !id.starts_with(UNTRAINED) {
        id.insert_str(0, UNTRAINED);
    }
    id.truncate(MAX_NAME); // all of it is ASCII
    format!("{}@{}", id.trim_end_matches(['-', '.']), sha256.get(..8).unwrap_or(sha256))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_fits_into_a_header_and_says_what_is_untrained() {
        let hash = "0123456789abcdef";
        assert_eq!(model_id("cdm-d435", hash, true), "cdm-d435@01234567");
        assert_eq!(model_id("my model (2)", hash, true), "my-model--2@01234567");
        assert_eq!(model_id("demo", hash, false), "untrained-demo@01234567");
        assert_eq!(model_id("untrained-vits", hash, false), "untrained-vits@01234567");
        let id = model_id(&"ä".repeat(100), hash, false);
        assert!(id.len() <= 31 && id.starts_with("untrained@"), "{id}");
        let id = model_id("a-very-long-name-of-a-checkpoint-file", hash, false);
        assert_eq!((id.len(), id.as_str()), (30, "untrained-a-very-long@01234567"));
    }
}
