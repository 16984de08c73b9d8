//! ByteCameraDepth folders: exported, imported, compared; and the folders of others with all their faults.

use super::{contents, files, open};
use crate::support::*;
use core::ops::ControlFlow;
use depthrig_bus::PixelFormat;
use depthrig_convert::{
    ByteCameraExport, ByteCameraImport, ByteCameraOptions, CameraNames, ExportOptions, ExportReport,
    ImportReport, export, import,
};
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    ColorCodec, CompareOptions, Dataset, ErrorKind, Recorder, RecorderOptions, Result, Session, SetRange,
    compare,
};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Every kind of stream, two cameras of one model, and two infrared images of one camera.
fn everything() -> Session {
    let mut s = session();
    // The layout has no place for them, which is said: `an_export_says_that_it_leaves_out_what_is_no_image`.
    s.motion.clear();
    s.signals.clear();
    s.name = "20260314_1512_kitchen".into();
    s.streams = vec![
        stream("front/color", PixelFormat::Rgb8, 32, 24),
        stream("front/depth", PixelFormat::Z16, 32, 24),
        stream("front/ir_left", PixelFormat::Mono8, 20, 10),
        stream("front/ir_right", PixelFormat::Mono8, 20, 10),
        stream("back/depth", PixelFormat::Z16, 32, 24),
        stream("back/color", PixelFormat::Bgr8, 32, 24),
        stream("stereo/depth", PixelFormat::DepthF32, 16, 12),
        stream("stereo/color", PixelFormat::Yuyv, 16, 12),
        stream("stereo/confidence", PixelFormat::Confidence8, 16, 12),
        stream("stereo/disparity", PixelFormat::DisparityF32, 16, 12),
        stream("tof/ir", PixelFormat::Mono16, 16, 12),
    ];
    for s in &mut s.streams {
        s.model = match s.id.camera.as_str() {
            "stereo" => "ZED 2i (neural)".into(),
            "tof" => "Azure Kinect".into(),
            _ => "Intel RealSense D455".into(),
        };
        if s.format == PixelFormat::DepthF32 {
            s.depth_unit_m = 1.0;
        }
        s.intrinsics.coeffs = [0.1, -0.2, 1.0 / 3.0, 0.0, 1e-17, 0.0, 0.0, 0.0];
    }
    s
}

/// Records sets of `session`; of set 2 the stream 1 is missing, and of set 3 all but the first.
fn recorded(session: &Session, sets: u64, color: ColorCodec) -> MemFs {
    let fs = MemFs::new();
    let options = RecorderOptions { color, segment_max_ns: 3 * PERIOD, ..options() };
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options).unwrap();
    for n in 0..sets {
        let streams: Vec<usize> = match n {
            2 => (0..session.streams.len()).filter(|i| *i != 1).collect(),
            3 => vec![0],
            _ => (0..session.streams.len()).collect(),
        };
        r.push(set_of(session, n, &streams)).unwrap();
        settle(&r);
    }
    assert!(r.finish().unwrap().complete);
    fs
}

fn exported(fs: &MemFs, names: CameraNames, unit: Option<f64>) -> Result<ExportReport> {
    let mut exporter = ByteCameraExport::new(names, unit)?;
    let on = &mut |_| ControlFlow::Continue(());
    export(fs, &mut exporter, vec![open(fs)], Path::new("/export"), ExportOptions::default(), on)
}

fn session_dir() -> PathBuf {
    PathBuf::from("/export/20260314_1512")
}

fn back() -> PathBuf {
    PathBuf::from("/back")
}

fn imported(fs: &MemFs, from: &Path, options: ByteCameraOptions) -> Result<ImportReport> {
    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    let options = ByteCameraOptions { name: "back".into(), ..options };
    let mut importer = ByteCameraImport::open(Arc::clone(&shared), from, options)?;
    let color = ColorCodec::Raw;
    let options = RecorderOptions { color, min_free_bytes: 0, reserve_bytes: 0, ..Default::default() };
    import(&mut importer, shared, &back(), options, &mut |_| ControlFlow::Continue(()))
}

