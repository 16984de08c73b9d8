//! Comparisons of two datasets and the differences they find.

use crate::support::*;
use depthrig_bus::{FrameFlags, HostTime, PixelFormat, UtcPair};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    ColorCodec, CompareOptions, Comparison, Compression, Dataset, PixelCheck, RecordSet, Recorder,
    RecorderOptions, Session, compare,
};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

fn recorded(
    session: &Session,
    options: RecorderOptions,
    sets: impl IntoIterator<Item = RecordSet>,
) -> Dataset {
    let fs: Arc<dyn Fs> = Arc::new(MemFs::new());
    let r = Recorder::create(Arc::clone(&fs), &dir(), session.clone(), options).unwrap();
    for set in sets {
        r.push(set).unwrap();
        settle(&r);
    }
    let summary = r.finish().unwrap();
    assert!(summary.complete, "{:?}", summary.lost);
    Dataset::open_with(fs, &dir()).unwrap()
}

fn raw() -> RecorderOptions {
    RecorderOptions { color: ColorCodec::Raw, ..options() }
}

fn plain(sets: u64) -> impl Iterator<Item = RecordSet> {
    let session = session();
    (0..sets).map(move |n| set(&session, n))
}

fn counts(c: &Comparison) -> Vec<(&str, &str, u64)> {
    c.counts.iter().map(|c| (c.stream.as_str(), c.field.as_str(), c.count)).collect()
}

fn with(pixels: PixelCheck) -> CompareOptions {
    CompareOptions { pixels, ..CompareOptions::default() }
}

#[test]
fn how_it_is_stored_is_no_difference() {
    let a = recorded(&session(), raw(), plain(5));
    let other = RecorderOptions { compression: Compression::None, segment_max_ns: PERIOD, ..raw() };
    let b = recorded(&session(), other, plain(5));
    assert_eq!((a.segments().len(), b.segments().len()), (1, 5));
    let c = compare(&a, &b, &CompareOptions { strict: true, ..CompareOptions::default() }).unwrap();
    assert_eq!(counts(&c), []);
    assert!(c.equal && c.differences.is_empty() && c.pixel_differences.is_empty());
    assert_eq!((c.sets_a, c.sets_b, c.sets, c.frames), (5, 5, 5, 15));
}

#[test]
fn the_loss_of_a_jpeg_is_measured() {
    let a = recorded(&session(), raw(), plain(4));
    let b = recorded(&session(), options(), plain(4));
    let c = compare(&a, &b, &CompareOptions::default()).unwrap();
    assert_eq!(counts(&c), [("front/color", "pixels", 4)]);
    let [d] = &c.pixel_differences[..] else { panic!("{:?}", c.pixel_differences) };
    assert_eq!((d.stream.as_str(), d.frames_differing, d.samples), ("front/color", 4, 4 * 64 * 48 * 3));
    // The same numbers by the decoded pixels, one by one.
    let sets = |d: &Dataset| d.sets(depthrig_recorder::SetRange::ALL).map(Result::unwrap).collect::<Vec<_>>();
    let mut max = 0;
    let mut sum = 0.0;
    let mut squares = 0.0;
    let mut n = 0;
    for (x, y) in sets(&a).iter().zip(sets(&b)) {
        for (x, y) in x.frames[0].pixels.iter().zip(&y.frames[0].pixels) {
            let d = x.abs_diff(*y);
            (max, sum, squares) = (max.max(d), sum + f64::from(d), squares + f64::from(d).powi(2));
            n += u64::from(d > 0);
        }
    }
    assert!(max > 0);
    assert_eq!((d.max_abs, d.samples_differing), (f64::from(max), n));
    assert!((d.mean_abs - sum / d.samples as f64).abs() < 1e-12);
    let psnr = 10.0 * (255.0 * 255.0 * d.samples as f64 / squares).log10();
    assert!((d.psnr_db.unwrap() - psnr).abs() < 1e-9);

    assert!(compare(&a, &b, &with(PixelCheck::None)).unwrap().equal);
    let c = compare(&a, &b, &with(PixelCheck::Stored)).unwrap();
    assert_eq!(counts(&c), [("front/color", "codec", 4)]);
    assert_eq!((c.differences[0].a.as_str(), c.differences[0].b.as_str()), ("raw", "jpeg"));
}

/// The same frames as a recording of their replay has them: see `daemon/src/replay.rs`.
fn replayed(session: &Session, n: u64) -> RecordSet {
    let mut s = set(session, n);
    s.id += 700;
    s.utc = UtcPair { mono: HostTime::from_ns(M0), utc_ns: T0 + 86_400_000_000_000, width_ns: 5 };
    s.frames.reverse();
    for f in &mut s.frames {
        f.header.sequence = n + 1;
        f.header.captured = n + 1 + f.header.drops().total();
        f.header.flags |= FrameFlags::REPLAYED.0;
    }
    s
}

