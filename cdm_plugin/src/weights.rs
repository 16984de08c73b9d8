//! Named tensors in a file, mapped into memory: a `.safetensors` file or a PyTorch checkpoint.

use crate::{Error, ErrorKind, Result, durable};
use core::ops::Range;
use memmap2::Mmap;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

mod floats;
pub(crate) mod fuzzing;
mod map;
mod pickle;
mod pth;
mod safetensors;
mod seeded;
mod verify;
mod write;

pub use seeded::write_seeded;
pub use verify::{Extra, Misshaped, Missing, NotFinite, Report, examine, verify, verify_names};
pub(crate) use write::copy;
#[cfg(test)]
pub(crate) use write::{Planned, write};

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

    /// The name that `.safetensors` files use.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "F32",
            Self::F16 => "F16",
            Self::Bf16 => "BF16",
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

/// The kind of file that weights lie in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A `.safetensors` file.
    Safetensors,
    /// A checkpoint that `torch.save` wrote (`.pth`, `.pt`, `.ckpt`): a zip archive of a pickle and raw numbers.
    PyTorch,
}

/// What a file holds, without the file.
#[derive(Debug, Default)]
struct Contents {
    entries: BTreeMap<String, Entry>,
    /// What is beside the tensors, by name: values that are no tensors, and tensors of other types.
    others: BTreeMap<String, String>,
    metadata: BTreeMap<String, String>,
    /// Names as they were, when they did not begin with the prefix that was cut from all of them.
    cut_blindly: Option<String>,
}

/// What is wrong with a file, without its name: [`Weights::open`] puts that in front.
type Parsed<T> = Result<T, String>;

/// Named tensors in a file that stays mapped.
#[derive(Debug)]
pub struct Weights {
    pub(crate) path: PathBuf,
    pub(crate) map: Mmap,
    pub(crate) entries: BTreeMap<String, Entry>,
    others: BTreeMap<String, String>,
    metadata: BTreeMap<String, String>,
    format: Format,
    cut_blindly: Option<String>,
}

impl Weights {
    /// Opens a `.safetensors` file or a checkpoint of PyTorch; what it is decides, not how it is called. No code that
    /// is in a checkpoint is ever run, and no number is looked at: [`verify()`] does that.
    ///
    /// Names are those of the network's own code. A checkpoint with tensors under `model` has the first seven
    /// characters of every name cut off, as the official loader does (they are `module.`); in every other file
    /// `module.` is cut off when all names begin with it.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] and [`ErrorKind::Io`] for the file, [`ErrorKind::BadModel`] with the cure for anything
    /// in it that is damaged, cut short or of another kind.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let map = map::read_only(path)?;
        let (format, contents) = parse(&map)
            .map_err(|what| Error::new(ErrorKind::BadModel, format!("{}: {what}", path.display())))?;
        let Contents { entries, others, metadata, cut_blindly } = contents;
        Ok(Self { path: path.into(), map, entries, others, metadata, format, cut_blindly })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The kind of file.
    pub const fn format(&self) -> Format {
        self.format
    }

    /// Bytes of the whole file.
    pub fn file_bytes(&self) -> u64 {
        self.map.len() as u64
    }

    /// Every tensor by name, as the network's code calls it (a wrapper's prefix is gone).
    pub const fn entries(&self) -> &BTreeMap<String, Entry> {
        &self.entries
    }

    /// What lies among the tensors and is none that a network can use, with what it is.
    pub const fn others(&self) -> &BTreeMap<String, String> {
        &self.others
    }

    /// What the file says about itself (`__metadata__` of a `.safetensors` file).
    pub const fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The bytes of a tensor as they lie in the file; they may begin at any address.
    pub fn bytes(&self, name: &str) -> Option<&[u8]> {
        self.map.get(self.entries.get(name)?.bytes.clone())
    }

    /// SHA-256 of the whole file, in hexadecimal; reads all of it.
    pub fn sha256(&self) -> String {
        durable::hex(&Sha256::digest(&self.map))
    }

    /// The numbers of a tensor as 32-bit floats, whatever they are stored as.
    pub fn to_f32(&self, name: &str) -> Option<Vec<f32>> {
        let bytes = self.bytes(name)?;
        Some(match self.entries.get(name)?.dtype {
            Dtype::F32 => {
                bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
            }
            Dtype::F16 => halves(bytes).map(|h| half::f16::from_bits(h).to_f32()).collect(),
            Dtype::Bf16 => halves(bytes).map(|h| half::bf16::from_bits(h).to_f32()).collect(),
        })
    }
}

fn halves(bytes: &[u8]) -> impl Iterator<Item = u16> {
    bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]]))
}

/// Finds out what kind of file it is, and reads what it holds.
fn parse(file: &[u8]) -> Parsed<(Format, Contents)> {
    /// First bytes that tell what a file is when it is none that can be read, with what to do.
    const STRANGERS: [(&[u8], &str); 5] = [
        (
            b"version https://git-lfs",
            "is the pointer of a large file in git, not the file; fetch it with `git lfs pull` or download it in a browser",
        ),
        (b"<", "is a page of HTML or XML, not weights; download the file itself, not the page that shows it"),
        (b"\x1f\x8b", "is packed with gzip; unpack it first"),
        (b"GGUF", "is a GGUF file; a .safetensors file or a checkpoint of PyTorch is needed"),
        (b"\x89HDF", "is an HDF5 file; a .safetensors file or a checkpoint of PyTorch is needed"),
    ];
    if file.is_empty() {
        return Err("is empty; was it being downloaded or copied? get it again".into());
    }
    if file.starts_with(b"PK\x03\x04") || file.starts_with(b"PK\x05\x06") {
        return Ok((Format::PyTorch, pth::read(file)?));
    }
    if pth::is_legacy(file) {
        return Err(pth::LEGACY.into());
    }
    if let Some((_, what)) = STRANGERS.iter().find(|(start, _)| file.starts_with(start)) {
        return Err((*what).into());
    }
    Ok((Format::Safetensors, safetensors::read(file)?))
}

/// Cuts `module.` off every name when all have it: a wrapper's prefix, and never the network's own.
fn without_module(contents: Contents) -> Contents {
    const PREFIX: &str = "module.";
    fn cut<V>(map: BTreeMap<String, V>) -> BTreeMap<String, V> {
        map.into_iter().map(|(name, v)| (name[PREFIX.len()..].to_owned(), v)).collect()
    }
    let mut names = contents.entries.keys().chain(contents.others.keys());
    if contents.entries.is_empty() || !names.all(|n| n.starts_with(PREFIX)) {
        return contents;
    }
    Contents { entries: cut(contents.entries), others: cut(contents.others), ..contents }
}

#[cfg(test)]
mod tests;
