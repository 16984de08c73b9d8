//! Prints how good the depth of the simulated cameras is, raw and filled, and writes images of it.
//!
//! `cargo run --release -p depthrig-tests --example fill [-- FOLDER [MODEL...]]`; without a folder no images are written.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)] // a measuring program: any failure ends it

use depthrig_cdm::metrics::{Dataset, Depth, DepthRange, Measured, Rules};
use depthrig_cdm::{Color, ColorFormat, FillRefiner, Job, Output, RawDepth, Refiner, StepTimes};
use depthrig_tests::scene::{MODELS, Scene, Size, places, shoot};
use std::path::{Path, PathBuf};

const RANGE: DepthRange = DepthRange { min_m: 0.1, max_m: 6.0 };
const RULES: Rules = Rules { range: RANGE, bin_m: 0.25, bins: 16, skip_not_finite: false };

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let folder = args.first().map(PathBuf::from);
    let models: Vec<&str> =
        if args.len() > 1 { args[1..].iter().map(String::as_str).collect() } else { MODELS.to_vec() };
    let cache = depthrig_sim::synthetic::default_cache_dir();
    let mut refiner = FillRefiner::new(1).unwrap();
    println!(
        "model   depth  strict: L1 m  RMSE m  AbsRel   d0.5     d1 | plain: L1 m  RMSE m  AbsRel   d0.5     d1 | filled % | where raw has depth: L1 m  better %  worse %   CPU ms (steps on the wall clock)"
    );
    for model in models {
        let mut raw_set = Dataset::new(RANGE);
        let mut fill_set = Dataset::new(RANGE);
        let mut raw_all = Measured::nothing();
        let mut fill_all = Measured::nothing();
        let mut best = u64::MAX;
        let mut same = SameSpots::default();
        let mut steps = StepTimes::default();
        for (i, place) in places().into_iter().enumerate() {
            let scene = shoot(model, Size::Default, place, &cache);
            let mut filled = vec![0u16; scene.raw.len()];
            for _ in 0..15 {
                let mut job = job(&scene, &mut filled);
                let began = thread_ns();
                refiner.refine(core::slice::from_mut(&mut job)).unwrap();
                let took = thread_ns() - began;
                if took < best {
                    (best, steps) = (took, job.steps);
                }
            }
            for (pixels, set, all) in
                [(&scene.raw, &mut raw_set, &mut raw_all), (&filled, &mut fill_set, &mut fill_all)]
            {
                let unit_m = scene.unit_m;
                let p = Depth::Units { pixels, unit_m };
                let t = Depth::Units { pixels: &scene.truth, unit_m };
                let m = Measured::of(&p, &t, None, &RULES).unwrap();
                set.push(&m);
                all.plus(&m);
            }
            same.add(&scene, &filled);
            if let Some(folder) = &folder {
                images(folder, &format!("{model}-{i}"), &scene, &filled);
            }
        }
        for (name, set, all) in [("raw", &raw_set, &raw_all), ("fill", &fill_set, &fill_all)] {
            let m = set.metrics().mean_of_images;
            print!(
                "{model:7} {name:5}  {:12.4}  {:6.4}  {:6.4}  {:5.4} {:6.4}",
                m.strict_l1_m, m.strict_rmse_m, m.strict_abs_rel, m.strict_delta_05, m.strict_delta_1
            );
            print!(
                " | {:11.4}  {:6.4}  {:6.4}  {:5.4} {:6.4} | {:8.2}",
                m.l1_m,
                m.rmse_m,
                m.abs_rel,
                m.delta_05,
                m.delta_1,
                100.0 * all.fill_rate()
            );
            let n = same.pixels as f64;
            if name == "raw" {
                println!(" | {:26.4}", same.raw_m / n);
            } else {
                println!(
                    " | {:26.4}  {:8.2} {:8.2} {:4.1} ({:.1} {:.1} {:.1})",
                    same.fill_m / n,
                    100.0 * same.better as f64 / n,
                    100.0 * same.worse as f64 / n,
                    best as f64 / 1e6,
                    steps.prepare_ns as f64 / 1e6,
                    steps.infer_ns as f64 / 1e6,
                    steps.finish_ns as f64 / 1e6
                );
            }
        }
        if folder.is_some() {
            for (a, b) in raw_all
                .by_distance(&RULES)
                .iter()
                .zip(fill_all.by_distance(&RULES))
                .filter(|(a, _)| a.metrics.counted > 0)
            {
                println!(
                    "    {:.2}..{:.2} m: strict L1 {:.4} -> {:.4}, plain L1 {:.4} -> {:.4}",
                    a.from_m,
                    a.to_m,
                    a.metrics.strict_l1_m,
                    b.metrics.strict_l1_m,
                    a.metrics.l1_m,
                    b.metrics.l1_m
                );
            }
        }
    }
}

