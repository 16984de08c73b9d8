//! Frames listed and written as image files.

use crate::support::*;
use depthrig_bus::PixelFormat;
use depthrig_recorder::fs::{Fault, Fs, MemFs};
use depthrig_recorder::{
    ColorCodec, Dataset, Edge, ErrorKind, FRAMES_FILE, FrameChoice, FramesDone, Moment, Recorder,
    RecorderOptions, SetChoice, SetSpan, StillFormat, export_frames, list_frames,
};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

fn out() -> PathBuf {
    PathBuf::from("/data/frames")
}

fn raw() -> RecorderOptions {
    RecorderOptions { color: ColorCodec::Raw, segment_max_ns: 3 * PERIOD, ..options() }
}

fn export(
    fs: &MemFs,
    dataset: &Dataset,
    choice: &FrameChoice,
    form: Option<StillFormat>,
) -> depthrig_recorder::Result<FramesDone> {
    export_frames(fs, dataset, choice, form, &out(), &mut |_, _| ControlFlow::Continue(()))
}

fn rows(dataset: &Dataset, choice: &FrameChoice) -> Vec<(u64, String)> {
    let mut rows = Vec::new();
    list_frames(dataset, choice, &mut |row| {
        rows.push((row.set, row.stream));
        ControlFlow::Continue(())
    })
    .unwrap();
    rows
}

/// The lines of `frames.csv` as maps from column to text.
fn csv(fs: &MemFs) -> Vec<BTreeMap<String, String>> {
    let text = String::from_utf8(contents(fs, &out().join(FRAMES_FILE))).unwrap();
    let mut lines = text.lines().map(|l| l.split(',').map(str::to_owned).collect::<Vec<_>>());
    let head = lines.next().unwrap();
    lines
        .map(|l| {
            assert_eq!(l.len(), head.len());
            head.iter().cloned().zip(l).collect()
        })
        .collect()
}

fn only(ids: &[&str]) -> Vec<depthrig_bus::StreamId> {
    ids.iter().map(|s| s.parse().unwrap()).collect()
}

#[test]
fn every_frame_becomes_a_file_that_holds_its_pixels() {
    let fs = MemFs::new();
    record(&fs, 7, raw());
    let dataset = open(&fs);
    let done = export(&fs, &dataset, &FrameChoice::default(), None).unwrap();
    assert_eq!((done.sets, done.frames, done.lost, done.ended), (7, 21, 0, false));
    let rows = csv(&fs);
    assert_eq!(rows.len(), 21);
    let mut bytes = 0;
    for (i, row) in rows.iter().enumerate() {
        let n = i as u64 / 3;
        let stream = &session().streams[i % 3];
        assert_eq!(row["file"], format!("{}/{:06}.png", stream.id, n + 1));
        assert_eq!(
            (row["set"].as_str(), row["stream"].as_str()),
            ((n + 1).to_string().as_str(), stream.id.to_string().as_str())
        );
        let h = header(stream, n);
        assert_eq!(row["capture_time_ns"], h.capture_time_ns.to_string());
        assert_eq!(row["capture_utc_ns"], (h.capture_time_ns - M0 + T0).to_string());
        assert_eq!(row["depth_unit_m"], if stream.format.is_depth() { "0.0001" } else { "0" });
        let file = contents(&fs, &out().join(&row["file"]));
        bytes += file.len() as u64;
        let image = image::load_from_memory(&file).unwrap();
        let got = match stream.format {
            PixelFormat::Z16 => image.into_luma16().iter().flat_map(|v| v.to_le_bytes()).collect(),
            PixelFormat::Rgb8 => image.into_rgb8().into_raw(),
            _ => image.into_luma8().into_raw(),
        };
        assert_eq!(got, pixels(stream.format, stream.width, stream.height, n), "{}", row["file"]);
    }
    assert_eq!(done.bytes, bytes);
    let names: Vec<_> = fs.read_dir(&out()).unwrap().into_iter().map(|e| e.name).collect();
    assert_eq!(names, ["frames.csv", "front", "side"]);
}

