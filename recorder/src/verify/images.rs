//! Checks images by unpacking, and decoding on request, on worker threads.

use crate::container::scan::SegmentReader;
use crate::dataset::check_stored;
use crate::encode::Codec;
use crossbeam::channel::{Receiver, Sender, bounded};
use depthrig_bus::FrameHeader;
use depthrig_bus::sync::lock;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};

/// An image to check.
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
    /// How to decode it, if requested.
    pub(super) decode: Option<(Codec, Box<FrameHeader>)>,
}

/// A damaged image; sorted in the order of the file.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct DamagedImage {
    number: u64,
    /// Where its chunk begins.
    pub(super) offset: u64,
    pub(super) message: String,
}

/// Takes jobs: hands them to workers, or does them itself without workers.
pub(super) struct Images<'a> {
    reader: &'a SegmentReader,
    queue: Option<Sender<(u64, Job)>>,
    damaged: &'a Mutex<Vec<DamagedImage>>,
    count: u64,
}

/// Runs `walk` with `threads` workers beside it; returns its result, and the damaged images in the order of the file.
pub(super) fn with_workers<R>(
    reader: &SegmentReader,
    threads: usize,
    walk: impl FnOnce(&mut Images<'_>) -> R,
) -> (R, Vec<DamagedImage>) {
    let damaged = Mutex::new(Vec::new());
    let result = std::thread::scope(|scope| {
        let queue = (threads > 0).then(|| {
            // Jobs are small; two for each worker keep all of them busy.
            let (sender, receiver) = bounded(2 * threads);
            for _ in 0..threads {
                let receiver = receiver.clone();
                let damaged = &damaged;
                scope.spawn(move || work(reader, &receiver, damaged));
            }
            sender
        });
        walk(&mut Images { reader, queue, damaged: &damaged, count: 0 })
    });
    let mut damaged = damaged.into_inner().unwrap_or_else(PoisonError::into_inner);
    damaged.sort_unstable();
    (result, damaged)
}

fn work(reader: &SegmentReader, queue: &Receiver<(u64, Job)>, damaged: &Mutex<Vec<DamagedImage>>) {
    let mut buf = Vec::new();
    while let Ok((number, job)) = queue.recv() {
        // The walk waits for room in the queue: a worker that is gone would leave it waiting.
        let checked = catch_unwind(AssertUnwindSafe(|| check(reader, &job, &mut buf)));
        note(damaged, number, &job, checked.unwrap_or_else(|_| Some("its decoder panicked".to_owned())));
    }
}

fn note(damaged: &Mutex<Vec<DamagedImage>>, number: u64, job: &Job, damage: Option<String>) {
    if let Some(damage) = damage {
        let message = format!("set {}: {}: {damage}", job.set, job.stream);
        let image = DamagedImage { number, offset: job.offset, message };
        lock(damaged).push(image);
    }
}

impl Images<'_> {
    pub(super) fn look_into(&mut self, job: Job) {
        self.count += 1;
        let unsent = match &self.queue {
            // Waits while all workers are busy. No worker ends before the queue is closed.
            Some(queue) => queue.send((self.count, job)).err().map(|e| e.0.1),
            None => Some(job),
        };
        if let Some(job) = unsent {
            note(self.damaged, self.count, &job, check(self.reader, &job, &mut Vec::new()));
        }
    }
}

/// Checks an image; the damage in words.
fn check(reader: &SegmentReader, job: &Job, buf: &mut Vec<u8>) -> Option<String> {
    let mut found = false;
    let mut problem = None;
    let read = reader.record_head(job.offset).and_then(|(_, len)| {
        reader.read_into(buf, job.offset + crate::container::scan::HEAD, len)?;
        reader.chunk_messages(buf, job.offset, |m| {
            if (m.channel, m.log_time) == (job.channel, job.log_time) && !found {
                found = true;
                if m.data.len() as u64 != job.len || crc32fast::hash(m.data) != job.crc {
                    problem = Some("its image is another one".to_owned());
                } else if let Some((codec, header)) = &job.decode {
                    problem = check_stored(m.data, *codec, header).err().map(|e| e.to_string());
                }
            }
            Ok(())
        })
    });
    match read {
        Err(e) => Some(e.to_string()),
        Ok(()) if !found => Some("its image is not in its chunk".to_owned()),
        Ok(()) => problem,
    }
}
