//! Named tensors in a file: a `.safetensors` file or a PyTorch checkpoint.

use crate::{Error, ErrorKind, Result, durable};
use core::ops::Range;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use stored::{ReadAt, Stored};

mod floats;
#[cfg(any(test, feature = "testing"))]
pub(crate) mod fuzzing;
mod pickle;
mod pth;
mod safetensors;
mod seeded;
pub(crate) mod stored;
mod verify;
mod write;

pub use seeded::write_seeded;
pub use verify::{Extra, Misshaped, Missing, NotFinite, Report, examine, verify, verify_names};
#[cfg(test)]
pub(crate) use write::{Planned, write};
pub(crate) use write::{copy, kept_as};

/// How the numbers of a tensor are stored, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Dtype {
    /// 64-bit float; the network computes with them rounded to 32 bits.
    F64,
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
            Self::F64 => 8,
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    /// The name that `.safetensors` files use.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F64 => "F64",
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
    /// Its bytes in the file; with strides, from its first number to its last.
    pub bytes: Range<usize>,
    /// Numbers from one index to the next, for each dimension, where it does not lie in the order of its shape.
    pub strides: Option<Vec<usize>>,
}

impl Entry {
    /// How many numbers it has.
    pub fn count(&self) -> usize {
        self.shape.iter().product()
    }
}

/// The kind of file that weights lie in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A `.safetensors` file.
    Safetensors,
    /// A checkpoint that `torch.save` wrote (`.pth`, `.pt`, `.ckpt`): a zip archive of a pickle and raw numbers.
    PyTorch,
}

/// Contents of a file, without the file.
#[derive(Debug, Default)]
struct Contents {
    entries: BTreeMap<String, Entry>,
    /// Other entries by name: values that are not tensors, and tensors of other types.
    others: BTreeMap<String, String>,
    metadata: BTreeMap<String, String>,
}

/// Result of parsing a file; the error lacks the file's name, which [`Weights::open`] prepends.
type Parsed<T> = Result<T, String>;

/// Named tensors in a file that stays open.
#[derive(Debug)]
pub struct Weights {
    file: Stored,
    pub(crate) entries: BTreeMap<String, Entry>,
    others: BTreeMap<String, String>,
    metadata: BTreeMap<String, String>,
    format: Format,
}

