//! Refined depth in a running rig: published frames, their metadata, and failures. Long because all tests share one rig.
//!
//! Faults come from a scripted refiner, injected where a rig takes its refiners from.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, Frame, FrameFlags, HostTime, PixelFormat, RigName, StageStep, Subscriber};
use depthrig_cdm::stage::RefineConfig;
use depthrig_cdm::stage::{Opened, Plan, Refiners};
use depthrig_cdm::{Description, EngineKind, Error, ErrorKind, Job, Output, Precision, Refiner, Result};
use depthrig_daemon::rig::Rig;
use depthrig_daemon::status::{RefineState, RefineStatus, RigStatus, StreamStatus};
use depthrig_recorder::{Finding, Severity};
use depthrig_tests::{Home, ImageSize, RigText, all_stream, assert_balanced, camera, wait_until};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

/// Behaviour of the scripted refiner, which adds 7 units to each raw depth.
#[derive(Debug, Default)]
struct Script {
    /// Milliseconds that a batch takes.
    delay_ms: AtomicU64,
    /// Batches that fail from now on.
    failing: AtomicUsize,
    /// Openings that fail from now on.
    closed: AtomicUsize,
    /// It hangs while this is set.
    hang: AtomicBool,
    /// Opening hangs while this is set.
    hang_open: AtomicBool,
    /// Colour of this width is refused; 0 accepts every width.
    refused_width: AtomicUsize,
    /// Pairs of a batch; 0 is 1.
    batch: AtomicUsize,
    opened: AtomicUsize,
    /// Sizes of the batches.
    largest: AtomicUsize,
}

/// How long refining took by its own account when it hung.
const HUNG_NS: u64 = 77_000_000;

const LARGE: ImageSize = ImageSize { width: 64, height: 48 };
const SMALL: ImageSize = ImageSize { width: 32, height: 24 };

#[derive(Clone)]
struct Scripted(Arc<Script>);

struct Fake(Arc<Script>, Description);

impl Refiners for Scripted {
    fn plan(&self, config: &RefineConfig, _device_model: &str) -> Plan {
        Plan {
            engine: EngineKind::Fill,
            model: config.model.clone(),
            input_size: config.input_size,
            precision: Precision::Fp32,
            device: config.device.clone(),
            fill_reach: 1.0,
            may_fill: false,
            note: None,
        }
    }

    fn open(&self, plan: &Plan, threads: usize) -> Result<Opened> {
        assert!(threads >= 1);
        self.0.opened.fetch_add(1, Ordering::SeqCst);
        while self.0.hang_open.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(5));
        }
        if take_one(&self.0.closed) {
            return Err(Error::new(ErrorKind::OutOfMemory, "the device has no memory left"));
        }
        let what = Description { engine: "fake 1.0".into(), model: format!("script-{}", plan.device) };
        Ok(Opened { refiner: Box::new(Fake(Arc::clone(&self.0), what)), note: None })
    }
}

/// Decrements the counter unless it is 0.
fn take_one(n: &AtomicUsize) -> bool {
    n.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |n| n.checked_sub(1)).is_ok()
}

impl Refiner for Fake {
    fn describe(&self) -> &Description {
        &self.1
    }

    fn best_batch(&self) -> usize {
        self.0.batch.load(Ordering::SeqCst).max(1)
    }