fn reopened(fs: &MemFs) -> Dataset {
    Dataset::open_with(Arc::new(fs.clone()), &back()).unwrap()
}

#[test]
fn an_export_imported_is_the_dataset_again() {
    for color in [ColorCodec::Raw, ColorCodec::Jpeg] {
        let session = everything();
        let fs = recorded(&session, 7, color);
        let report = exported(&fs, CameraNames::Short, None).unwrap();
        assert_eq!((report.sets, report.lost), (7, 0), "{report:?}");
        assert_eq!(report.frames, 11 * 7 - 1 - 10);
        let names: Vec<_> = files(&fs).into_keys().collect();
        for wanted in [
            "camera_d455/color_0.png",
            "camera_d455/depth_0.png",
            "camera_d455/ir_0.png",
            "camera_d455/ir_right_0.png",
            "camera_d455_2/depth_6.png",
            "camera_d455_2/color_6.png",
            "camera_zed2i/raw_depth_4.npy",
            "camera_zed2i/color_4.npy",
            "camera_zed2i/confidence_4.png",
            "camera_zed2i/disparity_4.npy",
            "camera_kinect/ir_1.png",
            "frames.csv",
            "calibration.json",
        ] {
            let path = session_dir().join(wanted).display().to_string();
            assert!(names.contains(&path), "{wanted} is not in {names:?}");
        }
        assert!(!names.iter().any(|n| n.ends_with("camera_d455/depth_2.png")), "set 2 has no depth of front");

        let made = imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
        assert_eq!((made.facts.lost, made.summary.sets.recorded), (0, 7), "{:?}", made.facts);
        assert!(made.verified.is_whole(), "{:?}", made.verified.findings);
        let strict = CompareOptions { strict: true, ..CompareOptions::default() };
        let same = compare(&open(&fs), &reopened(&fs), &strict).unwrap();
        assert!(same.equal, "{:#?}", same.differences);
        let extra = reopened(&fs).session().extra["import"].clone();
        assert_eq!(extra["format"].as_str(), Some("bytecameradepth"));
    }
}

#[test]
fn long_names_are_spelled_and_read() {
    let fs = recorded(&everything(), 1, ColorCodec::Raw);
    exported(&fs, CameraNames::Long, None).unwrap();
    for without in ["frames.csv", "calibration.json"] {
        fs.remove_file(&session_dir().join(without)).unwrap();
    }
    imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
    let cameras: Vec<_> = reopened(&fs).session().streams.iter().map(|s| s.id.to_string()).collect();
    assert!(cameras.contains(&"d455/depth".to_owned()) && cameras.contains(&"d455_2/color".to_owned()));
    assert!(cameras.contains(&"zed2i/raw_depth".to_owned()), "{cameras:?}");
}

#[test]
fn rescaled_depth_says_its_unit_and_its_loss() {
    let session = everything();
    let fs = recorded(&session, 2, ColorCodec::Raw);
    let report = exported(&fs, CameraNames::Short, Some(0.001)).unwrap();
    assert_eq!(report.lost, 0);
    assert!(report.counters["pixels of depth that were rounded"] > 100, "{:?}", report.counters);
    assert!(report.losses.iter().any(|l| l.contains("from units of 0.0001 m to 0.001 m")));
    let calibration = contents(&fs, &session_dir().join("calibration.json"));
    let json: serde_json::Value = serde_json::from_slice(&calibration).unwrap();
    assert_eq!(json["streams"][1]["depth_unit_m"], 0.001);
    assert_eq!(json["streams"][1]["recorded_depth_unit_m"], 0.0001);
    imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
    let before = open(&fs);
    let after = reopened(&fs);
    let all = |d: &Dataset| d.sets(SetRange::ALL).map(Result::unwrap).collect::<Vec<_>>();
    for (a, b) in all(&before).iter().zip(all(&after)) {
        assert_eq!(b.frames[1].header.depth_unit_m, 0.001);
        for (a, b) in a.frames[1].pixels.chunks(2).zip(b.frames[1].pixels.chunks(2)) {
            let [a, b] = [a, b].map(|v| u16::from_le_bytes([v[0], v[1]]));
            assert!((f64::from(a) * 0.1 - f64::from(b)).abs() <= 0.5 + 1e-9, "{a} became {b}");
        }
    }
    // A finer unit has no room for far pixels: they become 0, are counted and reported.
    let fs = recorded(&session, 1, ColorCodec::Raw);
    let report = exported(&fs, CameraNames::Short, Some(0.000_001)).unwrap();
    assert_eq!(report.lost, 2);
    assert!(report.problems[0].contains("beyond 65535 units"), "{:?}", report.problems);
}

