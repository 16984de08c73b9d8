//! The planes of the network's input, as `python/src/depthrig/lab/nets/tiny.py` (`tiny_inputs`) makes them, and its output.

use crate::{Color, ColorFormat, FillRefiner, RawDepth};

/// Sides of the network's input are multiples of this.
const MULTIPLE: usize = 16;
/// The least mean of filled inverse depth that planes are divided by, 1/m.
const LEAST_MEAN: f64 = 1e-6;

/// A side of an image, padded to a side of the network's input.
pub(super) const fn padded(side: usize) -> usize {
    side.next_multiple_of(MULTIPLE)
}

/// Writes the six planes of `x` and the plane `filled` for an image that `fill` has filled: colour less a half (red, green, blue; 0 to
/// 1), filled and raw inverse depth divided by the mean of the filled one over the image, and 1 where raw depth was measured. What is
/// right of the image and below it repeats its edge.
pub(super) fn write(
    color: &Color<'_>,
    depth: &RawDepth<'_>,
    fill: &FillRefiner,
    x: &mut [f32],
    filled: &mut [f32],
) {
    let w = color.width;
    let q = fill.inverse_depth();
    let sum: f64 = q.iter().map(|q| f64::from(*q)).sum();
    let per_mean = (1.0 / (sum / q.len() as f64).max(LEAST_MEAN)) as f32;
    let bytes: [usize; 3] = match color.format {
        ColorFormat::Rgb8 => [0, 1, 2],
        ColorFormat::Bgr8 => [2, 1, 0],
    };
    let across = padded(w);
    let rows = |plane: &mut [f32], row: &dyn Fn(usize, &mut [f32])| {
        for (y, out) in plane.chunks_exact_mut(across).take(color.height).enumerate() {
            row(y, &mut out[..w]);
            let edge = out[w - 1];
            out[w..].fill(edge);
        }
        let last = (color.height - 1) * across;
        for y in color.height..plane.len() / across {
            plane.copy_within(last..last + across, y * across);
        }
    };
    let raw = |y: usize, out: &mut [f32]| {
        fill.raw_row(&depth.pixels[y * w..(y + 1) * w], depth.unit_m, out);
    };
    for (plane, x) in x.chunks_exact_mut(filled.len()).enumerate() {
        match plane {
            0..3 => rows(x, &|y, out| {
                let pixels = color.row(y).as_chunks::<3>().0;
                for (out, pixel) in out.iter_mut().zip(pixels) {
                    *out = f32::from(pixel[bytes[plane]]) / 255.0 - 0.5;
                }
            }),
            3 => rows(x, &|y, out| {
                for (out, q) in out.iter_mut().zip(&q[y * w..]) {
                    *out = q * per_mean;
                }
            }),
            4 => rows(x, &|y, out| {
                raw(y, out);
                for q in out {
                    *q *= per_mean;
                }
            }),
            _ => rows(x, &|y, out| {
                raw(y, out);
                for q in out {
                    *q = if *q > 0.0 { 1.0 } else { 0.0 };
                }
            }),
        }
    }
    rows(filled, &|y, out| out.copy_from_slice(&q[y * w..(y + 1) * w]));
}

/// Takes the image of `w` columns out of the network's output of `across` columns; what is not finite and above 0 becomes 0.
pub(super) fn read(refined: &[f32], across: usize, image: &mut [f32], w: usize) {
    for (image, refined) in image.chunks_exact_mut(w).zip(refined.chunks_exact(across)) {
        for (image, refined) in image.iter_mut().zip(refined) {
            *image = if *refined > 0.0 && *refined < f32::INFINITY { *refined } else { 0.0 };
        }
    }
}
