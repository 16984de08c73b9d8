//! Findings of a verification. Long because it is a list: each kind of damage with the finding that must name it.

use crate::support::*;
use depthrig_bus::{DropCounts, HostTime, PixelFormat, UtcPair};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    Finding, Recorder, RecorderOptions, RecoverOptions, Severity, StreamAccount, VerifyOptions, VerifyReport,
    recover_with, verify_with,
};
use proptest::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

pub fn check(fs: &MemFs, options: &VerifyOptions) -> VerifyReport {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    verify_with(&fs, &dir(), options).unwrap()
}

pub fn found(fs: &MemFs) -> Vec<String> {
    check(fs, &VerifyOptions::default()).findings.into_iter().map(|f| f.message).collect()
}

#[test]
fn a_good_dataset_has_no_findings() {
    let fs = MemFs::new();
    record(&fs, 7, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
    let report = check(&fs, &VerifyOptions { decode: true, max_spread_ns: Some(1000), threads: 0 });
    assert_eq!(report.findings, []);
    assert!(report.is_whole());
    assert_eq!((report.sets, report.frames, report.segments), (7, 21, 3));
    // A segment in the middle is complete on its own as well.
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let alone = verify_with(&shared, &segment(1), &VerifyOptions::default()).unwrap();
    assert_eq!(alone.findings, []);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(120))]
    #[test]
    fn a_flipped_bit_anywhere_is_found(at in any::<prop::sample::Index>(), from_end in any::<bool>(), bit in 0u8..8) {
        let (fs, bytes) = recorded();
        let mut bytes = bytes.clone();
        // Half of the cases in the last bytes, where data end, summary and footer meet.
        let at = if from_end { bytes.len() - 1 - at.index(200) } else { at.index(bytes.len()) };
        bytes[at] ^= 1 << bit;
        let fs = copy(fs);
        fs.put(&segment(0), bytes);
        let report = check(&fs, &VerifyOptions::default());
        prop_assert_eq!(report.worst(), Some(Severity::Broken), "byte {} bit {} was flipped unnoticed", at, bit);
    }
}

fn recorded() -> &'static (MemFs, Vec<u8>) {
    static DATASET: std::sync::OnceLock<(MemFs, Vec<u8>)> = std::sync::OnceLock::new();
    DATASET.get_or_init(|| {
        let fs = MemFs::new();
        record(&fs, 3, options());
        let bytes = contents(&fs, &segment(0));
        (fs, bytes)
    })
}

/// Writes the messages of a segment again with the `mcap` crate, changed: valid as MCAP, wrong as a dataset.
pub fn rewrite(fs: &MemFs, mut change: impl FnMut(&mut mcap::Message) -> bool) {
    let bytes = contents(fs, &segment(0));
    let mut out = mcap::WriteOptions::new()
        .profile("ros2")
        .compression(None)
        .create(std::io::Cursor::new(Vec::new()))
        .unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    for index in &summary.metadata_indexes {
        out.write_metadata(&mcap::read::metadata(&bytes, index).unwrap()).unwrap();
    }
    for m in mcap::MessageStream::new(&bytes).unwrap() {
        let mut m = m.unwrap();
        if change(&mut m) {
            out.write(&m).unwrap();
        }
    }
    out.finish().unwrap();
    fs.put(&segment(0), out.into_inner().into_inner());
}

#[test]
fn another_writers_copy_of_a_segment_is_as_good() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let before = read_all(&fs);
    rewrite(&fs, |_| true);
    assert_eq!(found(&fs), Vec::<String>::new());
    for (a, b) in before.iter().zip(read_all(&fs)) {
        assert_eq!(a.frames[1].pixels, b.frames[1].pixels);
    }
}

