//! The report's fill rate against that of the depth metrics, on real images: the two crates share no code.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::ops::ControlFlow;
use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_cdm::metrics::{Depth, fill_rate};
use depthrig_recorder::report::{Report, ReportOptions};
use depthrig_recorder::{
    Dataset, RecordFrame, RecordSet, Recorder, RecorderOptions, Session, StreamRecord, fs::RealFs,
};
use std::path::Path;
use std::sync::Arc;

/// Depth images and their units, metres.
const IMAGES: [(&str, f64); 3] = [
    ("cdm_d405/depth_26.png", 0.0001),
    ("lingbot_depth/0/raw_depth.png", 0.001),
    ("lingbot_depth/3/raw_depth.png", 0.001),
];

#[test]
fn the_fill_rate_of_a_report_is_that_of_the_metrics() {
    let data = std::env::var_os("DEPTHRIG_TEST_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), Into::into);
    let images = IMAGES.map(|(file, unit_m)| {
        let path = data.join(file);
        let image =
            image::open(&path).unwrap_or_else(|e| panic!("{}: {e}; set DEPTHRIG_TEST_DATA", path.display()));
        (image.into_luma16(), unit_m)
    });
    let mut session = Session::new("fill", "rig");
    session.streams = images
        .iter()
        .enumerate()
        .map(|(i, (image, unit_m))| StreamRecord {
            id: format!("cam{i}/depth").parse().unwrap(),
            model: String::new(),
            serial: String::new(),
            format: PixelFormat::Z16,
            width: image.width(),
            height: image.height(),
            rate_hz: 30.0,
            depth_unit_m: *unit_m,
            calibration: String::new(),
            intrinsics: Intrinsics::default(),
            pose: Pose::IDENTITY,
        })
        .collect();
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("fill");
    let options = RecorderOptions { min_free_bytes: 0, ..RecorderOptions::default() };
    let recorder = Recorder::create(Arc::new(RealFs), &dir, session.clone(), options).unwrap();
    let frames = images.iter().zip(&session.streams).enumerate().map(|(stream, ((image, unit_m), s))| {
        let mut header = FrameHeader::default();
        header.set_names("rig", &s.id);
        header.set_image(PixelFormat::Z16, image.width(), image.height());
        header.depth_unit_m = *unit_m;
        let pixels: Vec<u8> = image.as_raw().iter().flat_map(|v| v.to_le_bytes()).collect();
        RecordFrame { stream, header, pixels: Box::new(pixels) }
    });
    let utc = UtcPair { mono: HostTime::from_ns(1), utc_ns: 1_700_000_000_000_000_000, width_ns: 1 };
    let frames = frames.collect();
    recorder
        .push(RecordSet {
            id: 1,
            tick: HostTime::from_ns(1),
            utc,
            frames,
            missing: vec![],
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        })
        .unwrap();
    recorder.finish().unwrap();

    let dataset = Dataset::open(&dir).unwrap();
    let report = Report::of(&dataset, &ReportOptions::default(), &mut |_| ControlFlow::Continue(()));
    let report = report.unwrap().unwrap();
    for ((image, unit_m), s) in images.iter().zip(&report.streams) {
        let truth = fill_rate(&Depth::Units { pixels: image.as_raw(), unit_m: *unit_m });
        assert!((0.5..1.0).contains(&truth), "an image with holes: {truth}");
        assert!(
            (s.fill.as_ref().unwrap().mean - truth).abs() < 1e-12,
            "{}: {:?}, not {truth}",
            s.record.id,
            s.fill
        );
    }
}
