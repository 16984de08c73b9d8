//! Recordings of an Azure Kinect as the SDK writes them, in early forms, from other writers, cut, damaged and lying.
//! Long because each form is a case.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_driver::ErrorKind;
use depthrig_kinect::recording::{Losses, Pixels, ReadAt, TrackKind, motion_samples};
use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode, Recording, WiredSync};
use depthrig_kinect_fixture::{
    ACCEL_LATE_NS, CALIBRATION, Fixture, Images, Lacing, Pattern, element, motion,
};
use std::path::PathBuf;

fn open(bytes: Vec<u8>) -> depthrig_driver::Result<Recording> {
    Recording::read(Box::new(bytes), "test.mkv")
}

/// All frames of a recording: kind, time and bytes.
fn all(recording: &mut Recording) -> Vec<(TrackKind, u64, Vec<u8>)> {
    let kinds: Vec<_> = recording.tracks().iter().map(|t| t.kind).collect();
    let mut out = Vec::new();
    while let Some(block) = recording.next_block().unwrap() {
        out.extend(block.frames().map(|f| (kinds[block.track], block.device_us, f.to_vec())));
    }
    out
}

/// Says where two readings differ, without their bytes.
fn same(got: &[(TrackKind, u64, Vec<u8>)], wanted: &[(TrackKind, u64, Vec<u8>)]) {
    let short = |frames: &[(TrackKind, u64, Vec<u8>)]| -> Vec<_> {
        frames.iter().map(|f| (f.0, f.1, f.2.len())).filter(|f| f.0 != TrackKind::Motion).collect()
    };
    assert_eq!(short(got), short(wanted));
    assert!(got == wanted, "bytes differ");
}

fn of(frames: &[(TrackKind, u64, Vec<u8>)], kind: TrackKind) -> Vec<(u64, &[u8])> {
    frames.iter().filter(|f| f.0 == kind).map(|f| (f.1, f.2.as_slice())).collect()
}

/// All of `fixture` is in `bytes`, at its times.
fn check(fixture: &Fixture, bytes: Vec<u8>) {
    let mut recording = open(bytes).unwrap();
    let frames = all(&mut recording);
    let mut pattern = Pattern::new(fixture);
    let there: Vec<u32> = (0..fixture.captures).filter(|n| !fixture.lost.contains(n)).collect();
    let color = of(&frames, TrackKind::Color);
    let depth = of(&frames, TrackKind::Depth);
    let infrared = of(&frames, TrackKind::Infrared);
    assert_eq!(color.len(), if fixture.color.is_some() { there.len() } else { 0 });
    for (n, (at, data)) in there.iter().zip(&color) {
        assert_eq!(*at, fixture.times_us(*n).0, "color {n}");
        assert!(*data == pattern.color(*n), "color {n}");
    }
    let words = |data: &[u8]| -> Vec<u16> {
        let pairs = data.as_chunks::<2>().0.iter();
        pairs.map(|b| if fixture.early { u16::from_le_bytes(*b) } else { u16::from_be_bytes(*b) }).collect()
    };
    let has_depth = fixture.depth.is_some_and(DepthMode::has_depth);
    assert_eq!(depth.len(), if has_depth { there.len() } else { 0 });
    assert_eq!(infrared.len(), if fixture.depth.is_some() { there.len() } else { 0 });
    for (n, (at, data)) in there.iter().zip(&depth) {
        assert_eq!(*at, fixture.times_us(*n).1, "depth {n}");
        assert!(words(data) == pattern.depth(*n), "depth {n}");
    }
    for (n, (_, data)) in there.iter().zip(&infrared) {
        assert!(words(data) == pattern.infrared(*n), "infrared {n}");
    }
    let samples: Vec<_> =
        frames.iter().filter(|f| f.0 == TrackKind::Motion).flat_map(|f| motion_samples(&f.2)).collect();
    if fixture.motion {
        let wanted = f64::from(fixture.captures) / f64::from(fixture.rate_hz) * 1600.0;
        assert!((samples.len() as f64 - wanted).abs() < 2.0, "{} samples", samples.len());
    }
    for (i, s) in (0..).zip(&samples) {
        let (at, acceleration, rotation) = motion(fixture, i);
        assert_eq!((s.accelerometer_ns, s.gyroscope_ns), (at + ACCEL_LATE_NS, at));
        assert_eq!((s.acceleration, s.rotation), (acceleration, rotation));
    }
    assert_eq!(recording.losses(), Losses::default());
    assert!(recording.next_block().unwrap().is_none(), "the end stays the end");
}