#[test]
fn a_missing_member_is_found() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let mut images = 0;
    rewrite(&fs, |m| {
        let image = m.channel.topic == "/rig/front/depth/image_raw";
        images += u32::from(image);
        !(image && images == 2)
    });
    assert_eq!(found(&fs), ["set 2: front/depth has no image"]);
    let errors: Vec<_> = open(&fs)
        .sets(depthrig_recorder::SetRange::ALL)
        .filter_map(Result::err)
        .map(|e| e.to_string())
        .collect();
    assert!(errors.len() == 1 && errors[0].contains("set 2 lacks the image of front/depth"), "{errors:?}");
}

#[test]
fn missing_descriptions_are_found() {
    let fs = MemFs::new();
    record(&fs, 1, options());
    rewrite(&fs, |m| !m.channel.topic.ends_with("/front/depth/camera_info"));
    assert_eq!(found(&fs), ["set 1: front/depth has no camera_info"]);
    let fs = MemFs::new();
    record(&fs, 1, options());
    rewrite(&fs, |m| !m.channel.topic.ends_with("/front/depth/frame_info"));
    assert_eq!(found(&fs), ["set 1: front/depth has no frame_info"]);
}

#[test]
fn an_image_swapped_for_another_is_found() {
    let fs = MemFs::new();
    record(&fs, 2, options());
    rewrite(&fs, |m| {
        if m.channel.topic == "/rig/front/depth/image_raw" {
            let last = m.data.len() - 1;
            m.data.to_mut()[last] ^= 1;
        }
        true
    });
    assert_eq!(
        found(&fs),
        ["set 1: front/depth: its image is another one", "set 2: front/depth: its image is another one"]
    );
}

#[test]
fn a_lost_set_breaks_the_account() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let mut marks = 0;
    rewrite(&fs, |m| {
        marks += u32::from(m.channel.topic == "/rig/frame_set");
        !(m.channel.topic == "/rig/frame_set" && marks == 2)
    });
    let found = found(&fs);
    assert!(found.iter().any(|f| f == "the account says 3 sets were recorded, 2 are there"), "{found:?}");
    assert!(found.iter().any(|f| f == "it says 3 sets were recorded, 2 are there"), "{found:?}");
}

#[test]
fn accounts_that_do_not_balance_are_found() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.update_accounts(vec![StreamAccount {
        stream: "front/depth".parse().unwrap(),
        captured: 30,
        delivered: 28,
        dropped: DropCounts([0, 1, 0, 0, 0, 0, 0, 0]),
    }]);
    r.push(set(&session(), 0)).unwrap();
    r.finish().unwrap();
    assert!(
        found(&fs).iter().any(|f| f
            == "the account of front/depth does not balance: 30 captured, 28 delivered, 1 dropped"),
        "{:?}",
        found(&fs)
    );
}

#[test]
fn a_missing_segment_is_found() {
    let fs = MemFs::new();
    record(&fs, 7, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
    fs.remove_file(&segment(1)).unwrap();
    let found = found(&fs);
    assert!(
        found.iter().any(|f| f == "seg_0001.mcap is missing, seg_0002.mcap is in its place"),
        "{found:?}"
    );
}

#[test]
fn a_wide_spread_and_a_false_one_are_found() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    let mut wide = set(&session(), 0);
    wide.frames[0].header.capture_time_ns += 50_000_000;
    wide.spread_ns = 50_000_000;
    let mut honest = set(&session(), 1);
    honest.spread_ns += 1;
    r.push(wide).unwrap();
    r.push(honest).unwrap();
    r.finish().unwrap();
    let report = check(&fs, &VerifyOptions { max_spread_ns: Some(30_000_000), ..Default::default() });
    let found: Vec<_> = report.findings.iter().map(|f| (f.severity, f.message.as_str())).collect();
    assert!(
        found.iter().any(|(s, m)| *s == Severity::Broken && m.starts_with("set 2: its frames are")),
        "{found:?}"
    );
    assert!(
        found.iter().any(|(s, m)| *s == Severity::Lost && m.contains("30000000 is the limit")),
        "{found:?}"
    );
}

