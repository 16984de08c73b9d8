use super::*;
use crate::MemorySink;
use proptest::prelude::*;

const CAPACITY: usize = 4;

fn unit() -> StreamProfile {
    let clock = DeviceClock::microseconds(64);
    profile(400.0, CAPACITY as u32, Pose::IDENTITY, clock, MetadataLevel::Full).unwrap()
}

#[derive(Debug, Clone, Copy)]
enum Event {
    /// A sample comes, so many milliseconds after the event before.
    Sample(i64),
    /// Nothing but time passes.
    Tick(i64),
    /// The clock's map changes.
    Epoch,
    /// So many samples are lost.
    Lose(u64),
    /// The next so many loans are refused.
    Refuse(usize),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        12 => (0i64..40).prop_map(Event::Sample),
        2 => (0i64..150).prop_map(Event::Tick),
        1 => Just(Event::Epoch),
        1 => (1u64..11).prop_map(Event::Lose),
        1 => (1usize..4).prop_map(Event::Refuse),
    ]
}

fn sample(n: u64, time: HostTime) -> MotionSample {
    MotionSample {
        time_ns: time.ns() - 1000,
        device_time: 7 * n,
        sequence: n,
        uncertainty_ns: n as u32 + 1,
        temperature_c: n as f32,
        gyro_rad_s: [n as f32; 3],
        ..MotionSample::default()
    }
}

/// Model of the batcher that looks at the whole past: batches as lists of numbers with their epoch and the time at
/// which each must have gone; `None` for one that was lost.
#[derive(Default)]
struct Model {
    open: Vec<(u64, HostTime, u32)>,
    sent: Vec<Option<(Vec<u64>, u32)>>,
    queue_full: u64,
    no_slot: u64,
    refuse: usize,
}

impl Model {
    fn close(&mut self) {
        if self.open.is_empty() {
            return;
        }
        let batch: Vec<_> = self.open.drain(..).collect();
        if self.refuse > 0 {
            self.refuse -= 1;
            self.no_slot += 1;
            self.sent.push(None);
        } else {
            self.sent.push(Some((batch.iter().map(|b| b.0).collect(), batch[0].2)));
        }
    }

    fn pass(&mut self, now: HostTime) {
        if self.open.iter().any(|(_, came, _)| now.since_ns(*came) >= LONGEST.as_nanos() as i64) {
            self.close();
        }
    }
}

proptest! {
    /// Every sample is in exactly one batch or in one that was counted as lost, in order, and none is kept longer than
    /// it may be, as far as the test let time pass.
    #[test]
    fn batches_are_those_of_a_slow_model(events in prop::collection::vec(event(), 1..200)) {
        let mut model = Model::default();
        let mut sink = MemorySink::default();
        let mut batcher = Batcher::new(0, &unit());
        let mut now = HostTime::from_ns(5_000_000_000);
        let mut n = 0u64;
        let mut epoch = 0u32;
        for e in events {
            match e {
                Event::Sample(ms) => {
                    now = now.plus_ns(ms * 1_000_000);
                    n += 1;
                    model.pass(now);
                    if model.open.last().is_some_and(|o| o.2 != epoch) {
                        model.close();
                    }
                    model.open.push((n, now, epoch));
                    if model.open.len() == CAPACITY {
                        model.close();
                    }
                    let flags = if n.is_multiple_of(7) { FrameFlags::TIME_UNCERTAIN } else { FrameFlags(0) };
                    batcher.push(&sample(n, now), Mark { arrival: now, epoch, flags }, &mut sink);
                }
                Event::Tick(ms) => {
                    now = now.plus_ns(ms * 1_000_000);
                    model.pass(now);
                    batcher.tick(now, &mut sink);
                }
                Event::Epoch => epoch += 1,
                Event::Lose(lost) => {
                    model.close();
                    n += lost;
                    let batches = lost.div_ceil(CAPACITY as u64);
                    model.queue_full += batches;
                    for _ in 0..batches {
                        model.sent.push(None);
                    }
                    batcher.lose(lost, DropReason::QueueFull, &mut sink);
                }
                Event::Refuse(count) => {
                    sink.refuse += count;
                    model.refuse += count;
                }
            }
            prop_assert_eq!(batcher.due().is_some(), !model.open.is_empty());
            if let Some((_, came, _)) = model.open.first() {
                prop_assert_eq!(batcher.due(), Some(came.plus(LONGEST)));
            }
            let lost = sink.drops_of(0);
            let captured = sink.captured.first().copied().unwrap_or(0);
            prop_assert_eq!(captured, sink.delivered(0) + lost.total());
            prop_assert_eq!((batcher.captured(), batcher.delivered()), (captured, sink.delivered(0)));
        }
        batcher.flush(&mut sink);
        model.close();
        prop_assert_eq!(sink.drops_of(0).get(DropReason::NoSlot), model.no_slot);
        prop_assert_eq!(sink.drops_of(0).get(DropReason::QueueFull), model.queue_full);
        let mut seen = 0;
        let wanted: Vec<_> = (1u64..).zip(&model.sent).filter_map(|(i, b)| Some((i, b.as_ref()?))).collect();
        prop_assert_eq!(sink.frames.len(), wanted.len());
        for ((_, meta, payload), (captured, (numbers, epoch))) in sink.frames.iter().zip(wanted) {
            let samples: Vec<_> = MotionSample::all_in(payload).collect();
            prop_assert_eq!(payload.len(), numbers.len() * MOTION_SAMPLE_BYTES);
            prop_assert_eq!(samples.iter().map(|s| s.sequence).collect::<Vec<_>>(), numbers.clone());
            let newest = samples.last().unwrap();
            prop_assert_eq!(meta.captured, captured);
            prop_assert_eq!((meta.device_sequence, meta.device_time), (newest.sequence, newest.device_time));
            prop_assert_eq!((meta.capture_time, meta.clock_epoch), (newest.time(), *epoch));
            prop_assert_eq!(meta.capture_uncertainty_ns, u64::from(newest.uncertainty_ns));
            prop_assert_eq!(meta.temperature_c, newest.temperature_c);
            prop_assert!(meta.capture_time <= meta.arrival);
            let uncertain = numbers.iter().any(|n| n.is_multiple_of(7));
            prop_assert_eq!(meta.flags.has(FrameFlags::TIME_UNCERTAIN), uncertain);
            prop_assert!(numbers[0] > seen);
            seen = newest.sequence;
        }
    }
}

#[test]
fn a_profile_is_a_row_of_samples() {
    let p = unit();
    assert_eq!((p.stream.as_str(), p.format, p.width, p.height), (IMU, PixelFormat::Motion, 4, 1));
    assert_eq!((p.rate_hz, p.frame_bytes(), p.depth_unit_m), (100.0, 256, 0.0));
}

/// A time that may be off by more than the sample can say is not said to be right within 4 s.
#[test]
fn an_uncertainty_that_does_not_fit_is_no_small_one() {
    let mut b = Batcher::new(0, &unit());
    let mut sink = MemorySink::default();
    let now = HostTime::from_ns(1_000_000_000);
    let mark = Mark { arrival: now, epoch: 0, flags: FrameFlags(0) };
    b.push(&MotionSample { uncertainty_ns: u32::MAX, ..sample(1, now) }, mark, &mut sink);
    b.flush(&mut sink);
    assert!(sink.frames[0].1.capture_uncertainty_ns > 1 << 60);
}
