//! A copy is the file, and damage costs what it hits.

use super::*;
use crate::fs::{Fs, MemFs};
use crate::{RecordFrame, RecordSet, Recorder, RecorderOptions, Session, StreamRecord};
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// A recording of `sets` sets of a depth and a colour stream, with a checkpoint now and then.
fn recorded(sets: u64) -> (MemFs, PathBuf) {
    let fs = MemFs::new();
    let mut session = Session::new("s", "rig");
    for (name, format) in [("a/depth", PixelFormat::Z16), ("a/color", PixelFormat::Rgb8)] {
        session.streams.push(StreamRecord {
            id: name.parse().unwrap(),
            model: String::new(),
            serial: String::new(),
            format,
            width: 32,
            height: 16,
            rate_hz: 5.0,
            depth_unit_m: 0.001,
            calibration: String::new(),
            intrinsics: Intrinsics::default(),
            pose: Pose::IDENTITY,
        });
    }
    let options = RecorderOptions {
        // Another type for the image, and a chunk that is not packed.
        depth: crate::DepthCodec::Rank,
        min_free_bytes: 0,
        reserve_bytes: 0,
        sync_interval_ns: 1_000_000,
        ..Default::default()
    };
    let r = Recorder::create(Arc::new(fs.clone()), Path::new("/d"), session.clone(), options).unwrap();
    for n in 0..sets {
        let frame = |(i, s): (usize, &StreamRecord)| {
            let mut header = FrameHeader::default();
            header.set_image(s.format, s.width, s.height);
            let bytes = s.format.frame_bytes(s.width, s.height);
            let pixels = (0..bytes).map(|k| (k as u64 * (n + 3) % 251) as u8).collect::<Vec<_>>();
            RecordFrame { stream: i, header, pixels: Box::new(pixels) }
        };
        let utc = UtcPair { mono: HostTime::from_ns(0), utc_ns: 1, width_ns: 0 };
        let tick = HostTime::from_ns(n as i64 + 1);
        let frames = session.streams.iter().enumerate().map(frame).collect();
        r.push(RecordSet {
            id: n,
            tick,
            utc,
            frames,
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        })
        .unwrap();
        while r.progress().sets.recorded <= n {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    assert!(r.finish().unwrap().complete);
    (fs, PathBuf::from("/d/seg_0000.mcap"))
}

/// Copies what is left of `bytes`; the copy, the ids of its sets, and how far the bytes were proven first.
fn copied(bytes: Vec<u8>) -> (Vec<u8>, Vec<u64>, u64, Vec<Damage>) {
    let fs = MemFs::new();
    fs.create_dir_all(Path::new("/d")).unwrap();
    fs.put(Path::new("/d/f"), bytes);
    let reader = SegmentReader::open_bare(&fs, Path::new("/d/f")).unwrap();
    let (preamble, first) = read_preamble(&reader).unwrap();
    let mut copy = Segment::create(&fs, Path::new("/d"), 7, &preamble).unwrap();
    let mut groups = Groups::new(&reader, &preamble, first).unwrap();
    let mut ids = Vec::new();
    let mut damage = Vec::new();
    while let Some(group) = groups.next().unwrap() {
        copy.append_group(&group).unwrap();
        match group {
            Group::Set(set) => ids.push(set.mark.id),
            Group::Damage(d) => damage.push(d),
            _ => {}
        }
    }
    let proven = groups.proven;
    let path = copy.finish(&fs).unwrap();
    (fs.contents(&path).unwrap(), ids, proven, damage)
}

#[test]
fn a_copy_is_the_same_file_whether_proven_by_checksum_or_chunk_by_chunk() {
    let (fs, path) = recorded(12);
    let whole = fs.contents(&path).unwrap();
    let (copy, ids, proven, damage) = copied(whole.clone());
    assert_eq!(ids, (0..12).collect::<Vec<_>>());
    assert!(damage.is_empty(), "{damage:?}");
    let differs = copy.iter().zip(&whole).position(|(a, b)| a != b);
    let lens = (copy.len(), whole.len());
    assert!(copy == whole, "{lens:?} bytes differ at {differs:?}; index and statistics are the same");
    assert!(proven as usize > whole.len() / 2, "{proven} of {} bytes are proven", whole.len());

    // Checkpoints that are somewhere else say nothing: every chunk is unpacked.
    let reader = SegmentReader::open(&fs, &path).unwrap();
    let (preamble, first) = read_preamble(&reader).unwrap();
    let mut moved = preamble.clone();
    moved.metadata.push(("more".into(), BTreeMap::new()));
    let fs2 = MemFs::new();
    fs2.create_dir_all(Path::new("/d")).unwrap();
    let mut copy = Segment::create(&fs2, Path::new("/d"), 0, &moved).unwrap();
    let mut groups = Groups::new(&reader, &preamble, first).unwrap();
    while let Some(group) = groups.next().unwrap() {
        copy.append_group(&group).unwrap();
    }
    let part = fs2.contents(copy.part()).unwrap();
    let (again, ids, proven, damage) = copied(part.clone());
    assert_eq!((ids.len(), proven, damage), (12, 0, Vec::new()));
    assert!(again.starts_with(&part));
}
/// The sets whose chunks do not have the byte `at`: what must outlive its damage.
fn untouched(bytes: &[u8], at: u64) -> Vec<u64> {
    let fs = MemFs::new();
    fs.create_dir_all(Path::new("/d")).unwrap();
    fs.put(Path::new("/d/f"), bytes.to_vec());
    let reader = SegmentReader::open_bare(&fs, Path::new("/d/f")).unwrap();
    let (preamble, first) = read_preamble(&reader).unwrap();
    let mut groups = Groups::new(&reader, &preamble, first).unwrap();
    let mut ids = Vec::new();
    while let Some(group) = groups.next().unwrap() {
        let Group::Set(set) = group else { continue };
        let mut spans = set.offsets.iter().zip(&set.chunks);
        if !spans.any(|(from, c)| (*from..from + c.len()).contains(&at)) {
            ids.push(set.mark.id);
        }
    }
    ids
}

#[test]
fn a_damaged_byte_costs_the_set_that_it_is_in_and_no_other() {
    let (fs, path) = recorded(6);
    let whole = fs.contents(&path).unwrap();
    let reader = SegmentReader::open(&fs, &path).unwrap();
    let (_, first) = read_preamble(&reader).unwrap();
    let end = reader.chunks.last().map(|c| (c.offset + c.length) as usize).unwrap();
    let mut harmless = 0;
    for unfinished in [false, true] {
        let bytes = if unfinished { whole[..end].to_vec() } else { whole.clone() };
        // Every byte takes long in a build that is not optimised; 17 has no part in any length here.
        for at in (first as usize..end).step_by(17) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << (at % 8);
            let (_, ids, _, damage) = copied(damaged);
            let least = untouched(&bytes, at as u64);
            // A bit that zstd has no use for may cost nothing at all; the checksums say so.
            assert!(least.iter().all(|id| ids.contains(id)), "byte {at}: {ids:?} of {least:?}");
            assert!(ids.is_sorted() && ids.len() <= 6, "byte {at}: {ids:?}");
            harmless += usize::from(ids.len() > least.len());
            if ids.len() < 6 {
                let said = damage.iter().any(|d| d.from <= at as u64 && (at as u64) < d.to);
                assert!(said, "byte {at}: {damage:?}");
            }
        }
    }
    assert!(harmless * 100 < end - first as usize, "{harmless} damaged bytes were taken for good ones");
}

#[test]
fn a_cut_file_gives_its_whole_sets() {
    let (fs, path) = recorded(5);
    let whole = fs.contents(&path).unwrap();
    let (_, first) = read_preamble(&SegmentReader::open(&fs, &path).unwrap()).unwrap();
    let mut before = 0;
    for cut in (first as usize..whole.len()).step_by(11) {
        let (_, ids, _, damage) = copied(whole[..cut].to_vec());
        assert_eq!(ids, (0..ids.len() as u64).collect::<Vec<_>>(), "cut at {cut}");
        assert!(ids.len() >= before, "cut at {cut}");
        assert!(damage.iter().all(|d| d.kind != DamageKind::Bytes && d.to <= cut as u64), "{damage:?}");
        before = ids.len();
    }
    assert_eq!(before, 5);
}
