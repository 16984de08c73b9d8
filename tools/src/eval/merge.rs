//! Parts put together: the records of all files in the order of the images.

use super::records::{Header, Reader, Record};
use super::summary::{Evaluation, Summary};
use crate::exit::UsageError;
use anyhow::{Result, bail};
use depthrig_convert::RunPart;
use std::path::{Path, PathBuf};

/// The evaluation that the files of all parts make together, as if it were one run, and its header.
///
/// # Errors
/// When a part is missing, given twice, not complete, or of another run.
pub fn merge(paths: &[PathBuf]) -> Result<(Evaluation, Header)> {
    let mut readers = paths.iter().map(|p| Reader::open(p)).collect::<Result<Vec<_>>>()?;
    readers.sort_by_key(|r| r.header.part);
    let Some(first) = readers.first() else { bail!(UsageError("name the files of all parts".into())) };
    let mut header = first.header.clone();
    let parts = header.part.parts();
    for other in &readers[1..] {
        if let Some(what) = header.difference(&other.header) {
            let text =
                format!("{} and {} are of two runs ({what})", first.path().display(), other.path().display());
            return Err(UsageError(text).into());
        }
    }
    for pair in readers.windows(2) {
        let [a, b] = pair else { continue };
        if a.header.part == b.header.part {
            let text = format!("{} and {} are one part", a.path().display(), b.path().display());
            return Err(UsageError(text).into());
        }
    }
    let missing: Vec<String> = (0..parts)
        .filter(|k| !readers.iter().any(|r| r.header.part.number() == *k))
        .map(|k| format!("{k}/{parts}"))
        .collect();
    if !missing.is_empty() {
        bail!("parts are missing: run --shard {} and name their files too", missing.join(", --shard "));
    }
    header.part = RunPart::ALL;
    let mut summary = Summary::new(header.rules()?);
    let mut heads = readers.iter_mut().map(Reader::next).collect::<Result<Vec<Option<Record>>>>()?;
    let mut images = 0;
    loop {
        let at = heads.iter().enumerate().filter_map(|(i, h)| Some((h.as_ref()?.image, i))).min();
        let Some((image, at)) = at else { break };
        if image != images {
            return Err(incomplete(readers[(images % parts) as usize].path()));
        }
        let next = readers[at].next()?;
        if let Some(record) = std::mem::replace(&mut heads[at], next) {
            summary.add(&record, |_, _| Ok(Vec::new()))?;
        }
        images += 1;
    }
    for reader in &readers {
        let Some(end) = reader.end else { return Err(incomplete(reader.path())) };
        if end.images != images {
            bail!(
                "{}: it is of {} images, and the parts have {images}; their inputs differ",
                reader.path().display(),
                end.images
            );
        }
    }
    Ok((summary.finish(&header), header))
}

fn incomplete(path: &Path) -> anyhow::Error {
    anyhow::anyhow!("{}: it is not complete; run its --shard again", path.display())
}