#[test]
fn a_stored_jpeg_comes_out_byte_by_byte() {
    let fs = MemFs::new();
    record(&fs, 2, options());
    let dataset = open(&fs);
    let choice = FrameChoice { streams: only(&["front/color"]), ..Default::default() };
    export(&fs, &dataset, &choice, Some(StillFormat::Jpeg)).unwrap();
    for set in dataset.sets_with((..).into(), depthrig_recorder::PixelMode::Stored) {
        let set = set.unwrap();
        let path = out().join(format!("front/color/{:06}.jpg", set.id));
        assert_eq!(contents(&fs, &path), set.frames[0].pixels);
    }
}

/// The images of a camera that came late are refused only if they cannot be JPEG.
#[test]
fn a_stream_that_is_missing_first_is_judged_by_what_it_can_be() {
    let late = |options: RecorderOptions, first: &[usize]| {
        let fs = MemFs::new();
        let r = recorder(&fs, options);
        for (n, streams) in [(0, first), (1, &[0, 1, 2][..])] {
            r.push(set_of(&session(), n, streams)).unwrap();
            settle(&r);
        }
        r.finish().unwrap();
        fs
    };
    let of = |id: &str| FrameChoice { streams: only(&[id]), ..Default::default() };
    let fs = late(options(), &[1, 2]);
    let done = export(&fs, &open(&fs), &of("front/color"), Some(StillFormat::Jpeg)).unwrap();
    assert_eq!((done.sets, done.frames, done.lost), (2, 1, 0), "{done:?}");
    assert_eq!(csv(&fs)[0]["file"], "front/color/000002.jpg");

    // Colour that is stored as it is costs its frames, each by itself.
    let fs = late(raw(), &[1, 2]);
    let done = export(&fs, &open(&fs), &of("front/color"), Some(StillFormat::Jpeg)).unwrap();
    assert_eq!((done.frames, done.lost), (0, 1));
    assert!(done.problems[0].contains("is stored as raw, not as a JPEG"), "{:?}", done.problems);

    let fs = late(options(), &[0]);
    let e = export(&fs, &open(&fs), &of("front/depth"), Some(StillFormat::Jpeg)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(fs.read_dir(&out()).is_err(), "nothing is written");
}

#[test]
fn what_cannot_be_written_as_asked_is_refused_before_anything_is_written() {
    let fs = MemFs::new();
    let mut session = session();
    session.streams = vec![
        stream("cam/depth", PixelFormat::DepthF32, 32, 24),
        stream("cam/yuv", PixelFormat::Yuyv, 32, 24),
        stream("cam/mono", PixelFormat::Mono8, 32, 24),
    ];
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    r.push(set(&session, 0)).unwrap();
    r.finish().unwrap();
    let dataset = open(&fs);
    for (form, stream) in [(StillFormat::Png, "cam/depth"), (StillFormat::Jpeg, "cam/depth")] {
        let e = export(&fs, &dataset, &FrameChoice::default(), Some(form)).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput);
        assert!(e.to_string().contains(stream) && e.to_string().contains("NPY"), "{e}");
        assert!(fs.read_dir(&out()).is_err(), "nothing is written");
    }
    let e = rows_error(&dataset, &FrameChoice { streams: only(&["cam/ir"]), ..Default::default() });
    assert_eq!(e, "there is no stream cam/ir; the dataset has cam/depth, cam/yuv, cam/mono");
    let e = rows_error(&dataset, &FrameChoice { sets: SetChoice::Id(9), ..Default::default() });
    assert_eq!(e, "there is no set 9; the dataset has sets 1 to 1 over 0.000 s");

    // Without a form each stream gets the one that holds its bits.
    export(&fs, &dataset, &FrameChoice::default(), None).unwrap();
    let files: Vec<_> = csv(&fs).into_iter().map(|r| r["file"].clone()).collect();
    assert_eq!(files, ["cam/depth/000001.npy", "cam/yuv/000001.npy", "cam/mono/000001.png"]);
    let npy = contents(&fs, &out().join("cam/depth/000001.npy"));
    assert!(npy.ends_with(&pixels(PixelFormat::DepthF32, 32, 24, 0)));

    // And nothing is written over.
    let before = fs.log().len();
    let e = export(&fs, &dataset, &FrameChoice::default(), None).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::AlreadyExists);
    assert!(fs.log()[before..].iter().all(|op| !op.starts_with("create") && !op.starts_with("write")));
}

fn rows_error(dataset: &Dataset, choice: &FrameChoice) -> String {
    list_frames(dataset, choice, &mut |_| ControlFlow::Continue(())).unwrap_err().to_string()
}

