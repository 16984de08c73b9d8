//! Copying from one segment to another: complete sets and what lies between them, each chunk proven and then
//! appended as it lies there, never packed anew.
//!
//! [`Groups`] walks a file in constant memory, one set at a time. It needs no index and survives damage: what
//! cannot be proven is skipped, reported as [`Group::Damage`], and the walk goes on at the next good chunk.
//! Bytes that a checkpoint (or the checksum of the whole data) vouches for are not unpacked; all others are.

use super::chunk::{Chunk, ChunkHead};
use super::record::{Channel, SchemaRecord, op};
use super::scan::{HEAD, SegmentReader};
use super::segment::{Preamble, Segment};
use crate::msgs::frame_set::{Checkpoint, FrameSetMsg};
use crate::msgs::schemas::Schema;
use crate::{Error, ErrorKind, Result};
use mcap::records::Record;
use std::collections::{BTreeMap, VecDeque};

mod proof;
#[cfg(test)]
mod tests;

/// Bytes read at a time where they are only looked at.
const WINDOW: u64 = 1 << 20;

/// A part of a segment after its head.
#[derive(Debug)]
pub(crate) enum Group {
    /// A complete set.
    Set(SetGroup),
    /// A chunk between two sets: clock, accounts, notes, diagnostics, `/tf_static`.
    Between(BetweenGroup),
    /// A metadata record after the first chunk.
    Metadata(String, BTreeMap<String, String>),
    /// Bytes that belong to no complete set.
    Damage(Damage),
}

/// A set: its images, and last the chunk with its commit mark.
#[derive(Debug)]
pub(crate) struct SetGroup {
    pub(crate) mark: FrameSetMsg,
    pub(crate) log_time: u64,
    /// In the order of the file.
    pub(crate) chunks: Vec<Chunk>,
    /// Where each of them begins in the file.
    pub(crate) offsets: Vec<u64>,
}

/// A chunk between two sets.
#[derive(Debug)]
pub(crate) struct BetweenGroup {
    pub(crate) chunk: Chunk,
    pub(crate) offset: u64,
    /// Whether it is the one with `/tf_static` that every segment begins with.
    pub(crate) head: bool,
}

/// Bytes that were skipped.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Damage {
    /// The first byte, and the one after the last.
    pub(crate) from: u64,
    pub(crate) to: u64,
    pub(crate) kind: DamageKind,
    /// The set that it was, where its mark can still be read.
    pub(crate) set: Option<u64>,
    /// The fault, in words.
    pub(crate) why: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DamageKind {
    /// The file ends here, in the middle of a record.
    Tail,
    /// Images without a commit mark, or a mark without its images.
    Torn,
    /// Bytes that are not a good record, with good ones after them.
    Bytes,
    /// The file holds nothing at all.
    Empty,
}

/// Meaning of a channel for the walk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Image,
    Set,
    TfStatic,
    Checkpoint,
}

/// An image whose set is not complete yet.
struct Image {
    chunk: Chunk,
    offset: u64,
    channel: u16,
    log_time: u64,
    /// Length and CRC-32 of the message, where the chunk was unpacked.
    content: Option<(u64, u32)>,
}

/// The groups of a segment in the order of the file.
pub(crate) struct Groups<'a> {
    reader: &'a SegmentReader,
    roles: BTreeMap<u16, Role>,
    /// The image channel of each stream.
    images: BTreeMap<String, u16>,
    /// Where the next record begins.
    at: u64,
    /// The bytes before this are proven by a checksum over all of them.
    proven: u64,
    pending: Vec<Image>,
    ready: VecDeque<Group>,
    ended: bool,
}

/// The preamble before the first chunk, and the offset of that chunk or of the damage before it: once schemas,
/// channels and metadata are there, the rest can be done without.
///
/// # Errors
/// [`ErrorKind::Corrupt`] or [`ErrorKind::Truncated`] when a record before them is damaged, [`ErrorKind::Io`].
pub(crate) fn read_preamble(reader: &SegmentReader) -> Result<(Preamble, u64)> {
    let mut p =
        Preamble { schemas: Vec::new(), channels: Vec::new(), metadata: Vec::new(), attachments: Vec::new() };
    let mut offset = 8;
    while offset < reader.size {
        match preamble_record(reader, &mut p, offset) {
            Ok(Some(next)) => offset = next,
            Ok(None) => break,
            Err(e) if is_damage(&e) && !p.metadata.is_empty() => break,
            Err(e) => return Err(e),
        }
    }
    Ok((p, offset.min(reader.size)))
}

