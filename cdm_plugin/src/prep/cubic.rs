//! Colour to the network's first three planes: bicubic resize and normalising in one pass over the image.
//!
//! The kernel is OpenCV's `INTER_CUBIC` (modules/imgproc/src/resize.cpp, Apache-2.0): a = -0.75, coordinates and weights
//! in `f32`, the border repeated, no smoothing when it shrinks. Rows first, then columns; OpenCV does columns first, and the
//! sums are the same but for rounding. Rows first reads the bytes as they lie, and vectors of them.

use crate::{ChannelOrder, Color};

/// Of the colours of ImageNet, by channel as the network counts them.
const MEAN: [f64; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f64; 3] = [0.229, 0.224, 0.225];

/// Columns of border on each side of a row: the kernel reaches two beyond the first and the last.
const BORDER: usize = 2;

/// Where the kernel lies for each place along one axis.
#[derive(Debug)]
struct Taps {
    /// The first of the four sources; -2 to `from`.
    first: Vec<i32>,
    weights: Vec<[f32; 4]>,
}

impl Taps {
    fn new(from: usize, to: usize) -> Self {
        let step = 1.0 / (to as f64 / from as f64);
        let places = (0..to).map(|i| {
            let at = ((i as f64 + 0.5) * step - 0.5) as f32;
            let floor = at.floor();
            (floor as i32 - 1, weights(at - floor))
        });
        let (first, weights) = places.unzip();
        Self { first, weights }
    }
}

/// The cubic kernel with a = -0.75 at `t` in 0..1 between the second and the third source, in `f32` and in this order of
/// operations, so that the weights have OpenCV's rounding.
pub(super) fn weights(t: f32) -> [f32; 4] {
    const A: f32 = -0.75;
    let w0 = ((A * (t + 1.0) - 5.0 * A) * (t + 1.0) + 8.0 * A) * (t + 1.0) - 4.0 * A;
    let w1 = ((A + 2.0) * t - (A + 3.0)) * t * t + 1.0;
    let w2 = ((A + 2.0) * (1.0 - t) - (A + 3.0)) * (1.0 - t) * (1.0 - t) + 1.0;
    [w0, w1, w2, 1.0 - w0 - w1 - w2]
}

/// Tables for one size of image and of input.
#[derive(Debug)]
pub(super) struct CubicResize {
    rows: Taps,
    columns: Taps,
    width: usize,
    height: usize,
}

impl CubicResize {
    pub(super) fn new(width: usize, height: usize, net_width: usize, net_height: usize) -> Self {
        Self { rows: Taps::new(height, net_height), columns: Taps::new(width, net_width), width, height }
    }

    /// Scratch memory of [`Self::run`]: one row of the image's width with its border, three numbers a pixel, and one more
    /// so that four can be read at the last.
    pub(super) fn line(&self) -> Vec<f32> {
        vec![0.0; 3 * (self.width + 2 * BORDER) + 1]
    }

    /// Writes rows of the three planes from the row `first` on, normalised; `line` is what [`Self::line`] made.
    #[inline(always)]
    pub(super) fn run(
        &self,
        color: &Color<'_>,
        scale: &Normalise,
        first: usize,
        line: &mut [f32],
        [a, b, c]: [&mut [f32]; 3],
    ) {
        let width = self.columns.first.len();
        // The planes by byte of a pixel.
        let [a, b, c] = if scale.swapped { [c, b, a] } else { [a, b, c] };
        let outputs = a.chunks_exact_mut(width).zip(b.chunks_exact_mut(width)).zip(c.chunks_exact_mut(width));
        let last = self.height as i32 - 1;
        let taps = self.rows.first.iter().zip(&self.rows.weights).skip(first);
        for ((first, weights), ((a, b), c)) in taps.zip(outputs) {
            let row = |k: i32| color.row((first + k).clamp(0, last) as usize);
            blend_rows([row(0), row(1), row(2), row(3)], weights, line);
            blend_columns(line, &self.columns, scale, [a, b, c]);
        }
    }
}

/// Factor and offset applied to a blended value of 0 to 255, by byte of a pixel.
pub(super) struct Normalise {
    factor: [f32; 3],
    offset: [f32; 3],
    /// Whether the first byte of a pixel goes to the last plane.
    swapped: bool,
}

impl Normalise {
    pub(super) fn new(color: &Color<'_>, order: ChannelOrder) -> Self {
        use crate::ColorFormat::{Bgr8, Rgb8};
        let swapped = !matches!((color.format, order), (Rgb8, ChannelOrder::Rgb) | (Bgr8, ChannelOrder::Bgr));
        let of = |f: fn(f64, f64) -> f64| {
            let by_plane: [f32; 3] = core::array::from_fn(|i| f(MEAN[i], DEVIATION[i]) as f32);
            let [r, g, b] = by_plane;
            if swapped { [b, g, r] } else { by_plane }
        };
        Self {
            factor: of(|_, deviation| 1.0 / (255.0 * deviation)),
            offset: of(|mean, deviation| -mean / deviation),
            swapped,
        }
    }
}

/// Four rows of bytes with their weights, into `line` between its borders, which then repeat the first and last pixel.
#[inline(always)]
fn blend_rows(rows: [&[u8]; 4], w: &[f32; 4], line: &mut [f32]) {
    let n = rows[0].len();
    let [r0, r1, r2, r3] = rows.map(|r| &r[..n]);
    let out = &mut line[3 * BORDER..][..n];
    for i in 0..n {
        out[i] = f32::from(r0[i]) * w[0]
            + f32::from(r1[i]) * w[1]
            + f32::from(r2[i]) * w[2]
            + f32::from(r3[i]) * w[3];
    }
    for k in 0..3 {
        let first = line[3 * BORDER + k];
        let last = line[n + 3 * BORDER - 3 + k];
        for border in 0..BORDER {
            line[3 * border + k] = first;
            line[n + 3 * BORDER + 3 * border + k] = last;
        }
    }
}

/// Four columns with their weights for each pixel, normalised, to one row of each plane.
#[inline(always)]
fn blend_columns(line: &[f32], columns: &Taps, scale: &Normalise, planes: [&mut [f32]; 3]) {
    let [a, b, c] = planes;
    let places = columns.first.iter().zip(&columns.weights);
    for ((first, w), ((a, b), c)) in places.zip(a.iter_mut().zip(b.iter_mut()).zip(c.iter_mut())) {
        let start = 3 * (first + BORDER as i32) as usize;
        let Some(p) = line.get(start..).and_then(|l| l.first_chunk::<13>()) else { continue };
        let mut sum = [0.0f32; 4];
        for k in 0..4 {
            sum[k] = p[k] * w[0] + p[3 + k] * w[1] + p[6 + k] * w[2] + p[9 + k] * w[3];
        }
        *a = sum[0] * scale.factor[0] + scale.offset[0];
        *b = sum[1] * scale.factor[1] + scale.offset[1];
        *c = sum[2] * scale.factor[2] + scale.offset[2];
    }
}
