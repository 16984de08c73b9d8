//! Writing `.safetensors` files, tensor after tensor, without holding more than one of them.

use super::{Dtype, Weights};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::io::{self, Write};

/// Where the numbers begin is a multiple of this, bytes: every tensor of 32-bit floats can be read in place.
const ALIGNMENT: usize = 64;

/// A tensor that is to be written.
#[derive(Debug, Clone)]
pub(crate) struct Planned {
    pub name: String,
    pub dtype: Dtype,
    pub shape: Vec<usize>,
}

impl Planned {
    fn bytes(&self) -> usize {
        self.shape.iter().product::<usize>() * self.dtype.bytes()
    }
}

/// Writes a file of `tensors`, whose numbers `fill` writes when it is given their place in `tensors`.
///
/// # Errors
/// Those of `out` and of `fill`.
pub(crate) fn write(
    out: &mut dyn Write,
    tensors: &mut [Planned],
    metadata: &BTreeMap<String, String>,
    fill: &mut dyn FnMut(&Planned, &mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    // Wide numbers first, as the format's own library has them, so that all of them are aligned.
    tensors.sort_by(|a, b| b.dtype.bytes().cmp(&a.dtype.bytes()).then_with(|| a.name.cmp(&b.name)));
    let mut head = Map::new();
    head.insert("__metadata__".into(), json!(metadata));
    let mut at = 0;
    for tensor in &*tensors {
        let end = at + tensor.bytes();
        let entry = json!({ "dtype": tensor.dtype.name(), "shape": tensor.shape, "data_offsets": [at, end] });
        head.insert(tensor.name.clone(), entry);
        at = end;
    }
    let mut head = Value::Object(head).to_string().into_bytes();
    head.resize((8 + head.len()).next_multiple_of(ALIGNMENT) - 8, b' ');
    out.write_all(&(head.len() as u64).to_le_bytes())?;
    out.write_all(&head)?;
    tensors.iter().try_for_each(|tensor| fill(tensor, out))
}

/// Type of the numbers in a copy. Engines compute with 32 bits at the most, and read those where they lie.
pub(crate) const fn kept_as(dtype: Dtype) -> Dtype {
    match dtype {
        Dtype::F64 => Dtype::F32,
        other => other,
    }
}

/// Writes the tensors of `weights` that `keep` wants.
///
/// # Errors
/// Those of `out`, and `Interrupted` when `go_on` (which receives the number of bytes written) returns false.
pub(crate) fn copy(
    out: &mut dyn Write,
    weights: &Weights,
    keep: impl Fn(&str) -> bool,
    metadata: &BTreeMap<String, String>,
    go_on: &mut dyn FnMut(u64) -> bool,
) -> io::Result<()> {
    let entries = weights.entries().iter().filter(|(name, _)| keep(name));
    let planned = entries.map(|(name, e)| Planned {
        name: name.clone(),
        dtype: kept_as(e.dtype),
        shape: e.shape.clone(),
    });
    let mut planned: Vec<_> = planned.collect();
    let mut done = 0;
    write(out, &mut planned, metadata, &mut |tensor, out| {
        let bytes = if weights.entries().get(&tensor.name).is_some_and(|e| e.dtype == tensor.dtype) {
            weights.read(&tensor.name)
        } else {
            weights.to_f32(&tensor.name).map(|n| n.iter().flat_map(|n| n.to_le_bytes()).collect())
        };
        let bytes = bytes.map_err(io::Error::other)?;
        done += bytes.len() as u64;
        out.write_all(&bytes)?;
        if go_on(done) { Ok(()) } else { Err(io::ErrorKind::Interrupted.into()) }
    })
}
