//! Other readers of Matroska agree with the writer of recordings: the crate `matroska-demuxer`, and
//! FFmpeg and MKVToolNix where they are installed (`tools/setup.sh test`).
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_kinect::recording::TrackKind;
use depthrig_kinect::{DepthMode, Recording};
use depthrig_kinect_fixture::{CALIBRATION, Fixture, Images, Lacing, Pattern};
use matroska_demuxer::{Frame, MatroskaFile};
use std::io::Cursor;
use std::path::Path;
use std::process::{Command, Output};

#[test]
fn another_reader_finds_the_same_frames() {
    for lacing in [Lacing::None, Lacing::Fixed, Lacing::Xiph, Lacing::Ebml] {
        let fixture = Fixture { captures: 9, depth_delay_ns: 160_000, lacing, ..Fixture::small() };
        let bytes = fixture.bytes();
        let mut theirs = MatroskaFile::open(Cursor::new(bytes.clone())).unwrap();
        let mut ours = Recording::read(Box::new(bytes), "test.mkv").unwrap();
        let offset_us = fixture.start_offset_ns / 1000;
        let mut frame = Frame::default();
        let mut frames = 0;
        while let Some(block) = ours.next_block().unwrap() {
            for data in block.frames() {
                assert!(theirs.next_frame(&mut frame).unwrap(), "they have fewer than {frames}");
                assert_eq!(
                    (frame.track, frame.timestamp),
                    (block.track as u64 + 1, block.device_us - offset_us)
                );
                assert!(frame.data == data, "frame {frames} differs, {lacing:?}");
                frames += 1;
            }
        }
        assert!(!theirs.next_frame(&mut frame).unwrap(), "they have more than {frames}");
        assert!(frames > 9 * 3 + 400, "{frames}");
        let tags: usize = theirs.tags().unwrap().iter().map(|t| t.simple_tags().len()).sum();
        assert!(tags > 10, "{tags}");
        let names: Vec<_> = theirs.tracks().iter().map(|t| t.name().unwrap().to_owned()).collect();
        let known: Vec<_> = ours.tracks().iter().map(|t| t.name.clone()).collect();
        assert_eq!((names, known.len()), (known, 4));
    }
}

/// Runs a program; `None` when it is not installed.
fn run(program: &str, args: &[&str], file: &Path) -> Option<Output> {
    match Command::new(program).args(args).arg(file).output() {
        Ok(output) => Some(output),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            println!("skipped: {program} is not installed; tools/setup.sh test");
            None
        }
        Err(e) => panic!("{program}: {e}"),
    }
}

fn written(dir: &Path, name: &str, fixture: &Fixture) -> std::path::PathBuf {
    let path = dir.join(name);
    fixture.write(&path, &mut Pattern::new(fixture)).unwrap();
    path
}

#[test]
fn ffmpeg_reads_it_without_a_complaint() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 6, ..Fixture::default() };
    let path = written(dir.path(), "kinect.mkv", &fixture);
    let args = ["-v", "warning", "-count_packets", "-show_entries"];
    let streams = "stream=codec_name,codec_tag_string,width,height,nb_read_packets,pix_fmt:stream_tags=title";
    let Some(out) = run("ffprobe", &[&args[..], &[streams, "-of", "csv=p=0:nk=0"]].concat(), &path) else {
        return;
    };
    let text = String::from_utf8_lossy(&out.stdout);
    let complaints = String::from_utf8_lossy(&out.stderr);
    println!("{text}{complaints}");
    assert!(out.status.success());
    // It has no decoder for motion nor for the attachment, and says so of any recording of a Kinect.
    let others: Vec<_> = complaints
        .lines()
        .filter(|l| {
            !l.contains("stream 3")
                && !l.contains("Stream #0:3")
                && !l.contains("probesize")
                && !l.contains("stream 4")
        })
        .collect();
    assert!(others.is_empty(), "{others:?}");
    let line = |title: &str| {
        text.lines()
            .find(|l| l.contains(&format!("title={title}")))
            .unwrap_or_else(|| panic!("{title}: {text}"))
    };
    for (title, wanted) in [
        ("COLOR", ["codec_name=mjpeg", "width=1280", "height=720", "nb_read_packets=6"]),
        ("DEPTH", ["codec_tag_string=b16g", "width=640", "height=576", "nb_read_packets=6"]),
        ("IR", ["codec_tag_string=b16g", "width=640", "height=576", "nb_read_packets=6"]),
    ] {
        for part in wanted {
            assert!(line(title).contains(part), "{part}: {}", line(title));
        }
    }
    // Depth, decoded by them, is what was written.
    let args = ["-v", "error", "-i"];
    let raw = dir.path().join("depth.raw");
    let out = Command::new("ffmpeg")
        .args(args)
        .arg(&path)
        .args(["-map", "0:1", "-f", "rawvideo", "-pix_fmt", "gray16le", "-y"])
        .arg(&raw)
        .output()
        .unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let mut pattern = Pattern::new(&fixture);
    let wanted: Vec<u8> = (0..6).flat_map(|n| pattern.depth(n)).flat_map(u16::to_le_bytes).collect();
    assert!(std::fs::read(&raw).unwrap() == wanted, "depth as FFmpeg decodes it");
}

#[test]
fn mkvtoolnix_lists_all_of_it() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Fixture { captures: 6, depth: Some(DepthMode::Wfov2x2Binned), ..Fixture::small() };
    let path = written(dir.path(), "kinect.mkv", &fixture);
    // The checksums of clusters are proven with -v -v.
    let Some(out) = run("mkvinfo", &["--all"], &path) else { return };
    let text = String::from_utf8_lossy(&out.stdout);
    assert!(out.status.success() && out.stderr.is_empty(), "{}", String::from_utf8_lossy(&out.stderr));
    for wanted in [
        "calibration.json",
        "K4A_START_OFFSET_NS",
        "V_MS/VFW/FOURCC",
        "S_K4A/IMU",
        "Name: DEPTH",
        "Cluster",
        "Cue",
    ] {
        assert!(text.contains(wanted), "{wanted}: {text}");
    }
    assert!(!text.to_lowercase().contains("error") && !text.to_lowercase().contains("invalid"), "{text}");
    let simple = text.matches("SimpleBlock").count() + text.matches("Simple block").count();
    assert!(simple >= 18, "{simple} of 18 images: {text}");
    // Their output is what was put in.
    let out = dir.path().join("calibration.json");
    let target = format!("1:{}", out.display());
    let extracted = Command::new("mkvextract").arg(&path).args(["attachments", &target]).output().unwrap();
    assert!(extracted.status.success(), "{}", String::from_utf8_lossy(&extracted.stdout));
    assert_eq!(std::fs::read_to_string(&out).unwrap(), CALIBRATION);
    assert!(Recording::open(&path).unwrap().track(TrackKind::Motion).is_some());
}
