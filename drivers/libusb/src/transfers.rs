//! Submitted bulk transfers, and the queue of their completions.
//!
//! `unsafe` because rusb has no asynchronous transfers; everything that touches libusb's raw interface is in this file.
//!
//! Who owns what:
//! - a [`Transfer`] is a `libusb_transfer` with its buffer and its [`Ticket`], three heap blocks whose addresses libusb
//!   holds from a successful submit until it has called [`completed`];
//! - `Transfer::pending` is true at least from before the submit until the thread that owns the [`TransferPool`] has
//!   read the event that `completed` posted. Only that thread submits, cancels, reads and frees, and it has
//!   `&mut TransferPool`;
//! - a transfer is read and freed only when it is not pending. One that is still pending when its pool is dropped is
//!   leaked with its buffer, its ticket and the open device, so that libusb and the kernel never hold a dangling
//!   address.
#![allow(unsafe_code)]

use super::camera::Inner;
use super::stream::{Completion, Status, Transfers};
use core::ffi::c_void;
use core::ptr::NonNull;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::sync::{lock, wait_timeout};
use rusb::constants;
use rusb::ffi::{self, libusb_transfer};
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex};

/// Something that a source has to attend to.
#[derive(Debug)]
pub(super) enum Event {
    /// A transfer completed, with or without success.
    Completed {
        /// Index of the stream.
        stream: usize,
        /// Index of the transfer in it.
        slot: usize,
        /// When.
        at: HostTime,
    },
    /// The endpoint of a stream was cleared and the stream committed anew, or not.
    Cleared {
        /// Index of the stream.
        stream: usize,
        /// How it went.
        result: rusb::Result<()>,
    },
}

/// Events from the event thread for the capture thread. Holds at most one event for each transfer and each stream,
/// because nothing posts a second one before the first was read.
#[derive(Debug, Default)]
pub(super) struct CompletionQueue {
    events: Mutex<VecDeque<Event>>,
    came: Condvar,
}

impl CompletionQueue {
    /// A queue with room for `events`.
    pub(super) fn new(events: usize) -> Arc<Self> {
        Arc::new(Self { events: Mutex::new(VecDeque::with_capacity(events)), came: Condvar::new() })
    }

    pub(super) fn post(&self, event: Event) {
        lock(&self.events).push_back(event);
        self.came.notify_one();
    }

    /// The oldest event, waiting for one until `deadline`.
    pub(super) fn next(&self, deadline: HostTime) -> Option<Event> {
        let mut events = lock(&self.events);
        loop {
            if let Some(event) = events.pop_front() {
                return Some(event);
            }
            let left = deadline.from_now();
            if left == Duration::ZERO {
                return None;
            }
            events = wait_timeout(&self.came, events, left);
        }
    }
}

/// Identifies a transfer in its completion event.
struct Ticket {
    queue: Arc<CompletionQueue>,
    stream: usize,
    slot: usize,
}

/// One transfer with the memory that it fills.
struct Transfer {
    raw: NonNull<libusb_transfer>,
    /// From `Box::into_raw`; `raw.buffer` points to its first byte.
    buffer: NonNull<[u8]>,
    /// From `Box::into_raw`; `raw.user_data` points to it.
    ticket: NonNull<Ticket>,
    pending: bool,
}

impl Transfer {
    fn new(ticket: Ticket, length: usize) -> Option<Self> {
        // SAFETY: no precondition; the result is checked for null.
        let raw = NonNull::new(unsafe { ffi::libusb_alloc_transfer(0) })?;
        // Leaked here and taken back in `drop`, so that no `Box` claims to be the only way to memory that libusb and
        // the kernel write to.
        let buffer = NonNull::from(Box::leak(vec![0; length].into_boxed_slice()));
        let ticket = NonNull::from(Box::leak(Box::new(ticket)));
        Some(Self { raw, buffer, ticket, pending: false })
    }
}

impl Drop for Transfer {
    fn drop(&mut self) {
        if self.pending {
            return; // leaked: libusb still has its addresses
        }
        // SAFETY: it is not pending, so libusb uses neither the transfer nor the buffer nor the ticket any more, and
        // the callback that read the ticket had copied what it needs before it posted the event after which `pending`
        // was cleared. Both boxes were leaked in `new` and are taken back once.
        unsafe {
            ffi::libusb_free_transfer(self.raw.as_ptr());
            drop(Box::from_raw(self.buffer.as_ptr()));
            drop(Box::from_raw(self.ticket.as_ptr()));
        }
    }
}

/// The transfers of one endpoint.
pub(super) struct TransferPool {
    transfers: Vec<Transfer>,
    endpoint: u8,
    /// Keeps the device open: declared after the transfers, and so dropped after them.
    camera: Arc<Inner>,
}

// SAFETY: the pointers are to memory that this pool alone owns; libusb's functions may be called on any thread
// (libusb's documentation, "Multi-threaded applications and asynchronous I/O"), and `CompletionQueue` and `Inner` are
// `Sync`.
unsafe impl Send for TransferPool {}

