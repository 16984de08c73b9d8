//! One pass over a segment's records, carrying along what spans segments.

use super::{Findings, Severity, VerifyOptions, file_name};
use crate::container::record::op;
use crate::container::scan::{ChunkEntry, Message, SegmentReader};
use crate::dataset::{Kind, check_stored, kinds};
use crate::encode::Codec;
use crate::fs::Fs;
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::schemas::Schema;
use crate::msgs::{accounts, frame_info};
use crate::recorder::topics::SESSION_METADATA;
use crate::{Error, ErrorKind, Result, Session, StreamAccount};
use depthrig_bus::StreamId;
use mcap::records::Record;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// What is carried from segment to segment.
pub(super) struct Walk {
    options: VerifyOptions,
    streams: BTreeSet<String>,
    pub(super) sets: u64,
    pub(super) frames: u64,
    pub(super) bytes: u64,
    last: Option<Last>,
    /// Sets counted by the accounts minus those seen, fixed at the first account of a lone segment.
    account_base: Option<u64>,
    dropped: Option<crate::SetCounts>,
    accounts: BTreeMap<StreamId, StreamAccount>,
}

/// The set before.
struct Last {
    id: u64,
    log_time: u64,
    tick_ns: i64,
}

/// What one segment's pass collects.
struct Pass<'a> {
    file: String,
    kinds: BTreeMap<u16, Kind>,
    camera_infos: BTreeMap<u16, StreamId>,
    accounts_channel: Option<u16>,
    findings: &'a mut Findings,
    /// Messages since the last commit mark.
    pictures: BTreeMap<StreamId, Picture>,
    infos: BTreeMap<StreamId, (u64, Vec<u8>)>,
    calibrated: BTreeSet<StreamId>,
    messages: u64,
}

struct Picture {
    offset: u64,
    log_time: u64,
    len: u64,
    crc: u32,
    /// Kept only when it will be decoded.
    message: Vec<u8>,
}

impl Walk {
    pub(super) fn new(session: &Session, options: VerifyOptions) -> Self {
        Self {
            options,
            streams: session.streams.iter().map(|s| s.id.to_string()).collect(),
            sets: 0,
            frames: 0,
            bytes: 0,
            last: None,
            account_base: None,
            dropped: None,
            accounts: BTreeMap::new(),
        }
    }

    pub(super) fn segment(&mut self, fs: &dyn Fs, path: &Path, findings: &mut Findings) {
        let file = file_name(path);
        if let Err(e) = self.read(fs, path, &file, findings) {
            findings.add(Severity::Broken, &file, None, e.to_string());
        }
    }

    fn read(&mut self, fs: &dyn Fs, path: &Path, file: &str, findings: &mut Findings) -> Result<()> {
        let mut reader = SegmentReader::open_bare(fs, path)?;
        self.bytes += reader.size;
        let index = reader.load_index();
        if let Err(e) = &index {
            findings.add(Severity::Broken, file, None, e.to_string());
        } else if reader.metadata(SESSION_METADATA).is_none() {
            findings.add(Severity::Broken, file, None, "it does not stand alone: the session is not in it");
        }
        if index.is_ok() && !reader.finished {
            let (offset, why) = reader.cut.clone().unwrap_or_default();
            let what = format!("unfinished: {why}; its whole sets can still be read");
            findings.add(Severity::Broken, file, Some(offset), what);
        }
        let find = |schema: Schema| {
            reader.channels.iter().filter(move |(_, c)| c.schema == schema.name()).map(|(id, c)| (*id, c))
        };
        let mut pass = Pass {
            file: file.to_owned(),
            kinds: kinds(&reader),
            camera_infos: find(Schema::CameraInfo)
                .filter_map(|(id, c)| Some((id, c.metadata.get("stream")?.parse().ok()?)))
                .collect(),
            accounts_channel: find(Schema::Accounts).map(|(id, _)| id).next(),
            findings,
            pictures: BTreeMap::new(),
            infos: BTreeMap::new(),
            calibrated: BTreeSet::new(),
            messages: 0,
        };
        let chunks = self.records(&reader, &mut pass)?;
        if !pass.pictures.is_empty() {
            let n = pass.pictures.len();
            let at = pass.pictures.values().map(|p| p.offset).min();
            let what = format!("a torn set: {n} pictures have no commit mark after them");
            pass.findings.add(Severity::Broken, file, at, what);
        }
        if index.is_ok() && reader.finished {
            if reader.chunks != chunks {
                let differs = reader.chunks.iter().zip(&chunks).find(|(a, b)| a != b);
                let at = differs.map(|(a, _)| a.offset);
                let (said, there) = (reader.chunks.len(), chunks.len());
                let what = format!("the index ({said} chunks) is not that of the data ({there} chunks)");
                pass.findings.add(Severity::Broken, file, at, what);
            }
            if reader.message_count != Some(pass.messages) {
                let what =
                    format!("{} messages, the statistics say {:?}", pass.messages, reader.message_count);
                pass.findings.add(Severity::Broken, file, None, what);
            }
        }
        Ok(())
    }

