//! One chunk, packed in memory by whoever has its messages, ready to be appended to a file.

use super::pool::{Buffer, Pool};
use super::record::{op, put_le, put_str};
use crate::frame::Pixels;
use crate::{Error, ErrorKind, Result};
use core::convert::Infallible;
use std::sync::Arc;

/// Messages below this many bytes are not worth compressing.
const SMALL: usize = 512;

/// A chunk record and what the index must know of it.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// The record, behind `start` bytes that are not of it, up to its tail.
    record: Buffer,
    start: usize,
    tail: Option<Tail>,
    /// CRC-32 of the record.
    pub(crate) crc: u32,
    pub(crate) start_time: u64,
    pub(crate) end_time: u64,
    pub(crate) compression: &'static str,
    pub(crate) compressed_size: u64,
    pub(crate) uncompressed_size: u64,
    /// Channel, log time and offset of each message.
    pub(crate) messages: Vec<(u16, u64, u64)>,
}

/// Bytes at the end of a record that are written from where they lie.
pub(crate) struct Tail {
    pixels: Box<dyn Pixels>,
    len: usize,
}

impl Tail {
    /// The first `len` bytes of `pixels`; `None` where there are fewer.
    pub(crate) fn new(pixels: Box<dyn Pixels>, len: usize) -> Option<Self> {
        (pixels.bytes().len() >= len).then_some(Self { pixels, len })
    }

    fn bytes(&self) -> &[u8] {
        &self.pixels.bytes()[..self.len]
    }
}

impl core::fmt::Debug for Tail {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Tail of {} bytes", self.len)
    }
}

/// Head of a message, before its data.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MessageHead {
    pub(crate) channel: u16,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) publish_time: u64,
}

/// Collects messages and packs them; buffers are reused from chunk to chunk.
pub(crate) struct ChunkBuilder {
    /// Room for the chunk's head (longest form), then the message records.
    buf: Buffer,
    /// `buf` becomes the record itself if it is not compressed; otherwise the record is a copy, of its true size.
    hand_over: bool,
    /// The end of the last message, which is not in `buf`.
    tail: Option<Tail>,
    /// Where records come from.
    pool: Arc<Pool>,
    messages: Vec<(u16, u64, u64)>,
    /// Of the message records so far. Each byte is hashed once; the other checksums are combined from that.
    crc: crc32fast::Hasher,
    zstd: Option<zstd::bulk::Compressor<'static>>,
    /// Where the compressor writes.
    packed: Vec<u8>,
}

/// Opcode, length, two times, two sizes, CRC, the compression's name with its length.
const fn head_len(compression: &str) -> usize {
    1 + 8 + 8 + 8 + 8 + 4 + 4 + compression.len() + 8
}
const ROOM: usize = head_len("zstd");
/// Opcode, length, channel, sequence and two times of a message record.
const MESSAGE_HEAD: usize = 1 + 8 + 2 + 4 + 8 + 8;

impl ChunkBuilder {
    /// A builder that lets go of what was written.
    pub(crate) fn new() -> Self {
        Self::with_pool(&Pool::new(0))
    }

    /// A builder that takes buffers from a pool, to which they go back once their chunk was written.
    pub(crate) fn with_pool(pool: &Arc<Pool>) -> Self {
        Self {
            buf: Buffer::default(),
            hand_over: false,
            tail: None,
            pool: Arc::clone(pool),
            messages: Vec::new(),
            crc: crc32fast::Hasher::new(),
            zstd: None,
            packed: Vec::new(),
        }
    }

    /// Says of an empty chunk that it will be of one message of about `len` bytes, and not be compressed: it is
    /// written where it stays.
    pub(crate) fn expect(&mut self, len: usize) {
        if self.messages.is_empty() {
            (self.buf, self.hand_over) = (self.pool.take(ROOM + MESSAGE_HEAD + len), true);
        }
    }

