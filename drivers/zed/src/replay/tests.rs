//! Recordings that are written here: folders of images, and SVO2 files with the `mcap` crate's writer.

use super::fake::{self, FakeSvo};
use super::svo2::payload::Payload;
use super::*;
use core::time::Duration;
use depthrig_bus::{DropReason, Name};
use depthrig_driver::{Backend, MemorySink, Poll, StreamRequest};

const CONF: &str = include_str!("../conf/sample.conf");
/// Size of one image in the smallest mode.
const VGA: (u32, u32) = (672, 376);

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

fn options() -> OpenOptions {
    OpenOptions { calibration: CalibrationFile::None, ..OpenOptions::default() }
}

/// Writes a side-by-side RGB image: the left half is `a`, the right half `b`, with a gradient.
fn write_image(path: &Path, width: u32, height: u32, a: u8, b: u8) {
    let image = image::RgbImage::from_fn(width, height, |x, y| {
        let base = if x < width / 2 { a } else { b };
        image::Rgb([base, (y % 200) as u8, (x % 200) as u8])
    });
    image.save(path).unwrap();
}

fn all(source: &mut dyn Source) -> (Vec<Pair>, Vec<String>) {
    let mut pair = Pair::default();
    let mut pairs = Vec::new();
    let mut damaged = Vec::new();
    loop {
        match source.next(&mut pair).unwrap() {
            Next::Pair => pairs.push(pair.clone()),
            Next::Damaged(why) => damaged.push(why),
            Next::End => return (pairs, damaged),
        }
    }
}

fn refused(path: &Path, options: &OpenOptions) -> (ErrorKind, String) {
    let e = open(path, options).err().unwrap();
    (e.kind(), e.to_string())
}

#[test]
fn a_folder_gives_its_pairs_in_the_order_of_their_numbers() {
    let dir = folder();
    std::fs::write(dir.path().join("SN12345678.conf"), CONF).unwrap();
    for i in [10u8, 2, 1] {
        write_image(&dir.path().join(format!("pair_{i}.png")), 2 * VGA.0, VGA.1, i, 100 + i);
    }
    let mut source = open(dir.path(), &OpenOptions::default()).unwrap();
    let info = source.info().clone();
    assert_eq!((info.kind, info.serial.as_str(), info.width, info.height), ("folder", "12345678", 672, 376));
    assert_eq!(
        (info.format, info.rate_hz, info.timed, source.len_hint()),
        (PixelFormat::Rgb8, 30.0, false, Some(3))
    );
    assert_eq!(info.calibration.unwrap().left.fx, 266.205);
    assert!(info.calibration_origin.contains("SN12345678.conf"));
    let (pairs, damaged) = all(source.as_mut());
    assert!(damaged.is_empty());
    let firsts: Vec<_> = pairs.iter().map(|p| (p.index, p.left[0], p.right[0])).collect();
    assert_eq!(firsts, [(0, 1, 101), (1, 2, 102), (2, 10, 110)]);
    // The right image begins in the middle of each row.
    assert_eq!((pairs[0].right[2], pairs[0].left[2], pairs[0].left[672 * 3 + 1]), ((672 % 200) as u8, 0, 1));
    assert_eq!(pairs[2].capture_time_ns, 66_666_667);
    source.seek(1).unwrap();
    assert_eq!(all(source.as_mut()).0, pairs[1..]);
    source.seek(99).unwrap();
    assert!(all(source.as_mut()).0.is_empty());
}

#[test]
fn names_with_times_give_the_pairs_their_times() {
    let dir = folder();
    for t in [1_700_000_000_000_000_000i64, 1_700_000_000_066_000_000, 1_700_000_000_133_000_000] {
        write_image(&dir.path().join(format!("left_right_{t}.png")), 64, 32, 1, 2);
    }
    let mut source = open(dir.path(), &options()).unwrap();
    assert!(source.info().timed && (source.info().rate_hz - 14.93).abs() < 0.01, "{}", source.info().rate_hz);
    assert_eq!(all(source.as_mut()).0[1].capture_time_ns, 1_700_000_000_066_000_000);
}