    /// Every record from the first to the end of the data; the chunks as they lie there.
    fn records(&mut self, reader: &SegmentReader, pass: &mut Pass<'_>) -> Result<Vec<ChunkEntry>> {
        let mut crc = crc32fast::Hasher::new();
        crc.update(&super::super::container::MAGIC);
        let mut chunks: Vec<ChunkEntry> = Vec::new();
        // Channel, time and offset of each message of the last chunk that no index record has named yet.
        let mut unlisted: BTreeSet<(u16, u64, u64)> = BTreeSet::new();
        let mut offset = 8;
        while offset < reader.size {
            let head = reader.read(offset, 9);
            let record = head.and_then(|head| Ok((head, reader.record(offset)?)));
            let (head, (opcode, body)) = match record {
                Ok(r) => r,
                // Said already: the file is unfinished and cut here.
                Err(e) if e.kind() == ErrorKind::Truncated && !reader.finished => return Ok(chunks),
                Err(e) => return Err(e),
            };
            if opcode != op::MESSAGE_INDEX && !unlisted.is_empty() {
                let what = format!("{} messages of the chunk before are in no message index", unlisted.len());
                pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
                unlisted.clear();
            }
            match opcode {
                op::DATA_END => {
                    if let Record::DataEnd(end) = reader.parse(opcode, &body, offset)? {
                        let crc = crc.finalize();
                        if end.data_section_crc != 0 && end.data_section_crc != crc {
                            let saved = end.data_section_crc;
                            let what = format!("the data's checksum is {crc:08x}, the file says {saved:08x}");
                            pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
                        }
                    }
                    return Ok(chunks);
                }
                op::CHUNK => chunks.push(self.chunk(reader, pass, offset, &body, &mut unlisted)?),
                op::MESSAGE_INDEX => {
                    let Record::MessageIndex(index) = reader.parse(opcode, &body, offset)? else { continue };
                    if let Some(chunk) = chunks.last_mut() {
                        chunk.channels.push(index.channel_id);
                    }
                    for e in index.records {
                        if !unlisted.remove(&(index.channel_id, e.log_time, e.offset)) {
                            let what =
                                format!("a message index points to nothing (channel {})", index.channel_id);
                            pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
                        }
                    }
                }
                _ => {
                    reader.parse(opcode, &body, offset)?;
                }
            }
            crc.update(&head);
            crc.update(&body);
            offset += 9 + body.len() as u64;
        }
        if reader.finished {
            pass.findings.add(Severity::Broken, &pass.file, None, "the data has no end record");
        }
        Ok(chunks)
    }

    fn chunk(
        &mut self,
        reader: &SegmentReader,
        pass: &mut Pass<'_>,
        offset: u64,
        body: &[u8],
        unlisted: &mut BTreeSet<(u16, u64, u64)>,
    ) -> Result<ChunkEntry> {
        let Record::Chunk { header, .. } = reader.parse(op::CHUNK, body, offset)? else {
            return Err(reader.error(ErrorKind::Corrupt, offset, "this is no chunk"));
        };
        let entry = ChunkEntry {
            offset,
            length: 9 + body.len() as u64,
            start_time: header.message_start_time,
            end_time: header.message_end_time,
            channels: Vec::new(),
        };
        let read = reader.chunk_messages(body, offset, |m| {
            pass.messages += 1;
            unlisted.insert((m.channel, m.log_time, m.offset));
            if m.log_time < header.message_start_time || m.log_time > header.message_end_time {
                let what = "a message lies outside of the times of its chunk";
                pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
            }
            if let Err(e) = self.message(pass, &m, offset) {
                pass.findings.add(Severity::Broken, &pass.file, Some(offset), e.to_string());
            }
            Ok(())
        });
        if let Err(e) = read {
            // The next chunk may be whole.
            unlisted.clear();
            pass.findings.add(Severity::Broken, &pass.file, Some(offset), e.to_string());
        }
        Ok(entry)
    }

