//! One chunk, packed in memory by whoever has its messages, ready to be appended to a file.

use super::record::{op, put_le, put_str};
use crate::{Error, ErrorKind, Result};

/// Messages below this many bytes are not worth compressing.
const SMALL: usize = 512;

/// A chunk record and what the index must know of it.
#[derive(Debug)]
pub(crate) struct Chunk {
    /// The record, behind `start` bytes that are not of it.
    record: Vec<u8>,
    start: usize,
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

/// What goes before a message's data.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MessageHead {
    pub(crate) channel: u16,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) publish_time: u64,
}

/// Collects messages and packs them; buffers are reused from chunk to chunk.
#[derive(Default)]
pub(crate) struct ChunkBuilder {
    /// Room for the chunk's head (longest form), then the message records.
    buf: Vec<u8>,
    messages: Vec<(u16, u64, u64)>,
    /// Of the message records so far. Each byte is hashed once; the other checksums are combined from that.
    crc: crc32fast::Hasher,
    zstd: Option<zstd::bulk::Compressor<'static>>,
    /// Where the compressor writes; the record is copied out of it at its true size.
    packed: Vec<u8>,
}

/// Opcode, length, two times, two sizes, CRC, the compression's name with its length.
const fn head_len(compression: &str) -> usize {
    1 + 8 + 8 + 8 + 8 + 4 + 4 + compression.len() + 8
}
const ROOM: usize = head_len("zstd");

impl ChunkBuilder {
    pub(crate) fn new() -> Self {
        Self::default()
    }

    /// Appends a message whose data `fill` writes; returns length and CRC-32 of the data.
    pub(crate) fn message<E>(
        &mut self,
        head: MessageHead,
        fill: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
    ) -> Result<(u64, u32), E> {
        self.buf.resize(self.buf.len().max(ROOM), 0);
        let at = self.buf.len();
        self.buf.push(op::MESSAGE);
        put_le!(self.buf, 0u64, head.channel, head.sequence, head.log_time, head.publish_time);
        let data = self.buf.len();
        if let Err(e) = fill(&mut self.buf) {
            self.buf.truncate(at);
            return Err(e);
        }
        let len = (self.buf.len() - at - 9) as u64;
        self.buf[at + 1..at + 9].copy_from_slice(&len.to_le_bytes());
        self.messages.push((head.channel, head.log_time, (at - ROOM) as u64));
        let (data_len, data_crc) = ((self.buf.len() - data) as u64, crc32fast::hash(&self.buf[data..]));
        self.crc.update(&self.buf[at..data]);
        self.crc.combine(&crc32fast::Hasher::new_with_initial_len(data_crc, data_len));
        Ok((data_len, data_crc))
    }

    /// Packs what was collected and begins anew.
    ///
    /// # Errors
    /// [`ErrorKind::Codec`] when the compressor fails.
    pub(crate) fn pack(&mut self, compress: bool) -> Result<Chunk> {
        let messages = std::mem::take(&mut self.messages);
        self.buf.resize(self.buf.len().max(ROOM), 0);
        let records = &self.buf[ROOM..];
        let uncompressed_size = records.len() as u64;
        let records_crc = std::mem::take(&mut self.crc);
        let uncompressed_crc = records_crc.clone().finalize();
        let start_time = messages.iter().map(|m| m.1).min().unwrap_or(0);
        let end_time = messages.iter().map(|m| m.1).max().unwrap_or(0);
        let packed = if compress && records.len() >= SMALL { self.compress()? } else { None };

        let (compression, mut record) = match packed {
            Some(record) => ("zstd", record),
            None => ("", std::mem::take(&mut self.buf)),
        };
        self.buf.clear();
        // Without compression the head is shorter than the room left for it: what is before it goes.
        let spare = ROOM - head_len(compression);
        let compressed_size = (record.len() - ROOM) as u64;
        let mut head = Vec::with_capacity(ROOM);
        head.push(op::CHUNK);
        put_le!(head, (record.len() - spare - 9) as u64, start_time, end_time);
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
            crc: crc.finalize(),
            start_time,
            end_time,
            compression,
            compressed_size,
            uncompressed_size,
            messages,
        })
    }

    /// The compressed records behind an empty head, or `None` when that saves nothing.
    fn compress(&mut self) -> Result<Option<Vec<u8>>> {
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
        let mut record = Vec::with_capacity(ROOM + self.packed.len());
        record.resize(ROOM, 0);
        record.extend_from_slice(&self.packed);
        Ok(Some(record))
    }
}

impl Chunk {
    /// The bytes of the record.
    pub(crate) fn bytes(&self) -> &[u8] {
        &self.record[self.start..]
    }

    /// The fields of the record.
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
            record,
            start: 0,
            start_time: head.start_time,
            end_time: head.end_time,
            compression: head.compression,
            compressed_size: head.compressed_size,
            uncompressed_size: head.uncompressed_size,
            messages: Vec::new(),
        })
    }
}

/// What a chunk record says before its data.
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
