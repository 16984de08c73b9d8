//! JPEG images of a recording, decoded by threads that are a few images ahead of the playing.
//!
//! Threads take turns, so images come back in their order. There are two images more than threads: while the oldest is
//! given out, its thread has its next one already. Nothing is allocated once each had the largest.

use super::cursor::Cursor;
use crate::recording::Recording;
use depthrig_bus::DropReason;
use depthrig_driver::{Error, ErrorKind, Result, unpack};
use std::collections::VecDeque;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

/// Threads at the most: four decode 4K at 30 Hz.
const MOST: usize = 4;

/// Images beyond one for each thread. With one the threads of two cores wait a tenth of their time, with two a
/// twentieth.
const WAITING: usize = 2;

/// An image on its way through a thread.
pub(super) struct Job {
    /// Bytes of it in the recording.
    jpeg: Vec<u8>,
    pub(super) pixels: Vec<u8>,
    pub(super) outcome: core::result::Result<(), DropReason>,
}

struct Worker {
    to: SyncSender<Job>,
    from: Receiver<Job>,
    thread: Option<JoinHandle<()>>,
}

/// Decodes ahead.
pub(super) struct Ahead {
    cursor: Cursor,
    track: usize,
    workers: Vec<Worker>,
    /// Who gets the next image, and who has the oldest.
    give: usize,
    head: usize,
    /// The times of the images in hand, the oldest first.
    at_us: VecDeque<u64>,
    spare: Vec<Job>,
    ended: bool,
}

impl Ahead {
    /// Decodes the images of `track`, of this size, out of `recording`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub(super) fn new(
        recording: Recording,
        looped: bool,
        track: usize,
        width: u32,
        height: u32,
    ) -> Result<Self> {
        let count = std::thread::available_parallelism().map_or(2, core::num::NonZero::get).clamp(1, MOST);
        let mut workers = Vec::new();
        for i in 0..count {
            let (to, jobs) = sync_channel::<Job>(WAITING);
            let (results, from) = sync_channel(WAITING);
            let work = move || {
                while let Ok(mut job) = jobs.recv() {
                    let span = unpack::jpeg_span(&job.jpeg);
                    job.outcome =
                        span.and_then(|jpeg| unpack::decode_jpeg(jpeg, width, height, &mut job.pixels));
                    if results.send(job).is_err() {
                        return;
                    }
                }
            };
            let thread =
                std::thread::Builder::new().name(format!("kinect-jpeg-{i}")).spawn(work).map_err(|e| {
                    Error::new(ErrorKind::Io, "no thread for decoding could be started").with_source(e)
                })?;
            workers.push(Worker { to, from, thread: Some(thread) });
        }
        let in_hand = count + WAITING;
        let job = || Job {
            jpeg: Vec::new(),
            pixels: vec![0; width as usize * height as usize * 3],
            outcome: Ok(()),
        };
        Ok(Self {
            cursor: Cursor::new(recording, looped),
            track,
            workers,
            give: 0,
            head: 0,
            at_us: VecDeque::with_capacity(in_hand),
            spare: core::iter::repeat_with(job).take(in_hand).collect(),
            ended: false,
        })
    }

    /// The time of the next image, after every thread was given what it can have in hand; `None` at the end.
    ///
    /// # Errors
    /// Those of reading the file.
    pub(super) fn peek(&mut self) -> Result<Option<u64>> {
        while !self.ended && !self.spare.is_empty() {
            let track = self.track;
            let Some(next) = self.cursor.next(|t| t == track)? else {
                self.ended = true;
                break;
            };
            let (Some(worker), Some(mut job)) = (self.workers.get(self.give), self.spare.pop()) else {
                break;
            };
            job.jpeg.clear();
            job.jpeg.extend_from_slice(self.cursor.recording.frames(&next.block).next().unwrap_or_default());
            worker.to.send(job).map_err(|_| died())?;
            self.at_us.push_back(next.at_us);
            self.give = (self.give + 1) % self.workers.len();
        }
        Ok(self.at_us.front().copied())
    }

    /// Hands the next image to `take`, waiting for it.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when a thread died.
    pub(super) fn take(&mut self, take: impl FnOnce(&Job)) -> Result<()> {
        let Some(worker) = self.workers.get(self.head) else { return Ok(()) };
        if self.at_us.pop_front().is_some() {
            let job = worker.from.recv().map_err(|_| died())?;
            take(&job);
            self.spare.push(job);
            self.head = (self.head + 1) % self.workers.len();
        }
        Ok(())
    }
}

fn died() -> Error {
    Error::new(ErrorKind::Protocol, "a thread that decodes the recording's images died")
}

impl Drop for Ahead {
    fn drop(&mut self) {
        for worker in self.workers.drain(..) {
            let Worker { to, from, thread, .. } = worker;
            drop((to, from));
            if let Some(thread) = thread {
                // It ends with its image.
                let _ = thread.join();
            }
        }
    }
}