    fn message(&mut self, pass: &mut Pass<'_>, m: &Message<'_>, offset: u64) -> Result<()> {
        if pass.accounts_channel == Some(m.channel) {
            return self.account(pass, m.data, offset);
        }
        if let Some(id) = pass.camera_infos.get(&m.channel) {
            pass.calibrated.insert(id.clone());
            return Ok(());
        }
        match pass.kinds.get(&m.channel) {
            Some(Kind::Picture(id)) => {
                let picture = Picture {
                    offset,
                    log_time: m.log_time,
                    len: m.data.len() as u64,
                    crc: crc32fast::hash(m.data),
                    message: if self.options.decode { m.data.to_vec() } else { Vec::new() },
                };
                pass.pictures.insert(id.clone(), picture);
            }
            Some(Kind::Info(id)) => {
                pass.infos.insert(id.clone(), (m.log_time, m.data.to_vec()));
            }
            Some(Kind::Set) => {
                let set = FrameSetMsg::read(m.data)?;
                for problem in self.set(pass, &set, m.log_time) {
                    let what = format!("set {}: {problem}", set.id);
                    pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
                }
                if let Some(max) = self.options.max_spread_ns.filter(|max| set.spread_ns > *max) {
                    let what = format!(
                        "set {}: its frames are {} ns apart, {max} is the limit",
                        set.id, set.spread_ns
                    );
                    pass.findings.add(Severity::Lost, &pass.file, Some(offset), what);
                }
                (pass.pictures, pass.infos, pass.calibrated) = Default::default();
            }
            None => {}
        }
        Ok(())
    }

    /// What is wrong with a set.
    fn set(&mut self, pass: &Pass<'_>, set: &FrameSetMsg, log_time: u64) -> Vec<String> {
        let mut problems = Vec::new();
        if let Some(last) = &self.last {
            if set.id <= last.id {
                problems.push(format!("it follows set {}", last.id));
            }
            if log_time <= last.log_time {
                problems.push("its log time is not later than that of the set before".to_owned());
            }
            if set.tick_ns <= last.tick_ns {
                problems.push("its tick is not later than that of the set before".to_owned());
            }
        }
        self.last = Some(Last { id: set.id, log_time, tick_ns: set.tick_ns });
        let mut named: BTreeSet<&str> = set.missing.iter().map(String::as_str).collect();
        let mut captures = Vec::new();
        for member in &set.members {
            let name = &member.stream;
            if !named.insert(name) {
                problems.push(format!("{name} is in it twice"));
            }
            captures.push(member.capture_time_ns);
            let Ok(id) = name.parse::<StreamId>() else {
                problems.push(format!("\"{name}\" is no stream"));
                continue;
            };
            if !pass.calibrated.contains(&id) {
                problems.push(format!("{name} has no camera_info"));
            }
            let info = pass.infos.get(&id).filter(|(t, _)| *t == log_time);
            let header = info.map(|(_, bytes)| frame_info::read(bytes));
            match &header {
                None => problems.push(format!("{name} has no frame_info")),
                Some(Err(e)) => problems.push(format!("{name}: {e}")),
                Some(Ok((h, _))) => {
                    let same = h.sequence == member.sequence
                        && h.capture_time_ns == member.capture_time_ns
                        && h.set_id == set.id;
                    if !same {
                        problems.push(format!("{name}: its frame_info is that of another frame"));
                    }
                }
            }
            let Some(picture) = pass.pictures.get(&id).filter(|p| p.log_time == log_time) else {
                problems.push(format!("{name} has no picture"));
                continue;
            };
            if picture.crc != member.message_crc32 || picture.len != member.message_bytes {
                problems.push(format!("{name}: its picture is another one"));
            } else if let (true, Some(Ok((h, extra)))) = (self.options.decode, &header) {
                let codec = Codec::from_name(extra.codec)
                    .ok_or_else(|| Error::new(ErrorKind::Version, format!("unknown codec {}", extra.codec)));
                if let Err(e) = codec.and_then(|codec| check_stored(&picture.message, codec, h)) {
                    problems.push(e.to_string());
                }
            }
        }
        let spread =
            captures.iter().max().zip(captures.iter().min()).map_or(0, |(a, b)| a.saturating_sub(*b));
        if spread != set.spread_ns {
            problems.push(format!("its frames are {spread} ns apart, it says {}", set.spread_ns));
        }
        for stream in &self.streams {
            if !named.contains(stream.as_str()) {
                problems.push(format!("{stream} is neither in it nor marked missing"));
            }
        }
        if let Some(stranger) = named.iter().find(|n| !self.streams.contains(**n)) {
            problems.push(format!("{stranger} is not in the session"));
        }
        self.sets += 1;
        self.frames += set.members.len() as u64;
        problems
    }

