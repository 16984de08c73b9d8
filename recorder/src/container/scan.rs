//! Reading a segment: its index from the summary, or by walking the records of a file without a summary.

use super::MAGIC;
use super::record::op;
use crate::fs::{Fs, ReadFile};
use crate::{Error, ErrorKind, Result};
use mcap::records::Record;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Longest record, packed or unpacked: an image of [`crate::IMAGE_MAX_BYTES`] and what stands around it. A longer one is a
/// damaged length, or made to fill the memory: a gigabyte of zeros is packed into some kilobytes.
pub(crate) const RECORD_MAX: u64 = crate::IMAGE_MAX_BYTES + (1 << 20);
/// Opcode and length.
pub(crate) const HEAD: u64 = 9;
/// Footer record and magic.
const FOOTER: u64 = HEAD + 20 + 8;

/// Where a chunk lies and what is in it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ChunkEntry {
    pub(crate) offset: u64,
    pub(crate) length: u64,
    pub(crate) start_time: u64,
    pub(crate) end_time: u64,
    pub(crate) channels: Vec<u16>,
    /// Whether it is compressed.
    pub(crate) is_packed: bool,
}

/// A channel: its topic, its type and its metadata.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct ChannelInfo {
    pub(crate) topic: String,
    pub(crate) schema: String,
    pub(crate) metadata: BTreeMap<String, String>,
}

/// One message of a chunk.
pub(crate) struct Message<'a> {
    pub(crate) channel: u16,
    pub(crate) sequence: u32,
    pub(crate) log_time: u64,
    pub(crate) publish_time: u64,
    /// Where its record begins in the unpacked chunk.
    pub(crate) offset: u64,
    pub(crate) data: &'a [u8],
}

/// An opened segment.
pub(crate) struct SegmentReader {
    file: Box<dyn ReadFile>,
    pub(crate) path: PathBuf,
    pub(crate) size: u64,
    /// In the order of the file.
    pub(crate) chunks: Vec<ChunkEntry>,
    pub(crate) channels: BTreeMap<u16, ChannelInfo>,
    pub(crate) metadata: Vec<(String, BTreeMap<String, String>)>,
    /// Whether the file has its summary and footer.
    pub(crate) finished: bool,
    /// Why the walk ended before the end of the data, and where.
    pub(crate) cut: Option<(u64, String)>,
    /// Messages in the file, as its statistics say.
    pub(crate) message_count: Option<u64>,
}

/// Bytes of an attachment's fields before its data: two times, name and media type, length.
fn attachment_head(body: &[u8]) -> Option<usize> {
    let text = |at: usize| {
        let len = body.get(at..)?.first_chunk::<4>()?;
        at.checked_add(4)?.checked_add(u32::from_le_bytes(*len) as usize)
    };
    text(text(16)?)?.checked_add(8)
}

/// Records collected by a walk, before schemas and channels are put together.
#[derive(Default)]
struct Collected {
    chunks: Vec<ChunkEntry>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, (u16, String, BTreeMap<String, String>)>,
    metadata: Vec<(String, BTreeMap<String, String>)>,
    metadata_offsets: Vec<u64>,
    message_count: Option<u64>,
}

impl SegmentReader {
    /// Opens a segment. A file that was cut is opened as far as it goes, see [`SegmentReader::cut`].
    pub(crate) fn open(fs: &dyn Fs, path: &Path) -> Result<Self> {
        let mut reader = Self::open_bare(fs, path)?;
        reader.load_index()?;
        Ok(reader)
    }

    /// Opens a segment without its index.
    pub(crate) fn open_bare(fs: &dyn Fs, path: &Path) -> Result<Self> {
        let reader = Self::open_any(fs, path)?;
        let mut magic = [0; 8];
        if reader.size >= 8 {
            reader.file.read_exact_at(&mut magic, 0).map_err(|e| Error::reading("read", path, e))?;
        }
        if magic != MAGIC {
            return Err(Error::new(
                ErrorKind::NotADataset,
                format!("{} is not an MCAP file: it does not begin with the MCAP magic", path.display()),
            ));
        }
        Ok(reader)
    }

    /// Opens a file of which even the beginning may be damaged.
    pub(crate) fn open_any(fs: &dyn Fs, path: &Path) -> Result<Self> {
        let file = fs.open(path).map_err(|e| Error::reading("open", path, e))?;
        let size = file.size().map_err(|e| Error::reading("open", path, e))?;
        Ok(Self {
            file,
            path: path.to_owned(),
            size,
            chunks: Vec::new(),
            channels: BTreeMap::new(),
            metadata: Vec::new(),
            finished: false,
            cut: None,
            message_count: None,
        })
    }

