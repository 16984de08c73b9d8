//! A frame of another process takes no memory on its way to the subscribers: counted by an allocator.
#![allow(unsafe_code)] // a global allocator is unsafe to write
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::cell::Cell;
use depthrig_bus::external::{About, ExternalCamera, ExternalFrame, HEARTBEAT, Mode, Place};
use depthrig_bus::{DropReason, HostTime, Name, PixelFormat, RuntimeDir};
use depthrig_drivers::clock::ClockQuality;
use depthrig_drivers::external::{ExternalBackend, ExternalConfig};
use depthrig_drivers::{Backend, FrameMeta, FrameSink, Poll};
use std::alloc::{GlobalAlloc, Layout, System};
use std::time::Duration;

const RATE_HZ: u64 = 200;
const FRAMES: u64 = 500;

struct Counting;

thread_local! {
    static OWN: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        OWN.set(OWN.get() + 1);
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(ptr, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A sink with memory of its own.
struct Slot(Vec<u8>, u64);

impl FrameSink for Slot {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        self.0.get_mut(..len)
    }
    fn commit(&mut self, _: usize, _: &FrameMeta) {
        self.1 += 1;
    }
    fn discard(&mut self, _: usize) {}
    fn dropped(&mut self, _: usize, _: DropReason, _: u64) {}
    fn captured(&mut self, _: usize, _: u64) {}
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

#[test]
fn a_frame_takes_no_memory() {
    let dir = tempfile::tempdir().unwrap();
    let runtime = RuntimeDir::at(dir.path()).unwrap();
    let place = Place { runtime, rig: Name::new("rig").unwrap(), camera: Name::new("cam").unwrap() };
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Rgb8, (64, 48), RATE_HZ as f64);
    let mode = mode.with_device_clock(32, 1_000_000, 32);
    let about = About { model: "Bench".into(), ..About::default() };
    let mut camera = ExternalCamera::offer(&place, &about, &[mode]).unwrap();
    let process = std::thread::spawn(move || {
        let mut session = camera.next_session(Duration::from_secs(20)).unwrap().unwrap();
        let pixels = vec![1; 64 * 48 * 3];
        let mut n = 0;
        while session.is_wanted() {
            n += 1;
            let now = HostTime::now().ns();
            let facts = ExternalFrame {
                device_sequence: n,
                device_time: now.cast_unsigned() / 1000,
                arrival_time_ns: now,
                ..ExternalFrame::default()
            };
            session.send_copy(0, &facts, &pixels).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    let backend = ExternalBackend::new(ExternalConfig::default(), place);
    let mut stream = backend.open(None).unwrap().start(&[]).unwrap();
    let mut sink = Slot(vec![0; 64 * 48 * 3], 0);
    let run = |stream: &mut Box<dyn depthrig_drivers::Stream>, sink: &mut Slot, frames: u64| {
        let until = sink.1 + frames;
        while sink.1 < until {
            assert_ne!(stream.poll(Duration::from_millis(50), sink).unwrap(), Poll::End);
        }
    };
    // The clock map takes its memory in its first seconds.
    run(&mut stream, &mut sink, 1500);
    let (before, began) = (OWN.get(), HostTime::now());
    run(&mut stream, &mut sink, FRAMES);
    let taken = OWN.get() - before;
    // What comes a few times a second may: a heart-beat of each side, and a word on the clock once in `RATE_HZ` frames.
    let beats = began.elapsed().as_secs_f64() / HEARTBEAT.as_secs_f64();
    let others = 2 * (beats as u64 + 1) + FRAMES / RATE_HZ + 1;
    assert!(others < FRAMES / 2, "the computer is so slow that this says nothing: {beats} heart-beats");
    assert!(
        taken <= others,
        "{FRAMES} frames, {beats:.0} heart-beats between them: memory was taken {taken} times"
    );
    drop(stream);
    process.join().unwrap();
}
