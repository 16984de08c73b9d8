//! The last kilobyte of a finished segment: footer, summary offsets, statistics.

use crate::container::MAGIC;
use crate::container::record::op;
use crate::fs::{Fs, ReadFile};
use crate::recorder::topics::Global;
use crate::{Error, ErrorKind, Result};
use mcap::records::{Record, Statistics};
use std::path::Path;

/// Opcode and length of a record.
const HEAD: u64 = 9;
/// Footer record and magic.
const FOOTER: u64 = HEAD + 20 + 8;
/// Neither the offsets nor the statistics of 64 cameras come near.
const GROUP_MAX: u64 = 1 << 20;

/// Sets and times from the statistics of a segment.
pub(super) struct SegmentFacts {
    pub(super) sets: u64,
    /// First and last log time, UTC nanoseconds.
    pub(super) times: Option<(i64, i64)>,
}

/// Reads them.
pub(super) fn read(fs: &dyn Fs, path: &Path) -> Result<SegmentFacts> {
    let io = |e| Error::reading("read", path, e);
    let wrong = |kind, what: &str| Error::new(kind, format!("{} {what}", path.display()));
    let damaged = || wrong(ErrorKind::Corrupt, "has a damaged summary");
    let file = fs.open(path).map_err(io)?;
    let size = file.size().map_err(io)?;
    let cut = || wrong(ErrorKind::Truncated, "has no footer: it was cut");
    let at = size.checked_sub(FOOTER).ok_or_else(cut)?;
    let tail = bytes(&*file, at, FOOTER).map_err(io)?;
    if tail[0] != op::FOOTER || tail[tail.len() - 8..] != MAGIC {
        return Err(cut());
    }
    let Ok(Record::Footer(footer)) = mcap::parse_record(op::FOOTER, &tail[HEAD as usize..tail.len() - 8])
    else {
        return Err(damaged());
    };
    let group = |from: u64, to: u64| {
        let len = to.checked_sub(from).filter(|n| *n <= GROUP_MAX && to <= size).ok_or_else(damaged)?;
        bytes(&*file, from, len).map_err(io)
    };
    let mut place = None;
    for record in records(&group(footer.summary_offset_start, at)?) {
        if let Some(Record::SummaryOffset(o)) = record
            && o.group_opcode == op::STATISTICS
        {
            place = Some((o.group_start, o.group_start.saturating_add(o.group_length)));
        }
    }
    let (from, to) = place.ok_or_else(damaged)?;
    let mut found: Option<Statistics> = None;
    for record in records(&group(from, to)?) {
        if let Some(Record::Statistics(s)) = record {
            found = Some(s);
        }
    }
    let s = found.ok_or_else(damaged)?;
    let sets = s.channel_message_counts.get(&Global::FrameSet.channel()).copied().unwrap_or(0);
    let times = (s.message_count > 0).then_some((s.message_start_time as i64, s.message_end_time as i64));
    Ok(SegmentFacts { sets, times })
}

fn bytes(file: &dyn ReadFile, from: u64, len: u64) -> std::io::Result<Vec<u8>> {
    let mut bytes = vec![0; len as usize];
    file.read_exact_at(&mut bytes, from)?;
    Ok(bytes)
}

/// The records that lie one after the other in `bytes`; `None` is one that cannot be read, and the last.
fn records(mut bytes: &[u8]) -> impl Iterator<Item = Option<Record<'_>>> {
    std::iter::from_fn(move || {
        let (head, rest) = bytes.split_first_chunk::<{ HEAD as usize }>()?;
        let mut len = [0; 8];
        len.copy_from_slice(&head[1..]);
        let len = usize::try_from(u64::from_le_bytes(len)).unwrap_or(usize::MAX);
        let Some(body) = rest.get(..len) else {
            bytes = &[];
            return Some(None);
        };
        bytes = &rest[len..];
        let known = matches!(head[0], op::SUMMARY_OFFSET | op::STATISTICS);
        Some(if known { mcap::parse_record(head[0], body).ok() } else { None })
    })
}
