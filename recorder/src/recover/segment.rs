//! One segment: whether it is complete, and if not, a verified copy of its complete sets.

use super::TEMPORARY;
use super::dry::{DryFs, Same};
use super::facts::Facts;
use super::head::{Head, HeadSearch, own_head};
use super::lost::Lost;
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::container::copy::{BetweenGroup, Damage, DamageKind, Group, Groups, SetGroup};
use crate::container::scan::SegmentReader;
use crate::container::segment::{Preamble, Segment};
use crate::dataset::segment_number;
use crate::fs::Fs;
use crate::msgs::frame_set::Checkpoint;
use crate::msgs::schemas::Schema;
use crate::msgs::{accounts, tf};
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA};
use crate::recovered::RECOVERED_METADATA;
use crate::verify::Finding;
use crate::{Error, ErrorKind, Result, Session};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Bytes compared at a time.
pub(super) const WINDOW: u64 = 1 << 20;
/// Room that a copy takes beside what it copies: index, footer, metadata.
const SPARE: u64 = 1 << 20;

/// Called with the bytes of a segment done so far; its error ends the work.
pub(super) type OnProgress<'a> = &'a mut dyn FnMut(u64) -> Result<()>;

/// The name of the copy of `path` until it is verified.
pub(super) fn temporary(path: &Path) -> PathBuf {
    let segment =
        if path.extension().is_some_and(|e| e == "part") { path.with_extension("") } else { path.into() };
    segment.with_extension(TEMPORARY)
}

/// A segment to be copied.
pub(super) struct Rebuild<'a> {
    pub(super) fs: &'a dyn Fs,
    /// The same file system, in a dry run.
    pub(super) dry: Option<&'a DryFs>,
    pub(super) dir: &'a Path,
    pub(super) path: &'a Path,
    /// All segments of the dataset: each has channels and session.
    pub(super) segments: &'a [PathBuf],
    pub(super) session: &'a Session,
    pub(super) before: Before,
}

/// The parts of a segment to leave out of its copy.
#[derive(Default)]
pub(super) struct Choice {
    /// Why, by where its chunks begin in the original.
    refused: BTreeMap<u64, String>,
    /// Whether to replace its own head.
    pub(super) foreign_head: bool,
}

impl Choice {
    /// Leaves out the parts of a copy with findings; returns whether that is more than before.
    pub(super) fn leave_out(&mut self, copy: &Rebuilt, broken: &[Finding]) -> bool {
        let known = self.refused.len();
        for finding in broken {
            if let Some(from) = finding.offset.and_then(|at| copy.original(at)) {
                self.refused.entry(from).or_insert_with(|| finding.message.clone());
            }
        }
        let more = self.refused.len() > known;
        // Damage outside the chunks is in the head.
        more || !std::mem::replace(&mut self.foreign_head, true)
    }

    /// The group as damage, if one of its chunks is refused.
    fn refusal(&self, group: &Group) -> Option<Damage> {
        let (offsets, end, set): (&[u64], _, _) = match group {
            Group::Set(set) => {
                let end = set.offsets.last().zip(set.chunks.last()).map(|(at, c)| at + c.len());
                (&set.offsets, end, Some(set.mark.id))
            }
            Group::Between(b) => (std::slice::from_ref(&b.offset), Some(b.offset + b.chunk.len()), None),
            _ => return None,
        };
        let why = offsets.iter().find_map(|at| self.refused.get(at))?.clone();
        let from = offsets.iter().copied().min()?;
        Some(Damage { from, to: end?, kind: DamageKind::Bytes, set, why })
    }
}

/// The state after the segments before one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Before {
    /// Id of the last set.
    last_set: Option<u64>,
    /// Sets that are there and sets that are known to be lost: what the accounts count. `None` where the first
    /// segments are not here.
    counted: Option<u64>,
    /// Of these, sets that are known to be lost.
    lost: u64,
}

impl Before {
    /// Before the first of these segments.
    pub(super) fn of(segments: &[PathBuf]) -> Self {
        let first = segments.first().and_then(|p| segment_number(&p.file_name()?.to_string_lossy()));
        Self { last_set: None, counted: (first == Some(0)).then_some(0), lost: 0 }
    }

