//! Against slow readings of the formulas; `tests/it/prep.rs` compares with the official code's own numbers.

use super::*;
use crate::ColorFormat;
use crate::ErrorKind::{self, BadInput, SizeMismatch};
use crate::workers::Wide;
use proptest::prelude::*;

#[test]
fn sizes_of_the_network() {
    for (image, input_size, net) in [
        ((1280, 720), 252, (448, 252)),
        ((1280, 720), 518, (924, 518)),
        ((640, 480), 308, (406, 308)),
        ((640, 480), 518, (686, 518)),
        ((480, 640), 518, (518, 686)),
        ((1, 1), 518, (518, 518)),
        // 18.5 and 19.5 patches go to the even number.
        ((37, 36), 252, (252, 252)),
        ((39, 36), 252, (280, 252)),
        // 500 is nearer to 504, 510 is nearer to 504 but must not fall below itself.
        ((500, 500), 500, (504, 504)),
        ((500, 500), 510, (518, 518)),
        ((1280, 120), 518, (5530, 518)),
    ] {
        assert_eq!(net_size(image.0, image.1, input_size).unwrap(), net, "{image:?} {input_size}");
    }
    for (image, input_size, text) in [
        ((0, 720), 518, "0x720"),
        ((1280, 0), 518, "1280x0"),
        ((640, 480), 13, "13"),
        ((6400, 480), 518, "too large"),
        ((usize::MAX, 1), 518, "too narrow"),
        ((640, 3), 112, "640x3 is too narrow"),
        ((640, 480), u32::MAX, "out of range 14..=1792"),
        ((640, 480), 4000, "input size 4000 is out of range"),
    ] {
        let error = net_size(image.0, image.1, input_size).unwrap_err();
        assert!(error.kind() == ErrorKind::BadInput && error.to_string().contains(text), "{error}");
    }
}

/// The definition in `f64`: columns and rows of the kernel with the border repeated.
fn slow_cubic(color: &Color<'_>, net_width: usize, net_height: usize) -> Vec<[f64; 3]> {
    let taps = |i: usize, from: usize, to: usize| {
        let at = (i as f64 + 0.5) * from as f64 / to as f64 - 0.5;
        [-1.0, 0.0, 1.0, 2.0].map(|k| {
            let source = at.floor() + k;
            let d = (at - source).abs();
            let w = if d <= 1.0 {
                1.25 * d.powi(3) - 2.25 * d.powi(2) + 1.0
            } else {
                -0.75 * (d.powi(3) - 5.0 * d.powi(2) + 8.0 * d - 4.0)
            };
            (source.clamp(0.0, from as f64 - 1.0) as usize, w)
        })
    };
    let mut out = Vec::new();
    for y in 0..net_height {
        for x in 0..net_width {
            let mut sum = [0.0; 3];
            for (row, wy) in taps(y, color.height, net_height) {
                for (column, wx) in taps(x, color.width, net_width) {
                    for (c, s) in sum.iter_mut().enumerate() {
                        *s += wx * wy * f64::from(color.row(row)[3 * column + c]) / 255.0;
                    }
                }
            }
            out.push(sum);
        }
    }
    out
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn colour_equals_the_slow_reading(
        (width, height, pixels) in (1usize..60, 1usize..40).prop_flat_map(|(w, h)| {
            (Just(w), Just(h), prop::collection::vec(any::<u8>(), 3 * w * h))
        }),
        input_size in 14u32..50,
    ) {
        let color = Color { pixels: &pixels, format: ColorFormat::Rgb8, width, height, stride: 3 * width };
        let Ok(mut prep) = Prep::new(width, height, input_size, 6.0) else { return Ok(()) };
        let net = prep.net();
        prop_assume!(net.0 * net.1 < 20_000);
        let mut x = vec![f32::NAN; 4 * net.0 * net.1];
        let depth = vec![0u16; width * height];
        let raw = RawDepth { pixels: &depth, unit_m: 0.001 };
        prop_assert!(!prep.prepare(&color, &raw, ChannelOrder::Rgb, &mut x).unwrap());
        let plane = net.0 * net.1;
        for (i, expected) in slow_cubic(&color, net.0, net.1).into_iter().enumerate() {
            for c in 0..3 {
                let want = (expected[c] - [0.485, 0.456, 0.406][c]) / [0.229, 0.224, 0.225][c];
                let got = f64::from(x[c * plane + i]);
                prop_assert!((got - want).abs() < 2e-5, "{} {}: {} {}", i, c, got, want);
            }
        }
        prop_assert!(x[3 * plane..].iter().all(|v| *v == 0.0));
    }

    /// The same bits with any number of threads, with and without AVX2, also of depth that one band of rows has alone.
    #[test]
    fn bits_depend_on_the_images_alone(
        (width, height, pixels) in (1usize..60, 1usize..60).prop_flat_map(|(w, h)| {
            (Just(w), Just(h), prop::collection::vec(any::<u8>(), 3 * w * h))
        }),
        input_size in 14u32..90,
        lone in any::<prop::sample::Index>(),
        dense in any::<bool>(),
    ) {
        let Ok(one) = Prep::new(width, height, input_size, 6.0) else { return Ok(()) };
        let plane = one.net().0 * one.net().1;
        prop_assume!(plane < 40_000);
        let color = Color { pixels: &pixels, format: ColorFormat::Bgr8, width, height, stride: 3 * width };
        let mut depth = vec![0u16; width * height];
        depth[lone.index(width * height)] = 1234;
        if dense {
            depth.iter_mut().zip(&pixels).for_each(|(d, p)| *d += 700 + u16::from(*p));
        }
        let raw = RawDepth { pixels: &depth, unit_m: 0.001 };
        let run = |mut prep: Prep| {
            let mut x = vec![f32::NAN; 4 * plane];
            let has_depth = prep.prepare(&color, &raw, ChannelOrder::Rgb, &mut x).unwrap();
            let mut units = vec![7u16; width * height];
            let mut metres = vec![7.0f32; width * height];
            let mut inverse = metres.clone();
            let y = &x[3 * plane..];
            prep.finish(y, &mut Output::Units { pixels: &mut units, unit_m: 0.001 }).unwrap();
            prep.finish(y, &mut Output::Metres(&mut metres)).unwrap();
            prep.finish(y, &mut Output::Inverse(&mut inverse)).unwrap();
            let bits = |numbers: Vec<f32>| numbers.into_iter().map(f32::to_bits).collect::<Vec<_>>();
            (has_depth, bits(x), units, bits(metres), bits(inverse))
        };
        let on = |threads, wide: Option<Wide>| {
            let mut workers = Workers::new(threads).unwrap();
            workers.wide = wide.unwrap_or(workers.wide);
            run(Prep::with_workers(Arc::new(workers), width, height, input_size, 6.0).unwrap())
        };
        let first = run(one);
        prop_assert_eq!(first.0, first.1[3 * plane..].iter().any(|bits| *bits != 0));
        prop_assert!(on(3, None) == first, "three threads");
        prop_assert!(on(7, None) == first, "seven threads");
        prop_assert!(on(1, Some(Wide::none())) == first, "without AVX2");
    }
}