#[test]
fn folders_that_cannot_be_say_why() {
    let dir = folder();
    let said = |wanted: &str| {
        let (kind, text) = refused(dir.path(), &OpenOptions::default());
        assert!(kind == ErrorKind::BadInput && text.contains(wanted), "{kind:?}: {text}");
    };
    said("has no side-by-side images");
    std::fs::write(dir.path().join("segment_000001.mcap"), b"x").unwrap();
    said("it is a dataset");
    write_image(&dir.path().join("1.png"), 65, 32, 1, 2);
    said("65x32 8-bit colour; a side-by-side image has an even width");
    write_image(&dir.path().join("2.png"), 64, 32, 1, 2);
    said("must be alike");
    std::fs::remove_file(dir.path().join("1.png")).unwrap();
    // A calibration for other sizes, then two of them, then one without a key.
    std::fs::write(dir.path().join("SN1.conf"), CONF).unwrap();
    said("left and right have 32x32 pixels, and");
    said("is for 2208x1242, 1920x1080, 1280x720, 672x376");
    std::fs::write(dir.path().join("SN2.conf"), CONF).unwrap();
    said("has several calibrations");
    std::fs::remove_file(dir.path().join("SN2.conf")).unwrap();
    std::fs::write(dir.path().join("SN1.conf"), CONF.replace("Baseline", "Baselime")).unwrap();
    said("[STEREO] has no Baseline");
    assert_eq!(refused(&dir.path().join("nothing"), &options()).0, ErrorKind::NotFound);
    let (kind, text) = refused(dir.path(), &OpenOptions { rate_hz: Some(0.0), ..options() });
    assert!(kind == ErrorKind::BadInput && text.contains("invalid rate 0 Hz"), "{text}");
    let deep = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(64, 32, image::Luma([9]));
    deep.save(dir.path().join("2.png")).unwrap();
    said("supported are 8-bit colour and grey");
}

#[test]
fn a_calibration_of_another_camera_is_refused() {
    let dir = folder();
    let conf = dir.path().join("SN777.conf");
    std::fs::write(&conf, CONF).unwrap();
    let path = dir.path().join("a.svo2");
    std::fs::write(&path, FakeSvo::strips(VGA, 2).build()).unwrap();
    let at = OpenOptions { calibration: CalibrationFile::At(conf), ..OpenOptions::default() };
    let (kind, text) = refused(&path, &at);
    assert!(kind == ErrorKind::BadInput && text.contains("the camera 777, and"), "{text}");
    // Beside the file it is skipped, since it is not this camera's.
    assert_eq!(open(&path, &OpenOptions::default()).unwrap().info().calibration, None);
    std::fs::write(dir.path().join(format!("SN{}.conf", fake::SERIAL)), CONF).unwrap();
    assert!(open(&path, &OpenOptions::default()).unwrap().info().calibration.is_some());
}

#[test]
fn strips_are_both_images() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    for (chunked, indexed) in [(true, true), (true, false), (false, false)] {
        let svo = FakeSvo { chunked, indexed, ..FakeSvo::strips(VGA, 7) };
        std::fs::write(&path, svo.build()).unwrap();
        let mut source = open(&path, &options()).unwrap();
        let info = source.info().clone();
        assert_eq!((info.kind, info.width, info.height, info.format), ("svo2", 672, 376, PixelFormat::Yuyv));
        assert_eq!(
            (info.serial.as_str(), info.rate_hz, info.timed),
            (fake::SERIAL.to_string().as_str(), 15.0, true)
        );
        assert_eq!(source.len_hint(), Some(7), "chunked {chunked}, indexed {indexed}");
        let (pairs, damaged) = all(source.as_mut());
        assert!(damaged.is_empty() && pairs.len() == 7, "{damaged:?}");
        for (i, p) in pairs.iter().enumerate() {
            assert_eq!((p.index, p.capture_time_ns), (i as u64, fake::time_of(i as u64)));
            let Pair { left, right, .. } = fake::images(VGA, i as u64);
            for (own, wanted) in [(&p.left, left), (&p.right, right)] {
                let most = own.iter().zip(&wanted).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
                assert!(own.len() == wanted.len() && most <= 6, "JPEG of quality 95 is {most} levels away");
            }
        }
        for at in [3, 0, 6, 7, 99] {
            source.seek(at).unwrap();
            let rest = all(source.as_mut()).0;
            assert_eq!(rest, pairs[(at as usize).min(7)..], "from {at}");
        }
    }
}

