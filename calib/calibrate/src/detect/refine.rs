//! A corner's place to a fraction of a pixel.

use super::GrayImage;
use glam::DVec2;

/// Steps at the most.
const STEPS: usize = 40;
/// A step below this is the last one, pixels.
const DONE_PX: f64 = 1e-3;

/// Places a corner between black and white squares: the point to which the gradients around it are perpendicular (Förstner and
/// Gülch, 1987, as OpenCV's `cornerSubPix` weighs them). `half` is half the side of the window. `None` if the window leaves the
/// image, has no corner in it, or the corner moves out of it.
pub fn refine(image: &GrayImage<'_>, start: DVec2, half: usize) -> Option<DVec2> {
    let side = 2 * half + 1;
    let reach = half as f64;
    // Falls to 1/e at the window's sides.
    let weights: Vec<f64> = (0..side).map(|i| (-((i as f64 - reach) / reach).powi(2)).exp()).collect();
    let wide = side + 2 + 2 * BLUR;
    let mut patch = vec![0.0; wide * wide];
    let mut lines = vec![0.0; wide * wide];
    let mut at = start;
    for _ in 0..STEPS {
        sample(image, at, half + 1 + BLUR, &mut patch)?;
        blur(&patch, &mut lines, wide, 1);
        blur(&lines, &mut patch, wide, wide);
        let mut a = 0.0;
        let mut b = 0.0;
        let mut c = 0.0;
        let mut right = DVec2::ZERO;
        for (row, weight_y) in weights.iter().enumerate() {
            let y = row as f64 - reach;
            for (column, weight_x) in weights.iter().enumerate() {
                let x = column as f64 - reach;
                let centre = (row + 1 + BLUR) * wide + column + 1 + BLUR;
                let gx = patch[centre + 1] - patch[centre - 1];
                let gy = patch[centre + wide] - patch[centre - wide];
                let w = weight_x * weight_y;
                let xx = gx * gx * w;
                let xy = gx * gy * w;
                let yy = gy * gy * w;
                a += xx;
                b += xy;
                c += yy;
                right += DVec2::new(xx * x + xy * y, xy * x + yy * y);
            }
        }
        let det = a * c - b * b;
        // One straight edge has gradients of one direction only.
        if det.is_nan() || det <= 1e-6 * (a + c) * (a + c) {
            return None;
        }
        let step = DVec2::new(c * right.x - b * right.y, a * right.y - b * right.x) / det;
        at += step;
        if (at - start).abs().max_element() > reach {
            return None;
        }
        if step.length() < DONE_PX {
            break;
        }
    }
    Some(at)
}

/// Pixels that [`blur`] takes from either side.
const BLUR: usize = 2;

/// Weighs each value and its neighbours `step` away by 1 4 6 4 1. An edge as sharp as a pixel pulls the corner towards the middle or the
/// side of a pixel, by up to 0.07 pixels; blurred, by 0.03. Values whose neighbours are not there are left alone.
fn blur(from: &[f64], to: &mut [f64], wide: usize, step: usize) {
    to.copy_from_slice(from);
    let first = BLUR * step;
    for i in first..wide * wide - first {
        to[i] = (from[i - 2 * step] + from[i + 2 * step]) / 16.0
            + (from[i - step] + from[i + step]) / 4.0
            + from[i] * 0.375;
    }
}

/// Bilinear samples of a square around `at`, row by row.
fn sample(image: &GrayImage<'_>, at: DVec2, half: usize, out: &mut [f64]) -> Option<()> {
    let corner = at - DVec2::splat(half as f64);
    let floor = corner.floor();
    let f = corner - floor;
    let side = 2 * half + 1;
    if !floor.is_finite() || floor.min_element() < 0.0 {
        return None;
    }
    let x0 = floor.x as usize;
    let y0 = floor.y as usize;
    if x0 + side + 1 > image.width || y0 + side + 1 > image.height {
        return None;
    }
    for row in 0..side {
        let upper = &image.pixels[(y0 + row) * image.width + x0..][..=side];
        let lower = &image.pixels[(y0 + row + 1) * image.width + x0..][..=side];
        for column in 0..side {
            let mix = |line: &[u8]| f64::from(line[column]) * (1.0 - f.x) + f64::from(line[column + 1]) * f.x;
            out[row * side + column] = mix(upper) * (1.0 - f.y) + mix(lower) * f.y;
        }
    }
    Some(())
}