/// Takes one record before the first chunk; where the next one begins.
fn preamble_record(reader: &SegmentReader, p: &mut Preamble, offset: u64) -> Result<Option<u64>> {
    let (opcode, len) = reader.record_head(offset)?;
    if matches!(opcode, op::CHUNK | op::DATA_END) {
        return Ok(None);
    }
    let body = reader.read(offset + HEAD, len)?;
    match reader.parse(opcode, &body, offset)? {
        Record::Header(_) => {}
        Record::Schema { header, data } => p.schemas.push(SchemaRecord {
            id: header.id,
            name: header.name,
            encoding: header.encoding,
            data: data.into_owned(),
        }),
        Record::Channel(c) => {
            p.channels.push(Channel { id: c.id, schema: c.schema_id, topic: c.topic, metadata: c.metadata });
        }
        Record::Metadata(m) => p.metadata.push((m.name, m.metadata)),
        Record::Attachment { header, data, crc } => {
            if crc != 0 && crc != crc32fast::hash(&body[..body.len() - 4]) {
                return Err(reader.error(ErrorKind::Corrupt, offset, "an attachment's checksum is wrong"));
            }
            p.attachments.push((header.log_time, header.name, header.media_type, data.into_owned()));
        }
        _ => {
            let what = format!("a record of type {opcode} before the first chunk");
            return Err(reader.error(ErrorKind::Corrupt, offset, what));
        }
    }
    Ok(Some(offset + HEAD + len))
}

impl<'a> Groups<'a> {
    /// The groups of the file behind `reader`, from `first`, where its first chunk begins or may begin. The
    /// reader needs no index.
    pub(crate) fn new(reader: &'a SegmentReader, preamble: &Preamble, first: u64) -> Result<Self> {
        let mut roles = BTreeMap::new();
        let mut images = BTreeMap::new();
        let schemas: BTreeMap<_, _> = preamble.schemas.iter().map(|s| (s.id, s.name.as_str())).collect();
        for c in &preamble.channels {
            let is = |s: Schema| schemas.get(&c.schema) == Some(&s.name());
            let role = if Schema::IMAGES.into_iter().any(is) {
                let Some(stream) = c.metadata.get("stream") else { continue };
                images.insert(stream.clone(), c.id);
                Role::Image
            } else if is(Schema::FrameSet) {
                Role::Set
            } else if is(Schema::TfMessage) {
                Role::TfStatic
            } else if is(Schema::Checkpoint) {
                Role::Checkpoint
            } else {
                continue;
            };
            roles.insert(c.id, role);
        }
        let mut groups = Self {
            reader,
            roles,
            images,
            at: first,
            proven: 0,
            pending: Vec::new(),
            ready: VecDeque::new(),
            ended: false,
        };
        groups.prove(0, 0, first)?;
        Ok(groups)
    }

    /// Whether a checksum proves every byte before the first chunk.
    pub(crate) const fn proves_head(&self) -> bool {
        self.proven >= self.at
    }

    /// Where the walk stands.
    pub(crate) const fn offset(&self) -> u64 {
        self.at
    }

    /// The next group; `None` at the end of the data.
    ///
    /// # Errors
    /// When the operating system cannot read the file. Damage is not an error.
    pub(crate) fn next(&mut self) -> Result<Option<Group>> {
        loop {
            if let Some(group) = self.ready.pop_front() {
                return Ok(Some(group));
            }
            if self.ended {
                return Ok(None);
            }
            self.step()?;
        }
    }

    /// Takes one record, or what is damaged.
    fn step(&mut self) -> Result<()> {
        if self.at >= self.reader.size {
            self.end();
            return Ok(());
        }
        let at = self.at;
        match self.record(at) {
            Ok(next) => self.at = next,
            Err(e) if is_damage(&e) => self.pass_over(at, &e)?,
            Err(e) => return Err(e),
        }
        Ok(())
    }

    /// Takes the record at `at`; where the next one begins.
    fn record(&mut self, at: u64) -> Result<u64> {
        let (opcode, len) = self.reader.record_head(at)?;
        let next = at.checked_add(HEAD).and_then(|o| o.checked_add(len)).filter(|n| *n <= self.reader.size);
        let next = next.ok_or_else(|| {
            let what = format!("a record of {len} bytes is cut off by the end of the file");
            self.reader.error(ErrorKind::Truncated, at, what)
        })?;
        match opcode {
            op::CHUNK => return self.chunk(at, next),
            op::DATA_END if len == 4 => self.end(),
            // Computed anew from the chunk; looked at, because a damaged chunk may pass for one.
            op::MESSAGE_INDEX => {
                let body = self.reader.read(at + HEAD, len)?;
                let entries = body.get(2..6).and_then(|n| n.first_chunk()).map(|n| u32::from_le_bytes(*n));
                if len % 16 != 6 || entries.map(u64::from) != Some(len - 6) {
                    return Err(self.reader.error(ErrorKind::Corrupt, at, "a damaged message index"));
                }
            }
            op::METADATA => {
                let body = self.reader.read(at + HEAD, len)?;
                if let Record::Metadata(m) = self.reader.parse(opcode, &body, at)? {
                    self.ready.push_back(Group::Metadata(m.name, m.metadata));
                }
            }
            other => {
                let what = format!("no record of type {other} belongs here");
                return Err(self.reader.error(ErrorKind::Corrupt, at, what));
            }
        }
        Ok(next)
    }

