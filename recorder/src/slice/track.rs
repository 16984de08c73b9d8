//! Reading ahead: a track is a sequence of segments whose sets follow each other; one thread reads each track.

use crate::container::copy::{Damage, Group, Groups, SetGroup, read_preamble};
use crate::container::scan::SegmentReader;
use crate::container::segment::Preamble;
use crate::dataset::{Dataset, Kind, Removed, kinds, segment_number};
use crate::msgs::accounts;
use crate::msgs::schemas::Schema;
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA};
use crate::{Error, ErrorKind, Result, Session, SetCounts, StreamAccount};
use crossbeam::channel::Sender;
use std::path::Path;
use std::sync::Arc;

/// Which sets are wanted, by log time; which notes go with them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Range {
    pub(super) from_utc_ns: i64,
    pub(super) to_utc_ns: i64,
    /// The first set of the source is in it.
    pub(super) begins: bool,
    /// The last set of the source is in it.
    pub(super) ends: bool,
    pub(super) notes_from_utc_ns: i64,
    pub(super) notes_to_utc_ns: i64,
    /// Without the sets of discarded episodes.
    pub(super) prunes: bool,
}

impl Range {
    pub(super) const ALL: Self = Self {
        from_utc_ns: i64::MIN,
        to_utc_ns: i64::MAX,
        begins: true,
        ends: true,
        notes_from_utc_ns: i64::MIN,
        notes_to_utc_ns: i64::MAX,
        prunes: false,
    };

    /// Whether a set of a dataset within the range is left out.
    pub(super) fn is_pruned(&self, session: &Session, utc_ns: i64) -> bool {
        self.prunes && session.is_discarded(utc_ns)
    }

    pub(super) const fn has_note(&self, utc_ns: i64) -> bool {
        self.notes_from_utc_ns <= utc_ns && utc_ns <= self.notes_to_utc_ns
    }
}

/// A dataset or a segment to read from.
pub(super) struct Input<'a> {
    pub(super) dataset: &'a Dataset,
    /// Sets that an earlier prune removed from it.
    pub(super) removed: Removed,
}

impl<'a> Input<'a> {
    pub(super) fn new(dataset: &'a Dataset) -> Self {
        Self { dataset, removed: Removed::of(dataset.session()) }
    }

    /// Sets that were offered before its first segment begins, as its marks count.
    pub(super) fn offered_before(&self) -> u64 {
        self.dataset.session().derived.last().map_or(0, |d| d.offered_before)
    }

    /// Whether the accounts of both count from the same beginning.
    pub(super) fn shares_accounts(&self, other: &Self) -> bool {
        self.dataset.session().derived == other.dataset.session().derived
    }
}

/// A segment of an input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Piece {
    pub(super) input: usize,
    pub(super) segment: usize,
}

/// Segments whose sets follow each other in time.
pub(super) type Track = Vec<Piece>;

/// Counts of an account: of the sets, and of each stream.
pub(super) type Account = (SetCounts, Vec<StreamAccount>);

/// Which segment something is from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Origin {
    pub(super) input: usize,
    /// The segment's number, by its name.
    pub(super) number: Option<u32>,
}

impl Origin {
    /// Whether the accounts of the segment `next` go on where those of this one end: both count from the same
    /// beginning, and they are of one input, or no segment is missing between them.
    pub(super) fn goes_on(self, next: Self, inputs: &[Input<'_>]) -> bool {
        let follows = |(a, b): (u32, u32)| a == b || a.checked_add(1) == Some(b);
        (self.input == next.input || self.number.zip(next.number).is_some_and(follows))
            && inputs[self.input].shares_accounts(&inputs[next.input])
    }
}

/// A segment that is being read.
pub(super) struct Source {
    pub(super) reader: SegmentReader,
    pub(super) preamble: Preamble,
    pub(super) origin: Origin,
}

impl Source {
    /// Whether it is the first segment of its dataset.
    pub(super) fn is_first(&self) -> bool {
        self.origin.number == Some(0)
    }

