//! Images from the kernel's nodes, several of one camera in one thread, each with its metadata if there is any.

use super::ioctl::{Buffer, QueueKind};
use super::metadata::{MetadataFormat, RECORD_BYTES, Record, Waiting, payload_header};
use super::node::Node;
use super::queue::MappedQueue;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::video::{Image, ImageSource};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::os::fd::BorrowedFd;
use v4l::v4l_sys as sys;

/// Buffers of each queue. A thread may be away for three frame times before frames are lost.
pub const DEFAULT_BUFFERS: u32 = 4;
/// How long an image waits for metadata that the kernel hands over after it. `uvcvideo` hands it over before.
const METADATA_TIMEOUT: Duration = Duration::from_millis(2);
/// A sequence number that is this far behind the last one began anew.
const SEQUENCE_BACK: u32 = 1 << 31;

/// A node to stream from. Its mode was set with [`Node::set_mode`].
#[derive(Debug)]
pub struct Wanted {
    /// Where images come from.
    pub video: Node,
    /// The metadata node of the same interface, and the format that is wanted of it.
    pub metadata: Option<(Node, MetadataFormat)>,
}

impl Wanted {
    /// Images alone.
    pub const fn plain(video: Node) -> Self {
        Self { video, metadata: None }
    }
}

/// Meaning of the stamps of a node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stamp {
    /// Of `CLOCK_MONOTONIC`, taken when the first bytes of the image came (`TSTAMP_SRC_SOE`).
    Start,
    /// Of `CLOCK_MONOTONIC`, taken when the last bytes had come (`TSTAMP_SRC_EOF`).
    End,
    /// Of another clock, or none: of no use.
    Unknown,
}

impl Stamp {
    /// Reads the flags of a buffer.
    pub const fn from_flags(flags: u32) -> Self {
        if flags & sys::V4L2_BUF_FLAG_TIMESTAMP_MASK != sys::V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC {
            Self::Unknown
        } else if flags & sys::V4L2_BUF_FLAG_TSTAMP_SRC_MASK == sys::V4L2_BUF_FLAG_TSTAMP_SRC_SOE {
            Self::Start
        } else {
            Self::End
        }
    }
}

/// Streaming nodes of one camera.
pub struct Source {
    ports: Vec<Port>,
}

/// A video queue with its metadata.
struct Port {
    video: MappedQueue,
    metadata: Option<MetadataPort>,
    sequence: Unwrapped,
}

struct MetadataPort {
    queue: MappedQueue,
    format: MetadataFormat,
    waiting: Waiting,
}

impl Source {
    /// Starts streaming from all of `nodes` with `buffers` buffers each. Metadata queues begin before the video
    /// queues and end after them, so that no image is without its own.
    ///
    /// A metadata node that gives neither of the formats we know is left alone.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`] (also when the bus has no bandwidth left).
    pub fn start(nodes: Vec<Wanted>, buffers: u32) -> Result<Self> {
        let mut ports = Vec::new();
        for wanted in nodes {
            let metadata = match wanted.metadata {
                Some((node, format)) => MetadataPort::new(node, format, buffers)?,
                None => None,
            };
            let video = MappedQueue::new(wanted.video, QueueKind::Video, buffers)?;
            ports.push(Port { video, metadata, sequence: Unwrapped::default() });
        }
        let mut source = Self { ports };
        for metadata in source.ports.iter_mut().filter_map(|p| p.metadata.as_mut()) {
            metadata.queue.start()?;
        }
        for port in &mut source.ports {
            port.video.start()?;
        }
        Ok(source)
    }

    /// The format that the metadata node of source number `source` really has.
    pub fn metadata(&self, source: usize) -> MetadataFormat {
        self.ports.get(source).and_then(|p| p.metadata.as_ref()).map_or(MetadataFormat::None, |m| m.format)
    }

    /// Meaning of the stamps of source number `source`.
    pub fn stamp(&self, source: usize) -> Stamp {
        self.ports.get(source).map_or(Stamp::Unknown, |p| Stamp::from_flags(p.video.flags))
    }
}

impl Drop for Source {
    fn drop(&mut self) {
        self.ports.iter_mut().for_each(|p| p.video.stop());
    }
}

impl MetadataPort {
    fn new(node: Node, wanted: MetadataFormat, buffers: u32) -> Result<Option<Self>> {
        let (format, _) = node.set_metadata_format(wanted)?;
        if format == MetadataFormat::None {
            return Ok(None);
        }
        // Twice as many as images: a record is given back at once, but an image may keep us from it.
        let queue = MappedQueue::new(node, QueueKind::Metadata, 2 * buffers)?;
        Ok(Some(Self { queue, format, waiting: Waiting::default() }))
    }

    /// Takes over whatever the kernel has.
    fn drain(&mut self) -> Result<()> {
        for _ in 0..self.queue.depth() {
            let queue = &mut self.queue;
            let waiting = &mut self.waiting;
            let came = queue.next(|b, bytes| {
                let bytes = bytes.get(..RECORD_BYTES.min(bytes.len())).unwrap_or_default();
                waiting.keep(&Record::new(b.sequence, b.stamp_ns, bytes));
            })?;
            if came.is_none() {
                break;
            }
        }
        Ok(())
    }