#[test]
fn a_damaged_session_file_does_not_hide_the_rest() {
    let fs = MemFs::new();
    record(&fs, 2, options());
    fs.put(&dir().join("session.toml"), b"name = ".to_vec());
    let report = check(&fs, &VerifyOptions::default());
    assert_eq!(report.sets, 2);
    assert!(report.findings[0].message.contains("cannot be read as a session"), "{:?}", report.findings);
    fs.remove_file(&dir().join("session.toml")).unwrap();
    let report = check(&fs, &VerifyOptions::default());
    assert!(report.findings[0].message.contains("session.toml is missing"), "{:?}", report.findings);
    assert_eq!(report.sets, 2);
}

#[test]
fn a_cameras_damaged_jpeg_is_found_when_images_are_decoded() {
    let jpeg = {
        let mut out = Vec::new();
        let rgb = pixels(PixelFormat::Rgb8, 64, 48, 1);
        jpeg_encoder::Encoder::new(&mut out, 90).encode(&rgb, 64, 48, jpeg_encoder::ColorType::Rgb).unwrap();
        out
    };
    // The second one is of another size than its header says, the third one is not JPEG at all.
    for (height, damage, expected) in
        [(48, false, None), (32, false, Some("its JPEG is 64x48")), (48, true, Some("its JPEG is damaged"))]
    {
        let fs = MemFs::new();
        let mut session = session();
        session.streams = vec![stream("cam/color", PixelFormat::Mjpeg, 64, height)];
        let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
        let mut pushed = set(&session, 0);
        let mut bytes = jpeg.clone();
        if damage {
            bytes[..4].fill(0);
        }
        pushed.frames[0].header.payload_len = bytes.len() as u32;
        pushed.frames[0].header.stride = 0;
        pushed.frames[0].pixels = Box::new(bytes);
        r.push(pushed).unwrap();
        r.finish().unwrap();
        assert_eq!(found(&fs), Vec::<String>::new(), "without decoding it is as good as it came");
        let findings = check(&fs, &VerifyOptions { decode: true, ..Default::default() }).findings;
        match expected {
            None => assert_eq!(findings, []),
            Some(what) => assert!(findings.len() == 1 && findings[0].message.contains(what), "{findings:?}"),
        }
    }
}

/// Where a record of a file begins, its opcode and its length with head.
fn records(bytes: &[u8]) -> Vec<(usize, u8, usize)> {
    let mut at = 8;
    let mut found = Vec::new();
    while at + 9 <= bytes.len() && bytes[at..] != bytes[..8] {
        let len = 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        found.push((at, bytes[at], len));
        at += len;
    }
    found
}

const CHUNK: u8 = 6;
const MESSAGE_INDEX: u8 = 7;
const CHUNK_INDEX: u8 = 8;
const STATISTICS: u8 = 0x0b;
const DATA_END: u8 = 0x0f;
const FOOTER: u8 = 2;

/// Makes the checksums over data and summary those of the changed bytes, and the footer point to the summary.
fn mend(bytes: &mut [u8]) {
    let records = records(bytes);
    let place = |opcode| records.iter().find(|r| r.1 == opcode).unwrap().0;
    let data_end = place(DATA_END);
    let footer = place(FOOTER);
    let crc = crc32fast::hash(&bytes[..data_end]);
    bytes[data_end + 9..data_end + 13].copy_from_slice(&crc.to_le_bytes());
    bytes[footer + 9..footer + 17].copy_from_slice(&(data_end as u64 + 13).to_le_bytes());
    let crc = crc32fast::hash(&bytes[data_end + 13..footer + 25]);
    bytes[footer + 25..footer + 29].copy_from_slice(&crc.to_le_bytes());
}

/// The recorded segment with its checksums mended after a change; what is found by default and with decoding.
fn forged(change: impl FnOnce(&mut Vec<u8>)) -> [Vec<String>; 2] {
    let (fs, bytes) = recorded();
    let mut bytes = bytes.clone();
    change(&mut bytes);
    mend(&mut bytes);
    let fs = copy(fs);
    fs.put(&segment(0), bytes);
    [false, true].map(|decode| {
        let report = check(&fs, &VerifyOptions { decode, ..Default::default() });
        let broken = report.findings.into_iter().filter(|f| f.severity == Severity::Broken);
        // A checkpoint sees most of what is forged, too; here it is about what would be seen without one.
        broken.map(|f| f.message).filter(|m| !m.contains("the checkpoint says")).collect()
    })
}

