//! Bags of librealsense: a real one, the same one damaged everywhere, and small synthetic ones.

mod synthetic;

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_bus::{ClockDomain, Distortion, FrameFlags};
use depthrig_convert::{ImportReport, RosbagImport, import};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{ColorCodec, Dataset, ErrorKind, RecorderOptions, Result, SetRange};
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn real_bag() -> Vec<u8> {
    let data = std::env::var_os("DEPTHRIG_TEST_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let path = data.join("librealsense_bag/single_depth_color_640x480.bag");
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}; set DEPTHRIG_TEST_DATA", path.display()))
}

fn imported(bytes: Vec<u8>) -> (MemFs, Result<ImportReport>) {
    let fs = MemFs::new();
    fs.put(Path::new("/in.bag"), bytes);
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let report = RosbagImport::open(&fs, Path::new("/in.bag"), "bag".into()).and_then(|mut importer| {
        let color = ColorCodec::Raw;
        let options = RecorderOptions { color, min_free_bytes: 0, reserve_bytes: 0, ..Default::default() };
        import(&mut importer, shared, &dir(), options, &mut |_| ControlFlow::Continue(()))
    });
    (fs, report)
}

/// The expected values are those of `rosbag info`, `rosbag echo` and Python's `rosbags`.
#[test]
fn the_real_bag_is_imported_completely() {
    let (fs, report) = imported(real_bag());
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames), (0, 3), "{:?}", report.facts);
    assert!(
        report.verified.worst() < Some(depthrig_recorder::Severity::Lost),
        "{:?}",
        report.verified.findings
    );
    let dataset = Dataset::open_with(Arc::new(fs), &dir()).unwrap();
    let session = dataset.session();
    let [color, depth] = ["d435/color", "d435/depth"].map(|id| {
        session.streams.iter().find(|s| s.id.to_string() == id).unwrap_or_else(|| panic!("no {id}"))
    });
    assert_eq!(
        (depth.model.as_str(), depth.rate_hz, depth.depth_unit_m),
        ("Intel RealSense D435", 6.0, 0.001)
    );
    assert_eq!((depth.width, depth.height, color.width, color.height), (640, 480, 640, 480));
    assert_eq!(depth.intrinsics.distortion(), Distortion::BrownConrady);
    assert!((depth.intrinsics.fx - 390.431_457_519_531_25).abs() < 1e-12, "{:?}", depth.intrinsics);
    assert!(depth.calibration.starts_with("factory"));
    assert_eq!(depth.pose, depthrig_bus::Pose::IDENTITY);
    // The colour camera of a D435 is 15 mm to the left of the left infrared one.
    let t = color.pose.translation_m;
    assert!((t[0] + 0.0143).abs() < 2e-4 && t[1].abs() < 1e-3 && t[2].abs() < 1e-3, "{t:?}");
    let options = &session.extra["import"]["options"]["device_0/sensor_0"];
    assert_eq!(options["Laser Power"].as_float(), Some(150.0));

    let sets: Vec<_> = dataset.sets(SetRange::ALL).map(std::result::Result::unwrap).collect();
    assert_eq!(sets.iter().map(|s| s.frames.len()).sum::<usize>(), 3);
    let depths: Vec<_> = sets
        .iter()
        .flat_map(|s| &s.frames)
        .filter(|f| session.streams[f.stream].id == depth.id)
        .map(|f| f.header)
        .collect();
    let h = depths[0];
    assert_eq!(depths.iter().map(|h| h.device_sequence).collect::<Vec<_>>(), [169, 170]);
    assert_eq!(depths.iter().map(|h| h.device_time).collect::<Vec<_>>(), [360_811_863, 360_978_539]);
    assert_eq!(depths[1].capture_time_ns - h.capture_time_ns, 166_676_000);
    assert_eq!(h.arrival_time_ns, 1_534_232_519_732_935_547);
    assert_eq!((h.exposure_ns, h.gain, h.device_tick_ns), (6_452_000, 16.0, 1000.0));
    assert_eq!(h.clock_domain, ClockDomain::Device as u32);
    assert!(h.has(FrameFlags::CLOCK_WARMUP), "two frames are not a long history");
    for h in &depths {
        assert!(h.capture_time_ns <= h.arrival_time_ns);
    }
}

/// A record of a bag: fields with their names, and data.
fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let field = |(name, value): &(&str, &[u8])| {
        let text = [name.as_bytes(), b"=", value].concat();
        [&(text.len() as u32).to_le_bytes(), &text[..]].concat()
    };
    let head: Vec<u8> = fields.iter().flat_map(field).collect();
    [&(head.len() as u32).to_le_bytes(), &head[..], &(data.len() as u32).to_le_bytes(), data].concat()
}