    /// Goes past a segment.
    pub(super) fn add(&mut self, facts: &Facts) {
        self.last_set = facts.last_set.or(self.last_set);
        self.lost = self.lost.saturating_add(facts.sets_lost);
        self.counted = self.counted.map(|n| n.saturating_add(facts.sets).saturating_add(facts.sets_lost));
    }
}

/// A chunk of the copy.
struct Copied {
    /// Where the chunk that it comes from begins in the original; `None` for one that was not there.
    from: Option<u64>,
    /// Whether it is that chunk bit by bit.
    same: bool,
    /// Where it begins in the copy, and its bytes.
    at: u64,
    len: u64,
}

/// A copy under its temporary name, or what it would be.
pub(super) struct Rebuilt {
    pub(super) facts: Facts,
    pub(super) lost: Lost,
    copied: Vec<Copied>,
}

impl Rebuilt {
    /// Where what lies at `at` in the copy was in the original.
    pub(super) fn original(&self, at: u64) -> Option<u64> {
        self.copied.iter().find(|c| (c.at..c.at + c.len).contains(&at)).and_then(|c| c.from)
    }
}

impl Rebuild<'_> {
    /// Copies the complete sets into the temporary file and verifies it.
    pub(super) fn run(&self, choice: &Choice, on_progress: OnProgress<'_>) -> Result<Rebuilt> {
        let reader = SegmentReader::open_any(self.fs, self.path)?;
        let file = self.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let mut lost = Lost { bytes: reader.size, file, ..Lost::default() };
        let search =
            HeadSearch { fs: self.fs, path: self.path, segments: self.segments, session: self.session };
        let head = search.run(&reader, choice.foreign_head)?;
        // A file that was just created has nothing to lose.
        lost.head_rebuilt = head.rebuilt && reader.size > 0;
        if reader.size == 0 && self.had_content() {
            let why = "the file is empty".to_owned();
            lost.damage.push(Damage { from: 0, to: 0, kind: DamageKind::Empty, set: None, why });
            lost.at_end = true;
        }
        let temporary = temporary(self.path);
        self.check_room(reader.size)?;
        let done =
            Segment::create_as(self.fs, &temporary, temporary.clone(), &head.preamble).and_then(|copy| {
                let mut copy = copy;
                let done = self.copy(&reader, &head, choice, &mut copy, &mut lost, on_progress)?;
                let (end, crc) = copy.checkpoint();
                copy.seal()?;
                // Nothing was written that could differ.
                if self.dry.is_none() {
                    self.prove(&reader, &temporary, end, crc, &done.copied)?;
                }
                Ok(done)
            });
        match done {
            Ok(done) => Ok(Rebuilt { facts: done.facts, lost, copied: done.copied }),
            Err(e) => {
                // The next recovery removes it if this cannot.
                let _ = self.fs.remove_file(&temporary);
                Err(e)
            }
        }
    }

    /// Whether an empty file stands where something was recorded: the last one of a recording that was cut off may have
    /// been created a moment before.
    fn had_content(&self) -> bool {
        let is_last = self.segments.last().is_none_or(|last| last == self.path);
        let is_part = self.path.extension().is_some_and(|e| e == "part");
        self.session.outcome.is_some() || !is_last || !is_part
    }

    fn check_room(&self, bytes: u64) -> Result<()> {
        let dir = self.dir;
        let free =
            self.fs.available_space(dir).map_err(|e| Error::io("ask for the free space of", dir, e))?;
        let needed = bytes.saturating_add(SPARE.min(bytes));
        if free >= needed {
            return Ok(());
        }
        Err(Error::new(
            ErrorKind::DiskFull,
            format!(
                "{} cannot be recovered: its copy takes {needed} bytes, the disk has {free} left; free some space and \
                 try again (nothing was changed)",
                self.path.display()
            ),
        ))
    }

    fn copy(
        &self,
        reader: &SegmentReader,
        own: &Head,
        choice: &Choice,
        copy: &mut Segment,
        lost: &mut Lost,
        on_progress: OnProgress<'_>,
    ) -> Result<Done> {
        let preamble = &own.preamble;
        let accounts_channel = channel_of(preamble, Schema::Accounts);
        let mut facts = Facts { bytes: reader.size, ..Facts::default() };
        let mut said = BTreeMap::new();
        let mut copied = Vec::new();
        let checkpoints = channel_of(preamble, Schema::Checkpoint);
        let mut groups = Groups::new(reader, preamble, own.first)?;
        let mut before = self.before.last_set;
        let mut last_time = None;
        let mut recorded = 0;
        let mut head = false;
        while let Some(group) = groups.next()? {
            if let (Group::Set(set), false) = (&group, head) {
                // The chunk with the poses of the cameras is damaged.
                let chunk = head_chunk(preamble, set.log_time, self.path)?;
                copied.push(Copied { from: None, same: false, at: copy.len(), len: chunk.len() });
                copy.append_chunks(&[chunk])?;
            }
            head |= matches!(&group, Group::Set(_)) || matches!(&group, Group::Between(b) if b.head);
            let at = copy.len();
            let known = copied.len();
            if let Some(damage) = choice.refusal(&group) {
                lost.at_end = true;
                lost.damage.push(damage);
                continue;
            }
            let mut renewed = None;
            match &group {
                Group::Damage(d) => {
                    lost.at_end = true;
                    lost.damage.push(d.clone());
                }
                Group::Set(set) if out_of_order(set, before, last_time) => {
                    let (Some(from), Some(to)) = (set.offsets.first(), set.offsets.last()) else { continue };
                    let why = format!("set {}, which is not after the set before", set.mark.id);
                    let kind = DamageKind::Torn;
                    lost.damage.push(Damage { from: *from, to: *to, kind, set: Some(set.mark.id), why });
                    continue;
                }
                Group::Set(set) => {
                    if let Some(before) = before.filter(|b| lost.at_end && set.mark.id > b + 1) {
                        lost.missing.push((before + 1, set.mark.id - 1));
                    }
                    lost.at_end = false;
                    before = Some(set.mark.id);
                    last_time = Some(set.log_time);
                    facts.set(&set.mark, set.log_time);
                }
                Group::Between(between) => {
                    reader.chunk_messages(between.chunk.body(), between.offset, |m| {
                        if Some(m.channel) == accounts_channel
                            && let Ok((counts, _)) = accounts::read(m.data)
                        {
                            facts.counts = Some(counts);
                            recorded = counts.recorded.saturating_sub(facts.sets).max(recorded);
                        }
                        Ok(())
                    })?;
                    if let Some(channel) = checkpoints {
                        renewed = renew_checkpoint(reader, between, channel, copy)?;
                    }
                }
                Group::Metadata(name, map) if name == SEGMENT_METADATA => {
                    facts.metadata(map);
                    said.clone_from(map);
                    continue;
                }
                Group::Metadata(name, map) if name == RECOVERED_METADATA => facts.recovered(map),
                Group::Metadata(..) => {}
            }
            append(copy, &group, renewed, at, &mut copied)?;
            self.forget(&copied[known..])?;
            on_progress(groups.offset())?;
        }
        if lost.at_end {
            let next = self.next_sets()?;
            if let (Some(last), Some(first)) = (before, next.first)
                && first > last + 1
            {
                lost.missing.push((last + 1, first - 1));
            }
            let counted = next.recorded_before.map_or(0, |n| n.saturating_sub(facts.sets));
            recorded = recorded.max(counted);
        }
        if let Some(counted) = self.before.counted.filter(|_| !lost.damage.is_empty()) {
            lost.uncounted = recorded.saturating_sub(counted).saturating_sub(facts.sets_lost);
        }
        facts.lost.extend(lost.words());
        facts.sets_lost = facts.sets_lost.saturating_add(lost.sets());
        append_facts(copy, &facts, lost, said)?;
        Ok(Done { facts, copied })
    }

    /// In a dry run, drops bytes of a copy that the original has as well.
    fn forget(&self, copied: &[Copied]) -> Result<()> {
        let Some(dry) = self.dry else { return Ok(()) };
        let same = copied.iter().filter(|c| c.same);
        let same = same.filter_map(|c| Some(Same { at: c.at, from: c.from?, len: c.len }));
        let refer = dry.refer(&temporary(self.path), self.path, &same.collect::<Vec<_>>());
        refer.map_err(|e| Error::reading("read", self.path, e))
    }

    /// The end of this segment by the segments after it, as far as they are not damaged themselves.
    fn next_sets(&self) -> Result<Next> {
        let after = self.segments.iter().skip_while(|p| *p != self.path).skip(1);
        let mut first = None;
        let mut sets = 0;
        for path in after {
            let unknown = Next { first, recorded_before: None };
            let reader = SegmentReader::open_any(self.fs, path)?;
            let Some(own) = own_head(&reader)? else { return Ok(unknown) };
            let preamble = own.preamble;
            let begin = own.first;
            let accounts_channel = channel_of(&preamble, Schema::Accounts);
            let mut groups = Groups::new(&reader, &preamble, begin)?;
            while let Some(group) = groups.next()? {
                match group {
                    Group::Damage(_) => return Ok(Next { first, recorded_before: None }),
                    Group::Set(set) => {
                        first.get_or_insert(set.mark.id);
                        sets += 1;
                    }
                    Group::Between(between) => {
                        let mut recorded = None;
                        reader.chunk_messages(between.chunk.body(), between.offset, |m| {
                            if Some(m.channel) == accounts_channel
                                && let Ok((counts, _)) = accounts::read(m.data)
                            {
                                recorded = Some(counts.recorded);
                            }
                            Ok(())
                        })?;
                        if let Some(n) = recorded {
                            return Ok(Next { first, recorded_before: Some(n.saturating_sub(sets)) });
                        }
                    }
                    Group::Metadata(..) => {}
                }
            }
        }
        // A closed recording states the number of its sets.
        let outcome = self.session.outcome.as_ref();
        let recorded = outcome.map(|o| o.sets_recorded.saturating_add(self.before.lost).saturating_sub(sets));
        Ok(Next { first, recorded_before: recorded })
    }

    /// Reads the copy back: its index must be readable, its data must have the checksum that was computed while
    /// it was written, and each chunk must be that of the original, bit by bit.
    fn prove(
        &self,
        original: &SegmentReader,
        copy: &Path,
        end: u64,
        crc: u32,
        copied: &[Copied],
    ) -> Result<()> {
        let mut reader = SegmentReader::open_bare(self.fs, copy)?;
        reader.load_index()?;
        let wrong = |at: u64, what: &str| {
            let what =
                format!("the recovered copy differs from the written data: {what}; is the disk failing?");
            reader.error(ErrorKind::Corrupt, at, what)
        };
        if !reader.finished
            || !reader.chunks.iter().map(|c| (c.offset, c.length)).eq(copied.iter().map(|c| (c.at, c.len)))
        {
            return Err(wrong(end, "its index is another one"));
        }
        let mut hasher = crc32fast::Hasher::new();
        let mut ours = Vec::new();
        let mut theirs = Vec::new();
        let mut at = 0;
        let tail = Copied { from: None, same: false, at: end, len: 0 };
        for &Copied { from, same, at: to, len } in copied.iter().chain([&tail]) {
            while at < to {
                let n = WINDOW.min(to - at);
                reader.read_into(&mut ours, at, n)?;
                hasher.update(&ours);
                at += n;
            }
            let mut done = 0;
            while done < len {
                let n = WINDOW.min(len - done);
                reader.read_into(&mut ours, to + done, n)?;
                if let Some(from) = from.filter(|_| same) {
                    original.read_into(&mut theirs, from + done, n)?;
                    if ours != theirs {
                        return Err(wrong(to + done, "a chunk differs"));
                    }
                }
                hasher.update(&ours);
                done += n;
            }
            at += len;
        }
        if hasher.finalize() == crc { Ok(()) } else { Err(wrong(end, "its checksum is another one")) }
    }
}

