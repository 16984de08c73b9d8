//! Batches of real channels on their way into a recording's sets.

use super::*;
use depthrig_bus::{
    Bus, Intrinsics, MetadataLevel, MotionSample, Name, PixelFormat, Pose, Publisher, RuntimeDir, Subscriber,
};
use depthrig_driver::{DeviceClock, StreamProfile};

/// A unit's channel with both ends.
struct Channel {
    facts: StreamFacts,
    publisher: Publisher,
    subscriber: Subscriber,
    sent: u64,
}

impl Channel {
    fn new(bus: &Bus, camera: &str, rate_hz: f64) -> Self {
        let id = StreamId::new(camera, "imu").unwrap();
        let profile = StreamProfile {
            stream: Name::new("imu").unwrap(),
            format: PixelFormat::Motion,
            width: 4,
            height: 1,
            rate_hz,
            depth_unit_m: 0.0,
            intrinsics: Intrinsics::default(),
            pose_in_device: Pose::IDENTITY,
            clock: DeviceClock::microseconds(32),
            sequence_bits: 32,
            metadata: MetadataLevel::Simulated,
        };
        let publisher = bus.publisher(&id, profile.frame_bytes(), 8).unwrap();
        let subscriber = bus.subscriber(&id).unwrap();
        let facts = StreamFacts {
            stream: Arc::new(Stream::new(id, profile, true, 8)),
            model: "fake".into(),
            serial: "7".into(),
            firmware: String::new(),
            calibration: "none".into(),
            camera_pose: Pose::IDENTITY,
            computed: None,
        };
        Self { facts, publisher, subscriber, sent: 0 }
    }

    /// The next batch as it comes off the channel; its number is in its samples.
    fn next(&mut self) -> Frame {
        self.sent += 1;
        let mut frame = self.publisher.loan(2 * 64).unwrap();
        frame.header_mut().set_image(PixelFormat::Motion, 2, 1);
        frame.header_mut().sequence = self.sent;
        for (i, bytes) in frame.pixels_mut().as_chunks_mut::<64>().0.iter_mut().enumerate() {
            *bytes =
                MotionSample { sequence: 2 * self.sent + i as u64, ..MotionSample::default() }.to_bytes();
        }
        self.publisher.send(frame).unwrap();
        self.subscriber.try_next().unwrap().unwrap()
    }

    fn id(&self) -> StreamId {
        self.facts.stream.id.clone()
    }
}

/// Of a stream of which nothing else is known.
fn facts_of(stream: &Arc<Stream>) -> StreamFacts {
    StreamFacts {
        stream: Arc::clone(stream),
        model: String::new(),
        serial: String::new(),
        firmware: String::new(),
        calibration: String::new(),
        camera_pose: Pose::IDENTITY,
        computed: None,
    }
}

fn with_two(rate_hz: f64, test: impl FnOnce(&mut Channel, &mut Channel, &mut Units, &mut Books)) {
    let dir = tempfile::Builder::new().prefix("dr").tempdir_in("/tmp").unwrap();
    let runtime = RuntimeDir::at(&dir.path().join("r")).unwrap();
    let bus = Bus::open(&runtime, &Name::new("motion").unwrap()).unwrap();
    let mut a = Channel::new(&bus, "a", rate_hz);
    let mut b = Channel::new(&bus, "b", rate_hz);
    let facts = [&a, &b].map(|c| facts_of(&c.facts.stream));
    let mut units = Units::new(&facts, 5.0);
    units.begin();
    test(&mut a, &mut b, &mut units, &mut Books::default());
}

fn account(books: &Books, id: &StreamId) -> SetAccount {
    books.accounts().find(|(other, _)| *other == id).unwrap().1
}

#[test]
fn batches_go_with_the_next_set_in_the_order_in_which_they_came() {
    with_two(25.0, |a, b, units, books| {
        for from_a in [true, false, false, true] {
            let channel = if from_a { &mut *a } else { &mut *b };
            let frame = channel.next();
            books.hear(Some(units), &channel.id(), &frame, 0);
        }
        let taken = books.take(units);
        let numbers: Vec<_> =
            taken.iter().map(|m| (m.unit, m.header.sequence, m.samples[1].sequence)).collect();
        assert_eq!(numbers, [(0, 1, 3), (1, 1, 3), (1, 2, 5), (0, 2, 5)]);
        assert!(taken.iter().all(|m| m.samples.len() == 2 && m.header.width == 2));
        assert!(books.take(units).is_empty(), "none goes twice");
        assert_eq!(account(books, &a.id()), SetAccount { used: 2, ..SetAccount::default() });
    });
}