/// Folders as the recorder of the published dataset writes them.
fn foreign(fs: &MemFs, folder: &str, prefix: &str, numbers: &[u32], format: PixelFormat, name: &str) {
    use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
    let dir = Path::new("/in").join(name).join(folder);
    fs.create_dir_all(&dir).unwrap();
    for n in numbers {
        let pixels = pixels(format, 16, 12, u64::from(*n));
        let mut file = Vec::new();
        let color = match format {
            PixelFormat::Z16 => ExtendedColorType::L16,
            PixelFormat::Rgb8 => ExtendedColorType::Rgb8,
            _ => ExtendedColorType::L8,
        };
        PngEncoder::new(&mut file).write_image(&pixels, 16, 12, color).unwrap();
        fs.put(&dir.join(format!("{prefix}_{n}.png")), file);
    }
}

#[test]
fn folders_of_others_come_in_with_everything_stated() {
    let fs = MemFs::new();
    let name = "20250314_1512";
    for (folder, n) in
        [("camera_realsense_405", vec![0, 1, 2, 4]), ("camera_zed2i_quality", vec![0, 1, 2, 3, 4])]
    {
        foreign(&fs, folder, "depth", &n, PixelFormat::Z16, name);
        foreign(&fs, folder, "color", &n, PixelFormat::Rgb8, name);
    }
    foreign(&fs, "camera_zed2i_quality", "R_color", &[0, 1], PixelFormat::Rgb8, name);
    let zed = Path::new("/in").join(name).join("camera_zed2i_quality");
    fs.put(&zed.join("pcd_0.npy"), b"no matter".to_vec());
    // One image is damaged, one has another size.
    let mut cut = contents(&fs, &zed.join("depth_1.png"));
    cut.truncate(100);
    fs.put(&zed.join("depth_1.png"), cut);
    let mut other = everything();
    other.streams.truncate(2);
    let small = recorded(&other, 1, ColorCodec::Raw);
    exported(&small, CameraNames::Short, None).unwrap();
    fs.put(&zed.join("depth_3.png"), contents(&small, &session_dir().join("camera_d455/depth_0.png")));

    let from = Path::new("/in").join(name);
    let made = imported(&fs, &from, ByteCameraOptions::default()).unwrap();
    assert_eq!(made.facts.lost, 2);
    assert!(made.facts.problems[0].contains("camera_zed2i_quality/depth_1.png: it cannot be read"));
    assert!(made.facts.problems[1].contains("depth_3.png: it is 32x24 z16, its stream is 16x12 z16"));
    for wanted in [
        "d405/depth: depth unit 0.0001 m inferred from the model D405",
        "zed2i_quality/depth: depth unit 0.001 m inferred from the model ZED 2i (quality)",
        "at 5 Hz, assumed",
        "20250314_1512, taken as UTC",
        "pcd_N.npy: 1 files are left out",
        "d405/depth: 1 of 5 sets have no file camera_realsense_405/depth_N.png, the first is number 3",
        "no calibration.json",
    ] {
        assert!(made.facts.stated.iter().any(|s| s.contains(wanted)), "{wanted}: {:#?}", made.facts.stated);
    }
    let lost: Vec<_> = made.verified.lost().map(|f| f.message.as_str()).collect();
    assert_eq!(lost, ["2 parts of what was imported could not be read, see [import]"]);
    assert!(made.verified.broken().is_none(), "{:?}", made.verified.findings);
    let dataset = reopened(&fs);
    let sets: Vec<_> = dataset.sets(SetRange::ALL).map(Result::unwrap).collect();
    let start = 1_741_965_120_000_000_000; // 2025-03-14T15:12Z
    assert_eq!(
        sets.iter().map(|s| s.utc_ns - start).collect::<Vec<_>>(),
        [0, 1, 2, 3, 4].map(|n| n * 200_000_000)
    );
    let id = |f: &depthrig_recorder::DatasetFrame| dataset.session().streams[f.stream].id.to_string();
    let last = sets[4].frames.iter().find(|f| id(f) == "d405/depth").unwrap();
    let h = &last.header;
    assert_eq!((h.sequence, h.device_sequence, h.captured, h.dropped[0]), (4, 4, 5, 1));
    assert!(h.has(depthrig_bus::FrameFlags::TIME_UNCERTAIN) && h.clock_domain == 0);
    assert_eq!(last.pixels, pixels(PixelFormat::Z16, 16, 12, 4));
    let streams: Vec<_> = dataset.session().streams.iter().map(|s| s.id.to_string()).collect();
    assert!(streams.contains(&"zed2i_quality/color_right".to_owned()), "{streams:?}");
}

