//! MCAP records as bytes: one opcode byte, eight bytes of length, the fields.

use std::collections::BTreeMap;

pub(crate) use mcap::records::op;

/// Appends a record whose fields `fill` writes.
pub(crate) fn put(buf: &mut Vec<u8>, opcode: u8, fill: impl FnOnce(&mut Vec<u8>)) {
    buf.push(opcode);
    let at = buf.len();
    buf.extend_from_slice(&[0; 8]);
    fill(buf);
    let len = (buf.len() - at - 8) as u64;
    buf[at..at + 8].copy_from_slice(&len.to_le_bytes());
}

/// Appends a string: four bytes of length, then the text.
pub(crate) fn put_str(buf: &mut Vec<u8>, s: &str) {
    put_bytes(buf, s.as_bytes());
}

fn put_bytes(buf: &mut Vec<u8>, bytes: &[u8]) {
    buf.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
    buf.extend_from_slice(bytes);
}

/// Appends something whose length in bytes goes before it, in four bytes.
fn put_sized(buf: &mut Vec<u8>, fill: impl FnOnce(&mut Vec<u8>)) {
    let at = buf.len();
    buf.extend_from_slice(&[0; 4]);
    fill(buf);
    let len = (buf.len() - at - 4) as u32;
    buf[at..at + 4].copy_from_slice(&len.to_le_bytes());
}

/// Appends the numbers little-endian.
macro_rules! put_le {
    ($buf:expr, $($v:expr),*) => {{ $($buf.extend_from_slice(&$v.to_le_bytes());)* }};
}
pub(crate) use put_le;

fn put_map(buf: &mut Vec<u8>, map: &BTreeMap<String, String>) {
    put_sized(buf, |b| {
        for (k, v) in map {
            put_str(b, k);
            put_str(b, v);
        }
    });
}

pub(crate) fn header(buf: &mut Vec<u8>, profile: &str, library: &str) {
    put(buf, op::HEADER, |b| {
        put_str(b, profile);
        put_str(b, library);
    });
}

/// A message type: its name and its definition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SchemaRecord {
    pub(crate) id: u16,
    pub(crate) name: String,
    /// The language of the definition.
    pub(crate) encoding: String,
    pub(crate) data: Vec<u8>,
}

pub(crate) fn schema(buf: &mut Vec<u8>, s: &SchemaRecord) {
    put(buf, op::SCHEMA, |b| {
        put_le!(b, s.id);
        put_str(b, &s.name);
        put_str(b, &s.encoding);
        put_bytes(b, &s.data);
    });
}

/// A channel of CDR messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Channel {
    pub(crate) id: u16,
    pub(crate) schema: u16,
    pub(crate) topic: String,
    pub(crate) metadata: BTreeMap<String, String>,
}

pub(crate) fn channel(buf: &mut Vec<u8>, c: &Channel) {
    put(buf, op::CHANNEL, |b| {
        put_le!(b, c.id, c.schema);
        put_str(b, &c.topic);
        put_str(b, "cdr");
        put_map(b, &c.metadata);
    });
}

/// Entries (log time, offset in the uncompressed chunk) of one channel in one chunk.
pub(crate) fn message_index(buf: &mut Vec<u8>, channel: u16, entries: &[(u64, u64)]) {
    put(buf, op::MESSAGE_INDEX, |b| {
        put_le!(b, channel);
        put_sized(b, |b| {
            for (time, offset) in entries {
                put_le!(b, time, offset);
            }
        });
    });
}

/// A chunk's entry in the summary.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct ChunkIndex {
    pub(crate) start_time: u64,
    pub(crate) end_time: u64,
    /// Where the chunk record begins, and its length with opcode and length.
    pub(crate) offset: u64,
    pub(crate) length: u64,
    /// Where each channel's message index record begins, and the length of them all.
    pub(crate) message_indexes: Vec<(u16, u64)>,
    pub(crate) message_index_length: u64,
    pub(crate) compression: &'static str,
    pub(crate) compressed_size: u64,
    pub(crate) uncompressed_size: u64,
}

pub(crate) fn chunk_index(buf: &mut Vec<u8>, c: &ChunkIndex) {
    put(buf, op::CHUNK_INDEX, |b| {
        put_le!(b, c.start_time, c.end_time, c.offset, c.length);
        put_sized(b, |b| {
            for (channel, offset) in &c.message_indexes {
                put_le!(b, channel, offset);
            }
        });
        put_le!(b, c.message_index_length);
        put_str(b, c.compression);
        put_le!(b, c.compressed_size, c.uncompressed_size);
    });
}

/// An attachment; its CRC covers the fields before it.
pub(crate) fn attachment(buf: &mut Vec<u8>, time: u64, name: &str, media_type: &str, data: &[u8]) {
    put(buf, op::ATTACHMENT, |b| {
        let start = b.len();
        put_le!(b, time, time);
        put_str(b, name);
        put_str(b, media_type);
        put_le!(b, data.len() as u64);
        b.extend_from_slice(data);
        let crc = crc32fast::hash(&b[start..]);
        put_le!(b, crc);
    });
}

/// An attachment's entry in the summary.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct AttachmentIndex {
    pub(crate) offset: u64,
    pub(crate) length: u64,
    pub(crate) time: u64,
    pub(crate) size: u64,
    pub(crate) name: String,
    pub(crate) media_type: String,
}

pub(crate) fn attachment_index(buf: &mut Vec<u8>, a: &AttachmentIndex) {
    put(buf, op::ATTACHMENT_INDEX, |b| {
        put_le!(b, a.offset, a.length, a.time, a.time, a.size);
        put_str(b, &a.name);
        put_str(b, &a.media_type);
    });
}

pub(crate) fn metadata(buf: &mut Vec<u8>, name: &str, map: &BTreeMap<String, String>) {
    put(buf, op::METADATA, |b| {
        put_str(b, name);
        put_map(b, map);
    });
}

pub(crate) fn metadata_index(buf: &mut Vec<u8>, offset: u64, length: u64, name: &str) {
    put(buf, op::METADATA_INDEX, |b| {
        put_le!(b, offset, length);
        put_str(b, name);
    });
}

/// Counts over a whole file.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub(crate) struct Statistics {
    pub(crate) schemas: u16,
    pub(crate) channels: u32,
    pub(crate) attachments: u32,
    pub(crate) metadata: u32,
    pub(crate) chunks: u32,
    /// First and last log time.
    pub(crate) times: Option<(u64, u64)>,
    /// Messages per channel.
    pub(crate) messages: BTreeMap<u16, u64>,
}

pub(crate) fn statistics(buf: &mut Vec<u8>, s: &Statistics) {
    put(buf, op::STATISTICS, |b| {
        let (start, end) = s.times.unwrap_or_default();
        put_le!(b, s.messages.values().sum::<u64>(), s.schemas, s.channels, s.attachments);
        put_le!(b, s.metadata, s.chunks, start, end);
        put_sized(b, |b| {
            for (channel, n) in &s.messages {
                put_le!(b, channel, n);
            }
        });
    });
}

pub(crate) fn summary_offset(buf: &mut Vec<u8>, group: u8, start: u64, length: u64) {
    put(buf, op::SUMMARY_OFFSET, |b| {
        b.push(group);
        put_le!(b, start, length);
    });
}

pub(crate) fn data_end(buf: &mut Vec<u8>, crc: u32) {
    put(buf, op::DATA_END, |b| put_le!(b, crc));
}
