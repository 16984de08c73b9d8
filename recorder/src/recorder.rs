//! Writing a dataset while cameras run.
//!
//! Invariants: [`Recorder::push`] does a bounded amount of work and never waits for the disk or an encoder;
//! `offered = recorded + Σ dropped(reason)` once every set is settled; sets reach the file in the order in
//! which they were pushed; the file is touched by the writer thread alone.
//!
//! More than 500 lines, because creating, pushing, closing and abandoning keep these over one shared state.

use crate::container::pool::Pool;
use crate::frame::{PushError, RecordSet, SetDrop};
use crate::fs::{self, Fs};
use crate::msgs::{Diagnostic, SetCounts, StreamAccount};
use crate::{Episode, EpisodeCounts, EpisodeEnd, Error, ErrorKind, RecorderOptions, Result, Session};
use crossbeam::channel::{Sender, bounded};
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, UtcPair};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;

mod drops;
mod guard;
mod progress;
mod resume;
mod ticket;
pub(crate) mod topics;
mod worker;
mod writer;

use drops::DropLog;
pub use guard::DiskStatus;
pub use progress::{Progress, Summary};
use resume::Past;
pub use resume::Resumed;
use ticket::{Job, Load, Ticket};
use topics::{SampleNumber, Topics};
use writer::Writer;

/// The file that is deleted to make room for the index when the disk is full.
pub(crate) const RESERVE_FILE: &str = ".reserve";
/// Encoded sets that may wait to be written, beside the limit on their bytes.
const BACKLOG_MAX_SETS: usize = 4096;
/// Bytes of buffers that are kept for frames to come: two sets of seven cameras of 1280x720 that are not compressed.
const POOL_BYTES: usize = 64 << 20;
/// Notes that may wait for the writer.
const NOTES_MAX: usize = 256;

/// A dataset being recorded. Threads end with [`Recorder::finish`]; dropping it without that leaves the last
/// segment as `.part`, as a crash would.
pub struct Recorder {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    writer: Option<JoinHandle<Summary>>,
    /// The disk guard, and the sender that ends it when dropped.
    guard: Option<(Sender<()>, JoinHandle<()>)>,
}

/// Reads both clocks for a recording. Tests step its wall clock, a replay gives the times of its dataset.
pub type UtcSource = Arc<dyn Fn() -> UtcPair + Send + Sync>;

/// State shared between the threads.
struct Shared {
    fs: Arc<dyn Fs>,
    utc: UtcSource,
    dir: PathBuf,
    options: RecorderOptions,
    topics: Topics,
    state: Mutex<State>,
    load: Arc<Load>,
    pool: Arc<Pool>,
    /// The writer leaves the segment unfinished.
    abandoned: AtomicBool,
    /// Since when the writer waits for the disk, on the host's clock; 0 when it does not.
    io_since_ns: AtomicI64,
    /// Since when a sync beside the writer has not ended, as the writer knew last; 0 when none goes on.
    sync_since_ns: AtomicI64,
    /// Held while recording: locks the dataset against other processes.
    _lock: Option<Box<dyn Send + Sync>>,
}

/// The initial state of a recorder.
struct Begin {
    fs: Arc<dyn Fs>,
    utc: UtcSource,
    topics: Topics,
    free_bytes: u64,
    lock: Option<Box<dyn Send + Sync>>,
    segment: crate::container::segment::Segment,
    past: Past,
}

/// A locked dataset and what is in it.
struct Held {
    lock: Option<Box<dyn Send + Sync>>,
    past: Past,
}

struct State {
    counts: SetCounts,
    drops: DropLog,
    frames: u64,
    bytes: u64,
    segments: u32,
    last_id: Option<u64>,
    /// Number of the last batch of each IMU.
    last_batches: Vec<Option<u64>>,
    /// The last sample of each signal that had one.
    last_samples: Vec<Option<SampleNumber>>,
    /// Places the recording in UTC.
    anchor: Option<UtcPair>,
    last_log_time: i64,
    first_tick: Option<HostTime>,
    last_tick: Option<HostTime>,
    /// Why no more sets are taken.
    ended: Option<SetDrop>,
    error: Option<Arc<Error>>,
    /// Why the writer is to end the recording.
    end_because: Option<Error>,
    disk: DiskStatus,
    session: Session,
    session_changed: bool,
    pending_notes: Vec<crate::Note>,
    accounts: Vec<StreamAccount>,
    diagnostics: Option<Vec<Diagnostic>>,
    tickets: Option<Sender<Arc<Ticket>>>,
    jobs: Option<Sender<Job>>,
}

