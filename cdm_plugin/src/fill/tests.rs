//! The steps together; each has its own tests beside it.

use super::*;
use crate::workers::Wide;
use crate::{Color, ColorFormat, RawDepth};
use proptest::prelude::*;

/// A grey image with depth in millimetres.
fn run(w: usize, h: usize, color: &[u8], depth: &[u16]) -> Vec<u16> {
    let mut out = vec![7; w * h];
    let mut job = Job {
        color: Color { pixels: color, format: ColorFormat::Rgb8, width: w, height: h, stride: 3 * w },
        depth: RawDepth { pixels: depth, unit_m: 0.001 },
        out: Output::Units { pixels: &mut out, unit_m: 0.001 },
        steps: StepTimes::default(),
    };
    FillRefiner::new(1).unwrap().refine(core::slice::from_mut(&mut job)).unwrap();
    out
}

#[test]
fn a_plane_stays_and_its_holes_are_filled() {
    let w = 64;
    let h = 48;
    // Inverse depth grows from left to right, as on a wall seen at an angle.
    let truth = |i: usize| (1000.0 / (1.0 + 0.01 * (i % w) as f64)).round() as u16;
    let mut depth: Vec<u16> = (0..w * h).map(truth).collect();
    for (i, d) in depth.iter_mut().enumerate() {
        let x = i % w;
        let y = i / w;
        if (20..30).contains(&x) && (10..25).contains(&y) {
            *d = if x % 2 == 0 { 0 } else { u16::MAX };
        }
    }
    let out = run(w, h, &vec![90; w * h * 3], &depth);
    for (i, d) in out.iter().enumerate() {
        let off = f64::from(*d) / f64::from(truth(i)) - 1.0;
        assert!(off.abs() < 0.06, "({}, {}): {d} for {}", i % w, i / w, truth(i));
    }
}

#[test]
fn colour_decides_what_a_hole_between_two_surfaces_is() {
    let w = 64;
    let h = 64;
    // Near and red on the left, far and blue on the right; depth is missing on both sides of the edge.
    let is_near = |i: usize| i % w < 30;
    let color: Vec<u8> =
        (0..w * h).flat_map(|i| if is_near(i) { [200, 40, 40] } else { [40, 40, 200] }).collect();
    let depth: Vec<u16> = (0..w * h)
        .map(|i| match i % w {
            18..42 => 0,
            0..18 => 500,
            _ => 1500,
        })
        .collect();
    let out = run(w, h, &color, &depth);
    for (i, d) in out.iter().enumerate() {
        assert_eq!(*d, if is_near(i) { 500 } else { 1500 }, "({}, {})", i % w, i / w);
    }
}

#[test]
fn without_any_depth_there_is_none() {
    for nothing in [0, u16::MAX] {
        assert!(run(33, 17, &[9; 33 * 17 * 3], &[nothing; 33 * 17]) == [0; 33 * 17]);
    }
}

#[test]
fn flying_pixels_and_islands_go() {
    let w = 160;
    let h = 120;
    let mut depth = vec![1000u16; w * h];
    depth[20 * w + 30] = 500; // alone
    for y in 60..62 {
        for x in 70..72 {
            depth[y * w + x] = 400; // an island of four
        }
    }
    assert!(run(w, h, &vec![50; w * h * 3], &depth) == vec![1000; w * h]);
}

/// A wall at 2.94 m of 640x480 with discs of these columns, rows, radii and depths before or behind it.
fn with_discs(discs: &[(i32, i32, i32, u16)]) -> Vec<u16> {
    let mut depth = vec![2940; 640 * 480];
    for (i, d) in depth.iter_mut().enumerate() {
        let x = i as i32 % 640;
        let y = i as i32 / 640;
        for (cx, cy, r, z) in discs {
            let square = (x - cx).pow(2) + (y - cy).pow(2);
            if square <= r * r {
                *d = *z;
            } else if square <= (r + 6) * (r + 6) {
                *d = 0; // a shadow
            }
        }
    }
    depth
}

