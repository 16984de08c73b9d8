//! Named tensors in a file, mapped into memory: a `.safetensors` file or a PyTorch checkpoint.

use core::ops::Range;
use memmap2::Mmap;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How the numbers of a tensor are stored, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// 32-bit float.
    F32,
    /// 16-bit float of IEEE 754.
    F16,
    /// The upper half of a 32-bit float.
    Bf16,
}

impl Dtype {
    /// Bytes of one number.
    pub const fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }
}

/// Where a tensor lies in its file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// How its numbers are stored.
    pub dtype: Dtype,
    /// Its shape, row-major.
    pub shape: Vec<usize>,
    /// Its bytes in the file.
    pub bytes: Range<usize>,
}

/// Named tensors in a file that stays mapped.
#[derive(Debug)]
pub struct Weights {
    pub(crate) path: PathBuf,
    pub(crate) map: Mmap,
    pub(crate) entries: BTreeMap<String, Entry>,
}

impl Weights {
    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Every tensor by name, as the network's code calls it (a wrapper's prefix is gone).
    pub const fn entries(&self) -> &BTreeMap<String, Entry> {
        &self.entries
    }

    /// The bytes of a tensor as they lie in the file.
    pub fn bytes(&self, name: &str) -> Option<&[u8]> {
        self.map.get(self.entries.get(name)?.bytes.clone())
    }
}