#[test]
fn what_waits_too_long_is_pushed_out_oldest_first_and_counted() {
    with_two(25.0, |a, b, units, books| {
        let most = 100; // four seconds of 25 batches
        let frame = b.next();
        books.hear(Some(units), &b.id(), &frame, 0);
        for _ in 0..most + 7 {
            let frame = a.next();
            books.hear(Some(units), &a.id(), &frame, 0);
        }
        let pending = account(books, &a.id());
        assert_eq!((pending.pending, pending.overflow), (most, 7));
        let taken = books.take(units);
        units.hand_over(&taken);
        let of_a: Vec<_> = taken.iter().filter(|m| m.unit == 0).map(|m| m.header.sequence).collect();
        assert_eq!(of_a, (8..=most + 7).collect::<Vec<_>>());
        assert_eq!(taken.len() as u64, most + 1, "the other unit lost nothing");
        let accounts: Vec<_> = units.accounts().collect();
        assert_eq!((accounts[0].captured, accounts[0].delivered), (most + 7, most));
        assert_eq!(accounts[0].dropped.get(DropReason::QueueFull), 7);
        assert!(accounts.iter().all(StreamAccount::balances) && accounts[1].dropped.total() == 0);
    });
}

#[test]
fn the_account_has_what_was_lost_since_the_beginning_and_nothing_that_waits() {
    with_two(25.0, |a, _, units, books| {
        let id = a.id();
        a.facts.stream.books().dropped.add(DropReason::NoSlot, 3);
        units.begin();
        a.facts.stream.books().dropped.add(DropReason::DeviceGap, 2);
        let frame = a.next();
        books.hear(Some(units), &id, &frame, 4);
        let before = units.accounts().next().unwrap();
        assert_eq!((before.captured, before.delivered), (6, 0), "it waits");
        let taken = books.take(units);
        units.hand_over(&taken);
        let after = units.accounts().next().unwrap();
        assert_eq!((after.captured, after.delivered), (7, 1));
        assert_eq!(
            after.dropped.nonzero().collect::<Vec<_>>(),
            [(DropReason::DeviceGap, 2), (DropReason::QueueFull, 4)]
        );
        assert_eq!(account(books, &id).missed, 4);
    });
}

#[test]
fn between_recordings_nothing_is_kept_and_every_batch_is_counted() {
    with_two(25.0, |a, _, units, books| {
        let id = a.id();
        let frame = a.next();
        books.hear(None, &id, &frame, 0);
        for _ in 0..3 {
            let frame = a.next();
            books.hear(Some(units), &id, &frame, 0);
        }
        books.end(units);
        assert!(books.take(units).is_empty(), "batches after the last set are not in the recording");
        let frame = a.next();
        books.hear(None, &id, &frame, 1);
        let sum = account(books, &id);
        assert_eq!(sum, SetAccount { decimated: 5, missed: 1, ..SetAccount::default() });
        assert_eq!(units.accounts().next().unwrap().captured, 0);
        // A stream that is not recorded.
        let other = StreamId::new("c", "imu").unwrap();
        books.hear(Some(units), &other, &frame, 0);
        assert_eq!(account(books, &other).decimated, 1);
    });
}

#[test]
fn rare_sets_have_timeout_for_two_of_them() {
    with_two(2.0, |a, _, _, _| {
        let facts = [facts_of(&a.facts.stream)];
        // Batches are at most 100 ms old, so that ten a second may come.
        assert_eq!(Units::new(&facts, 5.0).waiting.most(0), 40);
        assert_eq!(Units::new(&facts, 0.1).waiting.most(0), 200);
        // Two sets that are an hour apart would have more than one may hold.
        let rare = Units::new(&facts, 1.0 / 3600.0).waiting.most(0);
        let bytes = rare * RecordMotion::stored_bytes_of(4);
        assert!(
            bytes <= SET_MOTION_MAX_BYTES && bytes > SET_MOTION_MAX_BYTES * 9 / 10,
            "{rare} batches of {bytes} bytes"
        );
        let two = [facts_of(&a.facts.stream), facts_of(&a.facts.stream)];
        assert_eq!(Units::new(&two, 1.0 / 3600.0).waiting.most(0), rare / 2, "both share it");
    });
}