    /// Takes the chunk from `at` to `next`; where the next record begins.
    fn chunk(&mut self, at: u64, next: u64) -> Result<u64> {
        let record = self.reader.read(at, next - at)?;
        let mut chunk = Chunk::from_record(record).ok_or_else(|| {
            self.reader.error(ErrorKind::Corrupt, at, "the head of a chunk contradicts itself")
        })?;
        if next < self.proven {
            let after = self.listed(&mut chunk, next)?;
            // An image is alone in its chunk and gives it its times. Where the index says otherwise, the chunk itself is
            // asked: what else it is said to hold would be looked for in it later.
            let alone =
                matches!(chunk.messages[..], [(_, t, _)] if (t, t) == (chunk.start_time, chunk.end_time));
            if alone && self.role(&chunk) == Some(Role::Image) {
                self.image(chunk, at, None);
                return Ok(after);
            }
        }
        // The rest is small: what it says matters more than the time it takes.
        let mut content = None;
        let mut mark = None;
        let mut checkpoint = None;
        let mut messages = Vec::new();
        self.reader.chunk_messages(chunk.body(), at, |m| {
            messages.push((m.channel, m.log_time, m.offset));
            match self.roles.get(&m.channel) {
                Some(Role::Image) => content = Some((m.data.len() as u64, crc32fast::hash(m.data))),
                Some(Role::Set) => mark = Some((FrameSetMsg::read(m.data)?, m.log_time)),
                Some(Role::Checkpoint) => checkpoint = Some(Checkpoint::read(m.data)?),
                _ => {}
            }
            Ok(())
        })?;
        // The chunk's own checksum does not cover its head.
        let times = messages.iter().map(|m| m.1).min().zip(messages.iter().map(|m| m.1).max());
        if times.is_some_and(|times| times != (chunk.start_time, chunk.end_time)) {
            return Err(self.reader.error(
                ErrorKind::Corrupt,
                at,
                "the times of a chunk are not its messages'",
            ));
        }
        chunk.messages = messages;
        match (self.role(&chunk), mark) {
            (_, Some((mark, log_time))) => self.commit(chunk, at, mark, log_time),
            (Some(Role::Image), _) => self.image(chunk, at, content),
            (role, _) => {
                self.tear();
                let head = role == Some(Role::TfStatic);
                self.ready.push_back(Group::Between(BetweenGroup { chunk, offset: at, head }));
            }
        }
        if let Some(c) = checkpoint.filter(|c| c.file_bytes == at) {
            self.prove(at, c.crc32, next)?;
        }
        Ok(next)
    }

    /// The role of a chunk: a commit mark outweighs images, these outweigh the rest.
    fn role(&self, chunk: &Chunk) -> Option<Role> {
        let rank = |r: &Role| match r {
            Role::Set => 3,
            Role::Image => 2,
            Role::TfStatic => 1,
            Role::Checkpoint => 0,
        };
        let roles = chunk.messages.iter().filter_map(|m| self.roles.get(&m.0).copied());
        roles.max_by_key(rank)
    }

    /// Fills in the messages of a proven chunk from the index records after it; where those end.
    fn listed(&self, chunk: &mut Chunk, mut at: u64) -> Result<u64> {
        while at < self.proven {
            let (opcode, body) = self.reader.record(at)?;
            if opcode != op::MESSAGE_INDEX {
                break;
            }
            if let Record::MessageIndex(index) = self.reader.parse(opcode, &body, at)? {
                let entries = index.records.iter().map(|e| (index.channel_id, e.log_time, e.offset));
                chunk.messages.extend(entries);
            }
            at += HEAD + body.len() as u64;
        }
        chunk.messages.sort_unstable_by_key(|m| m.2);
        Ok(at)
    }

    fn image(&mut self, chunk: Chunk, offset: u64, content: Option<(u64, u32)>) {
        let Some(&(channel, log_time, _)) = chunk.messages.iter().find(|m| self.is_image(m.0)) else {
            return;
        };
        // Images of one set have one time and one stream each; so at most one set waits in memory.
        let other = |p: &Image| p.log_time != log_time || p.channel == channel;
        if self.pending.iter().any(other) {
            self.tear();
        }
        self.pending.push(Image { chunk, offset, channel, log_time, content });
    }