#[test]
fn specks_that_hang_in_the_air_go_and_things_stay() {
    let grey = vec![90; 640 * 480 * 3];
    // Near and far ones, of 21 to 197 pixels, together 452 at 0.36 m, but far from each other.
    let discs =
        [(100, 100, 5, 360), (300, 80, 7, 360), (500, 300, 3, 360), (200, 350, 4, 6000), (420, 200, 5, 5200)];
    assert!(run(640, 480, &grey, &with_discs(&discs)) == vec![2940; 640 * 480]);
    // A hand and a bump of the wall are not islands.
    for (r, z) in [(14, 360), (5, 2700), (5, 3200)] {
        let depth = with_discs(&[(320, 240, r, z)]);
        let out = run(640, 480, &grey, &depth);
        let kept = depth.iter().zip(&out).filter(|(d, _)| **d == z).all(|(_, o)| *o == z);
        assert!(kept, "{z} mm, radius {r}");
    }
}

#[test]
fn depth_far_from_what_was_measured_is_unknown() {
    let w = 640;
    let h = 480;
    // Depth on the left 300 columns; an eighth of 640 is 80.
    let depth: Vec<u16> = (0..w * h).map(|i| if i % w < 300 { 1000 } else { 0 }).collect();
    let grey = vec![90; w * h * 3];
    for (i, d) in run(w, h, &grey, &depth).into_iter().enumerate() {
        match i % w {
            0..376 => assert_eq!(d, 1000, "{}, {}", i % w, i / w),
            388.. => assert_eq!(d, 0, "{}, {}", i % w, i / w),
            _ => {}
        }
    }
    let mut all = FillRefiner::new(1).unwrap().with_reach(1.0);
    assert!(refined(&mut all, (w, h), &grey, &depth).iter().all(|d| (d - 1.0).abs() < 1e-6));
}

/// A small generator, so that images are the same everywhere.
struct Rolls(u64);

impl Rolls {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.0 >> 33
    }
}

/// Surfaces at a few depths with noise, holes, flying pixels and saturated ones.
fn scene(seed: u64, w: usize, h: usize) -> (Vec<u8>, Vec<u16>) {
    let mut rolls = Rolls(seed);
    let cell = 1 + rolls.next() as usize % 12;
    let base = 400 + rolls.next() % 500;
    let mut depth = Vec::new();
    let mut color = Vec::new();
    for i in 0..w * h {
        let patch = (i % w / cell * 31 + i / w / cell * 17) as u64 % 5;
        let roll = rolls.next() % 100;
        depth.push(match roll {
            0..20 => 0,
            20 => u16::MAX,
            21..24 => (300 + rolls.next() % 3000) as u16,
            _ => (base + 250 * patch + rolls.next() % 6) as u16,
        });
        color.extend([40 * patch as u8, 90, (200 - 30 * patch + rolls.next() % 9) as u8]);
    }
    (color, depth)
}

