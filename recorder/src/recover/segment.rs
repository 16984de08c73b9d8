//! One segment: whether it is whole, and if not, a proven copy of what is.

use super::facts::Facts;
use super::lost::Lost;
use super::{RECOVERED_METADATA, TEMPORARY};
use crate::container::MAGIC;
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::container::copy::{Damage, DamageKind, Group, Groups, SetGroup, read_preamble};
use crate::container::scan::SegmentReader;
use crate::container::segment::{Preamble, Segment};
use crate::dataset::segment_number;
use crate::encode::Codec;
use crate::fs::Fs;
use crate::msgs::schemas::Schema;
use crate::msgs::{accounts, frame_info, tf};
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA, Topics, image_channel};
use crate::{ColorCodec, DepthCodec, Error, ErrorKind, RecorderOptions, Result, Session};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Bytes compared at a time.
pub(super) const WINDOW: u64 = 1 << 20;
/// Room that a copy takes beside what it copies: index, footer, metadata.
const SPARE: u64 = 1 << 20;

/// Told how many bytes of a segment are done; its error ends the work.
pub(super) type Tell<'a> = &'a mut dyn FnMut(u64) -> Result<()>;

/// The name of the copy of `path` until it is proven.
pub(super) fn temporary(path: &Path) -> PathBuf {
    let segment =
        if path.extension().is_some_and(|e| e == "part") { path.with_extension("") } else { path.into() };
    segment.with_extension(TEMPORARY)
}

/// A segment to be copied.
pub(super) struct Rebuild<'a> {
    pub(super) fs: &'a dyn Fs,
    pub(super) dir: &'a Path,
    pub(super) path: &'a Path,
    /// All segments of the dataset: each has channels and session.
    pub(super) segments: &'a [PathBuf],
    pub(super) session: Option<&'a Session>,
    pub(super) before: Before,
}

/// What the segments before one hold.
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

/// A chunk of the copy: where it was in the original, unless it was made anew; where it is; its bytes.
type Copied = (Option<u64>, u64, u64);

