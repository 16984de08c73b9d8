//! Once it runs, stereo takes no memory for a pair: on the thread that captures, and on those that rectify and match.
#![allow(clippy::unwrap_used)]

use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, HostTime, Intrinsics, MetadataLevel, Name, PixelFormat, Pose};
use depthrig_calib::stereo::Preset;
use depthrig_counting::{Counting, of_process, of_thread};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{
    Device, DeviceClock, DeviceInfo, FrameMeta, FrameSink, Gate, Poll, RawFrame, Result, Stream,
    StreamProfile, StreamRequest, choose_profiles,
};
use depthrig_stereo::{StereoMode, StereoOptions, wrap};

#[global_allocator]
static COUNTING: Counting = Counting;

const SIZE: (u32, u32) = (160, 96);

/// A camera that always sees the same wall.
struct Wall {
    info: DeviceInfo,
    profiles: Vec<StreamProfile>,
}

struct WallStream {
    profiles: Vec<StreamProfile>,
    gates: Vec<Gate>,
    images: [Vec<u8>; 2],
    sequence: u64,
}

impl Device for Wall {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let profiles = choose_profiles("wall", &self.profiles, requests)?;
        let gates = profiles.iter().enumerate().map(|(i, p)| Gate::new(i, p)).collect();
        let image = |shift: u32| {
            let grey = |x: u32, y: u32| ((x + shift) * 7919 + y * 104_729).wrapping_mul(2_654_435_761) >> 7;
            let pixels = (0..SIZE.0 * SIZE.1).map(|i| (i % SIZE.0, i / SIZE.0));
            pixels.flat_map(|(x, y)| [grey(x, y) as u8, 128]).collect()
        };
        Ok(Box::new(WallStream { profiles, gates, images: [image(0), image(10)], sequence: 0 }))
    }
}

impl Stream for WallStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, _: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        self.sequence += 1;
        let ticks = 1_000_000_000 + self.sequence * 33_333_333;
        for (gate, image) in self.gates.iter_mut().zip(&self.images) {
            let raw = RawFrame::new(self.sequence, ticks, HostTime::from_ns(ticks as i64 + 1), image.len());
            gate.deliver(&raw, sink, |memory| {
                memory.copy_from_slice(image);
                Ok(())
            });
        }
        Ok(Poll::Frame)
    }
}

/// A sink that counts.
#[derive(Default)]
struct Sink {
    memory: Vec<u8>,
    delivered: [u64; 9],
}

impl FrameSink for Sink {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        self.memory.get_mut(..len)
    }
    fn commit(&mut self, stream: usize, _: &FrameMeta) {
        self.delivered[stream] += 1;
    }
    fn discard(&mut self, _: usize) {}
    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        panic!("{n} of stream {stream} lost: {}", reason.name());
    }
    fn captured(&mut self, _: usize, _: u64) {}
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

/// One test alone: others in this program would be counted too.
#[test]
fn a_pair_takes_no_memory() {
    let profile = |name: &str, x: f64| StreamProfile {
        stream: Name::new(name).unwrap(),
        format: PixelFormat::Yuyv,
        width: SIZE.0,
        height: SIZE.1,
        rate_hz: 30.0,
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::pinhole(200.0, 200.0, 79.5, 47.5),
        pose_in_device: Pose { translation_m: [x, 0.0, 0.0], ..Pose::IDENTITY },
        clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel },
        sequence_bits: 64,
        metadata: MetadataLevel::Kernel,
    };
    let wall =
        Wall { info: DeviceInfo::default(), profiles: vec![profile("left", 0.0), profile("right", 0.12)] };
    let modes = [Preset::Performance, Preset::Quality].map(|p| StereoMode::preset(p, 0.5, 1)).to_vec();
    let options = StereoOptions { modes, disparity: true, every_pair: true, ..StereoOptions::default() };
    let mut stream = wrap(Box::new(wall), options).unwrap().start(&[]).unwrap();
    assert_eq!(stream.profiles().len(), 9);
    let mut sink = Sink { memory: vec![0; 160 * 96 * 4], ..Sink::default() };
    let mut until = |n: u64| {
        while sink.delivered[8] < n {
            let _ = stream.poll(Duration::from_millis(20), &mut sink).unwrap();
        }
    };
    until(20);
    // A thread that the scheduler did not let run before makes its buffers when it does, so the steady state may come
    // late on a busy computer. Once is enough: what each pair took would be taken in every stretch.
    let mut by_threads = Vec::new();
    while by_threads.last().is_none_or(|n| *n > 2) {
        assert!(by_threads.len() < 5, "{by_threads:?} by the threads, in 40 pairs each time");
        let own = of_thread();
        let all = of_process();
        until(60 + 40 * by_threads.len() as u64);
        assert_eq!(of_thread() - own, 0, "on the thread that captures");
        by_threads.push(of_process() - all);
    }
}
