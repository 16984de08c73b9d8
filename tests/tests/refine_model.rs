//! A network in a running rig, from the cameras' images to the refined stream: what it gives, and its model's file that
//! goes away.
//!
//! Its weights are random. It runs in ONNX Runtime where that is installed; `make test` fetches it and sets
//! `DEPTHRIG_REQUIRE_ONNXRUNTIME`, without which these tests say that they were skipped.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, Frame, FrameFlags, RigName, StageStep, Subscriber};
use depthrig_cdm::{
    Color, ColorFormat, Encoder, EngineKind, ErrorKind, Job, Model, Output, Precision, RawDepth,
    RefinerOptions, StepTimes, find_library, refiner, weights,
};
use depthrig_daemon::rig::Rig;
use depthrig_daemon::status::{RefineState, RefineStatus, RigStatus};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, camera, wait_until};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

/// The smallest input that a rig file may ask for.
const INPUT: u32 = 56;

/// Whether the library is installed; prints a line if not, and fails if it is required.
fn has_library() -> bool {
    match find_library(None, "cpu", Precision::Fp32) {
        Ok(_) => true,
        Err(e)
            if e.kind() == ErrorKind::NoEngine
                && std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none() =>
        {
            println!("skipped: {e}");
            false
        }
        Err(e) => panic!("{e}"),
    }
}

/// A file of random weights in `home`, of its own, so that it may be removed. They are made once and kept under `target/`.
fn model(home: &Home) -> PathBuf {
    static MAKING: Mutex<()> = Mutex::new(());
    let _one = MAKING.lock().unwrap_or_else(PoisonError::into_inner);
    let made = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cdm-untrained-vits.safetensors");
    if !made.exists() {
        let unfinished = made.with_extension(format!("{}.part", std::process::id()));
        weights::write_seeded(Encoder::Vits, 1, &unfinished).unwrap();
        std::fs::rename(&unfinished, &made).unwrap();
    }
    let path = home.path("net.safetensors");
    std::fs::hard_link(&made, &path).or_else(|_| std::fs::copy(&made, &path).map(drop)).unwrap();
    path
}

fn refine(engine: &str, model: &Path) -> String {
    let model = model.display();
    format!(
        "[camera.refine]\nengine = \"{engine}\"\nmodel = \"{model}\"\ninput_size = {INPUT}\nrate_hz = 10\nalign = true"
    )
}

/// One thread, with which the network gives the same to the bit every time.
fn start(home: &Home, text: RigText) -> Rig {
    home.start(text.and("[cdm]\nthreads = 1\n").text()).unwrap()
}

fn status_of(status: &RigStatus, name: &str) -> (RefineStatus, u64) {
    let camera = camera(status, name);
    let stream = camera.streams.iter().find(|s| s.id.ends_with("/depth_refined")).unwrap();
    (camera.refine.clone().unwrap(), stream.delivered)
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect()
}

/// Refines two frames with the network, without a rig.
fn expected(path: &Path, color: &Frame, depth: &Frame) -> Vec<u16> {
    let mut refiner = refiner(&RefinerOptions {
        engine: Some(EngineKind::OnnxRuntime),
        model: Some(Model::from_file(path).unwrap()),
        input_size: Some(INPUT),
        threads: 1,
        ..RefinerOptions::default()
    })
    .unwrap();
    let c = color.header();
    let unit_m = depth.header().depth_unit_m;
    let raw = words(depth.pixels());
    let mut out = vec![0; raw.len()];
    let width = c.width as usize;
    let height = c.height as usize;
    let stride = c.stride as usize;
    let color = Color { pixels: color.pixels(), format: ColorFormat::Rgb8, width, height, stride };
    let depth = RawDepth { pixels: &raw, unit_m };
    let to = Output::Units { pixels: &mut out, unit_m };
    refiner.refine(&mut [Job { color, depth, out: to, steps: StepTimes::default() }]).unwrap();
    out
}

fn next(from: &mut Subscriber) -> Frame {
    from.next_timeout(Duration::from_secs(10)).unwrap().expect("a frame within ten seconds")
}