impl Recorder {
    /// Creates the dataset `dir` and starts to record into it.
    ///
    /// # Errors
    /// [`ErrorKind::AlreadyExists`] when `dir` holds anything, [`ErrorKind::PermissionDenied`] or
    /// [`ErrorKind::DiskFull`] when it cannot take a dataset, [`ErrorKind::BadInput`] when the session names
    /// no rig or no streams, [`ErrorKind::Io`] otherwise.
    pub fn create(fs: Arc<dyn Fs>, dir: &Path, session: Session, options: RecorderOptions) -> Result<Self> {
        Self::create_with(fs, Arc::new(UtcPair::sample), dir, session, options)
    }

    /// The same with another source of the clock pairs that are written each second.
    ///
    /// # Errors
    /// As [`Recorder::create`].
    pub fn create_with(
        fs: Arc<dyn Fs>,
        utc: UtcSource,
        dir: &Path,
        session: Session,
        options: RecorderOptions,
    ) -> Result<Self> {
        session.check()?;
        let topics = Topics::new(&session, &options);
        let free_bytes = prepare_folder(&*fs, dir, &options)?;
        let lock = lock_folder(&*fs, dir)?;
        let reserve = make_reserve(&*fs, dir, options.reserve_bytes)
            .and_then(|()| session.save(&*fs, dir))
            .and_then(|()| {
                let preamble = topics.preamble(&session, 0)?;
                crate::container::segment::Segment::create(&*fs, dir, 0, &preamble)
            });
        let segment = reserve.inspect_err(|_| {
            // Leave nothing behind that would make the next try say "there is a dataset already".
            for name in [RESERVE_FILE, crate::SESSION_FILE, crate::session::SESSION_TMP, "seg_0000.mcap.part"]
            {
                let _ = fs.remove_file(&dir.join(name));
            }
        })?;
        let begin = Begin { fs, utc, topics, free_bytes, lock, segment, past: Past::new(session) };
        Self::start(begin, dir, options)
    }

    /// Resumes the dataset `dir` whose recorder was killed, after the sets of its finished segments, which stay as they
    /// are. Unfinished segments are removed; their sets must be recorded again, with the same numbers. For sources that
    /// can repeat their sets; a live recording needs [`crate::recover`].
    ///
    /// # Errors
    /// [`ErrorKind::AlreadyExists`] when the dataset is complete, [`ErrorKind::InUse`] when another process uses it,
    /// [`ErrorKind::Corrupt`] when a finished segment cannot be read or is missing, and as [`Recorder::create`].
    pub fn resume(
        fs: Arc<dyn Fs>,
        utc: UtcSource,
        dir: &Path,
        options: RecorderOptions,
    ) -> Result<(Self, Resumed)> {
        let lock = lock_folder(&*fs, dir)?;
        let past = resume::past(&fs, dir)?;
        Self::go_on(fs, utc, dir, options, Held { lock, past })
    }

    /// Adds to a dataset that is finished, or was [recovered](crate::recover) after its recorder was killed. The next set must have a
    /// greater id and a later tick. For datasets that grow by the set, such as the views of a calibration.
    ///
    /// # Errors
    /// [`ErrorKind::Truncated`] when a segment is unfinished, and as [`Recorder::resume`].
    pub fn append(
        fs: Arc<dyn Fs>,
        utc: UtcSource,
        dir: &Path,
        options: RecorderOptions,
    ) -> Result<(Self, Resumed)> {
        let lock = lock_folder(&*fs, dir)?;
        let past = resume::all(&fs, dir)?;
        // From here on the dataset is unfinished again, also for one who looks after a crash.
        past.session.save(&*fs, dir)?;
        Self::go_on(fs, utc, dir, options, Held { lock, past })
    }

    fn go_on(
        fs: Arc<dyn Fs>,
        utc: UtcSource,
        dir: &Path,
        options: RecorderOptions,
        held: Held,
    ) -> Result<(Self, Resumed)> {
        let Held { lock, past } = held;
        let free_bytes = free_space(&*fs, dir, &options)?;
        let topics = Topics::new(&past.session, &options);
        make_reserve(&*fs, dir, options.reserve_bytes)?;
        let preamble = topics.preamble(&past.session, past.segments)?;
        let segment = crate::container::segment::Segment::create(&*fs, dir, past.segments, &preamble)?;
        let resumed = past.resumed();
        let begin = Begin { fs, utc, topics, free_bytes, lock, segment, past };
        Ok((Self::start(begin, dir, options)?, resumed))
    }

