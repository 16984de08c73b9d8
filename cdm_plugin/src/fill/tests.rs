//! The steps together; each has its own tests beside it.

use super::*;
use crate::{Color, ColorFormat, RawDepth};

/// A grey picture with depth in millimetres.
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
    let (w, h) = (64, 48);
    // Inverse depth grows from left to right, as on a wall seen at an angle.
    let truth = |i: usize| (1000.0 / (1.0 + 0.01 * (i % w) as f64)).round() as u16;
    let mut depth: Vec<u16> = (0..w * h).map(truth).collect();
    for (i, d) in depth.iter_mut().enumerate() {
        let (x, y) = (i % w, i / w);
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
    let (w, h) = (64, 64);
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
    let (w, h) = (160, 120);
    let mut depth = vec![1000u16; w * h];
    depth[20 * w + 30] = 500; // alone
    for y in 60..62 {
        for x in 70..72 {
            depth[y * w + x] = 400; // an island of four
        }
    }
    assert!(run(w, h, &vec![50; w * h * 3], &depth) == vec![1000; w * h]);
}