#[test]
fn depth_units_and_rates_are_as_given() {
    let fs = MemFs::new();
    for folder in ["camera_mech", "camera_d455"] {
        foreign(&fs, folder, "depth", &[7, 8], PixelFormat::Z16, "monday");
    }
    let options = ByteCameraOptions {
        depth_unit_m: Some(0.002),
        camera_depth_unit_m: [("d455".to_owned(), 0.0005)].into(),
        rate_hz: Some(10.0),
        ..Default::default()
    };
    let made = imported(&fs, Path::new("/in/monday"), options).unwrap();
    assert!(made.facts.stated.iter().any(|s| s.contains("is not a date YYYYMMDD_HHMM")));
    let dataset = reopened(&fs);
    let units: Vec<_> = dataset.session().streams.iter().map(|s| s.depth_unit_m).collect();
    assert_eq!(units, [0.0005, 0.002]);
    let times: Vec<_> = dataset.sets(SetRange::ALL).map(|s| s.unwrap().utc_ns).collect();
    assert_eq!(times, [0, 100_000_000]);
}

/// The list says the unit where neither a calibration nor an option does: session and frames agree.
#[test]
fn a_list_without_a_calibration_says_the_unit() {
    let mut session = everything();
    session.streams.truncate(2);
    let exports = recorded(&session, 3, ColorCodec::Raw);
    exported(&exports, CameraNames::Short, None).unwrap();
    let list = session_dir().join("frames.csv");
    let rows = String::from_utf8(contents(&exports, &list)).unwrap();
    assert_eq!(rows.matches(",0.0001,").count(), 2, "the unit of each depth image");
    for (given, in_list, unit, says) in [
        (None, 0.0001, 0.0001, "depth unit 0.0001 m as frames.csv says"),
        (Some(0.002), 0.0001, 0.002, "depth unit 0.002 m as given, frames.csv says 0.0001"),
        (Some(0.0001), 0.0001, 0.0001, "depth unit 0.0001 m as given;"),
        (None, 0.0, 0.001, "depth unit 0.001 m inferred from the model D455"),
    ] {
        let fs = copy(&exports);
        fs.remove_file(&session_dir().join("calibration.json")).unwrap();
        fs.put(&list, rows.replace(",0.0001,", &format!(",{in_list},")).into_bytes());
        let options = ByteCameraOptions { depth_unit_m: given, ..Default::default() };
        let made = imported(&fs, &session_dir(), options).unwrap();
        assert_eq!(made.facts.lost, 0, "{:?}", made.facts);
        assert!(made.facts.stated.iter().any(|s| s.contains(says)), "{says}: {:#?}", made.facts.stated);
        let dataset = reopened(&fs);
        let depth = dataset.session().streams.iter().position(|s| s.format == PixelFormat::Z16).unwrap();
        assert_eq!(dataset.session().streams[depth].depth_unit_m, unit);
        let sets: Vec<_> = dataset.sets(SetRange::ALL).map(Result::unwrap).collect();
        let frames = sets.iter().flat_map(|s| &s.frames).filter(|f| f.stream == depth);
        assert_eq!(frames.map(|f| f.header.depth_unit_m).collect::<Vec<_>>(), [unit; 2]);
    }
}