    fn refine(&mut self, jobs: &mut [Job<'_>]) -> Result<()> {
        let mut infer_ns = 3_000_000;
        while self.0.hang.load(Ordering::SeqCst) {
            infer_ns = HUNG_NS;
            std::thread::sleep(Duration::from_millis(5));
        }
        std::thread::sleep(Duration::from_millis(self.0.delay_ms.load(Ordering::SeqCst)));
        self.0.largest.fetch_max(jobs.len(), Ordering::SeqCst);
        if take_one(&self.0.failing) {
            return Err(Error::new(ErrorKind::Engine, "the script says so"));
        }
        let refused = self.0.refused_width.load(Ordering::SeqCst);
        if let Some(i) = jobs.iter().position(|j| j.color.width == refused) {
            let what = format!("pair {i} is {refused} pixels wide");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        for job in jobs {
            job.steps.infer_ns = infer_ns;
            match &mut job.out {
                Output::Units { pixels, .. } => {
                    for (out, raw) in pixels.iter_mut().zip(job.depth.pixels) {
                        *out = if *raw == 0 || *raw == u16::MAX { 0 } else { *raw + 7 };
                    }
                }
                Output::Metres(pixels) => {
                    for (out, raw) in pixels.iter_mut().zip(job.depth.pixels) {
                        *out = (f64::from(*raw) * job.depth.unit_m) as f32;
                    }
                }
                Output::Inverse(_) => panic!("nobody asked for it"),
            }
        }
        Ok(())
    }
}

/// A rig with the refiner of these tests.
fn start(home: &Home, text: &RigText, script: &Arc<Script>) -> Rig {
    let refiners = Scripted(Arc::clone(script));
    home.start_with(text.text(), |o| o.refiners = Some(Arc::new(refiners))).unwrap()
}

fn refined<'s>(status: &'s RigStatus, name: &str) -> (&'s RefineStatus, &'s StreamStatus) {
    let camera = camera(status, name);
    let stream = camera.streams.iter().find(|s| s.id.ends_with("/depth_refined")).unwrap();
    (camera.refine.as_ref().unwrap(), stream)
}

fn bus(home: &Home) -> Bus {
    Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap()
}

fn next(from: &mut Subscriber) -> Frame {
    from.next_timeout(Duration::from_secs(10)).unwrap().expect("a frame within ten seconds")
}

/// Panics when a stream that a camera captured lost a frame other than in its own count, as on a busy computer.
fn assert_captured_everything(status: &RigStatus) {
    for s in status.cameras.iter().flat_map(|c| &c.streams).filter(|s| !s.derived) {
        let lost = s.dropped.keys().any(|reason| reason != "device_gap");
        assert!(!lost, "{} lost frames: {:?}", s.id, s.dropped);
    }
}

#[test]
fn a_refined_frame_says_what_it_is_made_of() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let rig = start(
        &home,
        &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0\nalign = true"),
        &script,
    );
    wait_until(&rig, "refined", |s| all_stream(s) && refined(s, "cam").1.delivered > 3);
    let bus = bus(&home);
    let [mut color, mut depth, mut out, mut aligned] = ["color", "depth", "depth_refined", "depth_aligned"]
        .map(|s| bus.subscriber(&format!("cam/{s}").parse().unwrap()).unwrap());
    let mut colors = Vec::new();
    let mut depths = Vec::new();
    let mut views = Vec::new();
    let mut checked = 0;
    let mut before: Option<depthrig_bus::FrameHeader> = None;
    while checked < 20 {
        let frame = next(&mut out);
        while let Some(f) = color.try_next().unwrap() {
            colors.push(*f.header());
        }
        while let Some(f) = depth.try_next().unwrap() {
            depths.push((*f.header(), f.pixels().to_vec()));
        }
        while let Some(f) = aligned.try_next().unwrap() {
            views.push((*f.header(), f.pixels().to_vec()));
        }
        let h = frame.header();
        assert_eq!(
            (h.stream(), h.camera(), h.refiner(), h.refiner_model()),
            ("depth_refined", "cam", "fake 1.0", "script-cpu")
        );
        assert!(h.has(FrameFlags::DERIVED) && h.has(FrameFlags::SYNTHETIC));
        assert_eq!(h.pixel_format(), Some(PixelFormat::Z16));
        assert_eq!(h.captured, h.sequence + h.drops().total(), "{h:?}");
        if let Some(before) = before.replace(*h) {
            assert!(h.capture_time_ns > before.capture_time_ns && h.captured > before.captured);
        }
        assert_eq!(h.step_ns(StageStep::Infer), 3_000_000);
        let total = h.step_ns(StageStep::Total);
        assert!(
            total >= h.step_ns(StageStep::Wait) + h.step_ns(StageStep::Register) && total < 5_000_000_000
        );
        assert!(h.publish_time_ns > h.capture_time_ns);
        let (Some(c), Some((d, raw))) = (
            colors.iter().find(|c| c.sequence == h.source_color_sequence),
            depths.iter().find(|d| d.0.sequence == h.source_sequence),
        ) else {
            continue; // of before these subscribers
        };
        assert_eq!(
            (h.capture_time_ns, h.depth_unit_m, h.device_time),
            (d.capture_time_ns, d.depth_unit_m, d.device_time)
        );
        assert_eq!((h.intrinsics, h.pose, h.width, h.height), (c.intrinsics, c.pose, c.width, c.height));
        assert_eq!(h.source_color_capture_time_ns, c.capture_time_ns);
        let apart = |c: &depthrig_bus::FrameHeader| (c.capture_time_ns - d.capture_time_ns).abs();
        assert!(apart(c) <= 17_700_000, "half a period and a millisecond");
        assert!(colors.iter().all(|other| apart(other) >= apart(c)), "another colour frame lies nearer");
        let Some((v, view)) = views.iter().find(|v| v.0.source_sequence == h.source_sequence) else {
            continue;
        };
        assert_eq!((v.refiner(), v.stream(), v.intrinsics), ("", "depth_aligned", c.intrinsics));
        let words =
            |b: &[u8]| b.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect::<Vec<_>>();
        let seen = words(frame.pixels());
        let was = words(view);
        assert!(seen.iter().zip(&was).all(|(s, w)| *s == if *w == 0 || *w == u16::MAX { 0 } else { w + 7 }));
        assert_eq!(was.len(), words(raw).len());
        checked += 1;
    }
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
    assert_eq!(summary.lost, [] as [&str; 0]);
    let (state, stream) = refined(&summary.status, "cam");
    assert_eq!((state.state, state.engine.as_str()), (RefineState::Running, "fake 1.0"));
    assert!(stream.derived && state.steps_p50_ms["infer"] == 3.0);
}

