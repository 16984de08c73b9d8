//! Limits the memory that a file can make its reader allocate, by a counting allocator.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_counting::{Counting, peak_of};
use depthrig_recorder::fs::{Fs, MemFs, RealFs};
use depthrig_recorder::fuzzing::mcap::File;
use depthrig_recorder::{
    Dataset, RecordFrame, RecordSet, Recorder, RecorderOptions, RecoverOptions, Session, StreamRecord,
    VerifyOptions, look_at, recover_with, verify_with,
};
use std::io::Read;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

#[global_allocator]
static COUNTING: Counting = Counting;

const MIB: u64 = 1 << 20;
const DIR: &str = "/d";

/// A dataset of two sets of a small image.
fn recorded() -> MemFs {
    let fs = MemFs::new();
    let mut session = Session::new("d", "rig");
    session.streams.push(StreamRecord {
        id: "front/depth".parse().unwrap(),
        model: "Test 1".into(),
        serial: "1".into(),
        format: PixelFormat::Z16,
        width: 64,
        height: 48,
        rate_hz: 5.0,
        depth_unit_m: 0.001,
        calibration: "made up".into(),
        intrinsics: Intrinsics::pinhole(60.0, 60.0, 32.0, 24.0),
        pose: Pose::IDENTITY,
    });
    let options = RecorderOptions { min_free_bytes: 0, reserve_bytes: 0, ..RecorderOptions::default() };
    let recorder = Recorder::create(Arc::new(fs.clone()), Path::new(DIR), session.clone(), options).unwrap();
    for n in 0..2 {
        let mut header = FrameHeader::default();
        header.set_names("rig", &session.streams[0].id);
        header.set_image(PixelFormat::Z16, 64, 48);
        header.sequence = n + 1;
        header.captured = n + 1;
        header.depth_unit_m = 0.001;
        header.capture_time_ns = n as i64 * 200_000_000;
        let pixels = Box::new(vec![7; 64 * 48 * 2]);
        let tick = HostTime::from_ns(header.capture_time_ns);
        let set = RecordSet {
            id: n + 1,
            tick,
            utc: UtcPair { mono: HostTime::from_ns(0), utc_ns: 1_700_000_000_000_000_000, width_ns: 1 },
            frames: vec![RecordFrame { stream: 0, header, pixels }],
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        recorder.push(set).unwrap();
    }
    recorder.finish().unwrap();
    fs
}

/// The chunk with other records: `len` zeros, packed.
fn chunk_of_zeros(body: &[u8], len: u64) -> Vec<u8> {
    let mut packed = Vec::new();
    zstd::stream::copy_encode(std::io::repeat(0).take(len), &mut packed, 1).unwrap();
    let compression = [&4u32.to_le_bytes()[..], b"zstd"].concat();
    [&body[..16], &len.to_le_bytes(), &[0; 4], &compression, &(packed.len() as u64).to_le_bytes(), &packed]
        .concat()
}

/// Everything that reads a dataset.
fn read_all(fs: &MemFs) {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    let dir = Path::new(DIR);
    let _ = look_at(&*fs, dir);
    let _ = verify_with(&fs, dir, &VerifyOptions { decode: true, threads: 2, ..VerifyOptions::default() });
    if let Ok(dataset) = Dataset::open_with(Arc::clone(&fs), dir) {
        let _ = dataset.info();
        let _ = dataset.sets(depthrig_recorder::SetRange::ALL).count();
    }
    let _ = recover_with(&fs, dir, &RecoverOptions::default(), &mut |_| ControlFlow::Continue(()));
}

/// One test, because concurrent tests would be counted as well.
#[test]
fn no_file_takes_more_memory_than_its_limits_say() {
    let whole = recorded();
    let segment = Path::new(DIR).join("seg_0000.mcap");
    let file = File::parse(&whole.contents(&segment).unwrap()).unwrap();
    let ((), usual) = peak_of(|| read_all(&whole));
    assert!(usual < 40 * MIB, "{usual} bytes for two sets");

    // A gigabyte of zeros is some tens of kilobytes in the file; and the same at the limit, where it is allowed.
    for (mib, most, tried) in [(1024, 64, 6), (200, 600, 1)] {
        let chunks = (0..file.records.len()).filter(|i| file.records[*i].0 == 6);
        for at in chunks.take(tried) {
            let mut bomb = file.clone();
            bomb.records[at].1 = chunk_of_zeros(&file.records[at].1, mib * MIB);
            let bytes = bomb.with_lengths_of(&file).to_bytes();
            assert!((bytes.len() as u64) < MIB, "{}", bytes.len());
            let fs = whole.after_crash(|n| n);
            fs.put(&segment, bytes);
            let ((), peak) = peak_of(|| read_all(&fs));
            println!("a chunk of {mib} MiB at record {at}: {} MiB", peak / MIB);
            assert!(peak < most * MIB, "a chunk of {mib} MiB takes {peak} bytes");
        }
    }

    // 300 000 tables, as arrays of tables, as inline ones, and as keys with dots; and as many as are allowed.
    let session = Path::new(DIR).join("session.toml");
    let text = String::from_utf8(whole.contents(&session).unwrap()).unwrap();
    let tables = |n: usize| "[[x]]\n".repeat(n);
    let inline = |n: usize| format!("[y]\nx = [{}]\n", "{},".repeat(n));
    let values = |n: usize| format!("[y]\nx = [{}]\n", "1,".repeat(n));
    let dotted = |n: usize| (0..n).fold(String::new(), |text, i| text + &format!("[y{i}.a.b]\n"));
    for (name, more, most) in [
        ("tables", tables(300_000), 64),
        ("inline tables", inline(300_000), 64),
        ("dotted tables", dotted(100_000), 64),
        ("values", values(5_000_000), 96),
        ("as many tables as allowed", tables(19_900), 300),
        ("as many inline tables as allowed", inline(19_900), 300),
        ("as many values as allowed", values(249_000), 300),
    ] {
        let fs = whole.after_crash(|n| n);
        fs.put(&session, format!("{text}\n{more}").into_bytes());
        let ((), peak) = peak_of(|| read_all(&fs));
        println!("{name}: {} MiB", peak / MIB);
        assert!(peak < most * MIB, "{name} take {peak} bytes");
    }

    // A sparse file of a terabyte costs nothing either.
    let dir = tempfile::tempdir().unwrap();
    for name in ["session.toml", "seg_0000.mcap"] {
        let bytes = whole.contents(&Path::new(DIR).join(name)).unwrap();
        std::fs::write(dir.path().join(name), bytes).unwrap();
    }
    let sparse = std::fs::OpenOptions::new().write(true).open(dir.path().join("session.toml")).unwrap();
    sparse.set_len(1 << 40).unwrap();
    let (entry, peak) = peak_of(|| look_at(&RealFs, dir.path()));
    assert!(entry.why.iter().any(|w| w.contains("is the limit")), "{entry:?}");
    assert!(peak < 64 * MIB, "{peak}");
}
