//! Where a driver's frames go: memory on loan, written once, then committed or given back.

use crate::clock::{CalibratedLatency, ClockQuality};
use depthrig_bus::{ClockDomain, DropCounts, DropReason, FrameFlags, FrameMut, HostTime};

/// The receiver of a camera's frames. `stream` is the index into [`crate::Stream::profiles`].
///
/// On the live path the memory is a free slot of the stream's shared-memory channel, so that what a driver
/// writes is what every subscriber reads.
pub trait FrameSink {
    /// Memory for the next frame of `stream`, exactly `len` bytes, with arbitrary contents; `None` when
    /// no slot is free, and the frame must be dropped.
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]>;

    /// Publishes the memory lent last for `stream`.
    fn commit(&mut self, stream: usize, meta: &FrameMeta);

    /// Takes back the memory lent last for `stream`, unpublished.
    fn discard(&mut self, stream: usize);

    /// Memory of exactly `len` bytes for a frame of `stream` that the device itself will write; as many as
    /// [`depthrig_bus::MAX_LENT`] may be out at once, beside what [`Self::loan`] lends. Dropping it gives it back.
    /// `None` when no slot is free, or when the receiver does not lend in this way.
    fn lend(&mut self, _stream: usize, _len: usize) -> Option<Loan> {
        None
    }

    /// Publishes memory from [`Self::lend`].
    fn commit_lent(&mut self, stream: usize, loan: Loan, _meta: &FrameMeta) {
        drop(loan);
        self.dropped(stream, DropReason::NoSlot, 1);
    }

    /// Says that `n` frames of `stream` were lost.
    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64);

    /// Says that `n` frames of `stream`, which is computed, were superseded by newer ones. That is by design and not
    /// a fault: it is counted as [`DropReason::QueueFull`], and a log need not repeat it.
    fn superseded(&mut self, stream: usize, n: u64) {
        self.dropped(stream, DropReason::QueueFull, n);
    }

    /// Says that the device captured `n` more frames on `stream`; each of them is committed or dropped next.
    fn captured(&mut self, stream: usize, n: u64);

    /// Says how the clock map of `stream` is doing, about once a second.
    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality);

    /// Constant latency of `stream`, where a calibration of the mount has found it. The gate asks before the first frame.
    fn calibrated_latency(&self, _stream: usize) -> Option<CalibratedLatency> {
        None
    }
}

/// Memory for one frame that is the driver's until it is committed or dropped, so that a device can fill several at
/// once. It stays where it is when the loan moves.
#[derive(Debug)]
pub enum Loan {
    /// A slot of a stream's channel.
    Slot(FrameMut),
    /// Memory of the process.
    Memory(Box<[u8]>),
}

impl Loan {
    /// The bytes, all of them.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Slot(frame) => frame.pixels_mut(),
            Self::Memory(bytes) => bytes,
        }
    }
}

/// Metadata of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameMeta {
    /// The device's frame counter, unwrapped.
    pub device_sequence: u64,
    /// Device time in ticks, unwrapped.
    pub device_time: u64,
    /// Middle of the exposure on the host clock.
    pub capture_time: HostTime,
    /// The capture time is right within this much.
    pub capture_uncertainty_ns: u64,
    /// Number of the clock map in force.
    pub clock_epoch: u32,
    /// Where the capture time comes from.
    pub clock_domain: ClockDomain,
    /// When the last byte had arrived.
    pub arrival: HostTime,
    /// Facts about the frame.
    pub flags: FrameFlags,
    /// Frames captured so far on this stream, this one included.
    pub captured: u64,
    /// Exposure time; 0 when unknown.
    pub exposure_ns: u64,
    /// Sensor gain; 0 when unknown.
    pub gain: f32,
    /// Sensor temperature in °C; NaN when unknown.
    pub temperature_c: f32,
    /// Constant latency that the capture time is free of, nanoseconds; 0 when none is known.
    pub latency_ns: u64,
}

/// A sink that keeps everything in memory, for tests and tools.
#[derive(Debug, Default)]
pub struct MemorySink {
    /// Committed frames: stream, facts, pixels.
    pub frames: Vec<(usize, FrameMeta, Vec<u8>)>,
    /// Drops by stream.
    pub drops: Vec<DropCounts>,
    /// Frames captured by stream.
    pub captured: Vec<u64>,
    /// Number of loans from now on that are refused, as if no slot were free.
    pub refuse: usize,
    /// Latency of every stream, as a calibration would have found it.
    pub latency: Option<CalibratedLatency>,
    lends: bool,
    buffers: Vec<Vec<u8>>,
}

impl MemorySink {
    fn at<T: Default>(list: &mut Vec<T>, i: usize) -> &mut T {
        while list.len() <= i {
            list.push(T::default());
        }
        &mut list[i]
    }

    /// A sink that lends memory for the device to write.
    pub fn lending() -> Self {
        Self { lends: true, ..Self::default() }
    }

    /// Frames delivered on `stream`.
    pub fn delivered(&self, stream: usize) -> u64 {
        self.frames.iter().filter(|f| f.0 == stream).count() as u64
    }

    /// Drops of `stream`.
    pub fn drops_of(&self, stream: usize) -> DropCounts {
        self.drops.get(stream).copied().unwrap_or_default()
    }
}

impl FrameSink for MemorySink {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        if self.refuse > 0 {
            self.refuse -= 1;
            return None;
        }
        let buffer = Self::at(&mut self.buffers, stream);
        *buffer = vec![0xA5; len]; // not zero: a driver that leaves a byte unwritten shows
        Some(buffer)
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let pixels = core::mem::take(Self::at(&mut self.buffers, stream));
        self.frames.push((stream, *meta, pixels));
    }

    fn discard(&mut self, stream: usize) {
        Self::at(&mut self.buffers, stream).clear();
    }

    fn lend(&mut self, _: usize, len: usize) -> Option<Loan> {
        if !self.lends {
            return None;
        }
        if self.refuse > 0 {
            self.refuse -= 1;
            return None;
        }
        Some(Loan::Memory(vec![0xA5; len].into()))
    }

    fn commit_lent(&mut self, stream: usize, mut loan: Loan, meta: &FrameMeta) {
        self.frames.push((stream, *meta, loan.bytes_mut().to_vec()));
    }

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        Self::at(&mut self.drops, stream).add(reason, n);
    }

    fn captured(&mut self, stream: usize, n: u64) {
        *Self::at(&mut self.captured, stream) += n;
    }

    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}

    fn calibrated_latency(&self, _: usize) -> Option<CalibratedLatency> {
        self.latency
    }
}