/// Appends a group as it is in the damaged segment, or with its checkpoint `renewed`; `at` is the end of the copy.
fn append(
    copy: &mut Segment,
    group: &Group,
    renewed: Option<Chunk>,
    at: u64,
    copied: &mut Vec<Copied>,
) -> Result<()> {
    if let (Group::Between(between), Some(chunk)) = (group, renewed) {
        copied.push(Copied { from: Some(between.offset), same: false, at, len: chunk.len() });
        return copy.append_chunks(&[chunk]);
    }
    copy.append_group(group)?;
    let mut to = at;
    let (chunks, offsets): (&[_], &[_]) = match group {
        Group::Set(set) => (&set.chunks, &set.offsets),
        Group::Between(b) => (std::slice::from_ref(&b.chunk), std::slice::from_ref(&b.offset)),
        _ => (&[], &[]),
    };
    for (chunk, from) in chunks.iter().zip(offsets) {
        let len = chunk.len();
        copied.push(Copied { from: Some(*from), same: true, at: to, len });
        to += len + Segment::index_len(chunk);
    }
    Ok(())
}

/// Appends the losses and the facts of the segment; `said` are the facts that it stated itself.
fn append_facts(
    copy: &mut Segment,
    facts: &Facts,
    lost: &Lost,
    mut said: BTreeMap<String, String>,
) -> Result<()> {
    copy.append_metadata(RECOVERED_METADATA, &lost.metadata())?;
    said.extend(
        [
            ("segment", segment_number(&lost.file).unwrap_or_default() as u64),
            ("sets", facts.sets),
            ("first_set", facts.first_set.unwrap_or_default()),
            ("last_set", facts.last_set.unwrap_or_default()),
        ]
        .map(|(k, v)| (k.to_owned(), v.to_string())),
    );
    copy.append_metadata(SEGMENT_METADATA, &said)
}