impl Rebuild<'_> {
    /// Copies what is whole into the temporary file and proves that. With `dry_run` it only looks.
    pub(super) fn run(&self, dry_run: bool, tell: Tell<'_>) -> Result<(Facts, Lost)> {
        let reader = SegmentReader::open_any(self.fs, self.path)?;
        let file = self.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let mut lost = Lost { bytes: reader.size, file, ..Lost::default() };
        let (preamble, first) = if let Some(own) = self.own_preamble(&reader)? {
            own
        } else {
            // A file that was only just created has nothing to lose.
            lost.head_rebuilt = reader.size > 0;
            (self.other_preamble(&reader)?, MAGIC.len().min(reader.size as usize) as u64)
        };
        let temporary = temporary(self.path);
        if dry_run {
            let (facts, _) = self.copy(&reader, &preamble, first, None, &mut lost, tell)?;
            return Ok((facts, lost));
        }
        self.check_room(reader.size)?;
        let done = Segment::create_as(self.fs, &temporary, temporary.clone(), &preamble).and_then(|copy| {
            let mut copy = copy;
            let (facts, copied) = self.copy(&reader, &preamble, first, Some(&mut copy), &mut lost, tell)?;
            let (end, crc) = copy.checkpoint();
            copy.seal()?;
            self.prove(&reader, &temporary, end, crc, &copied)?;
            Ok(facts)
        });
        match done {
            Ok(facts) => Ok((facts, lost)),
            Err(e) => {
                // The next recovery removes it if this cannot.
                let _ = self.fs.remove_file(&temporary);
                Err(e)
            }
        }
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
        preamble: &Preamble,
        first: u64,
        mut copy: Option<&mut Segment>,
        lost: &mut Lost,
        tell: Tell<'_>,
    ) -> Result<(Facts, Vec<Copied>)> {
        let accounts_channel = channel_of(preamble, Schema::Accounts);
        let mut facts = Facts { bytes: reader.size, ..Facts::default() };
        let mut said = BTreeMap::new();
        let mut copied = Vec::new();
        let mut groups = Groups::new(reader, preamble, first)?;
        let mut before = self.before.last_set;
        let (mut last_time, mut recorded) = (None, 0);
        let mut head = false;
        while let Some(group) = groups.next()? {
            if let (Group::Set(set), Some(copy), false) = (&group, copy.as_deref_mut(), head) {
                // Damage took the chunk that says where the cameras are.
                let chunk = head_chunk(preamble, set.log_time, self.path)?;
                copied.push((None, copy.len(), chunk.len()));
                copy.append_chunks(&[chunk])?;
            }
            head |= matches!(&group, Group::Set(_)) || matches!(&group, Group::Between(b) if b.head);
            let at = copy.as_ref().map_or(0, |c| c.len());
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
                    (before, last_time) = (Some(set.mark.id), Some(set.log_time));
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
                }
                Group::Metadata(name, map) if name == SEGMENT_METADATA => {
                    facts.metadata(map);
                    said.clone_from(map);
                    continue;
                }
                Group::Metadata(name, map) if name == RECOVERED_METADATA => facts.recovered(map),
                Group::Metadata(..) => {}
            }
            if let Some(copy) = copy.as_deref_mut() {
                copy.append_group(&group)?;
                let mut to = at;
                let (chunks, offsets): (&[_], &[_]) = match &group {
                    Group::Set(set) => (&set.chunks, &set.offsets),
                    Group::Between(b) => (std::slice::from_ref(&b.chunk), std::slice::from_ref(&b.offset)),
                    _ => (&[], &[]),
                };
                for (chunk, from) in chunks.iter().zip(offsets) {
                    let len = chunk.len();
                    copied.push((Some(*from), to, len));
                    to += len + Segment::index_len(chunk);
                }
            }
            tell(groups.offset())?;
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
        if let Some(copy) = copy {
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
            copy.append_metadata(SEGMENT_METADATA, &said)?;
        }
        Ok((facts, copied))
    }

    /// What comes after this segment says of the end of this one, as far as it is not damaged itself.
    fn next_sets(&self) -> Result<Next> {
        let after = self.segments.iter().skip_while(|p| *p != self.path).skip(1);
        let (mut first, mut sets) = (None, 0);
        for path in after {
            let unknown = Next { first, recorded_before: None };
            let reader = SegmentReader::open_any(self.fs, path)?;
            let Some((preamble, begin)) = self.own_preamble(&reader)? else { return Ok(unknown) };
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
        // A recording that was closed says how many sets there were.
        let outcome = self.session.and_then(|s| s.outcome.as_ref());
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
            let what = format!("the recovered copy is not what was written: {what}; is the disk failing?");
            reader.error(ErrorKind::Corrupt, at, what)
        };
        if !reader.finished
            || !reader.chunks.iter().map(|c| (c.offset, c.length)).eq(copied.iter().map(|c| (c.1, c.2)))
        {
            return Err(wrong(end, "its index is another one"));
        }
        let mut hasher = crc32fast::Hasher::new();
        let (mut ours, mut theirs) = (Vec::new(), Vec::new());
        let mut at = 0;
        for &(from, to, len) in copied.iter().chain([&(None, end, 0)]) {
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
                if let Some(from) = from {
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

    /// Schemas, channels and session as they stand in the file, if they do.
    fn own_preamble(&self, reader: &SegmentReader) -> Result<Option<(Preamble, u64)>> {
        if reader.size < MAGIC.len() as u64 || reader.read(0, MAGIC.len() as u64)? != MAGIC {
            return Ok(None);
        }
        let found = match read_preamble(reader) {
            Ok(found) => found,
            Err(e) if matches!(e.kind(), ErrorKind::Corrupt | ErrorKind::Truncated) => return Ok(None),
            Err(e) => return Err(e),
        };
        let session = found.0.metadata.iter().find(|(name, _)| name == SESSION_METADATA);
        let text = session.and_then(|(_, m)| m.get("session_toml"));
        Ok(text.is_some_and(|t| Session::from_toml(t, self.path).is_ok()).then_some(found))
    }

    /// The same from another segment, or from the session.
    fn other_preamble(&self, reader: &SegmentReader) -> Result<Preamble> {
        let number =
            segment_number(&self.path.file_name().unwrap_or_default().to_string_lossy()).unwrap_or_default();
        for other in self.segments.iter().filter(|p| *p != self.path) {
            let other = SegmentReader::open_any(self.fs, other)?;
            if let Some((mut preamble, _)) = self.own_preamble(&other)? {
                for (name, map) in &mut preamble.metadata {
                    if name == SESSION_METADATA {
                        map.insert("segment".to_owned(), number.to_string());
                    }
                }
                return Ok(preamble);
            }
        }
        let Some(session) = self.session else {
            return Err(Error::new(
                ErrorKind::NotADataset,
                format!(
                    "nothing says what {} holds: its head is damaged, and so are session.toml and all other segments",
                    self.path.display()
                ),
            ));
        };
        let preamble = |options: &RecorderOptions| {
            let mut session = session.clone();
            session.outcome = None;
            Topics::new(&session, options).preamble(&session, number)
        };
        // How pictures are stored decides the types of their channels; the first set tells.
        let mut options = RecorderOptions::default();
        let guess = preamble(&options)?;
        let mut groups = Groups::new(reader, &guess, MAGIC.len().min(reader.size as usize) as u64)?;
        while let Some(group) = groups.next()? {
            if let Group::Set(set) = group {
                codecs(reader, &set, session, &mut options)?;
                return preamble(&options);
            }
        }
        Ok(guess)
    }
}

/// Where the segments after a damaged one begin.
struct Next {
    /// Id of their first set.
    first: Option<u64>,
    /// Sets that were recorded before them, if an account tells.
    recorded_before: Option<u64>,
}

/// The channel of this type, as whoever reads the index finds it: of schemas and channels with one number the last counts.
fn channel_of(preamble: &Preamble, schema: Schema) -> Option<u16> {
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

/// Finds out how the pictures of a set are stored.
fn codecs(
    reader: &SegmentReader,
    set: &SetGroup,
    session: &Session,
    options: &mut RecorderOptions,
) -> Result<()> {
    let (Some(chunk), Some(offset)) = (set.chunks.last(), set.offsets.last()) else { return Ok(()) };
    reader.chunk_messages(chunk.body(), *offset, |m| {
        let stream = session.streams.iter().enumerate().find(|(i, _)| image_channel(*i) + 2 == m.channel);
        let Some((_, stream)) = stream else { return Ok(()) };
        let (header, extra) = frame_info::read(m.data)?;
        let stored = Codec::from_name(extra.codec);
        if header.format != stream.format as u32 {
            return Ok(());
        }
        let agrees = |to: &RecorderOptions| Some(Codec::of(stream.format, to)) == stored;
        let colors = [ColorCodec::Jpeg, ColorCodec::Raw, ColorCodec::Png]
            .map(|color| RecorderOptions { color, ..options.clone() });
        let depths =
            [DepthCodec::Zstd, DepthCodec::Rank].map(|depth| RecorderOptions { depth, ..options.clone() });
        if !agrees(options)
            && let Some(found) = colors.into_iter().chain(depths).find(agrees)
        {
            *options = found;
        }
        Ok(())
    })
}