/// The packed chunks with an image: those that verification does not unpack by itself.
fn packed_images(bytes: &[u8]) -> Vec<(usize, usize)> {
    let all = records(bytes);
    let one_message = |i: usize| all[i + 1].1 == MESSAGE_INDEX && all[i + 2].1 != MESSAGE_INDEX;
    let zstd = |at: usize| &bytes[at + 41..at + 45] == b"zstd";
    let chunks = all.iter().enumerate().filter(|(i, r)| r.1 == CHUNK && one_message(*i) && zstd(r.0));
    chunks.map(|(_, r)| (r.0, r.2)).collect()
}

/// One bit of each byte (`DEPTHRIG_LONG=1`), or of every 23rd.
#[test]
fn no_flipped_byte_of_a_finished_segment_stays_unseen() {
    let (fs, bytes) = recorded();
    let fs = copy(fs);
    let step = if std::env::var_os("DEPTHRIG_LONG").is_some() { 1 } else { 23 };
    let mut changed = bytes.clone();
    for at in (0..bytes.len()).step_by(step) {
        changed[at] ^= 1 << (at % 8);
        fs.put(&segment(0), changed.clone());
        let worst = check(&fs, &VerifyOptions::default()).worst();
        assert_eq!(worst, Some(Severity::Broken), "byte {at} was changed unnoticed");
        changed[at] = bytes[at];
    }
    assert!(packed_images(bytes).len() >= 6, "images that are not unpacked were among them");
}

/// First, middle and last byte of each part of each kind of record.
#[test]
fn damage_of_every_kind_of_record_is_found() {
    let (fs, bytes) = recorded();
    let fs = copy(fs);
    let mut kinds = std::collections::BTreeSet::new();
    for (at, opcode, len) in records(bytes) {
        kinds.insert(opcode);
        for place in [at, at + 1, at + 8, at + 9, at + usize::midpoint(9, len), at + len - 1] {
            let mut changed = bytes.clone();
            changed[place.min(bytes.len() - 1)] ^= 0x41;
            fs.put(&segment(0), changed);
            let worst = check(&fs, &VerifyOptions::default()).worst();
            assert_eq!(worst, Some(Severity::Broken), "byte {place}, a record of kind {opcode:#x} at {at}");
        }
    }
    // Header, footer, schema, channel, chunk, message index, chunk index, attachment and its index, statistics,
    // metadata and its index, summary offset, data end.
    assert_eq!(kinds.into_iter().collect::<Vec<_>>(), [1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]);
}

/// Only unpacking shows an image whose packed bytes were changed with every checksum around it corrected: this also
/// proves that verification by default does not unpack it.
#[test]
fn an_image_forged_behind_its_checksums_is_found_by_unpacking() {
    let (_, bytes) = recorded();
    for (at, len) in packed_images(bytes) {
        let [default, decoded] = forged(|b| b[at + len - 20] ^= 0x55);
        assert_eq!(default, Vec::<String>::new());
        assert!(decoded.len() == 1 && decoded[0].starts_with("set "), "{decoded:?}");
        // The head of an image's chunk is compared with the mark of its set.
        let [default, _] = forged(|b| b[at + 33] ^= 1);
        assert!(default.len() == 1 && default[0].contains("a chunk's checksum is"), "checksum: {default:?}");
        let [default, _] = forged(|b| b[at + 25] ^= 1);
        let reported = default.iter().any(|m| m.ends_with("its image is another one"));
        assert!(reported && default.len() == 2, "size: {default:?}");
        for time in [at + 9, at + 17] {
            let [default, _] = forged(|b| b[time] ^= 1);
            assert!(default.iter().any(|m| m.contains("the index of a chunk")), "times: {default:?}");
        }
    }
}