    /// Appends a message whose data `fill` writes; returns length and CRC-32 of the data.
    pub(crate) fn message<E>(
        &mut self,
        head: MessageHead,
        fill: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
    ) -> Result<(u64, u32), E> {
        self.make_room();
        let at = self.buf.len();
        self.buf.push(op::MESSAGE);
        put_le!(self.buf, 0u64, head.channel, head.sequence, head.log_time, head.publish_time);
        let data = self.buf.len();
        if let Err(e) = fill(&mut self.buf) {
            self.buf.truncate(at);
            self.hand_over = false;
            return Err(e);
        }
        Ok(self.end_message(head, at, data))
    }

    /// The only message of an empty chunk, whose data `fill` begins and `tail` ends; otherwise as [`Self::message`]. It
    /// is not compressed.
    pub(crate) fn message_with_tail(
        &mut self,
        head: MessageHead,
        tail: Tail,
        fill: impl FnOnce(&mut Vec<u8>),
    ) -> (u64, u32) {
        debug_assert!(self.messages.is_empty() && self.tail.is_none());
        self.tail = Some(tail);
        let begun = self.message::<Infallible>(head, |buf| {
            fill(buf);
            Ok(())
        });
        match begun {
            Ok(content) => content,
            Err(never) => match never {},
        }
    }

    /// Puts the length of the message at `at` right, whose data begins at `data`.
    fn end_message(&mut self, head: MessageHead, at: usize, data: usize) -> (u64, u32) {
        let tail = self.tail.as_ref().map_or(&[][..], Tail::bytes);
        let data_len = (self.buf.len() - data + tail.len()) as u64;
        let len = (data - at - 9) as u64 + data_len;
        self.buf[at + 1..at + 9].copy_from_slice(&len.to_le_bytes());
        self.messages.push((head.channel, head.log_time, (at - ROOM) as u64));
        let mut crc = crc32fast::Hasher::new();
        crc.update(&self.buf[data..]);
        crc.update(tail);
        self.crc.update(&self.buf[at..data]);
        self.crc.combine(&crc);
        (data_len, crc.finalize())
    }

    /// Packs what was collected and begins anew.
    ///
    /// # Errors
    /// [`ErrorKind::Codec`] when the compressor fails.
    pub(crate) fn pack(&mut self, compress: bool) -> Result<Chunk> {
        let messages = std::mem::take(&mut self.messages);
        self.make_room();
        let tail = self.tail.take();
        let tail_len = tail.as_ref().map_or(0, |t| t.len);
        let records = self.buf.len() - ROOM;
        let uncompressed_size = (records + tail_len) as u64;
        let records_crc = std::mem::take(&mut self.crc);
        let uncompressed_crc = records_crc.clone().finalize();
        let start_time = messages.iter().map(|m| m.1).min().unwrap_or(0);
        let end_time = messages.iter().map(|m| m.1).max().unwrap_or(0);
        let packed = if compress && records >= SMALL && tail_len == 0 { self.compress()? } else { None };

        let (compression, mut record) = match packed {
            Some(record) => ("zstd", record),
            None if self.hand_over => ("", std::mem::take(&mut self.buf)),
            None => ("", self.copy(&[], &self.buf)),
        };
        self.buf.clear();
        self.hand_over = false;
        // Without compression the head is shorter than the room left for it: what is before it goes.
        let spare = ROOM - head_len(compression);
        let compressed_size = (record.len() - ROOM + tail_len) as u64;
        let mut head = Vec::with_capacity(ROOM);
        head.push(op::CHUNK);
        put_le!(head, (record.len() - spare - 9 + tail_len) as u64, start_time, end_time);
        put_le!(head, uncompressed_size, uncompressed_crc);
        put_str(&mut head, compression);
        put_le!(head, compressed_size);
        record[spare..ROOM].copy_from_slice(&head);
        let mut crc = crc32fast::Hasher::new();
        if compression.is_empty() {
            crc.update(&head);
            crc.combine(&records_crc);
        } else {
            crc.update(&record[spare..]);
        }
        Ok(Chunk {
            record,
            start: spare,
            tail,
            crc: crc.finalize(),
            start_time,
            end_time,
            compression,
            compressed_size,
            uncompressed_size,
            messages,
        })
    }

    /// An empty head before the first message.
    fn make_room(&mut self) {
        let len = self.buf.len().max(ROOM);
        self.buf.resize(len, 0);
    }

