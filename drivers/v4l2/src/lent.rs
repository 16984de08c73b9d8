//! Streaming into the receiver's own memory (user pointers): the kernel writes each image into a loan, and no byte
//! of it is copied by this process.
//!
//! Several loans are out at once, one for each buffer of the queue. A loan that was filled is published and another
//! takes its place; one that was filled with a damaged image is handed to the kernel again.
#![allow(unsafe_code)] // Giving the kernel the address of memory to write into.

use super::ioctl::{self, Buffer, Memory, QueueKind};
use super::node::{Layout, Node};
use super::source::{Stamp, Unwrapped, wait};
use core::ptr::NonNull;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, FrameSink, Loan, Result};
use v4l::v4l_sys as sys;

/// An image that lies in a loan already.
#[derive(Debug, Clone, Copy)]
pub(super) struct Filled {
    pub(super) bytes: usize,
    pub(super) damaged: bool,
    pub(super) sequence: u64,
    pub(super) kernel_time: Option<HostTime>,
    pub(super) arrival: HostTime,
}

/// Why the kernel or the receiver cannot do it; the mapped path can.
pub(super) struct Refused {
    pub(super) why: String,
}

/// Callback that takes a filled loan of a queue, and gives it back when it was not published.
pub(super) type Take<'t> = dyn FnMut(usize, &Filled, Loan, &mut dyn FrameSink) -> Option<Loan> + 't;

/// The queues of one camera, one for each of its streams.
pub(super) struct LentSource {
    queues: Vec<LentQueue>,
    on: bool,
}

/// The queue of one node. The node comes first: fields are dropped in their order, and closing the node is what ends
/// the kernel's writing for certain.
struct LentQueue {
    node: Node,
    stream: usize,
    frame_bytes: usize,
    /// The loan that each buffer of the kernel writes into; `None` when there was no memory for it.
    slots: Vec<Option<Loan>>,
    sequence: Unwrapped,
    on: bool,
}

impl LentSource {
    /// Asks the driver of each node for `buffers` buffers in memory of ours. Each node comes with its layout and with
    /// the bytes of one frame as they are delivered.
    pub(super) fn new(nodes: Vec<(Node, Layout, usize)>, buffers: u32) -> Result<Self, Refused> {
        let mut queues = Vec::new();
        for (stream, (node, layout, frame_bytes)) in nodes.into_iter().enumerate() {
            if layout.size_image as usize != frame_bytes {
                let why = format!(
                    "{}: a buffer has {} bytes and a frame {frame_bytes}: rows are padded, or images are packed",
                    node.path().display(),
                    layout.size_image
                );
                return Err(Refused { why });
            }
            let given = ioctl::request_buffers(node.fd(), QueueKind::Video, Memory::UserPointer, buffers)
                .map_err(|e| Refused {
                    why: format!("{}: its driver takes no memory of ours ({e})", node.path().display()),
                })?;
            let slots = (0..given).map(|_| None).collect();
            queues.push(LentQueue {
                node,
                stream,
                frame_bytes,
                slots,
                sequence: Unwrapped::default(),
                on: false,
            });
        }
        Ok(Self { queues, on: false })
    }

    /// No queues at all.
    pub(super) const fn none() -> Self {
        Self { queues: Vec::new(), on: false }
    }

    /// Meaning of the stamps of stream `stream`.
    pub(super) fn stamp(&self, stream: usize) -> Stamp {
        let flags = self.queues.get(stream).and_then(|q| {
            ioctl::query_buffer(q.node.fd(), QueueKind::Video, Memory::UserPointer, 0).ok().map(|b| b.flags)
        });
        flags.map_or(Stamp::Unknown, Stamp::from_flags)
    }

    /// Hands memory of `sink` to every node and begins; once.
    pub(super) fn start(&mut self, sink: &mut dyn FrameSink) -> Result<(), Refused> {
        if self.on {
            return Ok(());
        }
        for queue in &mut self.queues {
            queue.refill(sink).map_err(|why| Refused { why })?;
            if queue.slots.iter().all(Option::is_none) {
                return Err(Refused { why: "the receiver lends no memory".to_owned() });
            }
        }
        for queue in &mut self.queues {
            ioctl::stream_on(queue.node.fd(), QueueKind::Video).map_err(|e| Refused {
                why: format!("{}: does not begin to stream ({e})", queue.node.path().display()),
            })?;
            queue.on = true;
        }
        self.on = true;
        Ok(())
    }

