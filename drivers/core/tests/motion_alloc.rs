//! A batch of IMU samples allocates nothing: counted by an allocator.
#![allow(missing_docs, clippy::unwrap_used)]

use depthrig_bus::{DropReason, FrameFlags, HostTime, MetadataLevel, MotionSample, Pose};
use depthrig_counting::{Counting, during};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::motion::{Batcher, Mark, profile};
use depthrig_driver::{DeviceClock, FrameMeta, FrameSink};

#[global_allocator]
static COUNTING: Counting = Counting;

/// A sink with memory of its own.
struct Slot(Vec<u8>, u64, u64);

impl FrameSink for Slot {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        self.0.get_mut(..len)
    }
    fn commit(&mut self, _: usize, _: &FrameMeta) {
        self.1 += 1;
    }
    fn discard(&mut self, _: usize) {}
    fn dropped(&mut self, _: usize, _: DropReason, n: u64) {
        self.2 += n;
    }
    fn captured(&mut self, _: usize, _: u64) {}
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

#[test]
fn a_batch_takes_no_memory() {
    let unit =
        profile(1600.0, 64, Pose::IDENTITY, DeviceClock::microseconds(64), MetadataLevel::Full).unwrap();
    let mut batcher = Batcher::new(0, &unit);
    let mut sink = Slot(vec![0; unit.frame_bytes()], 0, 0);
    let taken = during(|| {
        for n in 0..64_000u64 {
            let arrival = HostTime::from_ns(1_000_000_000 + 625_000 * n as i64);
            let sample = MotionSample { time_ns: arrival.ns(), sequence: n, ..MotionSample::default() };
            let mark = Mark { arrival, epoch: (n / 10_000) as u32, flags: FrameFlags(0) };
            batcher.push(&sample, mark, &mut sink);
            if n.is_multiple_of(5000) {
                batcher.lose(3, DropReason::QueueFull, &mut sink);
            }
        }
    });
    assert!(sink.1 >= 1000 && sink.2 == 13, "{} batches, {} lost", sink.1, sink.2);
    assert_eq!(taken, 0);
}