/// The network's input for every reading: an image of 256x256 at its own size would lose some, so this reads the table.
fn inverse_of(unit_m: f64, max_depth_m: f64) -> Vec<f32> {
    let mut table = DepthTable::new(max_depth_m);
    table.use_unit(unit_m);
    let raw: Vec<u16> = (0..=u16::MAX).collect();
    let columns: Vec<u32> = (0..1 << 16).collect();
    let mut out = vec![f32::NAN; 1 << 16];
    assert!(table.sample(&raw, 1 << 16, &[0], &columns, &mut out));
    out
}

/// The official script: readings over units per metre in `f64`, beyond 6 m is 0, 1/d where d is above 0, then `f32`.
/// 65535 is a hole here already; with 6 m that is so in the script as well, for every unit a camera has that reaches 6 m.
#[test]
fn inverse_depth_is_the_official_one_for_every_reading() {
    for (unit_m, per_metre) in [(0.001, 1000.0), (0.0001, 10_000.0), (0.00025, 4000.0), (0.0005, 2000.0)] {
        let ours = inverse_of(unit_m, 6.0);
        for (raw, ours) in ours.iter().enumerate() {
            let d = raw as f64 / per_metre;
            let official = if d > 6.0 || d <= 0.0 { 0.0 } else { (1.0 / d) as f32 };
            assert_eq!(*ours, official, "{raw} of {unit_m} m");
        }
        // As devices give it.
        assert_eq!(inverse_of(f64::from(unit_m as f32), 6.0), ours);
    }
    let fine = inverse_of(0.000_05, 6.0);
    assert_eq!((fine[65534], fine[65535]), ((1.0 / 3.2767) as f32, 0.0), "full scale is a hole, not 3.3 m");
    assert!(inverse_of(1e-300, 6.0)[1..65535].iter().all(|v| *v == f32::MAX), "finite for any unit");
}

