//! JPEG pictures of a recording, decoded by threads that are a few pictures ahead of the playing.
//!
//! Each thread has one picture in hand, and they take turns; so pictures come back in their order, memory is that of one
//! picture for each thread, and nothing is allocated once each had the largest.

use super::cursor::Cursor;
use crate::kinect::recording::Recording;
use crate::{Error, ErrorKind, Result, unpack};
use depthrig_bus::DropReason;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

/// Threads at the most: four decode 4K at 30 Hz.
const MOST: usize = 4;

/// A picture on its way through a thread.
pub(super) struct Job {
    pub(super) at_us: u64,
    /// Bytes of it in the recording.
    jpeg: Vec<u8>,
    pub(super) pixels: Vec<u8>,
    pub(super) outcome: core::result::Result<(), DropReason>,
}

struct Worker {
    to: SyncSender<Job>,
    from: Receiver<Job>,
    thread: Option<JoinHandle<()>>,
    /// Its picture, when it was decoded or not yet given out.
    done: Option<Job>,
    /// The time of the picture it has in hand.
    at_us: Option<u64>,
}

/// Decodes ahead.
pub(super) struct Ahead {
    cursor: Cursor,
    track: usize,
    workers: Vec<Worker>,
    /// Who has the oldest picture.
    head: usize,
    ended: bool,
}

impl Ahead {
    /// Decodes the pictures of `track`, of this size, out of `recording`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub(super) fn new(recording: Recording, looped: bool, track: usize, size: (u32, u32)) -> Result<Self> {
        let count = std::thread::available_parallelism().map_or(2, core::num::NonZero::get).clamp(1, MOST);
        let mut workers = Vec::new();
        for i in 0..count {
            let (to, jobs) = sync_channel::<Job>(1);
            let (results, from) = sync_channel(1);
            let work = move || {
                while let Ok(mut job) = jobs.recv() {
                    let span = unpack::jpeg_span(&job.jpeg);
                    job.outcome =
                        span.and_then(|jpeg| unpack::decode_jpeg(jpeg, size.0, size.1, &mut job.pixels));
                    if results.send(job).is_err() {
                        return;
                    }
                }
            };
            let thread =
                std::thread::Builder::new().name(format!("kinect-jpeg-{i}")).spawn(work).map_err(|e| {
                    Error::new(ErrorKind::Io, "no thread for decoding could be started").with_source(e)
                })?;
            let pixels = vec![0; size.0 as usize * size.1 as usize * 3];
            let done = Job { at_us: 0, jpeg: Vec::new(), pixels, outcome: Ok(()) };
            workers.push(Worker { to, from, thread: Some(thread), done: Some(done), at_us: None });
        }
        Ok(Self { cursor: Cursor::new(recording, looped), track, workers, head: 0, ended: false })
    }

    /// The time of the next picture, after every idle thread was given one; `None` at the end.
    ///
    /// # Errors
    /// Those of reading the file.
    pub(super) fn peek(&mut self) -> Result<Option<u64>> {
        let n = self.workers.len();
        for i in 0..n {
            let Some(worker) = self.workers.get_mut((self.head + i) % n) else { break };
            if worker.at_us.is_some() || self.ended {
                continue;
            }
            let track = self.track;
            let Some(next) = self.cursor.next(|t| t == track)? else {
                self.ended = true;
                break;
            };
            let Some(mut job) = worker.done.take() else { break };
            job.at_us = next.at_us;
            job.jpeg.clear();
            job.jpeg.extend_from_slice(self.cursor.recording.frames(&next.block).next().unwrap_or_default());
            worker.at_us = Some(next.at_us);
            worker.to.send(job).map_err(|_| died())?;
        }
        Ok(self.workers.get(self.head).and_then(|w| w.at_us))
    }

    /// Hands the next picture to `take`, waiting for it.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when a thread died.
    pub(super) fn take(&mut self, take: impl FnOnce(&Job)) -> Result<()> {
        let Some(worker) = self.workers.get_mut(self.head) else { return Ok(()) };
        if worker.at_us.take().is_some() {
            let job = worker.from.recv().map_err(|_| died())?;
            take(&job);
            worker.done = Some(job);
            self.head = (self.head + 1) % self.workers.len();
        }
        Ok(())
    }
}

fn died() -> Error {
    Error::new(ErrorKind::Protocol, "a thread that decodes the recording's pictures died")
}

impl Drop for Ahead {
    fn drop(&mut self) {
        for worker in self.workers.drain(..) {
            let Worker { to, from, thread, .. } = worker;
            drop((to, from));
            if let Some(thread) = thread {
                // It ends with its picture.
                let _ = thread.join();
            }
        }
    }
}