    /// Waits at most `timeout`, then gives every filled loan to `take`; whether there was one.
    pub(super) fn poll(
        &mut self,
        timeout: Duration,
        sink: &mut dyn FrameSink,
        take: &mut Take<'_>,
    ) -> Result<bool> {
        for queue in &mut self.queues {
            queue.refill(sink).map_err(|why| Error::new(ErrorKind::Io, why))?;
        }
        let ready = {
            let nodes: Vec<&Node> = self.queues.iter().map(|q| &q.node).collect();
            wait(&nodes, timeout)?
        };
        let mut any = false;
        for (index, failed) in ready {
            let Some(queue) = self.queues.get_mut(index) else { continue };
            let mut came = 0;
            while came < queue.slots.len() && queue.next(sink, take)? {
                came += 1;
            }
            any |= came > 0;
            if failed && came == 0 {
                let path = queue.node.path().display();
                return Err(Error::new(
                    ErrorKind::Io,
                    format!("{path}: the node reports an error; open it again"),
                ));
            }
        }
        Ok(any)
    }
}

impl LentQueue {
    /// Gives the kernel a loan for each of its buffers that has none, as far as `sink` has memory.
    fn refill(&mut self, sink: &mut dyn FrameSink) -> Result<(), String> {
        for index in 0..self.slots.len() {
            if self.slots.get(index).is_some_and(Option::is_some) {
                continue;
            }
            let Some(loan) = sink.lend(self.stream, self.frame_bytes) else { break };
            self.queue(index, loan)?;
        }
        Ok(())
    }

    fn queue(&mut self, index: usize, mut loan: Loan) -> Result<(), String> {
        let bytes = NonNull::from(loan.bytes_mut());
        let slot = self.slots.get_mut(index).ok_or("the driver has fewer buffers than it said")?;
        let loan = slot.insert(loan);
        debug_assert_eq!(NonNull::from(loan.bytes_mut()), bytes, "a loan stays where it is");
        // SAFETY: the loan lies in `slots`, untouched, until its buffer was dequeued (`next`); when the queue goes,
        // `drop` switches it off and the node closes, before `slots` are dropped.
        unsafe { ioctl::queue_user(self.node.fd(), index as u32, bytes) }.map_err(|e| {
            *slot = None;
            format!("{}: its driver does not take memory of ours ({e})", self.node.path().display())
        })
    }

    /// Gives the loan that was filled first to `take`; whether there was one.
    fn next(&mut self, sink: &mut dyn FrameSink, take: &mut Take<'_>) -> Result<bool> {
        let dequeued = ioctl::dequeue(self.node.fd(), QueueKind::Video, Memory::UserPointer)
            .map_err(|e| self.node.error("stopped streaming (VIDIOC_DQBUF)", e))?;
        let Some(buffer) = dequeued else { return Ok(false) };
        let filled = self.describe(&buffer);
        let Some(loan) = self.slots.get_mut(buffer.index as usize).and_then(Option::take) else {
            let path = self.node.path().display();
            let what = format!("{path}: its driver filled buffer {}, which it did not have", buffer.index);
            return Err(Error::new(ErrorKind::Protocol, what));
        };
        let free =
            take(self.stream, &filled, loan, sink).or_else(|| sink.lend(self.stream, self.frame_bytes));
        if let Some(free) = free {
            self.queue(buffer.index as usize, free).map_err(|why| Error::new(ErrorKind::Io, why))?;
        }
        Ok(true)
    }

    fn describe(&mut self, b: &Buffer) -> Filled {
        Filled {
            bytes: b.bytes_used as usize,
            damaged: b.flags & sys::V4L2_BUF_FLAG_ERROR != 0,
            sequence: self.sequence.next(b.sequence),
            kernel_time: (Stamp::from_flags(b.flags) != Stamp::Unknown)
                .then(|| HostTime::from_ns(b.stamp_ns)),
            arrival: HostTime::now(),
        }
    }
}

impl Drop for LentQueue {
    fn drop(&mut self) {
        // After an unplug the node refuses, and closing it, which comes next, stops the kernel all the same.
        if core::mem::take(&mut self.on)
            && let Err(e) = ioctl::stream_off(self.node.fd(), QueueKind::Video)
            && !super::error::is_gone(&e)
        {
            tracing::warn!(node = %self.node.path().display(), error = %e, "the node did not stop streaming");
        }
    }
}
