//! Detects exchanged left and right images: on a real pair, and on synthetic ones that can mislead.
//!
//! Missing real images make their test fail: `DEPTHRIG_TEST_DATA` names the folder that holds them.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_calib::stereo::{Order, OrderCheck, StereoPair};
use depthrig_tests::pairs::{Pair, Size, seen, smooth, stripe};

/// The order found for a pair as named, and for the same pair exchanged.
fn orders(pair: &Pair) -> [Order; 2] {
    let mut check = OrderCheck::new(pair.size.0, pair.size.1).unwrap();
    let as_named = pair.pair();
    [as_named, StereoPair::new(as_named.right, as_named.left)].map(|pair| check.check(&pair).unwrap())
}

/// Both orders are recognised.
#[track_caller]
fn assert_detected(pair: &Pair) {
    assert_eq!(orders(pair), [Order::AsNamed, Order::Swapped], "{}", pair.name);
}

/// Neither order is taken for the other.
#[track_caller]
fn assert_not_misread(pair: &Pair) {
    let [named, exchanged] = orders(pair);
    assert_ne!(named, Order::Swapped, "{}", pair.name);
    assert_ne!(exchanged, Order::AsNamed, "{}, exchanged", pair.name);
}

const SIZES: [Size; 2] = [(192, 108), (344, 192)];

/// Pixels of a size for each of 192 across.
fn scale((w, _): Size) -> f64 {
    w as f64 / 192.0
}

#[test]
fn the_real_pair_is_recognised_in_every_size() {
    for parts in [1, 2, 3, 4, 8] {
        assert_detected(&Pair::aloe(parts));
    }
}

#[test]
fn texture_is_recognised() {
    for size in SIZES {
        let s = scale(size);
        for (d, spot, contrast) in [(8.0, 3.0, 1.0), (20.0, 3.0, 1.0), (8.0, 3.0, 0.2), (20.0, 12.0, 1.0)] {
            let name = format!("a wall at {d} of spots of {spot}, contrast {contrast}, {size:?}");
            let bright = |x: f64, y: f64| 0.4 + contrast * (smooth(x / spot, y / spot, 1) - 0.5);
            assert_detected(&seen(name, size, &|_, _| d * s, &bright));
        }
        let floor = |_: f64, y: f64| (2.0 + 26.0 * y / size.1 as f64) * s;
        assert_detected(&seen(format!("a floor, {size:?}"), size, &floor, &|x, y| {
            smooth(x / 4.0, y / 4.0, 3)
        }));
        // Three quarters of the image are a plain wall.
        let part = |x: f64, y: f64| if y < size.1 as f64 * 0.75 { 0.5 } else { smooth(x / 3.0, y / 3.0, 4) };
        assert_detected(&seen(format!("a strip of texture, {size:?}"), size, &|_, _| 14.0 * s, &part));
    }
}

#[test]
fn what_has_no_texture_misleads_nobody() {
    for size in SIZES {
        let w = size.0 as f64;
        let h = size.1 as f64;
        let s = scale(size);
        let one = |name: &str, d: f64, bright: &dyn Fn(f64, f64) -> f64| {
            assert_not_misread(&seen(format!("{name}, {size:?}"), size, &|_, _| d, bright));
        };
        one("grey", 12.0 * s, &|_, _| 0.4);
        one("a slope", 12.0 * s, &|x, y| 0.2 + 0.6 * x / w + 0.05 * y / h);
        one("a slope the other way", 12.0 * s, &|x, y| 0.8 - 0.6 * x / w + 0.05 * y / h);
        one("a vignette", 0.0, &|x, y| 0.8 - 0.5 * ((x / w - 0.5).powi(2) + (y / h - 0.5).powi(2)));
        one("rows", 12.0 * s, &|_, y| stripe(y / 9.0 / s));
        one("far away", 0.3, &|x, y| smooth(x / 3.0, y / 3.0, 9));
        one("too near", 140.0 * s, &|x, y| smooth(x / 3.0, y / 3.0, 9));
        one("faint", 20.0 * s, &|x, y| 0.4 + 0.05 * smooth(x / 12.0, y / 12.0, 1));
        // Two cameras that look at different things.
        let scene = |seed| {
            seen(format!("two things, {size:?}"), size, &|_, _| 0.0, &|x, y| smooth(x / 4.0, y / 4.0, seed))
        };
        let mut two = scene(9);
        let other = scene(10);
        two.images[1].clone_from(&other.images[1]);
        assert_not_misread(&two);
    }
}

/// Of what repeats, the next one may look nearer to where it should be than the right one.
#[test]
fn what_repeats_misleads_nobody() {
    for size in SIZES {
        let half = size.1 as f64 / 2.0;
        let s = scale(size);
        for d in [4.0, 14.0, 26.0, 40.0] {
            for period in [9.0, 16.0, 22.0, 28.0, 45.0] {
                let d = d * s;
                let p = period * s;
                let one = |name: &str, bright: &dyn Fn(f64, f64) -> f64| {
                    let name = format!("{name} of period {p:.1} at {d:.1}, {size:?}");
                    assert_not_misread(&seen(name, size, &|_, _| d, bright));
                };
                let paper = |x: f64, y: f64| smooth((x.rem_euclid(p) / s * 2.0).floor(), y / 3.0, 5);
                one("stripes", &|x, _| stripe(x / p));
                one("checks", &|x, y| if stripe(x / p) > 0.5 { stripe(y / p) } else { 1.0 - stripe(y / p) });
                one("wallpaper", &paper);
                one("half of wallpaper", &|x, y| if y > half { 0.4 } else { paper(x, y) });
            }
        }
        // Tiles on a floor.
        for tile in [0.5, 1.0, 2.0, 4.0] {
            let depth = |y: f64| 2.0 + 26.0 * y / size.1 as f64;
            let bright = |x: f64, y: f64| {
                let u = (x - size.0 as f64 / 2.0) / s / depth(y);
                let v = 40.0 / depth(y);
                if ((u / tile).floor() + (v / tile).floor()) as i64 % 2 == 0 { 0.9 } else { 0.2 }
            };
            assert_not_misread(&seen(
                format!("tiles of {tile}, {size:?}"),
                size,
                &|_, y| depth(y) * s,
                &bright,
            ));
        }
    }
}
