//! Images become frames with the camera's own numbers and times, and none is lost without an account.

use super::*;
use crate::family::Family;
use crate::imu::fake::FakeImu;
use crate::protocol::hwm::{HardwareMonitor, Request};
use crate::protocol::metadata::{CaptureTiming, Configuration, DepthControl, PayloadHeader};
use depthrig_bus::{Intrinsics, MetadataLevel, Name, PixelFormat, Pose};
use depthrig_driver::{DeviceClock, MemorySink};
use depthrig_usb::uvc::control::{ControlPort, Query};
use std::collections::VecDeque;

/// An image that the fake transport hands over.
#[derive(Debug, Clone)]
struct FakeImage {
    bytes: Vec<u8>,
    header: Option<Vec<u8>>,
    sequence: u64,
    damaged: bool,
}

/// Hands over one image at each poll, then fails or is idle.
struct Images {
    left: VecDeque<FakeImage>,
    end: Option<ErrorKind>,
    polls: i64,
}

impl ImageSource for Images {
    fn poll(&mut self, _: Duration, each: &mut dyn FnMut(&Image<'_>)) -> Result<bool> {
        self.polls += 1;
        let Some(fake) = self.left.pop_front() else {
            return match self.end {
                Some(kind) => Err(Error::new(kind, "the end")),
                None => Ok(false),
            };
        };
        let arrival = HostTime::from_ns(1_000_000_000 + self.polls * 33_333_333);
        each(&Image {
            source: 0,
            bytes: &fake.bytes,
            damaged: fake.damaged,
            sequence: fake.sequence,
            kernel_time: Some(arrival.plus_ns(-2_000_000)),
            arrival,
            header: fake.header.as_deref(),
        });
        Ok(true)
    }
}

/// Controls that are not there.
struct NoControls;

impl HardwareMonitor for NoControls {
    fn command(&mut self, _: &Request) -> Result<Vec<u8>> {
        Err(Error::new(ErrorKind::Disconnected, "none"))
    }
}

impl ControlPort for NoControls {
    fn query(&mut self, _: u8, _: u8, _: Query, _: &mut [u8]) -> Result<()> {
        Err(Error::new(ErrorKind::Disconnected, "none"))
    }
}

/// The header of a D435's depth frame.
fn header(counter: u32, pts: u32) -> Vec<u8> {
    let timing = CaptureTiming {
        frame_counter: Some(counter),
        sensor_timestamp_us: Some(9_000),
        exposure_us: Some(8_000),
        ..CaptureTiming::default()
    };
    let depth = DepthControl { gain: Some(16), exposure_us: Some(8_500), ..DepthControl::default() };
    let configuration = Configuration { trigger: Some(2), ..Configuration::default() };
    let vendor = [timing.build(), depth.build(), configuration.build()].concat();
    let standard =
        PayloadHeader { flags: 0x8F, pts: Some(pts), scr: Some((1, 2)), ..PayloadHeader::default() };
    standard.build(&vendor).unwrap()
}

fn fake(i: u32) -> FakeImage {
    FakeImage {
        bytes: vec![i as u8; 16],
        header: Some(header(100 + i, 1_000_000 + i * 33_333)),
        sequence: u64::from(i),
        damaged: false,
    }
}

fn profile(stream: &str, format: PixelFormat, level: MetadataLevel) -> StreamProfile {
    StreamProfile {
        stream: Name::new(stream).unwrap(),
        format,
        width: 4,
        height: 2,
        rate_hz: 30.0,
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device: Pose::IDENTITY,
        clock: DeviceClock::microseconds(32),
        sequence_bits: Account::sequence_bits(level),
        metadata: level,
    }
}

/// A stream over `images`: depth, or both imagers out of one source.
fn stream(images: Vec<FakeImage>, end: Option<ErrorKind>, both: bool) -> (RealsenseStream, Arc<Memory>) {
    let level = MetadataLevel::Full;
    let profiles = if both {
        vec![
            (profile("ir_left", PixelFormat::Mono8, level), Unpack::Left),
            (profile("ir_right", PixelFormat::Mono8, level), Unpack::Right),
        ]
    } else {
        vec![(profile("depth", PixelFormat::Z16, level), Unpack::Copy)]
    };
    let stream = |(i, (p, unpack)): (usize, &(StreamProfile, Unpack))| StreamState {
        gate: Gate::new(i, p),
        source: 0,
        unpack: *unpack,
        frame_bytes: p.frame_bytes(),
    };
    let memory = Arc::new(Memory::default());
    let parts = Parts {
        label: "D435 1".to_owned(),
        images: Box::new(Images { left: images.into(), end, polls: 0 }),
        streams: profiles.iter().enumerate().map(stream).collect(),
        profiles: profiles.into_iter().map(|m| m.0).collect(),
        sources: vec![Source { account: Account::new(level), wire_bytes: 16 }],
        control: Control::spawn(
            "D435 1".to_owned(),
            Family::D4xx,
            Box::new(NoControls),
            Box::new(NoControls),
        )
        .unwrap(),
        memory: Arc::clone(&memory),
        imu: None,
        panel: None,
    };
    (RealsenseStream::new(parts), memory)
}

/// Polls until idle or failed.
fn drain(stream: &mut RealsenseStream) -> (MemorySink, Result<Poll>) {
    let mut sink = MemorySink::default();
    loop {
        match stream.poll(Duration::ZERO, &mut sink) {
            Ok(Poll::Frame) => {}
            end => return (sink, end),
        }
    }
}

#[test]
fn a_frame_has_the_cameras_own_number_time_exposure_and_gain() {
    let (mut stream, _) = stream((0..3).map(fake).collect(), None, false);
    let (sink, _) = drain(&mut stream);
    let (_, meta, pixels) = &sink.frames[1];
    assert_eq!((meta.device_sequence, meta.device_time), (101, 1_000_000 + 33_333 - 9_000));
    assert_eq!((meta.exposure_ns, meta.gain), (8_500_000, 16.0));
    assert!(meta.flags.has(FrameFlags::HARDWARE_TRIGGERED) && !meta.flags.has(FrameFlags::HEADER_TIME));
    assert_eq!(pixels, &[1; 16]);
}

#[test]
fn one_interleaved_image_is_two_frames() {
    let image = FakeImage { bytes: (0..16).collect(), ..fake(0) };
    let (mut stream, _) = stream(vec![image], None, true);
    let (sink, _) = drain(&mut stream);
    assert_eq!(sink.frames.len(), 2);
    assert_eq!(sink.frames[0].2, [0, 2, 4, 6, 8, 10, 12, 14]);
    assert_eq!(sink.frames[1].2, [1, 3, 5, 7, 9, 11, 13, 15]);
    assert_eq!(sink.frames[0].1.capture_time, sink.frames[1].1.capture_time);
}

#[test]
fn every_way_of_losing_a_frame_has_its_reason() {
    let mut images: Vec<_> = (0..8).map(fake).collect();
    images[1].bytes.truncate(8);
    images[2].bytes.extend([0; 4]);
    images[3].damaged = true;
    // 4 never comes, 5 comes twice.
    images[4] = images[5].clone();
    for both in [false, true] {
        let (mut stream, _) = stream(images.clone(), None, both);
        let (sink, _) = drain(&mut stream);
        for i in 0..=usize::from(both) {
            let drops = sink.drops_of(i);
            let reasons: Vec<_> = drops.nonzero().collect();
            let expected = [
                (DropReason::DeviceGap, 1),
                (DropReason::Incomplete, 1),
                (DropReason::WrongSize, 1),
                (DropReason::DeviceError, 1),
                (DropReason::OutOfOrder, 1),
            ];
            assert!(expected.iter().all(|e| reasons.contains(e)) && reasons.len() == 5, "{reasons:?}");
            assert_eq!((sink.delivered(i), sink.captured[i]), (4, 9));
        }
    }
}

#[test]
fn frames_before_the_first_metadata_are_booked_and_later_ones_without_it_delivered() {
    let mut images: Vec<_> = (0..5).map(fake).collect();
    for i in [0, 1, 3] {
        images[i].header = None;
    }
    let (mut stream, _) = stream(images, None, false);
    let (sink, _) = drain(&mut stream);
    assert_eq!(sink.drops_of(0).get(DropReason::Incomplete), 2);
    assert_eq!((sink.delivered(0), sink.captured[0]), (3, 5));
    let lost: Vec<_> = sink.frames.iter().map(|f| f.1.flags.has(FrameFlags::METADATA_LOST)).collect();
    assert_eq!(lost, [false, true, false]);
    assert_eq!(sink.frames[1].1.device_sequence, 103);
}

#[test]
fn a_camera_without_the_metadata_it_promised_is_opened_again_without() {
    let without = |i| FakeImage { header: None, ..fake(i) };
    let (mut stream, memory) = stream((0..40).map(without).collect(), None, false);
    let (_, end) = drain(&mut stream);
    assert_eq!(end.unwrap_err().kind(), ErrorKind::Protocol);
    assert!(memory.is_mute());
}

#[test]
fn a_stream_that_failed_stays_dead_and_names_its_camera() {
    let (mut stream, _) = stream(vec![fake(0)], Some(ErrorKind::Disconnected), false);
    let (sink, end) = drain(&mut stream);
    let e = end.unwrap_err();
    assert_eq!((e.kind(), sink.delivered(0)), (ErrorKind::Disconnected, 1));
    assert!(e.to_string().starts_with("D435 1: "), "{e}");
    assert!(stream.poll(Duration::ZERO, &mut MemorySink::default()).is_err());
}

/// A camera that delivers the IMU `fake` alone.
fn imu_alone(fake: &mut FakeImu) -> (RealsenseStream, Arc<Memory>) {
    let (mut stream, memory) = stream(Vec::new(), None, false);
    stream.streams.clear();
    stream.sources.clear();
    stream.profiles = vec![FakeImu::profile()];
    stream.imu = Some(fake.open(0));
    (stream, memory)
}

#[test]
fn an_imu_alone_is_streamed_until_it_ends_with_the_reason() {
    let mut fake = FakeImu::new();
    let (mut stream, _) = imu_alone(&mut fake);
    let mut sink = MemorySink::default();
    let until = HostTime::now().plus(Duration::from_secs(20));
    while sink.delivered(0) < 3 {
        assert!(!until.from_now().is_zero(), "no samples");
        fake.measure(2);
        stream.poll(Duration::from_millis(1), &mut sink).unwrap();
    }
    std::fs::remove_dir_all(fake.path().join("gyro_3d/buffer")).unwrap();
    let end = loop {
        assert!(!until.from_now().is_zero(), "it does not end");
        if let Err(e) = stream.poll(Duration::from_millis(1), &mut sink) {
            break e;
        }
    };
    assert_eq!(end.kind(), ErrorKind::Disconnected);
    assert!(end.to_string().starts_with("D435 1: its IMU is no longer read: "), "{end}");
    assert!(stream.poll(Duration::ZERO, &mut sink).is_err());
}

#[test]
fn a_camera_that_was_asked_for_no_images_is_not_restarted_for_sending_none() {
    let mut fake = FakeImu::new();
    let memory = Arc::new(Memory::default());
    for _ in 0..3 {
        let (mut stream, _) = imu_alone(&mut fake);
        stream.memory = Arc::clone(&memory);
        stream.began = stream.began.plus_ns(-60_000_000_000);
    }
    assert!(!memory.take_reset());
}
