//! Colour in the view of depth.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::cover::whole;
use super::lens::Lens32;
use super::warp::{Edge, Lane, Numbers, Warp, WithRow};
use crate::simd::for_every_processor;

/// Positions are in this part of a pixel: the product of two weights and a colour fits 32 bits.
const PARTS: i32 = 256;

/// Where the pixels of a row of depth are seen in colour, in [`PARTS`] of a pixel; −1 where they are not.
#[derive(Debug)]
pub(super) struct PaintRows {
    u: Vec<i32>,
    v: Vec<i32>,
}

impl PaintRows {
    pub(super) fn new(depth_width: usize) -> Self {
        Self { u: vec![-1; depth_width], v: vec![-1; depth_width] }
    }

    /// Paints some rows of depth: each pixel gets what is around its middle.
    #[expect(clippy::too_many_arguments, reason = "two images with their sizes")]
    pub(super) fn paint(
        &mut self,
        warp: &Warp,
        depth: &[u16],
        unit: f32,
        width: usize,
        rows: core::ops::Range<usize>,
        color: &[u8],
        (color_width, color_height): (usize, usize),
        out: &mut [u8],
    ) {
        for (row, out) in rows.zip(out.chunks_exact_mut(width * 3)) {
            let depth = &depth[row * width..(row + 1) * width];
            warp.with_row(row, Middles { depth, unit, numbers: &warp.numbers, rows: self });
            for ((u, v), out) in self.u.iter().zip(&self.v).zip(out.chunks_exact_mut(3)) {
                if *u < 0 {
                    out.fill(0);
                    continue;
                }
                let x = (u / PARTS) as usize;
                let y = (v / PARTS) as usize;
                let right = (x + 1).min(color_width - 1);
                let below = (y + 1).min(color_height - 1);
                let weight_x = (u % PARTS) as u32;
                let weight_y = (v % PARTS) as u32;
                let pixel = |x: usize, y: usize| &color[(y * color_width + x) * 3..][..3];
                let a = pixel(x, y);
                let b = pixel(right, y);
                let c = pixel(x, below);
                let d = pixel(right, below);
                for i in 0..3 {
                    let mix = |a: u8, b: u8| (256 - weight_x) * u32::from(a) + weight_x * u32::from(b);
                    let sum = (256 - weight_y) * mix(a[i], b[i]) + weight_y * mix(c[i], d[i]);
                    out[i] = ((sum + (1 << 15)) >> 16) as u8;
                }
            }
        }
    }
}

struct Middles<'a> {
    depth: &'a [u16],
    unit: f32,
    numbers: &'a Numbers,
    rows: &'a mut PaintRows,
}

impl WithRow for Middles<'_> {
    fn run<Y: Lane, L: Lens32>(self, top: Edge<'_, Y>, bottom: Edge<'_, Y>, lens: L) {
        let Self { depth, unit, numbers, rows } = self;
        middles(depth, unit, top.x, top.y, bottom.x, bottom.y, lens, numbers, &mut rows.u, &mut rows.v);
    }
}

for_every_processor! {
    fn middles<Y: Lane, L: Lens32>(
        depth: &[u16], unit: f32, x0: &[f32], y0: Y, x1: &[f32], y1: Y, lens: L, numbers: &Numbers,
        u: &mut [i32], v: &mut [i32],
    ) {
        let n = depth.len();
        let x0 = &x0[..n];
        let y0 = y0.cut(0..n);
        let x1 = &x1[1..=n];
        let y1 = y1.cut(1..n + 1);
        let u = &mut u[..n];
        let v = &mut v[..n];
        let numbers = *numbers;
        let [w, h] = numbers.size;
        for i in 0..n {
            let z = f32::from(depth[i]) * unit;
            let p = numbers.project(z, (x0[i] + x1[i]) * 0.5, (y0.at(i) + y1.at(i)) * 0.5, lens);
            // Half a pixel outside still lies in the pixels of the border.
            let inside = (p.u >= -0.5) & (p.v >= -0.5) & (p.u <= w - 0.5) & (p.v <= h - 0.5);
            let seen = (depth[i] != 0) & p.seen & inside;
            u[i] = if seen { parts(p.u, w) } else { -1 };
            v[i] = if seen { parts(p.v, h) } else { -1 };
        }
    }
}

/// A position in the image, cut to the middles of its border.
#[inline(always)]
fn parts(at: f32, size: f32) -> i32 {
    let at = if at > 0.0 { at } else { 0.0 };
    let at = if at < size - 1.0 { at } else { size - 1.0 };
    whole(at * PARTS as f32 + 0.5)
}