#[test]
fn a_recording_of_a_replay_is_equal() {
    let a = recorded(&session(), raw(), plain(3));
    // Another rig lists its streams in another order and names itself otherwise.
    let mut other = session();
    other.streams.reverse();
    (other.rig, other.name, other.started_utc_ns) = ("bench".into(), "again".into(), T0 + 1);
    (other.streams[0].calibration, other.streams[0].rate_hz) = (String::new(), 0.0);
    let sets = (0..3).map(|n| {
        let mut s = replayed(&session(), n);
        s.frames.iter_mut().for_each(|f| f.stream = 2 - f.stream);
        s
    });
    let b = recorded(&other, raw(), sets);
    let c = compare(&a, &b, &CompareOptions::default()).unwrap();
    assert_eq!(counts(&c), []);
    assert_eq!(c.frames, 9);
    let c = compare(&a, &b, &CompareOptions { strict: true, ..CompareOptions::default() }).unwrap();
    let mut expected = vec![("", "id", 3), ("", "utc_ns", 3), ("", "utc_offset_ns", 3)];
    for stream in ["front/color", "front/depth", "side/ir_left"] {
        expected.push((stream, "captured", 2)); // in the first set it is the same
        if stream == "side/ir_left" {
            expected.extend([(stream, "description.calibration", 1), (stream, "description.rate_hz", 1)]);
        }
        expected.extend([(stream, "flags", 3), (stream, "sequence", 2), (stream, "set_id", 3)]);
    }
    // The motion of a set is that of another one now; its own numbers are as they were here.
    expected.extend([("front/imu", "set_id", 3 * BATCHES), ("side/imu", "set_id", 3 * BATCHES)]);
    expected.sort_unstable();
    assert_eq!(counts(&c), expected);
}

#[test]
fn streams_and_their_descriptions_are_compared() {
    let a = recorded(&session(), raw(), plain(2));
    let mut other = session();
    other.streams[1].depth_unit_m = 0.001;
    other.streams[2] = stream("side/ir_right", PixelFormat::Mono8, 40, 30);
    let b = recorded(&other, raw(), (0..2).map(|n| set(&other, n)));
    let c = compare(&a, &b, &with(PixelCheck::None)).unwrap();
    assert_eq!(
        counts(&c),
        [
            ("", "spread_ns", 2),
            ("front/depth", "depth_unit_m", 2),
            ("front/depth", "description.depth_unit_m", 1),
            ("side/ir_left", "frame", 2),
            ("side/ir_left", "stream", 1),
            ("side/ir_right", "frame", 2),
            ("side/ir_right", "stream", 1),
        ]
    );
    let unit = c.differences.iter().find(|d| d.field == "depth_unit_m").unwrap();
    assert_eq!((unit.a.as_str(), unit.b.as_str(), unit.set_a), ("0.0001", "0.001", Some(1)));
}

#[test]
fn what_cannot_be_read_is_a_difference() {
    let fs = MemFs::new();
    record(&fs, 3, raw());
    let good = open(&fs);
    let damaged = copy(&fs);
    let mut bytes = contents(&damaged, &segment(0));
    // In the middle lies an image of the second set, or what describes it.
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    damaged.put(&segment(0), bytes);
    let c = compare(&good, &open(&damaged), &CompareOptions::default()).unwrap();
    let (unreadable, lone): (Vec<_>, Vec<_>) = c.counts.iter().partition(|c| c.field == "unreadable");
    assert!(!c.equal && !unreadable.is_empty(), "{c:?}");
    assert_eq!(lone.iter().map(|c| (c.field.as_str(), c.count)).collect::<Vec<_>>(), [("set", 1)]);
    let hurt = |b: &str| b.contains("checksum") || b.contains("cannot be unpacked");
    assert!(c.differences.iter().any(|d| d.a == "-" && hurt(&d.b)), "{:?}", c.differences);
    let both = compare(&open(&damaged), &open(&damaged), &CompareOptions::default()).unwrap();
    assert!(!both.equal, "two datasets that cannot be read are not proven equal");
}

/// One thing that a second recording has otherwise.
#[derive(Debug, Clone)]
enum Change {
    NoSet,
    NoFrame(usize),
    Pixel(usize, usize),
    Gain(usize),
    Pose(usize),
    Exposure(usize),
    Spread,
}

