//! How fast recordings of an Azure Kinect are played, in multiples of their own length.
//!
//! `cargo run --release -p depthrig-kinect-fixture --example kinect_speed [-- FILE.mkv]`; without a file, one of 30 s
//! of 720p JPEG (150 kB an image), depth and infrared of the narrow field of view and IMU is generated first. Frames go
//! into memory that is used again, as the slots of a channel are. Two numbers each: by the wall clock, which other
//! programs on the computer spoil, and by the processor time of all threads shared by two cores, which they do not.
//! `taskset -c 0,1` makes it two cores for the first one too.
//!
//! Exit code 1 when frames are lost, or when the generated recording is slower by processor time than it must be.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)] // a measuring program: any failure ends it

use depthrig_bus::{DropReason, HostTime, Name, PixelFormat};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{Backend, FrameMeta, FrameSink, Poll, StreamRequest};
use depthrig_kinect::Recording;
use depthrig_kinect::playback::{CalibrationSource, PlaybackBackend, PlaybackConfig};
use depthrig_kinect_fixture::{Fixture, Pattern};
use rustix::time::{ClockId, clock_gettime};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Memory that is used again, and counts.
#[derive(Default)]
struct Slots {
    memory: Vec<Vec<u8>>,
    frames: u64,
    lost: u64,
    bytes: u64,
}

impl FrameSink for Slots {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        while self.memory.len() <= stream {
            self.memory.push(Vec::new());
        }
        let slot = &mut self.memory[stream];
        if slot.len() < len {
            slot.resize(len, 0);
        }
        self.bytes += len as u64;
        Some(&mut slot[..len])
    }

    fn commit(&mut self, _: usize, _: &FrameMeta) {
        self.frames += 1;
    }

    fn discard(&mut self, _: usize) {}

    fn dropped(&mut self, _: usize, _: DropReason, n: u64) {
        self.lost += n;
    }

    fn captured(&mut self, _: usize, _: u64) {}

    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

fn main() {
    let given = std::env::args().nth(1).map(PathBuf::from);
    let generated = given.is_none().then(|| tempfile::tempdir().unwrap());
    let path = given.unwrap_or_else(|| {
        let fixture = Fixture { captures: 900, ..Fixture::default() };
        let path = generated.as_ref().unwrap().path().join("speed.mkv");
        fixture.write(&path, &mut Pattern::new(&fixture)).unwrap();
        path
    });
    let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let length_s = length_s(&path);
    let size = std::fs::metadata(&path).unwrap().len() as f64 / 1e6;
    println!("{}: {length_s:.1} s, {size:.0} MB; {cores} cores", path.display());
    let streams = |format| {
        let any = |name| StreamRequest::any(Name::new(name).unwrap());
        vec![StreamRequest { format: Some(format), ..any("color") }, any("depth"), any("ir")]
    };
    let mut good = true;
    for (name, format, least_times) in
        [("decoding JPEG", PixelFormat::Rgb8, 10.0), ("passing JPEG through", PixelFormat::Mjpeg, 50.0)]
    {
        // The best of three: the first also fills the page cache.
        let runs: Vec<_> = (0..3).map(|_| play(&path, &streams(format))).collect();
        let least = |of: fn(&Run) -> f64| runs.iter().map(of).fold(f64::INFINITY, f64::min);
        let wall_s = least(|r| r.wall_s);
        let cpu_s = least(|r| r.cpu_s);
        let main_s = least(|r| r.main_s);
        // Two cores share the work, and one of them has all of the playing thread's.
        let two_s = (cpu_s / 2.0).max(main_s);
        let slots = &runs[0].slots;
        println!(
            "{name}: {:.1} x real time by the wall clock, {:.1} x by processor time on two cores ({wall_s:.2} s, {cpu_s:.2} s, of \
             it {main_s:.2} s on the playing thread; {} frames, {:.0} MB, {} lost)",
            length_s / wall_s,
            length_s / two_s,
            slots.frames,
            slots.bytes as f64 / 1e6,
            slots.lost
        );
        if runs.iter().any(|r| r.slots.lost > 0) || (generated.is_some() && length_s / two_s < least_times) {
            println!("  that is lost frames, or less than {least_times} x real time");
            good = false;
        }
    }
    drop(generated);
    if !good {
        std::process::exit(1);
    }
}

/// Times of one run.
struct Run {
    wall_s: f64,
    cpu_s: f64,
    main_s: f64,
    slots: Slots,
}

fn cpu_s(of: ClockId) -> f64 {
    let t = clock_gettime(of);
    t.tv_sec as f64 + t.tv_nsec as f64 / 1e9
}

fn play(path: &Path, streams: &[StreamRequest]) -> Run {
    let config = PlaybackConfig {
        rate: f64::INFINITY,
        calibration: CalibrationSource::None,
        ..PlaybackConfig::new(path)
    };
    let mut stream = PlaybackBackend::new(config).open(None).unwrap().start(streams).unwrap();
    let mut slots = Slots::default();
    let process = cpu_s(ClockId::ProcessCPUTime);
    let thread = cpu_s(ClockId::ThreadCPUTime);
    let began = HostTime::now();
    while stream.poll(Duration::from_millis(50), &mut slots).unwrap() != Poll::End {}
    Run {
        wall_s: began.elapsed().as_secs_f64(),
        cpu_s: cpu_s(ClockId::ProcessCPUTime) - process,
        main_s: cpu_s(ClockId::ThreadCPUTime) - thread,
        slots,
    }
}

/// From the first to the last block, and one period.
fn length_s(path: &Path) -> f64 {
    let mut recording = Recording::open(path).unwrap();
    let period_ns = recording.tracks().iter().find_map(|t| t.period_ns).unwrap_or(33_333_333);
    let mut first = u64::MAX;
    let mut last = 0;
    while let Some(block) = recording.next_block().unwrap() {
        (first, last) = (first.min(block.device_us), last.max(block.device_us));
    }
    (last - first) as f64 / 1e6 + period_ns as f64 / 1e9
}