    fn start(begin: Begin, dir: &Path, options: RecorderOptions) -> Result<Self> {
        let Begin { fs, utc, topics, free_bytes, lock, segment, past } = begin;
        let session = past.session;
        let workers = options.workers.max(1);
        let queue_sets = options.queue_sets.max(1);
        let (jobs, job_queue) = bounded(queue_sets * session.streams.len());
        let (tickets, ticket_queue) = bounded(queue_sets + BACKLOG_MAX_SETS);
        let shared = Arc::new(Shared {
            fs,
            utc,
            dir: dir.to_owned(),
            options,
            topics,
            state: Mutex::new(State {
                counts: SetCounts { offered: past.sets, recorded: past.sets, ..SetCounts::default() },
                drops: DropLog::default(),
                frames: past.frames,
                bytes: past.bytes,
                segments: past.segments + 1,
                last_id: past.last_id,
                last_batches: past.last_batches,
                last_samples: past.last_samples,
                anchor: past.anchor,
                last_log_time: past.last_log_time,
                first_tick: past.first_tick,
                last_tick: past.last_tick,
                ended: None,
                error: None,
                end_because: None,
                disk: DiskStatus { free_bytes, ..DiskStatus::default() },
                session,
                session_changed: false,
                pending_notes: Vec::new(),
                accounts: Vec::new(),
                diagnostics: None,
                tickets: Some(tickets),
                jobs: Some(jobs),
            }),
            load: Arc::default(),
            pool: Pool::new(POOL_BYTES),
            abandoned: AtomicBool::new(false),
            io_since_ns: AtomicI64::new(0),
            sync_since_ns: AtomicI64::new(0),
            _lock: lock,
        });
        let mut recorder =
            Self { shared: Arc::clone(&shared), threads: Vec::new(), writer: None, guard: None };
        let no_thread = |e| Error::new(ErrorKind::Io, "cannot start a thread of the recorder").with_source(e);
        for i in 0..workers {
            let shared = Arc::clone(&shared);
            let queue = job_queue.clone();
            let thread = std::thread::Builder::new().name(format!("rec-enc-{i}"));
            let run = move || worker::run(&shared, &queue);
            recorder.threads.push(thread.spawn(run).map_err(no_thread)?);
        }
        let thread = std::thread::Builder::new().name("rec-write".into());
        let (stop, stopped) = bounded(0);
        let watched = Arc::clone(&shared);
        let guard = std::thread::Builder::new().name("rec-disk".into());
        let guard = guard.spawn(move || guard::run(&watched, &stopped)).map_err(no_thread)?;
        recorder.guard = Some((stop, guard));
        let writer = Writer::new(shared, ticket_queue, segment, past.segments);
        recorder.writer = Some(thread.spawn(move || writer.run()).map_err(no_thread)?);
        Ok(recorder)
    }

