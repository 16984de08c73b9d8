//! Pixels begin at a multiple of 64 in every slot, for who writes and for who reads; and how a channel whose header
//! was aligned to 8, as before, meets one of today.
#![allow(missing_docs, clippy::unwrap_used)]

use depthrig_bus::{
    Bus, ErrorKind, Frame, FrameHeader, HEADER_SIZE, PIXEL_ALIGN, Publisher, RigName, RuntimeDir, SCHEMA,
    StreamId,
};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe;
use std::collections::HashSet;

const SLOTS: usize = 24;
/// As many as one subscriber may hold.
const HELD: usize = 16;

struct Fixture {
    dir: tempfile::TempDir,
    bus: Bus,
    id: StreamId,
}

fn fixture() -> Fixture {
    let dir = tempfile::tempdir().unwrap();
    let bus = Bus::open(&RuntimeDir::at(dir.path()).unwrap(), &RigName::new("test").unwrap()).unwrap();
    Fixture { dir, bus, id: StreamId::new("cam", "depth").unwrap() }
}

/// Publishes a frame of `len` bytes; its slot's address where it was written.
fn publish(publisher: &Publisher, sequence: u64, len: usize) -> usize {
    let mut frame = publisher.loan(len).unwrap();
    let at = frame.pixels_mut().as_ptr().addr();
    assert!(at.is_multiple_of(PIXEL_ALIGN), "a loan of {len} bytes begins at {at:#x}");
    frame.pixels_mut()[0] = sequence as u8;
    frame.pixels_mut()[len - 1] = sequence as u8;
    frame.header_mut().sequence = sequence;
    assert_eq!(publisher.send(frame).unwrap(), 1);
    at
}

/// The address of what was received, which must hold what was written.
fn read(frame: &Frame, sequence: u64, len: usize) -> usize {
    assert_eq!((frame.header().sequence, frame.pixels().len()), (sequence, len));
    assert_eq!((frame.pixels()[0], frame.pixels()[len - 1]), (sequence as u8, sequence as u8));
    let at = frame.pixels().as_ptr().addr();
    assert!(at.is_multiple_of(PIXEL_ALIGN), "{len} bytes were received at {at:#x}");
    at
}

/// Images of usual sizes, and of sizes without a common factor.
fn sizes() -> impl Iterator<Item = usize> {
    let images = [(64, 48), (640, 480), (848, 480), (1280, 720), (1920, 1080)];
    let bytes = images.into_iter().flat_map(|(w, h)| [w * h, w * h * 3 / 2, w * h * 2, w * h * 3, w * h * 4]);
    bytes.chain([1, 7, 8, 9, 31, 63, 64, 65, 127, 4095, 4096, 4097, 614_401, 921_637])
}

#[test]
fn pixels_begin_at_a_multiple_of_64_in_every_slot() {
    for max in sizes() {
        let f = fixture();
        let publisher = f.bus.publisher(&f.id, max, SLOTS).unwrap();
        let mut subscriber = f.bus.subscriber(&f.id).unwrap();
        let mut written = HashSet::new();
        let mut received = HashSet::new();
        let mut held = Vec::new();
        // Held frames push the publisher through its slots; letting go in between takes it through them again.
        for sequence in 1..=3 * SLOTS as u64 {
            let len = if sequence % 3 == 0 { max.div_ceil(2) } else { max };
            written.insert(publish(&publisher, sequence, len));
            let frame = subscriber.try_next().unwrap().unwrap();
            received.insert(read(&frame, sequence, len));
            held.push(frame);
            if held.len() == HELD {
                held.drain(..HELD - 3);
            }
        }
        assert!(written.len() >= HELD && received.len() >= HELD, "{max}: {} slots were seen", written.len());
        let lent: Vec<_> = (0..4).map(|_| publisher.loan(max).unwrap()).collect();
        for mut frame in lent {
            assert!(frame.pixels_mut().as_ptr().addr().is_multiple_of(PIXEL_ALIGN), "{max}");
        }
    }
}

#[test]
fn a_slot_costs_what_it_carries_and_less_than_two_cache_lines() {
    for max in sizes() {
        let f = fixture();
        let publisher = f.bus.publisher(&f.id, max, SLOTS).unwrap();
        let mut loans: Vec<_> = (0..8).map(|_| publisher.loan(max).unwrap()).collect();
        let mut at: Vec<_> = loans.iter_mut().map(|l| l.pixels_mut().as_ptr().addr()).collect();
        at.sort_unstable();
        let stride = at.windows(2).map(|w| w[1] - w[0]).min().unwrap();
        assert!(stride.is_multiple_of(PIXEL_ALIGN), "{max}: {stride}");
        assert!(stride <= HEADER_SIZE + max + 2 * PIXEL_ALIGN, "{max}: {stride}");
    }
}

/// The header as it was declared before: the same bytes, aligned to 8.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend)]
#[type_name("depthrig.FrameHeader.v1")]
struct AlignedTo8 {
    words: [u64; HEADER_SIZE / 8],
}

type Service = publish_subscribe::PortFactory<ipc::Service, [u8], AlignedTo8>;

fn node(f: &Fixture) -> Node<ipc::Service> {
    let mut config = Config::default();
    config.global.set_root_path(&Path::new(f.dir.path().join("iox2").to_str().unwrap().as_bytes()).unwrap());
    config.global.prefix = FileName::new(b"depthrig_").unwrap();
    NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap()
}

fn name(f: &Fixture) -> ServiceName {
    format!("depthrig/test/{}", f.id).as_str().try_into().unwrap()
}

#[test]
fn a_channel_that_was_made_with_the_old_alignment_is_refused_with_what_to_do() {
    let f = fixture();
    let node = node(&f);
    let attributes =
        AttributeSpecifier::new().define(&"schema".try_into().unwrap(), &SCHEMA.try_into().unwrap()).unwrap();
    let _made: Service = node
        .service_builder(&name(&f))
        .publish_subscribe::<[u8]>()
        .user_header::<AlignedTo8>()
        .create_with_attributes(&attributes)
        .unwrap();
    for e in [f.bus.subscriber(&f.id).unwrap_err(), f.bus.publisher(&f.id, 64, SLOTS).unwrap_err()] {
        assert_eq!(e.kind(), ErrorKind::VersionMismatch, "{e}");
        assert!(e.to_string().contains("end programs that still hold it"), "{e}");
    }
}

#[test]
fn a_reader_that_asks_for_the_old_alignment_reads_the_same_bytes() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, 4097, SLOTS).unwrap();
    let node = node(&f);
    let service: Service = node
        .service_builder(&name(&f))
        .publish_subscribe::<[u8]>()
        .user_header::<AlignedTo8>()
        .open()
        .unwrap();
    let reader = service.subscriber_builder().create().unwrap();
    for sequence in 1..=3 {
        publish(&publisher, sequence, 4097);
        let sample = reader.receive().unwrap().unwrap();
        let words = sample.user_header().words;
        let of = |field: usize| words[field / 8];
        assert_eq!(of(core::mem::offset_of!(FrameHeader, sequence)), sequence);
        assert_eq!((sample.payload()[0], sample.payload()[4096]), (sequence as u8, sequence as u8));
        assert_eq!(sample.payload().len(), 4097);
        assert!(sample.payload().as_ptr().addr().is_multiple_of(PIXEL_ALIGN));
    }
}
