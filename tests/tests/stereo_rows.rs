//! Measures the row offset between left and right images: of a real pair, and of synthetic ones, some without texture.
//!
//! Missing real images make their test fail: `DEPTHRIG_TEST_DATA` names the folder that holds them.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_calib::RowCorrector;
use depthrig_calib::stereo::{DisparityMap, Matcher, Parameters, Preset, RowCheck, RowOffset, SgmMatcher};
use depthrig_tests::pairs::{Pair, Size, seen, seen_apart, smooth, stripe};
use proptest::prelude::*;

const SIZES: [Size; 2] = [(192, 108), (420, 236)];

fn measured(pairs: &[Pair]) -> Option<RowOffset> {
    let (w, h) = pairs[0].size;
    let mut check = RowCheck::new(w, h);
    for pair in pairs {
        check.look(&pair.pair()).unwrap();
    }
    check.offset()
}

/// The pair with its right image `by` rows lower and with another brightness and contrast.
fn lowered(pair: &Pair, by: f64) -> Pair {
    let (w, h) = pair.size;
    let right = &pair.images[1];
    let at = |x: usize, y: f64| f64::from(right[y.clamp(0.0, h as f64 - 1.0) as usize * w + x]);
    let pixel = |i: usize| {
        let from = (i / w) as f64 - by;
        let below = from.floor();
        let part = from - from.floor();
        let value = at(i % w, below) * (1.0 - part) + at(i % w, below + 1.0) * part;
        (0.7 * value + 20.0).round() as u8
    };
    let name = format!("{}, {by} rows lower", pair.name);
    Pair { name, size: pair.size, images: [pair.images[0].clone(), (0..w * h).map(pixel).collect()] }
}

/// Smallest images that are used have a seventh of the places.
#[test]
fn the_real_pair_is_measured_in_every_size() {
    for parts in [1, 2, 3, 4] {
        let aloe = Pair::aloe(parts);
        let good = measured(std::slice::from_ref(&aloe)).expect(&aloe.name);
        assert!(!good.is_bad() && good.overall_px() < 0.15, "{}: {good}", aloe.name);
        assert!(good.warning(true).is_none() && good.unsure_px[0] < 0.1, "{}: {good}", aloe.name);
        for by in [-5.0, -1.5, 0.75, 2.0, 5.5] {
            let low = lowered(&aloe, by);
            let found = measured(std::slice::from_ref(&low)).expect(&low.name);
            // The pair itself is good to a tenth.
            assert!((found.middle_px - by).abs() < found.unsure_px[0] + 0.1, "{}: {found}", low.name);
            assert!(found.is_bad(), "{}: {found}", low.name);
        }
    }
}

/// A landscape with hills of disparity.
fn hills(size: Size, seed: u64, rows: &dyn Fn(f64, f64) -> f64) -> Pair {
    let s = size.0 as f64 / 192.0;
    let hills = move |x: f64, y: f64| s * (6.0 + 12.0 * smooth(x / 60.0 / s, y / 60.0 / s, seed ^ 5));
    let bright =
        move |x: f64, y: f64| 0.8 * smooth(x / 3.5, y / 3.5, seed) + 0.2 * smooth(x / 9.0, y / 9.0, seed + 1);
    seen_apart(format!("hills {seed}, {size:?}"), size, &hills, rows, &bright)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, failure_persistence: None, ..<_>::default() })]

    /// The plane that was put in comes out within the stated uncertainty, also of a slope that was too small to be shown:
    /// of 9000 numbers the worst was off by less than 0.8 of it.
    #[test]
    fn what_was_put_in_comes_out(
        middle in -4.0..4.0_f64,
        across in -3.0..3.0_f64,
        down in -2.0..2.0_f64,
        flat in any::<bool>(),
        large in any::<bool>(),
        seed in 0..1000_u64,
    ) {
        let size = SIZES[usize::from(large)];
        let (across, down) = if flat { (0.0, 0.0) } else { (across, down) };
        let plane = |x: f64, y: f64| middle + across * (x / size.0 as f64 - 0.5) + down * (y / size.1 as f64 - 0.5);
        let pairs = [0, 1, 2].map(|n| hills(size, 3 * seed + n, &plane));
        let found = measured(&pairs).unwrap();
        let wanted = [middle, across, down];
        for ((found_px, unsure), wanted) in
            [found.middle_px, found.across_px, found.down_px].into_iter().zip(found.unsure_px).zip(wanted)
        {
            prop_assert!((found_px - wanted).abs() < unsure, "{found}, {:?} is not {:?}", found, (middle, across, down));
            prop_assert!(unsure < 0.25, "{found}");
        }
        let truth = (middle * middle + (across * across + down * down) / 12.0).sqrt();
        prop_assert!(truth < 0.65 || found.is_bad(), "{truth} passes: {found}");
        prop_assert!(truth > 0.35 || !found.is_bad(), "{truth} alarms: {found}");
        prop_assert_eq!(found.pairs, 3);
    }
}

