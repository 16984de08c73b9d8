//! A model ready for an engine: weights that were proven to be of its encoder, and how they want their input.

use crate::{Encoder, Weights};
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
    /// What headers and reports call it: its name and the beginning of its hash, such as `cdm-d435@1f2e3d4c`; at most
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
