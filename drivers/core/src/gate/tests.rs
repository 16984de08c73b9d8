//! The gate's accounts are exact whatever a device does with its frame counter.

use super::Outcome::{AlreadyCounted, Delivered, Dropped};
use super::*;
use crate::{DeviceClock, MemorySink};
use depthrig_bus::{Intrinsics, MetadataLevel, Name, Pose};
use proptest::prelude::*;

fn profile(sequence_bits: u32, domain: ClockDomain) -> StreamProfile {
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
        sequence_bits,
        metadata: MetadataLevel::Full,
    }
}

const PERIOD_NS: i64 = 33_333_333;

fn raw(sequence: u64, i: i64) -> RawFrame {
    let arrival = HostTime::from_ns(1_000_000_000 + i * PERIOD_NS);
    RawFrame::new(sequence, (i * PERIOD_NS / 1000) as u64, arrival, 16)
}

fn feed(gate: &mut Gate, sink: &mut MemorySink, raw: &RawFrame) -> Outcome {
    gate.deliver(raw, sink, |memory| {
        memory.fill(7);
        Ok(())
    })
}

#[test]
fn a_gap_whose_reason_is_known_is_counted_for_it() {
    let mut gate = Gate::new(0, &profile(32, ClockDomain::Device));
    let mut sink = MemorySink::default();
    gate.explain_gap(2, DropReason::QueueFull); // before the first, which the counter alone cannot show
    feed(&mut gate, &mut sink, &raw(10, 0));
    gate.explain_gap(1, DropReason::QueueFull);
    feed(&mut gate, &mut sink, &raw(14, 1)); // 11 to 13 are missing, one of them by the host
    let lost =
        |gate: &Gate| (gate.drops().get(DropReason::QueueFull), gate.drops().get(DropReason::DeviceGap));
    assert_eq!(lost(&gate), (3, 2));
    gate.explain_gap(100, DropReason::QueueFull);
    feed(&mut gate, &mut sink, &raw(16, 2)); // no more than are missing
    assert_eq!(lost(&gate), (4, 2));
    feed(&mut gate, &mut sink, &raw(18, 3)); // said once, it counts for one frame
    assert_eq!(lost(&gate), (4, 3));
    assert_eq!(gate.captured(), gate.delivered() + gate.drops().total());
}

#[test]
fn a_counter_that_jumps_by_more_than_any_camera_loses_was_set_anew() {
    let mut gate = Gate::new(0, &profile(64, ClockDomain::Device));
    let mut sink = MemorySink::default();
    for (i, sequence) in [1, 2, u64::MAX / 2, u64::MAX - 1, u64::MAX, 3].into_iter().enumerate() {
        feed(&mut gate, &mut sink, &raw(sequence, i as i64));
    }
    assert_eq!(gate.captured(), gate.delivered() + gate.drops().total());
    assert!(gate.captured() < 100, "{}", gate.captured());
}

#[test]
fn gaps_duplicates_and_late_frames_are_distinguished() {
    let mut gate = Gate::new(0, &profile(8, ClockDomain::Device));
    let mut sink = MemorySink::default();
    let outcomes: Vec<_> = [250, 251, 251, 255, 253, 1, 1]
        .into_iter()
        .enumerate()
        .map(|(i, s)| feed(&mut gate, &mut sink, &raw(s, i as i64)))
        .collect();
    let twice = Dropped(DropReason::OutOfOrder);
    assert_eq!(outcomes, [Delivered, Delivered, twice, Delivered, AlreadyCounted, Delivered, twice]);
    // 250..=257 are eight frames, and two came twice.
    assert_eq!((gate.captured(), gate.delivered()), (10, 4));
    assert_eq!(sink.drops_of(0).get(DropReason::DeviceGap), 4);
    assert_eq!(sink.frames.iter().map(|f| f.1.device_sequence).collect::<Vec<_>>(), [250, 251, 255, 257]);
}

#[test]
fn a_reset_counter_is_no_gap() {
    let mut gate = Gate::new(0, &profile(32, ClockDomain::Device));
    let mut sink = MemorySink::default();
    for (i, s) in [5000, 5001, 1, 2].into_iter().enumerate() {
        assert_eq!(feed(&mut gate, &mut sink, &raw(s, i as i64)), Outcome::Delivered);
    }
    assert_eq!((gate.captured(), gate.drops().total()), (4, 0));
}

#[test]
fn a_counter_reset_soon_after_the_start_costs_three_frames() {
    let mut gate = Gate::new(0, &profile(32, ClockDomain::Device));
    let mut sink = MemorySink::default();
    let sequence = (1..=30).chain(1..=30);
    let delivered = sequence
        .enumerate()
        .filter(|(i, s)| feed(&mut gate, &mut sink, &raw(*s, *i as i64)) == Outcome::Delivered)
        .count();
    assert_eq!(delivered, 57, "three frames are taken for repeated ones, then the restart is certain");
    assert_eq!((gate.captured(), gate.drops().get(DropReason::OutOfOrder)), (60, 3));
}

