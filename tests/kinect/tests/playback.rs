//! A recording of an Azure Kinect as a camera: the suite of all drivers, its pixels, times, counts and rounds.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Distortion, DropReason, FrameFlags, HostTime, MotionSample, Name, PixelFormat, Pose};
use depthrig_driver::{Backend, DeviceInfo, ErrorKind, MemorySink, Poll, Stream, StreamRequest};
use depthrig_kinect::playback::{CalibrationSource, PlaybackBackend, PlaybackConfig};
use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode, WiredSync};
use depthrig_kinect_fixture::{ACCEL_LATE_NS, Fixture, Images, Lacing, Pattern, damage_time, motion};
use depthrig_sim::conformance::{self, Bench, Cannot, Rig, Sent, Subject, Trouble};
use std::path::{Path, PathBuf};
use std::time::Duration;
use tempfile::TempDir;

fn write(dir: &Path, fixture: &Fixture) -> PathBuf {
    let path = dir.join("kinect.mkv");
    fixture.write(&path, &mut Pattern::new(fixture)).unwrap();
    path
}

fn start(config: PlaybackConfig, requests: &[StreamRequest]) -> (DeviceInfo, Box<dyn Stream>) {
    let device = PlaybackBackend::new(config).open(None).unwrap();
    (device.info().clone(), device.start(requests).unwrap())
}

fn play(stream: &mut dyn Stream, frames: usize) -> MemorySink {
    let mut sink = MemorySink::default();
    while sink.frames.len() < frames
        && stream.poll(Duration::from_millis(50), &mut sink).unwrap() != Poll::End
    {}
    sink
}

/// As fast as it is taken, to its end.
fn all(path: &Path, requests: &[StreamRequest]) -> MemorySink {
    let config = PlaybackConfig { rate: f64::INFINITY, ..PlaybackConfig::new(path) };
    play(start(config, requests).1.as_mut(), usize::MAX)
}

fn color(fixture: &Fixture, n: u32) -> Vec<u8> {
    let bytes = Pattern::new(fixture).color(n);
    match fixture.color.unwrap().format {
        ColorFormat::Mjpg => depthrig_jpeg::decode(&bytes).unwrap().pixels,
        ColorFormat::Bgra => bytes.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
        ColorFormat::Nv12 | ColorFormat::Yuy2 => bytes,
    }
}

fn words(pixels: &[u16]) -> Vec<u8> {
    pixels.iter().flat_map(|p| p.to_le_bytes()).collect()
}

/// A recording that plays ten times as fast as it was taken, without end.
struct Recorded;

const BENCH: u32 = 5;

fn bench() -> Fixture {
    Fixture { captures: BENCH, ..Fixture::small() }
}

impl Subject for Recorded {
    fn name(&self) -> String {
        "kinect (recording)".into()
    }

    fn make(&self) -> Bench {
        let dir = tempfile::tempdir().unwrap();
        let config =
            PlaybackConfig { looped: true, rate: 3.0, ..PlaybackConfig::new(write(dir.path(), &bench())) };
        Bench {
            backend: Box::new(PlaybackBackend::new(config)),
            serial: "000123456789".into(),
            // The IMU has a case of its own.
            requests: ["color", "depth", "ir"].map(|s| StreamRequest::any(Name::new(s).unwrap())).into(),
            rig: Box::new(RecordedRig(dir)),
        }
    }
}

struct RecordedRig(TempDir);

impl Rig for RecordedRig {
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot> {
        assert!(self.0.path().exists());
        Err(Cannot(match trouble {
            Trouble::Unplug(_) | Trouble::Busy(_) => "a file is neither plugged in nor held by one process",
            Trouble::Stall(_) | Trouble::Hang(_) => "reading a file cannot be made to wait",
            Trouble::HalfFrame(_)
            | Trouble::WrongSize(_)
            | Trouble::Damaged(_)
            | Trouble::Repeated(_)
            | Trouble::Skip(_) => "what is in the file is what comes",
            Trouble::TimeBackwards(_) | Trouble::ClockReset => "the clock goes on from round to round",
        }))
    }

    fn sent(&self, _: usize) -> Option<Sent> {
        None
    }

