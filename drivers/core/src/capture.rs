//! One thread per camera: opens it, polls it, and can be given up when the device makes it hang.
//!
//! Whatever a device does, [`Capture::stop`] returns within its timeout. A thread that does not end by then
//! is *abandoned*: it is left behind, and if it ever wakes, nothing that it still holds is published.

use crate::clock::{CalibratedLatency, ClockQuality};
use crate::{DeviceInfo, Error, ErrorKind, FrameMeta, FrameSink, Loan, Poll, Result, Stream};
use core::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use core::time::Duration;
use depthrig_bus::sync::{lock, wait_timeout};
use depthrig_bus::{DropReason, HostTime};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;

/// How long one poll waits; also how late a stop request is noticed at the most.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);

/// Result of the opening step of a camera thread.
pub struct Session {
    /// Description of the device, as it reports it.
    pub info: DeviceInfo,
    /// The running device.
    pub stream: Box<dyn Stream>,
    /// Where its frames go.
    pub sink: Box<dyn FrameSink>,
}

/// How a camera thread came to its end by itself or on request.
#[derive(Debug)]
pub enum End {
    /// It was asked to stop.
    Stopped,
    /// The source has no more frames.
    Finished,
    /// The device failed.
    Failed(Error),
}

/// Outcome of [`Capture::stop`].
#[derive(Debug)]
pub enum StopOutcome {
    /// The thread is gone.
    Ended(End),
    /// The device made the thread hang; it was left behind and can no longer publish anything.
    Abandoned,
}

/// A running camera thread.
#[derive(Debug)]
pub struct Capture {
    name: String,
    thread: Option<JoinHandle<()>>,
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    stop: AtomicBool,
    abandoned: AtomicBool,
    heartbeat_ns: AtomicI64,
    last_frame_ns: AtomicI64,
    end: Mutex<Option<End>>,
    ended: Condvar,
}

impl Capture {
    /// Starts the thread `name`. `open` runs on it, and so may take as long as the device likes.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the system refuses a thread.
    pub fn spawn(name: &str, open: impl FnOnce() -> Result<Session> + Send + 'static) -> Result<Self> {
        let shared = Arc::new(Shared::default());
        shared.beat();
        let theirs = Arc::clone(&shared);
        let label = name.to_owned();
        let thread = std::thread::Builder::new()
            .name(format!("cam-{name}"))
            .spawn(move || {
                let end = catch_unwind(AssertUnwindSafe(|| run(open, &theirs))).unwrap_or_else(|panic| {
                    let what = panic
                        .downcast_ref::<String>()
                        .map(String::as_str)
                        .or_else(|| panic.downcast_ref::<&str>().copied())
                        .unwrap_or("no message");
                    End::Failed(Error::new(
                        ErrorKind::Protocol,
                        format!("{label}: the driver panicked: {what}"),
                    ))
                });
                *lock(&theirs.end) = Some(end);
                theirs.ended.notify_all();
            })
            .map_err(|e| {
                Error::new(ErrorKind::Io, format!("{name}: no thread for the camera could be started"))
                    .with_source(e)
            })?;
        Ok(Self { name: name.to_owned(), thread: Some(thread), shared })
    }

    /// The camera's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// When the thread last came back from the device.
    pub fn heartbeat(&self) -> HostTime {
        HostTime::from_ns(self.shared.heartbeat_ns.load(Ordering::Relaxed))
    }

    /// When a frame was last delivered or dropped, of a camera with images an image; `None` before the first.
    pub fn last_frame(&self) -> Option<HostTime> {
        match self.shared.last_frame_ns.load(Ordering::Relaxed) {
            0 => None,
            ns => Some(HostTime::from_ns(ns)),
        }
    }

    /// Whether the thread has come to its end.
    pub fn has_ended(&self) -> bool {
        lock(&self.shared.end).is_some()
    }