    /// Both in a buffer of their size.
    fn copy(&self, head: &[u8], rest: &[u8]) -> Buffer {
        let mut record = self.pool.take(head.len() + rest.len());
        record.extend_from_slice(head);
        record.extend_from_slice(rest);
        record
    }

    /// The compressed records behind an empty head, or `None` when that saves nothing.
    fn compress(&mut self) -> Result<Option<Buffer>> {
        let fail = |e| Error::new(ErrorKind::Codec, "zstd failed").with_source(e);
        if self.zstd.is_none() {
            self.zstd = Some(zstd::bulk::Compressor::new(1).map_err(fail)?);
        }
        let Some(zstd) = &mut self.zstd else { return Ok(None) };
        let records = &self.buf[ROOM..];
        self.packed.clear();
        self.packed.reserve(zstd::zstd_safe::compress_bound(records.len()));
        zstd.compress_to_buffer(records, &mut self.packed).map_err(fail)?;
        if self.packed.len() >= records.len() {
            return Ok(None);
        }
        Ok(Some(self.copy(&[0; ROOM], &self.packed)))
    }
}

impl Chunk {
    /// The bytes of the record, in two parts.
    pub(crate) fn parts(&self) -> [&[u8]; 2] {
        [&self.record[self.start..], self.tail.as_ref().map_or(&[], Tail::bytes)]
    }

    /// Bytes of the record.
    pub(crate) fn len(&self) -> u64 {
        self.parts().iter().map(|p| p.len() as u64).sum()
    }

    /// The fields of a record that was read.
    pub(crate) fn body(&self) -> &[u8] {
        &self.record[self.start + 9..]
    }

    /// A chunk as it lies in a file, opcode and length included, to be appended to another one as it is. Its
    /// `messages` are for the caller to fill in. `None` when its lengths contradict each other or it is packed
    /// in a way that depthrig does not use.
    pub(crate) fn from_record(record: Vec<u8>) -> Option<Self> {
        let head = ChunkHead::read(&record)?;
        (head.record_len() == record.len() as u64).then(|| Self {
            crc: crc32fast::hash(&record),
            record: record.into(),
            start: 0,
            tail: None,
            start_time: head.start_time,
            end_time: head.end_time,
            compression: head.compression,
            compressed_size: head.compressed_size,
            uncompressed_size: head.uncompressed_size,
            messages: Vec::new(),
        })
    }
}

/// Head of a chunk record, before its data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChunkHead {
    pub(crate) start_time: u64,
    pub(crate) end_time: u64,
    pub(crate) compression: &'static str,
    pub(crate) compressed_size: u64,
    pub(crate) uncompressed_size: u64,
}

impl ChunkHead {
    /// Bytes that are enough to read any head.
    pub(crate) const MAX_LEN: usize = ROOM;

    /// The head that `bytes` begin with; `None` when they do not begin with a chunk of ours. The opcode, two
    /// lengths and the compression's name must agree, so that hardly anything else is taken for one.
    pub(crate) fn read(bytes: &[u8]) -> Option<Self> {
        let u64_at = |at: usize| Some(u64::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
        let name = u32::from_le_bytes(*bytes.get(37..)?.first_chunk()?) as usize;
        let compression = match (name, bytes.get(41..)?) {
            (0, _) => "",
            (4, rest) if rest.starts_with(b"zstd") => "zstd",
            _ => return None,
        };
        let head = Self {
            start_time: u64_at(9)?,
            end_time: u64_at(17)?,
            compression,
            compressed_size: u64_at(41 + name)?,
            uncompressed_size: u64_at(25)?,
        };
        let agrees = bytes[0] == op::CHUNK
            && u64_at(1)?.checked_add(9) == Some(head.record_len())
            && head.start_time <= head.end_time
            && (head.compressed_size == head.uncompressed_size || !compression.is_empty());
        agrees.then_some(head)
    }

    /// Bytes of the whole record.
    pub(crate) const fn record_len(&self) -> u64 {
        (head_len(self.compression) as u64).saturating_add(self.compressed_size)
    }
}