#[test]
fn the_newest_pair_wins_and_the_others_are_counted() {
    let home = Home::default();
    let script = Arc::new(Script { delay_ms: 150.into(), ..Script::default() });
    let rig = start(&home, &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0"), &script);
    // Published frames are of the newest pair: no older than one refining plus the delay of a frame. Pairs come every
    // 33 ms: the newest has waited for less than that, the oldest for nearly all of the 150 ms.
    wait_until(&rig, "the newest pairs are refined", |s| {
        let (state, stream) = refined(s, "cam");
        stream.delivered >= 8 && stream.latency_p50_ms < 300.0 && state.steps_p50_ms["wait"] < 75.0
    });
    let summary = rig.stop();
    let (state, stream) = refined(&summary.status, "cam");
    // Of about five pairs one is refined.
    let busy = state.skipped["busy"];
    assert!(busy >= 2 * stream.delivered, "{busy} skipped, {} refined", stream.delivered);
    assert_eq!(stream.dropped.get("queue_full"), Some(&busy));
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
}

#[test]
fn the_rate_asked_for_is_kept() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let rig = start(&home, &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 5"), &script);
    // The moments move onto the first ticks.
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered >= 1 && s.sets.sent >= 3);
    let mut out = bus(&home).subscriber(&"cam/depth_refined".parse().unwrap()).unwrap();
    let headers: Vec<_> = (0..16).map(|_| *next(&mut out).header()).collect();
    let after = rig.stop().status;
    let periods = (headers[15].sequence - headers[0].sequence) as i64;
    let span = headers[15].capture_time_ns - headers[0].capture_time_ns;
    // The first frame may be late for its moment on a busy computer, and the last half a frame early.
    assert!(span > (periods - 1) * 200_000_000 - 17_000_000, "{periods} periods in {span} ns");
    // Of six frames one is due; a busy computer may come to read fewer.
    let (state, stream) = refined(&after, "cam");
    let due = stream.captured;
    assert!((2 * due..=5 * due + 30).contains(&state.not_due), "{due} due, {} not", state.not_due);
    assert_balanced(&after);
}