#[test]
fn a_damaged_set_costs_itself() {
    let fs = MemFs::new();
    record(&fs, 3, RecorderOptions { segment_max_ns: 60_000_000_000, ..raw() });
    let mut bytes = contents(&fs, &segment(0));
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs.put(&segment(0), bytes);
    let done = export(&fs, &open(&fs), &FrameChoice::default(), None).unwrap();
    assert_eq!((done.sets, done.frames, done.lost), (2, 6, 1));
    let damaged = |p: &String| p.contains("checksum") || p.contains("cannot be unpacked");
    assert!(damaged(&done.problems[0]), "{:?}", done.problems);
    assert_eq!(csv(&fs).len(), 6);
}

#[test]
fn an_end_from_outside_leaves_a_list_that_is_not_finished() {
    let fs = MemFs::new();
    record(&fs, 4, raw());
    let mut calls = 0;
    let done = export_frames(&fs, &open(&fs), &FrameChoice::default(), None, &out(), &mut |n, total| {
        calls += 1;
        assert_eq!((n, total), (calls - 1, 4));
        if n == 2 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .unwrap();
    assert!(done.ended && done.sets == 2);
    let names: Vec<_> = fs.read_dir(&out()).unwrap().into_iter().map(|e| e.name).collect();
    assert_eq!(names, ["frames.csv.part", "front", "side"]);
}

/// Whichever operation fails: an error, no finished list, and no incomplete image.
#[test]
fn any_failing_operation_is_an_error_and_leaves_no_half_image() {
    let good = MemFs::new();
    record(&good, 2, raw());
    let whole = copy(&good);
    export(&whole, &open(&whole), &FrameChoice::default(), None).unwrap();
    let ops = whole.ops();
    let mut failures = 0;
    for n in 0..ops {
        let fs = copy(&good).with_fault(Fault::FailOnce(n, io::ErrorKind::TimedOut));
        let shared: Arc<dyn Fs> = Arc::new(fs.clone());
        let Ok(dataset) = Dataset::open_with(shared, &dir()) else { continue };
        match export(&fs, &dataset, &FrameChoice::default(), None) {
            // Only reading again may help, and only what is read twice.
            Ok(done) => assert!(done.lost == 0 && csv(&fs).len() == 6, "operation {n}: {done:?}"),
            Err(e) => {
                failures += 1;
                assert_eq!(e.kind(), ErrorKind::Io, "operation {n}: {e}");
                let finished = fs.contents(&out().join(FRAMES_FILE)).is_some();
                assert!(!finished || fs.log().last().unwrap().starts_with("syncdir"), "operation {n}");
            }
        }
        for row in csv(&whole) {
            let path = out().join(&row["file"]);
            if let Some(bytes) = fs.contents(&path) {
                assert_eq!(bytes, contents(&whole, &path), "operation {n} left a half of {}", path.display());
            }
        }
    }
    assert!(failures > 20, "{failures} of {ops} operations fail");
}

/// Sets at random times with random ids, and which of them a span means, by looking at each.
#[derive(Debug, Clone)]
struct Model {
    /// Id, and ticks since the first set in units of 50 ms.
    sets: Vec<(u64, i64)>,
    from: Option<Edge>,
    to: Option<Edge>,
    every: usize,
}

const UNIT: i64 = 50_000_000;

fn edge() -> impl Strategy<Value = Option<Edge>> {
    prop_oneof![
        Just(None),
        (0..40i64).prop_map(|t| Some(Edge::Moment(Moment::AfterFirst(t * UNIT)))),
        (-5..40i64).prop_map(|t| Some(Edge::Moment(Moment::Utc(T0 + t * UNIT)))),
        (0..60u64).prop_map(|id| Some(Edge::Set(id))),
    ]
}

fn model() -> impl Strategy<Value = Model> {
    let steps = proptest::collection::vec((1..5u64, 1..5i64), 1..9);
    (steps, edge(), edge(), 0..4usize).prop_map(|(steps, from, to, every)| {
        let mut id = 0;
        let mut t = 0;
        let mut sets = Vec::new();
        for (i, (step, time)) in steps.into_iter().enumerate() {
            id += step;
            t += if i == 0 { 0 } else { time };
            sets.push((id, t));
        }
        Model { sets, from, to, every }
    })
}

impl Model {
    fn dataset(&self) -> (MemFs, Dataset) {
        let fs = MemFs::new();
        let mut session = session();
        session.streams = vec![stream("cam/any", PixelFormat::Mono8, 8, 8)];
        let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), raw()).unwrap();
        for (id, t) in &self.sets {
            let mut s = set(&session, 0);
            s.id = *id;
            s.tick = s.tick.plus_ns(t * UNIT);
            s.motion.clear();
            s.signals.clear();
            r.push(s).unwrap();
            settle(&r);
        }
        r.finish().unwrap();
        let dataset = open(&fs);
        (fs, dataset)
    }

    fn expected(&self) -> Vec<u64> {
        let inside = |id: u64, t: i64, edge: Option<Edge>, from: bool| {
            let (value, limit) = match edge {
                None => return true,
                Some(Edge::Set(limit)) => (id as i64, limit as i64),
                Some(Edge::Moment(Moment::AfterFirst(limit))) => (t * UNIT, limit),
                Some(Edge::Moment(Moment::Utc(limit))) => (T0 + t * UNIT, limit),
            };
            if from { value >= limit } else { value <= limit }
        };
        let all = self
            .sets
            .iter()
            .filter(|(id, t)| inside(*id, *t, self.from, true) && inside(*id, *t, self.to, false));
        all.map(|(id, _)| *id).step_by(self.every.max(1)).collect()
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]
    #[test]
    fn a_span_means_the_sets_that_lie_in_it(model in model(), id in 0..40u64, at in 0..45i64) {
        let (_fs, dataset) = model.dataset();
        let span = SetSpan { from: model.from, to: model.to };
        let choice = FrameChoice { sets: SetChoice::Span(span), every: model.every, ..Default::default() };
        let expected = model.expected();
        if expected.is_empty() {
            let e = rows_error(&dataset, &choice);
            prop_assert!(e.starts_with("no set is between these; the dataset has sets "), "{}", e);
        } else {
            let got: Vec<_> = rows(&dataset, &choice).into_iter().map(|r| r.0).collect();
            prop_assert_eq!(got, expected);
        }

        let choice = FrameChoice { sets: SetChoice::Id(id), ..Default::default() };
        if model.sets.iter().any(|s| s.0 == id) {
            prop_assert_eq!(rows(&dataset, &choice), [(id, "cam/any".to_owned())]);
        } else {
            let expected = format!("there is no set {id}; ");
            prop_assert!(rows_error(&dataset, &choice).starts_with(&expected));
        }

        let choice = FrameChoice { sets: SetChoice::Nearest(Moment::AfterFirst(at * UNIT)), ..Default::default() };
        let got = rows(&dataset, &choice)[0].0;
        let distance = |id| model.sets.iter().find(|s| s.0 == id).map(|s| (s.1 - at).abs()).unwrap();
        prop_assert_eq!(Some(distance(got)), model.sets.iter().map(|s| (s.1 - at).abs()).min());
    }
}

