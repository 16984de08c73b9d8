//! Checkpoints of PyTorch: a zip archive with a pickle of names and shapes, and one uncompressed member per storage.
//!
//! The form is that of `torch/serialization.py` since PyTorch 1.6: `NAME/data.pkl`, `NAME/byteorder` (newer ones), and
//! `NAME/data/KEY` for each storage.

use super::pickle::{self, Element, Pickle, Tensor, Value};
use super::{Contents, Entry, Parsed, without_module};
use core::ops::Range;
use std::collections::HashMap;
use std::io::Cursor;
use zip::{CompressionMethod, ZipArchive};

/// What to do about the form that PyTorch had before 1.6.
pub(super) const LEGACY: &str = "is a checkpoint in the form that PyTorch had before 1.6, which is not read here; \
    write it anew: python -c 'import torch; torch.save(torch.load(\"OLD.pth\", map_location=\"cpu\"), \"NEW.pth\")'";

/// The key that wrapped checkpoints keep their tensors under.
const WRAPPED: &str = "model";
/// Characters that the official loader cuts off every name of a wrapped checkpoint: `module.`, which it does not check.
const CUT: usize = 7;
/// The largest network has 1214 tensors, and three storages for each with an optimizer.
const MAX_MEMBERS: usize = 1 << 16;

/// Whether it is a checkpoint as PyTorch wrote them before 1.6: pickles one after the other (or a tar of them), of which
/// the first is a number that stands for nothing else.
pub(super) fn is_legacy(file: &[u8]) -> bool {
    const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];
    let start = file.get(..64).unwrap_or(file);
    let pickled = start.first() == Some(&0x80) && start.windows(MAGIC.len()).any(|w| w == MAGIC);
    pickled || (file.get(257..262) == Some(b"ustar") && file.starts_with(b"sys_info"))
}

/// What the file holds.
pub(super) fn read(file: &[u8]) -> Parsed<Contents> {
    let members = members(file)?;
    let list = members.keys().filter_map(|name| Some((name.strip_suffix("data.pkl")?, name)));
    let mut lists: Vec<_> = list.filter(|(folder, _)| folder.matches('/').count() <= 1).collect();
    lists.sort_unstable();
    let [(folder, list)] = lists.as_slice() else {
        return Err(match lists.len() {
            0 => "is a zip archive, but no checkpoint of PyTorch: it has no data.pkl".into(),
            n => format!("is no checkpoint of PyTorch: it has {n} files data.pkl"),
        });
    };
    if members.contains_key(&format!("{folder}constants.pkl")) {
        return Err("is a TorchScript program; a checkpoint (torch.save of a state dict) is needed".into());
    }
    let part = |range: &Range<usize>| file.get(range.clone()).unwrap_or_default();
    if let Some(order) = members.get(&format!("{folder}byteorder")).filter(|m| part(m) != b"little") {
        let order = String::from_utf8_lossy(part(order)).chars().take(20).collect::<String>();
        return Err(format!(
            "its numbers are stored in the byte order {order:?}; only \"little\" is read here"
        ));
    }
    let pickle = pickle::read(members.get(*list).map(part).unwrap_or_default())?;
    let place = |key: &str| members.get(&format!("{folder}data/{key}")).cloned();
    contents(&pickle, &place)
}

/// Where each member lies in the file.
fn members(file: &[u8]) -> Parsed<HashMap<String, Range<usize>>> {
    let mut zip = ZipArchive::new(Cursor::new(file)).map_err(|e| {
        format!(
            "has {} bytes and is no whole zip archive ({e}): it was probably cut short; download or copy it again",
            file.len()
        )
    })?;
    if zip.len() > MAX_MEMBERS {
        return Err(format!("is a zip archive of {} members, and no checkpoint has so many", zip.len()));
    }
    let mut members = HashMap::with_capacity(zip.len());
    for i in 0..zip.len() {
        let member = zip.by_index_raw(i).map_err(|e| format!("its member number {i} is damaged: {e}"))?;
        let name = String::from_utf8_lossy(member.name_raw()).into_owned();
        let shown: String = name.chars().take(120).collect();
        if member.compression() != CompressionMethod::Stored || member.encrypted() {
            return Err(format!(
                "its member {shown:?} is compressed or encrypted; checkpoints are stored as they are (was it packed anew?)"
            ));
        }
        let (start, len) = (member.data_start(), member.compressed_size());
        let range = start.and_then(|start| {
            let end = start.checked_add(len)?;
            Some(usize::try_from(start).ok()?..usize::try_from(end).ok()?)
        });
        let Some(range) = range.filter(|r| r.end <= file.len() && member.size() == len) else {
            return Err(format!(
                "has {} bytes, and its member {shown:?} of {len} bytes does not fit: it is cut short or damaged; \
                 download or copy it again",
                file.len()
            ));
        };
        if members.insert(name, range).is_some() {
            return Err(format!("has two members {shown:?}; it is damaged"));
        }
    }
    Ok(members)
}