    fn true_capture(&self, _: usize, _: HostTime) -> Option<(HostTime, u64)> {
        None
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        let f = bench();
        let mut pattern = Pattern::new(&f);
        Some((0..BENCH).any(|n| match stream {
            0 => color(&f, n) == pixels,
            1 => words(&pattern.depth(n)) == pixels,
            _ => words(&pattern.infrared(n)) == pixels,
        }))
    }
}

#[test]
fn a_recording_passes_every_case_that_a_file_can_be_put_to() {
    let report = conformance::run(&Recorded);
    println!("{report}");
    assert!(report.is_good(), "{report}");
    let device_faults = ["half_frame", "wrong_size", "damaged", "repeated", "skip", "stall"];
    let device_life = ["time_backwards", "clock_reset", "unplug", "busy", "hang"];
    assert_eq!(report.not_applicable(), [&["clock"][..], &device_faults, &device_life].concat());
}

#[test]
fn every_format_comes_as_it_was_recorded() {
    let dir = tempfile::tempdir().unwrap();
    let modes = [ColorFormat::Mjpg, ColorFormat::Nv12, ColorFormat::Yuy2, ColorFormat::Bgra];
    let formats = [PixelFormat::Rgb8, PixelFormat::Nv12, PixelFormat::Yuyv, PixelFormat::Bgr8];
    for (format, wanted) in modes.into_iter().zip(formats) {
        let fixture = Fixture {
            color: Some(ColorMode { format, resolution: ColorResolution::P720 }),
            captures: 7,
            early: format == ColorFormat::Nv12,
            ..Fixture::small()
        };
        let path = write(dir.path(), &fixture);
        let (_, stream) = start(PlaybackConfig::new(&path), &[]);
        assert_eq!(stream.profiles()[0].format, wanted);
        drop(stream);
        let sink = all(&path, &[]);
        let of = |stream: usize| sink.frames.iter().filter(move |f| f.0 == stream).zip(0..);
        let mut pattern = Pattern::new(&fixture);
        assert!((0..3).all(|i| sink.delivered(i) == 7), "{format:?}");
        assert!(of(0).all(|(f, n)| f.2 == color(&fixture, n)), "{format:?}");
        assert!(of(1).all(|(f, n)| f.2 == words(&pattern.depth(n))), "{format:?}");
        assert!(of(2).all(|(f, n)| f.2 == words(&pattern.infrared(n))), "{format:?}");
    }
}

#[test]
fn frames_of_a_recorded_subordinate_were_triggered() {
    let dir = tempfile::tempdir().unwrap();
    for wired_sync in WiredSync::ALL {
        let fixture = Fixture { captures: 2, wired_sync, ..Fixture::small() };
        let sink = all(&write(dir.path(), &fixture), &[]);
        let is_triggered = |f: &FrameFlags| f.has(FrameFlags::HARDWARE_TRIGGERED);
        let wanted = wired_sync == WiredSync::Subordinate;
        let images: Vec<_> = sink.frames.iter().filter(|f| f.0 < 3).collect();
        assert!(images.iter().all(|f| is_triggered(&f.1.flags) == wanted), "{wired_sync:?}");
        assert_eq!(images.len(), 6);
    }
}

#[test]
fn jpeg_is_kept_where_that_is_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 4, ..Fixture::default() };
    let kept =
        StreamRequest { format: Some(PixelFormat::Mjpeg), ..StreamRequest::any(Name::new("color").unwrap()) };
    let sink = all(&write(dir.path(), &fixture), &[kept]);
    let mut pattern = Pattern::new(&fixture);
    assert_eq!(sink.frames.len(), 4);
    assert!(sink.frames.iter().zip(0..).all(|(f, n)| f.2 == pattern.color(n)));
}