    /// Reads the index.
    pub(crate) fn load_index(&mut self) -> Result<()> {
        let collected = match self.summary()? {
            Some(collected) => {
                self.finished = true;
                collected
            }
            None => self.walk()?,
        };
        self.chunks = collected.chunks;
        self.chunks.sort_by_key(|c| c.offset);
        self.metadata = collected.metadata;
        self.message_count = collected.message_count;
        for (id, (schema, topic, metadata)) in collected.channels {
            let schema = collected.schemas.get(&schema).cloned().unwrap_or_default();
            self.channels.insert(id, ChannelInfo { topic, schema, metadata });
        }
        for offset in collected.metadata_offsets {
            let (opcode, body) = self.record(offset)?;
            if let Record::Metadata(m) = self.parse(opcode, &body, offset)? {
                self.metadata.push((m.name, m.metadata));
            }
        }
        Ok(())
    }

    /// The metadata record of this name.
    pub(crate) fn metadata(&self, name: &str) -> Option<&BTreeMap<String, String>> {
        self.metadata.iter().find(|(n, _)| n == name).map(|(_, m)| m)
    }

    /// An error about this file at `offset`.
    pub(crate) fn error(&self, kind: ErrorKind, offset: u64, what: impl core::fmt::Display) -> Error {
        Error::new(kind, format!("{} at byte {offset}: {what}", self.path.display()))
    }

    /// Reads bytes of the file.
    pub(crate) fn read(&self, offset: u64, len: u64) -> Result<Vec<u8>> {
        if offset.checked_add(len).is_none_or(|end| end > self.size) || len > RECORD_MAX {
            return Err(self.error(
                ErrorKind::Truncated,
                offset,
                format_args!("{len} bytes are wanted, the file ends at byte {}", self.size),
            ));
        }
        let mut bytes = vec![0; len as usize];
        self.file.read_exact_at(&mut bytes, offset).map_err(|e| Error::reading("read", &self.path, e))?;
        Ok(bytes)
    }

    /// Fills `buf` with bytes of the file, and uses its memory again.
    pub(crate) fn read_into(&self, buf: &mut Vec<u8>, offset: u64, len: u64) -> Result<()> {
        buf.resize(len as usize, 0);
        self.file.read_exact_at(buf, offset).map_err(|e| Error::reading("read", &self.path, e))
    }

    /// Fills `buf` with the bytes of the file from `offset`.
    pub(crate) fn read_at(&self, buf: &mut [u8], offset: u64) -> Result<()> {
        self.file.read_exact_at(buf, offset).map_err(|e| Error::reading("read", &self.path, e))
    }

    /// Opcode and length of the record at `offset`.
    pub(crate) fn record_head(&self, offset: u64) -> Result<(u8, u64)> {
        let head = self.read(offset, HEAD)?;
        let mut len = [0; 8];
        len.copy_from_slice(&head[1..]);
        Ok((head[0], u64::from_le_bytes(len)))
    }

    /// Opcode and fields of the record at `offset`.
    pub(crate) fn record(&self, offset: u64) -> Result<(u8, Vec<u8>)> {
        let (opcode, len) = self.record_head(offset)?;
        Ok((opcode, self.read(offset + HEAD, len)?))
    }