/// The tensors of a list, whose storages lie where `place` says.
pub(super) fn contents(
    pickle: &Pickle<'_>,
    place: &dyn Fn(&str) -> Option<Range<usize>>,
) -> Parsed<Contents> {
    let Value::Dict(top) = pickle.get(pickle.root) else {
        return Err(format!(
            "holds {}, not a dict of tensors; save a state dict: torch.save(net.state_dict(), FILE)",
            pickle.get(pickle.root).kind()
        ));
    };
    let wrapped = top.iter().rev().find(|(key, _)| *pickle.get(*key) == Value::Text(WRAPPED));
    let mut contents = Contents::default();
    let dict = match wrapped.map(|(_, value)| pickle.get(*value)) {
        Some(Value::Dict(dict)) => dict,
        Some(other) => {
            return Err(format!("holds {} under \"{WRAPPED}\", not a dict of tensors", other.kind()));
        }
        None => top,
    };
    for (key, value) in dict {
        let Value::Text(key) = pickle.get(*key) else {
            return Err(format!("has a tensor whose name is {}", pickle.get(*key).kind()));
        };
        let name = if wrapped.is_some() { cut(key) } else { key };
        if wrapped.is_some() && !key.starts_with("module.") && contents.cut_blindly.is_none() {
            contents.cut_blindly = Some((*key).to_owned());
        }
        let twice = match pickle.get(*value) {
            Value::Tensor(tensor) => match tensor.storage.element {
                Element::Float(dtype) => {
                    let bytes = bytes_of(tensor, dtype.bytes(), place)
                        .map_err(|what| format!("its tensor {name:?} {what}"))?;
                    let entry = Entry { dtype, shape: tensor.shape.clone(), bytes };
                    contents.entries.insert(name.to_owned(), entry).is_some()
                }
                Element::Other(of) => {
                    let what = format!("a tensor of {of}, shape {:?}", tensor.shape);
                    contents.others.insert(name.to_owned(), what).is_some()
                }
            },
            other => contents.others.insert(name.to_owned(), other.kind().to_owned()).is_some(),
        };
        if twice {
            return Err(format!("has two tensors {name:?}"));
        }
    }
    if contents.entries.is_empty() {
        return Err(no_tensors(pickle, dict, wrapped.is_some()));
    }
    Ok(if wrapped.is_some() { contents } else { without_module(contents) })
}

/// `key` without its first seven characters, as Python's `key[7:]`.
fn cut(key: &str) -> &str {
    key.char_indices().nth(CUT).map_or("", |(at, _)| &key[at..])
}

fn no_tensors(pickle: &Pickle<'_>, dict: &[(pickle::Id, pickle::Id)], wrapped: bool) -> String {
    let keys = dict.iter().filter_map(|(key, _)| match pickle.get(*key) {
        Value::Text(text) => Some(format!("{:?}", text.chars().take(60).collect::<String>())),
        _ => None,
    });
    let keys: Vec<_> = keys.take(8).collect();
    let place = if wrapped { "under \"model\"" } else { "at its top" };
    format!(
        "has no tensors {place} (it has {}); the weights are looked for under \"model\", or at the top of a plain state \
         dict: write them so, torch.save(torch.load(FILE)[KEY], NEW)",
        if keys.is_empty() { "nothing".to_owned() } else { keys.join(", ") }
    )
}

/// The bytes of a tensor in the file.
fn bytes_of(
    tensor: &Tensor<'_>,
    size: usize,
    place: &dyn Fn(&str) -> Option<Range<usize>>,
) -> Parsed<Range<usize>> {
    let Tensor { storage, offset, shape, strides } = tensor;
    let too_large = || format!("of shape {shape:?} does not fit into its storage; the file is damaged");
    let count = shape.iter().try_fold(1_usize, |n, d| n.checked_mul(*d)).ok_or_else(too_large)?;
    let mut stride = 1_u64;
    for (n, s) in shape.iter().zip(strides).rev() {
        if *n > 1 && count > 0 && *s != stride {
            return Err(format!(
                "is not contiguous (shape {shape:?}, strides {strides:?}); save it with .contiguous()"
            ));
        }
        stride = stride.saturating_mul(*n as u64);
    }
    let member = place(storage.key).ok_or_else(|| {
        let key: String = storage.key.chars().take(60).collect();
        format!("refers to data/{key}, which the file does not have: it is damaged, get it again")
    })?;
    let end = offset.checked_add(count as u64).filter(|end| *end <= storage.len).ok_or_else(too_large)?;
    let [from, to] = [*offset, end].map(|n| usize::try_from(n).ok()?.checked_mul(size));
    match (from, to) {
        (Some(from), Some(to)) if to <= member.len() => Ok(member.start + from..member.start + to),
        _ => Err(too_large()),
    }
}