impl TransferPool {
    /// `count` transfers of `length` bytes from `endpoint` that post to `queue` as those of stream `stream`. `None`
    /// when memory runs out.
    pub(super) fn new(
        camera: Arc<Inner>,
        endpoint: u8,
        queue: &Arc<CompletionQueue>,
        stream: usize,
        count: usize,
        length: usize,
    ) -> Option<Self> {
        let transfer = |slot| Transfer::new(Ticket { queue: Arc::clone(queue), stream, slot }, length);
        Some(Self { transfers: (0..count).map(transfer).collect::<Option<_>>()?, endpoint, camera })
    }
}

impl Transfers for TransferPool {
    fn slots(&self) -> usize {
        self.transfers.len()
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        let Some(transfer) = self.transfers.get_mut(slot).filter(|t| !t.pending) else {
            return Err(rusb::Error::InvalidParam);
        };
        let length = i32::try_from(transfer.buffer.len()).map_err(|_| rusb::Error::InvalidParam)?;
        transfer.pending = true;
        // SAFETY: the transfer was not pending, so nobody else uses it; buffer, ticket and the device handle outlive
        // it as the module says. A time-out of 0 means no time-out. `completed` has the callback's signature.
        let result = unsafe {
            ffi::libusb_fill_bulk_transfer(
                transfer.raw.as_ptr(),
                self.camera.raw_handle(),
                self.endpoint,
                transfer.buffer.as_ptr().cast(),
                length,
                completed,
                transfer.ticket.as_ptr().cast::<c_void>(),
                0,
            );
            ffi::libusb_submit_transfer(transfer.raw.as_ptr())
        };
        match result {
            0 => Ok(()),
            code => {
                transfer.pending = false; // what was not accepted is not called back
                Err(error_of(code))
            }
        }
    }

    fn cancel(&mut self, slot: usize) {
        if let Some(transfer) = self.transfers.get(slot).filter(|t| t.pending) {
            // SAFETY: the transfer is allocated for as long as it is pending. One that has just ended is refused by
            // libusb, and its event is on the queue already.
            let _ = unsafe { ffi::libusb_cancel_transfer(transfer.raw.as_ptr()) };
        }
    }

    fn take_completed(&mut self, slot: usize) -> Option<Completion<'_>> {
        let transfer = self.transfers.get_mut(slot).filter(|t| t.pending)?;
        transfer.pending = false;
        // SAFETY: the event of its end was read under the queue's lock, so everything that libusb wrote happened
        // before, and libusb does not touch it again before the next submit, which needs `&mut self`.
        let (status, came) = unsafe {
            let raw = transfer.raw.as_ref();
            (raw.status, raw.actual_length)
        };
        let room = transfer.buffer.len();
        let came = usize::try_from(came).unwrap_or(0).min(room);
        // SAFETY: as above; `came` is at most the buffer's length, and the borrow of `self` keeps it from being
        // submitted or freed while the bytes are looked at.
        let bytes = unsafe { core::slice::from_raw_parts(transfer.buffer.as_ptr().cast::<u8>(), came) };
        Some(Completion { status: status_of(status), bytes, short: came < room })
    }
}

impl Drop for TransferPool {
    fn drop(&mut self) {
        let lost = self.transfers.iter().filter(|t| t.pending).count();
        if lost > 0 {
            tracing::error!(
                camera = self.camera.label(),
                transfers = lost,
                "transfers did not come back from the kernel; their memory and the open camera stay until this process ends"
            );
            core::mem::forget(Arc::clone(&self.camera));
        }
    }
}

/// Called by libusb on the thread that handles its events when a transfer has completed.
extern "system" fn completed(transfer: *mut libusb_transfer) {
    let at = HostTime::now();
    // SAFETY: libusb passes the transfer that was submitted, whose `user_data` is its ticket; neither is freed before
    // the event that is posted below was read. From that moment on both may be gone, so what `post` needs is copied:
    // the queue too, because the ticket's reference could be the last one.
    let (queue, stream, slot) = unsafe {
        let ticket = &*(*transfer).user_data.cast::<Ticket>();
        (Arc::clone(&ticket.queue), ticket.stream, ticket.slot)
    };
    queue.post(Event::Completed { stream, slot, at });
}

const fn status_of(status: i32) -> Status {
    match status {
        constants::LIBUSB_TRANSFER_COMPLETED => Status::Completed,
        constants::LIBUSB_TRANSFER_CANCELLED => Status::Cancelled,
        constants::LIBUSB_TRANSFER_STALL => Status::Stalled,
        constants::LIBUSB_TRANSFER_NO_DEVICE => Status::Gone,
        constants::LIBUSB_TRANSFER_OVERFLOW => Status::Overflow,
        _ => Status::Failed,
    }
}

const fn error_of(code: i32) -> rusb::Error {
    match code {
        constants::LIBUSB_ERROR_NO_DEVICE => rusb::Error::NoDevice,
        constants::LIBUSB_ERROR_NO_MEM => rusb::Error::NoMem,
        constants::LIBUSB_ERROR_BUSY => rusb::Error::Busy,
        constants::LIBUSB_ERROR_PIPE => rusb::Error::Pipe,
        constants::LIBUSB_ERROR_INVALID_PARAM => rusb::Error::InvalidParam,
        constants::LIBUSB_ERROR_NOT_SUPPORTED => rusb::Error::NotSupported,
        _ => rusb::Error::Io,
    }
}
