//! One pass over a segment's records.
//!
//! The bytes are proven by the checksum over the data of a finished segment, or the last good checkpoint of an
//! unfinished one. Chunks with an image that lie in proven bytes are not unpacked: their message index says
//! which image they are, and from their set's mark follows what the checksum in their head must be. Bytes that
//! nothing proves, and every image when it is to be decoded, are unpacked by workers, see `images`.

use super::images::{Images, with_workers};
use super::index::Contents;
use super::records::Records;
use super::seen::{Image, MESSAGE_HEAD, Proof, Seen};
use super::sets::Walk;
use super::{Findings, Severity, Watch, file_name};
use super::{motion, signals};
use crate::container::record::op;
use crate::container::scan::{ChannelInfo, HEAD, Message, SegmentReader};
use crate::dataset::{Kind, kind_of};
use crate::frame::Waiting;
use crate::fs::Fs;
use crate::msgs::frame_set::{Checkpoint, FrameSetMsg, read_clock_pair};
use crate::msgs::schemas::Schema;
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA};
use crate::recovered::{RECOVERED_METADATA, sets_lost};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::StreamId;
use mcap::records::Record;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// State of the pass over one segment.
pub(super) struct Pass<'a> {
    seen: Seen<'a>,
    schemas: BTreeMap<u16, String>,
    kinds: BTreeMap<u16, Kind>,
    camera_infos: BTreeMap<u16, StreamId>,
    accounts_channel: Option<u16>,
    clock: Option<u16>,
    checkpoints: Option<u16>,
    contents: Contents,
    stands_alone: bool,
    /// Channel, time and offset of each message of the last chunk that no index record has named yet.
    unlisted: BTreeSet<(u16, u64, u64)>,
    /// Of the bytes before the present record.
    crc: crc32fast::Hasher,
    /// The bytes before this are proven.
    proven: u64,
}

/// Verifies a segment and takes its sets into `walk`.
pub(super) fn segment(
    walk: &mut Walk,
    fs: &dyn Fs,
    path: &Path,
    findings: &mut Findings,
    watch: &mut Watch<'_>,
) {
    if let Err(e) = try_segment(walk, fs, path, findings, watch) {
        findings.add(Severity::Broken, &file_name(path), None, e.to_string());
    }
}

/// The same, where a file that cannot be read is an error: damage alone is a finding.
pub(super) fn try_segment(
    walk: &mut Walk,
    fs: &dyn Fs,
    path: &Path,
    findings: &mut Findings,
    watch: &mut Watch<'_>,
) -> Result<()> {
    match read(walk, fs, path, findings, watch) {
        Err(e) if e.is_damage() => findings.add(Severity::Broken, &file_name(path), None, e.to_string()),
        done => return done,
    }
    Ok(())
}

fn read(
    walk: &mut Walk,
    fs: &dyn Fs,
    path: &Path,
    findings: &mut Findings,
    watch: &mut Watch<'_>,
) -> Result<()> {
    let file = file_name(path);
    let mut reader = SegmentReader::open_bare(fs, path)?;
    walk.bytes += reader.size;
    let index = reader.load_index();
    match &index {
        Err(e) if !e.is_damage() => return index,
        Err(e) => findings.add(Severity::Broken, &file, None, e.to_string()),
        Ok(()) if !reader.finished => {
            let (offset, why) = reader.cut.clone().unwrap_or_default();
            let what = format!("unfinished: {why}; its whole sets can still be read");
            findings.add(Severity::Broken, &file, Some(offset), what);
        }
        Ok(()) => {}
    }
    let finished = reader.finished && index.is_ok();
    // One record for each time it was recovered.
    for (_, said) in reader.metadata.iter().filter(|(name, _)| name == RECOVERED_METADATA) {
        walk.lost = walk.lost.saturating_add(sets_lost(said));
    }
    // With decoding every image is unpacked anyway. Without, a first pass shows what the checksums prove; where
    // they do not prove all, a second one takes its place.
    let mut unproven = if walk.options.decode { 0 } else { u64::MAX };
    let before = walk.clone();
    let watched = watch.done;
    loop {
        let mut found = Findings::default();
        let threads = if unproven == u64::MAX { 0 } else { walk.options.threads() };
        let (result, damaged) = with_workers(&reader, threads, |images| {
            let mut pass = Pass::new(&file, &mut found, unproven);
            // Another writer may have put them into chunks; those at the head of the data are taken as they come.
            reader.channels.iter().for_each(|(id, info)| pass.channel(*id, info));
            let result = pass.run(walk, &reader, finished, images, watch);
            result.map(|()| pass.proven)
        });
        let proven = *result.as_ref().unwrap_or(&0);
        if unproven == u64::MAX && proven < reader.size && !watch.stopped {
            *walk = before.clone();
            watch.done = watched;
            unproven = proven;
            continue;
        }
        findings.append(found);
        for image in damaged {
            findings.add(Severity::Broken, &file, Some(image.offset), image.message);
        }
        return result.map(drop);
    }
}

