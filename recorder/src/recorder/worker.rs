//! The encode threads: they turn frames into chunks at a lower priority than capture has.

use super::Shared;
use super::ticket::Job;
use super::topics::image_channel;
use crate::encode::{Effort, FrameEncoder, FrameJob};
use crossbeam::channel::Receiver;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

/// Encoding yields to capture, but not so much that other work on the computer starves it: a set lost to a
/// compiler running beside is still a lost set.
const NICE: i32 = 2;

pub(super) fn run(shared: &Shared, queue: &Receiver<Job>) {
    // On Linux this is the calling thread. Failure is harmless: the thread keeps its priority.
    let _ = rustix::process::setpriority_process(None, NICE);
    let mut encoder = FrameEncoder::new(&shared.options, &shared.pool);
    while let Ok(job) = queue.recv() {
        let ticket = Arc::clone(job.ticket());
        let encode = AssertUnwindSafe(|| {
            job.run(|frame, effort| {
                let effort = if shared.disk_keeps_up() { effort } else { Effort::Full };
                let job = FrameJob {
                    channel: image_channel(frame.stream),
                    frame_id: shared.topics.frame_id(frame.stream),
                    log_time: u64::try_from(ticket.log_time).unwrap_or(0),
                    stamp_utc_ns: ticket.utc_ns(frame.header.capture_time_ns),
                    frame,
                };
                encoder.encode(job, effort)
            });
        });
        // An image that makes an encoder panic must cost one set, not the recording.
        if catch_unwind(encode).is_err() {
            encoder = FrameEncoder::new(&shared.options, &shared.pool);
            tracing::error!(set = ticket.id, "an encoder panicked; the set is lost");
        }
    }
}
