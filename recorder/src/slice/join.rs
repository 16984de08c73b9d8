//! The sets of all tracks in the order of their times, each once.

use super::books::{Books, Gap};
use super::folder::Folder;
use super::output::{Losses, Output};
use super::session::{BEFORE, IN_NO_INPUT, NOT_THERE, said};
use super::track::{self, Input, Item, Loose, Origin, Place, Range, Source, Track};
use super::{SliceOptions, SliceProgress, SliceReport};
use crate::container::chunk::Chunk;
use crate::container::copy::SetGroup;
use crate::fs::Fs;
use crate::msgs::accounts;
use crate::msgs::schemas::Schema;
use crate::{Error, ErrorKind, Result, Session};
use crossbeam::channel::{Receiver, bounded};
use std::path::Path;
use std::sync::Arc;

mod end;

/// Items that a track reads ahead. A set is one of them, so this bounds the memory.
const AHEAD: usize = 1;
/// Lines of what is missing that are kept one by one.
const MAX_LOST: usize = 100;

pub(super) struct Join<'a> {
    inputs: &'a [Input<'a>],
    range: Range,
    options: SliceOptions,
    losses: Losses,
    lost: Vec<String>,
    more_lost: u64,
    repeated: u64,
    unexplained: u64,
    /// Inputs of which nothing can be read, and why.
    unread: Vec<(usize, String)>,
}

/// Reading position of a track.
struct Head {
    items: Receiver<Item>,
    source: Option<Arc<Source>>,
    books: Books,
    /// The set before, and its segment.
    before: Option<(Place, Origin)>,
    next: Option<Box<SetGroup>>,
    /// The clock pair that the next set's segment begins with.
    clock: Option<Loose>,
    /// The set before was left out.
    is_pruned: bool,
    /// Damage since the set before, in words.
    damage: Vec<String>,
    /// There are sets beyond the range.
    beyond: bool,
}

