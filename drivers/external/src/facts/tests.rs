//! Each invalid field of a frame's header is replaced, and each valid one is passed on as it is.

use super::*;
use depthrig_bus::{Intrinsics, MetadataLevel, Name, PixelFormat, Pose};
use depthrig_driver::DeviceClock;

const NOW_NS: i64 = 100_000_000_000;

fn profile(domain: ClockDomain) -> StreamProfile {
    StreamProfile {
        stream: Name::new("depth").unwrap(),
        format: PixelFormat::Z16,
        width: 4,
        height: 2,
        rate_hz: 30.0,
        depth_unit_m: 0.001,
        intrinsics: Intrinsics::default(),
        pose_in_device: Pose::IDENTITY,
        clock: DeviceClock { counter_bits: 32, tick_ps: 1_000_000, domain },
        sequence_bits: 16,
        metadata: MetadataLevel::Full,
    }
}

fn header() -> ExternalFrame {
    ExternalFrame {
        sequence: 1,
        device_sequence: 0x1_0005,
        device_time: 0x1_0000_0007,
        arrival_time_ns: NOW_NS - 1_000_000,
        exposure_ns: 8_000_000,
        gain: 2.0,
        temperature_c: 31.5,
        format: PixelFormat::Z16 as u32,
        width: 4,
        height: 2,
        payload_len: 16,
        ..ExternalFrame::default()
    }
}

fn raw_in(domain: ClockDomain, change: impl FnOnce(&mut ExternalFrame)) -> RawFrame {
    let mut header = header();
    change(&mut header);
    Facts::new(&profile(domain), true).raw(&header, 16, HostTime::from_ns(NOW_NS))
}

fn raw(change: impl FnOnce(&mut ExternalFrame)) -> RawFrame {
    raw_in(ClockDomain::Device, change)
}

#[test]
fn what_can_be_is_passed_on() {
    let frame = raw(|_| ());
    assert_eq!((frame.device_sequence, frame.device_ticks), (5, 7), "16 and 32 bits of them count");
    assert_eq!((frame.arrival.ns(), frame.bytes, frame.damaged), (NOW_NS - 1_000_000, 16, false));
    assert_eq!((frame.exposure_ns, frame.gain, frame.temperature_c), (8_000_000, 2.0, 31.5));
    assert_eq!(frame.flags, FrameFlags::default());
    let flagged = raw(|h| h.flags = ExternalFrameFlags::DAMAGED.0 | ExternalFrameFlags::HARDWARE_TRIGGERED.0);
    assert!(flagged.damaged && flagged.flags.has(FrameFlags::HARDWARE_TRIGGERED));
    let mut uncounted = Facts::new(&profile(ClockDomain::Device), false);
    let h = ExternalFrame { sequence: 9, ..header() };
    assert_eq!(
        uncounted.raw(&h, 16, HostTime::from_ns(NOW_NS)).device_sequence,
        9,
        "the process counts then"
    );
}

#[test]
fn only_a_frame_of_the_mode_that_has_its_bytes_is_read() {
    assert_eq!(raw(|h| h.payload_len = 10).bytes, 10, "incomplete, as it says");
    for change in [
        |h: &mut ExternalFrame| h.payload_len = 17,
        |h: &mut ExternalFrame| h.width = 5,
        |h: &mut ExternalFrame| h.height = 3,
        |h: &mut ExternalFrame| h.format = PixelFormat::Mono8 as u32,
    ] {
        assert_eq!(raw(change).bytes, usize::MAX, "a wrong size");
    }
}

#[test]
fn an_arrival_that_cannot_be_is_the_time_of_reading() {
    for said in [NOW_NS + 1, NOW_NS - OLDEST_NS, i64::MIN, i64::MAX] {
        assert_eq!(raw(|h| h.arrival_time_ns = said).arrival.ns(), NOW_NS, "{said}");
    }
    assert_eq!(raw(|h| h.arrival_time_ns = NOW_NS - OLDEST_NS + 1).arrival.ns(), NOW_NS - OLDEST_NS + 1);
    let mut facts = Facts::new(&profile(ClockDomain::Device), true);
    let mut at = |arrival_time_ns, now| {
        let h = ExternalFrame { arrival_time_ns, ..header() };
        facts.raw(&h, 16, HostTime::from_ns(now)).arrival.ns()
    };
    assert_eq!(at(NOW_NS - 10, NOW_NS), NOW_NS - 10);
    assert_eq!(at(NOW_NS - 20, NOW_NS), NOW_NS, "it does not go back");
}

