//! What verification finds.

use crate::support::*;
use depthrig_bus::{DropCounts, PixelFormat};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    Recorder, RecorderOptions, Severity, StreamAccount, VerifyOptions, VerifyReport, verify_with,
};
use proptest::prelude::*;
use std::sync::Arc;

fn check(fs: &MemFs, options: &VerifyOptions) -> VerifyReport {
    let fs: Arc<dyn Fs> = Arc::new(fs.clone());
    verify_with(&fs, &dir(), options).unwrap()
}

fn found(fs: &MemFs) -> Vec<String> {
    check(fs, &VerifyOptions::default()).findings.into_iter().map(|f| f.message).collect()
}

#[test]
fn a_good_dataset_has_no_findings() {
    let fs = MemFs::new();
    record(&fs, 7, RecorderOptions { segment_max_ns: 3 * PERIOD, ..options() });
    let report = check(&fs, &VerifyOptions { decode: true, max_spread_ns: Some(1000) });
    assert_eq!(report.findings, []);
    assert!(report.is_whole());
    assert_eq!((report.sets, report.frames, report.segments), (7, 21, 3));
    // A segment in the middle is whole on its own as well.
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
fn rewrite(fs: &MemFs, mut change: impl FnMut(&mut mcap::Message) -> bool) {
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
    let mut pictures = 0;
    rewrite(&fs, |m| {
        let picture = m.channel.topic == "/rig/front/depth/image_raw";
        pictures += u32::from(picture);
        !(picture && pictures == 2)
    });
    assert_eq!(found(&fs), ["set 2: front/depth has no picture"]);
    let errors: Vec<_> = open(&fs)
        .sets(depthrig_recorder::SetRange::ALL)
        .filter_map(Result::err)
        .map(|e| e.to_string())
        .collect();
    assert!(errors.len() == 1 && errors[0].contains("set 2 lacks the picture of front/depth"), "{errors:?}");
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
fn a_picture_swapped_for_another_is_found() {
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
        ["set 1: front/depth: its picture is another one", "set 2: front/depth: its picture is another one"]
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
fn a_cameras_damaged_jpeg_is_found_when_pictures_are_decoded() {
    let jpeg = {
        let mut out = Vec::new();
        let rgb = pixels(PixelFormat::Rgb8, 64, 48, 1);
        jpeg_encoder::Encoder::new(&mut out, 90).encode(&rgb, 64, 48, jpeg_encoder::ColorType::Rgb).unwrap();
        out
    };
    // The second one is of another size than its header says, the third one no JPEG at all.
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
        (pushed.frames[0].header.payload_len, pushed.frames[0].header.stride) = (bytes.len() as u32, 0);
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