/// The share of pixels whose disparity is not that of the hills within half a pixel, or missing.
fn wrong(pair: &Pair, seed: u64) -> f64 {
    let (w, h) = pair.size;
    let parameters = Parameters::preset(Preset::Quality, 64);
    let mut out = DisparityMap::default();
    SgmMatcher::new(w, h, &parameters, 1).unwrap().run(&pair.pair(), &mut out).unwrap();
    let s = w as f64 / 192.0;
    let truth = |i: usize| {
        let x = (i % w) as f64;
        let y = (i / w) as f64;
        s * (6.0 + 12.0 * smooth(x / 60.0 / s, y / 60.0 / s, seed ^ 5))
    };
    // Not what lies left of the right image, nor the rows that moved in.
    let counts = |i: &usize| (i % w) as f64 > 20.0 * s && (6..h - 6).contains(&(i / w));
    let all: Vec<usize> = (0..w * h).filter(counts).collect();
    // No disparity is NaN, which is within no distance.
    let good = |i: &&usize| (f64::from(out.disparity[**i]) - truth(**i)).abs() <= 0.5;
    1.0 - all.iter().filter(good).count() as f64 / all.len() as f64
}

/// After the correction no offset is left, and disparities are nearly those of aligned rows.
#[test]
fn a_measured_offset_is_corrected() {
    let size = SIZES[1];
    let w = size.0 as f64;
    let h = size.1 as f64;
    let seed = 7;
    let agrees = wrong(&hills(size, seed, &|_, _| 0.0), seed);
    for (middle, across, down) in [(1.0, 0.0, 0.0), (-1.5, 0.0, 0.0), (0.8, 1.5, -1.0)] {
        let case = format!("{middle} {across} {down}");
        let plane = |x: f64, y: f64| middle + across * (x / w - 0.5) + down * (y / h - 0.5);
        let mut pair = hills(size, seed, &plane);
        let offset = measured(std::slice::from_ref(&pair)).expect(&case);
        assert!(offset.is_significant(), "{case}: {offset}");
        let apart = wrong(&pair, seed);
        let corrector = RowCorrector::new(size.0 as u32, size.1 as u32, &offset).unwrap();
        let mut moved = Vec::new();
        corrector.correct(&pair.pair().right, &mut moved).unwrap();
        pair.images[1] = moved;
        let rest = measured(std::slice::from_ref(&pair)).expect(&case);
        assert!(!rest.is_significant() && rest.overall_px() < 0.15, "{case}: {rest}");
        let corrected = wrong(&pair, seed);
        assert!(apart > 2.0 * agrees, "{case}: {apart:.4} apart, {agrees:.4} without");
        assert!(corrected < 1.2 * agrees, "{case}: {corrected:.4} corrected, {agrees:.4} without");
    }
}

/// No offset is reported, or an acceptable one.
#[track_caller]
fn assert_no_alarm(pair: Pair) {
    let name = pair.name.clone();
    // The same twice: a scene that stands still.
    let again = Pair { name: String::new(), size: pair.size, images: pair.images.clone() };
    if let Some(found) = measured(&[pair, again]) {
        assert!(!found.is_bad(), "{name}: {found}");
    }
}

