//! One segment file: `seg_0003.mcap.part` while it grows, `seg_0003.mcap` once it is complete and durable.
//!
//! Invariant: the index lists exactly the chunks before `len`. A group of chunks is listed after all of it was
//! written; when a write fails, the file is cut back to `len`, and index and data agree again.

use super::MAGIC;
use super::chunk::Chunk;
use super::record::{self, AttachmentIndex, Channel, ChunkIndex, SchemaRecord, Statistics, op};
use crate::fs::{self, Fs, WriteFile};
use crate::{Error, Result};
use crossbeam::channel::{Receiver, TryRecvError, bounded};
use depthrig_bus::HostTime;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The MCAP profile of every segment.
pub(crate) const PROFILE: &str = "ros2";

pub(crate) fn file_name(index: u32) -> String {
    format!("seg_{index:04}.mcap")
}

/// Records at the head of each segment, which make it readable on its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Preamble {
    pub(crate) schemas: Vec<SchemaRecord>,
    pub(crate) channels: Vec<Channel>,
    pub(crate) metadata: Vec<(String, BTreeMap<String, String>)>,
    /// Time, name, media type and bytes.
    pub(crate) attachments: Vec<(u64, String, String, Vec<u8>)>,
}

/// Makes the names in the folder of `path` durable.
pub(crate) fn sync_folder_of(fs: &dyn Fs, path: &Path) -> Result<()> {
    let dir = path.parent().unwrap_or(Path::new("."));
    fs.sync_dir(dir).map_err(|e| Error::io("sync the folder", dir, e))
}

pub(crate) struct Segment {
    file: Box<dyn WriteFile>,
    part: PathBuf,
    path: PathBuf,
    len: u64,
    crc: crc32fast::Hasher,
    /// Schema and channel records, repeated in the summary.
    schemas: Vec<u8>,
    channels: Vec<u8>,
    chunks: Vec<ChunkIndex>,
    attachments: Vec<AttachmentIndex>,
    metadata: Vec<(u64, u64, String)>,
    stats: Statistics,
    /// Bytes beyond `len` may lie in the file.
    torn: bool,
    /// A sync failed. What it was for may never reach the disk, and a later sync that succeeds says nothing of
    /// it (<https://wiki.postgresql.org/wiki/Fsync_Errors>): such a file must not pass for a durable one.
    doubtful: bool,
    /// A sync on a thread of its own.
    syncing: Option<Syncing>,
}

/// A sync that is going on: when it began, and where its result comes.
struct Syncing {
    since: HostTime,
    result: Receiver<std::io::Result<()>>,
}

impl Segment {
    /// Creates `seg_<index>.mcap.part` with everything that comes before the first chunk.
    pub(crate) fn create(fs: &dyn Fs, dir: &Path, index: u32, preamble: &Preamble) -> Result<Self> {
        let path = dir.join(file_name(index));
        Self::create_as(fs, &path.with_extension("mcap.part"), path, preamble)
    }

    /// The same under the name `part`, to be finished as `path` in the same folder.
    pub(crate) fn create_as(fs: &dyn Fs, part: &Path, path: PathBuf, preamble: &Preamble) -> Result<Self> {
        let file = fs.create_new(part).map_err(|e| Error::io("create", part, e))?;
        let created = Self::begin(fs, file, part.to_owned(), path, preamble);
        if created.is_err() {
            // A file without a head is not a segment, and would be in the way of one.
            let _ = fs.remove_file(part);
        }
        created
    }

    fn begin(
        fs: &dyn Fs,
        file: Box<dyn WriteFile>,
        part: PathBuf,
        path: PathBuf,
        preamble: &Preamble,
    ) -> Result<Self> {
        let mut segment = Self {
            file,
            part,
            path,
            len: 0,
            crc: crc32fast::Hasher::new(),
            schemas: Vec::new(),
            channels: Vec::new(),
            chunks: Vec::new(),
            attachments: Vec::new(),
            metadata: Vec::new(),
            stats: Statistics::default(),
            torn: false,
            doubtful: false,
            syncing: None,
        };
        for s in &preamble.schemas {
            record::schema(&mut segment.schemas, s);
        }
        for c in &preamble.channels {
            record::channel(&mut segment.channels, c);
        }
        segment.stats.schemas = preamble.schemas.len() as u16;
        segment.stats.channels = preamble.channels.len() as u32;
        let mut head = MAGIC.to_vec();
        record::header(&mut head, PROFILE, concat!("depthrig ", env!("CARGO_PKG_VERSION")));
        head.extend_from_slice(&segment.schemas);
        head.extend_from_slice(&segment.channels);
        for (name, map) in &preamble.metadata {
            let at = head.len() as u64;
            record::metadata(&mut head, name, map);
            segment.metadata.push((at, head.len() as u64 - at, name.clone()));
        }
        for (time, name, media_type, data) in &preamble.attachments {
            let at = head.len() as u64;
            record::attachment(&mut head, *time, name, media_type, data);
            segment.attachments.push(AttachmentIndex {
                offset: at,
                length: head.len() as u64 - at,
                time: *time,
                size: data.len() as u64,
                name: name.clone(),
                media_type: media_type.clone(),
            });
        }
        segment.stats.metadata = segment.metadata.len() as u32;
        segment.stats.attachments = segment.attachments.len() as u32;
        segment.append(&[([&head, &[]], crc32fast::hash(&head))])?;
        sync_folder_of(fs, &segment.part)?;
        Ok(segment)
    }