    /// The channel whose messages are of this type.
    pub(super) fn channel(&self, schema: Schema) -> Option<u16> {
        channel(&self.preamble, schema)
    }
}

/// The channel of a file whose messages are of this type.
pub(super) fn channel(preamble: &Preamble, schema: Schema) -> Option<u16> {
    let id = preamble.schemas.iter().find(|s| s.name == schema.name())?.id;
    preamble.channels.iter().find(|c| c.schema == id).map(|c| c.id)
}

/// A message between two sets.
#[derive(Debug, Clone)]
pub(super) struct Loose {
    pub(super) channel: u16,
    pub(super) publish_time: u64,
    pub(super) data: Vec<u8>,
}

/// A set's place in its recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) id: u64,
    /// Sets offered up to it, with it.
    pub(super) offered: u64,
    pub(super) utc_ns: i64,
}

impl Place {
    pub(super) fn of(set: &SetGroup) -> Self {
        Self { id: set.mark.id, offered: set.mark.sets_offered, utc_ns: set.log_time as i64 }
    }
}

/// An item that a track's thread hands on.
pub(super) enum Item {
    /// The following items are from this segment. With the last account before it, where none of it was handed on.
    Source(Arc<Source>, Option<Account>),
    /// A set before the range.
    Skipped(Place),
    /// A set between others, which is left out.
    Pruned(Place),
    Set(Box<SetGroup>),
    /// Messages between two sets; `head` before the first set of a segment.
    Between {
        messages: Vec<Loose>,
        head: bool,
    },
    /// A part that cannot be read, in words.
    Damage(String),
    /// There are sets beyond the range. With the next account: it counts losses before them.
    Beyond(Option<Account>),
    Failed(Error),
}

/// All that is to be read.
pub(super) struct Tracks {
    pub(super) all: Vec<Track>,
    /// Log times of the first and the last set.
    pub(super) times: (i64, i64),
    /// Inputs of which nothing can be read, and why.
    pub(super) unread: Vec<(usize, String)>,
}