#[test]
fn times_are_those_of_the_devices_clock() {
    let dir = tempfile::tempdir().unwrap();
    // Two captures were lost while it was recorded.
    let fixture = Fixture { captures: 24, lost: vec![9, 10], depth_delay_ns: 160_000, ..Fixture::small() };
    let (info, mut stream) = start(PlaybackConfig::new(write(dir.path(), &fixture)), &[]);
    assert_eq!(
        (info.backend, info.model.as_str(), info.serial.as_str()),
        ("kinect", "Azure Kinect", "000123456789")
    );
    assert_eq!(
        (info.firmware.as_str(), info.calibration.as_str()),
        ("color 1.6.110, depth 1.6.79", "factory")
    );
    let began = HostTime::now();
    let sink = play(stream.as_mut(), usize::MAX);
    let took = began.elapsed().as_secs_f64();
    assert!(took > 23.0 / 30.0 - 0.01, "{took} s");
    let there: Vec<u32> = (0..24).filter(|n| !fixture.lost.contains(n)).collect();
    for stream in 0..3 {
        let frames: Vec<_> = sink.frames.iter().filter(|f| f.0 == stream).map(|f| f.1).collect();
        assert_eq!(frames.len(), there.len());
        assert_eq!(sink.drops_of(stream).get(DropReason::DeviceGap), 2, "what the recorder lost");
        for (meta, n) in frames.iter().zip(&there) {
            let (color, depth) = fixture.times_us(*n);
            assert_eq!(meta.device_time, if stream == 0 { color } else { depth });
            assert_eq!(meta.device_sequence, u64::from(*n));
        }
    }
    assert_eq!(
        stream.poll(Duration::ZERO, &mut MemorySink::default()).unwrap(),
        Poll::End,
        "it stays at its end"
    );
}

#[test]
fn the_clock_goes_on_from_round_to_round() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { color: None, captures: 6, ..Fixture::small() };
    let config =
        PlaybackConfig { looped: true, rate: 8.0, ..PlaybackConfig::new(write(dir.path(), &fixture)) };
    let (_, mut stream) = start(config, &[]);
    let sink = play(stream.as_mut(), 40);
    let depth: Vec<_> = sink.frames.iter().filter(|f| f.0 == 0).collect();
    let first = fixture.times_us(0).1;
    for (f, n) in depth.iter().zip(0..) {
        assert_eq!(f.1.device_sequence, n);
        let wanted = first + n * 33_333 / 8;
        assert!(f.1.device_time.abs_diff(wanted) <= 8, "{n}: {} {wanted}", f.1.device_time);
        assert!(f.2 == words(&Pattern::new(&fixture).depth(n as u32 % 6)), "image {n}");
    }
    assert!(sink.drops.iter().all(|d| d.total() == 0));
}

#[test]
fn intrinsics_and_poses_follow_the_calibration() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { depth: Some(DepthMode::NfovUnbinned), captures: 2, ..Fixture::small() };
    let path = write(dir.path(), &fixture);
    let (_, stream) = start(PlaybackConfig::new(&path), &[]);
    let [color, depth, ir, _imu] = stream.profiles() else { panic!("three cameras and an IMU") };
    assert!((depth.intrinsics.cx - 332.78128).abs() < 1e-9 && depth.intrinsics == ir.intrinsics);
    assert_eq!((color.intrinsics.distortion(), depth.depth_unit_m), (Distortion::Rational, 0.001));
    assert!((color.pose_in_device.translation_m[0] - 0.032).abs() < 1e-3);
    assert_eq!((ir.format, ir.depth_unit_m, color.rate_hz), (PixelFormat::Mono16, 0.0, 30.0));
    drop(stream);
    // Without one it is refused, unless that is wanted.
    let fixture = Fixture { calibration: None, serial: String::new(), ..fixture };
    let path = write(dir.path(), &fixture);
    let e = PlaybackBackend::new(PlaybackConfig::new(&path)).open(None).err().unwrap();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("no calibration.json"), "{e}");
    let none = PlaybackConfig { calibration: CalibrationSource::None, ..PlaybackConfig::new(&path) };
    let (info, stream) = start(none, &[]);
    assert_eq!((info.serial.as_str(), info.calibration.as_str()), ("kinect", "none"));
    assert!(!stream.profiles()[0].intrinsics.is_known());
    drop(stream);
    let other = dir.path().join("device.json");
    std::fs::write(&other, depthrig_kinect_fixture::CALIBRATION).unwrap();
    let given = PlaybackConfig { calibration: CalibrationSource::At(other), ..PlaybackConfig::new(&path) };
    assert!(start(given, &[]).1.profiles()[0].intrinsics.is_known());
}