#[test]
fn a_list_of_before_there_were_derived_streams_is_read() {
    let mut session = everything();
    session.streams.truncate(2);
    let fs = recorded(&session, 3, ColorCodec::Raw);
    exported(&fs, CameraNames::Short, None).unwrap();
    let path = session_dir().join("frames.csv");
    let today = String::from_utf8(contents(&fs, &path)).unwrap();
    let (head, rows) = today.split_once('\n').unwrap();
    let head = head.split_once(",source_color_sequence,").unwrap().0;
    fs.put(&path, format!("{head}\n{}", rows.replace(",,,,,\n", "\n")).into_bytes());
    let made = imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
    assert_eq!((made.facts.lost, made.summary.sets.recorded), (0, 3));
    let strict = CompareOptions { strict: true, ..CompareOptions::default() };
    let same = compare(&open(&fs), &reopened(&fs), &strict).unwrap();
    assert!(same.equal, "{:#?}", same.differences);
}

/// Names are cut; what they were cut to must not be one name.
#[test]
fn folders_with_long_names_are_cameras_of_their_own() {
    let fs = MemFs::new();
    for end in ["x", "y", "z"] {
        let folder = format!("camera_{}_{end}", "a".repeat(40));
        foreign(&fs, &folder, "depth", &[1, 2], PixelFormat::Z16, "monday");
    }
    imported(&fs, Path::new("/in/monday"), ByteCameraOptions::default()).unwrap();
    let cameras: Vec<_> = reopened(&fs).session().streams.iter().map(|s| s.id.camera.to_string()).collect();
    let stem = "a".repeat(29);
    assert_eq!(cameras, ["a".repeat(31), format!("{stem}_2"), format!("{stem}_3")]);
}

/// A list that ends early between two lines has no damaged line: the files that it does not name show it.
#[test]
fn a_list_that_lost_its_last_lines_is_reported() {
    let fs = recorded(&everything(), 3, ColorCodec::Raw);
    exported(&fs, CameraNames::Short, None).unwrap();
    let path = session_dir().join("frames.csv");
    let whole = String::from_utf8(contents(&fs, &path)).unwrap();
    // The head and two sets of eleven streams; the third set has ten frames.
    let begin: String = whole.split_inclusive('\n').take(23).collect();
    fs.put(&path, begin.into_bytes());
    let made = imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
    assert_eq!((made.summary.sets.recorded, made.facts.lost), (2, 10));
    assert_eq!(made.facts.problems, ["10 files are not named in frames.csv"]);
}