/// The result of a copy.
struct Done {
    facts: Facts,
    copied: Vec<Copied>,
}

/// Where the segments after a damaged one begin.
struct Next {
    /// Id of their first set.
    first: Option<u64>,
    /// Sets that were recorded before them, if an account says so.
    recorded_before: Option<u64>,
}

/// The channel of this type, as readers of the index find it: of schemas and channels with one number the last counts.
pub(super) fn channel_of(preamble: &Preamble, schema: Schema) -> Option<u16> {
    let names: BTreeMap<_, _> = preamble.schemas.iter().map(|s| (s.id, s.name.as_str())).collect();
    let channels: BTreeMap<_, _> = preamble.channels.iter().map(|c| (c.id, c.schema)).collect();
    channels.into_iter().find(|(_, of)| names.get(of) == Some(&schema.name())).map(|(id, _)| id)
}

fn out_of_order(set: &SetGroup, before: Option<u64>, last_time: Option<u64>) -> bool {
    before.is_some_and(|b| set.mark.id <= b) || last_time.is_some_and(|t| set.log_time <= t)
}

/// The chunk with `/tf_static`, from the session in the head of the file.
fn head_chunk(preamble: &Preamble, log_time: u64, path: &Path) -> Result<Chunk> {
    let metadata = preamble.metadata.iter().find(|(name, _)| name == SESSION_METADATA);
    let text = metadata.and_then(|(_, m)| m.get("session_toml"));
    let session = Session::from_toml(text.map(String::as_str).unwrap_or_default(), path)?;
    let mut builder = ChunkBuilder::new();
    if let Some(channel) = channel_of(preamble, Schema::TfMessage) {
        let head = MessageHead { channel, sequence: 0, log_time, publish_time: log_time };
        builder.message(head, |b| {
            tf::write(b, log_time as i64, &session);
            Ok::<_, Error>(())
        })?;
    }
    builder.pack(true)
}

/// The chunk of `between` with a checkpoint of the copy in place of its own; `None` where its own is right for both, or
/// it has none. A checkpoint of another file would look like damage of this one wherever their lengths agree.
fn renew_checkpoint(
    reader: &SegmentReader,
    between: &BetweenGroup,
    channel: u16,
    copy: &Segment,
) -> Result<Option<Chunk>> {
    let (file_bytes, crc32) = copy.checkpoint();
    let here = Checkpoint { file_bytes, crc32 };
    let mut stale = false;
    let mut builder = ChunkBuilder::new();
    reader.chunk_messages(between.chunk.body(), between.offset, |m| {
        let head = MessageHead {
            channel: m.channel,
            sequence: m.sequence,
            log_time: m.log_time,
            publish_time: m.publish_time,
        };
        let is_checkpoint = m.channel == channel;
        stale |= is_checkpoint && Checkpoint::read(m.data).ok() != Some(here);
        builder.message(head, |b| {
            if is_checkpoint {
                here.write(b, i64::try_from(m.publish_time).unwrap_or(0));
            } else {
                b.extend_from_slice(m.data);
            }
            Ok::<_, Error>(())
        })?;
        Ok(())
    })?;
    if stale { builder.pack(true).map(Some) } else { Ok(None) }
}