#[test]
fn an_image_that_cannot_be_decoded_is_a_counted_loss() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 5, checksums: false, motion: false, ..Fixture::default() };
    let (mut bytes, written) = fixture.bytes_and_places();
    // The second JPEG has no start, the fourth no end.
    let find = |bytes: &[u8], from: u64| {
        bytes[from as usize..].windows(2).position(|w| w == [0xFF, 0xD8]).unwrap() + from as usize
    };
    let second = find(&bytes, written.clusters[1]);
    bytes[second] = 0;
    let fourth = find(&bytes, written.clusters[3]);
    let end = bytes[fourth..].windows(2).position(|w| w == [0xFF, 0xD9]).unwrap() + fourth;
    bytes[end] = 0;
    let path = dir.path().join("damaged.mkv");
    std::fs::write(&path, bytes).unwrap();
    let sink = all(&path, &[]);
    assert_eq!((sink.delivered(0), sink.delivered(1)), (3, 5));
    assert_eq!(sink.drops_of(0).total(), 2);
    let kept =
        StreamRequest { format: Some(PixelFormat::Mjpeg), ..StreamRequest::any(Name::new("color").unwrap()) };
    let sink = all(&path, &[kept]);
    let drops = sink.drops_of(0);
    assert_eq!((drops.get(DropReason::WrongSize), drops.get(DropReason::Incomplete)), (1, 1));
}

fn motion_of(sink: &MemorySink, stream: usize) -> Vec<MotionSample> {
    sink.frames.iter().filter(|f| f.0 == stream).flat_map(|f| MotionSample::all_in(&f.2)).collect()
}

fn request(stream: &str) -> StreamRequest {
    StreamRequest::any(Name::new(stream).unwrap())
}

/// All samples of the file, however they share blocks, in real time, as fast as they are taken, and alone.
#[test]
fn imu_samples_are_played_with_the_images() {
    let dir = tempfile::tempdir().unwrap();
    for lacing in [Lacing::None, Lacing::Xiph, Lacing::Fixed, Lacing::Ebml] {
        let fixture = Fixture { lacing, captures: 8, lost: vec![3], ..Fixture::small() };
        let path = write(dir.path(), &fixture);
        let (_, written) = fixture.bytes_and_places();
        let check = |sink: &MemorySink, stream: usize, is_paced: bool| {
            let samples = motion_of(sink, stream);
            assert_eq!(samples.len() as u64, written.motion, "{lacing:?}");
            for (i, s) in (0..).zip(&samples) {
                let (at_ns, acceleration, rotation) = motion(&fixture, i);
                assert_eq!((s.sequence, s.gyro_rad_s, s.accel_m_s2), (i, rotation, acceleration));
                assert_eq!((s.accel_offset_ns, s.temperature_c.is_nan()), (ACCEL_LATE_NS as i32, true));
                if is_paced {
                    assert_eq!(s.device_time, at_ns / 1000);
                }
            }
            assert!(samples.is_sorted_by(|a, b| a.time_ns < b.time_ns), "times rise");
            let of = |s: usize| sink.frames.iter().filter(move |f| f.0 == s);
            assert!(of(stream).all(|f| f.1.capture_time <= f.1.arrival && f.2.len() <= 64 * 64));
            assert_eq!((sink.captured[stream], sink.drops_of(stream).total()), (sink.delivered(stream), 0));
        };
        let fast = all(&path, &[]);
        check(&fast, 3, false);
        assert_eq!([0, 1, 2].map(|s| fast.delivered(s)), [7; 3]);
        check(&all(&path, &[request("imu")]), 0, false);
        check(&all(&path, &[request("imu"), request("color")]), 0, false);
        let config = PlaybackConfig { rate: 2.0, ..PlaybackConfig::new(&path) };
        let (_, mut stream) = start(config, &[request("depth"), request("imu")]);
        check(&play(stream.as_mut(), usize::MAX), 1, false);
        let (_, mut stream) = start(PlaybackConfig::new(&path), &[request("depth"), request("imu")]);
        assert_eq!(stream.profiles()[1].describe(), "imu motion 1600 Hz in batches of up to 64");
        let sink = play(stream.as_mut(), usize::MAX);
        check(&sink, 1, true);
        // Samples and images of one moment of the device have nearly one time of the host, since both come when they
        // are due: within a period and what a busy machine adds.
        let depth = &sink.frames.iter().rfind(|f| f.0 == 0).unwrap().1;
        let near = motion_of(&sink, 1)
            .into_iter()
            .min_by_key(|s| s.device_time.abs_diff(depth.device_time))
            .unwrap();
        let apart_ns = near.time().since_ns(depth.capture_time).abs();
        assert!(apart_ns < 40_000_000, "{apart_ns} ns apart");
    }
}