    /// Bytes of the file so far.
    pub(crate) const fn len(&self) -> u64 {
        self.len
    }

    /// Bytes of the file so far and their CRC-32.
    pub(crate) fn checkpoint(&self) -> (u64, u32) {
        (self.len, self.crc.clone().finalize())
    }

    /// The file's present name.
    pub(crate) fn part(&self) -> &Path {
        &self.part
    }

    /// Log time of the first and the last message.
    pub(crate) const fn times(&self) -> Option<(u64, u64)> {
        self.stats.times
    }

    /// Appends chunks with their message indexes: all of them, or none.
    ///
    /// # Errors
    /// As the file system says; the file is then as before the call if it could be cut back.
    pub(crate) fn append_chunks(&mut self, chunks: &[Chunk]) -> Result<()> {
        let mut at = self.len;
        let mut entries = Vec::with_capacity(chunks.len());
        let mut indexes = Vec::with_capacity(chunks.len());
        for chunk in chunks {
            let mut per_channel: BTreeMap<u16, Vec<(u64, u64)>> = BTreeMap::new();
            for (channel, time, offset) in &chunk.messages {
                per_channel.entry(*channel).or_default().push((*time, *offset));
            }
            let length = chunk.len();
            let mut index = Vec::new();
            let mut offsets = Vec::with_capacity(per_channel.len());
            for (channel, times) in &per_channel {
                offsets.push((*channel, at + length + index.len() as u64));
                record::message_index(&mut index, *channel, times);
            }
            entries.push(ChunkIndex {
                start_time: chunk.start_time,
                end_time: chunk.end_time,
                offset: at,
                length,
                message_indexes: offsets,
                message_index_length: index.len() as u64,
                compression: chunk.compression,
                compressed_size: chunk.compressed_size,
                uncompressed_size: chunk.uncompressed_size,
            });
            at += length + index.len() as u64;
            indexes.push(index);
        }
        let mut records: Vec<([&[u8]; 2], u32)> = Vec::with_capacity(2 * chunks.len());
        for (chunk, index) in chunks.iter().zip(&indexes) {
            records.push((chunk.parts(), chunk.crc));
            records.push(([index, &[]], crc32fast::hash(index)));
        }
        self.append(&records)?;
        self.chunks.extend(entries);
        for chunk in chunks {
            self.stats.chunks += 1;
            for (channel, time, _) in &chunk.messages {
                *self.stats.messages.entry(*channel).or_default() += 1;
                let (first, last) = self.stats.times.unwrap_or((*time, *time));
                self.stats.times = Some((first.min(*time), last.max(*time)));
            }
        }
        Ok(())
    }

    /// Bytes of the message indexes that follow `chunk`.
    pub(crate) fn index_len(chunk: &Chunk) -> u64 {
        let mut channels: Vec<u16> = chunk.messages.iter().map(|m| m.0).collect();
        channels.sort_unstable();
        channels.dedup();
        (15 * channels.len() + 16 * chunk.messages.len()) as u64
    }

    /// Appends metadata.
    pub(crate) fn append_metadata(&mut self, name: &str, map: &BTreeMap<String, String>) -> Result<()> {
        let mut bytes = Vec::new();
        record::metadata(&mut bytes, name, map);
        let at = self.len;
        self.append(&[([&bytes, &[]], crc32fast::hash(&bytes))])?;
        self.metadata.push((at, bytes.len() as u64, name.to_owned()));
        self.stats.metadata += 1;
        Ok(())
    }

    /// Makes what was appended durable.
    pub(crate) fn sync(&mut self) -> Result<()> {
        let done = self.file.sync_data();
        self.synced(done)
    }

    /// Begins to make what was appended durable on a thread of its own, so that a slow disk does not keep what comes next
    /// from being written. While one such sync goes on, no other begins; whether one has begun.
    ///
    /// # Errors
    /// As the file system says, also of a sync that began earlier.
    pub(crate) fn begin_sync(&mut self) -> Result<bool> {
        match self.syncing.as_ref().map(|s| s.result.try_recv()) {
            Some(Err(TryRecvError::Empty)) => return Ok(false),
            Some(ended) => {
                self.syncing = None;
                self.synced(ended.unwrap_or_else(|_| Err(std::io::Error::other("its thread died"))))?;
            }
            None => {}
        }
        let (sender, result) = bounded(1);
        let begun = self.file.sync_beside().and_then(|sync| {
            // The receiver may be gone with the segment.
            let run = move || drop(sender.send(sync()));
            std::thread::Builder::new().name("rec-sync".into()).spawn(run).ok()
        });
        match begun {
            Some(_) => self.syncing = Some(Syncing { since: HostTime::now(), result }),
            None => self.sync()?,
        }
        Ok(true)
    }