#[test]
fn an_engine_that_fails_stops_the_stream_says_why_and_comes_back() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let rig = start(&home, &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0"), &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    script.closed.store(1, Ordering::SeqCst);
    script.failing.store(1, Ordering::SeqCst);
    let status = wait_until(&rig, "failed", |s| refined(s, "cam").0.state == RefineState::Failed);
    let message = refined(&status, "cam").0.message.clone().unwrap();
    assert!(message.contains("the script says so") && message.contains("tried again in 1 s"), "{message}");
    let stopped = refined(&status, "cam").1.delivered;
    let status = wait_until(&rig, "out of memory", |s| {
        refined(s, "cam").0.message.as_deref().is_some_and(|m| m.contains("no memory left"))
    });
    assert_eq!(refined(&status, "cam").1.delivered, stopped, "frames came although the engine had failed");
    let status = wait_until(&rig, "back", |s| refined(s, "cam").1.delivered > stopped + 3);
    assert_eq!(
        (refined(&status, "cam").0.state, refined(&status, "cam").0.restarts),
        (RefineState::Running, 1)
    );
    assert_eq!(script.opened.load(Ordering::SeqCst), 3);
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
    assert_eq!(refined(&summary.status, "cam").1.dropped["device_error"], 1);
}

#[test]
fn an_engine_that_hangs_is_given_up_and_neither_capture_nor_the_end_waits_for_it() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let text = RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0").and("[cdm]\nhang_s = 1.0\n");
    let rig = start(&home, &text, &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    let mut out = bus(&home).subscriber(&"cam/depth_refined".parse().unwrap()).unwrap();
    script.hang.store(true, Ordering::SeqCst);
    let status = wait_until(&rig, "given up", |s| refined(s, "cam").0.state == RefineState::Failed);
    let message = refined(&status, "cam").0.message.clone().unwrap();
    assert!(message.contains("hangs for"), "{message}");
    assert_eq!(refined(&status, "cam").1.dropped["abandoned"], 1);
    let stopped = refined(&status, "cam").1.delivered;
    script.hang.store(false, Ordering::SeqCst);
    // The thread that hung comes back now, and must not be heard.
    let mut newest = 0;
    let status = wait_until(&rig, "back", |s| {
        while let Some(frame) = out.try_next().unwrap() {
            assert_ne!(frame.header().step_ns(StageStep::Infer), HUNG_NS, "it was given up and published");
            newest = frame.header().sequence;
        }
        refined(s, "cam").1.delivered > stopped + 5
    });
    assert!(newest > stopped + 5, "{newest}");
    assert_balanced_live(&status);
    script.hang.store(true, Ordering::SeqCst);
    std::thread::sleep(Duration::from_millis(50));
    let began = HostTime::now();
    let summary = rig.stop();
    assert!(began.elapsed() < Duration::from_secs(5), "{:?}", began.elapsed());
    script.hang.store(false, Ordering::SeqCst);
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
}

