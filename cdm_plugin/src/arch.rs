//! The network of the camera depth models: its sizes, and the name and shape of every tensor.
//!
//! Two DINOv2 encoders (colour, inverse depth), a fusion of their tokens, and a DPT head; published with
//! "Manipulation as in Simulation" (arXiv 2509.02530) as `manip-as-in-sim-suite/cdm`, Apache-2.0.

use core::fmt;

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