#[test]
fn what_the_sdk_writes_is_read() {
    let fixture = Fixture { captures: 40, lost: vec![7, 8], depth_delay_ns: 160_000, ..Fixture::small() };
    let bytes = fixture.bytes();
    let recording = open(bytes.clone()).unwrap();
    let facts = recording.facts();
    assert_eq!(facts.serial, "000123456789");
    assert_eq!((facts.color_firmware.as_str(), facts.depth_firmware.as_str()), ("1.6.110", "1.6.79"));
    assert_eq!((facts.color_mode, facts.depth_mode), (fixture.color, fixture.depth));
    assert_eq!((facts.start_offset_ns, facts.depth_delay_ns), (336_277_000, 160_000));
    assert_eq!((facts.wired_sync, facts.is_cut), (WiredSync::Standalone, false));
    assert_eq!(facts.calibration.as_deref(), Some(CALIBRATION.as_bytes()));
    assert_eq!(facts.date_utc_ns, Some(1_767_225_600_000_000_000), "2026-01-01");
    let duration = facts.duration_ns.unwrap() as f64 / 1e9;
    assert!((duration - 40.0 / 30.0).abs() < 0.05, "{duration}");
    assert!(recording.calibration().is_ok());
    let (i, color) = recording.track(TrackKind::Color).unwrap();
    assert_eq!((i, color.name.as_str(), color.width, color.height), (0, "COLOR", 1280, 720));
    assert_eq!((color.pixels, color.period_ns), (Some(Pixels::Nv12), Some(33_333_333)));
    check(&fixture, bytes);
}

#[test]
fn every_mode_and_every_form_is_read() {
    let small = Fixture::small;
    let color = |format, resolution| Some(ColorMode { format, resolution });
    let forms = [
        Fixture { color: color(ColorFormat::Mjpg, ColorResolution::P720), captures: 3, ..small() },
        Fixture {
            color: color(ColorFormat::Yuy2, ColorResolution::P720),
            depth_delay_ns: -500_000,
            ..small()
        },
        Fixture { color: color(ColorFormat::Bgra, ColorResolution::P720), captures: 2, ..small() },
        Fixture { color: None, depth: Some(DepthMode::NfovUnbinned), ..small() },
        Fixture { color: None, depth: Some(DepthMode::WfovUnbinned), rate_hz: 15, captures: 2, ..small() },
        Fixture { color: None, depth: Some(DepthMode::Wfov2x2Binned), motion: false, ..small() },
        Fixture { color: None, depth: Some(DepthMode::PassiveIr), captures: 2, ..small() },
        Fixture { depth: None, ..small() },
        Fixture { early: true, ..small() },
        Fixture { checksums: false, index: false, ..small() },
        Fixture { tags_behind: true, ..small() },
        Fixture { open_sizes: true, ..small() },
        Fixture { open_sizes: true, tags_behind: true, index: false, checksums: false, ..small() },
        Fixture { lacing: Lacing::None, ..small() },
        Fixture { lacing: Lacing::Xiph, ..small() },
        Fixture { lacing: Lacing::Ebml, ..small() },
        Fixture { start_offset_ns: 0, rate_hz: 5, ..small() },
    ];
    for fixture in forms {
        println!("{fixture:?}");
        check(&fixture, fixture.bytes());
    }
}

#[test]
fn early_recordings_name_infrared_and_the_mode_differently() {
    let recording = open(Fixture { early: true, ..Fixture::small() }.bytes()).unwrap();
    let (_, infrared) = recording.track(TrackKind::Infrared).unwrap();
    assert_eq!((infrared.name.as_str(), infrared.pixels), ("DEPTH_IR", Some(Pixels::Gray16Le)));
    assert_eq!(recording.facts().depth_mode, Some(DepthMode::Nfov2x2Binned));
}

