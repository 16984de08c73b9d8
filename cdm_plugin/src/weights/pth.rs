//! Checkpoints of PyTorch: a zip archive with a pickle of names and shapes, and one uncompressed member per storage.
//!
//! The form is that of `torch/serialization.py` since PyTorch 1.6: `NAME/data.pkl`, `NAME/byteorder` (newer ones), and
//! `NAME/data/KEY` for each storage.

use super::pickle::{self, Element, Pickle, Tensor, Value};
use super::stored::{ReadAt, Stream, part};
use super::{Contents, Dtype, Entry, Parsed, unreadable, without_module};
use core::ops::Range;
use std::collections::HashMap;
use std::io::BufReader;
use zip::{CompressionMethod, ZipArchive};

/// Cure for the format of PyTorch before 1.6.
pub(super) const LEGACY: &str = "is a checkpoint in the format of PyTorch before 1.6, which is not supported; \
    convert it: python -c 'import torch; torch.save(torch.load(\"OLD.pth\", map_location=\"cpu\"), \"NEW.pth\")'";

/// The key that wrapped checkpoints keep their tensors under.
const WRAPPED: &str = "model";
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

/// Reads the contents of the file.
pub(super) fn read(file: &dyn ReadAt) -> Parsed<Contents> {
    let members = members(file)?;
    let list = members.keys().filter_map(|name| Some((name.strip_suffix("data.pkl")?, name)));
    let mut lists: Vec<_> = list.filter(|(folder, _)| folder.matches('/').count() <= 1).collect();
    lists.sort_unstable();
    let [(folder, list)] = lists.as_slice() else {
        return Err(match lists.len() {
            0 => "is a zip archive, but no checkpoint of PyTorch: it has no data.pkl".into(),
            n => format!("is not a checkpoint of PyTorch: it has {n} files data.pkl"),
        });
    };
    if members.contains_key(&format!("{folder}constants.pkl")) {
        return Err("is a TorchScript program; a checkpoint (torch.save of a state dict) is needed".into());
    }
    if let Some(range) = members.get(&format!("{folder}byteorder")) {
        let order = part(file, range.start..range.end.min(range.start + 20)).map_err(|e| unreadable(&e))?;
        if order != b"little" {
            let order = String::from_utf8_lossy(&order).into_owned();
            return Err(format!(
                "its numbers are stored in the byte order {order:?}; only \"little\" is read here"
            ));
        }
    }
    let range = members.get(*list).cloned().unwrap_or_default();
    pickle::check_size(range.len())?;
    let list = part(file, range).map_err(|e| unreadable(&e))?;
    let pickle = pickle::read(&list)?;
    let place = |key: &str| members.get(&format!("{folder}data/{key}")).cloned();
    contents(&pickle, &place)
}

/// Where each member lies in the file.
fn members(file: &dyn ReadAt) -> Parsed<HashMap<String, Range<usize>>> {
    let mut zip = ZipArchive::new(BufReader::new(Stream::new(file))).map_err(|e| {
        format!(
            "has {} bytes and is not a complete zip archive ({e}): it was probably truncated; download or copy it again",
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
        let start = member.data_start();
        let len = member.compressed_size();
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
        let name = *key;
        let twice = match pickle.get(*value) {
            Value::Tensor(tensor) => match tensor.storage.element {
                Element::Float(dtype) => {
                    let entry =
                        entry(tensor, dtype, place).map_err(|what| format!("its tensor {name:?} {what}"))?;
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
    Ok(without_module(contents))
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

/// Where a tensor lies in the file.
fn entry(tensor: &Tensor<'_>, dtype: Dtype, place: &dyn Fn(&str) -> Option<Range<usize>>) -> Parsed<Entry> {
    let Tensor { storage, offset, shape, strides } = tensor;
    let too_large = || format!("of shape {shape:?} does not fit into its storage; the file is damaged");
    let count = shape.iter().try_fold(1_usize, |n, d| n.checked_mul(*d)).ok_or_else(too_large)?;
    let mut in_order = true;
    let mut stride = 1_u64;
    // The place of the last number after the first.
    let mut last = 0_u64;
    for (n, s) in shape.iter().zip(strides).rev() {
        in_order &= *n <= 1 || *s == stride;
        stride = stride.saturating_mul(*n as u64);
        last = last.saturating_add(s.saturating_mul((*n as u64).saturating_sub(1)));
    }
    let span = if count == 0 { 0 } else { last.saturating_add(1) };
    // More numbers than there are places is a tensor that was expanded, and could be of any size.
    if count as u64 > storage.len {
        return Err(format!("{}; if PyTorch reads it, save it with .contiguous()", too_large()));
    }
    let member = place(storage.key).ok_or_else(|| {
        let key: String = storage.key.chars().take(60).collect();
        format!("refers to data/{key}, which the file does not have: it is damaged, get it again")
    })?;
    let end = offset.checked_add(span).filter(|end| *end <= storage.len).ok_or_else(too_large)?;
    let [from, to] = [*offset, end].map(|n| usize::try_from(n).ok()?.checked_mul(dtype.bytes()));
    let bytes = match (from, to) {
        (Some(from), Some(to)) if to <= member.len() => member.start + from..member.start + to,
        _ => return Err(too_large()),
    };
    let out_of_order = (!in_order && count > 0).then(|| strides.iter().map(|s| *s as usize).collect());
    Ok(Entry { dtype, shape: shape.clone(), bytes, strides: out_of_order })
}
