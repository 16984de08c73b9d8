//! A sink that keeps the metadata of each frame and inspects its pixels without keeping them.

use core::time::Duration;
use depthrig_bus::{DropCounts, DropReason, HostTime};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{FrameMeta, FrameSink, Poll, Stream};
use depthrig_emulator::Stamp;

/// A frame that was delivered.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    /// The stream it belongs to.
    pub stream: usize,
    /// The driver's metadata.
    pub meta: FrameMeta,
    /// Index of the emulator's stamp; `None` when its pixels have none.
    pub index: Option<u64>,
}

/// Frames and losses of a stream.
#[derive(Debug, Default)]
pub struct Tally {
    /// Delivered frames in their order.
    pub frames: Vec<Frame>,
    /// Frames lost, by stream.
    pub drops: Vec<DropCounts>,
    /// Frames captured, by stream.
    pub captured: Vec<u64>,
    memory: Vec<u8>,
}

impl Tally {
    /// Polls `stream` for `time`.
    ///
    /// # Errors
    /// Those of the stream.
    pub fn poll_for(&mut self, stream: &mut dyn Stream, time: Duration) -> depthrig_driver::Result<()> {
        let end = HostTime::now().plus(time);
        while !end.from_now().is_zero() {
            if stream.poll(Duration::from_millis(50), self)? == Poll::End {
                break;
            }
        }
        Ok(())
    }

    /// The frames of one stream.
    pub fn of(&self, stream: usize) -> impl Iterator<Item = &Frame> {
        self.frames.iter().filter(move |f| f.stream == stream)
    }

    /// Frames of a stream that were lost for `reason`.
    pub fn lost(&self, stream: usize, reason: DropReason) -> u64 {
        self.drops.get(stream).map_or(0, |d| d.get(reason))
    }

    fn at<T: Default>(list: &mut Vec<T>, i: usize) -> &mut T {
        while list.len() <= i {
            list.push(T::default());
        }
        &mut list[i]
    }
}

impl FrameSink for Tally {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        self.memory.resize(len, 0);
        Some(&mut self.memory)
    }

    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let index = Stamp::read(&self.memory).map(|s| s.index);
        self.frames.push(Frame { stream, meta: *meta, index });
    }

    fn discard(&mut self, _: usize) {}

    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        Self::at(&mut self.drops, stream).add(reason, n);
    }

    fn captured(&mut self, stream: usize, n: u64) {
        *Self::at(&mut self.captured, stream) += n;
    }

    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}
