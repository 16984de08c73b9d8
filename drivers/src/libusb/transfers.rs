//! Bulk transfers under way, and the board on which their ends are posted.
//!
//! `unsafe` because rusb has no asynchronous transfers; everything that touches libusb's raw interface is in this file.
//!
//! Who owns what:
//! - a [`Flight`] is a transfer with its buffer and its [`Ticket`], three blocks of the heap whose addresses libusb
//!   holds from a successful submit until it has called [`landed`];
//! - `Flight::flying` is true at least from before the submit until the thread that owns the [`Pool`] has read the
//!   event that `landed` posted. Only that thread submits, cancels, reads and frees, and it has `&mut Pool`;
//! - a flight is read and freed only when it does not fly. One that is still flying when its pool is dropped is leaked
//!   with its buffer, its ticket and the open device, so that libusb and the kernel never hold a dangling address.
#![allow(unsafe_code)]

use super::camera::Inner;
use super::stream::{Landing, Lane, Status};
use core::ffi::c_void;
use core::ptr::NonNull;
use core::time::Duration;
use depthrig_bus::HostTime;
use rusb::constants;
use rusb::ffi::{self, libusb_transfer};
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};

/// Something that a source has to attend to.
#[derive(Debug)]
pub(super) enum Event {
    /// A transfer came to its end.
    Landed {
        /// Index of the stream.
        stream: usize,
        /// Index of the transfer in it.
        slot: usize,
        /// When.
        at: HostTime,
    },
    /// The end point of a stream was cleared and the stream committed anew, or not.
    Cleared {
        /// Index of the stream.
        stream: usize,
        /// How it went.
        result: rusb::Result<()>,
    },
}

/// Where the event thread tells the capture thread what happened. Holds at most one event for each transfer and each
/// stream, because nothing posts a second before the first was read.
#[derive(Debug, Default)]
pub(super) struct Board {
    events: Mutex<VecDeque<Event>>,
    came: Condvar,
}

impl Board {
    /// A board with room for `events`.
    pub(super) fn new(events: usize) -> Arc<Self> {
        Arc::new(Self { events: Mutex::new(VecDeque::with_capacity(events)), came: Condvar::new() })
    }

    pub(super) fn post(&self, event: Event) {
        self.events.lock().unwrap_or_else(PoisonError::into_inner).push_back(event);
        self.came.notify_one();
    }