#[test]
fn an_engine_that_hangs_while_it_opens_has_no_pair_to_lose() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let rig = start(&home, &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0"), &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    script.hang_open.store(true, Ordering::SeqCst);
    script.failing.store(1, Ordering::SeqCst);
    wait_until(&rig, "opening", |s| {
        script.opened.load(Ordering::SeqCst) == 2 && refined(s, "cam").0.state == RefineState::Starting
    });
    let began = HostTime::now();
    let summary = rig.stop();
    assert!(began.elapsed() < Duration::from_secs(5), "{:?}", began.elapsed());
    script.hang_open.store(false, Ordering::SeqCst);
    assert_balanced(&summary.status);
    let (state, stream) = refined(&summary.status, "cam");
    assert_eq!((state.skipped.get("hung"), stream.dropped.get("abandoned")), (None, None));
    assert_eq!(state.skipped["engine"], 1);
}

#[test]
fn what_an_engine_refuses_of_one_camera_costs_the_others_nothing() {
    let home = Home::default();
    let script = Arc::new(Script {
        delay_ms: 20.into(),
        batch: 2.into(),
        refused_width: 64.into(),
        ..Script::default()
    });
    let dir = home.path("narrow");
    std::fs::create_dir_all(&dir).unwrap();
    let manifest = depthrig_tests::uncalibrated_camera(&dir, LARGE, LARGE);
    let text = RigText::default().camera("good", "[camera.refine]\nrate_hz = 0").files(
        "bad",
        &manifest,
        "[camera.refine]\nrate_hz = 0\nis_aligned = true",
    );
    let rig = start(&home, &text, &script);
    let status = wait_until(&rig, "one is refined, the other is not", |s| {
        refined(s, "good").1.delivered > 20
            && refined(s, "bad").0.skipped.get("unfit").is_some_and(|n| *n > 20)
    });
    let (state, stream) = refined(&status, "bad");
    assert_eq!((state.state, stream.delivered), (RefineState::Failed, 0));
    assert!(state.message.as_deref().unwrap().contains("64 pixels wide"), "{:?}", state.message);
    assert_eq!(refined(&status, "good").0.state, RefineState::Running);
    assert_eq!(script.largest.load(Ordering::SeqCst), 2, "they were never in one batch");
    script.refused_width.store(0, Ordering::SeqCst);
    let status = wait_until(&rig, "both", |s| refined(s, "bad").1.delivered > 3);
    assert_eq!(refined(&status, "bad").0.state, RefineState::Running);
    assert_eq!(script.opened.load(Ordering::SeqCst), 1, "an engine that works was opened again");
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
    assert_eq!(refined(&summary.status, "good").0.skipped.get("engine"), None);
}

#[test]
fn depth_without_colour_near_it_is_not_refined() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    // Of every three depth frames one has its own colour frame, and the others are 33 ms from any.
    let text = RigText::default().and(
        "[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\nmodel = \"generic\"\ncheap = true\n\
         [camera.refine]\nrate_hz = 0\n\
         [[camera.stream]]\nname = \"color\"\nwidth = 160\nheight = 120\nrate_hz = 10\n\
         [[camera.stream]]\nname = \"depth\"\nwidth = 160\nheight = 120\nrate_hz = 30\n",
    );
    let rig = start(&home, &text, &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    let mut out = bus(&home).subscriber(&"cam/depth_refined".parse().unwrap()).unwrap();
    let mut most = 0;
    for _ in 0..15 {
        let h = *next(&mut out).header();
        let apart = (h.capture_time_ns - h.source_color_capture_time_ns).abs();
        assert!(apart <= 51_000_000, "{apart} ns: more than half a colour period and a millisecond");
        most = most.max(apart);
    }
    assert!(most > 20_000_000, "only those of one moment are pairs: {most} ns");
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
    let (state, stream) = refined(&summary.status, "cam");
    println!("{} refined, {:?}", stream.delivered, state.skipped);
    assert_eq!(stream.dropped["incomplete"], state.skipped["no_color"]);
    assert!(state.skipped["no_color"] >= stream.delivered / 4, "{:?}", state.skipped);
}

/// As [`assert_balanced`], of the refined stream of a rig that runs.
fn assert_balanced_live(status: &RigStatus) {
    let stream = refined(status, "cam").1;
    assert_eq!(stream.captured, stream.delivered + stream.dropped.values().sum::<u64>());
}