#[test]
fn what_is_no_such_folder_is_refused() {
    let refused = |fs: &MemFs, from: &str, options| {
        let e = imported(fs, Path::new(from), options).unwrap_err();
        (e.kind(), e.to_string())
    };
    let fs = MemFs::new();
    assert_eq!(refused(&fs, "/nowhere", ByteCameraOptions::default()).0, ErrorKind::NotFound);
    fs.create_dir_all(Path::new("/empty")).unwrap();
    let (kind, why) = refused(&fs, "/empty", ByteCameraOptions::default());
    assert!(kind == ErrorKind::BadRecording && why.contains("no folder camera_<model>"), "{why}");
    foreign(&fs, "camera_d455", "depth", &[1], PixelFormat::Z16, "a");
    // The folder around it is one step off.
    let (_, why) = refused(&fs, "/in", ByteCameraOptions::default());
    assert!(why.contains("import one, such as /in/a"), "{why}");
    let image = contents(&fs, Path::new("/in/a/camera_d455/depth_1.png"));
    fs.put(Path::new("/in/a/camera_d455/depth_001.png"), image);
    let (_, why) = refused(&fs, "/in/a", ByteCameraOptions::default());
    assert!(why.contains("number 1 of depth_N.png is there twice"), "{why}");
    let unit = ByteCameraOptions { depth_unit_m: Some(1000.0), ..Default::default() };
    assert!(refused(&fs, "/in/a", unit).1.contains("invalid depth unit 1000 m"));

    // Every line of frames.csv cut or changed, and every byte of calibration.json: an error or a dataset, no panic.
    let fs = recorded(&everything(), 2, ColorCodec::Raw);
    exported(&fs, CameraNames::Short, None).unwrap();
    for (name, step) in [("frames.csv", 97), ("calibration.json", 331)] {
        let path = session_dir().join(name);
        let whole = contents(&fs, &path);
        for at in (0..whole.len()).step_by(step) {
            let fs = copy(&fs);
            fs.put(&path, whole[..at].to_vec());
            let made = imported(&fs, &session_dir(), ByteCameraOptions::default());
            assert!(made.is_err() || made.is_ok_and(|m| m.facts.lost > 0), "{name} cut at {at}");
            let mut changed = whole.clone();
            changed[at] = b'9';
            fs.put(&path, changed);
            if fs.read_dir(&back()).is_err() {
                let _ = imported(&fs, &session_dir(), ByteCameraOptions::default());
            }
        }
    }
}

/// A stereo camera with depth in several modes: a folder for each, as the published dataset has them, and back again.
#[test]
fn a_folder_for_each_depth_mode() {
    let mut session = everything();
    let left = stream("zed/color", PixelFormat::Rgb8, 32, 24);
    let mut of = |name: &str, format| {
        let mut s = stream(&format!("zed/{name}"), format, 32, 24);
        s.model = "ZED 2i".into();
        session.streams.push(s);
    };
    of("left", PixelFormat::Yuyv);
    of("color", left.format);
    for mode in ["performance", "quality"] {
        of(&format!("depth_{mode}"), PixelFormat::Z16);
        of(&format!("confidence_{mode}"), PixelFormat::Confidence8);
        of(&format!("disparity_{mode}"), PixelFormat::DisparityF32);
    }
    let fs = recorded(&session, 5, ColorCodec::Png);
    let report = exported(&fs, CameraNames::Short, None).unwrap();
    let folders = fs.read_dir(&session_dir()).unwrap().into_iter().filter(|e| e.is_dir).map(|e| e.name);
    let folders: Vec<_> = folders.filter(|f| f.contains("zed2i")).collect();
    // The camera of the other streams is a ZED 2i as well.
    assert_eq!(
        folders,
        ["camera_zed2i", "camera_zed2i_2", "camera_zed2i_performance", "camera_zed2i_quality"]
    );
    let color = |mode: &str| contents(&fs, &session_dir().join(format!("camera_zed2i_{mode}/color_4.png")));
    assert_eq!(color("performance"), color("quality"));
    for mode in ["performance", "quality"] {
        for file in ["depth_4.png", "confidence_4.png", "disparity_4.npy"] {
            assert!(!contents(&fs, &session_dir().join(format!("camera_zed2i_{mode}/{file}"))).is_empty());
        }
    }
    assert!(
        report.losses.iter().any(|l| l.contains("camera_zed2i_performance and camera_zed2i_quality")),
        "{:?}",
        report.losses
    );
    let imported = imported(&fs, &session_dir(), ByteCameraOptions::default()).unwrap();
    assert!(!imported.facts.stated.iter().any(|s| s.contains("left out")), "{:?}", imported.facts.stated);
    let same = compare(&open(&fs), &reopened(&fs), &CompareOptions::default()).unwrap();
    assert!(same.equal, "{:?}", same.differences);
}
