//! The network of the camera depth models: its sizes, and the name and shape of every tensor.
//!
//! Two DINOv2 encoders (colour, inverse depth), a fusion of their tokens, and a DPT head; published with
//! "Manipulation as in Simulation" (arXiv 2509.02530) as `manip-as-in-sim-suite/cdm`, Apache-2.0.

use crate::{Error, ErrorKind, Result};
use core::fmt;

mod tensors;

pub use tensors::TensorSpec;

/// Edge of a patch, pixels: every input is a multiple of it.
pub const PATCH: usize = 14;

/// The size of the network, by the name of its encoders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Encoder {
    /// 384 wide, 12 blocks.
    Vits,
    /// 768 wide, 12 blocks.
    Vitb,
    /// 1024 wide, 24 blocks: the published models.
    Vitl,
    /// 1536 wide, 40 blocks.
    Vitg,
}

impl Encoder {
    /// Every size, smallest first.
    pub const ALL: [Self; 4] = [Self::Vits, Self::Vitb, Self::Vitl, Self::Vitg];

    /// The name used in files and on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Vits => "vits",
            Self::Vitb => "vitb",
            Self::Vitl => "vitl",
            Self::Vitg => "vitg",
        }
    }
}

impl fmt::Display for Encoder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl core::str::FromStr for Encoder {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|e| e.name() == s).ok_or_else(|| {
            let message = format!("unknown encoder {s:?}; use vits, vitb, vitl or vitg");
            Error::new(ErrorKind::BadInput, message)
        })
    }
}

/// The part of a block that follows attention.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FeedForward {
    /// `fc2(gelu(fc1(x)))` with the exact (erf) GELU.
    Gelu {
        /// Width between the two layers.
        hidden: usize,
    },
    /// `w3(silu(a) * b)`, where `a` and `b` are the halves of `w12(x)`.
    SwiGlu {
        /// Width of each half.
        hidden: usize,
    },
}

/// The sizes of a network. What is the same in all of them are constants of this module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Architecture {
    /// Width of a token.
    pub width: usize,
    /// Blocks of each of the two encoders.
    pub blocks: usize,
    /// Heads of attention in a block.
    pub heads: usize,
    /// The part of a block that follows attention.
    pub feed_forward: FeedForward,
    /// The blocks (counted from 0) whose tokens go to the head, each through the encoder's final norm.
    pub taps: [usize; 4],
    /// Channels within the head.
    pub features: usize,
    /// Channels of the four levels when they enter the head.
    pub levels: [usize; 4],
    /// Edge of the grid that the position embeddings were trained on.
    pub grid: usize,
}

/// Added inside the square root of every layer norm.
pub const NORM_EPS: f64 = 1e-6;
/// Heads of the attention between the two tokens of one place; the same in every size.
pub const FUSION_HEADS: usize = 4;
/// Channels before the last convolution of the head.
pub const OUTPUT_CHANNELS: usize = 32;
/// The names of the two encoders, colour first.
pub const ENCODERS: [&str; 2] = ["pretrained", "depth_pretrained"];
/// The name of the head.
pub const HEAD: &str = "depth_head_rgbd";

impl Encoder {
    /// The sizes of this network.
    pub const fn architecture(self) -> Architecture {
        match self {
            Self::Vits => Architecture::new(384, 12, 6, [2, 5, 8, 11], 64, [48, 96, 192, 384]),
            Self::Vitb => Architecture::new(768, 12, 12, [2, 5, 8, 11], 128, [96, 192, 384, 768]),
            Self::Vitl => Architecture::new(1024, 24, 16, [4, 11, 17, 23], 256, [256, 512, 1024, 1024]),
            Self::Vitg => Architecture {
                feed_forward: FeedForward::SwiGlu { hidden: 4096 },
                ..Architecture::new(1536, 40, 24, [9, 19, 29, 39], 384, [1536; 4])
            },
        }
    }
}

impl Architecture {
    const fn new(
        width: usize,
        blocks: usize,
        heads: usize,
        taps: [usize; 4],
        features: usize,
        levels: [usize; 4],
    ) -> Self {
        let feed_forward = FeedForward::Gelu { hidden: 4 * width };
        Self { width, blocks, heads, feed_forward, taps, features, levels, grid: 37 }
    }

    /// Width of one head of attention.
    pub const fn head_width(&self) -> usize {
        self.width / self.heads
    }
}

#[cfg(test)]
mod tests;
