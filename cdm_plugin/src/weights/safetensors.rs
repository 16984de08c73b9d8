//! `.safetensors` files: a length, a JSON head, and the numbers.

use super::stored::{ReadAt, part};
use super::{Contents, Dtype, Entry, Parsed, unreadable, without_module};
use ::safetensors::tensor::{Dtype as FileDtype, Metadata};

/// The head of the largest network is 200 kB; a file that claims more than this is invalid.
const MAX_HEAD: usize = 16 << 20;

/// Reads the contents of the file.
pub(super) fn read(file: &dyn ReadAt) -> Parsed<Contents> {
    let not_one = "is neither a .safetensors file nor a checkpoint of PyTorch (a zip archive); \
                   give the file that holds the model's weights";
    let start = part(file, 0..file.len().min(9)).map_err(|e| unreadable(&e))?;
    let Some((head_len, rest)) = start.split_first_chunk::<8>() else { return Err(not_one.into()) };
    let head_len = usize::try_from(u64::from_le_bytes(*head_len)).map_err(|_| not_one)?;
    if !(2..=MAX_HEAD).contains(&head_len) || rest.first().is_some_and(|b| *b != b'{') {
        return Err(not_one.into());
    }
    if file.len() < 8 + head_len {
        return Err(cut_short(file.len(), (8 + head_len) as u64, "the head alone"));
    }
    let head = part(file, 8..8 + head_len).map_err(|e| unreadable(&e))?;
    let head = core::str::from_utf8(&head).map_err(|e| format!("its head is damaged: {e}"))?;
    let head: Metadata = serde_json::from_str(head).map_err(|e| format!("its head is damaged: {e}"))?;
    let data_at = 8 + head_len;
    let whole = data_at as u64 + head.data_len() as u64;
    if (file.len() as u64) < whole {
        return Err(cut_short(file.len(), whole, "the whole"));
    }
    if file.len() as u64 != whole {
        return Err(format!(
            "has {} bytes and its head describes {whole}; the file is damaged, get it again",
            file.len()
        ));
    }
    let mut contents = Contents::default();
    for (name, info) in head.tensors() {
        let (from, to) = info.data_offsets;
        let dtype = match info.dtype {
            FileDtype::F64 => Dtype::F64,
            FileDtype::F32 => Dtype::F32,
            FileDtype::F16 => Dtype::F16,
            FileDtype::BF16 => Dtype::Bf16,
            other => {
                contents.others.insert(name, format!("a tensor of {other:?}, shape {:?}", info.shape));
                continue;
            }
        };
        let entry =
            Entry { dtype, shape: info.shape.clone(), bytes: data_at + from..data_at + to, strides: None };
        contents.entries.insert(name, entry);
    }
    contents.metadata = head.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
    Ok(without_module(contents))
}

fn cut_short(has: usize, needs: u64, what: &str) -> String {
    format!("is cut short: it has {has} bytes, and {what} takes {needs}; download or copy it again")
}