    /// The record of the image in `b`, waiting for it a little.
    fn record_of(&mut self, b: &Buffer) -> Result<Option<Record>> {
        let until = HostTime::now().plus(METADATA_TIMEOUT);
        loop {
            self.drain()?;
            if self.waiting.has(b.sequence, b.stamp_ns) {
                return Ok(self.waiting.take(b.sequence, b.stamp_ns));
            }
            let left = until.from_now();
            if left.is_zero() || wait(&[self.queue.node()], left)?.is_empty() {
                return Ok(None);
            }
        }
    }
}

impl ImageSource for Source {
    fn poll(&mut self, timeout: Duration, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        let ready = {
            let nodes: Vec<&Node> = self.ports.iter().map(|p| p.video.node()).collect();
            wait(&nodes, timeout)?
        };
        let mut any = false;
        for (index, failed) in ready {
            let Some(port) = self.ports.get_mut(index) else { continue };
            let mut came = 0;
            while came < port.video.depth() && port.next(index, each)? {
                came += 1;
            }
            any |= came > 0;
            if failed && came == 0 {
                // Taking an image yields neither an image nor an error, so the cause is unknown.
                let path = port.video.node().path().display();
                return Err(Error::new(
                    ErrorKind::Io,
                    format!("{path}: the node reports an error; open it again"),
                ));
            }
        }
        Ok(any)
    }
}

impl Port {
    /// Hands the oldest image to `each`; whether there was one.
    fn next(&mut self, index: usize, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        let Self { video, metadata, sequence } = self;
        let format = metadata.as_ref().map_or(MetadataFormat::None, |m| m.format);
        let came = video.next(|b, bytes| {
            let arrival = HostTime::now();
            let record = match metadata {
                Some(m) => m.record_of(b),
                None => Ok(None),
            };
            let (record, problem) = match record {
                Ok(record) => (record, None),
                Err(e) => (None, Some(e)),
            };
            let kernel_time =
                (Stamp::from_flags(b.flags) != Stamp::Unknown).then(|| HostTime::from_ns(b.stamp_ns));
            each(&Image {
                source: index,
                bytes,
                damaged: b.flags & sys::V4L2_BUF_FLAG_ERROR != 0,
                sequence: sequence.next(b.sequence),
                kernel_time,
                arrival,
                header: record.as_ref().and_then(|r| payload_header(r.bytes(), format)),
            });
            problem
        })?;
        match came {
            None => Ok(false),
            Some(None) => Ok(true),
            Some(Some(problem)) => Err(problem),
        }
    }
}

/// The kernel's counter of 32 bits as one that does not wrap.
#[derive(Debug, Default)]
pub(super) struct Unwrapped {
    last: Option<u64>,
}

impl Unwrapped {
    pub(super) fn next(&mut self, sequence: u32) -> u64 {
        let now = match self.last {
            None => u64::from(sequence),
            Some(last) => {
                let step = sequence.wrapping_sub(last as u32);
                if step < SEQUENCE_BACK {
                    last + u64::from(step)
                } else {
                    last.saturating_sub(u64::from(step.wrapping_neg()))
                }
            }
        };
        self.last = Some(now);
        now
    }
}

/// Waits for any of `nodes`; the indices of those that have something, and whether that is an error.
pub(super) fn wait(nodes: &[&Node], timeout: Duration) -> Result<Vec<(usize, bool)>> {
    let until = HostTime::now().plus(timeout);
    loop {
        let mut fds: Vec<PollFd<'_>> = Vec::with_capacity(nodes.len());
        for node in nodes {
            fds.push(PollFd::from_borrowed_fd(borrow(node), PollFlags::IN));
        }
        let left = until.from_now();
        let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        match poll(&mut fds, Some(&left)) {
            Ok(_) => {}
            Err(rustix::io::Errno::INTR) => continue,
            Err(e) => {
                return Err(Error::new(ErrorKind::Io, "waiting for the camera failed").with_source(e));
            }
        }
        let ready = fds.iter().enumerate().filter(|(_, fd)| !fd.revents().is_empty());
        return Ok(ready.map(|(i, fd)| (i, !fd.revents().contains(PollFlags::IN))).collect());
    }
}

/// The node as what `poll` takes.
#[allow(unsafe_code)] // The crate `v4l` hands out a bare number.
fn borrow(node: &Node) -> BorrowedFd<'_> {
    // SAFETY: the node stays open for as long as it is borrowed.
    unsafe { BorrowedFd::borrow_raw(node.fd()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_counter_does_not_wrap_and_may_step_back() {
        let mut u = Unwrapped::default();
        let numbers = [u32::MAX - 1, u32::MAX, 0, 3, 2, 4].map(|n| u.next(n));
        let most = u64::from(u32::MAX);
        assert_eq!(numbers, [most - 1, most, most + 1, most + 4, most + 3, most + 5]);
    }

    #[test]
    fn a_stamp_is_used_only_of_the_monotonic_clock() {
        assert_eq!(Stamp::from_flags(0x2000 | 0x1_0000), Stamp::Start);
        assert_eq!(Stamp::from_flags(0x2000), Stamp::End);
        assert_eq!(Stamp::from_flags(0x4000), Stamp::Unknown, "copied from an output buffer");
        assert_eq!(Stamp::from_flags(0), Stamp::Unknown);
    }
}