#[test]
fn memory_is_that_of_a_cluster_whatever_the_length() {
    let memory = |captures| {
        let mut recording = open(Fixture { captures, ..Fixture::small() }.bytes()).unwrap();
        while recording.next_block().unwrap().is_some() {}
        recording.memory_bytes()
    };
    let few = memory(4);
    assert!(few < 2_500_000, "{few}");
    assert_eq!(memory(60), few);
}

#[test]
fn seeking_finds_the_first_block_at_or_after_a_time() {
    for fixture in [
        Fixture { captures: 90, motion: false, ..Fixture::small() },
        Fixture { captures: 90, motion: false, index: false, ..Fixture::small() },
        Fixture { captures: 45, motion: false, open_sizes: true, ..Fixture::small() },
    ] {
        let mut recording = open(fixture.bytes()).unwrap();
        let last = fixture.captures - 1;
        for n in [30, last, 0, 31, 17, 44] {
            let at = fixture.times_us(n).0;
            for (from, wanted) in [(at, n), (at - 1, n), (at - 20_000, n)] {
                recording.seek(from).unwrap();
                let block = recording.next_block().unwrap().unwrap();
                assert_eq!(block.device_us, fixture.times_us(wanted).0, "from {from}, of {fixture:?}");
            }
        }
        recording.seek(fixture.times_us(last).1 + 1).unwrap();
        assert!(recording.next_block().unwrap().is_none(), "behind the end");
        recording.seek(0).unwrap();
        let frames = all(&mut recording);
        assert_eq!(frames.len(), 3 * fixture.captures as usize, "from the start");
        assert_eq!(recording.losses(), Losses::default());
    }
}

#[test]
fn an_index_that_lies_is_not_believed() {
    let fixture = Fixture { captures: 90, motion: false, ..Fixture::small() };
    let (mut bytes, written) = fixture.bytes_and_places();
    // Every position of the index points into the middle of an image.
    let index = written.clusters_end as usize;
    let mark = [0xF1_u8];
    let mut at = index;
    while let Some(found) = bytes[at..].windows(1).position(|w| w == mark) {
        at += found + 2;
        bytes[at] ^= 0x15;
    }
    let mut recording = open(bytes).unwrap();
    recording.seek(fixture.times_us(60).0).unwrap();
    assert_eq!(recording.next_block().unwrap().unwrap().device_us, fixture.times_us(60).0);
}

#[test]
fn a_file_that_is_cut_is_read_up_to_its_last_complete_cluster() {
    let fixture = Fixture { captures: 8, motion: false, ..Fixture::small() };
    let (bytes, written) = fixture.bytes_and_places();
    let ends: Vec<u64> = written.clusters[1..].iter().copied().chain([written.clusters_end]).collect();
    let whole = all(&mut open(bytes.clone()).unwrap());
    let first = written.clusters[0];
    for cut in [
        first + 8,
        first + 700_000,
        ends[0] - 1,
        ends[0],
        ends[0] + 3,
        ends[3] + 5,
        ends[5] - 100,
        ends[7] + 2,
    ] {
        let mut recording = open(bytes[..cut as usize].to_vec()).unwrap();
        assert!(recording.facts().is_cut && recording.facts().duration_ns.is_none());
        let frames = all(&mut recording);
        let good = ends.iter().filter(|end| **end <= cut).count();
        let captures = frames.iter().filter(|f| f.0 == TrackKind::Color).count();
        assert_eq!(captures, good, "cut at {cut}: {ends:?}");
        same(&frames, &whole[..frames.len()]);
        let lost = cut - ends.get(good.wrapping_sub(1)).map_or(first, |end| *end);
        assert_eq!(
            recording.losses().bytes,
            if lost > 0 && good < ends.len() { lost } else { recording.losses().bytes }
        );
    }
}

#[test]
fn a_file_that_is_cut_before_its_first_image_says_so() {
    let (bytes, written) = Fixture::small().bytes_and_places();
    for cut in [0, 1, 30, 45, 60, 300, 1000, written.clusters[0] as usize - 100, written.clusters[0] as usize]
    {
        let e = open(bytes[..cut].to_vec()).unwrap_err();
        let text = e.to_string();
        assert_eq!(e.kind(), ErrorKind::BadInput, "{text}");
        assert!(
            text.starts_with("test.mkv: ")
                && (text.contains("cut off") || text.contains("not a Matroska file")),
            "{cut}: {text}"
        );
    }
}