#[test]
fn a_cut_file_gives_its_complete_pairs() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    let whole = FakeSvo { per_chunk: 1, ..FakeSvo::strips(VGA, 8) }.build();
    let mut most = 0;
    for part in [30, 60, 90] {
        std::fs::write(&path, &whole[..whole.len() * part / 100]).unwrap();
        let mut source = open(&path, &options()).unwrap();
        let (pairs, damaged) = all(source.as_mut());
        assert!(
            damaged.is_empty() && pairs.len() >= most && pairs.len() < 8,
            "{} of 8 at {part} %",
            pairs.len()
        );
        assert!(pairs.iter().enumerate().all(|(i, p)| p.index == i as u64));
        most = pairs.len();
    }
    assert!(most >= 4);
}

#[test]
fn a_damaged_chunk_is_said_and_the_others_are_played() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    let svo = FakeSvo { per_chunk: 2, ..FakeSvo::strips(VGA, 8) };
    let mut bytes = svo.build();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 64].fill(0x5A);
    std::fs::write(&path, &bytes).unwrap();
    let mut source = open(&path, &options()).unwrap();
    let (pairs, damaged) = all(source.as_mut());
    assert_eq!(pairs.len() + damaged.len(), 8, "{damaged:?}");
    assert!((1..=2).contains(&damaged.len()), "{damaged:?}");
    assert_eq!(pairs.last().map(|p| p.index), Some(7), "those after it keep their numbers");
}

#[test]
fn what_is_no_svo2_or_cannot_be_decoded_says_so() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    let said = |bytes: &[u8], kind: ErrorKind, wanted: &str| {
        std::fs::write(&path, bytes).unwrap();
        let (k, text) = refused(&path, &options());
        assert!(k == kind && text.contains(wanted), "{k:?}: {text}");
        assert!(text.contains("a.svo2"), "{text}");
    };
    said(b"ZED SVO 1 and so on", ErrorKind::BadInput, "SVO files of SDK 3 and before");
    said(b"", ErrorKind::BadInput, "not an SVO2 file");
    let fake = || FakeSvo::strips(VGA, 2);
    said(
        &FakeSvo { topic: "camera/image".into(), ..fake() }.build(),
        ErrorKind::BadInput,
        "no topic Camera_SN",
    );
    said(&FakeSvo { header: None, ..fake() }.build(), ErrorKind::BadInput, "no message svo_header");
    said(&FakeSvo { header: Some("{}".into()), ..fake() }.build(), ErrorKind::BadInput, "has no \"header\"");
    said(&FakeSvo { header: Some("no".into()), ..fake() }.build(), ErrorKind::BadInput, "is not valid JSON");
    let other = FakeSvo::header_of((1280, 720), "5.0.1", false);
    said(
        &FakeSvo { header: Some(other), ..fake() }.build(),
        ErrorKind::BadInput,
        "its header says 2560x720 and its images have 1344x376",
    );
    said(&FakeSvo { frames: vec![], ..fake() }.build(), ErrorKind::BadInput, "it has no images");
    let h265 =
        fake::unit(&[0, 0, 0, 1, 0x40, 1, 0x0C, 1, 0xFF, 0xFF, 0, 0, 0, 1, 0x42, 1, 1, 1], (1344, 376), 0, 0);
    said(
        &FakeSvo { frames: vec![h265], ..fake() }.build(),
        ErrorKind::Unsupported,
        "H.265, which is not decoded here",
    );
    let secret = vec![fake::noise(5000)];
    said(
        &FakeSvo { frames: secret.clone(), header: Some(FakeSvo::header_of(VGA, "5.3.0", true)), ..fake() }
            .build(),
        ErrorKind::Unsupported,
        "it is encrypted (SDK 5.3.0",
    );
    said(
        &FakeSvo { frames: secret, header: Some(FakeSvo::header_of(VGA, "9.1", false)), ..fake() }.build(),
        ErrorKind::Unsupported,
        "neither JPEG strips nor H.264",
    );
    // A strip of grey noise in colour, and one image that breaks off.
    let mut broken = fake();
    broken.frames[1].truncate(3000);
    std::fs::write(&path, broken.build()).unwrap();
    let mut source = open(&path, &options()).unwrap();
    let (pairs, damaged) = all(source.as_mut());
    assert_eq!((pairs.len(), damaged.len()), (1, 1), "{damaged:?}");
}