#[test]
fn an_index_that_lies_is_found_though_every_checksum_is_right() {
    let (_, bytes) = recorded();
    let all = records(bytes);
    let mut chunk_indexes = 0;
    for (at, opcode, len) in all {
        let fields: &[usize] = match opcode {
            // Times, offset, length of the chunk, a message index's offset; then the end: its uncompressed size.
            CHUNK_INDEX => &[0, 8, 16, 24, 36, 38, len - 9 - 8],
            // Messages; schemas, channels, attachments, metadata, chunks; first and last time.
            STATISTICS => &[0, 8, 10, 14, 18, 22, 26, 34],
            // Log time and offset of the first entry.
            MESSAGE_INDEX => &[6, 14],
            _ => continue,
        };
        chunk_indexes += usize::from(opcode == CHUNK_INDEX);
        if opcode == CHUNK_INDEX && chunk_indexes % 5 != 1 {
            continue;
        }
        for field in fields {
            let [default, _] = forged(|b| b[at + 9 + field] ^= 1);
            assert!(!default.is_empty(), "kind {opcode:#x} at {at}, field at {field}");
        }
    }
    assert!(chunk_indexes > 10);
}

#[test]
fn a_chunk_taken_out_is_found_though_every_checksum_is_right() {
    let (_, bytes) = recorded();
    for (at, len) in packed_images(bytes) {
        let index = u64::from_le_bytes(bytes[at + len + 1..at + len + 9].try_into().unwrap()) as usize + 9;
        let [default, _] = forged(|b| {
            b.drain(at..at + len + index);
        });
        assert!(default.len() >= 2, "the index as well: {default:?}");
        assert!(default.iter().any(|m| m.ends_with("has no image")), "{default:?}");
    }
}

