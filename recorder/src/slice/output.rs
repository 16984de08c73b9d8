//! Writing the new dataset: sets as they came, and between them what must be said anew.

use super::SliceOptions;
use super::session::count_line;
use super::track::{Loose, Range, Source};
use crate::container::chunk::{ChunkBuilder, MessageHead};
use crate::container::copy::SetGroup;
use crate::container::segment::{Preamble, Segment};
use crate::fs::Fs;
use crate::msgs::frame_set::Checkpoint;
use crate::msgs::schemas::Schema;
use crate::msgs::{accounts, diagnostics, tf};
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA};
use crate::{Error, Outcome, Result, Session, SetCounts, SetDrop, StreamAccount};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

/// Losses by reason.
pub(super) type Losses = [u64; SetDrop::ALL.len()];

pub(super) struct Output<'a> {
    fs: &'a dyn Fs,
    dir: &'a Path,
    session: Session,
    range: Range,
    options: SliceOptions,
    segment: Option<(Segment, Arc<Source>)>,
    /// Index of the present segment, or of the next one.
    index: u32,
    /// Sets in the present segment, with the ids of the first and the last.
    in_segment: (u64, u64, u64),
    builder: ChunkBuilder,
    sequence: u32,
    /// Sets written.
    pub(super) recorded: u64,
    /// Id and log time of the first and the last set.
    pub(super) first: Option<(u64, u64)>,
    /// Sets offered up to the last one, as its mark says.
    pub(super) offered: u64,
    pub(super) last: Option<(u64, u64)>,
    /// Messages after the last set that are not written yet.
    held: Vec<(Arc<Source>, Loose)>,
    /// The last reading of both clocks.
    clock: Option<Loose>,
    streams: Vec<StreamAccount>,
    notes: BTreeSet<(i64, String)>,
    pub(super) bytes: u64,
}

impl<'a> Output<'a> {
    pub(super) fn new(
        fs: &'a dyn Fs,
        dir: &'a Path,
        session: Session,
        range: Range,
        options: SliceOptions,
    ) -> Self {
        Self {
            fs,
            dir,
            session,
            range,
            options,
            segment: None,
            index: 0,
            in_segment: (0, 0, 0),
            builder: ChunkBuilder::new(),
            sequence: 0,
            recorded: 0,
            first: None,
            offered: 0,
            last: None,
            held: Vec::new(),
            clock: None,
            streams: Vec::new(),
            notes: BTreeSet::new(),
            bytes: 0,
        }
    }

    pub(super) const fn segments(&self) -> u32 {
        self.index
    }

    /// Appends a set. `clock` is the reading that its segment began with.
    pub(super) fn set(
        &mut self,
        set: &SetGroup,
        source: &Arc<Source>,
        clock: Option<Loose>,
        losses: &Losses,
    ) -> Result<()> {
        if self.segment.as_ref().is_some_and(|(s, from)| self.is_full(s, set) || !alike(from, source)) {
            self.close(losses)?;
        }
        match (&self.segment, clock) {
            (None, clock) => {
                self.clock = clock.or(self.clock.take());
                self.open(set, source)?;
            }
            (Some(_), Some(clock)) => self.held.push((Arc::clone(source), clock)),
            (Some(_), None) => {}
        }
        self.between(false, losses)?;
        if let Some((segment, _)) = &mut self.segment {
            segment.append_chunks(&set.chunks)?;
        }
        let id = set.mark.id;
        self.recorded += 1;
        let (n, first, _) = self.in_segment;
        self.in_segment = (n + 1, if n == 0 { id } else { first }, id);
        self.first.get_or_insert((id, set.log_time));
        self.last = Some((id, set.log_time));
        self.offered = set.mark.sets_offered;
        Ok(())
    }

    /// Says what its marks count from; before the first set.
    pub(super) fn begin(&mut self, offered_before: u64) {
        if let Some(step) = self.session.derived.last_mut() {
            step.offered_before = offered_before;
        }
    }

    /// Sets offered before its first one: its marks count from there.
    pub(super) fn offered_before(&self) -> u64 {
        self.session.derived.last().map_or(0, |step| step.offered_before)
    }

    /// Takes what came after the set before.
    pub(super) fn hold(&mut self, mut messages: Vec<(Arc<Source>, Loose)>) {
        self.held.append(&mut messages);
    }

    /// Takes what came before the first set: the latest reading of the clocks, and a note that was written early.
    pub(super) fn before(&mut self, source: Arc<Source>, message: Loose) {
        self.see_clock(&source, &message);
        if source.channel(Schema::Log) == Some(message.channel) {
            self.held.push((source, message));
        }
    }