#[test]
fn a_damaged_cluster_is_left_out_and_counted() {
    let fixture = Fixture { captures: 8, motion: false, ..Fixture::small() };
    let (bytes, written) = fixture.bytes_and_places();
    let size = |i: usize| written.clusters[i + 1] - written.clusters[i];
    let whole = all(&mut open(bytes.clone()).unwrap());
    let without = |n: u64| -> Vec<_> {
        // Capture n is cluster n: the period is longer than a cluster.
        let at = fixture.times_us(n as u32).0;
        let of_cluster = |t: u64| t >= at && t < at + 33_333;
        whole.iter().filter(|f| !of_cluster(f.1)).cloned().collect()
    };
    let damage = |at: u64, with: &[u8]| {
        let mut bytes = bytes.clone();
        bytes[at as usize..at as usize + with.len()].copy_from_slice(with);
        let mut recording = open(bytes).unwrap();
        (all(&mut recording), recording.losses())
    };
    let third = written.clusters[3];
    // A flipped bit in an image; a lying size of a block; the cluster's own size, too long and too short; its name.
    let pixel = third + 500_000;
    let (frames, losses) = damage(pixel, &[bytes[pixel as usize] ^ 4]);
    same(&frames, &without(3));
    assert_eq!(losses, Losses { places: 1, bytes: size(3) });
    for (at, with) in [(third + 4, &[0x18, 0, 0, 0][..]), (third + 4, &[0x20, 0x10, 0]), (third, &[0; 12])] {
        let (frames, losses) = damage(at, with);
        same(&frames, &without(3));
        assert_eq!(losses, Losses { places: 1, bytes: size(3) }, "{with:?} at {at}");
    }
    // Without checksums, damage inside an image is undetected, but damage to the structure is not.
    let plain = Fixture { checksums: false, ..fixture.clone() };
    let (mut bytes, written) = plain.bytes_and_places();
    let at = written.clusters[2] as usize;
    let block = bytes[at..].windows(1).position(|w| w == [0xA3]).unwrap() + at;
    bytes[block + 1] = 0x1F;
    let mut recording = open(bytes).unwrap();
    assert_eq!(all(&mut recording).iter().filter(|f| f.0 == TrackKind::Color).count(), 7);
    assert_eq!(recording.losses().places, 1);
}

#[test]
fn rubbish_between_clusters_is_passed_over() {
    let fixture = Fixture { captures: 4, open_sizes: true, ..Fixture::small() };
    let (bytes, written) = fixture.bytes_and_places();
    let whole = all(&mut open(bytes.clone()).unwrap());
    let at = written.clusters[2] as usize;
    // Bytes that begin like a cluster and are not one.
    let mut rubbish = vec![0x55; 3_000_000];
    for place in (0..3_000_000).step_by(9999) {
        rubbish[place..][..4].copy_from_slice(&[0x1F, 0x43, 0xB6, 0x75]);
    }
    let mixed = [&bytes[..at], &rubbish, &bytes[at..]].concat();
    let mut recording = open(mixed).unwrap();
    same(&all(&mut recording), &whole);
    assert_eq!(recording.losses(), Losses { places: 1, bytes: 3_000_000 });
}

/// The place of the first block of this kind in the cluster at `at`: of its track's number.
fn block_at(bytes: &[u8], at: u64, id: u8) -> usize {
    let mut i = at as usize + 4;
    i += bytes[i].leading_zeros() as usize + 1;
    loop {
        let len = bytes[i + 1].leading_zeros() as usize + 1;
        let first = u64::from(bytes[i + 1]) & (0xFF >> len);
        let size = bytes[i + 2..i + 1 + len].iter().fold(first, |n, b| n << 8 | u64::from(*b));
        match bytes[i] {
            of if of == id => return i + 1 + len,
            // A group: its block comes first.
            0xA0 if id == 0xA1 => i += 1 + len,
            _ => i += 1 + len + size as usize,
        }
    }
}