#[test]
fn broken_frames_are_dropped_with_their_reason() {
    let mut gate = Gate::new(0, &profile(32, ClockDomain::Device));
    let mut sink = MemorySink::default();
    let mut frame = raw(1, 0);
    let mut outcome = |gate: &mut Gate, sink: &mut MemorySink, change: &dyn Fn(&mut RawFrame)| {
        frame = raw(frame.device_sequence + 1, frame.device_sequence as i64);
        let mut broken = frame;
        change(&mut broken);
        feed(gate, sink, &broken)
    };
    assert_eq!(outcome(&mut gate, &mut sink, &|f| f.bytes = 9), Dropped(DropReason::Incomplete));
    assert_eq!(outcome(&mut gate, &mut sink, &|f| f.bytes = 0), Dropped(DropReason::Incomplete));
    assert_eq!(outcome(&mut gate, &mut sink, &|f| f.bytes = 17), Dropped(DropReason::WrongSize));
    assert_eq!(outcome(&mut gate, &mut sink, &|f| f.damaged = true), Dropped(DropReason::DeviceError));
    sink.refuse = 1;
    assert_eq!(outcome(&mut gate, &mut sink, &|_| ()), Dropped(DropReason::NoSlot));
    assert_eq!(outcome(&mut gate, &mut sink, &|_| ()), Outcome::Delivered);
    assert_eq!((gate.captured(), gate.delivered(), gate.drops().total()), (6, 1, 5));
    assert_eq!(gate.drops(), sink.drops_of(0));
}

#[test]
fn a_kernel_stamp_is_used_as_it_is() {
    let mut gate = Gate::new(0, &profile(32, ClockDomain::Kernel));
    let mut sink = MemorySink::default();
    let mut frame = raw(1, 0);
    frame.device_ticks = 999_000_000;
    feed(&mut gate, &mut sink, &frame);
    assert_eq!(sink.frames[0].1.capture_time, HostTime::from_ns(999_000_000));
}

#[test]
fn a_calibrated_latency_is_subtracted_whatever_the_clock() {
    for domain in [ClockDomain::Device, ClockDomain::Kernel, ClockDomain::Arrival] {
        let stamps = |latency: Option<CalibratedLatency>| {
            let mut gate = Gate::new(0, &profile(32, domain));
            let mut sink = MemorySink::default();
            sink.latency = latency;
            for i in 0..3 {
                let mut frame = raw(1 + i, i as i64);
                if domain == ClockDomain::Kernel {
                    frame.device_ticks = frame.arrival.ns() as u64 - 1_000_000;
                }
                feed(&mut gate, &mut sink, &frame);
            }
            sink.frames.iter().map(|f| f.1).collect::<Vec<_>>()
        };
        let plain = stamps(None);
        let corrected = stamps(Some(CalibratedLatency { ns: 4_700_000, bound_ns: 60_000 }));
        for (before, after) in plain.iter().zip(&corrected) {
            assert_eq!(before.capture_time.since_ns(after.capture_time), 4_700_000, "{domain:?}");
            assert_eq!((before.latency_ns, after.latency_ns), (0, 4_700_000));
            assert!(!before.flags.has(FrameFlags::LATENCY_CALIBRATED));
            assert!(after.flags.has(FrameFlags::LATENCY_CALIBRATED));
            assert!(after.capture_uncertainty_ns >= before.capture_uncertainty_ns + 60_000);
        }
    }
}

/// One thing a device may do with its counter.
#[derive(Debug, Clone)]
enum Step {
    Next,
    Skip(u64),
    Repeat,
    Broken,
    NoSlot,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        6 => Just(Step::Next),
        1 => (1u64..100).prop_map(Step::Skip),
        1 => Just(Step::Repeat),
        1 => Just(Step::Broken),
        1 => Just(Step::NoSlot),
    ];
    prop::collection::vec(step, 1..300)
}

proptest! {
    /// Against the obvious model: count what the device made, count what came out.
    #[test]
    fn captured_is_delivered_plus_dropped(steps in steps(), start in any::<u64>(), bits in 8u32..=64) {
        let mask = if bits == 64 { u64::MAX } else { (1 << bits) - 1 };
        let mut gate = Gate::new(0, &profile(bits, ClockDomain::Device));
        let mut sink = MemorySink::default();
        let mut counter = start & mask;
        feed(&mut gate, &mut sink, &raw(counter, 0));
        let mut made = 1u64;
        let mut out = 1u64;
        for (i, step) in steps.iter().enumerate() {
            let skipped = match step { Step::Skip(n) => *n, _ => 0 };
            let advance = u64::from(!matches!(step, Step::Repeat)) + skipped;
            counter = counter.wrapping_add(advance) & mask;
            made += advance.max(1);
            out += u64::from(matches!(step, Step::Next | Step::Skip(_)));
            let mut frame = raw(counter, i as i64 + 1);
            frame.damaged = matches!(step, Step::Broken);
            sink.refuse = usize::from(matches!(step, Step::NoSlot));
            feed(&mut gate, &mut sink, &frame);
            sink.refuse = 0;
            prop_assert_eq!(gate.captured(), gate.delivered() + gate.drops().total());
        }
        prop_assert_eq!((gate.captured(), gate.delivered()), (made, out));
        prop_assert_eq!((gate.drops(), gate.captured()), (sink.drops_of(0), sink.captured[0]));
        prop_assert!(sink.frames.windows(2).all(|w| w[0].1.capture_time <= w[1].1.capture_time));
    }
}