#[test]
fn the_network_refines_what_the_camera_sees_and_outlives_its_file() {
    if !has_library() {
        return;
    }
    let home = Home::default();
    let path = model(&home);
    let rig = start(&home, RigText::default().camera("cam", &refine("onnxruntime", &path)));
    wait_until(&rig, "refined", |s| all_stream(s) && status_of(s, "cam").1 > 1);
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let [mut color, mut aligned, mut out] = ["color", "depth_aligned", "depth_refined"]
        .map(|s| bus.subscriber(&format!("cam/{s}").parse().unwrap()).unwrap());
    let mut colors = Vec::new();
    let mut views = Vec::new();
    let (seen, of) = loop {
        let frame = next(&mut out);
        let h = *frame.header();
        while let Some(f) = color.try_next().unwrap() {
            colors.push(f);
        }
        while let Some(f) = aligned.try_next().unwrap() {
            views.push(f);
        }
        let color = colors.iter().position(|f| f.header().sequence == h.source_color_sequence);
        let view = views.iter().position(|f| f.header().source_sequence == h.source_sequence);
        if let (Some(c), Some(v)) = (color, view) {
            break (frame, (colors.swap_remove(c), views.swap_remove(v)));
        }
        // A subscriber may hold sixteen frames.
        colors.drain(..colors.len().saturating_sub(8));
        views.drain(..views.len().saturating_sub(4));
    };
    let h = seen.header();
    assert!(
        h.refiner().starts_with("onnxruntime 1.") && h.refiner().ends_with(" cpu fp32"),
        "{}",
        h.refiner()
    );
    assert!(h.refiner_model().starts_with("untrained-net@"), "{}", h.refiner_model());
    assert!(h.has(FrameFlags::DERIVED) && h.step_ns(StageStep::Infer) > 0);
    let seen = words(seen.pixels());
    assert!(seen == expected(&path, &of.0, &of.1), "the rig publishes something else than the network gives");
    assert!(seen != words(of.1.pixels()) && seen.iter().any(|z| *z > 0));

    std::fs::remove_file(&path).unwrap();
    let before = status_of(&rig.control().status(), "cam").1;
    let status = wait_until(&rig, "it goes on", |s| status_of(s, "cam").1 > before + 5);
    let (state, _) = status_of(&status, "cam");
    assert_eq!((state.state, state.restarts, state.message), (RefineState::Running, 0, None));
    assert!(state.engine.starts_with("onnxruntime 1.") && state.model.starts_with("untrained-net@"));
    drop((colors, views, of));
    assert_balanced(&rig.stop().status);
}

#[test]
fn a_model_that_is_gone_is_named_and_something_stands_in_only_where_it_may() {
    if !has_library() {
        return;
    }
    let home = Home::default();
    let path = home.path("gone.safetensors");
    let text = RigText::default()
        .camera("strict", &refine("onnxruntime", &path))
        .camera("lenient", &refine("auto", &path));
    let rig = start(&home, text);
    let status = wait_until(&rig, "one failed, one refined", |s| {
        status_of(s, "strict").0.state == RefineState::Failed && status_of(s, "lenient").1 > 3
    });
    let (strict, frames) = status_of(&status, "strict");
    let message = strict.message.unwrap();
    assert!(message.contains("gone.safetensors") && message.contains("tried again"), "{message}");
    assert_eq!(frames, 0);
    let (lenient, _) = status_of(&status, "lenient");
    let message = lenient.message.unwrap();
    assert!(message.starts_with("fill stands in for onnxruntime on cpu with /"), "{message}");
    assert_eq!(
        (lenient.state, lenient.engine.as_str(), lenient.model.as_str()),
        (RefineState::Running, "fill", "")
    );

    // Installed while the rig runs, it is found at the next try.
    std::fs::rename(model(&home), &path).unwrap();
    let status = wait_until(&rig, "back", |s| status_of(s, "strict").1 > 3);
    let (strict, _) = status_of(&status, "strict");
    assert_eq!((strict.state, strict.message), (RefineState::Running, None));
    assert!(strict.model.starts_with("untrained-gone@"), "{}", strict.model);
    let summary = rig.stop();
    assert_balanced(&summary.status);
}