#[test]
fn a_block_may_be_earlier_than_its_cluster() {
    let fixture = Fixture { captures: 4, checksums: false, motion: false, ..Fixture::small() };
    let (mut bytes, written) = fixture.bytes_and_places();
    let block = block_at(&bytes, written.clusters[2], 0xA3);
    // Track, then two bytes of time with a sign; units are microseconds.
    let was = i16::from_be_bytes([bytes[block + 1], bytes[block + 2]]);
    bytes[block + 1..block + 3].copy_from_slice(&(-5_i16).to_be_bytes());
    let frames = all(&mut open(bytes).unwrap());
    let color = of(&frames, TrackKind::Color);
    let wanted = fixture.times_us(2).0.saturating_add_signed(-5 - i64::from(was));
    assert_eq!(color[2].0, wanted);
}

#[test]
fn laces_that_do_not_fit_show_without_a_checksum() {
    let fixture = Fixture { captures: 4, checksums: false, lacing: Lacing::Fixed, ..Fixture::small() };
    let (bytes, written) = fixture.bytes_and_places();
    for id in [0xA3, 0xA1] {
        let mut bytes = bytes.clone();
        // 256 frames of one size, which their bytes cannot be shared among.
        let block = block_at(&bytes, written.clusters[2], id);
        bytes[block + 3] = 0x04;
        bytes[block + 4] = 0xFF;
        let mut recording = open(bytes).unwrap();
        let frames = all(&mut recording);
        assert_eq!(of(&frames, TrackKind::Depth).len(), 3, "0x{id:X}");
        assert_eq!(recording.losses().places, 1, "0x{id:X}");
    }
}