/// Colour alone is decoded from a pass over the file of its own; the other pass must not run ahead to the end.
#[test]
fn colour_alone_begins_before_the_file_is_read() {
    let read_by_me = || {
        let io = std::fs::read_to_string("/proc/thread-self/io").unwrap();
        let first = io.lines().next().unwrap().strip_prefix("rchar: ").unwrap();
        first.parse::<u64>().unwrap()
    };
    let dir = tempfile::tempdir().unwrap();
    let color = Some(ColorMode { format: ColorFormat::Mjpg, resolution: ColorResolution::P720 });
    let path = write(dir.path(), &Fixture { color, captures: 30, ..Fixture::small() });
    let bytes = path.metadata().unwrap().len();
    let (_, mut stream) = start(PlaybackConfig::new(&path), &[request("color")]);
    let before = read_by_me();
    let sink = play(stream.as_mut(), 1);
    let read = read_by_me() - before;
    assert_eq!(sink.delivered(0), 1);
    assert!(read < bytes / 4, "{read} of {bytes} bytes were read for the first image");
    assert_eq!(all(&path, &[request("color")]).delivered(0), 30);
}

/// A sample of another century is left out; those around it are played.
#[test]
fn a_sample_whose_time_is_damaged_does_not_hold_up_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { checksums: false, captures: 8, ..Fixture::small() };
    let path = write(dir.path(), &fixture);
    let written = fixture.bytes_and_places().1.motion;
    damage_time(&path, &fixture, 70);
    let samples = motion_of(&all(&path, &[request("imu")]), 0);
    assert_eq!(samples.len() as u64, written - 1);
    assert!(samples.is_sorted_by(|a, b| a.sequence < b.sequence && a.time_ns < b.time_ns));
    let config = PlaybackConfig { looped: true, rate: f64::INFINITY, ..PlaybackConfig::new(&path) };
    let sink = play(start(config, &[request("depth"), request("imu")]).1.as_mut(), 60);
    assert!(motion_of(&sink, 1).len() as u64 > written, "rounds after the first have samples");
}

/// Round after round numbers and times go on.
#[test]
fn samples_of_a_recording_that_is_played_without_end_never_go_back() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 4, ..Fixture::small() };
    let path = write(dir.path(), &fixture);
    let config = PlaybackConfig { looped: true, rate: 8.0, ..PlaybackConfig::new(&path) };
    let (_, mut stream) = start(config, &[request("imu"), request("depth")]);
    let sink = play(stream.as_mut(), 60);
    let samples = motion_of(&sink, 0);
    let rounds = samples.iter().filter(|s| s.gyro_rad_s[2] == 0.0).count();
    assert!(rounds >= 3, "{rounds} rounds");
    for pair in samples.windows(2) {
        assert!(pair[0].sequence < pair[1].sequence && pair[0].time_ns < pair[1].time_ns, "{pair:?}");
        assert!(pair[1].sequence - pair[0].sequence <= 2, "{pair:?}");
    }
}

#[test]
fn where_the_imu_sits_is_in_the_calibration() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), &Fixture::small());
    let imu = |calibration| {
        let config = PlaybackConfig { calibration, ..PlaybackConfig::new(&path) };
        let device = PlaybackBackend::new(config).open(None).unwrap();
        device.profiles().iter().find(|p| p.stream.as_str() == "imu").unwrap().pose_in_device
    };
    // Rows of the accelerometer's rotation: 0 -1 0, 0 0 -1, 1 0 0; its inverse turned by the translation.
    let t = imu(CalibrationSource::Recorded).translation_m;
    assert!(t.iter().zip([-0.0015, -0.051, 0.0034]).all(|(a, b)| (a - b).abs() < 1e-6), "{t:?}");
    assert_eq!(imu(CalibrationSource::None), Pose::IDENTITY);
    let still = Fixture { motion: false, ..Fixture::small() };
    let path = write(dir.path(), &still);
    let e =
        PlaybackBackend::new(PlaybackConfig::new(&path)).open(None).unwrap().start(&[request("imu")]).err();
    assert!(e.unwrap().to_string().contains("no such mode of \"imu\""));
}