/// Writes a segment again with its messages in another order: `order` is given the place of each and its log time.
fn reorder(fs: &MemFs, order: impl Fn(&mut Vec<(u64, mcap::Message<'static>)>)) {
    let bytes = contents(fs, &segment(0));
    let all = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let mut all: Vec<_> =
        all.map(|m| (m.log_time, mcap::Message { data: m.data.into_owned().into(), ..m })).collect();
    order(&mut all);
    let mut next = all.into_iter();
    rewrite(fs, |m| {
        let Some((_, other)) = next.next() else { return false };
        *m = other;
        true
    });
}

#[test]
fn two_sets_in_each_others_place_are_found() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    let second = (T0 + PERIOD).cast_unsigned();
    reorder(&fs, |all| all.sort_by_key(|(t, _)| if *t == second { u64::MAX } else { *t }));
    let found = found(&fs);
    for what in
        ["set 2: it follows set 3", "set 2: its log time is not later", "set 2: its tick is not later"]
    {
        assert!(found.iter().any(|f| f.starts_with(what)), "{what}: {found:?}");
    }
}

#[test]
fn accounts_that_do_not_agree_with_the_sets_are_found() {
    let fs = MemFs::new();
    record(&fs, 3, options());
    rewrite(&fs, |m| {
        if m.channel.topic == "/rig/accounts" {
            // Stamp, then offered and recorded: both one more, so that the account balances.
            for at in [12, 20] {
                m.data.to_mut()[at] += 1;
            }
        }
        true
    });
    assert_eq!(found(&fs), ["the account says 4 sets were recorded, 3 are there"]);
}

#[test]
fn frames_whose_own_accounts_are_wrong_are_found() {
    let found = |change: &dyn Fn(usize, &mut depthrig_bus::FrameHeader)| {
        let fs = MemFs::new();
        let r = recorder(&fs, options());
        for n in 0..3 {
            let mut pushed = set(&session(), n);
            change(n as usize, &mut pushed.frames[1].header);
            r.push(pushed).unwrap();
        }
        r.finish().unwrap();
        found(&fs)
    };
    let balance = found(&|n, h| h.captured += u64::from(n == 1));
    assert_eq!(
        balance,
        ["set 2: front/depth: its header does not balance: 10 captured, 7 delivered, 2 dropped"]
    );
    let backwards = |n: usize, h: &mut depthrig_bus::FrameHeader| {
        if n == 2 {
            h.sequence = 3;
            h.captured = 5;
        }
    };
    assert_eq!(found(&backwards), ["set 3: front/depth: the account in its header goes backwards"]);
    let reasons = found(&|n, h| {
        if n == 2 {
            h.dropped[1] = 1;
            h.dropped[2] = 1;
        }
    });
    assert_eq!(reasons, ["set 3: front/depth: the account in its header goes backwards"]);
    // A replay that was recorded may have begun again.
    let replayed = found(&|n, h| {
        backwards(n, h);
        h.flags |= depthrig_bus::FrameFlags::REPLAYED.0;
    });
    assert_eq!(replayed, Vec::<String>::new());
}

#[test]
fn the_sessions_own_limit_of_the_spread_is_used() {
    let fs = MemFs::new();
    let mut session = session();
    session.max_spread_ns = Some(2_000_000);
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    let mut wide = set(&session, 0);
    wide.frames[0].header.capture_time_ns += 5_000_000;
    let times = wide.frames.iter().map(|f| f.header.capture_time_ns);
    wide.spread_ns = times.clone().max().unwrap() - times.min().unwrap();
    r.push(wide).unwrap();
    r.push(set(&session, 1)).unwrap();
    r.finish().unwrap();
    let report = check(&fs, &VerifyOptions::default());
    assert_eq!(report.worst(), Some(Severity::Lost));
    assert!(report.findings[0].message.ends_with("2000000 is the limit"), "{:?}", report.findings);
    let wider = VerifyOptions { max_spread_ns: Some(9_000_000), ..Default::default() };
    assert_eq!(check(&fs, &wider).findings, [], "the option overrides the session");
}

#[test]
fn streams_without_calibration_or_without_its_source_are_named() {
    let fs = MemFs::new();
    let mut session = session();
    session.streams[0].intrinsics = depthrig_bus::Intrinsics::default();
    session.streams[1].calibration = String::new();
    session.streams[1].depth_unit_m = 0.0;
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    r.push(set(&session, 0)).unwrap();
    r.finish().unwrap();
    let report = check(&fs, &VerifyOptions::default());
    let found: Vec<_> = report.findings.iter().map(|f| (f.severity, f.message.as_str())).collect();
    assert_eq!(
        found,
        [
            (Severity::Broken, "front/depth is depth without a unit: its numbers mean nothing"),
            (Severity::Note, "front/color has no calibration"),
            (Severity::Note, "front/depth does not say where its calibration comes from"),
        ]
    );
}

#[test]
fn a_recovered_segment_says_what_it_lost_alone_and_the_dataset_says_it_once() {
    let fs = MemFs::new();
    record(&fs, 9, RecorderOptions { segment_max_ns: 100 * PERIOD, ..options() });
    let mut bytes = contents(&fs, &segment(0));
    let at = bytes.len() * 2 / 5;
    bytes[at..at + 512].fill(0xA5);
    fs.put(&segment(0), bytes);
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let go_on = &mut |_| std::ops::ControlFlow::Continue(());
    let said = recover_with(&shared, &dir(), &RecoverOptions::default(), go_on).unwrap();
    let words = &said.segments[0].lost;
    assert!(!words.is_empty());
    let alone = verify_with(&shared, &segment(0), &VerifyOptions::default()).unwrap();
    let parts = |f: &Finding| (f.severity, f.file.clone(), f.message.clone());
    let expected: Vec<_> =
        words.iter().map(|w| (Severity::Lost, "seg_0000.mcap".to_owned(), w.clone())).collect();
    // Lost sets lose their IMU batches and samples of signals, which the numbers around them show.
    let (beside, of_sets): (Vec<_>, Vec<_>) =
        alone.findings.iter().partition(|f| f.severity == Severity::Note);
    assert_eq!(of_sets.into_iter().map(parts).collect::<Vec<_>>(), expected);
    let beside: Vec<_> = beside.iter().map(|f| f.message.as_str()).collect();
    let batches = ["front/imu", "side/imu"].map(|u| format!("{BATCHES} batches of {u} were not recorded"));
    let samples =
        ["arm/gripper", "arm/joints"].map(|s| format!("{SIGNAL_SAMPLES} samples of {s} were not recorded"));
    assert_eq!(beside, [batches, samples].concat());
    let whole = check(&fs, &VerifyOptions::default()).findings;
    for what in words {
        assert_eq!(whole.iter().filter(|f| f.message == *what).count(), 1, "{whole:?}");
    }
    assert!(whole.len() > words.len(), "the session knows of sets in no segment: {whole:?}");
}

/// Records `sets` sets over two segments; after set n the clocks are read, UTC being off by `off_ns(n)`.
fn clocked(sets: u64, off_ns: impl Fn(i64) -> i64) -> MemFs {
    let fs = MemFs::new();
    let now = Arc::new(AtomicI64::new(0));
    let theirs = Arc::clone(&now);
    let read = Arc::new(AtomicI64::new(-1));
    let offs: Vec<i64> = (0..sets as i64).map(off_ns).collect();
    let utc = {
        let read = Arc::clone(&read);
        Arc::new(move || {
            let n = theirs.load(Ordering::SeqCst);
            read.store(n, Ordering::SeqCst);
            let mono = HostTime::from_ns(M0 + n * PERIOD + 1);
            UtcPair { mono, utc_ns: T0 + n * PERIOD + 1 + offs[n as usize], width_ns: 100 }
        })
    };
    let options = RecorderOptions { sync_interval_ns: 1, segment_max_ns: 5 * PERIOD, ..options() };
    let r = Recorder::create_with(Arc::new(fs.clone()), utc, &dir(), session(), options).unwrap();
    for n in 0..sets {
        now.store(n as i64, Ordering::SeqCst);
        r.push(set(&session(), n)).unwrap();
        let there = || read.load(Ordering::SeqCst) == n as i64;
        assert!((0..20_000).any(|_| there() || {
            std::thread::sleep(std::time::Duration::from_millis(1));
            false
        }));
    }
    r.finish().unwrap();
    fs
}

#[test]
fn a_step_of_the_wall_clock_is_a_note_with_its_size_and_time_and_drift_is_none() {
    let day = 86_400_000_000_000;
    for (by_ns, said) in [(-day, "-86400000.0 ms"), (1_500_000, "+1.5 ms")] {
        // Seen in the first of two segments: the second begins with the first reading again.
        let fs = clocked(8, |n| if n >= 3 { by_ns } else { 0 });
        let report = check(&fs, &VerifyOptions::default());
        assert_eq!((report.findings.len(), report.segments), (1, 2), "{:?}", report.findings);
        let f = &report.findings[0];
        let at = format!("{:.1} s after", 3.0 * PERIOD as f64 / 1e9);
        assert_eq!((f.severity, f.file.as_str()), (Severity::Note, "seg_0000.mcap"));
        assert!(f.offset.is_some() && f.message.contains(said) && f.message.contains(&at), "{f:?}");
        assert!(report.is_whole());
    }
    // 400 ppm, as NTP slews.
    let fs = clocked(8, |n| n * PERIOD / 2500);
    assert_eq!(check(&fs, &VerifyOptions::default()).findings, []);
}

/// A `.part` with checkpoints, and sets after the last of them.
fn unfinished() -> (MemFs, std::path::PathBuf, Vec<u8>) {
    let fs = MemFs::new();
    let r = recorder(&fs, RecorderOptions { sync_interval_ns: 3_000_000, ..options() });
    for n in 0..4 {
        r.push(set(&session(), n)).unwrap();
        settle(&r);
        std::thread::sleep(std::time::Duration::from_millis(12));
    }
    drop(r);
    let part = dir().join("seg_0000.mcap.part");
    let mut bytes = contents(&fs, &part);
    // The last set is the end of the file: no checkpoint covers it.
    let last = packed_images(&bytes).pop().unwrap().0;
    let after: Vec<_> = records(&bytes).into_iter().filter(|r| r.1 == CHUNK && r.0 > last).collect();
    if let Some(beyond) = after.get(1) {
        bytes.truncate(beyond.0);
        fs.put(&part, bytes.clone());
    }
    (fs, part, bytes)
}

#[test]
fn damage_in_an_unfinished_segment_is_found_before_and_after_its_checkpoints() {
    let (fs, part, bytes) = unfinished();
    let usual = check(&fs, &VerifyOptions::default()).findings;
    assert!(
        usual.iter().all(|f| f.message.contains("unfinished") || f.message.contains("not closed")),
        "{usual:?}"
    );
    let chunks: Vec<_> = records(&bytes).into_iter().filter(|r| r.1 == CHUNK && r.2 > 700).collect();
    assert!(chunks.len() >= 8, "{chunks:?}");
    for (at, _, len) in chunks {
        for place in [at + 60, at + len / 2, at + len - 1] {
            let mut changed = bytes.clone();
            changed[place] ^= 0x10;
            fs.put(&part, changed);
            let found = check(&fs, &VerifyOptions::default()).findings;
            assert!(found.len() > usual.len(), "byte {place} of the chunk at {at}: {found:?}");
        }
    }
}

#[test]
fn findings_do_not_depend_on_the_number_of_threads() {
    let (fs, bytes) = recorded();
    let mut bytes = bytes.clone();
    for (at, len) in packed_images(&bytes) {
        bytes[at + len - 20] ^= 0x55;
    }
    mend(&mut bytes);
    let fs = copy(fs);
    fs.put(&segment(0), bytes);
    let with = |threads| check(&fs, &VerifyOptions { decode: true, threads, ..Default::default() }).findings;
    let one = with(1);
    assert!(one.len() >= 7 && one[0].message.contains("the checkpoint says"), "{one:?}");
    assert!(one[1..].is_sorted_by_key(|f| f.offset), "{one:?}");
    for threads in [0, 2, 3, 7] {
        for _ in 0..5 {
            assert_eq!(with(threads), one);
        }
    }
}

#[test]
fn verification_tells_how_far_it_is_and_can_be_stopped() {
    use std::ops::ControlFlow;
    let fs = MemFs::new();
    let mut session = session();
    session.streams = vec![stream("cam/ir", PixelFormat::Mono8, 1024, 1024)];
    let noise: Arc<[u8]> = {
        let mut x = 1u64;
        let mut next = || {
            x ^= x << 13;
            x ^= x >> 7;
            x ^= x << 17;
            x as u8
        };
        (0..1 << 20).map(|_| next()).collect()
    };
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    for n in 0..12 {
        let mut pushed = set_of(&session, n, &[]);
        pushed.missing = Vec::new();
        pushed.spread_ns = 0;
        let header = header(&session.streams[0], n);
        pushed.frames =
            vec![depthrig_recorder::RecordFrame { stream: 0, header, pixels: Box::new(Arc::clone(&noise)) }];
        r.push(pushed).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    let fs: Arc<dyn Fs> = Arc::new(fs);
    let mut seen = Vec::new();
    let mut go_on = |p: depthrig_recorder::VerifyProgress| {
        seen.push((p.bytes, p.total_bytes));
        ControlFlow::Continue(())
    };
    let options = VerifyOptions::default();
    let report = depthrig_recorder::verify_watched(&fs, &dir(), &options, &mut go_on).unwrap();
    assert!(report.is_whole() && !report.stopped);
    assert!(seen.len() >= 2 && seen.is_sorted() && seen.iter().all(|(b, t)| b <= t), "{seen:?}");
    let stopped =
        depthrig_recorder::verify_watched(&fs, &dir(), &options, &mut |_| ControlFlow::Break(())).unwrap();
    assert!(stopped.stopped && stopped.sets < report.sets, "{stopped:?}");
}