#[test]
fn numbers_that_no_sensor_has_are_unknown() {
    for gain in [f32::NAN, f32::INFINITY, -1.0] {
        assert_eq!(raw(|h| h.gain = gain).gain, 0.0);
    }
    for t in [f32::NAN, f32::INFINITY, -101.0, 251.0] {
        assert!(raw(|h| h.temperature_c = t).temperature_c.is_nan());
    }
    assert_eq!(raw(|h| h.exposure_ns = u64::MAX).exposure_ns, 0);
}

#[test]
fn a_time_of_the_host_that_cannot_be_is_not_believed() {
    let unsure = FrameFlags::METADATA_LOST.with(FrameFlags::TIME_UNCERTAIN);
    let stamp = |ns: i64| raw_in(ClockDomain::Kernel, |h| h.device_time = ns.cast_unsigned());
    let arrival = NOW_NS - 1_000_000;
    assert_eq!(
        (stamp(arrival - 5).device_ticks, stamp(arrival - 5).flags),
        (arrival as u64 - 5, FrameFlags::default())
    );
    for ns in [arrival + 1, arrival - OLDEST_NS, -1, 0] {
        assert_eq!((stamp(ns).device_ticks, stamp(ns).flags), (arrival as u64, unsure), "{ns}");
    }
    let lost = raw_in(ClockDomain::Kernel, |h| h.flags = ExternalFrameFlags::METADATA_LOST.0);
    assert_eq!((lost.device_ticks, lost.flags), (arrival as u64, unsure));
    assert_eq!(raw_in(ClockDomain::Arrival, |_| ()).device_ticks, arrival as u64);
}

#[test]
fn a_time_of_the_device_that_did_not_come_goes_on_from_the_last() {
    let mut facts = Facts::new(&profile(ClockDomain::Device), true);
    let mut at = |device_time, later_ms: i64, lost: bool| {
        let arrival_time_ns = NOW_NS + later_ms * 1_000_000;
        let flags = if lost { ExternalFrameFlags::METADATA_LOST.0 } else { 0 };
        let h = ExternalFrame { device_time, arrival_time_ns, flags, ..header() };
        facts.raw(&h, 16, HostTime::from_ns(arrival_time_ns))
    };
    assert_eq!(at(0xFFFF_FFFF, 0, false).device_ticks, 0xFFFF_FFFF);
    let lost = at(0, 10, true);
    assert_eq!(lost.device_ticks, 9999, "10 ms of microseconds later, around the end of 32 bits");
    assert!(lost.flags.has(FrameFlags::METADATA_LOST) && lost.flags.has(FrameFlags::TIME_UNCERTAIN));
    assert_eq!(at(0, 20, true).device_ticks, 19_999);
}

#[test]
fn frames_that_the_process_lost_are_counted_once() {
    let mut facts = Facts::new(&profile(ClockDomain::Device), true);
    let lost = [1, 2, 5, 5, 4, 6, u64::MAX]
        .map(|sequence| facts.lost_before(&ExternalFrame { sequence, ..header() }));
    assert_eq!(lost, [0, 0, 2, 0, 0, 0, u64::MAX - 7]);
}

#[test]
fn a_header_of_something_else_is_none() {
    assert!(is_header(&header()));
    for change in [
        |h: &mut ExternalFrame| h.magic[3] = b'X',
        |h: &mut ExternalFrame| h.version = 2,
        |h: &mut ExternalFrame| h.size = 127,
    ] {
        let mut h = header();
        change(&mut h);
        assert!(!is_header(&h));
    }
}