/// Divides segments into as few tracks as possible, so that the sets of each track follow each other in time. `None`
/// without a set.
pub(super) fn tracks(inputs: &[Input<'_>]) -> Result<Option<Tracks>> {
    let mut spans: Vec<(i64, i64, Piece)> = Vec::new();
    let mut damaged: Vec<(Piece, Error)> = Vec::new();
    for (input, source) in inputs.iter().enumerate() {
        for segment in 0..source.dataset.segments().len() {
            let Some(opened) = source.dataset.open_segment(segment) else { continue };
            let piece = Piece { input, segment };
            match opened {
                Ok(reader) => spans.extend(span(&reader).map(|(from, to)| (from, to, piece))),
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                // Another input may have all that is in it.
                Err(e) => damaged.push((piece, e)),
            }
        }
    }
    spans.sort_by_key(|(from, to, piece)| (*from, *to, piece.input, piece.segment));
    let Some(first) = spans.first().map(|s| s.0) else {
        return damaged.into_iter().next().map_or(Ok(None), |(_, e)| Err(e));
    };
    let last = spans.iter().map(|s| s.1).max().unwrap_or(first);
    let mut tracks: Vec<(i64, Track)> = Vec::new();
    for (from, to, piece) in spans {
        let free = |track: &&mut (i64, Track)| track.0 < from;
        let same = |track: &(i64, Track)| track.1.last().is_some_and(|p| p.input == piece.input);
        // Stay with an input where that is possible: its accounts go on.
        let at = tracks.iter_mut().filter(free).max_by_key(|track| same(track));
        match at {
            Some((end, pieces)) => {
                *end = to;
                pieces.push(piece);
            }
            None => tracks.push((to, vec![piece])),
        }
    }
    let mut tracks: Vec<Track> = tracks.into_iter().map(|(_, pieces)| pieces).collect();
    let mut unread = Vec::new();
    for (piece, e) in damaged {
        if !put(&mut tracks, piece) {
            unread.push((piece.input, e.to_string()));
        }
    }
    Ok(Some(Tracks { all: tracks, times: (first, last), unread }))
}

/// Log times of the first and the last set of a segment, as its index says.
fn span(reader: &SegmentReader) -> Option<(i64, i64)> {
    let kinds = kinds(reader);
    let is_set = |id: &u16| kinds.get(id) == Some(&Kind::Set);
    let marks = reader.chunks.iter().filter(|c| c.channels.iter().any(is_set));
    let times = marks.map(|c| (c.start_time as i64, c.end_time as i64));
    times.reduce(|(a, b), (from, to)| (a.min(from), b.max(to)))
}

/// Puts a segment that cannot be opened, so that its times are unknown, beside its neighbour of the same input: it is
/// the reason for sets missing there. `false` without a neighbour.
fn put(tracks: &mut [Track], piece: Piece) -> bool {
    // Segment, track, and place in the track.
    let mut own: Vec<(usize, usize, usize)> = Vec::new();
    for (track, pieces) in tracks.iter().enumerate() {
        let of_input = pieces.iter().enumerate().filter(|(_, p)| p.input == piece.input);
        own.extend(of_input.map(|(at, p)| (p.segment, track, at)));
    }
    let before = own.iter().filter(|(segment, ..)| *segment < piece.segment).max();
    let place = before.map(|(_, track, at)| (*track, at + 1));
    let place = place.or_else(|| own.iter().min().map(|(_, track, at)| (*track, *at)));
    let Some((track, at)) = place else { return false };
    tracks[track].insert(at, piece);
    true
}

/// Bytes of the chunks that a track will copy.
pub(super) fn bytes(inputs: &[Input<'_>], track: &[Piece], range: &Range) -> Result<u64> {
    let mut total = 0;
    for piece in track {
        let reader = match inputs[piece.input].dataset.open_segment(piece.segment) {
            Some(Ok(reader)) => reader,
            Some(Err(e)) if e.kind() == ErrorKind::Io => return Err(e),
            _ => continue,
        };
        let inside = reader
            .chunks
            .iter()
            .filter(|c| (c.end_time as i64) >= range.from_utc_ns && (c.start_time as i64) <= range.to_utc_ns)
            .filter(|c| !range.is_pruned(inputs[piece.input].dataset.session(), c.start_time as i64));
        total += inside.map(|c| c.length).sum::<u64>();
    }
    Ok(total)
}

/// Hands on everything of a track, in order. Ends early when nobody listens any more.
pub(super) fn read(inputs: &[Input<'_>], track: &[Piece], range: &Range, items: &Sender<Item>) {
    let mut reading = Reading { inputs, range, items, account: None };
    if let Err(Stop::Failed(e)) = reading.run(track) {
        // Nobody listens where this fails.
        let _ = items.send(Item::Failed(e));
    }
}

/// Why reading ends before the end.
enum Stop {
    Failed(Error),
    /// Beyond the range, or nobody listens.
    Enough,
}

impl From<Error> for Stop {
    fn from(e: Error) -> Self {
        Self::Failed(e)
    }
}

struct Reading<'a> {
    inputs: &'a [Input<'a>],
    range: &'a Range,
    items: &'a Sender<Item>,
    /// The last account before the next segment, where that is not handed on.
    account: Option<Account>,
}

impl Reading<'_> {
    fn send(&self, item: Item) -> Result<(), Stop> {
        self.items.send(item).map_err(|_| Stop::Enough)
    }

    fn run(&mut self, track: &[Piece]) -> Result<(), Stop> {
        let mut before: Option<Piece> = None;
        for piece in track {
            let next = before.map(|b| Piece { segment: b.segment + 1, ..b });
            if next != Some(*piece) {
                self.account = self.account_before(*piece)?;
            }
            before = Some(*piece);
            let input = &self.inputs[piece.input];
            let Some(opened) = input.dataset.open_segment(piece.segment) else { continue };
            let reader = match opened {
                Ok(reader) => reader,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e.into()),
                Err(e) => {
                    self.send(Item::Damage(e.to_string()))?;
                    continue;
                }
            };
            super::check_segment(input.dataset.session(), reader.metadata(SESSION_METADATA), &reader.path)?;
            if reader.chunks.iter().all(|c| (c.end_time as i64) < self.range.from_utc_ns) {
                self.account = last_account(&reader)?.or_else(|| self.account.take());
                continue;
            }
            self.segment(reader, *piece)?;
        }
        Ok(())
    }

    /// The last account of the segment before this one in its dataset, which another track reads.
    fn account_before(&self, piece: Piece) -> Result<Option<Account>> {
        let Some(before) = piece.segment.checked_sub(1) else { return Ok(None) };
        match self.inputs[piece.input].dataset.open_segment(before) {
            Some(Ok(reader)) => last_account(&reader),
            Some(Err(e)) if e.kind() == ErrorKind::Io => Err(e),
            _ => Ok(None),
        }
    }

    fn segment(&mut self, reader: SegmentReader, piece: Piece) -> Result<(), Stop> {
        let (preamble, first) = read_preamble(&reader)?;
        let number = reader.path.file_name().and_then(|n| segment_number(&n.to_string_lossy()));
        let source = Arc::new(Source { reader, preamble, origin: Origin { input: piece.input, number } });
        let account = self.account.take();
        self.send(Item::Source(Arc::clone(&source), account))?;
        let mut groups = Groups::new(&source.reader, &source.preamble, first)?;
        let file = &source.reader.path;
        let session = self.inputs[piece.input].dataset.session();
        // Of a file that was cut off between two records nothing else shows that there was more to come.
        let mut has_end = source.reader.finished
            || is_reported_unfinished(self.inputs[piece.input].dataset.session(), file);
        let mut is_damaged = false;
        while let Some(group) = groups.next()? {
            is_damaged = matches!(group, Group::Damage(_));
            match group {
                Group::Set(set) if (set.log_time as i64) < self.range.from_utc_ns => {
                    self.send(Item::Skipped(Place::of(&set)))?;
                }
                Group::Set(set) if (set.log_time as i64) > self.range.to_utc_ns => {
                    let account = next_account(&source, &mut groups)?;
                    self.send(Item::Beyond(account))?;
                    return Err(Stop::Enough);
                }
                Group::Set(set) if self.range.is_pruned(session, set.log_time as i64) => {
                    self.send(Item::Pruned(Place::of(&set)))?;
                }
                Group::Set(set) => self.send(Item::Set(Box::new(set)))?,
                Group::Between(between) => {
                    let mut messages = Vec::new();
                    source.reader.chunk_messages(between.chunk.body(), between.offset, |m| {
                        let channel = m.channel;
                        let publish_time = m.publish_time;
                        messages.push(Loose { channel, publish_time, data: m.data.to_vec() });
                        Ok(())
                    })?;
                    self.send(Item::Between { messages, head: between.head })?;
                }
                // The last thing that is written before the index.
                Group::Metadata(name, _) => has_end |= name == SEGMENT_METADATA,
                Group::Damage(Damage { from, why, .. }) => {
                    self.send(Item::Damage(format!("{} at byte {from}: {why}", file.display())))?;
                }
            }
        }
        if !has_end && !is_damaged {
            let why = source.reader.cut.as_ref().map_or("it has no end", |(_, why)| why.as_str());
            self.send(Item::Damage(format!("{} was not finished: {why}", file.display())))?;
        }
        Ok(())
    }
}