    fn see_clock(&mut self, source: &Source, message: &Loose) {
        if source.channel(Schema::ClockPair) == Some(message.channel) {
            self.clock = Some(message.clone());
        }
    }

    /// Notes an account from before the first set: until the next one it is the latest.
    pub(super) fn see_streams(&mut self, streams: Vec<StreamAccount>) {
        for new in streams {
            match self.streams.iter_mut().find(|s| s.stream == new.stream) {
                // An input that ends earlier may hold an older account.
                Some(old) if new.captured < old.captured || new.delivered < old.delivered => {}
                Some(old) => *old = new,
                None => self.streams.push(new),
            }
        }
    }

    /// Notes an account from after the last set: better than none.
    pub(super) fn see_streams_beyond(&mut self, streams: Vec<StreamAccount>) {
        if self.streams.is_empty() {
            self.streams = streams;
        }
    }

    fn is_full(&self, segment: &Segment, next: &SetGroup) -> bool {
        let began = segment.times().map_or(next.log_time, |(first, _)| first);
        segment.len() >= self.options.segment_max_bytes
            || next.log_time.saturating_sub(began) as i64 >= self.options.segment_max_ns
    }

    /// Begins a segment with what each must say: `/tf_static` and a clock pair.
    fn open(&mut self, set: &SetGroup, source: &Arc<Source>) -> Result<()> {
        let preamble = self.preamble(source)?;
        let mut segment = Segment::create(self.fs, self.dir, self.index, &preamble)?;
        let log_time = set.log_time;
        if let Some(channel) = source.channel(Schema::TfMessage) {
            let session = &self.session;
            message(&mut self.builder, &mut self.sequence, channel, log_time, log_time, |b| {
                tf::write(b, log_time as i64, session);
            })?;
        }
        if let (Some(channel), Some(clock)) = (source.channel(Schema::ClockPair), &self.clock) {
            message(&mut self.builder, &mut self.sequence, channel, log_time, clock.publish_time, |b| {
                b.extend_from_slice(&clock.data);
            })?;
        }
        segment.append_chunks(&[self.builder.pack(true)?])?;
        self.segment = Some((segment, Arc::clone(source)));
        self.in_segment = (0, 0, 0);
        Ok(())
    }

    /// The preamble of the source's segments, for this session.
    fn preamble(&self, source: &Source) -> Result<Preamble> {
        let mut facts = source.reader.metadata(SESSION_METADATA).cloned().unwrap_or_default();
        let session = &self.session;
        for (key, value) in [
            ("name", session.name.clone()),
            ("scene", session.scene.clone()),
            ("operator", session.operator.clone()),
            ("segment", self.index.to_string()),
            ("session_toml", session.to_toml()?),
        ] {
            facts.insert(key.to_owned(), value);
        }
        Ok(Preamble {
            schemas: source.preamble.schemas.clone(),
            channels: source.preamble.channels.clone(),
            metadata: vec![(SESSION_METADATA.to_owned(), facts)],
            attachments: source.preamble.attachments.clone(),
        })
    }

    fn counts(&self, losses: &Losses) -> SetCounts {
        let mut counts = SetCounts { offered: 0, recorded: self.recorded, dropped: *losses };
        counts.offered = counts.recorded.saturating_add(counts.dropped_total());
        counts
    }

    /// Writes what is held as one chunk: clock pairs, diagnostics and notes as they came, the accounts and the
    /// checkpoint as they are here. `account` asks for an account where none came.
    fn between(&mut self, account: bool, losses: &Losses) -> Result<()> {
        let Some((_, log_time)) = self.last else { return Ok(()) };
        let Some((_, source)) = &self.segment else { return Ok(()) };
        let source = Arc::clone(source);
        let mut account = account;
        let mut any = false;
        for (from, m) in std::mem::take(&mut self.held) {
            let is = |schema| from.channel(schema) == Some(m.channel);
            if is(Schema::Accounts) {
                self.see_streams(accounts::read(&m.data)?.1);
                account = true;
                continue;
            }
            if is(Schema::Checkpoint) {
                continue;
            }
            if is(Schema::Log) {
                let (utc_ns, text) = diagnostics::read_note(&m.data)?;
                if !self.range.has_note(utc_ns) || !self.notes.insert((utc_ns, text.to_owned())) {
                    continue;
                }
                let note = crate::Note { utc_ns, text: text.to_owned() };
                if !self.session.notes.contains(&note) {
                    self.session.notes.push(note);
                }
            }
            self.see_clock(&from, &m);
            // Segments that are not alike are never open at once, so its channel is the same here.
            message(&mut self.builder, &mut self.sequence, m.channel, log_time, m.publish_time, |b| {
                b.extend_from_slice(&m.data);
            })?;
            any = true;
        }
        if let Some(channel) = source.channel(Schema::Accounts).filter(|_| account) {
            let counts = self.counts(losses);
            let streams = &self.streams;
            message(&mut self.builder, &mut self.sequence, channel, log_time, log_time, |b| {
                accounts::write(b, log_time as i64, &counts, streams);
            })?;
            any = true;
        }
        if any { self.append_between(&source, log_time) } else { Ok(()) }
    }