    /// Since when a sync goes on, if one does.
    pub(crate) fn syncing_since(&self) -> Option<HostTime> {
        let syncing = self.syncing.as_ref()?;
        syncing.result.is_empty().then_some(syncing.since)
    }

    fn synced(&mut self, done: std::io::Result<()>) -> Result<()> {
        done.map_err(|e| {
            self.doubtful = true;
            Error::io("sync", &self.part, e)
        })
    }

    /// Writes index and footer, makes the file durable and gives it its final name.
    pub(crate) fn finish(mut self, fs: &dyn Fs) -> Result<PathBuf> {
        self.write_index()?;
        self.publish(fs)
    }

    /// Makes a file that has its index durable and gives it its final name.
    pub(crate) fn publish(self, fs: &dyn Fs) -> Result<PathBuf> {
        let path = self.path.clone();
        let part = self.durable()?;
        fs.rename(&part, &path).map_err(|e| Error::io("rename", &part, e))?;
        sync_folder_of(fs, &path)?;
        Ok(path)
    }

    /// Writes index and footer and makes the file durable under the name that it has.
    pub(crate) fn seal(mut self) -> Result<PathBuf> {
        self.write_index()?;
        self.durable()
    }

    /// Writes index and footer: all of it, or nothing when the disk is full, so that it can be tried again.
    pub(crate) fn write_index(&mut self) -> Result<()> {
        let tail = self.tail();
        self.append(&[([&tail, &[]], 0)])
    }

    fn durable(mut self) -> Result<PathBuf> {
        if let Some(syncing) = self.syncing.take() {
            let ended = syncing.result.recv();
            self.synced(ended.unwrap_or_else(|_| Err(std::io::Error::other("its thread died"))))?;
        }
        self.file.sync_all().map_err(|e| Error::io("sync", &self.part, e))?;
        if self.doubtful {
            return Err(Error::new(
                crate::ErrorKind::Io,
                format!("{} may not be completely on the disk: a sync of it failed", self.part.display()),
            ));
        }
        Ok(self.part)
    }

    /// Everything after the data: `DataEnd`, summary, summary offsets, footer, magic.
    fn tail(&self) -> Vec<u8> {
        let mut b = Vec::new();
        record::data_end(&mut b, self.crc.clone().finalize());
        let summary = b.len();
        let base = self.len;
        let mut groups: Vec<(u8, usize, usize)> = Vec::new();
        let mut group = |b: &mut Vec<u8>, opcode: u8, fill: &dyn Fn(&mut Vec<u8>)| {
            let start = b.len();
            fill(b);
            if b.len() > start {
                groups.push((opcode, start, b.len() - start));
            }
        };
        group(&mut b, op::SCHEMA, &|b| b.extend_from_slice(&self.schemas));
        group(&mut b, op::CHANNEL, &|b| b.extend_from_slice(&self.channels));
        group(&mut b, op::STATISTICS, &|b| record::statistics(b, &self.stats));
        group(&mut b, op::CHUNK_INDEX, &|b| self.chunks.iter().for_each(|c| record::chunk_index(b, c)));
        group(&mut b, op::ATTACHMENT_INDEX, &|b| {
            self.attachments.iter().for_each(|a| record::attachment_index(b, a));
        });
        group(&mut b, op::METADATA_INDEX, &|b| {
            self.metadata.iter().for_each(|(at, len, name)| record::metadata_index(b, *at, *len, name));
        });
        let offsets = b.len();
        for (opcode, start, len) in groups {
            record::summary_offset(&mut b, opcode, base + start as u64, len as u64);
        }
        // The CRC of the summary covers the footer up to the CRC itself.
        b.push(op::FOOTER);
        record::put_le!(b, 20u64, base + summary as u64, base + offsets as u64);
        let crc = crc32fast::hash(&b[summary..]);
        record::put_le!(b, crc);
        b.extend_from_slice(&MAGIC);
        b
    }

    /// Appends records, in up to two pieces each, with their CRCs: all or, after cutting back, none.
    fn append(&mut self, records: &[([&[u8]; 2], u32)]) -> Result<()> {
        if self.torn {
            // An earlier cut failed; nothing may follow a torn record.
            let cut = self.file.truncate(self.len);
            cut.map_err(|e| Error::io("cut back", &self.part, e))?;
            self.torn = false;
        }
        let mut len = self.len;
        let mut crc = self.crc.clone();
        for (pieces, record_crc) in records {
            if let Err(e) = pieces.iter().try_for_each(|bytes| fs::write_all(&mut *self.file, bytes)) {
                self.torn = self.file.truncate(self.len).is_err();
                return Err(Error::io("write", &self.part, e));
            }
            let bytes = pieces.iter().map(|p| p.len() as u64).sum();
            len += bytes;
            crc.combine(&crc32fast::Hasher::new_with_initial_len(*record_crc, bytes));
        }
        (self.len, self.crc) = (len, crc);
        Ok(())
    }
}