/// Whether the session says itself that a file was not finished.
fn is_reported_unfinished(session: &Session, file: &Path) -> bool {
    let name = file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    session.outcome.iter().flat_map(|o| &o.lost).any(|line| line.contains(&name))
}

/// The next account in the segment, which is within about a second.
fn next_account(source: &Source, groups: &mut Groups<'_>) -> Result<Option<Account>> {
    let channel = source.channel(Schema::Accounts);
    while let Some(group) = groups.next()? {
        let Group::Between(between) = group else { continue };
        let mut account = None;
        source.reader.chunk_messages(between.chunk.body(), between.offset, |m| {
            if channel == Some(m.channel) {
                account = Some(accounts::read(m.data)?);
            }
            Ok(())
        })?;
        if account.is_some() {
            return Ok(account);
        }
    }
    Ok(None)
}

/// The last account in a segment.
fn last_account(reader: &SegmentReader) -> Result<Option<Account>> {
    let channel = reader.channels.iter().find(|(_, c)| c.schema == Schema::Accounts.name());
    let Some((channel, _)) = channel else { return Ok(None) };
    let Some(entry) = reader.chunks.iter().rev().find(|c| c.channels.contains(channel)) else {
        return Ok(None);
    };
    let mut last = None;
    let read = reader.messages(entry, |m| {
        if m.channel == *channel {
            last = Some(accounts::read(m.data)?);
        }
        Ok(())
    });
    match read {
        Err(e) if e.kind() == ErrorKind::Io => Err(e),
        _ => Ok(last),
    }
}
