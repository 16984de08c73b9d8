//! Sets by number against sets in order: the same sets, whatever the order, and nothing read that was not asked for.

use crate::support::*;
use depthrig_bus::FrameHeader;
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{DatasetSet, ErrorKind, PixelMode, RecorderOptions, SetRange};
use std::path::Path;

/// Six sets a segment.
fn recorded(sets: u64) -> MemFs {
    let fs = MemFs::new();
    record(&fs, sets, RecorderOptions { segment_max_ns: 6 * PERIOD, ..options() });
    fs
}

/// Headers by their fields; the unknown temperature of the test's cameras is not a number and equals nothing.
fn known(h: &FrameHeader) -> FrameHeader {
    assert!(h.temperature_c.is_nan());
    FrameHeader { temperature_c: 0.0, ..*h }
}

fn same(a: &DatasetSet, b: &DatasetSet) -> bool {
    let frames = a.frames.iter().zip(&b.frames).all(|(a, b)| {
        (a.stream, known(&a.header), &a.pixels, a.codec) == (b.stream, known(&b.header), &b.pixels, b.codec)
    });
    frames
        && a.frames.len() == b.frames.len()
        && (a.id, a.tick, a.utc_ns, a.utc_offset_ns, a.spread_ns, &a.missing)
            == (b.id, b.tick, b.utc_ns, b.utc_offset_ns, b.spread_ns, &b.missing)
}

#[test]
fn any_order_gives_the_sets_that_reading_in_order_gives() {
    let fs = recorded(20);
    let expected = read_all(&fs);
    let mut reader = open(&fs).set_reader().unwrap();
    assert_eq!(reader.times(), expected.iter().map(|s| s.utc_ns).collect::<Vec<_>>());
    assert_eq!(reader.problems(), [""; 0]);
    // 7 and 20 have no common divisor: every set once, forwards and backwards over the segments.
    for i in (0..20).map(|i| i * 7 % 20).chain((0..20).rev()) {
        assert!(same(&reader.read(i, PixelMode::Decoded).unwrap(), &expected[i]), "set number {i}");
    }
    let e = reader.read(20, PixelMode::Decoded).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert!(e.to_string().contains("has 20 sets"), "{e}");
}

#[test]
fn opening_reads_indexes_and_a_set_costs_one_set() {
    let fs = recorded(60);
    let dataset = open(&fs);
    let reads = |fs: &MemFs| fs.log().iter().filter(|l| l.starts_with("read ")).count();
    let before = reads(&fs);
    let mut reader = dataset.set_reader().unwrap();
    let opening = reads(&fs) - before;
    // Magic, footer, summary by record and the two metadata records of each of the ten segments.
    assert!(opening < 10 * 80, "{opening} reads to open");
    let chunk_reads = |fs: &MemFs, number: usize, reader: &mut depthrig_recorder::SetReader| {
        let before = reads(fs);
        reader.read(number, PixelMode::Decoded).unwrap();
        reads(fs) - before
    };
    chunk_reads(&fs, 31, &mut reader);
    // Head and body of three image chunks and the one that describes them, in a segment that is open.
    assert_eq!(chunk_reads(&fs, 34, &mut reader), 8);
    let before = reads(&fs);
    reader.read(35, PixelMode::None).unwrap();
    assert_eq!(reads(&fs) - before, 2, "without pixels only the chunk that describes");
}

#[test]
fn a_damaged_set_costs_itself_and_a_cut_segment_its_end() {
    let fs = recorded(12);
    let expected = read_all(&fs);
    let mut bytes = contents(&fs, &segment(0));
    let mut reader = open(&fs).set_reader().unwrap();
    // The JPEG of the third set: JPEGs begin so.
    let third = bytes.windows(3).enumerate().filter(|(_, w)| *w == [0xff, 0xd8, 0xff]).nth(2).unwrap().0;
    bytes[third + 100] ^= 0x55;
    fs.put(&segment(0), bytes);
    let results: Vec<_> = (0..12).map(|i| reader.read(i, PixelMode::Decoded)).collect();
    assert_eq!(results.iter().filter(|r| r.is_err()).count(), 1, "one set is lost");
    for (r, e) in results.iter().zip(&expected) {
        assert!(r.as_ref().is_ok_and(|r| same(r, e)) || r.is_err());
    }

    // The second segment is cut in its last set.
    let bytes = contents(&fs, &segment(1));
    let part = segment(1).with_extension("mcap.part");
    fs.remove_file(&segment(1)).unwrap();
    fs.put(&part, bytes[..bytes.len() * 5 / 10].to_vec());
    let reader = open(&fs).set_reader().unwrap();
    let in_order = open(&fs).sets(SetRange::ALL).filter_map(Result::ok).count();
    assert_eq!(reader.times().len(), in_order + 1, "the damaged set is still numbered");
    assert_eq!(reader.problems().len(), 1);
    assert!(reader.problems()[0].contains("seg_0001.mcap.part"), "{:?}", reader.problems());

    fs.put(&segment(0), b"no mcap".to_vec());
    let reader = open(&fs).set_reader().unwrap();
    assert_eq!(reader.problems().len(), 2);
    assert!(Path::new(&reader.problems()[0]).to_string_lossy().contains("seg_0000.mcap"));
}

#[test]
fn a_stored_image_comes_with_its_pixels_when_asked_for() {
    let fs = recorded(1);
    let mut reader = open(&fs).set_reader().unwrap();
    let stored = reader.read(0, PixelMode::Stored).unwrap();
    let decoded = reader.read(0, PixelMode::Decoded).unwrap();
    let both = reader.read(0, PixelMode::DecodedAndStored).unwrap();
    for ((stored, decoded), both) in stored.frames.iter().zip(&decoded.frames).zip(&both.frames) {
        assert_eq!(both.pixels, decoded.pixels);
        assert_eq!(decoded.stored, None);
        assert_eq!(both.stored, (both.codec != "raw").then(|| stored.pixels.clone()));
    }
}
