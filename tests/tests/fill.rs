//! `fill` against raw depth, on every simulated camera: its promises without an installed model.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_cdm::metrics::{Depth, DepthRange, compare};
use depthrig_cdm::{Color, ColorFormat, FillRefiner, Job, Output, RawDepth, Refiner, StepTimes};
use depthrig_tests::scene::{MODELS, Size, places, shoot};

/// Strict measures: a pixel without depth counts as 0 m. L1 shrinks in every image. RMSE does in the mean of a camera's
/// images; it weighs the few large errors that filling makes, and grew in 4 of these 42 images, by a tenth at the
/// most (D435, L515). `tests/examples/fill.rs` prints all there is to say.
#[test]
fn filled_depth_is_nearer_to_the_truth_than_raw_for_stereo_and_time_of_flight() {
    let range = DepthRange { min_m: 0.1, max_m: 6.0 };
    let cache = depthrig_sim::synthetic::default_cache_dir();
    let mut refiner = FillRefiner::new(1).unwrap();
    for (model, size) in MODELS.iter().flat_map(|m| [(*m, Size::Small), (*m, Size::Default)]) {
        let mut rmse_m = [0.0; 2];
        for place in places() {
            let scene = shoot(model, size, place, &cache);
            let (width, height) = scene.size;
            let unit_m = scene.unit_m;
            let mut filled = vec![0; scene.raw.len()];
            let job = Job {
                color: Color {
                    pixels: &scene.color,
                    format: ColorFormat::Rgb8,
                    width,
                    height,
                    stride: 3 * width,
                },
                depth: RawDepth { pixels: &scene.raw, unit_m },
                out: Output::Units { pixels: &mut filled, unit_m },
                steps: StepTimes::default(),
            };
            refiner.refine(&mut [job]).unwrap();
            let truth = Depth::Units { pixels: &scene.truth, unit_m };
            let measure = |pixels| compare(&Depth::Units { pixels, unit_m }, &truth, range).unwrap();
            let raw = measure(&scene.raw);
            let fill = measure(&filled);
            let what = format!("{model} {size:?}: {raw:?} raw, {fill:?} filled");
            assert!(fill.strict_l1_m < raw.strict_l1_m, "{what}");
            assert!(fill.strict_rmse_m < 1.15 * raw.strict_rmse_m, "{what}");
            rmse_m = [rmse_m[0] + raw.strict_rmse_m / 3.0, rmse_m[1] + fill.strict_rmse_m / 3.0];
        }
        assert!(rmse_m[1] < rmse_m[0], "{model} {size:?}: RMSE {rmse_m:?} m");
    }
}