    /// Appends the chunk that was collected, with a checkpoint of what lies before it.
    fn append_between(&mut self, source: &Source, log_time: u64) -> Result<()> {
        let Some((segment, _)) = &mut self.segment else { return Ok(()) };
        if let Some(channel) = source.channel(Schema::Checkpoint) {
            let (file_bytes, crc32) = segment.checkpoint();
            message(&mut self.builder, &mut self.sequence, channel, log_time, log_time, |b| {
                Checkpoint { file_bytes, crc32 }.write(b, log_time as i64);
            })?;
        }
        segment.append_chunks(&[self.builder.pack(true)?])
    }

    /// Ends the present segment with its accounts and index.
    fn close(&mut self, losses: &Losses) -> Result<()> {
        self.between(true, losses)?;
        let Some((mut segment, _)) = self.segment.take() else { return Ok(()) };
        let (n, first, last) = self.in_segment;
        let mut facts = BTreeMap::from([
            ("segment".to_owned(), self.index.to_string()),
            ("sets".to_owned(), n.to_string()),
            ("first_set".to_owned(), first.to_string()),
            ("last_set".to_owned(), last.to_string()),
            ("sets_recorded_so_far".to_owned(), self.recorded.to_string()),
        ]);
        for (reason, n) in self.counts(losses).dropped_by_reason() {
            facts.insert(format!("sets_dropped_{}", reason.name()), n.to_string());
        }
        segment.append_metadata(SEGMENT_METADATA, &facts)?;
        let path = segment.finish(self.fs)?;
        self.index += 1;
        let file = self.fs.open(&path).and_then(|f| f.size());
        self.bytes += file.map_err(|e| Error::reading("open", &path, e))?;
        Ok(())
    }

    /// Closes the dataset: the last segment, the notes that stood beyond the end, and the session with its outcome.
    /// Returns what is missing, in words.
    pub(super) fn finish(&mut self, losses: &Losses, mut lost: Vec<String>) -> Result<Vec<String>> {
        self.notes_beyond();
        self.close(losses)?;
        let counts = self.counts(losses);
        let dropped = counts.dropped_by_reason();
        let mut all: Vec<_> = dropped.map(|(r, n)| count_line(n, counts.offered, r.name())).collect();
        all.append(&mut lost);
        let (_, ended) = self.last.unwrap_or_default();
        self.session.notes.sort_by_key(|n| n.utc_ns);
        self.session.outcome = Some(Outcome::new(ended as i64, &counts, all.clone()));
        self.session.save(self.fs, self.dir)?;
        Ok(all)
    }

    /// A note is in the file up to a second after it was made: where the cut fell between, it is written here.
    fn notes_beyond(&mut self) {
        let Some((_, source)) = &self.segment else { return };
        let Some(channel) = source.channel(Schema::Log) else { return };
        let source = Arc::clone(source);
        let held: BTreeSet<_> = self
            .held
            .iter()
            .filter(|(from, m)| from.channel(Schema::Log) == Some(m.channel))
            .filter_map(|(_, m)| diagnostics::read_note(&m.data).ok().map(|(t, text)| (t, text.to_owned())))
            .collect();
        for note in self.session.notes.clone() {
            let key = (note.utc_ns, note.text);
            if self.notes.contains(&key) || held.contains(&key) {
                continue;
            }
            let mut data = Vec::new();
            diagnostics::write_note(&mut data, key.0, &key.1);
            let publish_time = u64::try_from(key.0).unwrap_or(0);
            self.held.push((Arc::clone(&source), Loose { channel, publish_time, data }));
        }
    }
}

/// Whether the channels of both mean the same, so that chunks of one can stand in a segment of the other.
fn alike(a: &Source, b: &Source) -> bool {
    std::ptr::eq(a, b)
        || (a.preamble.channels == b.preamble.channels && a.preamble.schemas == b.preamble.schemas)
}

fn message(
    builder: &mut ChunkBuilder,
    sequence: &mut u32,
    channel: u16,
    log_time: u64,
    publish_time: u64,
    fill: impl FnOnce(&mut Vec<u8>),
) -> Result<()> {
    *sequence = sequence.wrapping_add(1);
    let head = MessageHead { channel, sequence: *sequence, log_time, publish_time };
    builder.message(head, |b| {
        fill(b);
        Ok::<_, Error>(())
    })?;
    Ok(())
}
