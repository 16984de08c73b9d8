//! The clusters of a recording, one in memory at a time: found, checked, and skipped if they are damaged.

use super::head::{Parts, head_at};
use super::source::ReadAt;
use super::{Losses, block_time};
use crate::ebml::{self, Head, id};
use depthrig_driver::{Error, ErrorKind, Result};

/// The most bytes that a cluster may have. The largest that a Kinect can make, 3072p as BGRA with depth and infrared of
/// the wide field of view, has 55 MB.
pub const MAX_CLUSTER: u64 = 128 << 20;
/// The most that an index may have: 18 days at one entry a second.
const MAX_CUES: u64 = 32 << 20;
/// Limit of false cluster starts, after which the rest of a file is given up.
const MAX_FALSE_STARTS: u32 = 1000;
/// Bytes that are searched at a time.
const SEARCH: usize = 1 << 20;
/// Bytes at the start of a cluster that hold its time.
const PEEK: usize = 60;

/// Elements that may stand between clusters.
const BETWEEN: [u32; 8] =
    [id::VOID, id::CUES, id::TAGS, id::ATTACHMENTS, id::SEEK_HEAD, id::INFO, id::TRACKS, id::CHAPTERS];

/// Where a block is in the cluster in memory.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) track: u64,
    /// In units of the file.
    pub(super) time: u64,
    start: usize,
    end: usize,
}

/// Reads clusters.
pub(super) struct Clusters {
    source: Box<dyn ReadAt>,
    name: String,
    scale_ns: u64,
    origin: u64,
    first: u64,
    end: u64,
    cues: Option<u64>,
    /// Where the next one is.
    at: u64,
    /// The one in memory, in the first `used` bytes.
    body: Vec<u8>,
    used: usize,
    time: u64,
    /// Where its next element is.
    cursor: usize,
    losses: Losses,
    false_starts: u32,
}

impl Clusters {
    pub(super) fn new(source: Box<dyn ReadAt>, name: String, parts: &Parts) -> Self {
        let scale_ns =
            ebml::child_uint(&parts.info, id::TIMESTAMP_SCALE).unwrap_or(1_000_000).clamp(1, 1_000_000_000);
        Self {
            source,
            name,
            scale_ns,
            origin: parts.origin,
            first: parts.clusters,
            end: parts.end,
            cues: parts.cues,
            at: parts.clusters,
            body: Vec::new(),
            used: 0,
            time: 0,
            cursor: 0,
            losses: Losses::default(),
            false_starts: 0,
        }
    }

    /// Nanoseconds per unit of the file's times.
    pub(super) const fn scale_ns(&self) -> u64 {
        self.scale_ns
    }

    pub(super) const fn losses(&self) -> Losses {
        self.losses
    }

    pub(super) fn progress(&self) -> (u64, u64) {
        (self.at.min(self.end), self.end)
    }

    pub(super) fn memory_bytes(&self) -> usize {
        self.body.len()
    }

    /// The next block; `None` at the end.
    pub(super) fn advance(&mut self) -> Result<Option<Place>> {
        loop {
            while let Some((of, start, end)) = element(&self.body, self.cursor, self.used) {
                self.cursor = end;
                let inside = |(start, end): (usize, usize)| -> Option<Place> {
                    let block = ebml::block(self.body.get(start..end)?)?;
                    Some(Place { track: block.track, time: block_time(self.time, block.time), start, end })
                };
                let found = match of {
                    id::SIMPLE_BLOCK => inside((start, end)),
                    id::BLOCK_GROUP => block_of(&self.body, start, end).and_then(inside),
                    _ => None,
                };
                if found.is_some() {
                    return Ok(found);
                }
            }
            if !self.load_next()? {
                return Ok(None);
            }
        }
    }