    /// Asks the thread to end, without waiting. Stop all cameras with this before [`Self::stop`] on each.
    pub fn request_stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }

    /// Ends the thread, waiting for at most `timeout`.
    pub fn stop(mut self, timeout: Duration) -> StopOutcome {
        self.request_stop();
        let deadline = HostTime::now().plus(timeout);
        let mut end = lock(&self.shared.end);
        while end.is_none() {
            let left = deadline.from_now();
            if left.is_zero() {
                // Set under the lock that commits of the thread take, so none can slip through.
                self.shared.abandoned.store(true, Ordering::SeqCst);
                return StopOutcome::Abandoned;
            }
            end = wait_timeout(&self.shared.ended, end, left);
        }
        let end = end.take().unwrap_or(End::Stopped);
        if let Some(thread) = self.thread.take() {
            // The thread has stored its end, so it is past all that could block or panic.
            let _ = thread.join();
        }
        StopOutcome::Ended(end)
    }
}

impl Drop for Capture {
    fn drop(&mut self) {
        self.request_stop();
    }
}

impl Shared {
    fn beat(&self) {
        self.heartbeat_ns.store(HostTime::now().ns(), Ordering::Relaxed);
    }
}

fn run(open: impl FnOnce() -> Result<Session>, shared: &Shared) -> End {
    let Session { mut stream, mut sink, .. } = match open() {
        Ok(session) => session,
        Err(e) => return End::Failed(e),
    };
    // Of a camera that has images these say whether it runs: its IMU talks on when it sends none.
    let has_images = stream.profiles().iter().any(|p| !p.format.is_motion());
    let counts = stream.profiles().iter().map(|p| !(has_images && p.format.is_motion())).collect();
    let mut guarded = Guarded { sink: sink.as_mut(), shared, counts };
    while !shared.stop.load(Ordering::Relaxed) {
        shared.beat();
        match stream.poll(POLL_TIMEOUT, &mut guarded) {
            Ok(Poll::Frame | Poll::Idle) => {}
            Ok(Poll::End) => return End::Finished,
            Err(e) => return End::Failed(e),
        }
    }
    End::Stopped
}

/// The sink of a camera thread: notes when frames come, and shuts when the thread was abandoned.
struct Guarded<'a> {
    sink: &'a mut dyn FrameSink,
    shared: &'a Shared,
    /// Of each stream whether its frames are a sign of life.
    counts: Vec<bool>,
}

impl Guarded<'_> {
    fn is_abandoned(&self) -> bool {
        self.shared.abandoned.load(Ordering::SeqCst)
    }

    fn note_frame(&self, stream: usize) {
        if self.counts.get(stream) == Some(&false) {
            return;
        }
        self.shared.last_frame_ns.store(HostTime::now().ns(), Ordering::Relaxed);
    }
}

impl FrameSink for Guarded<'_> {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        if self.is_abandoned() { None } else { self.sink.loan(stream, len) }
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        self.note_frame(stream);
        let _no_abandoning_meanwhile = lock(&self.shared.end);
        if self.is_abandoned() {
            self.sink.discard(stream);
            self.sink.dropped(stream, DropReason::Abandoned, 1);
        } else {
            self.sink.commit(stream, meta);
        }
    }

    fn discard(&mut self, stream: usize) {
        self.sink.discard(stream);
    }

    fn lend(&mut self, stream: usize, len: usize) -> Option<Loan> {
        if self.is_abandoned() { None } else { self.sink.lend(stream, len) }
    }

    fn commit_lent(&mut self, stream: usize, loan: Loan, meta: &FrameMeta) {
        self.note_frame(stream);
        let _no_abandoning_meanwhile = lock(&self.shared.end);
        if self.is_abandoned() {
            drop(loan);
            self.sink.dropped(stream, DropReason::Abandoned, 1);
        } else {
            self.sink.commit_lent(stream, loan, meta);
        }
    }

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        self.note_frame(stream);
        let reason = if self.is_abandoned() { DropReason::Abandoned } else { reason };
        self.sink.dropped(stream, reason, n);
    }

    fn superseded(&mut self, stream: usize, n: u64) {
        self.note_frame(stream);
        if self.is_abandoned() {
            self.sink.dropped(stream, DropReason::Abandoned, n);
        } else {
            self.sink.superseded(stream, n);
        }
    }

    fn captured(&mut self, stream: usize, n: u64) {
        self.sink.captured(stream, n);
    }

    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality) {
        self.sink.clock_quality(stream, quality);
    }

    fn calibrated_latency(&self, stream: usize) -> Option<CalibratedLatency> {
        self.sink.calibrated_latency(stream)
    }
}

#[cfg(test)]
mod tests;
