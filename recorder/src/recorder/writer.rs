//! The writer thread: it alone owns the file.
//!
//! More than 500 lines, because everything that is written into a segment is one state of one thread.

use super::ticket::{Encoded, Ticket};
use super::topics::{Global, MOTION_CODEC, SEGMENT_METADATA, image_channel};
use super::{RESERVE_FILE, Shared, Summary};
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::container::segment::Segment;
use crate::encode::EncodedFrame;
use crate::frame::SetDrop;
use crate::msgs::frame_info::{self, Extra};
use crate::msgs::frame_set::{self, Checkpoint, FrameSetMsg, Member};
use crate::msgs::motion::{self, Imu};
use crate::msgs::signal::{self, SignalForm};
use crate::msgs::{accounts, diagnostics, image, tf};
use crate::{Error, Outcome, Result};
use core::time::Duration;
use crossbeam::channel::{Receiver, RecvTimeoutError};
use depthrig_bus::{HostTime, UtcPair};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// How long a count of dropped sets may wait until it is in the file.
const SAY_EVERY_NS: i64 = 100_000_000;
/// An operation that took this long was a stall of the disk.
const STALL_NS: i64 = 300_000_000;
/// Interval in which sets that waited for a stalled disk may be written late once: a permanently slow disk must not let
/// sets grow older and older.
const FORGIVE_EVERY_NS: i64 = 10_000_000_000;

/// The sets in the present segment so far.
#[derive(Default, Clone, Copy)]
struct Within {
    sets: u64,
    /// Ids of the first and the last set; 0 without one.
    first: u64,
    last: u64,
}

pub(super) struct Writer {
    shared: Arc<Shared>,
    tickets: Receiver<Arc<Ticket>>,
    segment: Option<Segment>,
    /// Index of the present segment, or of the next one.
    index: u32,
    /// The sets in the present segment, once it has its head chunk.
    in_segment: Option<Within>,
    builder: ChunkBuilder,
    /// Signals that the present segment names.
    signals: usize,
    sequence: u32,
    last_log_time: Option<i64>,
    next_sync: HostTime,
    /// Dropped sets as the file has them.
    said: u64,
    /// The next time to write them.
    next_say: HostTime,
    /// Sets with a tick before this are not late: the disk had stalled.
    forgiven: HostTime,
    /// When a stall may be forgiven again.
    next_forgiven: HostTime,
    /// Something was written that is not durable yet.
    dirty: bool,
    /// The recording ended before its time; nothing more is written.
    failed: bool,
    /// The segment being closed is the last one.
    ending: bool,
    unfinished: Vec<String>,
}

impl Writer {
    pub(super) fn new(
        shared: Arc<Shared>,
        tickets: Receiver<Arc<Ticket>>,
        segment: Segment,
        index: u32,
    ) -> Self {
        let mut state = shared.lock();
        state.bytes += segment.len();
        let signals = state.session.signals.len();
        drop(state);
        let now = HostTime::now();
        let next_sync = now.plus_ns(shared.options.sync_interval_ns);
        Self {
            shared,
            tickets,
            segment: Some(segment),
            index,
            in_segment: None,
            builder: ChunkBuilder::new(),
            signals,
            sequence: 0,
            last_log_time: None,
            next_sync,
            said: 0,
            next_say: now,
            forgiven: HostTime::from_ns(i64::MIN),
            next_forgiven: now,
            dirty: true,
            failed: false,
            ending: false,
            unfinished: Vec::new(),
        }
    }