    /// Hands over a set. Never blocks: a set that finds no room is refused, counted, and the count goes into
    /// the file.
    ///
    /// # Errors
    /// The reason, as counted.
    pub fn push(&self, set: RecordSet) -> Result<(), PushError> {
        let mut state = self.shared.lock();
        state.counts.offered += 1;
        let id = set.id;
        let refused = |state: &mut State, reason: SetDrop, message: String| {
            state.drop_set(id, reason, &message);
            Err(PushError { reason, message: format!("set {id} was not recorded: {message}") })
        };
        if let Some(reason) = state.ended {
            let why = match &state.error {
                Some(e) => format!("the recording had ended: {e}"),
                None => "the recorder is being closed".to_owned(),
            };
            return refused(&mut state, reason, why);
        }
        if let Err(why) = self.shared.topics.check(&set, state.last_id, &state.last_batches) {
            return refused(&mut state, SetDrop::BadSet, why);
        }
        if let Err(why) = Topics::check_signals(&set.signals, &state.session.signals, &state.last_samples) {
            return refused(&mut state, SetDrop::BadSet, why);
        }
        let options = &self.shared.options;
        let load = &self.shared.load;
        let unencoded = load.unencoded.load(Ordering::Relaxed);
        if unencoded >= options.queue_sets.max(1) {
            let why = format!("{unencoded} sets wait to be encoded already");
            return refused(&mut state, SetDrop::EncoderBusy, why);
        }
        let backlog = load.backlog_bytes.load(Ordering::Relaxed);
        let slow = format!("the disk is too slow, {backlog} bytes wait to be written already");
        if backlog >= options.backlog_max_bytes {
            return refused(&mut state, SetDrop::DiskSlow, slow);
        }
        let (Some(tickets), Some(jobs)) = (state.tickets.clone(), state.jobs.clone()) else {
            return refused(&mut state, SetDrop::Ended, "the recorder is being closed".into());
        };

        let anchor = *state.anchor.get_or_insert(set.utc);
        // Strictly later than the set before, so that a log time names one set whatever the tick does.
        let log_time = anchor.utc_ns(set.tick).max(state.last_log_time.saturating_add(1)).max(0);
        let late_after_ns = options.late_after_ns;
        let (ticket, frames) = Ticket::new(set, &anchor, log_time, state.counts.offered, late_after_ns, load);
        let ticket = Arc::new(ticket);
        if tickets.try_send(Arc::clone(&ticket)).is_err() {
            load.backlog_bytes.fetch_sub(ticket.taken_bytes(), Ordering::Relaxed);
            return refused(&mut state, SetDrop::DiskSlow, slow);
        }
        state.last_id = Some(ticket.id);
        for batch in &ticket.motion {
            state.last_batches[batch.unit] = Some(batch.header.sequence);
        }
        let signals = state.session.signals.len();
        state.last_samples.resize(signals, None);
        for part in &ticket.signals {
            if let Some(last) = part.samples.last() {
                state.last_samples[part.signal] = Some((last.header().session, last.header().sequence));
            }
        }
        state.last_log_time = log_time;
        state.first_tick.get_or_insert(ticket.tick);
        state.last_tick = Some(ticket.tick);
        if !frames.is_empty() {
            load.unencoded.fetch_add(1, Ordering::Relaxed);
        }
        for (slot, frame) in frames.into_iter().enumerate() {
            // The queue has room for every frame of every set that `queue_sets` admits; a job that is dropped
            // all the same marks its slot as failed.
            drop(jobs.try_send(Job::new(Arc::clone(&ticket), slot, frame)));
        }
        Ok(())
    }

    /// Adds a signal that appeared after the recording began, and returns its index. The next set with a sample of it begins
    /// a segment, because a segment names its channels at its head.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a stream or signal has its name already, or the dataset lists as many as it can.
    pub fn add_signal(&self, signal: crate::SignalRecord) -> Result<usize> {
        let mut state = self.shared.lock();
        let index = state.session.add_signal(signal)?;
        state.session_changed = true;
        Ok(index)
    }

    /// Whether the next set would find room, for callers that would rather wait than lose one. True as well when it
    /// would be refused for good: waiting does not help then.
    pub fn has_room(&self) -> bool {
        let load = &self.shared.load;
        self.shared.lock().ended.is_some()
            || (load.unencoded.load(Ordering::Relaxed) < self.shared.options.queue_sets.max(1)
                && load.backlog_bytes.load(Ordering::Relaxed) < self.shared.options.backlog_max_bytes)
    }