    /// The fields of a record, taken apart.
    pub(crate) fn parse<'a>(&self, opcode: u8, body: &'a [u8], offset: u64) -> Result<Record<'a>> {
        // The crate cuts the CRC off an attachment without looking whether there is one.
        if opcode == op::ATTACHMENT && attachment_head(body).is_none_or(|n| n + 4 > body.len()) {
            return Err(self.error(ErrorKind::Corrupt, offset, "an attachment is too short"));
        }
        mcap::parse_record(opcode, body)
            .map_err(|e| self.error(ErrorKind::Corrupt, offset, "a damaged record").with_source(e))
    }

    /// Calls `f` with each message of a chunk after checking its CRC.
    pub(crate) fn messages(
        &self,
        entry: &ChunkEntry,
        f: impl FnMut(Message<'_>) -> Result<()>,
    ) -> Result<()> {
        let (opcode, body) = self.record(entry.offset)?;
        if opcode != op::CHUNK {
            return Err(self.error(ErrorKind::Corrupt, entry.offset, "the index points to no chunk"));
        }
        self.chunk_messages(&body, entry.offset, f)
    }

    /// The same for a chunk whose record was read from `offset`.
    pub(crate) fn chunk_messages(
        &self,
        body: &[u8],
        offset: u64,
        mut f: impl FnMut(Message<'_>) -> Result<()>,
    ) -> Result<()> {
        let corrupt = |what: String| self.error(ErrorKind::Corrupt, offset, what);
        let Record::Chunk { header, data } = self.parse(op::CHUNK, body, offset)? else {
            return Err(corrupt("this is not a chunk".to_owned()));
        };
        if header.uncompressed_size > RECORD_MAX {
            return Err(corrupt(format!("a chunk of {} bytes is too large", header.uncompressed_size)));
        }
        let records: Cow<'_, [u8]> = match header.compression.as_str() {
            "" => data,
            "zstd" => zstd::bulk::decompress(&data, header.uncompressed_size as usize)
                .map_err(|e| corrupt(format!("a chunk cannot be unpacked: {e}")))?
                .into(),
            other => {
                return Err(corrupt(format!("a chunk is packed with {other}, which depthrig never uses")));
            }
        };
        if records.len() as u64 != header.uncompressed_size {
            return Err(corrupt(format!(
                "a chunk unpacks to {} bytes, its header says {}",
                records.len(),
                header.uncompressed_size
            )));
        }
        let crc = crc32fast::hash(&records);
        if header.uncompressed_crc != 0 && crc != header.uncompressed_crc {
            let saved = header.uncompressed_crc;
            return Err(corrupt(format!("a chunk's checksum is {crc:08x}, its header says {saved:08x}")));
        }
        let mut at = 0;
        while at < records.len() {
            let cut = || corrupt("a chunk ends in the middle of a record".to_owned());
            let (head, rest) = records[at..].split_at_checked(HEAD as usize).ok_or_else(cut)?;
            let mut len = [0; 8];
            len.copy_from_slice(&head[1..]);
            let len = usize::try_from(u64::from_le_bytes(len)).unwrap_or(usize::MAX);
            let body = rest.get(..len).ok_or_else(cut)?;
            if head[0] == op::MESSAGE {
                let Record::Message { header, data } = self.parse(head[0], body, offset)? else {
                    return Err(cut());
                };
                f(Message {
                    channel: header.channel_id,
                    sequence: header.sequence,
                    log_time: header.log_time,
                    publish_time: header.publish_time,
                    offset: at as u64,
                    data: &data,
                })?;
            }
            at += HEAD as usize + len;
        }
        Ok(())
    }

    /// The index from the summary; `None` when the file has no footer.
    fn summary(&self) -> Result<Option<Collected>> {
        let Some(at) = self.size.checked_sub(FOOTER).filter(|at| *at >= 8) else { return Ok(None) };
        let tail = self.read(at, FOOTER)?;
        if tail[0] != op::FOOTER || tail[tail.len() - 8..] != MAGIC {
            return Ok(None);
        }
        let Record::Footer(footer) = self.parse(op::FOOTER, &tail[HEAD as usize..tail.len() - 8], at)? else {
            return Ok(None);
        };
        let start = footer.summary_start;
        if start < 8 || start > at {
            return Err(self.error(ErrorKind::Corrupt, at, "the footer points outside of the file"));
        }
        let summary = self.read(start, at - start)?;
        // The CRC covers the summary and the footer up to the CRC itself.
        let mut crc = crc32fast::Hasher::new();
        crc.update(&summary);
        crc.update(&tail[..HEAD as usize + 16]);
        if footer.summary_crc != 0 && crc.finalize() != footer.summary_crc {
            return Err(self.error(
                ErrorKind::Corrupt,
                start,
                "the summary's checksum does not agree with it",
            ));
        }
        let mut c = Collected::default();
        let mut offset = start;
        let mut rest = summary.as_slice();
        while !rest.is_empty() {
            let cut = || self.error(ErrorKind::Corrupt, offset, "the summary ends in the middle of a record");
            let (head, after) = rest.split_at_checked(HEAD as usize).ok_or_else(cut)?;
            let len = head[1..].iter().rev().fold(0, |v, b| v << 8 | u64::from(*b));
            let len = usize::try_from(len).unwrap_or(usize::MAX);
            let (body, next) = after.split_at_checked(len).ok_or_else(cut)?;
            match self.parse(head[0], body, offset)? {
                Record::ChunkIndex(i) => c.chunks.push(ChunkEntry {
                    offset: i.chunk_start_offset,
                    length: i.chunk_length,
                    start_time: i.message_start_time,
                    end_time: i.message_end_time,
                    channels: i.message_index_offsets.keys().copied().collect(),
                    is_packed: !i.compression.is_empty(),
                }),
                Record::Statistics(s) => c.message_count = Some(s.message_count),
                Record::MetadataIndex(i) => c.metadata_offsets.push(i.offset),
                other => c.definition(other),
            }
            offset += HEAD + body.len() as u64;
            rest = next;
        }
        Ok(Some(c))
    }

    /// The index from the records themselves, as far as they are complete.
    fn walk(&mut self) -> Result<Collected> {
        let mut c = Collected::default();
        let mut offset = 8;
        while offset < self.size {
            let step = self.walk_record(&mut c, offset);
            match step {
                Ok(Some(next)) => offset = next,
                Ok(None) => break,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => {
                    self.cut = Some((offset, e.to_string()));
                    break;
                }
            }
        }
        if self.cut.is_none() {
            self.cut = Some((offset, "the data ends without a summary".to_owned()));
        }
        Ok(c)
    }

    /// Takes one record into `c`; the offset of the next one, or `None` at the end of the data.
    fn walk_record(&self, c: &mut Collected, offset: u64) -> Result<Option<u64>> {
        let (opcode, len) = self.record_head(offset)?;
        let next = offset.checked_add(HEAD).and_then(|o| o.checked_add(len)).filter(|n| *n <= self.size);
        let Some(next) = next else {
            let what = format!("a record of {len} bytes is cut off by the end of the file");
            return Err(self.error(ErrorKind::Truncated, offset, what));
        };
        match opcode {
            op::DATA_END => return Ok(None),
            op::CHUNK => {
                // Two times, a size and a checksum, and the length of the compression's name.
                let times = self.read(offset + HEAD, 32)?;
                let time = |i: usize| times[i..i + 8].iter().rev().fold(0, |v, b| v << 8 | u64::from(*b));
                c.chunks.push(ChunkEntry {
                    offset,
                    length: next - offset,
                    start_time: time(0),
                    end_time: time(8),
                    channels: Vec::new(),
                    is_packed: times[28..] != [0; 4],
                });
            }
            op::MESSAGE_INDEX => {
                let id = self.read(offset + HEAD, 2)?;
                if let Some(chunk) = c.chunks.last_mut() {
                    chunk.channels.push(u16::from_le_bytes([id[0], id[1]]));
                }
            }
            op::SCHEMA | op::CHANNEL | op::METADATA => {
                let body = self.read(offset + HEAD, len)?;
                c.definition(self.parse(opcode, &body, offset)?);
            }
            0 => return Err(self.error(ErrorKind::Corrupt, offset, "no record has opcode 0")),
            _ => {}
        }
        Ok(Some(next))
    }
}