    pub(super) fn run(mut self) -> Summary {
        loop {
            match self.tickets.recv_timeout(self.next_look().from_now()) {
                Ok(ticket) => self.take(&ticket),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            self.work_when_due();
        }
        if self.shared.abandoned.load(Ordering::Acquire) {
            self.try_io(|w| w.segment.as_mut().map_or(Ok(()), Segment::sync));
        } else {
            self.ending = true;
            self.try_io(Self::close_segment);
        }
        self.summary()
    }

    /// Waits for a set's frames and writes it, or counts it as dropped.
    fn take(&mut self, ticket: &Ticket) {
        let encoded = loop {
            let until = ticket.due.map_or(self.next_look(), |due| due.min(self.next_look()));
            if let Some(encoded) = ticket.wait(until.from_now()) {
                break encoded;
            }
            if ticket.is_late(HostTime::now()) {
                ticket.give_up();
            }
            self.work_when_due();
        };
        let bytes = ticket.taken_bytes();
        let late = ticket.is_late(HostTime::now()) && ticket.tick >= self.forgiven;
        let dropped = match encoded {
            _ if self.failed => Some((SetDrop::WriteFailed, "the recording had ended".to_owned())),
            Encoded::Late => {
                Some((SetDrop::EncoderBusy, "the encoders were behind, it had become too old".to_owned()))
            }
            Encoded::Failed(e) => Some((SetDrop::EncodeFailed, e.to_string())),
            Encoded::Frames(_) if late => {
                Some((SetDrop::DiskSlow, "the disk was behind, it had become too old".to_owned()))
            }
            Encoded::Frames(frames) => {
                let n = frames.len() as u64;
                self.try_io(|w| w.write_set(ticket, frames));
                if self.failed {
                    Some((SetDrop::WriteFailed, "the recording ended with it".to_owned()))
                } else {
                    let mut state = self.shared.lock();
                    state.counts.recorded += 1;
                    state.frames += n;
                    None
                }
            }
        };
        self.shared.load.backlog_bytes.fetch_sub(bytes, Ordering::Relaxed);
        if let Some((reason, why)) = dropped {
            self.shared.lock().drop_set(ticket.id, reason, &why);
            let live = self.shared.options.late_after_ns.is_some();
            if live && self.in_segment.is_none() && self.segment.is_some() {
                // The count needs a segment with a head to stand in.
                self.try_io(|w| w.begin_segment(ticket));
            }
        }
    }

    /// The next time of work besides sets.
    fn next_look(&self) -> HostTime {
        match self.shared.options.late_after_ns {
            Some(_) => self.next_sync.min(HostTime::now().plus_ns(SAY_EVERY_NS)),
            None => self.next_sync,
        }
    }

    fn work_when_due(&mut self) {
        self.say_drops_when_due();
        self.sync_when_due();
    }

    /// Writes how many sets were dropped soon after they were, so that a kill does not take the count.
    fn say_drops_when_due(&mut self) {
        if self.shared.options.late_after_ns.is_none() || self.next_say.from_now() > Duration::ZERO {
            return;
        }
        let Some(log_time) = self.last_log_time.filter(|_| self.in_segment.is_some()) else { return };
        if self.shared.lock().counts.dropped_total() == self.said {
            return;
        }
        self.next_say = HostTime::now().plus_ns(SAY_EVERY_NS);
        self.try_io(|w| {
            w.accounts(log_time);
            let chunk = w.builder.pack(true)?;
            w.append(&[chunk])
        });
    }

    /// Writes the head chunk of a segment before its first set.
    fn begin_segment(&mut self, ticket: &Ticket) -> Result<()> {
        let chunk = self.head_chunk(ticket)?;
        self.append(&[chunk])?;
        self.last_log_time = Some(ticket.log_time);
        self.in_segment = Some(Within::default());
        Ok(())
    }

    /// Writes a complete set: its images, then the chunk that describes them and ends in the commit mark.
    fn write_set(&mut self, ticket: &Ticket, frames: Vec<EncodedFrame>) -> Result<()> {
        let options = &self.shared.options;
        let full = self.segment.as_ref().is_some_and(|s| {
            let began = s.times().map_or(ticket.log_time, |(first, _)| first as i64);
            s.times().is_some()
                && (s.len() >= options.segment_max_bytes
                    || ticket.log_time.saturating_sub(began) >= options.segment_max_ns)
        });
        let unnamed = ticket.signals.iter().any(|s| s.signal >= self.signals);
        if full || (unnamed && self.segment.is_some()) {
            self.close_segment()?;
        }
        if unnamed {
            // Whoever reads the dataset after a crash finds there all signals of its segments.
            self.save_session_if_changed();
        }
        let mut chunks = Vec::with_capacity(frames.len() + 2);
        if self.in_segment.is_none() {
            chunks.push(self.head_chunk(ticket)?);
        }
        let commit = self.commit_chunk(ticket, &frames)?;
        chunks.extend(frames.into_iter().map(|f| f.chunk));
        chunks.push(commit);
        if self.segment.is_none() {
            self.open_segment()?;
        }
        self.append(&chunks)?;
        self.last_log_time = Some(ticket.log_time);
        let within = self.in_segment.unwrap_or_default();
        let first = if within.sets == 0 { ticket.id } else { within.first };
        self.in_segment = Some(Within { sets: within.sets + 1, first, last: ticket.id });
        Ok(())
    }

    fn open_segment(&mut self) -> Result<()> {
        let session = self.shared.lock().session.clone();
        self.signals = session.signals.len();
        let preamble = self.shared.topics.preamble(&session, self.index)?;
        let segment = Segment::create(&*self.shared.fs, &self.shared.dir, self.index, &preamble)?;
        let mut state = self.shared.lock();
        state.segments += 1;
        state.bytes += segment.len();
        drop(state);
        self.segment = Some(segment);
        Ok(())
    }

    fn append(&mut self, chunks: &[Chunk]) -> Result<()> {
        let Some(segment) = &mut self.segment else { return Ok(()) };
        let before = segment.len();
        segment.append_chunks(chunks)?;
        self.shared.lock().bytes += segment.len() - before;
        self.dirty = true;
        Ok(())
    }

    /// The messages that a segment has once, at the time of its first set.
    fn head_chunk(&mut self, ticket: &Ticket) -> Result<Chunk> {
        let session = self.shared.lock().session.clone();
        let log_time = ticket.log_time;
        self.message(Global::TfStatic, log_time, log_time, |b| {
            tf::write(b, log_time, &session);
        });
        self.clock_pair(log_time, ticket.utc_ns(ticket.utc.mono.ns()), &ticket.utc);
        self.builder.pack(true)
    }

    fn commit_chunk(&mut self, ticket: &Ticket, frames: &[EncodedFrame]) -> Result<Chunk> {
        let shared = Arc::clone(&self.shared);
        let topics = &shared.topics;
        let mut set = FrameSetMsg {
            stamp_utc_ns: ticket.log_time,
            id: ticket.id,
            tick_ns: ticket.tick.ns(),
            utc_offset_ns: ticket.utc_offset_ns,
            spread_ns: ticket.spread_ns,
            sets_offered: ticket.offered,
            members: Vec::with_capacity(frames.len()),
            missing: ticket.missing.iter().map(|s| topics.name(*s).to_owned()).collect(),
        };
        for ((stream, h), frame) in ticket.frames.iter().zip(frames) {
            let stamp_utc_ns = ticket.utc_ns(h.capture_time_ns);
            let frame_id = topics.frame_id(*stream);
            let extra = Extra { stamp_utc_ns, frame_id, codec: frame.codec.name() };
            let head = |channel| MessageHead {
                channel,
                sequence: h.sequence as u32,
                log_time: ticket.log_time as u64,
                publish_time: u64::try_from(stamp_utc_ns).unwrap_or(0),
            };
            let channel = image_channel(*stream);
            self.builder.message(head(channel + 1), |b| {
                image::write_camera_info(b, stamp_utc_ns, frame_id, h);
                Ok::<_, Error>(())
            })?;
            self.builder.message(head(channel + 2), |b| {
                frame_info::write(b, h, &extra);
                Ok::<_, Error>(())
            })?;
            set.members.push(Member {
                stream: topics.name(*stream).to_owned(),
                sequence: h.sequence,
                capture_time_ns: h.capture_time_ns,
                message_bytes: frame.message_bytes,
                message_crc32: frame.message_crc32,
            });
        }
        self.motion(ticket);
        self.signals(ticket);
        self.message(Global::FrameSet, ticket.log_time, ticket.log_time, |b| set.write(b));
        self.builder.pack(true)
    }

    /// Writes the IMU batches since the set before: each batch as its channel carried it, then its samples one by one.
    fn motion(&mut self, ticket: &Ticket) {
        let shared = Arc::clone(&self.shared);
        for batch in &ticket.motion {
            let h = &batch.header;
            let unit = shared.topics.unit(batch.unit);
            let stamp_utc_ns = ticket.utc_ns(h.capture_time_ns);
            let extra = Extra { stamp_utc_ns, frame_id: &unit.frame_id, codec: MOTION_CODEC };
            let head = |channel, sequence: u64, stamp_utc_ns: i64| MessageHead {
                channel,
                sequence: sequence as u32,
                log_time: ticket.log_time as u64,
                publish_time: u64::try_from(stamp_utc_ns).unwrap_or(0),
            };
            self.put(head(unit.channel, h.sequence, stamp_utc_ns), |b| frame_info::write(b, h, &extra));
            self.put(head(unit.channel + 1, h.sequence, stamp_utc_ns), |b| {
                motion::write_samples(b, stamp_utc_ns, h.sequence, &batch.samples);
            });
            for sample in &batch.samples {
                let imu = Imu::of(sample, ticket.utc_offset_ns);
                let head = head(unit.channel + 2, sample.sequence, imu.stamp_utc_ns);
                self.put(head, |b| imu.write(b, &unit.frame_id));
            }
        }
    }

    /// Writes the samples of signals since the set before: those of a publisher together, then one by one.
    fn signals(&mut self, ticket: &Ticket) {
        let shared = Arc::clone(&self.shared);
        for part in &ticket.signals {
            let Some(newest) = part.samples.last() else { continue };
            let form = SignalForm::of(newest.description());
            let channel = shared.topics.signal_channel(part.signal);
            let head = |channel, sequence: u64, stamp_utc_ns: i64| MessageHead {
                channel,
                sequence: sequence as u32,
                log_time: ticket.log_time as u64,
                publish_time: u64::try_from(stamp_utc_ns).unwrap_or(0),
            };
            let stamp_utc_ns = ticket.utc_ns(newest.header().time_ns);
            self.put(head(channel, newest.header().sequence, stamp_utc_ns), |b| {
                signal::write_samples(b, stamp_utc_ns, &part.samples);
            });
            for sample in &part.samples {
                let h = sample.header();
                let head = head(channel + 1, h.sequence, ticket.utc_ns(h.time_ns));
                self.put(head, |b| form.write(b, sample, ticket.utc_offset_ns));
            }
        }
    }

    fn message(&mut self, what: Global, log_time: i64, publish_time: i64, fill: impl FnOnce(&mut Vec<u8>)) {
        self.sequence = self.sequence.wrapping_add(1);
        let head = MessageHead {
            channel: what.channel(),
            sequence: self.sequence,
            log_time: log_time as u64,
            publish_time: u64::try_from(publish_time).unwrap_or(0),
        };
        self.put(head, fill);
    }

    fn put(&mut self, head: MessageHead, fill: impl FnOnce(&mut Vec<u8>)) {
        let filled = self.builder.message(head, |b| {
            fill(b);
            Ok::<_, std::convert::Infallible>(())
        });
        match filled {
            Ok(_) => {}
            Err(never) => match never {},
        }
    }

    fn clock_pair(&mut self, log_time: i64, stamp: i64, pair: &UtcPair) {
        self.message(Global::Clock, log_time, stamp, |b| frame_set::write_clock_pair(b, stamp, pair));
    }

    /// Writes the accounts of settled sets; sets still being encoded or written are not in them.
    fn accounts(&mut self, log_time: i64) {
        let state = self.shared.lock();
        let mut counts = state.counts;
        let streams = state.accounts.clone();
        drop(state);
        counts.offered = counts.recorded + counts.dropped_total();
        self.said = counts.dropped_total();
        self.message(Global::Accounts, log_time, log_time, |b| {
            accounts::write(b, log_time, &counts, &streams);
        });
    }

    fn sync_when_due(&mut self) {
        let end_because = self.shared.lock().end_because.take();
        if let Some(e) = end_because {
            self.end(e);
        }
        let now = HostTime::now();
        if now < self.next_sync {
            return;
        }
        self.next_sync = now.plus_ns(self.shared.options.sync_interval_ns.max(1_000_000));
        self.try_io(Self::each_second);
        let since = self.segment.as_ref().and_then(Segment::syncing_since);
        self.shared.sync_since_ns.store(since.map_or(0, HostTime::ns), Ordering::Relaxed);
        self.save_session_if_changed();
    }

    /// Clock, accounts, diagnostics and notes; then everything so far is made durable.
    fn each_second(&mut self) -> Result<()> {
        let Some(log_time) = self.last_log_time.filter(|_| self.in_segment.is_some()) else { return Ok(()) };
        self.between(log_time)?;
        if let Some(segment) = self.segment.as_mut().filter(|_| self.dirty)
            && segment.begin_sync()?
        {
            self.dirty = false;
        }
        Ok(())
    }

    /// The chunk between two sets, and before the end.
    fn between(&mut self, log_time: i64) -> Result<()> {
        let pair = (self.shared.utc)();
        self.clock_pair(log_time, pair.utc_ns, &pair);
        self.accounts(log_time);
        self.diagnostics_and_notes(log_time);
        if let Some((file_bytes, crc32)) = self.segment.as_ref().map(Segment::checkpoint) {
            let checkpoint = Checkpoint { file_bytes, crc32 };
            self.message(Global::Checkpoint, log_time, pair.utc_ns, |b| checkpoint.write(b, pair.utc_ns));
        }
        let chunk = self.builder.pack(true)?;
        self.append(&[chunk])
    }

    fn diagnostics_and_notes(&mut self, log_time: i64) {
        let mut state = self.shared.lock();
        let mut statuses = state.diagnostics.take().unwrap_or_default();
        let notes = std::mem::take(&mut state.pending_notes);
        if !statuses.is_empty() || state.disk.warning.is_some() {
            statuses.push(state.disk.diagnostic(&state.session.rig));
        }
        drop(state);
        if !statuses.is_empty() {
            self.message(Global::Diagnostics, log_time, log_time, |b| {
                diagnostics::write(b, log_time, &statuses);
            });
        }
        for note in notes {
            self.message(Global::Notes, log_time, note.utc_ns, |b| {
                diagnostics::write_note(b, note.utc_ns, &note.text);
            });
        }
    }

    /// Ends the present segment with its accounts and index, under its final name.
    fn close_segment(&mut self) -> Result<()> {
        if let Some(log_time) = self.last_log_time.filter(|_| self.in_segment.is_some()) {
            self.between(log_time)?;
        }
        self.finish_file()
    }

    fn finish_file(&mut self) -> Result<()> {
        let Some(mut segment) = self.segment.take() else { return Ok(()) };
        let within = self.in_segment.unwrap_or_default();
        let counts = self.shared.lock().counts;
        let mut facts = BTreeMap::from([
            ("segment".to_owned(), self.index.to_string()),
            ("sets".to_owned(), within.sets.to_string()),
            ("first_set".to_owned(), within.first.to_string()),
            ("last_set".to_owned(), within.last.to_string()),
            ("sets_recorded_so_far".to_owned(), counts.recorded.to_string()),
        ]);
        for (reason, n) in counts.dropped_by_reason() {
            facts.insert(format!("sets_dropped_{}", reason.name()), n.to_string());
        }
        if let Some(e) = &self.shared.lock().error {
            facts.insert("error".to_owned(), e.to_string());
        }
        if self.ending || self.failed {
            facts.insert("final".to_owned(), "true".to_owned());
        }
        let part = segment.part().display().to_string();
        let closed = segment.append_metadata(SEGMENT_METADATA, &facts).and_then(|()| segment.write_index());
        if let Err(e) = closed {
            if self.failed {
                self.unfinished.push(part);
            } else {
                // There may be room once the reserve is gone: `try_io` tries it again.
                self.segment = Some(segment);
            }
            return Err(e);
        }
        self.in_segment = None;
        self.index += 1;
        self.dirty = false;
        if let Err(e) = segment.publish(&*self.shared.fs) {
            self.unfinished.push(part);
            return Err(e);
        }
        Ok(())
    }

    /// Ends the recording while there is still room: closed as ever, with its last accounts and notes.
    fn end(&mut self, e: Error) {
        if self.failed {
            return;
        }
        self.ended_by(e);
        self.ending = true;
        self.try_io(Self::close_segment);
        self.failed = true;
        let _ = self.shared.fs.remove_file(&self.shared.dir.join(RESERVE_FILE));
    }

    fn ended_by(&self, e: Error) {
        tracing::error!(dataset = %self.shared.dir.display(), "the recording ended: {e}");
        let mut state = self.shared.lock();
        state.ended = Some(SetDrop::WriteFailed);
        // The first reason stays: what fails while the file is closed follows from it.
        state.error.get_or_insert_with(|| Arc::new(e));
    }

    /// Runs an operation on the file unless the recording has failed; its first failure ends the recording.
    fn try_io(&mut self, operation: impl FnOnce(&mut Self) -> Result<()>) {
        if self.failed {
            return;
        }
        let begun = HostTime::now();
        self.shared.io_since_ns.store(begun.ns(), Ordering::Relaxed);
        let done = operation(self);
        self.shared.io_since_ns.store(0, Ordering::Relaxed);
        let now = HostTime::now();
        if now.since_ns(begun) >= STALL_NS && now >= self.next_forgiven {
            self.forgiven = now;
            self.next_forgiven = now.plus_ns(FORGIVE_EVERY_NS);
        }
        let Err(e) = done else { return };
        self.failed = true;
        self.builder = ChunkBuilder::new();
        self.ended_by(e);
        // The reserve makes room for the index; what was cut back is a whole number of sets.
        let _ = self.shared.fs.remove_file(&self.shared.dir.join(RESERVE_FILE));
        if let Err(e) = self.finish_file() {
            tracing::error!(dataset = %self.shared.dir.display(), "its last segment is not finished: {e}");
        }
    }

    fn save_session_if_changed(&mut self) {
        let mut state = self.shared.lock();
        if !std::mem::take(&mut state.session_changed) {
            return;
        }
        let session = state.session.clone();
        drop(state);
        if let Err(e) = session.save(&*self.shared.fs, &self.shared.dir) {
            tracing::error!("the notes are not in session.toml yet: {e}");
            self.shared.lock().session_changed = true;
        }
    }

    /// Removes the reserve, writes the outcome into `session.toml` and reports.
    fn summary(mut self) -> Summary {
        let abandoned = self.shared.abandoned.load(Ordering::Acquire);
        let mut state = self.shared.lock();
        let mut lost: Vec<String> = Vec::new();
        if let Some(e) = &state.error {
            lost.push(format!("the recording ended before its time: {e}"));
        }
        let counts = state.counts;
        for (reason, n) in counts.dropped_by_reason() {
            lost.push(format!("{n} of {} sets were not recorded: {}", counts.offered, reason.name()));
        }
        for part in &self.unfinished {
            lost.push(format!("{part} could not be finished; `depthrig recover` repairs it"));
        }
        let ended = self.last_log_time.unwrap_or(state.session.started_utc_ns);
        state.session.outcome = Some(Outcome::new(ended, &counts, lost.clone()));
        let session = state.session.clone();
        drop(state);
        if !abandoned {
            let _ = self.shared.fs.remove_file(&self.shared.dir.join(RESERVE_FILE));
            if let Err(e) = session.save(&*self.shared.fs, &self.shared.dir) {
                tracing::error!("the outcome is not in session.toml: {e}");
                lost.push(format!("the outcome could not be written: {e}"));
            }
        }
        self.unfinished.clear();
        let state = self.shared.lock();
        Summary {
            path: self.shared.dir.clone(),
            sets: counts,
            frames: state.frames,
            bytes: state.bytes,
            segments: state.segments,
            duration_ns: state.duration_ns(),
            complete: lost.is_empty(),
            lost,
        }
    }
}