fn change() -> impl Strategy<Value = Change> {
    let stream = 0..3usize;
    prop_oneof![
        Just(Change::NoSet),
        stream.clone().prop_map(Change::NoFrame),
        (stream.clone(), 0..1200usize).prop_map(|(s, at)| Change::Pixel(s, at)),
        stream.clone().prop_map(Change::Gain),
        stream.clone().prop_map(Change::Pose),
        stream.prop_map(Change::Exposure),
        Just(Change::Spread),
    ]
}

/// A set on one side of the model: streams with the version of each field.
type Seen = BTreeMap<&'static str, u64>;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    /// Both sides get random changes; a set-by-set model without files says what must be found.
    #[test]
    fn every_change_is_found_and_nothing_else(
        changes in proptest::collection::vec((any::<bool>(), 0..6u64, change()), 0..8),
    ) {
        const NAMES: [&str; 3] = ["front/color", "front/depth", "side/ir_left"];
        let mut model: [BTreeMap<u64, [Seen; 4]>; 2] = Default::default();
        let mut sides = Vec::new();
        for (side, model) in [false, true].into_iter().zip(&mut model) {
            let mut sets = Vec::new();
            for n in 0..6u64 {
                let mine: Vec<_> = changes.iter().filter(|c| c.0 == side && c.1 == n).map(|c| &c.2).collect();
                if mine.iter().any(|c| matches!(c, Change::NoSet)) {
                    continue;
                }
                let mut s = set(&session(), n);
                let mut seen: [Seen; 4] = Default::default();
                for c in mine {
                    let mut bump = |at: usize, field| *seen[at].entry(field).or_default() += 1;
                    match *c {
                        Change::NoSet => {}
                        Change::NoFrame(i) => {
                            s.frames.retain(|f| f.stream != i);
                            if !s.missing.contains(&i) {
                                s.missing.push(i);
                            }
                        }
                        Change::Spread => {
                            s.spread_ns += 1;
                            bump(3, "spread_ns");
                        }
                        Change::Pixel(i, at) => {
                            for f in s.frames.iter_mut().filter(|f| f.stream == i) {
                                let mut bytes = f.pixels.bytes().to_vec();
                                bytes[at] = bytes[at].wrapping_add(1);
                                f.pixels = Box::new(bytes);
                            }
                        }
                        Change::Gain(i) => {
                            s.frames.iter_mut().filter(|f| f.stream == i).for_each(|f| f.header.gain += 1.0);
                            bump(i, "gain");
                        }
                        Change::Pose(i) => {
                            let frames = s.frames.iter_mut().filter(|f| f.stream == i);
                            frames.for_each(|f| f.header.pose.translation_m[2] += 1.0);
                            bump(i, "pose.translation_m");
                        }
                        Change::Exposure(i) => {
                            s.frames.iter_mut().filter(|f| f.stream == i).for_each(|f| f.header.exposure_ns += 1);
                            bump(i, "exposure_ns");
                        }
                    }
                }
                // The pixels themselves are the model of the pixels.
                for f in &s.frames {
                    let hash = crc32fast::hash(f.pixels.bytes());
                    seen[f.stream].insert("pixels", u64::from(hash));
                }
                model.insert(n, seen);
                sets.push(s);
            }
            sides.push(recorded(&session(), raw(), sets));
        }
        let mut expected: BTreeMap<(&str, &str), u64> = BTreeMap::new();
        let mut common = 0;
        for n in 0..6 {
            let (a, b) = match (model[0].get(&n), model[1].get(&n)) {
                (None, None) => continue,
                (Some(a), Some(b)) => (a, b),
                _ => {
                    *expected.entry(("", "set")).or_default() += 1;
                    continue;
                }
            };
            common += 1;
            for (i, name) in NAMES.iter().enumerate() {
                match (a[i].contains_key("pixels"), b[i].contains_key("pixels")) {
                    (true, true) => {}
                    (false, false) => continue,
                    _ => {
                        *expected.entry((name, "frame")).or_default() += 1;
                        continue;
                    }
                }
                for field in ["pixels", "gain", "pose.translation_m", "exposure_ns"] {
                    if a[i].get(field) != b[i].get(field) {
                        *expected.entry((name, field)).or_default() += 1;
                    }
                }
            }
            if a[3] != b[3] {
                *expected.entry(("", "spread_ns")).or_default() += 1;
            }
        }
        let c = compare(&sides[0], &sides[1], &CompareOptions { strict: true, listed: 3, ..Default::default() }).unwrap();
        let expected: Vec<_> = expected.into_iter().map(|((s, f), n)| (s, f, n)).collect();
        let total: u64 = expected.iter().map(|e| e.2).sum();
        prop_assert_eq!(counts(&c), expected);
        prop_assert_eq!(c.equal, total == 0);
        prop_assert_eq!(c.differences.len() as u64, total.min(3));
        prop_assert_eq!(c.sets, common);
    }
}