impl<'a> Join<'a> {
    pub(super) fn new(inputs: &'a [Input<'a>], range: Range, options: SliceOptions) -> Self {
        Self {
            inputs,
            range,
            options,
            losses: Losses::default(),
            lost: Vec::new(),
            more_lost: 0,
            repeated: 0,
            unexplained: 0,
            unread: Vec::new(),
        }
    }

    /// The same with inputs of which nothing can be read, and why.
    pub(super) fn without(mut self, unread: Vec<(usize, String)>) -> Self {
        self.unread = unread;
        self
    }

    pub(super) fn run(
        mut self,
        fs: &dyn Fs,
        tracks: &[Track],
        session: Session,
        out: &Path,
        progress: SliceProgress<'_>,
    ) -> Result<SliceReport> {
        let mut total = 0;
        for track in tracks {
            total += track::bytes(self.inputs, track, &self.range)?;
        }
        let folder = Folder::create(fs, out, total)?;
        let mut output = Output::new(fs, folder.path(), session, self.range, self.options);
        let inputs = self.inputs;
        let range = self.range;
        let lost = std::thread::scope(|scope| {
            let mut heads = Vec::new();
            for track in tracks {
                let (sender, items) = bounded(AHEAD);
                scope.spawn(move || track::read(inputs, track, &range, &sender));
                heads.push(Head::new(items));
            }
            // The heads go before the threads are waited for: a thread that has nobody to read for ends.
            self.copy(heads, &mut output, progress, total)
        })?;
        let (Some(first), Some(last)) = (output.first, output.last) else {
            let what = "no set in the requested range can be read; `depthrig verify` says why";
            return Err(Error::new(ErrorKind::Corrupt, what));
        };
        let report = SliceReport {
            path: out.to_owned(),
            sets: output.recorded,
            first_set: first.0,
            last_set: last.0,
            duration_ns: (last.1 - first.1) as i64,
            segments: output.segments(),
            bytes: output.bytes,
            repeated: self.repeated,
            complete: lost.is_empty(),
            lost,
        };
        drop(output);
        folder.finish()?;
        Ok(report)
    }

    /// Copies everything; what is missing, in words.
    fn copy(
        &mut self,
        mut heads: Vec<Head>,
        output: &mut Output<'_>,
        progress: SliceProgress<'_>,
        total: u64,
    ) -> Result<Vec<String>> {
        for head in &mut heads {
            for (source, message) in self.fill(head, output)? {
                output.before(source, message);
            }
        }
        let mut done = 0;
        let mut last = None;
        while let Some(at) = heads.iter().filter_map(Head::time).min() {
            if progress(done, total).is_break() {
                return Err(Error::new(
                    ErrorKind::Cancelled,
                    "it was ended before it was done; nothing is left of it",
                ));
            }
            let due: Vec<_> = (0..heads.len()).filter(|i| heads[*i].time() == Some(at)).collect();
            // Staying with a track keeps its accounts together.
            let chosen = last.filter(|l| due.contains(l)).unwrap_or(due[0]);
            for other in due.iter().filter(|i| **i != chosen) {
                must_be_same(&heads[chosen], &heads[*other])?;
                self.repeated += 1;
            }
            self.account_for(&mut heads, &due, chosen, output)?;
            for i in due {
                let head = &mut heads[i];
                let (Some(set), Some(source)) = (head.next.take(), head.source.clone()) else { continue };
                done += set.chunks.iter().map(Chunk::len).sum::<u64>();
                let clock = head.clock.take();
                if i == chosen {
                    output.set(&set, &source, clock, &self.losses)?;
                }
                head.before = Some((Place::of(&set), source.origin));
                head.is_pruned = false;
                drop(set);
                let after = self.fill(head, output)?;
                if i == chosen {
                    output.hold(after);
                }
            }
            last = Some(chosen);
        }
        self.end(&mut heads, output);
        let lost = self.loss_lines();
        let lost = output.finish(&self.losses, lost)?;
        // The bytes that are not read are between sets and outside of the range.
        let _ = progress(total, total);
        Ok(lost)
    }

    /// Finds what is missing between the last set written and the next one, and for which reason.
    fn account_for(
        &mut self,
        heads: &mut [Head],
        due: &[usize],
        chosen: usize,
        output: &mut Output<'_>,
    ) -> Result<()> {
        let inputs = self.inputs;
        for i in due {
            let head = &mut heads[*i];
            let Some(set) = &head.next else { continue };
            let mark = &set.mark;
            let gap = head.gap(inputs, Place::of(set));
            let offered = mark.sets_offered;
            let found = |counted: bool| Gap { sets: gap, counted, offered };
            let damage = std::mem::take(&mut head.damage);
            if *i != chosen {
                head.books.gap(found(false), &mut self.losses);
                continue;
            }
            let session = head.source.as_ref().map(|s| inputs[s.origin.input].dataset.session());
            let Some((id, _)) = output.last else {
                // Losses before the first set belong to a complete recording, not to a part.
                let counted = head.before.is_none() && self.range.begins;
                let own = head.source.as_ref().filter(|s| counted && s.is_first());
                output.begin(own.map_or(mark.sets_offered.saturating_sub(1), |s| {
                    inputs[s.origin.input].offered_before()
                }));
                let knows = own.is_some();
                let line = lost_before(mark.id, gap, &damage, knows, session).filter(|_| counted);
                head.books.gap(found(counted && line.is_none()), &mut self.losses);
                if let Some(line) = line {
                    self.lose(line);
                }
                continue;
            };
            if mark.id <= id {
                return Err(Error::new(
                    ErrorKind::BadInput,
                    format!(
                        "set {} of {} comes after set {id} in time, but not by its number: the inputs contradict \
                         each other; `depthrig verify` each of them",
                        mark.id,
                        head.name()
                    ),
                ));
            }
            // With the set of another input before it, its own accounts do not count the gap.
            let same = head.before.zip(head.source.as_ref()).is_some_and(|((before, origin), source)| {
                (before.id == id || head.is_pruned) && origin.goes_on(source.origin, inputs)
            });
            let missing = if same { gap } else { mark.sets_offered.saturating_sub(output.offered + 1) };
            let between = format!("{missing} sets between set {id} and set {}", mark.id);
            if missing == 0 {
                head.books.gap(found(false), &mut self.losses);
            } else if !same {
                head.books.gap(found(false), &mut self.losses);
                self.lose(format!("{between} are {IN_NO_INPUT}"));
            } else if !damage.is_empty() {
                self.lose(format!("{between} {NOT_THERE}{}", damage.join("; ")));
            } else if let Some(line) = said(session, &format!("{between} are ")) {
                // The cut or join that it is from gave a reason that no account has.
                self.lose(line);
            } else {
                head.books.gap(found(true), &mut self.losses);
            }
        }
        Ok(())
    }

    fn lose(&mut self, line: String) {
        if self.lost.len() < MAX_LOST {
            self.lost.push(line);
        } else {
            self.more_lost += 1;
        }
    }

    fn loss_lines(&mut self) -> Vec<String> {
        let mut lost = std::mem::take(&mut self.lost);
        if self.more_lost > 0 {
            lost.push(format!("and {} more like these", self.more_lost));
        }
        lost
    }

    /// Reads on to the next set; what lies before it.
    fn fill(&mut self, head: &mut Head, output: &mut Output<'_>) -> Result<Vec<(Arc<Source>, Loose)>> {
        let mut messages = Vec::new();
        while let Ok(item) = head.items.recv() {
            match item {
                Item::Source(source, account) => {
                    let goes_on =
                        head.source.as_ref().is_some_and(|s| s.origin.goes_on(source.origin, self.inputs));
                    if !goes_on {
                        self.unexplained += head.books.unexplained();
                        let counts = account.as_ref().map(|(counts, _)| counts);
                        head.books =
                            if source.is_first() { Books::from_zero() } else { Books::after(counts) };
                    }
                    if let Some((_, streams)) = account.filter(|_| output.last.is_none()) {
                        output.see_streams(streams);
                    }
                    head.source = Some(source);
                }
                Item::Skipped(place) => {
                    let sets = head.gap(self.inputs, place);
                    let gap = Gap { sets, counted: false, offered: place.offered };
                    head.books.gap(gap, &mut self.losses);
                    head.before = head.source.as_ref().map(|s| (place, s.origin));
                    head.damage.clear();
                    for (source, message) in messages.drain(..) {
                        output.before(source, message);
                    }
                }
                Item::Pruned(place) => {
                    let sets = head.gap(self.inputs, place);
                    // Only a loss beside a set that stays is one of the new dataset.
                    let counted = !head.is_pruned && output.last.is_some();
                    head.books.gap(Gap { sets, counted, offered: place.offered }, &mut self.losses);
                    head.before = head.source.as_ref().map(|s| (place, s.origin));
                    head.is_pruned = true;
                    for (source, message) in messages.drain(..) {
                        output.before(source, message);
                    }
                }
                Item::Set(set) => {
                    head.next = Some(set);
                    break;
                }
                Item::Between { messages: between, head: is_head } => {
                    let Some(source) = &head.source else { continue };
                    for message in between {
                        if source.channel(Schema::Accounts) == Some(message.channel) {
                            let (counts, streams) = accounts::read(&message.data)?;
                            head.books.account(&counts, &mut self.losses);
                            if output.last.is_none() {
                                output.see_streams(streams);
                            }
                        }
                        if !is_head {
                            messages.push((Arc::clone(source), message));
                        } else if source.channel(Schema::ClockPair) == Some(message.channel) {
                            head.clock = Some(message);
                        }
                    }
                }
                Item::Damage(what) => head.damage.push(what),
                Item::Beyond(account) => {
                    head.beyond = true;
                    if let Some((counts, streams)) = account {
                        head.books.account(&counts, &mut self.losses);
                        output.see_streams_beyond(streams);
                    }
                }
                Item::Failed(e) => return Err(e),
            }
        }
        Ok(messages)
    }
}