fn refined(refiner: &mut FillRefiner, (w, h): (usize, usize), color: &[u8], depth: &[u16]) -> Vec<f32> {
    let mut out = vec![-1.0; w * h];
    let mut job = Job {
        color: Color { pixels: color, format: ColorFormat::Rgb8, width: w, height: h, stride: 3 * w },
        depth: RawDepth { pixels: depth, unit_m: 0.001 },
        out: Output::Metres(&mut out),
        steps: StepTimes::default(),
    };
    refiner.refine(core::slice::from_mut(&mut job)).unwrap();
    out
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// The same bits with any number of threads, with and without AVX2, whatever was refined before.
    #[test]
    fn bits_depend_on_the_image_alone(seed in any::<u64>(), w in 1usize..90, h in 1usize..70) {
        let (color, depth) = scene(seed, w, h);
        let mut one = FillRefiner::new(1).unwrap();
        let first = refined(&mut one, (w, h), &color, &depth);
        let (other_color, other_depth) = scene(!seed, 50, 40);
        refined(&mut one, (50, 40), &other_color, &other_depth);
        prop_assert!(bits(&refined(&mut one, (w, h), &color, &depth)) == bits(&first), "an image before it");
        let mut three = FillRefiner::new(3).unwrap();
        prop_assert!(bits(&refined(&mut three, (w, h), &color, &depth)) == bits(&first), "three threads");
        let mut plain = FillRefiner::new(1).unwrap();
        plain.workers.wide = Wide::none();
        prop_assert!(bits(&refined(&mut plain, (w, h), &color, &depth)) == bits(&first), "without AVX2");
    }

    /// Every pixel gets a depth between the nearest and the farthest that was measured, or none.
    #[test]
    fn nothing_is_invented_beyond_what_was_measured(seed in any::<u64>(), w in 1usize..90, h in 1usize..70) {
        let (color, depth) = scene(seed, w, h);
        let out = refined(&mut FillRefiner::new(1).unwrap(), (w, h), &color, &depth);
        let seen = depth.iter().filter(|d| **d > 0 && **d < u16::MAX).map(|d| f32::from(*d) * 0.001);
        let (near, far) = seen.fold((f32::MAX, 0.0f32), |(a, b), d| (a.min(d), b.max(d)));
        let is_none = |d: f32| d == 0.0;
        let is_between = |d: f32| d >= near * 0.9999 && d <= far * 1.0001;
        prop_assert!(out.iter().all(|d| is_none(*d) || is_between(*d)), "{} to {}", near, far);
        let all = refined(&mut FillRefiner::new(1).unwrap().with_reach(1.0), (w, h), &color, &depth);
        prop_assert!(all.iter().all(|d| is_none(*d)) || all.iter().all(|d| is_between(*d)), "{} to {}", near, far);
    }

    /// Stride, order of the channels and form of the output change nothing else.
    #[test]
    fn forms_of_input_and_output_agree(seed in any::<u64>(), w in 1usize..40, h in 1usize..30, pad in 0usize..9) {
        let (color, depth) = scene(seed, w, h);
        let mut refiner = FillRefiner::new(1).unwrap();
        let metres = refined(&mut refiner, (w, h), &color, &depth);
        let stride = 3 * w + pad;
        let mut padded = vec![77u8; stride * h];
        for (to, from) in padded.chunks_mut(stride).zip(color.chunks(3 * w)) {
            for (to, from) in to.chunks_mut(3).zip(from.chunks(3)) {
                to.copy_from_slice(&[from[2], from[1], from[0]]);
            }
        }
        let mut units = vec![7u16; w * h];
        let mut inverse = vec![7f32; w * h];
        let outs = [Output::Units { pixels: &mut units, unit_m: 0.0005 }, Output::Inverse(&mut inverse)];
        for out in outs {
            let mut job = Job {
                color: Color { pixels: &padded, format: ColorFormat::Bgr8, width: w, height: h, stride },
                depth: RawDepth { pixels: &depth, unit_m: 0.001 },
                out,
                steps: StepTimes::default(),
            };
            refiner.refine(core::slice::from_mut(&mut job)).unwrap();
        }
        for ((m, u), q) in metres.iter().zip(&units).zip(&inverse) {
            prop_assert!((f64::from(*u) * 0.0005 - f64::from(*m)).abs() <= 0.000_251, "{} {}", m, u);
            prop_assert!(if *m == 0.0 { *q == 0.0 } else { (q * m - 1.0).abs() < 1e-5 }, "{} {}", m, q);
        }
    }

    /// Against eight neighbours looked at one by one.
    #[test]
    fn support_is_what_neighbours_give(seed in any::<u64>(), w in 1usize..40, h in 1usize..20) {
        let (_, depth) = scene(seed, w, h);
        let q: Vec<f32> = depth.iter().map(|d| if *d == 0 { 0.0 } else { 1000.0 / f32::from(*d) }).collect();
        for y in 0..h {
            let mut row = vec![9.0; w];
            clean::keep_supported(Wide::detect(), &q, w, y, &mut row);
            for x in 0..w {
                let here = q[y * w + x];
                let mut n = 0;
                for (dx, dy) in [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)] {
                    let nx = x as i32 + dx;
                    let ny = y as i32 + dy;
                    if nx >= 0 && ny >= 0 && nx < w as i32 && ny < h as i32 {
                        n += u32::from((q[ny as usize * w + nx as usize] - here).abs() < clean::SAME * here);
                    }
                }
                prop_assert_eq!(row[x], if n >= 2 { here } else { 0.0 }, "{} {}", x, y);
            }
        }
    }

    /// Against a flood from every pixel.
    #[test]
    fn islands_are_what_a_flood_finds(seed in any::<u64>(), w in 1usize..40, h in 1usize..30, least in 1u32..30) {
        let (_, depth) = scene(seed, w, h);
        let q: Vec<f32> = depth.iter().map(|d| if *d == 0 { 0.0 } else { 1000.0 / f32::from(*d) }).collect();
        let mut fast = q.clone();
        let mut islands = Islands::default();
        islands.reserve(w * h);
        islands.remove(&mut fast, w, least, 0);
        let joined = |a: usize, b: usize| {
            // In the order in which the rows are read: the later pixel is the measure.
            let (a, b) = (q[a.min(b)], q[a.max(b)]);
            b > 0.0 && a > 0.0 && (a - b).abs() < clean::SAME * b
        };
        let mut size = vec![0; w * h];
        for start in 0..w * h {
            let mut seen = vec![false; w * h];
            let mut todo = vec![start];
            seen[start] = true;
            let mut n = 0;
            while let Some(i) = todo.pop() {
                n += 1;
                let x = i % w;
                let y = i / w;
                let next = [(x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1), (y > 0).then(|| i - w), (y + 1 < h).then(|| i + w)];
                for j in next.into_iter().flatten() {
                    if !seen[j] && joined(i, j) {
                        seen[j] = true;
                        todo.push(j);
                    }
                }
            }
            size[start] = n;
        }
        for i in 0..w * h {
            prop_assert_eq!(fast[i], if size[i] >= least { q[i] } else { 0.0 }, "{} {}", i % w, i / w);
        }
    }
}