    /// The frames of a block of the cluster in memory, which was proven.
    pub(super) fn frames(&self, place: &Place) -> ebml::Frames<'_> {
        let block = self.body.get(place.start..place.end).and_then(ebml::block);
        block.and_then(|b| b.frames()).unwrap_or_default()
    }

    /// Takes the next good cluster into memory; false at the end.
    fn load_next(&mut self) -> Result<bool> {
        (self.used, self.cursor) = (0, 0);
        while self.at < self.end {
            let at = self.at;
            let head = self.head(at)?;
            let next = match head {
                Some(h) if h.id == id::CLUSTER => {
                    if let Some(next) = self.load(at, h)? {
                        self.at = next;
                        return Ok(true);
                    }
                    None
                }
                Some(h) if BETWEEN.contains(&h.id) => end_of(at, h).filter(|next| *next <= self.end),
                _ => None,
            };
            match next {
                Some(next) => self.at = next,
                None => self.pass_over(at, head)?,
            }
        }
        Ok(false)
    }

    /// Reads the cluster at `at` and proves it. Returns where it ends, or `None` when it is not good.
    fn load(&mut self, at: u64, head: Head) -> Result<Option<u64>> {
        let Some(next) = self.cluster_end(at, head)? else { return Ok(None) };
        let from = at + head.len as u64;
        let size = next - from;
        if size > MAX_CLUSTER {
            return Ok(None);
        }
        let size = size as usize;
        if self.body.len() < size {
            // Exactly as much as there is: growing by doubling would make memory depend on the order of the clusters.
            self.body = Vec::new();
            self.body.resize(size, 0);
        }
        let body = self.body.get_mut(..size).unwrap_or_default();
        self.source.read_at(from, body).map_err(|e| unreadable(&self.name, e))?;
        let Some(time) = prove(body) else { return Ok(None) };
        (self.time, self.used, self.cursor) = (time, size, 0);
        Ok(Some(next))
    }

    /// Where a cluster ends that lies within the file.
    fn cluster_end(&self, at: u64, head: Head) -> Result<Option<u64>> {
        if head.size.is_some() {
            return Ok(end_of(at, head).filter(|next| *next <= self.end));
        }
        // Of unknown size: it ends before the first element that does not belong to it.
        let mut next = at + head.len as u64;
        while next < self.end && next - at <= MAX_CLUSTER {
            let Some(child) = self.head(next)? else { return Ok(None) };
            if child.id == id::CLUSTER || (BETWEEN.contains(&child.id) && child.id != id::VOID) {
                break;
            }
            match end_of(next, child).filter(|end| *end <= self.end) {
                Some(end) => next = end,
                None => return Ok(None),
            }
        }
        Ok(Some(next))
    }

    /// Notes that what is at `at` is damaged, and goes to the next thing that looks like a cluster.
    fn pass_over(&mut self, at: u64, head: Option<Head>) -> Result<()> {
        let claimed = head.filter(|h| h.id == id::CLUSTER).and_then(|h| end_of(at, h));
        // The end of a cluster that is damaged only inside can be trusted.
        let follows = match claimed {
            Some(next) if next < self.end => {
                self.head(next)?.is_some_and(|h| h.id == id::CLUSTER || BETWEEN.contains(&h.id))
            }
            Some(next) => next == self.end,
            None => false,
        };
        self.at = match claimed {
            Some(next) if follows => next,
            _ => self.search(at + 1)?,
        };
        self.losses.places += 1;
        self.losses.bytes += self.at - at;
        if self.losses.places.is_power_of_two() {
            let name = &self.name;
            let bytes = self.at - at;
            if self.at >= self.end {
                tracing::warn!(
                    "{name}: the last {bytes} bytes, from byte {at} on, are cut off or damaged and left out"
                );
            } else {
                tracing::warn!("{name}: {bytes} bytes at byte {at} are damaged and left out");
            }
        }
        Ok(())
    }

    /// The first place from `from` on that looks like a cluster, or the end.
    fn search(&mut self, mut from: u64) -> Result<u64> {
        let wanted = id::CLUSTER.to_be_bytes();
        let mut bytes = vec![0; SEARCH];
        while self.end.saturating_sub(from) > PEEK as u64 && self.false_starts < MAX_FALSE_STARTS {
            let there = (self.end - from).min(SEARCH as u64) as usize;
            let bytes = bytes.get_mut(..there).unwrap_or_default();
            self.source.read_at(from, bytes).map_err(|e| unreadable(&self.name, e))?;
            let mut skip = 0;
            while let Some(found) =
                bytes.get(skip..).and_then(|rest| rest.windows(4).position(|w| w == wanted))
            {
                skip += found + 1;
                let at = from + (skip - 1) as u64;
                if self.peek(at)?.is_some() {
                    return Ok(at);
                }
                self.false_starts += 1;
                if self.false_starts >= MAX_FALSE_STARTS {
                    return Ok(self.end);
                }
            }
            // An identifier may lie across the border.
            from += (there - 3) as u64;
        }
        Ok(self.end)
    }

    /// The time of the cluster at `at`, and where it ends if it says so; `None` without a cluster there.
    fn peek(&self, at: u64) -> Result<Option<(u64, Option<u64>)>> {
        let mut bytes = [0; PEEK];
        let there = self.end.saturating_sub(at).min(PEEK as u64) as usize;
        if there == 0 {
            return Ok(None);
        }
        let bytes = bytes.get_mut(..there).unwrap_or_default();
        self.source.read_at(at, bytes).map_err(|e| unreadable(&self.name, e))?;
        let Some(head) = ebml::head(bytes).filter(|h| h.id == id::CLUSTER) else { return Ok(None) };
        let mut cursor = head.len;
        while let Some((of, start, end)) = element(bytes, cursor, bytes.len()) {
            if of == id::TIMESTAMP {
                let time = bytes.get(start..end).and_then(ebml::uint);
                return Ok(time.map(|time| (time, end_of(at, head).filter(|next| *next <= self.end))));
            }
            cursor = end;
        }
        Ok(None)
    }

    /// Goes to the last cluster whose time is at most `time`, units of the file.
    pub(super) fn seek(&mut self, time: u64) -> Result<()> {
        (self.used, self.cursor) = (0, 0);
        self.at = self.by_index(time)?.unwrap_or(self.first);
        let mut next = self.peek(self.at)?.and_then(|(_, next)| next);
        while let Some(at) = next {
            let Some(head) = self.head(at)? else { break };
            if BETWEEN.contains(&head.id) {
                next = end_of(at, head).filter(|next| *next < self.end);
                continue;
            }
            let Some((begins, end)) = self.peek(at)?.filter(|(begins, _)| *begins <= time) else { break };
            debug_assert!(begins <= time);
            (self.at, next) = (at, end);
        }
        Ok(())
    }

    /// Where the index says that the last cluster is whose time is at most `time`.
    fn by_index(&self, time: u64) -> Result<Option<u64>> {
        let Some(at) = self.cues else { return Ok(None) };
        let head = self.head(at)?.filter(|h| h.id == id::CUES && h.size.is_some_and(|size| size <= MAX_CUES));
        let Some(head) = head else { return Ok(None) };
        let Some(end) = end_of(at, head).filter(|end| *end <= self.end) else { return Ok(None) };
        let from = at + head.len as u64;
        let mut body = vec![0; (end - from) as usize];
        self.source.read_at(from, &mut body).map_err(|e| unreadable(&self.name, e))?;
        let entries = ebml::children(&body).filter(|c| c.0 == id::CUE_POINT).filter_map(|(_, cue)| {
            let place = ebml::child(cue, id::CUE_TRACK_POSITIONS)?;
            Some((ebml::child_uint(cue, id::CUE_TIME)?, ebml::child_uint(place, id::CUE_CLUSTER_POSITION)?))
        });
        let best = entries.filter(|(t, _)| *t <= time).max();
        let Some(at) = best.and_then(|(_, position)| self.origin.checked_add(position)) else {
            return Ok(None);
        };
        // An index may lie.
        Ok(self.peek(at)?.filter(|(begins, _)| *begins <= time).map(|_| at))
    }

    fn head(&self, at: u64) -> Result<Option<Head>> {
        head_at(self.source.as_ref(), at, self.end).map_err(|e| unreadable(&self.name, e))
    }
}