    /// Adds a note of the operator, stamped now; it goes into the file and into `session.toml`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when it is longer than [`crate::NOTE_MAX_BYTES`], when the dataset is at its limit
    /// of notes, and when too many wait to be written.
    pub fn add_note(&self, text: impl Into<String>) -> Result<()> {
        let note = crate::Note { utc_ns: (self.shared.utc)().utc_ns, text: text.into() };
        let mut state = self.shared.lock();
        state.session.check_note(&note.text)?;
        if state.pending_notes.len() >= NOTES_MAX {
            let message = format!("{NOTES_MAX} notes wait to be written already; try again in a second");
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        state.pending_notes.push(note.clone());
        state.session.notes.push(note);
        state.session_changed = true;
        Ok(())
    }

    /// Begins an episode now; [`Self::finish`] ends one that runs.
    ///
    /// # Errors
    /// [`ErrorKind::InUse`] when one is running, [`ErrorKind::BadInput`] for a task that is too long and for too many episodes.
    pub fn start_episode(&self, task: &str) -> Result<Episode> {
        self.change_episode(|session, now| session.start_episode(task, now))
    }

    /// Ends the episode that runs.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when none is running.
    pub fn end_episode(&self, end: EpisodeEnd) -> Result<Episode> {
        self.change_episode(|session, now| session.end_episode(end, now))
    }

    /// Judges an episode, by default the last one that has ended. One that runs can only be discarded, which ends it; without a
    /// number it is the one that is discarded.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when it is unknown, [`ErrorKind::InUse`] when it runs.
    pub fn judge_episode(&self, number: Option<u32>, end: EpisodeEnd) -> Result<Episode> {
        self.change_episode(|session, now| match session.running().map(|e| e.number) {
            Some(n) if end == EpisodeEnd::Discarded && number.is_none_or(|number| number == n) => {
                session.end_episode(end, now)
            }
            Some(n) if number == Some(n) => {
                Err(Error::new(ErrorKind::InUse, format!("episode {n} is running; stop it first")))
            }
            _ => session.judge_episode(number, end),
        })
    }

    /// Its episodes so far.
    pub fn episodes(&self) -> Vec<Episode> {
        self.shared.lock().session.episodes.clone()
    }

    /// Changes an episode; the change is in `session.toml` within the second.
    fn change_episode(&self, change: impl FnOnce(&mut Session, i64) -> Result<Episode>) -> Result<Episode> {
        let mut state = self.shared.lock();
        // On the time axis of the sets, which a step of the wall clock does not move.
        let now = state.anchor.map_or_else(|| (self.shared.utc)().utc_ns, |a| a.utc_ns(HostTime::now()));
        let changed = change(&mut state.session, now)?;
        state.session_changed = true;
        Ok(changed)
    }

    /// Puts a table of facts into `session.toml`, in place of one of this name: what is known only at the end. It is
    /// written with the outcome.
    pub fn state(&self, name: &str, table: toml::Table) {
        self.shared.lock().session.extra.insert(name.to_owned(), table.into());
    }

    /// Hands over the present account of each stream; the last one given is written each second and at the
    /// end of each segment.
    pub fn update_accounts(&self, accounts: Vec<StreamAccount>) {
        self.shared.lock().accounts = accounts;
    }

    /// Hands over the state of the rig; the last one given is written each second, on `/diagnostics`.
    pub fn diagnostics(&self, statuses: Vec<Diagnostic>) {
        self.shared.lock().diagnostics = Some(statuses);
    }

    /// The dataset's folder.
    pub fn path(&self) -> &Path {
        &self.shared.dir
    }

    fn end_guard(&mut self) {
        if let Some((stop, guard)) = self.guard.take() {
            drop(stop);
            let _ = guard.join();
        }
    }

    /// How the recording stands.
    pub fn progress(&self) -> Progress {
        let s = self.shared.lock();
        Progress {
            sets: s.counts,
            frames: s.frames,
            bytes: s.bytes,
            segments: s.segments,
            encode_queue: self.shared.load.unencoded.load(Ordering::Relaxed),
            backlog_bytes: self.shared.load.backlog_bytes.load(Ordering::Relaxed),
            duration_ns: s.duration_ns(),
            disk: s.disk.clone(),
            episodes: EpisodeCounts::of(&s.session.episodes),
            error: s.error.clone(),
        }
    }

    /// Writes what was handed over, closes the dataset and says what it holds. A recording that had ended
    /// before its time is reported in [`Summary::lost`].
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the writer thread died, which is a defect of the recorder.
    pub fn finish(mut self) -> Result<Summary> {
        // None is running, mostly.
        let _ = self.end_episode(EpisodeEnd::Kept(None));
        self.shared.close();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        let writer = self.writer.take().map(JoinHandle::join);
        self.end_guard();
        match writer {
            Some(Ok(summary)) => Ok(summary),
            _ => Err(Error::new(
                ErrorKind::Io,
                format!("the writer of {} died; run `depthrig verify` on it", self.shared.dir.display()),
            )),
        }
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if self.writer.is_none() && self.threads.is_empty() {
            return;
        }
        self.shared.abandoned.store(true, Ordering::Release);
        self.shared.close();
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
        if let Some(writer) = self.writer.take() {
            let _ = writer.join();
        }
        self.end_guard();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Whether frames may go to the disk without being packed.
    fn disk_keeps_up(&self) -> bool {
        self.load.backlog_bytes.load(Ordering::Relaxed) < self.options.backlog_max_bytes / 4
    }

    /// Takes no more sets; the threads end when the queues are empty.
    fn close(&self) {
        let mut state = self.lock();
        state.ended.get_or_insert(SetDrop::Ended);
        state.tickets = None;
        state.jobs = None;
    }
}

impl State {
    /// Counts a set that is not recorded, and logs it unless its reason was logged just now.
    fn drop_set(&mut self, id: u64, reason: SetDrop, why: &str) {
        self.counts.dropped[reason as usize] += 1;
        if self.drops.add(reason, HostTime::now()) {
            tracing::error!(
                set = id,
                reason = reason.name(),
                "a frame set was not recorded: {why}; further ones are counted once a minute"
            );
        }
    }

    fn duration_ns(&self) -> i64 {
        self.last_tick.zip(self.first_tick).map_or(0, |(last, first)| last.since_ns(first))
    }
}

/// Creates the folder, or finds it empty, and checks that it can take a dataset; the bytes that are free there.
fn prepare_folder(fs: &dyn Fs, dir: &Path, options: &RecorderOptions) -> Result<u64> {
    match fs.read_dir(dir) {
        Ok(entries) => {
            let names: Vec<_> = entries.iter().map(|e| e.name.as_str()).collect();
            if names.contains(&crate::SESSION_FILE) {
                let message = format!("{} holds a dataset already; choose another name", dir.display());
                return Err(Error::new(ErrorKind::AlreadyExists, message));
            }
            if let Some(first) = names.first() {
                return Err(Error::new(
                    ErrorKind::AlreadyExists,
                    format!("{} is not empty (it holds {first}); choose a new folder", dir.display()),
                ));
            }
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            // A new folder is a name in its parent. Where that is new too, its own name must last as well, or a
            // power cut takes all that is below it; so look how far up folders are missing before creating them.
            let mut parents = Vec::new();
            for parent in dir.ancestors().skip(1) {
                parents.push(parent);
                // An empty path is the working folder, which exists.
                let missing = |e: std::io::Error| e.kind() == std::io::ErrorKind::NotFound;
                if parent.as_os_str().is_empty() || !fs.read_dir(parent).is_err_and(missing) {
                    break;
                }
            }
            fs.create_dir_all(dir).map_err(|e| Error::io("create the folder", dir, e))?;
            for parent in parents {
                fs.sync_dir(parent).map_err(|e| Error::io("sync the folder", parent, e))?;
            }
        }
        Err(e) => return Err(Error::io("use the folder", dir, e)),
    }
    free_space(fs, dir, options)
}

/// The bytes that are free in the folder, if they are enough to begin with.
fn free_space(fs: &dyn Fs, dir: &Path, options: &RecorderOptions) -> Result<u64> {
    let free = fs.available_space(dir).map_err(|e| Error::io("ask for the free space of", dir, e))?;
    let needed = options.min_free_bytes.saturating_add(options.reserve_bytes);
    if free < needed {
        return Err(Error::new(
            ErrorKind::DiskFull,
            format!(
                "{} has {} MB left, a recording stops at {} MB: free some space or record to another disk",
                dir.display(),
                free / 1_000_000,
                needed / 1_000_000
            ),
        ));
    }
    Ok(free)
}

/// Locks the dataset against a recovery. Without locks in the file system the recording goes on.
fn lock_folder(fs: &dyn Fs, dir: &Path) -> Result<Option<Box<dyn Send + Sync>>> {
    match fs.lock(dir) {
        Ok(lock) => Ok(Some(lock)),
        Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => Err(Error::new(
            ErrorKind::InUse,
            format!("{} is being recorded or recovered by somebody else; choose another name", dir.display()),
        )),
        Err(e) => {
            tracing::warn!(
                "{} cannot be locked: {e}; do not run `depthrig recover` on it now",
                dir.display()
            );
            Ok(None)
        }
    }
}

/// Writes real data into the reserve file, so that deleting it frees blocks.
fn make_reserve(fs: &dyn Fs, dir: &Path, bytes: u64) -> Result<()> {
    if bytes == 0 {
        return Ok(());
    }
    let path = dir.join(RESERVE_FILE);
    let write = || {
        let mut file = fs.create_new(&path)?;
        let mut left = bytes;
        while left > 0 {
            let n = left.min(1 << 20);
            fs::write_all(&mut *file, &vec![0; n as usize])?;
            left -= n;
        }
        file.sync_all()
    };
    write().map_err(|e| Error::io("write", &path, e))
}