#[test]
fn cameras_share_an_engine_in_turn_and_in_batches() {
    for batch in [1, 3] {
        let home = Home::default();
        let script = Arc::new(Script { delay_ms: 40.into(), batch: batch.into(), ..Script::default() });
        let refine = "[camera.refine]\nrate_hz = 0";
        let text = RigText::default().camera("a", refine).camera("b", refine).camera("c", refine);
        let rig = start(&home, &text, &script);
        let counts = |s: &RigStatus| ["a", "b", "c"].map(|n| refined(s, n).1.delivered);
        // They do not begin together.
        let before = counts(&wait_until(&rig, "each", |s| counts(s).iter().all(|n| *n >= 1)));
        let since = |s: &RigStatus| [0, 1, 2].map(|i| counts(s)[i] - before[i]);
        wait_until(&rig, "all", |s| {
            since(s).iter().all(|n| *n >= 10) && script.largest.load(Ordering::SeqCst) >= batch
        });
        let summary = rig.stop();
        let counts = since(&summary.status);
        let least = counts.iter().min().unwrap();
        let most = counts.iter().max().unwrap();
        assert!(*most <= 2 * *least, "not in turn: {counts:?}");
        assert_eq!(script.opened.load(Ordering::SeqCst), 1, "one engine for all of them");
        assert_eq!(script.largest.load(Ordering::SeqCst), batch);
        assert_balanced(&summary.status);
        assert_captured_everything(&summary.status);
    }
}

#[test]
fn two_engines_on_one_device_where_only_one_fits() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let one = "[camera.refine]\nrate_hz = 0\ndevice = \"cuda:0\"\ninput_size = 252";
    let text = RigText::default().camera("a", "[camera.refine]\nrate_hz = 0").camera("b", one);
    // The first that opens gets the memory.
    let refiners = OneFits(Arc::clone(&script), AtomicBool::new(false));
    let rig = home.start_with(text.text(), |o| o.refiners = Some(Arc::new(refiners))).unwrap();
    let status = wait_until(&rig, "one runs and one fails", |s| {
        let states = ["a", "b"].map(|n| refined(s, n).0.state);
        states.contains(&RefineState::Running) && states.contains(&RefineState::Failed)
    });
    let failed = ["a", "b"].into_iter().find(|n| refined(&status, n).0.state == RefineState::Failed).unwrap();
    assert!(refined(&status, failed).0.message.as_deref().unwrap().contains("no memory left"));
    let summary = rig.stop();
    assert!(
        summary.lost.iter().any(|l| l.contains(failed) && l.contains("no memory left")),
        "{:?}",
        summary.lost
    );
    assert_captured_everything(&summary.status);
}

struct OneFits(Arc<Script>, AtomicBool);

impl Refiners for OneFits {
    fn plan(&self, config: &RefineConfig, device_model: &str) -> Plan {
        Scripted(Arc::clone(&self.0)).plan(config, device_model)
    }

    fn open(&self, plan: &Plan, threads: usize) -> Result<Opened> {
        if self.1.swap(true, Ordering::SeqCst) {
            return Err(Error::new(ErrorKind::OutOfMemory, "the device has no memory left"));
        }
        Scripted(Arc::clone(&self.0)).open(plan, threads)
    }
}

#[test]
fn a_reader_that_holds_its_frames_costs_nobody_anything() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let rig = start(&home, &RigText::default().camera("cam", "[camera.refine]\nrate_hz = 0"), &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    let bus = bus(&home);
    let id = "cam/depth_refined".parse().unwrap();
    // One that never reads, and one that holds all it may.
    let _silent = bus.subscriber(&id).unwrap();
    let mut greedy = bus.subscriber(&id).unwrap();
    let held: Vec<_> = (0..16).map(|_| next(&mut greedy)).collect();
    let before = refined(&rig.control().status(), "cam").1.delivered;
    wait_until(&rig, "it goes on", |s| refined(s, "cam").1.delivered > before + 40);
    assert!(held.windows(2).all(|w| w[0].header().sequence < w[1].header().sequence));
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);
    assert!(!refined(&summary.status, "cam").1.dropped.contains_key("no_slot"));
}

