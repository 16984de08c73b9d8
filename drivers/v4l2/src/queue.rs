//! The buffers of one node: mapped from the kernel, filled by it, looked at, and handed back.
#![allow(unsafe_code)] // Mapping memory that the kernel writes into.

use super::ioctl::{self, Buffer, Memory, QueueKind};
use super::node::Node;
use core::ptr::NonNull;
use depthrig_driver::{Error, ErrorKind, Result};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use std::io;
use std::os::fd::BorrowedFd;

/// A mapped buffer of the kernel.
struct Mapping {
    at: NonNull<core::ffi::c_void>,
    length: usize,
}

// SAFETY: the mapping belongs to the process, not to a thread; `Mapping` alone has its address.
unsafe impl Send for Mapping {}

impl Mapping {
    fn new(node: &Node, buffer: &Buffer) -> io::Result<Self> {
        let length = buffer.length as usize;
        // SAFETY: the node is open for longer than this borrow.
        let fd = unsafe { BorrowedFd::borrow_raw(node.fd()) };
        // SAFETY: a new mapping at an address of the kernel's choice touches no memory of ours.
        let at = unsafe {
            mmap(core::ptr::null_mut(), length, ProtFlags::READ, MapFlags::SHARED, fd, buffer.offset.into())
        }?;
        let at = NonNull::new(at).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { at, length })
    }

    /// The first `used` bytes.
    ///
    /// # Safety
    /// The buffer was dequeued, and is not queued again while the slice lives.
    unsafe fn bytes(&self, used: u32) -> &[u8] {
        let length = (used as usize).min(self.length);
        // SAFETY: `length` bytes are mapped for reading as long as `self` lives, and the kernel leaves a dequeued
        // buffer alone.
        unsafe { core::slice::from_raw_parts(self.at.as_ptr().cast(), length) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `new` with this length; slices of it borrowed `self` and are gone.
        if let Err(e) = unsafe { munmap(self.at.as_ptr(), self.length) } {
            tracing::warn!(error = %e, "a buffer of the kernel could not be unmapped");
        }
    }
}

/// The mapped buffers of a node, streaming or not.
pub(super) struct MappedQueue {
    node: Node,
    kind: QueueKind,
    buffers: Vec<Mapping>,
    /// Flags of an unused buffer: they say which clock stamps.
    pub(super) flags: u32,
    on: bool,
}

impl MappedQueue {
    /// Asks for `count` buffers and maps what the driver gives.
    pub(super) fn new(node: Node, kind: QueueKind, count: u32) -> Result<Self> {
        let given = ioctl::request_buffers(node.fd(), kind, Memory::Mapped, count)
            .map_err(|e| node.error("gives no buffers (VIDIOC_REQBUFS)", e))?;
        let mut queue = Self { node, kind, buffers: Vec::new(), flags: 0, on: false };
        for index in 0..given {
            let map = || {
                let buffer = ioctl::query_buffer(queue.node.fd(), kind, Memory::Mapped, index)?;
                Ok((buffer.flags, Mapping::new(&queue.node, &buffer)?))
            };
            let (flags, mapping) =
                map().map_err(|e| queue.node.error("a buffer could not be mapped (VIDIOC_QUERYBUF)", e))?;
            queue.flags = flags;
            queue.buffers.push(mapping);
        }
        if queue.buffers.is_empty() {
            let path = queue.node.path().display();
            return Err(Error::new(
                ErrorKind::Io,
                format!("{path}: its driver gave no buffers; open it again"),
            ));
        }
        Ok(queue)
    }

    /// Hands all buffers to the driver and begins.
    pub(super) fn start(&mut self) -> Result<()> {
        for index in 0..self.buffers.len() {
            ioctl::queue_mapped(self.node.fd(), self.kind, index as u32)
                .map_err(|e| self.node.error("takes no buffer (VIDIOC_QBUF)", e))?;
        }
        ioctl::stream_on(self.node.fd(), self.kind)
            .map_err(|e| self.node.error("does not begin to stream (VIDIOC_STREAMON)", e))?;
        self.on = true;
        Ok(())
    }

    /// Ends streaming; said in the log when the driver refuses, which a camera that is gone may do.
    pub(super) fn stop(&mut self) {
        if core::mem::take(&mut self.on)
            && let Err(e) = ioctl::stream_off(self.node.fd(), self.kind)
            && !super::error::is_gone(&e)
        {
            tracing::warn!(node = %self.node.path().display(), error = %e, "the node did not stop streaming");
        }
    }

    pub(super) const fn node(&self) -> &Node {
        &self.node
    }

    pub(super) fn depth(&self) -> usize {
        self.buffers.len()
    }

    /// Takes the oldest filled buffer, if there is one, shows it to `look`, and hands it back to the driver.
    pub(super) fn next<R>(&mut self, look: impl FnOnce(&Buffer, &[u8]) -> R) -> Result<Option<R>> {
        let dequeued = ioctl::dequeue(self.node.fd(), self.kind, Memory::Mapped)
            .map_err(|e| self.node.error("stopped streaming (VIDIOC_DQBUF)", e))?;
        let Some(buffer) = dequeued else { return Ok(None) };
        let Some(mapping) = self.buffers.get(buffer.index as usize) else {
            let path = self.node.path().display();
            let what = format!("{path}: its driver filled buffer {}, which there is not", buffer.index);
            return Err(Error::new(ErrorKind::Protocol, what));
        };
        // SAFETY: dequeued just now, and queued again below, after the slice.
        let seen = look(&buffer, unsafe { mapping.bytes(buffer.bytes_used) });
        ioctl::queue_mapped(self.node.fd(), self.kind, buffer.index)
            .map_err(|e| self.node.error("does not take its buffer back (VIDIOC_QBUF)", e))?;
        Ok(Some(seen))
    }
}

impl Drop for MappedQueue {
    fn drop(&mut self) {
        self.stop();
        self.buffers.clear();
        // Another opener of the node may want its own; closing would do it too, but our handle may be shared.
        if let Err(e) = ioctl::request_buffers(self.node.fd(), self.kind, Memory::Mapped, 0)
            && !super::error::is_gone(&e)
        {
            tracing::debug!(node = %self.node.path().display(), error = %e, "buffers were not given back");
        }
    }
}