impl<'a> Pass<'a> {
    fn new(file: &str, findings: &'a mut Findings, unproven: u64) -> Self {
        Self {
            seen: Seen::new(file, findings, unproven),
            schemas: BTreeMap::new(),
            kinds: BTreeMap::new(),
            camera_infos: BTreeMap::new(),
            accounts_channel: None,
            clock: None,
            checkpoints: None,
            contents: Contents::default(),
            stands_alone: false,
            unlisted: BTreeSet::new(),
            crc: crc32fast::Hasher::new(),
            proven: 0,
        }
    }

    fn run(
        &mut self,
        walk: &mut Walk,
        reader: &SegmentReader,
        finished: bool,
        images: &mut Images<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<()> {
        let ended = self.data(walk, reader, images, watch);
        if watch.stopped {
            return Ok(());
        }
        if !self.stands_alone {
            self.seen.broken(None, "it does not stand alone: the session is not in it");
        }
        let channels = walk.units.channels(&self.kinds.values());
        for what in channels.into_iter().chain(walk.signals.channels(&self.kinds.values())) {
            self.seen.broken(None, what);
        }
        if !self.seen.images.is_empty() {
            let n = self.seen.images.len();
            let at = self.seen.images.values().map(|p| p.offset).min();
            self.seen.broken(at, format!("a torn set: {n} images have no commit mark after them"));
        }
        match ended {
            Ok(Some(summary)) => self.summary(reader, summary, finished),
            Ok(None) if finished => {
                self.seen.broken(None, "the data has no end record");
                Ok(())
            }
            // A finding already: the file is unfinished and cut here.
            Ok(None) => Ok(()),
            Err(e) if e.kind() == ErrorKind::Truncated && !reader.finished => Ok(()),
            Err(e) => Err(e),
        }
    }

    /// Every record up to the end of the data; where the summary begins.
    fn data(
        &mut self,
        walk: &mut Walk,
        reader: &SegmentReader,
        images: &mut Images<'_>,
        watch: &mut Watch<'_>,
    ) -> Result<Option<u64>> {
        self.crc.update(&crate::container::MAGIC);
        let mut records = Records::new(reader, 8);
        loop {
            let offset = records.offset;
            let Some(raw) = records.record()? else { return Ok(None) };
            let length = raw.whole.len() as u64;
            if raw.opcode != op::MESSAGE_INDEX && !self.unlisted.is_empty() {
                let what =
                    format!("{} messages of the chunk before are in no message index", self.unlisted.len());
                self.seen.broken(Some(offset), what);
                self.unlisted.clear();
            }
            match raw.opcode {
                op::DATA_END => {
                    if let Record::DataEnd(end) = reader.parse(raw.opcode, raw.body(), offset)? {
                        let crc = self.crc.clone().finalize();
                        let saved = end.data_section_crc;
                        if saved == crc {
                            self.proven = reader.size;
                        } else if saved != 0 {
                            let what = format!("the data's checksum is {crc:08x}, the file says {saved:08x}");
                            self.seen.broken(Some(offset), what);
                        }
                    }
                    return Ok(Some(offset + length));
                }
                op::CHUNK => self.chunk(walk, reader, images, offset, &raw)?,
                op::MESSAGE_INDEX => {
                    if let Record::MessageIndex(index) = reader.parse(raw.opcode, raw.body(), offset)? {
                        self.contents.message_index(index.channel_id, offset, length);
                        for e in index.records {
                            if !self.unlisted.remove(&(index.channel_id, e.log_time, e.offset)) {
                                let channel = index.channel_id;
                                let what = format!("a message index points to nothing (channel {channel})");
                                self.seen.broken(Some(offset), what);
                            }
                        }
                    }
                }
                _ => {
                    let record = reader.parse(raw.opcode, raw.body(), offset)?;
                    self.definition(record, raw.opcode, raw.whole, offset);
                }
            }
            self.crc.update(raw.whole);
            records.advance(length as usize);
            if watch.advance(length) {
                return Ok(None);
            }
        }
    }

    /// Takes what describes the messages.
    fn definition(&mut self, record: Record<'_>, opcode: u8, whole: &[u8], offset: u64) {
        match record {
            Record::Schema { header, .. } => {
                self.contents.definition(opcode, header.id, whole);
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(c) => {
                self.contents.definition(opcode, c.id, whole);
                let schema = self.schemas.get(&c.schema_id).cloned().unwrap_or_default();
                let info = ChannelInfo { topic: c.topic, schema, metadata: c.metadata };
                self.channel(c.id, &info);
            }
            Record::Attachment { .. } => self.contents.other(opcode, offset, whole.len() as u64),
            Record::Metadata(m) => {
                self.contents.other(opcode, offset, whole.len() as u64);
                self.stands_alone |= m.name == SESSION_METADATA;
                if let Some(error) = m.metadata.get("error").filter(|_| m.name == SEGMENT_METADATA) {
                    let what = format!("the recording ended before its time: {error}");
                    self.seen.findings.add(Severity::Lost, &self.seen.file, Some(offset), what);
                }
                if let Some(lost) = m.metadata.get("lost").filter(|_| m.name == RECOVERED_METADATA) {
                    for what in lost.lines() {
                        self.seen.findings.add(Severity::Lost, &self.seen.file, Some(offset), what);
                    }
                }
            }
            _ => {}
        }
    }

    fn channel(&mut self, id: u16, info: &ChannelInfo) {
        let is = |s: Schema| info.schema == s.name();
        if is(Schema::CameraInfo)
            && let Some(stream) = info.metadata.get("stream").and_then(|s| s.parse().ok())
        {
            self.camera_infos.insert(id, stream);
        } else if is(Schema::Accounts) {
            self.accounts_channel = Some(id);
        } else if is(Schema::ClockPair) {
            self.clock = Some(id);
        } else if is(Schema::Checkpoint) {
            self.checkpoints = Some(id);
        } else if let Some(kind) = kind_of(info) {
            self.kinds.insert(id, kind);
        }
    }

    fn chunk(
        &mut self,
        walk: &mut Walk,
        reader: &SegmentReader,
        images: &mut Images<'_>,
        offset: u64,
        raw: &super::records::Raw<'_>,
    ) -> Result<()> {
        let Record::Chunk { header, .. } = reader.parse(op::CHUNK, raw.body(), offset)? else {
            return Err(reader.error(ErrorKind::Corrupt, offset, "this is not a chunk"));
        };
        self.contents.chunk(offset, raw.whole.len() as u64, &header);
        if let Some((id, image)) = self.lone_image(&header, offset, raw.after) {
            self.contents.message(image.channel);
            self.unlisted.insert((image.channel, image.log_time, 0));
            self.seen.images.insert(id, image);
            return Ok(());
        }
        let read = reader.chunk_messages(raw.body(), offset, |m| {
            self.contents.message(m.channel);
            self.unlisted.insert((m.channel, m.log_time, m.offset));
            if m.log_time < header.message_start_time || m.log_time > header.message_end_time {
                self.seen.broken(Some(offset), "a message lies outside of the times of its chunk");
            }
            if let Err(e) = self.message(walk, images, &m, offset) {
                self.seen.broken(Some(offset), e.to_string());
            }
            Ok(())
        });
        if let Err(e) = read {
            // The next chunk may be intact.
            self.unlisted.clear();
            self.seen.broken(Some(offset), e.to_string());
        }
        Ok(())
    }

    /// The image that a packed chunk holds, by its message index alone; `None` if that does not identify it.
    fn lone_image(
        &self,
        header: &mcap::records::ChunkHeader,
        offset: u64,
        after: &[u8],
    ) -> Option<(StreamId, Image)> {
        let (index, next) = after.split_at_checked(HEAD as usize + 22)?;
        let number =
            |at: usize, n: usize| index[at..at + n].iter().rev().fold(0, |v, b| v << 8 | u64::from(*b));
        let one = index[0] == op::MESSAGE_INDEX && number(1, 8) == 22 && number(11, 4) == 16;
        let channel = number(9, 2) as u16;
        let log_time = number(15, 8);
        let times = (header.message_start_time, header.message_end_time);
        if !one
            || next.first() == Some(&op::MESSAGE_INDEX)
            || number(23, 8) != 0
            || times != (log_time, log_time)
        {
            return None;
        }
        // An unpacked image is checked on the spot: that costs no more than its checksum.
        let len =
            header.uncompressed_size.checked_sub(MESSAGE_HEAD).filter(|_| header.compression == "zstd")?;
        let Some(Kind::Image(id)) = self.kinds.get(&channel) else { return None };
        let proof = Proof::Packed(header.uncompressed_crc);
        Some((id.clone(), Image { offset, channel, log_time, len, proof }))
    }

    fn message(
        &mut self,
        walk: &mut Walk,
        images: &mut Images<'_>,
        m: &Message<'_>,
        offset: u64,
    ) -> Result<()> {
        if self.accounts_channel == Some(m.channel) {
            return walk.account(&mut self.seen, m.data, offset);
        }
        if self.clock == Some(m.channel) {
            walk.clock(&mut self.seen, read_clock_pair(m.data)?, m.log_time, offset);
            return Ok(());
        }
        if self.checkpoints == Some(m.channel) {
            return self.checkpoint(Checkpoint::read(m.data)?, offset);
        }
        if let Some(id) = self.camera_infos.get(&m.channel) {
            self.seen.calibrated.insert(id.clone());
            return Ok(());
        }
        let kind = self.kinds.get(&m.channel);
        if let Some(Err(what)) = kind.map(|kind| kind.count(&mut self.seen.waiting, m.data.len())) {
            (self.seen.waiting, self.seen.motion, self.seen.signals) = Default::default();
            return Err(Error::new(ErrorKind::Corrupt, what));
        }
        match kind {
            Some(kind) if self.seen.motion.take(kind, m, walk.compares_singles)? => {}
            Some(kind) if self.seen.signals.take(kind, m) => {}
            Some(Kind::Image(id)) => {
                let len = m.data.len() as u64;
                let proof = Proof::Crc(crc32fast::hash(m.data));
                let image = Image { offset, channel: m.channel, log_time: m.log_time, len, proof };
                self.seen.images.insert(id.clone(), image);
            }
            Some(Kind::Info(id)) => {
                self.seen.infos.insert(id.clone(), (m.log_time, m.data.to_vec()));
            }
            Some(Kind::Set) => {
                let set = FrameSetMsg::read(m.data)?;
                walk.set(&mut self.seen, &set, m.log_time, offset, images);
                motion::set(walk, &mut self.seen, &set, m.log_time, offset);
                signals::set(walk, &mut self.seen, &set, m.log_time, offset);
                self.seen.waiting = Waiting::default();
                (self.seen.images, self.seen.infos, self.seen.calibrated) = Default::default();
            }
            Some(_) | None => {}
        }
        Ok(())
    }

    /// A checkpoint in the chunk at `offset` proves all that lies before that chunk.
    fn checkpoint(&mut self, c: Checkpoint, offset: u64) -> Result<()> {
        // In a copy of the segment it describes another file, and proves nothing about this one.
        if c.file_bytes != offset {
            return Ok(());
        }
        let crc = self.crc.clone().finalize();
        if c.crc32 == crc {
            self.proven = self.proven.max(offset);
            return Ok(());
        }
        let what = format!("the bytes before have checksum {crc:08x}, the checkpoint says {:08x}", c.crc32);
        Err(Error::new(ErrorKind::Corrupt, what))
    }

    /// The summary against the data.
    fn summary(&mut self, reader: &SegmentReader, offset: u64, finished: bool) -> Result<()> {
        if !finished {
            return Ok(());
        }
        let mut records = Records::new(reader, offset);
        loop {
            let offset = records.offset;
            let Some(raw) = records.record()? else {
                self.seen.broken(None, "the summary has no footer");
                return Ok(());
            };
            let record = reader.parse(raw.opcode, raw.body(), offset)?;
            if let Some(mismatch) = self.contents.summary(&record, raw.whole)? {
                self.seen.broken(mismatch.offset, mismatch.message);
            }
            if raw.opcode == op::FOOTER {
                break;
            }
            let length = raw.whole.len();
            records.advance(length);
        }
        for mismatch in self.contents.compare() {
            self.seen.broken(mismatch.offset, mismatch.message);
        }
        Ok(())
    }
}