#[test]
fn depth_that_cannot_be_registered_is_reported_and_the_raw_streams_go_on() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let table = "uncalibrated";
    let dir = home.path(table);
    std::fs::create_dir_all(&dir).unwrap();
    let manifest = depthrig_tests::uncalibrated_camera(&dir, LARGE, SMALL);
    let text = RigText::default().files("cam", &manifest, "[camera.refine]\nrate_hz = 0");
    let rig = start(&home, &text, &script);
    let status = wait_until(&rig, "failed", |s| refined(s, "cam").0.state == RefineState::Failed);
    let message = refined(&status, "cam").0.message.clone().unwrap();
    assert!(
        message.contains("depth is 32x24 and colour 64x48") && message.contains("neither has a calibration"),
        "{message}"
    );
    assert!(!message.contains("is_aligned"), "that would not help here: {message}");
    let status = wait_until(&rig, "some more", |s| refined(s, "cam").1.captured > 5);
    assert_eq!(refined(&status, "cam").1.delivered, 0);
    let summary = rig.stop();
    assert_balanced(&summary.status);
    assert_captured_everything(&summary.status);

    // Of one size the camera may be believed.
    let dir = home.path("one_size");
    std::fs::create_dir_all(&dir).unwrap();
    let manifest = depthrig_tests::uncalibrated_camera(&dir, LARGE, LARGE);
    let text = RigText::default().files("cam", &manifest, "[camera.refine]\nrate_hz = 0");
    let rig = start(&home, &text, &script);
    let status = wait_until(&rig, "failed", |s| refined(s, "cam").0.state == RefineState::Failed);
    let message = refined(&status, "cam").0.message.clone().unwrap();
    assert!(message.contains("is_aligned = true"), "{message}");
    drop(rig);
    let text = RigText::default().files("cam", &manifest, "[camera.refine]\nrate_hz = 0\nis_aligned = true");
    let rig = start(&home, &text, &script);
    wait_until(&rig, "refined", |s| refined(s, "cam").1.delivered > 3);
    // The first row has no depth, the second is saturated: neither gets a value.
    let frame = next(&mut bus(&home).subscriber(&"cam/depth_refined".parse().unwrap()).unwrap());
    assert!(frame.pixels()[..64 * 2 * 2].iter().all(|b| *b == 0));
    assert!(frame.pixels()[64 * 2 * 2..].iter().any(|b| *b != 0));
}

