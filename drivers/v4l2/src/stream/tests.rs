//! Images through a stream without a kernel: what is delivered, what is dropped and why, and at which time.

use super::*;
use depthrig_bus::{Intrinsics, Pose, StreamName};
use depthrig_driver::MemorySink;

fn profile(format: PixelFormat, clock: &StreamClock) -> StreamProfile {
    let (clock, metadata) = clock.of_profile();
    StreamProfile {
        stream: StreamName::new("color").unwrap(),
        format,
        width: 8,
        height: 4,
        rate_hz: 30.0,
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device: Pose::IDENTITY,
        clock,
        sequence_bits: 64,
        metadata,
    }
}

fn stream(format: PixelFormat, stride: u32, clock: StreamClock) -> StreamState {
    let profile = profile(format, &clock);
    let layout = Layout { bytes_per_line: stride, size_image: 1000 };
    let unpack = Unpack::of(&profile, layout);
    StreamState { name: "test".into(), gate: Gate::new(0, &profile), unpack, clock }
}

fn image(bytes: &[u8], sequence: u64) -> Image<'_> {
    Image {
        source: 0,
        bytes,
        damaged: false,
        sequence,
        kernel_time: Some(HostTime::from_ns(1_000_000)),
        arrival: HostTime::from_ns(5_000_000),
        header: None,
    }
}

const KERNEL: StreamClock = StreamClock::Kernel { said: false };

#[test]
fn padded_rows_arrive_without_their_padding() {
    let mut stream = stream(PixelFormat::Mono8, 11, KERNEL);
    let padded: Vec<u8> = (0..44).collect();
    let mut sink = MemorySink::default();
    stream.copy(&image(&padded, 0), &mut sink);
    stream.copy(&image(&padded[..41], 1), &mut sink);
    let expected: Vec<u8> = [0..8, 11..19, 22..30, 33..41].into_iter().flatten().collect();
    assert_eq!(sink.frames.iter().map(|f| f.2.clone()).collect::<Vec<_>>(), [expected.clone(), expected]);
}

#[test]
fn nv12_has_its_second_plane() {
    let mut stream = stream(PixelFormat::Nv12, 8, KERNEL);
    let mut sink = MemorySink::default();
    let bytes: Vec<u8> = (0..48).collect();
    stream.copy(&image(&bytes, 0), &mut sink);
    assert_eq!(sink.frames[0].2, bytes);
}

#[test]
fn what_is_short_damaged_or_skipped_is_counted_by_its_reason() {
    let mut stream = stream(PixelFormat::Mono8, 8, KERNEL);
    let mut sink = MemorySink::default();
    let whole = [7; 32];
    stream.copy(&image(&whole, 10), &mut sink);
    stream.copy(&image(&whole[..31], 11), &mut sink);
    stream.copy(&image(&[], 12), &mut sink);
    stream.copy(&Image { damaged: true, ..image(&whole, 13) }, &mut sink);
    stream.copy(&image(&whole, 17), &mut sink);
    let drops = sink.drops_of(0);
    assert_eq!((sink.captured[0], sink.delivered(0)), (8, 2));
    assert_eq!(drops.get(DropReason::Incomplete), 2);
    assert_eq!(drops.get(DropReason::DeviceError), 1);
    assert_eq!(drops.get(DropReason::DeviceGap), 3);
    assert_eq!(drops.total(), 6);
}

#[test]
fn a_lent_frame_is_published_or_given_back_and_never_copied() {
    let mut stream = stream(PixelFormat::Mono8, 8, KERNEL);
    let mut sink = MemorySink::lending();
    let filled =
        Filled { bytes: 32, damaged: false, sequence: 0, kernel_time: None, arrival: HostTime::from_ns(9) };
    let mut loan = sink.lend(0, 32).unwrap();
    loan.bytes_mut().fill(3);
    let at = loan.bytes_mut().as_ptr();
    let mut loan = stream.publish(&Filled { damaged: true, ..filled }, loan, &mut sink).unwrap();
    assert_eq!(loan.bytes_mut().as_ptr(), at, "it stays where it is");
    assert!(stream.publish(&Filled { sequence: 1, ..filled }, loan, &mut sink).is_none());
    assert_eq!(sink.frames[0].2, [3; 32]);
    assert_eq!((sink.delivered(0), sink.drops_of(0).get(DropReason::DeviceError)), (1, 1));
}

#[test]
fn a_stamp_ahead_of_time_is_moved_back_and_flagged() {
    let mut stream = stream(PixelFormat::Mono8, 8, KERNEL);
    let mut sink = MemorySink::default();
    let ahead = Image { kernel_time: Some(HostTime::from_ns(35_000_000)), ..image(&[0; 32], 1) };
    stream.copy(&image(&[0; 32], 0), &mut sink);
    stream.copy(&ahead, &mut sink);
    stream.copy(&Image { kernel_time: None, ..image(&[0; 32], 2) }, &mut sink);
    let seen: Vec<_> = sink
        .frames
        .iter()
        .map(|f| (f.1.capture_time.ns(), f.1.flags.has(FrameFlags::TIME_UNCERTAIN)))
        .collect();
    assert_eq!(seen, [(1_000_000, false), (5_000_000, true), (5_000_000, true)]);
}

#[test]
fn a_device_clock_goes_on_over_a_lost_header() {
    let mut stream = stream(PixelFormat::Mono8, 8, StreamClock::Device { hz: 100_000, last: None });
    let mut sink = MemorySink::default();
    // Length 6, flags PTS and end of header, ticks 4294967290: the counter wraps 5 ticks later.
    let header = [6, 0x84, 0xFA, 0xFF, 0xFF, 0xFF];
    stream.copy(&Image { header: Some(&header), ..image(&[0; 32], 0) }, &mut sink);
    let later = Some(HostTime::from_ns(1_000_000 + 33_000_000));
    stream.copy(
        &Image { kernel_time: later, arrival: HostTime::from_ns(38_000_000), ..image(&[0; 32], 1) },
        &mut sink,
    );
    let seen: Vec<_> =
        sink.frames.iter().map(|f| (f.1.device_time, f.1.flags.has(FrameFlags::METADATA_LOST))).collect();
    assert_eq!(seen, [(4_294_967_290, false), (4_294_967_290 + 3300, true)]);
    assert!(sink.frames.iter().all(|f| f.1.flags.has(FrameFlags::HEADER_TIME)));
    assert!(sink.frames.iter().all(|f| f.1.clock_domain == ClockDomain::Device));
}

#[test]
fn a_jpeg_image_without_its_end_is_incomplete() {
    let mut stream = stream(PixelFormat::Mjpeg, 0, KERNEL);
    let mut sink = MemorySink::default();
    let jpeg = [0xFF, 0xD8, 1, 2, 3, 0xFF, 0xD9, 0, 0];
    stream.copy(&image(&jpeg, 0), &mut sink);
    stream.copy(&image(&jpeg[..6], 1), &mut sink);
    assert_eq!(sink.frames[0].2, jpeg[..7], "padding is cut off");
    assert_eq!(sink.drops_of(0).get(DropReason::Incomplete), 1);
}