#[test]
fn a_cluster_is_found_wherever_the_search_is_cut() {
    let fixture = Fixture { captures: 3, motion: false, ..Fixture::small() };
    let (mut bytes, written) = fixture.bytes_and_places();
    let whole = all(&mut open(bytes.clone()).unwrap());
    let at = written.clusters[1] as usize;
    // The segment gets longer, so that its size must be unknown.
    let segment = bytes.windows(4).position(|w| w == [0x18, 0x53, 0x80, 0x67]).unwrap() + 4;
    bytes[segment..segment + 8].copy_from_slice(&[0x01, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
    // The search takes pieces of a mebibyte, and begins one byte behind a false cluster.
    for before in 0..6 {
        let rubbish = vec![0x55; (1 << 20) + 1 - before];
        let mut recording = open([&bytes[..at], &rubbish, &bytes[at..]].concat()).unwrap();
        same(&all(&mut recording), &whole);
        assert_eq!(recording.losses().bytes, rubbish.len() as u64, "{before}");
    }
}

/// Bytes, then so many zeros, then bytes again; nothing of it is as large as it says.
struct Sparse(Vec<u8>, u64, Vec<u8>);

impl ReadAt for Sparse {
    fn size(&self) -> u64 {
        self.0.len() as u64 + self.1 + self.2.len() as u64
    }

    fn read_at(&self, at: u64, to: &mut [u8]) -> std::io::Result<()> {
        assert!(to.len() < 32 << 20, "{} bytes are taken at once", to.len());
        let behind = self.0.len() as u64 + self.1;
        for (i, byte) in (at..).zip(to) {
            *byte = if i >= behind {
                *self.2.get((i - behind) as usize).ok_or(std::io::ErrorKind::UnexpectedEof)?
            } else {
                self.0.get(i as usize).copied().unwrap_or(0)
            };
        }
        Ok(())
    }
}

#[test]
fn what_no_kinect_could_have_written_is_not_taken_into_memory() {
    let fixture =
        Fixture { captures: 3, checksums: false, motion: false, open_sizes: true, ..Fixture::small() };
    let (bytes, written) = fixture.bytes_and_places();
    let [first, second] = [written.clusters[1] as usize, written.clusters[2] as usize];
    // The second cluster says that it has 200 MiB, and the file is as long.
    let more = 200 << 20;
    let size = (second - first) as u64 - 12 + more;
    let mut head = bytes[..second].to_vec();
    head[first + 4..first + 12].copy_from_slice(&(1_u64 << 56 | size).to_be_bytes());
    let source = Sparse(head, more, bytes[second..].to_vec());
    let mut recording = Recording::read(Box::new(source), "test.mkv").unwrap();
    let frames = all(&mut recording);
    assert_eq!(of(&frames, TrackKind::Color).len(), 2, "the first and the third");
    assert_eq!(recording.losses(), Losses { places: 1, bytes: size + 12 });
    assert!(recording.memory_bytes() < 3_000_000);
    // So do the attachments.
    let (bytes, _) = fixture.bytes_and_places();
    let at = (0..5000).filter(|i| bytes[*i..*i + 4] == [0x19, 0x41, 0xA4, 0x69]).nth(1).unwrap();
    let len = bytes[at + 4].leading_zeros() as usize + 1;
    let mut head = bytes[..at + 4].to_vec();
    head.extend((1_u64 << 56 | more).to_be_bytes());
    let source = Sparse(head, more, bytes[at + 4 + len..].to_vec());
    let e = Recording::read(Box::new(source), "test.mkv").unwrap_err().to_string();
    assert!(e.contains("Attachments at byte") && e.contains("the file is damaged"), "{e}");
}

#[test]
fn of_two_tracks_of_a_kind_the_first_is_the_cameras() {
    // An early file, whose tracks are identified by their names.
    let mut bytes = Fixture { early: true, ..Fixture::small() }.bytes();
    let name = element::text(0x536E, "DEPTH");
    let at = bytes.windows(name.len()).position(|w| w == name).unwrap();
    bytes[at + 3..at + 8].copy_from_slice(b"COLOR");
    let recording = open(bytes).unwrap();
    let kinds: Vec<_> = recording.tracks().iter().map(|t| t.kind).collect();
    assert_eq!(kinds, [TrackKind::Color, TrackKind::Other, TrackKind::Infrared, TrackKind::Motion]);
    assert_eq!(recording.track(TrackKind::Color).map(|(i, _)| i), Some(0));
}

#[test]
fn sizes_that_lie_take_no_memory() {
    let fixture = Fixture { captures: 3, motion: false, open_sizes: true, ..Fixture::small() };
    let (mut bytes, written) = fixture.bytes_and_places();
    let at = written.clusters[1] as usize + 4;
    bytes[at..at + 8].copy_from_slice(&[0x01, 0x7F, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFE]);
    let mut recording = open(bytes).unwrap();
    let frames = all(&mut recording);
    assert_eq!(frames.iter().filter(|f| f.0 == TrackKind::Color).count(), 2, "the first and the third");
    assert!(recording.memory_bytes() < 3_000_000);
    // A header that claims more than the file has.
    let (mut bytes, _) = Fixture::small().bytes_and_places();
    // The first place is in the table of contents.
    let tracks = (0..5000).filter(|i| bytes[*i..*i + 4] == [0x16, 0x54, 0xAE, 0x6B]).nth(1).unwrap();
    bytes[tracks + 4] = 0x01;
    let e = open(bytes).unwrap_err().to_string();
    assert!(e.contains("Tracks at byte") && e.contains("claims"), "{e}");
}

#[test]
fn a_file_of_somebody_else_is_refused_by_name() {
    let error = |bytes: Vec<u8>| open(bytes).unwrap_err().to_string();
    assert!(error(b"RIFF....AVI LIST".to_vec()).contains("not a Matroska file"));
    assert!(error(Vec::new()).contains("the file is empty"));
    let replaced = |from: &str, to: &str| {
        let mut bytes = Fixture::small().bytes();
        let n = from.len();
        assert_eq!(n, to.len());
        for i in 0..20_000 {
            if &bytes[i..i + n] == from.as_bytes() {
                bytes[i..i + n].copy_from_slice(to.as_bytes());
            }
        }
        bytes
    };
    let e = error(replaced("K4A_", "XYZ_"));
    assert!(
        e.contains("no recording of an Azure Kinect: it has no tags K4A_")
            && e.contains("\"COLOR\", \"DEPTH\""),
        "{e}"
    );
    let e = error(replaced("V_MS/VFW/FOURCC", "V_MPEG4/ISO/AVC"));
    assert!(e.contains("COLOR is stored as \"V_MPEG4/ISO/AVC\""), "{e}");
    let e = error(replaced("b16g", "H264"));
    assert!(e.contains("DEPTH are stored as \"H264\""), "{e}");
    let e = error(replaced("NFOV_2X2BINNED", "WFOV_2X2BINNED"));
    assert!(e.contains("K4A_DEPTH_MODE is \"WFOV_2X2BINNED\", which does not fit images of 320x288"), "{e}");
    let e = error(replaced("STANDALONE", "OUTOFORDER"));
    assert!(e.contains("K4A_WIRED_SYNC_MODE = \"OUTOFORDER\" is unknown"), "{e}");
    let e = error(replaced("336277000", "336277x00"));
    assert!(e.contains("K4A_START_OFFSET_NS = \"336277x00\" is not a number of nanoseconds"), "{e}");
}

#[test]
fn a_calibration_that_is_missing_or_wrong_is_an_error_of_its_own() {
    let recording = open(Fixture { calibration: None, ..Fixture::small() }.bytes()).unwrap();
    let e = recording.calibration().unwrap_err();
    assert!(e.to_string().contains("test.mkv: the recording has no calibration.json"), "{e}");
    let recording = open(Fixture { calibration: Some("{}".into()), ..Fixture::small() }.bytes()).unwrap();
    let e = recording.calibration().unwrap_err();
    assert!(
        e.to_string().contains("test.mkv: the Kinect's calibration: no object CalibrationInformation"),
        "{e}"
    );
    // Its tracks are read all the same.
    assert_eq!(recording.tracks().len(), 4);
}

#[test]
fn tracks_are_identified_by_their_tags_not_by_their_order_or_name() {
    let mut bytes = Fixture { motion: false, ..Fixture::small() }.bytes();
    // A user's own track that is called COLOR, in the place of the real one.
    let name = element::text(0x536E, "COLOR");
    let at = bytes.windows(name.len()).position(|w| w == name).unwrap();
    bytes[at + 3..at + 8].copy_from_slice(b"RGBRG");
    let recording = open(bytes).unwrap();
    assert_eq!(recording.track(TrackKind::Color).map(|(_, t)| t.name.as_str()), Some("RGBRG"));
}

/// A public recording of an Azure Kinect, if `DEPTHRIG_KINECT_SAMPLE` names it: `tests/assets/recording.mkv` of pyk4a.
/// It shows a private room, so it is not kept here.
#[test]
fn a_recording_of_a_real_device() {
    let Some(path) = std::env::var_os("DEPTHRIG_KINECT_SAMPLE").map(PathBuf::from) else {
        println!("skipped: DEPTHRIG_KINECT_SAMPLE names no recording");
        return;
    };
    let mut recording = Recording::open(&path).unwrap();
    let facts = recording.facts().clone();
    assert_eq!((facts.serial.as_str(), facts.start_offset_ns), ("001514394512", 336_277_000));
    assert_eq!(facts.depth_mode, Some(DepthMode::NfovUnbinned));
    let k = recording.calibration().unwrap().depth_intrinsics(DepthMode::NfovUnbinned);
    for (got, wanted) in [(k.cx, 332.78), (k.cy, 348.83), (k.fx, 504.61), (k.fy, 504.73)] {
        assert!((got - wanted).abs() < 0.01, "{got} {wanted}");
    }
    let frames = all(&mut recording);
    assert_eq!(recording.losses(), Losses::default(), "the checksums of its clusters are right");
    let depth = of(&frames, TrackKind::Depth);
    let mut mm: Vec<u16> =
        depth[0].1.as_chunks::<2>().0.iter().map(|b| u16::from_be_bytes(*b)).filter(|d| *d > 0).collect();
    mm.sort_unstable();
    assert_eq!((mm.len(), mm[0], mm[mm.len() / 2], mm[mm.len() - 1]), (281_945, 165, 1491, 3690));
    assert_eq!(depth[0].0, 463_945 + 336_277);
    let motion = of(&frames, TrackKind::Motion);
    let sample = motion_samples(motion[0].1).next().unwrap();
    assert_eq!(sample.accelerometer_ns, 336_277_000);
    let length = sample.acceleration.iter().map(|a| a * a).sum::<f32>().sqrt();
    assert!((length - 9.87).abs() < 0.01, "{length}");
}
