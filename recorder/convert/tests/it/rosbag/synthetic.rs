//! Small synthetic bags: of a recorder that was killed, with counters that begin again, with images that have few facts
//! or none.

use super::{imported, record};
use crate::support::*;
use depthrig_bus::{ClockDomain, FrameHeader};
use depthrig_recorder::fs::MemFs;

const DEPTH: &str = "/device_0/sensor_0/Depth_0";
const COLOR: &str = "/device_0/sensor_1/Color_0";
/// Its pixels are of a kind that cannot be imported.
const OTHER: &str = "/device_0/sensor_1/Color_1";
/// When the first image arrived, milliseconds since 1970.
const ARRIVED_MS: i64 = 1_534_232_519_732;
/// The device's counter of microseconds begins again.
const TURN: u64 = 1 << 32;

/// Connections and messages, which a chunk may hold.
struct BagBuilder {
    records: Vec<u8>,
    topics: Vec<String>,
}

fn words(values: &[u32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// Text or bytes with their length before them.
fn long(bytes: &[u8]) -> Vec<u8> {
    [&(bytes.len() as u32).to_le_bytes()[..], bytes].concat()
}

/// A chunk that was closed.
fn chunk(records: &[u8]) -> Vec<u8> {
    let size = (records.len() as u32).to_le_bytes();
    record(&[("op", &[5]), ("compression", b"none"), ("size", &size)], records)
}

/// A chunk as it is written when it begins.
fn begun(records: &[u8]) -> Vec<u8> {
    let head = record(&[("op", &[5]), ("compression", b"none"), ("size", &[0; 4])], b"");
    [&head[..], records].concat()
}

fn bag(chunks: &[Vec<u8>]) -> Vec<u8> {
    [&b"#ROSBAG V2.0\n"[..], &chunks.concat()].concat()
}

fn headers(fs: &MemFs) -> Vec<FrameHeader> {
    read_all(fs).iter().flat_map(|s| &s.frames).map(|f| f.header).collect()
}

impl BagBuilder {
    fn new() -> Self {
        let mut builder = Self { records: Vec::new(), topics: Vec::new() };
        builder.message("/device_0/info", 0, &[long(b"Name"), long(b"Intel RealSense D435")].concat());
        builder
    }

    /// Takes the records so far; connections stay known.
    fn take(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.records)
    }

    fn message(&mut self, topic: &str, n: u32, data: &[u8]) {
        let known = self.topics.iter().position(|t| t == topic);
        let conn = (known.unwrap_or(self.topics.len()) as u32).to_le_bytes();
        if known.is_none() {
            let fields = [("op", &[7][..]), ("conn", &conn), ("topic", topic.as_bytes())];
            self.records.extend(record(&fields, b""));
            self.topics.push(topic.to_owned());
        }
        let time = words(&[0, 33_000_000 * n]);
        self.records.extend(record(&[("op", &[2][..]), ("conn", &conn), ("time", &time)], data));
    }

    /// Image number `n` of a stream, 4x2, with its facts.
    fn image(&mut self, stream: &str, n: u32, stamp_us: u64, facts: &[(&str, String)]) {
        let (encoding, bytes) = match stream {
            DEPTH => (&b"mono16"[..], 2),
            COLOR => (&b"rgb8"[..], 3),
            _ => (&b"yuyv"[..], 2),
        };
        let stamp = [(stamp_us / 1_000_000) as u32, (stamp_us % 1_000_000) as u32 * 1000];
        let head = words(&[n, stamp[0], stamp[1], 0, 2, 4]);
        let pixels: Vec<u8> = (0..8 * bytes).map(|i| (i + n) as u8).collect();
        let data = [head, long(encoding), vec![0], words(&[4 * bytes]), long(&pixels)].concat();
        self.message(&format!("{stream}/image/data"), n, &data);
        for (key, value) in facts {
            let fact = [long(key.as_bytes()), long(value.as_bytes())].concat();
            self.message(&format!("{stream}/image/metadata"), n, &fact);
        }
    }

    /// An image with all facts of one whose stamp is of the device's clock.
    fn counted(&mut self, stream: &str, n: u32, count_us: u64, arrived_ms: i64) {
        let facts = facts(n, count_us, arrived_ms, "Hardware Clock");
        self.image(stream, n, count_us % TURN, &facts);
    }
}

fn facts(n: u32, count_us: u64, arrived_ms: i64, clock: &str) -> [(&'static str, String); 4] {
    [
        ("Frame Counter", (n + 7).to_string()),
        ("Sensor Timestamp", (count_us % TURN).to_string()),
        ("system_time", arrived_ms.to_string()),
        ("timestamp_domain", clock.to_owned()),
    ]
}

#[test]
fn the_last_chunk_of_a_killed_recorder_is_read_and_reported() {
    let mut builder = BagBuilder::new();
    for stream in [DEPTH, COLOR] {
        builder.counted(stream, 0, 1_000_000, ARRIVED_MS);
    }
    let closed = chunk(&builder.take());
    builder.counted(DEPTH, 1, 1_033_000, ARRIVED_MS + 33);
    // Its facts were not written any more.
    builder.image(COLOR, 1, 1_033_000, &[]);
    let last = builder.take();
    let (whole, report) = imported(bag(&[closed.clone(), chunk(&last)]));
    assert_eq!(report.unwrap().facts.lost, 0);

    let bytes = bag(&[closed, begun(&last)]);
    let (fs, report) = imported(bytes.clone());
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames), (1, 4), "{:?}", report.facts.problems);
    assert!(report.facts.problems[0].contains("before it closed its last chunk"), "{:?}", report.facts);
    let pixels = |fs: &MemFs| -> Vec<_> {
        read_all(fs).into_iter().flat_map(|s| s.frames).map(|f| f.pixels).collect()
    };
    assert_eq!(pixels(&fs), pixels(&whole));

    let (_, report) = imported(bytes[..bytes.len() - 3].to_vec());
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames), (2, 3), "{:?}", report.facts.problems);
    assert!(report.facts.problems[1].contains("in the middle of a record"), "{:?}", report.facts);
}