fn finish(y: f32, unit_m: f64) -> (u16, f32, f32) {
    let mut prep = Prep::new(1, 1, 14, 6.0).unwrap();
    let y = vec![y; 14 * 14];
    let mut units = [7u16];
    let mut metres = [7.0f32];
    let mut inverse = [7.0f32];
    prep.finish(&y, &mut Output::Units { pixels: &mut units, unit_m }).unwrap();
    prep.finish(&y, &mut Output::Metres(&mut metres)).unwrap();
    prep.finish(&y, &mut Output::Inverse(&mut inverse)).unwrap();
    (units[0], metres[0], inverse[0])
}

#[test]
fn what_cannot_be_expressed_is_a_hole() {
    assert_eq!(finish(0.5, 0.001), (2000, 2.0, 0.5));
    assert_eq!(finish(2.0, 0.0001), (5000, 0.5, 2.0));
    for nothing in [0.0, -0.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert_eq!(finish(nothing, 0.001), (0, 0.0, 0.0), "{nothing}");
    }
    // Metres that are infinite; inverse depth itself is a number.
    assert_eq!(finish(1e-45, 0.001), (0, 0.0, 1e-45));
    // The last unit that fits, and the first that would be 65535.
    let last = 1.0 / 65.534;
    let first = 1.0 / 65.535;
    assert_eq!((finish(last, 0.001).0, finish(first, 0.001).0), (65534, 0));
    assert_eq!(finish(1e-3, 0.001).0, 0);
    // Less than half a unit.
    assert_eq!((finish(3000.0, 0.001).0, finish(1900.0, 0.001).0), (0, 1));
}

#[test]
fn images_that_do_not_fit_are_refused() {
    let pixels = [0u8; 3 * 20];
    let depth = [0u16; 20];
    let color = Color { pixels: &pixels, format: ColorFormat::Rgb8, width: 5, height: 4, stride: 15 };
    let raw = RawDepth { pixels: &depth, unit_m: 0.001 };
    let mut prep = Prep::new(5, 4, 14, 6.0).unwrap();
    let mut x = vec![0.0; 4 * prep.net().0 * prep.net().1];
    let mut refused = |color: Color<'_>, raw: RawDepth<'_>, kind, text: &str| {
        let error = prep.prepare(&color, &raw, ChannelOrder::Bgr, &mut x).unwrap_err();
        assert!(error.kind() == kind && error.to_string().contains(text), "{error}");
    };
    refused(Color { stride: 14, ..color }, raw, BadInput, "14 bytes apart");
    refused(Color { pixels: &pixels[1..], ..color }, raw, BadInput, "cut short at 59");
    refused(Color { stride: usize::MAX, ..color }, raw, BadInput, "cut short");
    refused(Color { width: 0, stride: 0, ..color }, raw, BadInput, "no pixels");
    refused(Color { width: 4, height: 5, stride: 12, ..color }, raw, SizeMismatch, "4x5");
    refused(color, RawDepth { pixels: &depth[1..], ..raw }, SizeMismatch, "19 pixels");
    for unit_m in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        refused(color, RawDepth { unit_m, ..raw }, BadInput, "invalid depth unit");
    }
    let error = prep.prepare(&color, &raw, ChannelOrder::Bgr, &mut x[1..]).unwrap_err();
    assert_eq!(error.kind(), SizeMismatch);
    let y = vec![1.0; prep.net().0 * prep.net().1];
    let mut out = [0.0f32; 20];
    assert_eq!(prep.finish(&y[1..], &mut Output::Metres(&mut out)).unwrap_err().kind(), SizeMismatch);
    assert_eq!(prep.finish(&y, &mut Output::Metres(&mut out[1..])).unwrap_err().kind(), SizeMismatch);
    let mut units = [0u16; 20];
    let error = prep.finish(&y, &mut Output::Units { pixels: &mut units, unit_m: 0.0 }).unwrap_err();
    assert_eq!(error.kind(), BadInput);
}

#[test]
fn embeddings_keep_what_they_must() {
    let channels = 3;
    let learnt: Vec<f32> = (0..(1 + 37 * 37) * channels).map(|i| (i as f32 * 0.37).sin()).collect();
    let same = position::resize(&learnt, 37, channels, 37, 37);
    assert_eq!(same, learnt);
    // As many places, but of another form: these are resized.
    assert_ne!(position::resize(&learnt, 37, channels, 37 * 37, 1)[channels..], learnt[channels..]);
    let other = position::resize(&learnt, 37, channels, 18, 32);
    assert_eq!(other.len(), (1 + 18 * 32) * channels);
    assert_eq!(other[..channels], learnt[..channels], "the class token has no place");
    let flat = position::resize(&vec![0.25; learnt.len()], 37, channels, 50, 7);
    assert!(flat.iter().all(|v| (v - 0.25).abs() < 1e-6));
}