impl Collected {
    fn definition(&mut self, record: Record<'_>) {
        match record {
            Record::Schema { header, .. } => {
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(c) => {
                self.channels.insert(c.id, (c.schema_id, c.topic, c.metadata));
            }
            Record::Metadata(m) => self.metadata.push((m.name, m.metadata)),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fs::MemFs;
    use proptest::prelude::*;

    /// The lengths at which name, media type and data meet the end of the record.
    #[test]
    fn short_attachments_are_refused() {
        let fs = MemFs::new();
        fs.put(Path::new("f"), MAGIC.to_vec());
        let reader = SegmentReader::open_bare(&fs, Path::new("f")).unwrap();
        for name in 0u32..6 {
            let mut body = vec![0; 16];
            body.extend(name.to_le_bytes());
            body.extend(vec![b'a'; name as usize]);
            body.extend([0; 12]);
            for len in 0..body.len() + 4 {
                let mut cut = body.clone();
                cut.resize(len, 0);
                let e = reader.parse(op::ATTACHMENT, &cut, 8).unwrap_err();
                assert_eq!(e.kind(), ErrorKind::Corrupt);
            }
            body.extend([0; 4]);
            assert!(reader.parse(op::ATTACHMENT, &body, 8).is_ok());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        /// Small numbers make lengths that nearly fit, where a parser goes wrong.
        #[test]
        fn no_record_makes_the_parser_panic(
            opcode in 0u8..0x12,
            body in proptest::collection::vec(prop_oneof![3 => 0u8..6, 1 => any::<u8>()], 0..90),
        ) {
            let fs = MemFs::new();
            fs.put(Path::new("f"), MAGIC.to_vec());
            let reader = SegmentReader::open_bare(&fs, Path::new("f")).unwrap();
            let _ = reader.parse(opcode, &body, 8);
            let _ = reader.chunk_messages(&body, 8, |_| Ok(()));
        }

        #[test]
        fn no_file_makes_the_reader_panic(
            records in proptest::collection::vec(
                (0u8..0x12, proptest::collection::vec(0u8..6, 0..60), 0u64..3), 0..8),
            tail in proptest::collection::vec(any::<u8>(), 0..12),
        ) {
            let mut bytes = MAGIC.to_vec();
            for (opcode, body, lie) in records {
                bytes.push(opcode);
                bytes.extend((body.len() as u64 + lie / 2).to_le_bytes());
                bytes.extend(body);
            }
            bytes.extend(tail);
            let fs = MemFs::new();
            fs.put(Path::new("f"), bytes.clone());
            if let Ok(reader) = SegmentReader::open(&fs, Path::new("f")) {
                for entry in &reader.chunks {
                    let _ = reader.messages(entry, |_| Ok(()));
                }
            }
            bytes.extend(MAGIC);
            fs.put(Path::new("f"), bytes);
            let _ = SegmentReader::open(&fs, Path::new("f"));
        }
    }
}