/// A set that cannot be read must not send the search for an id astray.
#[test]
fn a_search_passes_over_what_cannot_be_read() {
    let fs = MemFs::new();
    record(&fs, 8, RecorderOptions { segment_max_ns: 60_000_000_000, ..raw() });
    let whole = contents(&fs, &segment(0));
    let mut hit = 0;
    for part in 1..40 {
        let mut bytes = whole.clone();
        let at = bytes.len() * part / 40;
        bytes[at] ^= 1;
        let damaged = copy(&fs);
        damaged.put(&segment(0), bytes);
        let Ok(dataset) = Dataset::open_with(Arc::new(damaged), Path::new("/data/session")) else { continue };
        if dataset.set_reader().unwrap().times().is_empty() {
            let e = rows_error(&dataset, &FrameChoice::default());
            assert!(e.contains("the dataset has 0 sets") && e.contains("checksum"), "{e}");
            continue;
        }
        let all: Vec<_> = rows(&dataset, &FrameChoice::default()).into_iter().map(|r| r.0).collect();
        hit += usize::from(all.len() < 24);
        for id in 1..=8 {
            let choice = FrameChoice { sets: SetChoice::Id(id), ..Default::default() };
            if all.contains(&id) {
                assert_eq!(rows(&dataset, &choice)[0].0, id);
            } else {
                assert!(rows_error(&dataset, &choice).contains("there is no set"));
            }
        }
    }
    assert!(hit > 3, "the description of a set was hit {hit} times");
}