/// Compared byte by byte, since the fake H.264 loses nothing. Without the library the message is tested instead.
#[test]
fn h264_is_decoded_or_the_missing_library_named() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    std::fs::write(&path, FakeSvo::h264(VGA, 8).build()).unwrap();
    let mut source = match open(&path, &options()) {
        Ok(source) => source,
        Err(e) => {
            assert!(
                e.kind() == ErrorKind::Unsupported && e.to_string().contains("apt install libopenh264-7"),
                "{e}"
            );
            eprintln!("OpenH264 is not installed: {e}");
            return;
        }
    };
    let (pairs, damaged) = all(source.as_mut());
    assert!(damaged.is_empty() && pairs.len() == 8, "{} {damaged:?}", pairs.len());
    for (i, p) in pairs.iter().enumerate() {
        let Pair { left, right, .. } = fake::images(VGA, i as u64 / 3 * 3);
        assert!(p.left == left && p.right == right, "pair {i}");
        assert_eq!(p.capture_time_ns, fake::time_of(i as u64));
    }
    for at in [5, 1, 7, 3, 0] {
        source.seek(at).unwrap();
        assert!(all(source.as_mut()).0 == pairs[at as usize..], "from {at}");
    }
    // A recording that was cut begins in the middle of what a key frame began: damaged until the next one.
    let mut svo = FakeSvo::h264(VGA, 8);
    svo.frames.remove(0);
    std::fs::write(&path, svo.build()).unwrap();
    let (rest, damaged) = all(open(&path, &options()).unwrap().as_mut());
    assert_eq!((rest.len(), damaged.len()), (5, 2), "{damaged:?}");
    assert!(rest[0].left == fake::images(VGA, 3).left);
}

#[test]
fn payloads_are_identified() {
    let is = |unit: &[u8]| Payload::parse(&fake::unit(unit, (1344, 376), 3, 2)).name().to_owned();
    assert_eq!(is(&[0, 0, 0, 1, 0x67, 0x42, 0, 0x1F, 0xFF]), "H.264", "a sequence parameter set");
    assert_eq!(is(&[0, 0, 0, 1, 0x09, 0x10, 0, 0, 0, 1, 0x41, 0x9A, 0, 0]), "H.264", "delimiter and slice");
    assert_eq!(is(&[0, 0, 0, 1, 0x41, 0x9A, 0x24, 0x6C]), "H.264", "a slice alone");
    assert_eq!(is(&[0, 0, 0, 1, 0x65, 0x88, 0x84, 0]), "H.264", "an IDR slice");
    assert_eq!(is(&[0, 0, 0, 1, 0x40, 0x01, 0x0C, 0x01]), "H.265", "a video parameter set");
    assert_eq!(is(&[0, 0, 0, 1, 0x02, 0x01, 0xD0, 0x09]), "H.265", "a slice alone");
    assert_eq!(is(&[0, 0, 0, 1, 0x26, 0x01, 0xAF, 0x09]), "H.265", "an IDR slice");
    assert_eq!(is(&[7; 40]), "a message has no start code");
    let whole = fake::unit(&[0, 0, 1, 0x67, 1], (1344, 376), 3, 2);
    let Payload::H264(unit, Some(footer)) = Payload::parse(&whole) else { panic!("no H.264") };
    assert_eq!((unit.len(), footer.size(), footer.number, footer.last_key), (5, (1344, 376), 3, 2));
    assert_eq!((footer.key_of(3), footer.key_of(9)), (Some(2), None));
    for cut in 0..60 {
        let _ = Payload::parse(&whole[..cut.min(whole.len())]);
    }
}