#[test]
fn refined_depth_is_recorded_with_the_depth_that_it_is_made_of() {
    let home = Home::default();
    let script = Arc::new(Script { delay_ms: 60.into(), ..Script::default() });
    let text = RigText::default().camera("cam", "[camera.refine]\nrecord = true").camera("other", "");
    let rig = start(&home, &text, &script);
    wait_until(&rig, "running", |s| all_stream(s) && refined(s, "cam").1.delivered > 3);
    let control = rig.control();
    let request = depthrig_daemon::control::RecordRequest {
        directory: Some(home.path("")),
        name: Some("made".into()),
        force: true,
        ..<_>::default()
    };
    control.record_start(&request).unwrap();
    wait_until(&rig, "some sets", |s| s.recording.as_ref().is_some_and(|r| r.sets >= 17));
    control.record_stop().unwrap();
    let summary = rig.stop();
    assert_balanced(&summary.status);
    let dataset = home.path("made");
    let report = depthrig_recorder::verify(
        &dataset,
        &depthrig_recorder::VerifyOptions { decode: true, ..<_>::default() },
    )
    .unwrap();
    // What a busy computer lost live is noted.
    let noted = |f: &Finding| f.severity == Severity::Note && f.message.contains("were lost live");
    assert!(report.findings.iter().all(noted), "{:#?}", report.findings);
    let opened = depthrig_recorder::Dataset::open(&dataset).unwrap();
    let streams = &opened.session().streams;
    let at = |name: &str| streams.iter().position(|s| s.id.to_string() == name).unwrap();
    let depth = at("cam/depth");
    let made = at("cam/depth_refined");
    let mut sets = 0;
    let mut whole = 0;
    let mut own = 0;
    for set in opened.sets(depthrig_recorder::SetRange::ALL) {
        let set = set.unwrap();
        sets += 1;
        let find = |stream| set.frames.iter().find(|f| f.stream == stream);
        let (Some(raw), Some(refined)) = (find(depth), find(made)) else {
            assert!(set.missing.contains(&depth) || set.missing.contains(&made), "set {}", set.id);
            continue;
        };
        whole += 1;
        let r = refined.header;
        let d = raw.header;
        assert!((r.capture_time_ns - d.capture_time_ns).abs() < 90_000_000);
        own += usize::from(r.capture_time_ns == d.capture_time_ns);
        assert_eq!((r.refiner(), r.has(FrameFlags::DERIVED)), ("fake 1.0", true));
    }
    // A busy computer may be late with either.
    assert!(sets >= 17 && 2 * whole >= sets, "{whole} of {sets} sets have refined depth");
    assert!(2 * own > whole, "{own} of {whole} are of the set's own depth frame");
}

#[test]
fn a_recording_goes_on_at_once_when_the_engine_does_not() {
    let home = Home::default();
    let script = Arc::new(Script::default());
    let text = RigText::default().camera("cam", "[camera.refine]\nrecord = true");
    let rig = start(&home, &text, &script);
    wait_until(&rig, "running", |s| refined(s, "cam").1.delivered > 3);
    script.closed.store(usize::MAX, Ordering::SeqCst);
    script.failing.store(1, Ordering::SeqCst);
    wait_until(&rig, "failed", |s| refined(s, "cam").0.state == RefineState::Failed);
    let control = rig.control();
    let request = depthrig_daemon::control::RecordRequest {
        directory: Some(home.path("")),
        name: Some("bare".into()),
        force: true,
        ..<_>::default()
    };
    let before = control.status().sets.sent;
    control.record_start(&request).unwrap();
    // How many sets are on their way to the recorder when they are fewest, once as many wait as ever do.
    let mut waiting = u64::MAX;
    wait_until(&rig, "some sets", |s| {
        let written = s.recording.as_ref().map_or(0, |r| r.sets);
        if s.sets.sent - before > 6 {
            waiting = waiting.min((s.sets.sent - before).saturating_sub(written));
        }
        written >= 12
    });
    assert!(waiting <= 1, "{waiting} sets waited for depth that does not come");
    control.record_stop().unwrap();
    let summary = rig.stop();
    assert_captured_everything(&summary.status);
    let opened = depthrig_recorder::Dataset::open(&home.path("bare")).unwrap();
    let streams = &opened.session().streams;
    let made = streams.iter().position(|s| s.id.to_string() == "cam/depth_refined").unwrap();
    let sets: Vec<_> = opened.sets(depthrig_recorder::SetRange::ALL).map(Result::unwrap).collect();
    for set in &sets {
        assert_eq!(set.frames.len() + set.missing.len(), streams.len(), "set {}", set.id);
        assert!(set.frames.iter().all(|f| f.stream != made), "set {}", set.id);
    }
    // A busy computer may be late with a frame of either.
    let complete = sets.iter().filter(|s| s.frames.len() == 2).count();
    assert!(2 * complete >= sets.len(), "{complete} of {} sets are complete", sets.len());
}
