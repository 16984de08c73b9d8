//! A frame of another process takes no memory on its way to the subscribers: counted by an allocator.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::external::{About, ExternalCamera, ExternalFrame, HEARTBEAT, Mode, Place};
use depthrig_bus::{DropReason, HostTime, Name, PixelFormat, RuntimeDir};
use depthrig_counting::{Counting, of_thread};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{Backend, FrameMeta, FrameSink, Poll};
use depthrig_external::{ExternalBackend, ExternalConfig};
use std::time::Duration;

const RATE_HZ: f64 = 200.0;
const FRAMES: u64 = 500;
/// Most allocations of one look at a lock.
const LOOK: u64 = 16;

#[global_allocator]
static COUNTING: Counting = Counting;

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
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Rgb8, 64, 48, RATE_HZ);
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
    // Looks at the lock of a process that has sent nothing for a tenth of a second, as happens on a busy computer.
    let mut looks = 0;
    let mut run = |stream: &mut Box<dyn depthrig_driver::Stream>, sink: &mut Slot, frames: u64| {
        let until = sink.1 + frames;
        let mut last = HostTime::now();
        while sink.1 < until {
            let before = sink.1;
            assert_ne!(stream.poll(Duration::from_millis(50), sink).unwrap(), Poll::End);
            if sink.1 > before {
                let silence_ms = last.elapsed().as_millis() as u64;
                looks += if silence_ms < 90 { 0 } else { silence_ms / 50 };
                last = HostTime::now();
            }
        }
        core::mem::take(&mut looks)
    };
    // The clock map takes its memory in its first seconds.
    run(&mut stream, &mut sink, 1500);
    // Each heart-beat of the daemon's side takes one: what iceoryx2 shares between a loan and its port. Reading the
    // lock of a silent process takes nine or so. Found by the traces of all that was taken; nothing else was.
    let mut measure = || {
        let before = of_thread();
        let began = HostTime::now();
        let looks = run(&mut stream, &mut sink, FRAMES);
        let taken = of_thread() - before;
        let beats = began.elapsed().as_secs_f64() / HEARTBEAT.as_secs_f64();
        (taken, beats, looks, beats as u64 + 1 + LOOK * looks)
    };
    // Says nothing where a busy computer makes the others as many as the frames.
    let told = (0..10).map(|_| measure()).find(|(.., others)| *others < FRAMES / 2);
    let (taken, beats, looks, others) = told.expect("a computer that is not so slow");
    assert!(
        taken <= others,
        "{FRAMES} frames, {beats:.0} heart-beats and {looks} looks between them: memory was taken {taken} times"
    );
    drop(stream);
    process.join().unwrap();
}