#[test]
fn what_cannot_be_used_is_refused_by_name() {
    let refine = |w: usize, h: usize, stride: usize, bytes: usize, depth: usize, out: usize, unit_m: f64| {
        let pixels = vec![0; bytes];
        let depth = vec![0; depth];
        let mut out = vec![0u16; out];
        let mut job = Job {
            color: Color { pixels: &pixels, format: ColorFormat::Rgb8, width: w, height: h, stride },
            depth: RawDepth { pixels: &depth, unit_m },
            out: Output::Units { pixels: &mut out, unit_m: 0.001 },
            steps: StepTimes::default(),
        };
        FillRefiner::new(1)
            .unwrap()
            .refine(core::slice::from_mut(&mut job))
            .map_err(|e| (e.kind(), e.to_string()))
    };
    refine(4, 3, 12, 36, 12, 12, 0.001).unwrap();
    for ((w, h, stride, bytes, depth, out, unit_m), kind, says) in [
        ((0, 3, 0, 0, 0, 0, 0.001), ErrorKind::BadInput, "0x3"),
        ((4, 3, 11, 36, 12, 12, 0.001), ErrorKind::BadInput, "11 bytes a row"),
        ((4, 3, 12, 35, 12, 12, 0.001), ErrorKind::BadInput, "35 bytes"),
        ((4, 3, usize::MAX, 36, 12, 12, 0.001), ErrorKind::BadInput, "bytes"),
        ((4, 3, 12, 36, 13, 12, 0.001), ErrorKind::SizeMismatch, "depth 13"),
        ((4, 3, 12, 36, 12, 11, 0.001), ErrorKind::SizeMismatch, "output 11"),
        ((4, 3, 12, 36, 12, 12, 0.0), ErrorKind::BadInput, "raw depth"),
        ((4, 3, 12, 36, 12, 12, f64::NAN), ErrorKind::BadInput, "raw depth"),
    ] {
        let (k, text) = refine(w, h, stride, bytes, depth, out, unit_m).unwrap_err();
        assert!(k == kind && text.contains(says), "{text}");
    }
}
