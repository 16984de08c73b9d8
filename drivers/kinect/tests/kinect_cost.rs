//! Cost of a frame of an attached Kinect: one write of its bytes, and no allocation.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/kinect.rs"]
mod kinect;

use depthrig_bus::{DropReason, Name, PixelFormat};
use depthrig_counting::{Counting, of_thread};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{Backend, FrameMeta, FrameSink, Stream, StreamRequest, unpack};
use depthrig_kinect::live::{LiveBackend, LiveConfig};
use kinect::Fake;
use std::time::Duration;

#[global_allocator]
static COUNTING: Counting = Counting;

const A: &str = "000111111111";

fn all_streams(color: PixelFormat) -> [StreamRequest; 3] {
    let wish = |stream: &str, size, format| StreamRequest {
        stream: Name::new(stream).unwrap(),
        size: Some(size),
        rate_hz: Some(30.0),
        format: Some(format),
    };
    let small = (320, 288);
    [
        wish("color", (1280, 720), color),
        wish("depth", small, PixelFormat::Z16),
        wish("ir", small, PixelFormat::Mono16),
    ]
}

fn start(config: LiveConfig, requests: &[StreamRequest]) -> Box<dyn Stream> {
    LiveBackend::new(config).open(Some(A)).unwrap().start(requests).unwrap()
}

/// One test alone: what others copy would be counted too.
#[test]
fn an_image_is_written_once_and_costs_no_memory() {
    /// Lends the same memory again and again.
    struct Slot(Vec<u8>, u64, u64);
    impl FrameSink for Slot {
        fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
            self.1 += len as u64;
            self.0.get_mut(..len)
        }
        fn commit(&mut self, _: usize, _: &FrameMeta) {
            self.2 += 1;
        }
        fn discard(&mut self, _: usize) {}
        fn dropped(&mut self, _: usize, reason: DropReason, _: u64) {
            // Images that a busy machine fetches too late are lost in libk4a.
            assert_eq!(reason, DropReason::DeviceGap);
        }
        fn captured(&mut self, _: usize, _: u64) {}
        fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
    }
    let fake = Fake::new(&[A]);
    for color in [PixelFormat::Yuyv, PixelFormat::Nv12, PixelFormat::Bgr8, PixelFormat::Mjpeg] {
        let mut stream = start(fake.config(), &all_streams(color));
        let mut slot = Slot(vec![0; 4 << 20], 0, 0);
        let mut taken = 0;
        while slot.2 < 60 {
            // The clock map grows to its size with the first frames.
            let warm = slot.2 > 15;
            let before = of_thread();
            stream.poll(Duration::from_millis(50), &mut slot).unwrap();
            taken += if warm { of_thread() - before } else { 0 };
        }
        assert_eq!(taken, 0, "{color:?}");
    }
    let before = unpack::copied_bytes();
    let mut stream = start(fake.config(), &all_streams(PixelFormat::Rgb8));
    let mut slot = Slot(vec![0; 4 << 20], 0, 0);
    while slot.2 < 12 {
        stream.poll(Duration::from_millis(50), &mut slot).unwrap();
    }
    assert_eq!(unpack::copied_bytes() - before, slot.1, "bytes written, of bytes lent");
}