impl Head {
    fn new(items: Receiver<Item>) -> Self {
        Self {
            items,
            source: None,
            books: Books::default(),
            before: None,
            is_pruned: false,
            next: None,
            clock: None,
            damage: Vec::new(),
            beyond: false,
        }
    }

    fn time(&self) -> Option<u64> {
        self.next.as_ref().map(|set| set.log_time)
    }

    fn name(&self) -> String {
        self.source.as_ref().map_or_else(String::new, |s| s.reader.path.display().to_string())
    }

    /// Sets that were offered since the set before and are not in this track, as far as its accounts go back: what
    /// lies between two inputs with accounts of their own is in neither. Where an earlier prune removed sets, only its accounts report
    /// losses beside them.
    fn gap(&self, inputs: &[Input<'_>], place: Place) -> u64 {
        let Some(source) = &self.source else { return 0 };
        let input = &inputs[source.origin.input];
        match self.before.filter(|(_, origin)| origin.goes_on(source.origin, inputs)) {
            Some((before, _)) if input.removed.is_between(before.utc_ns, place.utc_ns) => 0,
            Some((before, _)) => place.offered.saturating_sub(before.offered.saturating_add(1)),
            None if source.is_first() => {
                let before = input.offered_before();
                place.offered.saturating_sub(before.saturating_add(1))
            }
            None => 0,
        }
    }
}

/// The line about sets missing before the first one, where no account counts them; `knows` when these are `gap` sets.
fn lost_before(
    id: u64,
    gap: u64,
    damage: &[String],
    knows: bool,
    session: Option<&Session>,
) -> Option<String> {
    let sets = format!("{gap} sets before set {id}");
    match (damage.is_empty(), knows) {
        (true, _) => said(session, &format!("{sets} are ")),
        // A beginning that cannot be read has an unknown length.
        (false, false) => Some(format!("{BEFORE}{id} is not there: {}", damage.join("; "))),
        (false, true) => (gap > 0).then(|| format!("{sets} {NOT_THERE}{}", damage.join("; "))),
    }
}

/// Refuses two sets of one time that are not the same.
fn must_be_same(a: &Head, b: &Head) -> Result<()> {
    let (Some(x), Some(y), Some(from), Some(to)) = (&a.next, &b.next, &a.source, &b.source) else {
        return Ok(());
    };
    let what = if x.mark != y.mark {
        "their commit marks differ"
    } else if described(x, from)? != described(y, to)? {
        "their frames are described otherwise"
    } else {
        return Ok(());
    };
    Err(Error::new(
        ErrorKind::BadInput,
        format!(
            "set {} of {} and set {} of {} have the same time and are not the same ({what}): the inputs contradict \
             each other; `depthrig verify` each of them",
            x.mark.id,
            a.name(),
            y.mark.id,
            b.name()
        ),
    ))
}

/// The messages that describe a set; its images are in the mark by length and checksum.
fn described(set: &SetGroup, source: &Source) -> Result<Vec<(String, Vec<u8>)>> {
    let (Some(chunk), Some(offset)) = (set.chunks.last(), set.offsets.last()) else { return Ok(Vec::new()) };
    let mut messages = Vec::new();
    source.reader.chunk_messages(chunk.body(), *offset, |m| {
        let topic = source.preamble.channels.iter().find(|c| c.id == m.channel).map(|c| c.topic.clone());
        messages.push((topic.unwrap_or_default(), m.data.to_vec()));
        Ok(())
    })?;
    Ok(messages)
}