#[test]
fn an_image_that_says_little_has_the_clock_of_its_neighbours() {
    let mut builder = BagBuilder::new();
    let count = |n: u32| TURN - 50_000 + 33_000 * u64::from(n);
    let stamp_us = |n: u32| 1000 * ARRIVED_MS.unsigned_abs() + 33_000 * u64::from(n);
    for n in 0..6 {
        let facts = facts(n, count(n), ARRIVED_MS + 33 * i64::from(n) + 9, "Global Time");
        let given = if matches!(n, 0 | 3) { 0 } else { facts.len() };
        builder.image(DEPTH, n, stamp_us(n), &facts[..given]);
    }
    let (fs, report) = imported(bag(&[chunk(&builder.records)]));
    assert_eq!(report.unwrap().facts.lost, 0);
    for (n, h) in (0..6).zip(headers(&fs)) {
        assert_eq!(h.capture_time_ns, 1000 * stamp_us(n) as i64, "image {n}");
        assert_eq!(h.clock_domain, ClockDomain::Arrival as u32);
        assert!(matches!(n, 0 | 3) || h.device_time == count(n), "image {n}: {}", h.device_time);
    }
}

#[test]
fn streams_of_a_device_share_the_turns_of_its_counter() {
    let count = |n: u32| TURN - 50_000 + 33_000 * u64::from(n);
    let mut builder = BagBuilder::new();
    for n in 0..6 {
        builder.counted(DEPTH, n, count(n), ARRIVED_MS + 33 * i64::from(n));
        // Begins when the counter of the other one has begun again.
        if n > 2 {
            builder.counted(COLOR, n, count(n), ARRIVED_MS + 33 * i64::from(n));
        }
    }
    let (fs, report) = imported(bag(&[chunk(&builder.records)]));
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames, report.summary.sets.recorded), (0, 9, 6));
    for h in headers(&fs) {
        let n = (h.device_sequence - 7) as u32;
        assert_eq!(h.device_time, count(n), "image {n}");
        assert_eq!(h.capture_time_ns, (ARRIVED_MS + 33 * i64::from(n)) * 1_000_000, "image {n}");
    }

    // The first image to arrive is not always the first that was taken.
    let mut builder = BagBuilder::new();
    builder.counted(COLOR, 0, TURN + 9_000, ARRIVED_MS);
    builder.counted(DEPTH, 1, TURN - 1_000, ARRIVED_MS + 32);
    let (fs, _) = imported(bag(&[chunk(&builder.records)]));
    let mut times: Vec<_> = headers(&fs).iter().map(|h| h.device_time).collect();
    times.sort_unstable();
    assert_eq!(times, [TURN - 1_000, TURN + 9_000]);
}

#[test]
fn every_image_that_cannot_be_imported_is_counted() {
    let mut builder = BagBuilder::new();
    for n in 0..3 {
        builder.counted(DEPTH, n, 33_000 * u64::from(n), ARRIVED_MS + 33 * i64::from(n));
        builder.counted(OTHER, n, 33_000 * u64::from(n), ARRIVED_MS + 33 * i64::from(n));
    }
    let (_, report) = imported(bag(&[chunk(&builder.records)]));
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames), (3, 3));
    let problem = "/device_0/sensor_1/Color_1: 3 images cannot be imported; the first: 4x2 yuyv pixels";
    assert_eq!(report.facts.problems, [problem]);
}