    fn account(&mut self, pass: &mut Pass<'_>, message: &[u8], offset: u64) -> Result<()> {
        let (sets, streams) = accounts::read(message)?;
        let mut broken = |what: String| pass.findings.add(Severity::Broken, &pass.file, Some(offset), what);
        if !sets.balances() {
            broken(format!(
                "the account of sets does not balance: {} offered, {} recorded, {} dropped",
                sets.offered,
                sets.recorded,
                sets.dropped_total()
            ));
        }
        // A segment on its own begins in the middle of the account.
        let first_is_zero = self.last.as_ref().is_none_or(|_| pass.file.starts_with("seg_0000."));
        let base = *self
            .account_base
            .get_or_insert_with(|| if first_is_zero { 0 } else { sets.recorded.saturating_sub(self.sets) });
        let there = base.saturating_add(self.sets);
        if sets.recorded != there {
            broken(format!("the account says {} sets were recorded, {there} are there", sets.recorded));
        }
        self.dropped = Some(sets);
        for a in streams {
            if !a.balances() {
                broken(format!(
                    "the account of {} does not balance: {} captured, {} delivered, {} dropped",
                    a.stream,
                    a.captured,
                    a.delivered,
                    a.dropped.total()
                ));
            }
            if self
                .accounts
                .get(&a.stream)
                .is_some_and(|b| a.captured < b.captured || a.delivered < b.delivered)
            {
                broken(format!("the account of {} goes backwards", a.stream));
            }
            self.accounts.insert(a.stream.clone(), a);
        }
        Ok(())
    }

    /// The whole against what the session says of it.
    pub(super) fn finish(&self, whole: Option<&Session>, findings: &mut Findings) {
        for (reason, n) in self.dropped.iter().flat_map(crate::SetCounts::dropped_by_reason) {
            let what = format!("{n} sets were not recorded: {}", reason.name());
            findings.add(Severity::Lost, "accounts", None, what);
        }
        for a in self.accounts.values().filter(|a| a.dropped.total() > 0) {
            let reasons: Vec<_> = a.dropped.nonzero().map(|(r, n)| format!("{n} {}", r.name())).collect();
            let what = format!(
                "{} of {} frames of {} were lost live: {}",
                a.dropped.total(),
                a.captured,
                a.stream,
                reasons.join(", ")
            );
            findings.add(Severity::Note, "accounts", None, what);
        }
        let Some(session) = whole else { return };
        let file = crate::SESSION_FILE;
        match &session.outcome {
            None => {
                findings.add(
                    Severity::Broken,
                    file,
                    None,
                    "the recording was not closed: no outcome is there",
                );
            }
            Some(o) => {
                if o.sets_recorded != self.sets {
                    let what =
                        format!("it says {} sets were recorded, {} are there", o.sets_recorded, self.sets);
                    findings.add(Severity::Broken, file, None, what);
                }
                for lost in &o.lost {
                    findings.add(Severity::Lost, file, None, lost.clone());
                }
            }
        }
    }
}
