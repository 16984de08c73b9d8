//! Whether left and right are exchanged, asked of many pairs: a real one, and made ones of which some must not be believed.
//!
//! Missing real pictures make their test fail: `DEPTHRIG_TEST_DATA` names the folder that holds them.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_calib::stereo::{Gray, Order, OrderCheck, StereoPair};
use std::path::PathBuf;

type Size = (usize, usize);

/// Both pictures of a pair, grey.
struct Pair {
    name: String,
    size: Size,
    eyes: [Vec<u8>; 2],
}

impl Pair {
    /// What it looks like, and what it looks like the other way round.
    fn orders(&self) -> [Order; 2] {
        let (w, h) = self.size;
        let mut check = OrderCheck::new(w, h).unwrap();
        let [a, b] = self.eyes.each_ref().map(|e| Gray::packed(e, w, h));
        [StereoPair::new(a, b), StereoPair::new(b, a)].map(|pair| check.check(&pair).unwrap())
    }

    /// It is known which is which.
    #[track_caller]
    fn tells(&self) {
        assert_eq!(self.orders(), [Order::AsNamed, Order::Swapped], "{}", self.name);
    }

    /// Either way round nothing wrong is believed.
    #[track_caller]
    fn misleads_nobody(&self) {
        let [named, exchanged] = self.orders();
        assert_ne!(named, Order::Swapped, "{}", self.name);
        assert_ne!(exchanged, Order::AsNamed, "{}, exchanged", self.name);
    }
}

fn hash(a: i64, b: i64, seed: u64) -> f64 {
    let mut x = (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (b as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
    x ^= x >> 31;
    x = x.wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x ^= x >> 29;
    (x.wrapping_mul(0x94D0_49BB_1331_11EB) >> 56) as f64 / 255.0
}

/// Noise that is smooth between whole numbers, 0 to 1.
fn smooth(u: f64, v: f64, seed: u64) -> f64 {
    let (i, j) = (u.floor(), v.floor());
    let (fu, fv) = (u - i, v - j);
    let at = |i: f64, j: f64| hash(i as i64, j as i64, seed);
    let row = |j| at(i, j) * (1.0 - fu) + at(i + 1.0, j) * fu;
    row(j) * (1.0 - fv) + row(j + 1.0) * fv
}

/// A stripe with soft edges, of period 1.
fn stripe(u: f64) -> f64 {
    ((u * core::f64::consts::TAU).sin() * 3.0).clamp(-1.0, 1.0) * 0.5 + 0.5
}

/// A surface as both eyes see it: its disparity and its brightness (0 to 1) at a pixel of the left view. The right eye is
/// darker than the left one by a fifth, and both have noise of three grey levels.
fn seen(
    name: String,
    size: Size,
    disparity: &dyn Fn(f64, f64) -> f64,
    brightness: &dyn Fn(f64, f64) -> f64,
) -> Pair {
    let eye = |right: bool| -> Vec<u8> {
        let pixel = |i: usize| {
            let (x, y) = ((i % size.0) as f64, (i / size.0) as f64);
            let mut left = x;
            for _ in 0..if right { 8 } else { 0 } {
                left = x + disparity(left, y);
            }
            let noise: f64 = (0..4).map(|k| hash(i as i64, k, 77 + u64::from(right)) - 0.5).sum();
            let gain = if right { 0.8 } else { 1.0 };
            (gain * (20.0 + 200.0 * brightness(left, y)) + 5.0 * noise).round().clamp(0.0, 255.0) as u8
        };
        (0..size.0 * size.1).map(pixel).collect()
    };
    Pair { name, size, eyes: [eye(false), eye(true)] }
}

const SIZES: [Size; 2] = [(192, 108), (344, 192)];

/// Pixels of a size for each of 192 across.
fn scale((w, _): Size) -> f64 {
    w as f64 / 192.0
}

#[test]
fn the_real_pair_tells_in_every_size() {
    let data = std::env::var_os("DEPTHRIG_TEST_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
    let read = |name: &str| {
        let path = data.join("opencv_aloe_stereo").join(name);
        image::open(&path)
            .unwrap_or_else(|e| panic!("{}: {e}; set DEPTHRIG_TEST_DATA", path.display()))
            .into_luma8()
    };
    let eyes = [read("aloeL.jpg"), read("aloeR.jpg")];
    for parts in [1, 2, 3, 4, 8] {
        let (w, h) = (eyes[0].width() / parts, eyes[0].height() / parts);
        let small =
            eyes.each_ref().map(|e| image::imageops::resize(e, w, h, image::imageops::Triangle).into_raw());
        Pair { name: format!("aloe of {w}x{h}"), size: (w as usize, h as usize), eyes: small }.tells();
    }
}

#[test]
fn texture_tells() {
    for size in SIZES {
        let s = scale(size);
        for (d, spot, contrast) in [(8.0, 3.0, 1.0), (20.0, 3.0, 1.0), (8.0, 3.0, 0.2), (20.0, 12.0, 1.0)] {
            let name = format!("a wall at {d} of spots of {spot}, contrast {contrast}, {size:?}");
            let bright = |x: f64, y: f64| 0.4 + contrast * (smooth(x / spot, y / spot, 1) - 0.5);
            seen(name, size, &|_, _| d * s, &bright).tells();
        }
        let floor = |_: f64, y: f64| (2.0 + 26.0 * y / size.1 as f64) * s;
        seen(format!("a floor, {size:?}"), size, &floor, &|x, y| smooth(x / 4.0, y / 4.0, 3)).tells();
        // Three quarters of the picture are a plain wall.
        let part = |x: f64, y: f64| if y < size.1 as f64 * 0.75 { 0.5 } else { smooth(x / 3.0, y / 3.0, 4) };
        seen(format!("a strip of texture, {size:?}"), size, &|_, _| 14.0 * s, &part).tells();
    }
}

#[test]
fn what_has_no_texture_misleads_nobody() {
    for size in SIZES {
        let ((w, h), s) = ((size.0 as f64, size.1 as f64), scale(size));
        let one = |name: &str, d: f64, bright: &dyn Fn(f64, f64) -> f64| {
            seen(format!("{name}, {size:?}"), size, &|_, _| d, bright).misleads_nobody();
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
        let (mut two, other) = (scene(9), scene(10));
        two.eyes[1].clone_from(&other.eyes[1]);
        two.misleads_nobody();
    }
}

/// Of what repeats, the next one may look nearer to where it should be than the right one.
#[test]
fn what_repeats_misleads_nobody() {
    for size in SIZES {
        let (half, s) = (size.1 as f64 / 2.0, scale(size));
        for d in [4.0, 14.0, 26.0, 40.0] {
            for period in [9.0, 16.0, 22.0, 28.0, 45.0] {
                let (d, p) = (d * s, period * s);
                let one = |name: &str, bright: &dyn Fn(f64, f64) -> f64| {
                    let name = format!("{name} of period {p:.1} at {d:.1}, {size:?}");
                    seen(name, size, &|_, _| d, bright).misleads_nobody();
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
                let (u, v) = ((x - size.0 as f64 / 2.0) / s / depth(y), 40.0 / depth(y));
                if ((u / tile).floor() + (v / tile).floor()) as i64 % 2 == 0 { 0.9 } else { 0.2 }
            };
            seen(format!("tiles of {tile}, {size:?}"), size, &|_, y| depth(y) * s, &bright).misleads_nobody();
        }
    }
}