#[test]
fn images_without_texture_raise_no_alarm() {
    for size in SIZES {
        let w = size.0 as f64;
        let h = size.1 as f64;
        let s = size.0 as f64 / 192.0;
        let one = |name: &str, d: f64, bright: &dyn Fn(f64, f64) -> f64| {
            let pair = seen(format!("{name}, {size:?}"), size, &|_, _| d, bright);
            assert_eq!(measured(std::slice::from_ref(&pair)), None, "{}", pair.name);
            assert_no_alarm(pair);
        };
        one("grey", 12.0 * s, &|_, _| 0.4);
        one("a slope", 12.0 * s, &|x, y| 0.2 + 0.6 * x / w + 0.05 * y / h);
        one("a vignette", 0.0, &|x, y| 0.8 - 0.5 * ((x / w - 0.5).powi(2) + (y / h - 0.5).powi(2)));
        one("rows", 12.0 * s, &|_, y| stripe(y / 9.0 / s));
        one("columns", 12.0 * s, &|x, _| smooth(x / 3.0, 0.0, 7));
        one("slanted lines", 12.0 * s, &|x, y| smooth((x + 0.4 * y) / 3.0, 0.0, 7));
        // One object in a corner is not enough for the rest.
        one("a corner", 12.0 * s, &|x, y| {
            if x < w / 5.0 && y < h / 5.0 { smooth(x / 3.0, y / 3.0, 4) } else { 0.5 }
        });
        // Two cameras that look at different things.
        let scene = |seed| {
            seen(format!("two things, {size:?}"), size, &|_, _| 0.0, &|x, y| smooth(x / 4.0, y / 4.0, seed))
        };
        let mut two = scene(9);
        let other = scene(10);
        two.images[1].clone_from(&other.images[1]);
        assert_no_alarm(two);
        assert_no_alarm(seen(format!("too near, {size:?}"), size, &|_, _| 140.0 * s, &|x, y| {
            smooth(x / 3.0, y / 3.0, 9)
        }));
        assert_no_alarm(seen(format!("far away, {size:?}"), size, &|_, _| 0.3, &|x, y| {
            smooth(x / 3.0, y / 3.0, 9)
        }));
    }
}

/// Of what repeats, the next one up or down may look nearer to where it should be than the right one.
#[test]
fn repeated_patterns_raise_no_alarm() {
    for size in SIZES {
        let s = size.0 as f64 / 192.0;
        for d in [4.0, 14.0, 40.0] {
            for period in [5.0, 9.0, 16.0, 28.0] {
                let d = d * s;
                let p = period * s;
                let one = |name: &str, bright: &dyn Fn(f64, f64) -> f64| {
                    assert_no_alarm(seen(
                        format!("{name} of period {p:.1} at {d:.1}, {size:?}"),
                        size,
                        &|_, _| d,
                        bright,
                    ));
                };
                one("stripes", &|x, _| stripe(x / p));
                one("checks", &|x, y| if stripe(x / p) > 0.5 { stripe(y / p) } else { 1.0 - stripe(y / p) });
                one("wallpaper", &|x, y| smooth((x.rem_euclid(p) / s * 2.0).floor(), y / 3.0, 5));
                one("wallpaper downwards", &|x, y| smooth(x / 3.0, (y.rem_euclid(p) / s * 2.0).floor(), 5));
                // Each row of bricks begins half a brick further.
                one("bricks", &|x, y| {
                    let row = (y / p).floor();
                    let u = (x / p / 2.0 + 0.5 * row).rem_euclid(1.0);
                    let v = (y / p).rem_euclid(1.0);
                    if u < 0.1 || v < 0.2 { 0.9 } else { 0.3 }
                });
                // The same of everything, in both directions and slanted.
                one("tiles with an image", &|x, y| {
                    let u = (x + 0.3 * y).rem_euclid(p);
                    let v = y.rem_euclid(p);
                    smooth(u / s, v / s, 11)
                });
            }
        }
    }
}
