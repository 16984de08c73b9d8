//! The stereo benchmark: CPU time per pair with each preset, alternating within one run.

use super::bus::report::Bar;
use super::conditions::Conditions;
use crate::commands::stereo::Image;
use crate::out;
use anyhow::Result;
use depthrig_bus::clock::{HostTime, process_cpu_ns};
use depthrig_calib::stereo::{DisparityMap, Matcher, Parameters, Preset, SgmMatcher, StereoPair};
use serde::Serialize;

/// Plan of the measurement.
#[derive(Debug, Clone, Copy)]
pub struct Plan {
    /// Disparities that are searched.
    pub max_disparity: usize,
    /// Threads of a matcher.
    pub threads: usize,
    /// Pairs with each preset, after one that is not counted.
    pub rounds: usize,
}

/// A preset's cost.
#[derive(Debug, Serialize)]
pub struct Cost {
    /// Its name.
    pub preset: &'static str,
    /// CPU time of a pair, all threads together: the best of the rounds.
    pub cpu_ms_best: f64,
    /// The middle of the rounds.
    pub cpu_ms_median: f64,
    /// From call to return, the best of the rounds.
    pub wall_ms_best: f64,
    /// Memory that the matcher keeps allocated.
    pub memory_bytes: u64,
    /// Pixels that got a disparity, percent.
    pub filled_percent: f64,
}

/// Result of the benchmark.
#[derive(Debug, Serialize)]
pub struct StereoReport {
    /// Conditions of the measurement.
    pub conditions: Conditions,
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Disparities.
    pub max_disparity: usize,
    /// Threads.
    pub threads: usize,
    /// Vectors that were used.
    pub vectors: &'static str,
    /// By preset.
    pub costs: Vec<Cost>,
    /// CPU time of quality over that of performance: the median of the ratios inside the rounds.
    pub quality_over_performance: f64,
}

/// Measures every preset.
///
/// # Errors
/// When the images do not fit, or the engine refuses them.
pub fn run(
    left: &Image,
    right: &Image,
    plan: Plan,
    mut on_progress: impl FnMut(&str, u64, u64),
) -> Result<StereoReport> {
    left.fits(right)?;
    let mut conditions = Conditions::now();
    let pair = StereoPair::new(left.gray(), right.gray());
    let width = pair.left.width;
    let height = pair.left.height;
    let mut matchers = Vec::new();
    for preset in Preset::ALL {
        let parameters = Parameters::preset(preset, plan.max_disparity);
        matchers.push(SgmMatcher::new(width, height, &parameters, plan.threads)?);
    }
    let vectors = matchers.first().map_or("", SgmMatcher::form);
    let mut map = DisparityMap::default();
    let mut rounds: Vec<Vec<(f64, f64)>> = vec![Vec::new(); matchers.len()];
    let mut filled = vec![0.0; matchers.len()];
    for round in 0..=plan.rounds {
        on_progress("pairs", round as u64, plan.rounds as u64);
        for (i, matcher) in matchers.iter_mut().enumerate() {
            let cpu = process_cpu_ns();
            let start = HostTime::now();
            matcher.run(&pair, &mut map)?;
            let cpu = process_cpu_ns() - cpu;
            let wall = HostTime::now().since_ns(start);
            filled[i] = 100.0 * map.fill();
            // The first pair touches fresh memory and is not counted.
            if round > 0 {
                rounds[i].push((cpu as f64 / 1e6, wall as f64 / 1e6));
            }
        }
    }
    conditions.finish();
    let best = |v: &[(f64, f64)], f: fn(&(f64, f64)) -> f64| v.iter().map(f).fold(f64::INFINITY, f64::min);
    let costs = matchers.iter().enumerate().map(|(i, matcher)| Cost {
        preset: matcher.parameters().preset.name(),
        cpu_ms_best: best(&rounds[i], |r| r.0),
        cpu_ms_median: median(rounds[i].iter().map(|r| r.0).collect()),
        wall_ms_best: best(&rounds[i], |r| r.1),
        memory_bytes: matcher.describe().memory_bytes,
        filled_percent: filled[i],
    });
    let ratios = rounds[1].iter().zip(&rounds[0]).map(|(quality, performance)| quality.0 / performance.0);
    Ok(StereoReport {
        conditions,
        width,
        height,
        max_disparity: plan.max_disparity,
        threads: plan.threads,
        vectors,
        costs: costs.collect(),
        quality_over_performance: median(ratios.collect()),
    })
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    super::stats::quantile(&values, 0.5).unwrap_or(f64::NAN)
}

/// Promises about stereo; tests/peers/stereo.py compares it with other libraries.
pub fn bars(report: &StereoReport) -> [Bar; 1] {
    [Bar {
        promise: "performance is faster than quality: at least 2.5 times",
        measured: format!("{:.2}", report.quality_over_performance),
        kept: report.quality_over_performance >= 2.5,
    }]
}

/// Formats the report as text.
pub fn text(report: &StereoReport) -> String {
    let rows = report.costs.iter().map(|c| {
        let ms = |v: f64| format!("{v:.1}");
        vec![
            c.preset.to_owned(),
            ms(c.cpu_ms_best),
            ms(c.cpu_ms_median),
            ms(c.wall_ms_best),
            out::bytes(c.memory_bytes),
            format!("{:.1}", c.filled_percent),
        ]
    });
    let head = ["preset", "CPU ms, best", "median", "wall ms, best", "memory", "filled %"];
    let mut lines = vec![
        report.conditions.line(),
        format!(
            "{}x{}, {} disparities, {}, vectors of {}",
            report.width,
            report.height,
            report.max_disparity,
            out::count(report.threads, "thread"),
            report.vectors
        ),
        out::table(&head, 1, rows),
        "\nPromises".to_owned(),
    ];
    lines.extend(bars(report).iter().map(Bar::line));
    lines.join("\n")
}

/// Generates a synthetic pair: noise on planes at several distances, with sensor noise.
pub fn synthetic_pair(width: usize, height: usize, max_disparity: usize) -> [Image; 2] {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    let mut next = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as u8
    };
    let margin = max_disparity + 8;
    // Noise, made smoother along the row, as images are.
    let mut texture: Vec<u8> = (0..(width + margin) * height).map(|_| next()).collect();
    for row in texture.chunks_exact_mut(width + margin) {
        for x in 1..row.len() {
            row[x] = u8::midpoint(row[x], row[x - 1]);
        }
    }
    let shift = |x: usize, y: usize| {
        let tile = (x * 5 / width.max(1)) * 7 + (y * 4 / height.max(1)) * 3;
        max_disparity / 8 + tile % 5 * max_disparity / 8
    };
    let mut right = vec![0; width * height];
    let mut left = vec![0; width * height];
    for y in 0..height {
        for x in 0..width {
            let d = shift(x, y);
            let value = texture[y * (width + margin) + x + margin - d];
            left[y * width + x] = value.saturating_add(next() % 6);
            if x >= d {
                right[y * width + x - d] = value.saturating_add(next() % 6);
            }
        }
    }
    [left, right].map(|pixels| Image::new(pixels, width, height))
}