/// A recording plays as the camera that took it: streams, times, rate and loop.
#[test]
fn a_recording_plays_as_a_camera() {
    let dir = folder();
    std::fs::write(dir.path().join("SN5.conf"), CONF).unwrap();
    for i in 0..3u8 {
        write_image(&dir.path().join(format!("{i}.png")), 2 * VGA.0, VGA.1, i, 100 + i);
    }
    let config =
        ZedPlaybackConfig { input: dir.path().into(), rate_hz: Some(200.0), ..ZedPlaybackConfig::default() };
    let backend = ZedPlaybackBackend::new(config.clone());
    let found = backend.discover().unwrap().remove(0);
    assert_eq!((found.backend, found.serial.as_str()), ("zed", "5"));
    assert_eq!(backend.open(Some("6")).err().unwrap().kind(), ErrorKind::NotFound);
    let play = |backend: &ZedPlaybackBackend, requests: &[StreamRequest], most: usize| {
        let mut stream = backend.open(None).unwrap().start(requests).unwrap();
        let mut sink = MemorySink::default();
        while sink.frames.len() < most
            && stream.poll(Duration::from_millis(50), &mut sink).unwrap() != Poll::End
        {}
        (sink, stream.profiles().to_vec())
    };
    let (sink, profiles) = play(&backend, &[], usize::MAX);
    assert_eq!((sink.delivered(0), sink.delivered(1), profiles[1].rate_hz), (3, 3, 200.0));
    assert!(
        (profiles[1].pose_in_device.translation_m[0] - 0.12).abs() < 1e-3
            && profiles[0].intrinsics.is_known()
    );
    let times: Vec<_> = sink.frames.iter().filter(|f| f.0 == 0).map(|f| f.1.capture_time.ns()).collect();
    assert!(times.windows(2).all(|w| w[1] - w[0] >= 5_000_000), "{times:?}");
    assert_eq!(sink.frames[0].1.capture_time, sink.frames[1].1.capture_time, "both images of one pair");
    let looping = ZedPlaybackBackend::new(ZedPlaybackConfig { looped: true, ..config });
    let right = StreamRequest::any(Name::new("right").unwrap());
    let (sink, _) = play(&looping, &[right], 8);
    let reds: Vec<_> = sink.frames.iter().map(|f| f.2[0]).collect();
    assert_eq!(reds, [100, 101, 102, 100, 101, 102, 100, 101]);
}

#[test]
fn a_damaged_pair_is_a_counted_drop_of_both_images() {
    let dir = folder();
    let path = dir.path().join("a.svo2");
    let mut svo = FakeSvo::strips(VGA, 4);
    svo.frames[2].truncate(2000);
    std::fs::write(&path, svo.build()).unwrap();
    let config = ZedPlaybackConfig { input: path, rate_hz: Some(100.0), ..ZedPlaybackConfig::default() };
    let mut stream = ZedPlaybackBackend::new(config).open(None).unwrap().start(&[]).unwrap();
    let mut sink = MemorySink::default();
    while stream.poll(Duration::from_millis(50), &mut sink).unwrap() != Poll::End {}
    for side in 0..2 {
        assert_eq!((sink.captured[side], sink.delivered(side)), (4, 3));
        assert_eq!(sink.drops_of(side).get(DropReason::DeviceError), 1);
    }
}