    fn is_image(&self, channel: u16) -> bool {
        self.roles.get(&channel) == Some(&Role::Image)
    }

    fn commit(&mut self, chunk: Chunk, offset: u64, mark: FrameSetMsg, log_time: u64) {
        let lacks = mark.members.iter().find(|member| {
            let channel = self.images.get(&member.stream);
            !self.pending.iter().any(|p| {
                Some(&p.channel) == channel
                    && p.log_time == log_time
                    && p.content.is_none_or(|c| c == (member.message_bytes, member.message_crc32))
            })
        });
        let why = match lacks {
            Some(member) => Some(format!("set {} lacks the image of {}", mark.id, member.stream)),
            None if self.pending.len() > mark.members.len() => {
                Some(format!("set {} has images that its mark does not list", mark.id))
            }
            None => None,
        };
        if let Some(why) = why {
            self.torn(Some((offset, &chunk)), Some(mark.id), why);
            return;
        }
        let mut chunks = Vec::new();
        let mut offsets = Vec::new();
        for p in self.pending.drain(..) {
            chunks.push(p.chunk);
            offsets.push(p.offset);
        }
        chunks.push(chunk);
        offsets.push(offset);
        self.ready.push_back(Group::Set(SetGroup { mark, log_time, chunks, offsets }));
    }

    /// Gives up the images that wait for their mark.
    fn tear(&mut self) {
        if !self.pending.is_empty() {
            let why = format!("{} images of a set without its commit mark", self.pending.len());
            self.torn(None, None, why);
        }
    }

    fn torn(&mut self, mark: Option<(u64, &Chunk)>, set: Option<u64>, why: String) {
        let spans = self.pending.iter().map(|p| (p.offset, p.offset + p.chunk.len()));
        let spans = spans.chain(mark.map(|(at, c)| (at, at + c.len())));
        let (from, to) = spans.fold((u64::MAX, 0), |(a, b), (from, to)| (a.min(from), b.max(to)));
        self.pending.clear();
        self.ready.push_back(Group::Damage(Damage { from, to, kind: DamageKind::Torn, set, why }));
    }

    /// The data ends here.
    fn end(&mut self) {
        self.tear();
        self.ended = true;
    }

    /// Goes on at the next good chunk after `from`.
    fn pass_over(&mut self, from: u64, why: &Error) -> Result<()> {
        // The mark of what waits may follow all the same: a damaged index hurts no set.
        let found = self.next_good_chunk(from + 1)?;
        let (to, kind) = match found {
            Some(at) => (at, DamageKind::Bytes),
            None => (self.reader.size, DamageKind::Tail),
        };
        if found.is_none() {
            self.tear();
        }
        let why = why.to_string();
        self.ready.push_back(Group::Damage(Damage { from, to, kind, set: None, why }));
        self.at = to;
        Ok(())
    }

    /// The first byte at or after `from` where a chunk begins whose content agrees with its checksum.
    fn next_good_chunk(&self, mut from: u64) -> Result<Option<u64>> {
        let overlap = ChunkHead::MAX_LEN as u64;
        while from < self.reader.size {
            let len = WINDOW.min(self.reader.size - from);
            let window = self.reader.read(from, len)?;
            for (i, _) in window.iter().enumerate().filter(|(_, b)| **b == op::CHUNK) {
                let Some(head) = ChunkHead::read(&window[i..]) else { continue };
                let at = from + i as u64;
                if at.checked_add(head.record_len()).is_some_and(|end| end <= self.reader.size) {
                    let (_, body) = self.reader.record(at)?;
                    match self.reader.chunk_messages(&body, at, |_| Ok(())) {
                        Ok(()) => return Ok(Some(at)),
                        Err(e) if is_damage(&e) => {}
                        Err(e) => return Err(e),
                    }
                }
            }
            if len < WINDOW {
                return Ok(None);
            }
            from += len - overlap;
        }
        Ok(None)
    }
}

/// Whether an error says that the file is damaged, and not that it cannot be read.
fn is_damage(e: &Error) -> bool {
    matches!(e.kind(), ErrorKind::Corrupt | ErrorKind::Truncated | ErrorKind::Version)
}

impl Segment {
    /// Appends a group as it was in its file.
    ///
    /// # Errors
    /// As [`Segment::append_chunks`].
    pub(crate) fn append_group(&mut self, group: &Group) -> Result<()> {
        match group {
            Group::Set(set) => self.append_chunks(&set.chunks),
            Group::Between(between) => self.append_chunks(std::slice::from_ref(&between.chunk)),
            Group::Metadata(name, map) => self.append_metadata(name, map),
            Group::Damage(_) => Ok(()),
        }
    }
}