/// Where raw depth has a value: what filling did to it.
#[derive(Default)]
struct SameSpots {
    pixels: u64,
    raw_m: f64,
    fill_m: f64,
    /// Pixels whose error shrank, and grew, by more than 5 mm.
    better: u64,
    worse: u64,
}

impl SameSpots {
    fn add(&mut self, scene: &Scene, filled: &[u16]) {
        for ((raw, fill), truth) in scene.raw.iter().zip(filled).zip(&scene.truth) {
            if *raw > 0 && *truth > 0 && *fill > 0 {
                let error = |d: u16| (f64::from(d) - f64::from(*truth)).abs() * scene.unit_m;
                let a = error(*raw);
                let b = error(*fill);
                self.pixels += 1;
                self.raw_m += a;
                self.fill_m += b;
                self.better += u64::from(b < a - 0.005);
                self.worse += u64::from(b > a + 0.005);
            }
        }
    }
}

/// Time that this thread has had on a processor, nanoseconds: other programs do not count.
fn thread_ns() -> u64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
    text.split(' ').next().unwrap().parse().unwrap()
}

fn job<'a>(scene: &'a Scene, out: &'a mut [u16]) -> Job<'a> {
    let (width, height) = scene.size;
    Job {
        color: Color { pixels: &scene.color, format: ColorFormat::Rgb8, width, height, stride: 3 * width },
        depth: RawDepth { pixels: &scene.raw, unit_m: scene.unit_m },
        out: Output::Units { pixels: out, unit_m: scene.unit_m },
        steps: StepTimes::default(),
    }
}

/// Colour, raw, filled and true depth, and the errors of both, on one sheet.
fn images(folder: &Path, name: &str, scene: &Scene, filled: &[u16]) {
    let (w, h) = scene.size;
    let mut sheet = image::RgbImage::new(2 * w as u32, 3 * h as u32);
    let depth = |d: u16| {
        if d == 0 {
            return [0; 3];
        }
        let t = ((1.0 / (f64::from(d) * scene.unit_m) - 0.25) / 2.5).clamp(0.0, 1.0);
        [(255.0 * t) as u8, (255.0 * (1.0 - (2.0 * t - 1.0).abs())) as u8, (255.0 * (1.0 - t)) as u8]
    };
    let error = |d: u16, truth: u16| {
        if d == 0 {
            return [60, 60, 90];
        }
        // Red: too far, blue: too near; white 0, full colour 0.1 m.
        let e = ((f64::from(d) - f64::from(truth)) * scene.unit_m / 0.1).clamp(-1.0, 1.0);
        let pale = (255.0 * (1.0 - e.abs())) as u8;
        if e > 0.0 { [255, pale, pale] } else { [pale, pale, 255] }
    };
    for (i, filled) in filled.iter().enumerate() {
        let x = (i % w) as u32;
        let y = (i / w) as u32;
        let c = [scene.color[3 * i], scene.color[3 * i + 1], scene.color[3 * i + 2]];
        let w = w as u32;
        let h = h as u32;
        sheet.put_pixel(x, y, image::Rgb(c));
        sheet.put_pixel(x + w, y, image::Rgb(depth(scene.truth[i])));
        sheet.put_pixel(x, y + h, image::Rgb(depth(scene.raw[i])));
        sheet.put_pixel(x + w, y + h, image::Rgb(depth(*filled)));
        sheet.put_pixel(x, y + 2 * h, image::Rgb(error(scene.raw[i], scene.truth[i])));
        sheet.put_pixel(x + w, y + 2 * h, image::Rgb(error(*filled, scene.truth[i])));
    }
    std::fs::create_dir_all(folder).unwrap();
    sheet.save(folder.join(format!("{name}.png"))).unwrap();
}
