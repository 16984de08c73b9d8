//! How fast recordings of an Azure Kinect are played, in multiples of their own length.
//!
//! `cargo run --release -p depthrig-kinect-fixture --example kinect_speed [-- FILE.mkv]`; without a file, one of 30 s of
//! 720p JPEG (150 kB a picture), depth and infrared of the narrow field of view and motion is made first. Frames go into
//! memory that is used again, as the slots of a channel are. Time is that of the wall; the number of cores is printed, and
//! `taskset -c 0,1` makes it two.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)] // a measuring program: any failure ends it

use depthrig_bus::{DropReason, HostTime, Name, PixelFormat};
use depthrig_drivers::clock::ClockQuality;
use depthrig_drivers::kinect::Recording;
use depthrig_drivers::kinect::playback::{CalibrationSource, PlaybackBackend, PlaybackConfig};
use depthrig_drivers::{Backend, FrameMeta, FrameSink, Poll, StreamRequest};
use depthrig_kinect_fixture::{Fixture, Pattern};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Memory that is used again, and counts.
#[derive(Default)]
struct Slots {
    slots: Vec<Vec<u8>>,
    frames: u64,
    lost: u64,
    bytes: u64,
}

impl FrameSink for Slots {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        while self.slots.len() <= stream {
            self.slots.push(Vec::new());
        }
        let slot = &mut self.slots[stream];
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
    let made = given.is_none().then(|| tempfile::tempdir().unwrap());
    let path = given.unwrap_or_else(|| {
        let fixture = Fixture { captures: 900, ..Fixture::default() };
        let path = made.as_ref().unwrap().path().join("speed.mkv");
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
    for (name, format) in [("decoding JPEG", PixelFormat::Rgb8), ("passing JPEG through", PixelFormat::Mjpeg)]
    {
        // The best of three: the first also fills the page cache.
        let best = (0..3).map(|_| play(&path, &streams(format))).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
        let (took, slots) = best;
        println!(
            "{name}: {:.1} x real time ({took:.2} s for {} frames, {:.0} MB/s written, {} lost)",
            length_s / took,
            slots.frames,
            slots.bytes as f64 / 1e6 / took,
            slots.lost
        );
    }
}

fn play(path: &Path, streams: &[StreamRequest]) -> (f64, Slots) {
    let config = PlaybackConfig {
        rate: f64::INFINITY,
        calibration: CalibrationSource::None,
        ..PlaybackConfig::new(path)
    };
    let mut stream = PlaybackBackend::new(config).open(None).unwrap().start(streams).unwrap();
    let mut slots = Slots::default();
    let began = HostTime::now();
    while stream.poll(Duration::from_millis(50), &mut slots).unwrap() != Poll::End {}
    (began.elapsed().as_secs_f64(), slots)
}

/// From the first to the last block, and one period.
fn length_s(path: &Path) -> f64 {
    let mut recording = Recording::open(path).unwrap();
    let period_ns = recording.tracks().iter().find_map(|t| t.period_ns).unwrap_or(33_333_333);
    let (mut first, mut last) = (u64::MAX, 0);
    while let Some(block) = recording.next_block().unwrap() {
        (first, last) = (first.min(block.device_us), last.max(block.device_us));
    }
    (last - first) as f64 / 1e6 + period_ns as f64 / 1e9
}