impl Weights {
    /// Opens a `.safetensors` file or a checkpoint of PyTorch; what it is decides, not how it is called. No code that
    /// is in a checkpoint is ever run, and no number is looked at: [`verify()`] does that.
    ///
    /// Names are those of the network's own code: the tensors of a checkpoint may lie under `model`, and `module.`, which
    /// a wrapper puts in front of every name, is cut off.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] and [`ErrorKind::Io`] for the file, [`ErrorKind::BadModel`] with the cure for anything
    /// in it that is damaged, cut short or of another kind.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let file = Stored::open(path)?;
        let (format, contents) = parse(&file)
            .map_err(|what| Error::new(ErrorKind::BadModel, format!("{}: {what}", path.display())))?;
        let Contents { entries, others, metadata } = contents;
        Ok(Self { file, entries, others, metadata, format })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.file.path()
    }

    /// The kind of file.
    pub const fn format(&self) -> Format {
        self.format
    }

    /// Bytes of the whole file.
    pub fn file_bytes(&self) -> u64 {
        self.file.len() as u64
    }

    /// Every tensor by name, as the network's code calls it (a wrapper's prefix is gone).
    pub const fn entries(&self) -> &BTreeMap<String, Entry> {
        &self.entries
    }

    /// Entries that a network cannot use, with their descriptions.
    pub const fn others(&self) -> &BTreeMap<String, String> {
        &self.others
    }

    /// Metadata of the file (`__metadata__` of a `.safetensors` file).
    pub const fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The numbers of a tensor as they are stored, in the order of its shape.
    ///
    /// # Errors
    /// [`ErrorKind::BadModel`] when there is no such tensor, [`ErrorKind::Io`] when it cannot be read, also because the
    /// file became shorter.
    pub fn read(&self, name: &str) -> Result<Vec<u8>> {
        let missing = || {
            let message = format!("{}: the tensor {name} is missing", self.path().display());
            Error::new(ErrorKind::BadModel, message)
        };
        let entry = self.entries.get(name).ok_or_else(missing)?;
        let span =
            stored::part(&self.file, entry.bytes.clone()).map_err(|e| stored::failed(self.path(), e))?;
        Ok(match &entry.strides {
            Some(strides) => gathered(&span, entry, strides),
            None => span,
        })
    }

    /// The whole file, mapped into memory: for an engine that reads tensors where they lie.
    ///
    /// # Errors
    /// [`ErrorKind::Io`].
    pub(crate) fn mapped(&self) -> Result<&[u8]> {
        self.file.mapped()
    }

    /// SHA-256 of the whole file, in hexadecimal; reads all of it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when it cannot be read, also because it became shorter.
    pub fn sha256(&self) -> Result<String> {
        let mut hash = Sha256::new();
        let mut part = vec![0; 1 << 20];
        let mut at = 0;
        while at < self.file.len() {
            let n = part.len().min(self.file.len() - at);
            self.file.read_at(at, &mut part[..n]).map_err(|e| stored::failed(self.path(), e))?;
            hash.update(&part[..n]);
            at += n;
        }
        Ok(durable::hex(&hash.finalize()))
    }

    /// The numbers of a tensor as 32-bit floats, whatever they are stored as.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn to_f32(&self, name: &str) -> Result<Vec<f32>> {
        let bytes = self.read(name)?;
        Ok(match self.entries.get(name).map_or(Dtype::F32, |e| e.dtype) {
            Dtype::F64 => bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
            Dtype::F32 => bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
            Dtype::F16 => halves(&bytes).map(|h| half::f16::from_bits(h).to_f32()).collect(),
            Dtype::Bf16 => halves(&bytes).map(|h| half::bf16::from_bits(h).to_f32()).collect(),
        })
    }
}

/// The numbers of `span` that `entry` has, in the order of its shape.
fn gathered(span: &[u8], entry: &Entry, strides: &[usize]) -> Vec<u8> {
    let size = entry.dtype.bytes();
    let count = entry.count();
    let mut out = Vec::with_capacity(count * size);
    let mut index = vec![0; entry.shape.len()];
    for _ in 0..count {
        let at: usize = index.iter().zip(strides).map(|(i, stride)| i * stride).sum();
        out.extend_from_slice(&span[at * size..][..size]);
        for dimension in (0..index.len()).rev() {
            index[dimension] += 1;
            if index[dimension] < entry.shape[dimension] {
                break;
            }
            index[dimension] = 0;
        }
    }
    out
}

fn halves(bytes: &[u8]) -> impl Iterator<Item = u16> {
    bytes.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]]))
}

/// Detects the format of a file, and reads its contents.
fn parse(file: &dyn ReadAt) -> Parsed<(Format, Contents)> {
    /// First bytes of known unsupported formats, with the cure.
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
    if file.len() == 0 {
        return Err("is empty; was it being downloaded or copied? get it again".into());
    }
    let start = stored::part(file, 0..file.len().min(START)).map_err(|e| unreadable(&e))?;
    if start.starts_with(b"PK\x03\x04") || start.starts_with(b"PK\x05\x06") {
        return Ok((Format::PyTorch, pth::read(file)?));
    }
    if pth::is_legacy(&start) {
        return Err(pth::LEGACY.into());
    }
    if let Some((_, what)) = STRANGERS.iter().find(|(first, _)| start.starts_with(first)) {
        return Err((*what).into());
    }
    Ok((Format::Safetensors, safetensors::read(file)?))
}

/// Number of bytes that identify a format.
const START: usize = 512;

fn unreadable(e: &io::Error) -> String {
    format!("cannot be read: {e}; is it still being written or copied?")
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
