//! Compares the summary of a segment, which readers of the index rely on, with its data.

use crate::container::record::op;
use crate::{ErrorKind, Result};
use mcap::records::{ChunkIndex, Record, Statistics};
use std::collections::BTreeMap;

/// The contents of the data, to compare with the summary.
#[derive(Default)]
pub(super) struct Contents {
    /// By offset, as an index would describe them.
    chunks: BTreeMap<u64, ChunkIndex>,
    /// Of the last chunk: where its message indexes begin.
    indexes_from: u64,
    /// Attachments and metadata: opcode and length by offset.
    others: BTreeMap<u64, (u8, u64)>,
    /// CRC-32 of the schemas and channels, by opcode and id.
    definitions: BTreeMap<(u8, u16), u32>,
    /// Messages per channel.
    messages: BTreeMap<u16, u64>,
    summary: Summary,
}

/// The contents of the summary so far.
#[derive(Default)]
struct Summary {
    chunks: usize,
    others: usize,
    repeated: BTreeMap<(u8, u16), u32>,
    statistics: Option<Statistics>,
}

/// A difference between summary and data.
pub(super) struct Mismatch {
    /// Where it is, if in one place.
    pub(super) offset: Option<u64>,
    pub(super) message: String,
}

impl Contents {
    pub(super) fn chunk(&mut self, offset: u64, length: u64, header: &mcap::records::ChunkHeader) {
        let entry = ChunkIndex {
            message_start_time: header.message_start_time,
            message_end_time: header.message_end_time,
            chunk_start_offset: offset,
            chunk_length: length,
            message_index_offsets: BTreeMap::new(),
            message_index_length: 0,
            compression: header.compression.clone(),
            compressed_size: header.compressed_size,
            uncompressed_size: header.uncompressed_size,
        };
        self.chunks.insert(offset, entry);
        self.indexes_from = offset + length;
    }

    pub(super) fn message_index(&mut self, channel: u16, offset: u64, length: u64) {
        let from = self.indexes_from;
        if let Some((_, chunk)) = self.chunks.iter_mut().next_back() {
            chunk.message_index_offsets.insert(channel, offset);
            chunk.message_index_length = offset + length - from;
        }
    }

    pub(super) fn message(&mut self, channel: u16) {
        *self.messages.entry(channel).or_default() += 1;
    }

    pub(super) fn other(&mut self, opcode: u8, offset: u64, length: u64) {
        self.others.insert(offset, (opcode, length));
    }

    pub(super) fn definition(&mut self, opcode: u8, id: u16, record: &[u8]) {
        self.definitions.insert((opcode, id), crc32fast::hash(record));
    }

    /// Takes a record of the summary.
    ///
    /// # Errors
    /// [`ErrorKind::Corrupt`] for a record that has no place there.
    pub(super) fn summary(&mut self, record: &Record<'_>, whole: &[u8]) -> Result<Option<Mismatch>> {
        let index = |offset, kind: &str, same: bool| {
            (!same).then(|| Mismatch {
                offset: Some(offset),
                message: format!("the index of {kind} is not what is at this place"),
            })
        };
        let mismatch = match record {
            Record::ChunkIndex(i) => {
                self.summary.chunks += 1;
                let same = self.chunks.get(&i.chunk_start_offset) == Some(i);
                index(i.chunk_start_offset, "a chunk", same)
            }
            Record::AttachmentIndex(i) => {
                self.summary.others += 1;
                let same = self.others.get(&i.offset) == Some(&(op::ATTACHMENT, i.length));
                index(i.offset, "an attachment", same)
            }
            Record::MetadataIndex(i) => {
                self.summary.others += 1;
                let same = self.others.get(&i.offset) == Some(&(op::METADATA, i.length));
                index(i.offset, "metadata", same)
            }
            Record::Statistics(s) => {
                self.summary.statistics = Some(s.clone());
                None
            }
            Record::Schema { header, .. } => {
                self.summary.repeated.insert((op::SCHEMA, header.id), crc32fast::hash(whole));
                None
            }
            Record::Channel(c) => {
                self.summary.repeated.insert((op::CHANNEL, c.id), crc32fast::hash(whole));
                None
            }
            Record::Footer(_) | Record::SummaryOffset(_) | Record::Unknown { .. } => None,
            _ => return Err(crate::Error::new(ErrorKind::Corrupt, "a record has no place in the summary")),
        };
        Ok(mismatch)
    }

    /// The records that the summary lacks, once all of it was taken.
    pub(super) fn compare(&self) -> Vec<Mismatch> {
        let mut mismatches = Vec::new();
        let mut say = |message: String| mismatches.push(Mismatch { offset: None, message });
        let said = self.summary.chunks;
        let there = self.chunks.len();
        if said != there {
            say(format!("the index ({said} chunks) is not that of the data ({there} chunks)"));
        }
        if self.summary.others != self.others.len() {
            let said = self.summary.others;
            let there = self.others.len();
            say(format!("{there} attachments and metadata records, the index says {said}"));
        }
        for (key, crc) in &self.definitions {
            if self.summary.repeated.get(key) != Some(crc) {
                let kind = if key.0 == op::SCHEMA { "schema" } else { "channel" };
                say(format!("{kind} {} of the data is not that of the summary", key.1));
            }
        }
        let messages: u64 = self.messages.values().sum();
        let Some(s) = &self.summary.statistics else {
            say(format!("{messages} messages, and no statistics of them"));
            return mismatches;
        };
        if s.message_count != messages || s.channel_message_counts.iter().any(|(c, n)| self.count(*c) != *n) {
            say(format!("{messages} messages, the statistics say {:?}", s.message_count));
        }
        let all = |opcode| self.others.values().filter(|o| o.0 == opcode).count() as u32;
        // Other writers put schemas and channels into chunks; what the summary repeats are all of them.
        let defined = |opcode| self.summary.repeated.keys().filter(|k| k.0 == opcode).count();
        let counts = [s.chunk_count, s.attachment_count, s.metadata_count, s.channel_count];
        let there = [there as u32, all(op::ATTACHMENT), all(op::METADATA), defined(op::CHANNEL) as u32];
        if counts != there || usize::from(s.schema_count) != defined(op::SCHEMA) {
            say(format!(
                "chunks, attachments, metadata and channels are {there:?}, the statistics say {counts:?}"
            ));
        }
        let first = self.chunks.values().map(|c| c.message_start_time).min().unwrap_or(0);
        let last = self.chunks.values().map(|c| c.message_end_time).max().unwrap_or(0);
        if messages > 0 && (s.message_start_time, s.message_end_time) != (first, last) {
            say(format!("its messages are from {first} to {last}, the statistics say otherwise"));
        }
        mismatches
    }

    fn count(&self, channel: u16) -> u64 {
        self.messages.get(&channel).copied().unwrap_or(0)
    }
}
