//! Pictures that are unpacked, and decoded on request: by worker threads, some at a time.

use crate::container::scan::SegmentReader;
use crate::dataset::check_stored;
use crate::encode::Codec;
use crossbeam::channel::{Receiver, Sender, bounded};
use depthrig_bus::FrameHeader;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};

/// A picture to be looked into.
pub(super) struct Job {
    /// Where its chunk begins.
    pub(super) offset: u64,
    pub(super) channel: u16,
    pub(super) log_time: u64,
    /// Length and CRC-32 of its message, as its set's mark says.
    pub(super) len: u64,
    pub(super) crc: u32,
    /// Its set and its stream, for the message.
    pub(super) set: u64,
    pub(super) stream: String,
    /// How to decode it, when that is wanted.
    pub(super) decode: Option<(Codec, Box<FrameHeader>)>,
}

/// What is wrong with a picture: its number in the order of the file, where its chunk is, what it is.
type Problem = (u64, u64, String);

/// Takes jobs: hands them to workers, or does them itself when there are none.
pub(super) struct Pictures<'a> {
    reader: &'a SegmentReader,
    queue: Option<Sender<(u64, Job)>>,
    problems: &'a Mutex<Vec<Problem>>,
    count: u64,
}

/// Runs `walk` with `threads` workers beside it; what it returns, and the problems in the order of the file.
pub(super) fn with_workers<R>(
    reader: &SegmentReader,
    threads: usize,
    walk: impl FnOnce(&mut Pictures<'_>) -> R,
) -> (R, Vec<(u64, String)>) {
    let problems = Mutex::new(Vec::new());
    let result = std::thread::scope(|scope| {
        let queue = (threads > 0).then(|| {
            // Jobs are small; two for each worker keep all of them busy.
            let (sender, receiver) = bounded(2 * threads);
            for _ in 0..threads {
                let (receiver, problems) = (receiver.clone(), &problems);
                scope.spawn(move || work(reader, &receiver, problems));
            }
            sender
        });
        walk(&mut Pictures { reader, queue, problems: &problems, count: 0 })
    });
    let mut problems = problems.into_inner().unwrap_or_else(PoisonError::into_inner);
    problems.sort_unstable();
    (result, problems.into_iter().map(|(_, offset, what)| (offset, what)).collect())
}

fn work(reader: &SegmentReader, queue: &Receiver<(u64, Job)>, problems: &Mutex<Vec<Problem>>) {
    let mut buf = Vec::new();
    while let Ok((number, job)) = queue.recv() {
        // The walk waits for room in the queue: a worker that is gone would leave it waiting.
        let checked = catch_unwind(AssertUnwindSafe(|| check(reader, &job, &mut buf)));
        note(problems, number, &job, checked.unwrap_or_else(|_| Some("its decoder panicked".to_owned())));
    }
}

fn note(problems: &Mutex<Vec<Problem>>, number: u64, job: &Job, problem: Option<String>) {
    if let Some(what) = problem {
        let what = format!("set {}: {}: {what}", job.set, job.stream);
        problems.lock().unwrap_or_else(PoisonError::into_inner).push((number, job.offset, what));
    }
}

impl Pictures<'_> {
    pub(super) fn look_into(&mut self, job: Job) {
        self.count += 1;
        let unsent = match &self.queue {
            // Waits while all workers are busy. No worker ends before the queue is closed.
            Some(queue) => queue.send((self.count, job)).err().map(|e| e.0.1),
            None => Some(job),
        };
        if let Some(job) = unsent {
            note(self.problems, self.count, &job, check(self.reader, &job, &mut Vec::new()));
        }
    }
}

/// What is wrong with a picture.
fn check(reader: &SegmentReader, job: &Job, buf: &mut Vec<u8>) -> Option<String> {
    let (mut found, mut problem) = (false, None);
    let read = reader.record_head(job.offset).and_then(|(_, len)| {
        reader.read_into(buf, job.offset + crate::container::scan::HEAD, len)?;
        reader.chunk_messages(buf, job.offset, |m| {
            if (m.channel, m.log_time) == (job.channel, job.log_time) && !found {
                found = true;
                if m.data.len() as u64 != job.len || crc32fast::hash(m.data) != job.crc {
                    problem = Some("its picture is another one".to_owned());
                } else if let Some((codec, header)) = &job.decode {
                    problem = check_stored(m.data, *codec, header).err().map(|e| e.to_string());
                }
            }
            Ok(())
        })
    });
    match read {
        Err(e) => Some(e.to_string()),
        Ok(()) if !found => Some("its picture is not in its chunk".to_owned()),
        Ok(()) => problem,
    }
}