/// A D435i records its IMU too: three messages, put in before the images.
#[test]
fn motion_of_a_bag_is_reported_and_left_out() {
    let topic = "/device_0/sensor_2/Gyro_0/imu/data";
    let conn = 9999_u32.to_le_bytes();
    let mut inner = record(&[("op", &[7]), ("conn", &conn), ("topic", topic.as_bytes())], b"");
    for _ in 0..3 {
        inner.extend(record(&[("op", &[2]), ("conn", &conn), ("time", &[0; 8])], b"a sensor_msgs/Imu"));
    }
    let size = (inner.len() as u32).to_le_bytes();
    let chunk = record(&[("op", &[5]), ("compression", b"none"), ("size", &size)], &inner);
    let mut bytes = real_bag();
    bytes.splice(13..13, chunk);
    let (fs, report) = imported(bytes);
    let report = report.unwrap();
    assert_eq!((report.facts.lost, report.summary.frames), (0, 3), "{:?}", report.facts);
    let statement = format!("{topic}: 3 messages are left out: motion and poses of a bag are not imported");
    let dataset = Dataset::open_with(Arc::new(fs), &dir()).unwrap();
    let stated = dataset.session().extra["import"]["stated"].as_array().unwrap();
    assert!(stated.iter().any(|s| s.as_str() == Some(&statement)), "{stated:?}");
}

/// Cut anywhere: an error that says so, or what is before it with the loss counted; never a panic, never silence.
#[test]
fn a_bag_that_was_cut_is_reported() {
    let whole = real_bag();
    let mut with_frames = 0;
    for i in 0..60 {
        let at = whole.len() * i / 60 + i % 7;
        let (_, report) = imported(whole[..at].to_vec());
        match report {
            Ok(r) => {
                with_frames += 1;
                // The index at the end is not needed; a cut exactly between records cannot be seen.
                assert!(r.facts.lost > 0 || r.summary.frames == 3, "cut at {at}");
            }
            Err(e) => assert_eq!(e.kind(), ErrorKind::BadRecording, "cut at {at}: {e}"),
        }
    }
    assert!(with_frames > 5, "{with_frames}");
}

#[test]
fn other_files_are_refused_with_advice() {
    for (bytes, word) in [
        (&b"#ROSBAG V1.2\n"[..], "rosbag fix"),
        (b"SQLite format 3\0", "ROS 2"),
        (b"\x89MCAP0\r\n", "ROS 2"),
        (b"", "is not a rosbag"),
        (b"#ROSBAG V2.0\n", "holds no images"),
    ] {
        let e = imported(bytes.to_vec()).1.unwrap_err();
        assert!(e.kind() == ErrorKind::BadRecording && e.to_string().contains(word), "{e}");
    }
    // Every chunk says it is packed with something else.
    let mut bz2 = real_bag();
    let at = |bytes: &[u8]| bytes.windows(15).position(|w| w == b"compression=lz4");
    while let Some(i) = at(&bz2) {
        bz2[i + 12..i + 15].copy_from_slice(b"bz2");
    }
    let e = imported(bz2).1.unwrap_err();
    assert!(e.kind() == ErrorKind::BadRecording && e.to_string().contains("rosbag decompress"), "{e}");
}

/// A chunk that unpacks to more or less than its header says is damaged, whatever is in it.
#[test]
fn a_chunk_of_another_size_is_reported() {
    let whole = real_bag();
    let at = whole.windows(5).rposition(|w| w == b"size=").unwrap() + 5;
    let size = u32::from_le_bytes(whole[at..at + 4].try_into().unwrap());
    for (wrong, word) in [
        (size - 1, format!("its header says {}", size - 1)),
        (size + 1, format!("its header says {}", size + 1)),
        (u32::MAX, "is the most".to_owned()),
    ] {
        let mut bytes = whole.clone();
        bytes[at..at + 4].copy_from_slice(&wrong.to_le_bytes());
        let (_, report) = imported(bytes);
        let report = report.unwrap();
        assert_eq!(report.facts.lost, 1, "{:?}", report.facts.problems);
        assert!(report.facts.problems[0].contains(&word), "{:?}", report.facts.problems);
    }
}

/// A byte changed at many places: no panic, no endless loop, and no frame that is not what the file says.
#[test]
fn a_bag_that_is_damaged_is_no_surprise() {
    let whole = real_bag();
    let mut x = 0x2545_f491_4f6c_dd1d_u64;
    for _ in 0..60 {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        let mut bytes = whole.clone();
        let at = (x % bytes.len() as u64) as usize;
        bytes[at] ^= 1 << (x >> 60 & 7);
        depthrig_convert::fuzzing::rosbag(&bytes);
        // Headers of records are where the damage is interesting.
        let heads: Vec<usize> =
            whole.windows(3).enumerate().filter(|(_, w)| *w == b"op=").map(|(i, _)| i).collect();
        let mut bytes = whole.clone();
        let at = heads[(x >> 20) as usize % heads.len()].saturating_sub((x >> 50) as usize % 40);
        bytes[at] = (x >> 8) as u8;
        depthrig_convert::fuzzing::rosbag(&bytes);
    }
}