    /// The oldest event, waiting for one until `deadline`.
    pub(super) fn next(&self, deadline: HostTime) -> Option<Event> {
        let mut events = self.events.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(event) = events.pop_front() {
                return Some(event);
            }
            let left = deadline.from_now();
            if left == Duration::ZERO {
                return None;
            }
            events = self.came.wait_timeout(events, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// What a transfer's end is posted with.
struct Ticket {
    board: Arc<Board>,
    stream: usize,
    slot: usize,
}

/// One transfer with the memory that it fills.
struct Flight {
    transfer: NonNull<libusb_transfer>,
    /// From `Box::into_raw`; `transfer.buffer` points to its first byte.
    buffer: NonNull<[u8]>,
    /// From `Box::into_raw`; `transfer.user_data` points to it.
    ticket: NonNull<Ticket>,
    flying: bool,
}

impl Flight {
    fn new(ticket: Ticket, length: usize) -> Option<Self> {
        // SAFETY: no precondition; the result is checked for null.
        let transfer = NonNull::new(unsafe { ffi::libusb_alloc_transfer(0) })?;
        // Leaked here and taken back in `drop`, so that no `Box` claims to be the only way to memory that libusb and
        // the kernel write to.
        let buffer = NonNull::from(Box::leak(vec![0; length].into_boxed_slice()));
        let ticket = NonNull::from(Box::leak(Box::new(ticket)));
        Some(Self { transfer, buffer, ticket, flying: false })
    }
}

impl Drop for Flight {
    fn drop(&mut self) {
        if self.flying {
            return; // leaked: libusb still has its addresses
        }
        // SAFETY: it does not fly, so libusb uses neither the transfer nor the buffer nor the ticket any more, and
        // the callback that read the ticket had copied what it needs before it posted the event that grounded the
        // flight. Both boxes were leaked in `new` and are taken back once.
        unsafe {
            ffi::libusb_free_transfer(self.transfer.as_ptr());
            drop(Box::from_raw(self.buffer.as_ptr()));
            drop(Box::from_raw(self.ticket.as_ptr()));
        }
    }
}

/// The transfers of one end point.
pub(super) struct Pool {
    flights: Vec<Flight>,
    endpoint: u8,
    /// Keeps the device open: declared behind the flights, and so dropped after them.
    camera: Arc<Inner>,
}

// SAFETY: the pointers are to memory that this pool alone owns; libusb's functions may be called on any thread
// (libusb's documentation, "Multi-threaded applications and asynchronous I/O"), and `Board` and `Inner` are `Sync`.
unsafe impl Send for Pool {}

impl Pool {
    /// `count` transfers of `length` bytes from `endpoint` that post to `board` as those of stream `stream`. `None`
    /// when there is no memory.
    pub(super) fn new(
        camera: Arc<Inner>,
        endpoint: u8,
        board: &Arc<Board>,
        stream: usize,
        count: usize,
        length: usize,
    ) -> Option<Self> {
        let flight = |slot| Flight::new(Ticket { board: Arc::clone(board), stream, slot }, length);
        Some(Self { flights: (0..count).map(flight).collect::<Option<_>>()?, endpoint, camera })
    }
}

impl Lane for Pool {
    fn slots(&self) -> usize {
        self.flights.len()
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        let Some(flight) = self.flights.get_mut(slot).filter(|f| !f.flying) else {
            return Err(rusb::Error::InvalidParam);
        };
        let length = i32::try_from(flight.buffer.len()).map_err(|_| rusb::Error::InvalidParam)?;
        flight.flying = true;
        // SAFETY: the flight did not fly, so nobody else uses the transfer; buffer, ticket and the device handle
        // outlive the flight as the module says. A time-out of 0 is none. `landed` has the callback's signature.
        let result = unsafe {
            ffi::libusb_fill_bulk_transfer(
                flight.transfer.as_ptr(),
                self.camera.raw_handle(),
                self.endpoint,
                flight.buffer.as_ptr().cast(),
                length,
                landed,
                flight.ticket.as_ptr().cast::<c_void>(),
                0,
            );
            ffi::libusb_submit_transfer(flight.transfer.as_ptr())
        };
        match result {
            0 => Ok(()),
            code => {
                flight.flying = false; // what was not accepted is not called back
                Err(error_of(code))
            }
        }
    }

    fn cancel(&mut self, slot: usize) {
        if let Some(flight) = self.flights.get(slot).filter(|f| f.flying) {
            // SAFETY: the transfer is allocated for as long as it flies. One that has just ended is refused by
            // libusb, and its event is on the board already.
            let _ = unsafe { ffi::libusb_cancel_transfer(flight.transfer.as_ptr()) };
        }
    }

    fn land(&mut self, slot: usize) -> Option<Landing<'_>> {
        let flight = self.flights.get_mut(slot).filter(|f| f.flying)?;
        flight.flying = false;
        // SAFETY: the event of its end was read under the board's lock, so everything that libusb wrote happened
        // before, and libusb does not touch it again before the next submit, which needs `&mut self`.
        let (status, came) = unsafe {
            let transfer = flight.transfer.as_ref();
            (transfer.status, transfer.actual_length)
        };
        let room = flight.buffer.len();
        let came = usize::try_from(came).unwrap_or(0).min(room);
        // SAFETY: as above; `came` is at most the buffer's length, and the borrow of `self` keeps it from being
        // submitted or freed while the bytes are looked at.
        let bytes = unsafe { core::slice::from_raw_parts(flight.buffer.as_ptr().cast::<u8>(), came) };
        Some(Landing { status: status_of(status), bytes, short: came < room })
    }
}

impl Drop for Pool {
    fn drop(&mut self) {
        let lost = self.flights.iter().filter(|f| f.flying).count();
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

/// libusb calls this on whichever thread handles its events when a transfer has come to its end.
extern "system" fn landed(transfer: *mut libusb_transfer) {
    let at = HostTime::now();
    // SAFETY: libusb passes the transfer that was submitted, whose `user_data` is its ticket; neither is freed before
    // the event that is posted below was read. From that moment on both may be gone, so what `post` needs is copied:
    // the board too, because the ticket's reference could be the last one.
    let (board, stream, slot) = unsafe {
        let ticket = &*(*transfer).user_data.cast::<Ticket>();
        (Arc::clone(&ticket.board), ticket.stream, ticket.slot)
    };
    board.post(Event::Landed { stream, slot, at });
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