/// Where the element at `at` ends.
fn end_of(at: u64, head: Head) -> Option<u64> {
    at.checked_add(head.len as u64)?.checked_add(head.size?)
}

fn unreadable(name: &str, e: std::io::Error) -> Error {
    Error::new(ErrorKind::Io, format!("{name}: the recording cannot be read: {e}")).with_source(e)
}

/// Identifier, start and end of the element at `at` in the first `used` bytes, if it is complete.
fn element(bytes: &[u8], at: usize, used: usize) -> Option<(u32, usize, usize)> {
    let rest = bytes.get(at..used)?;
    let head = ebml::head(rest)?;
    let end = usize::try_from(head.size?).ok()?.checked_add(head.len)?;
    (end <= rest.len()).then_some((head.id, at + head.len, at + end))
}

/// Where the block of a group is.
fn block_of(bytes: &[u8], mut at: usize, end: usize) -> Option<(usize, usize)> {
    loop {
        let (of, start, next) = element(bytes, at, end)?;
        if of == id::BLOCK {
            return Some((start, next));
        }
        at = next;
    }
}

/// Proves that a cluster is good: its checksum, if it has one, its elements and its blocks. Returns its time.
fn prove(body: &[u8]) -> Option<u64> {
    let mut elements = ebml::children(body);
    let mut time = None;
    let mut first = true;
    for (of, inside) in elements.by_ref() {
        match of {
            // RFC 8794, section 11.3.1: of all that follows it, the low byte first.
            id::CRC_32 if first => {
                let rest = body.get(inside.len() + 2..)?;
                if u32::from_le_bytes(*inside.first_chunk()?) != crc32fast::hash(rest) {
                    return None;
                }
            }
            id::TIMESTAMP => time = Some(ebml::uint(inside)?),
            id::SIMPLE_BLOCK => ebml::block(inside)?.frames().map(|_| ())?,
            id::BLOCK_GROUP => ebml::block(ebml::child(inside, id::BLOCK)?)?.frames().map(|_| ())?,
            _ => {}
        }
        first = false;
    }
    if elements.is_complete() { time } else { None }
}
