//! Measures the processor time of a pass of `zed replay` against the stereo matching in it.
//!
//! `cargo run --release -p depthrig-tests --example zed_replay_ratio [PAIRS [WIDTH HEIGHT [RUNS [JOBS]]]]`
//!
//! The parts are runs with one mode each, of which only the matching counts. The pass is one run with all three modes, of
//! which everything counts but verifying: reading, rectifying, matching, depth, encoding, writing. Of each the best of
//! RUNS, taken in turns, because other work on the computer makes all of them slower.
//!
//! Exit code 1 when a pass costs more than [`BAR`] times its parts.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::ops::ControlFlow;
use depthrig_calib::stereo::Preset;
use depthrig_convert::zed_replay::{CpuReport, ZedReplayOptions, ZedReplayReport, zed_replay};
use depthrig_stereo::Mode;
use depthrig_tests::synthetic_stereo::SyntheticStereo;
use std::path::Path;

/// The most that a pass may cost, in sums of the parts' matching.
const BAR: f64 = 1.15;

fn replay(dir: &Path, modes: &[Mode], jobs: usize, disparity: bool) -> ZedReplayReport {
    let out = dir.join("out");
    let options = ZedReplayOptions {
        modes: modes.to_vec(),
        jobs,
        disparity,
        // 128 disparities, as docs/stereo.md measures.
        range_m: (0.5, 20.0),
        ..ZedReplayOptions::default()
    };
    let report =
        zed_replay(&dir.join("source"), &out, &options, &mut |_, _, _| ControlFlow::Continue(())).unwrap();
    std::fs::remove_dir_all(&out).unwrap();
    report
}

fn main() {
    let args: Vec<u64> = std::env::args().skip(1).map(|a| a.parse().unwrap()).collect();
    let arg = |i: usize, default: u64| args.get(i).copied().unwrap_or(default);
    let pairs = arg(0, 10);
    let width = arg(1, 1280);
    let height = arg(2, 720);
    let runs = arg(3, 3);
    let jobs = arg(4, 1) as usize;
    let dir = tempfile::tempdir().unwrap();
    let size = (width as u32, height as u32);
    // The ZED 2i's 2.1 mm lens at 720p.
    let focal = 525.0 * width as f64 / 1280.0;
    SyntheticStereo { size, focal, sets: pairs, ..SyntheticStereo::default() }
        .record(&dir.path().join("source"));
    let modes = [Preset::Performance, Preset::Ultra, Preset::Quality].map(Mode::Preset);
    let mut parts = [f64::INFINITY; 3];
    let mut pass = CpuReport { total_s: f64::INFINITY, ..CpuReport::default() };
    let mut memory = 0;
    for _ in 0..runs {
        for (mode, best) in modes.iter().zip(&mut parts) {
            *best = best.min(replay(dir.path(), &[*mode], jobs, false).cpu.stereo_s);
        }
        let all = replay(dir.path(), &modes, jobs, false);
        memory = all.memory_bytes;
        if all.cpu.total_s < pass.total_s {
            pass = all.cpu;
        }
    }
    let ms = |s: f64| s * 1e3 / pairs as f64;
    println!(
        "{pairs} pairs of {width}x{height}, {jobs} jobs of one thread, best of {runs}, processor ms per pair:"
    );
    for (mode, s) in modes.iter().zip(parts) {
        println!("  {mode} alone, matching only      {:8.1}", ms(s));
    }
    let sum: f64 = parts.iter().sum();
    println!("  sum of the parts' matching         {:8.1}", ms(sum));
    println!("  all three in one pass, everything  {:8.1}", ms(pass.total_s));
    println!(
        "    matching {:.1}, reading {:.1}, rectifying {:.1}, depth {:.1}, encoding, writing and the rest {:.1}",
        ms(pass.stereo_s),
        ms(pass.read_s),
        ms(pass.rectify_s),
        ms(pass.depth_s),
        ms(pass.total_s - pass.stereo_s - pass.read_s - pass.rectify_s - pass.depth_s)
    );
    println!("  memory for pairs and matchers      {:8.1} MB", memory as f64 / 1e6);
    let ratio = pass.total_s / sum;
    println!("pass / sum of the parts = {ratio:.3}; at most {BAR}");
    drop(dir);
    if ratio > BAR {
        println!("above the bar");
        std::process::exit(1);
    }
}
