//! From images as cameras give them to the form in which they are worked on, and back.

use crate::workers::{Workers, wide};
use crate::{Color, ColorFormat, Output, RawDepth};

/// Value that cameras report beyond their range.
const SATURATED: u16 = u16::MAX;

/// Inverse depth in 1/m to `q`, 0 in holes, and colour to `packed`.
pub(super) fn load(
    workers: &Workers,
    color: &Color<'_>,
    depth: &RawDepth<'_>,
    q: &mut [f32],
    packed: &mut [u32],
) {
    let w = color.width;
    let per_unit = (1.0 / depth.unit_m) as f32;
    workers.rows2(q, packed, w, |y, q, packed| {
        inverse_row(workers.wide, &depth.pixels[y * w..(y + 1) * w], per_unit, q);
        let row = &color.pixels[y * color.stride..y * color.stride + 3 * w];
        match color.format {
            ColorFormat::Rgb8 => pack_row(workers.wide, row, 0, packed),
            ColorFormat::Bgr8 => pack_row(workers.wide, row, 2, packed),
        }
    });
}

wide! {
/// Inverse depth of a row, 1/m.
pub(super) fn inverse_row(depth: &[u16], per_unit: f32, q: &mut [f32]) {
    for (q, d) in q.iter_mut().zip(depth) {
        let inverse = per_unit / f32::from(*d);
        // A unit beyond all reason can make it infinite or 0.
        let is_hole = *d == 0 || *d == SATURATED || !(inverse > 0.0 && inverse < f32::MAX);
        *q = if is_hole { 0.0 } else { inverse };
    }
}
}

wide! {
/// `red` says which byte of a pixel is red: 0 or 2.
fn pack_row(pixels: &[u8], red: usize, packed: &mut [u32]) {
    let blue = 2 - red;
    for (out, c) in packed.iter_mut().zip(pixels.chunks_exact(3)) {
        *out = u32::from(c[red]) | u32::from(c[1]) << 8 | u32::from(c[blue]) << 16;
    }
}
}

wide! {
/// 1 where there is depth, 0 in holes.
pub(super) fn share(q: &[f32], share: &mut [f32]) {
    for (share, q) in share.iter_mut().zip(q) {
        *share = if *q > 0.0 { 1.0 } else { 0.0 };
    }
}
}

/// Writes inverse depth as it was asked for; what cannot be expressed is 0.
pub(super) fn store(workers: &Workers, q: &[f32], w: usize, out: &mut Output<'_>) {
    match out {
        Output::Units { pixels, unit_m } => {
            let per_unit = (1.0 / *unit_m) as f32;
            workers.rows(pixels, w, |y, row| units_row(workers.wide, &q[y * w..(y + 1) * w], per_unit, row));
        }
        Output::Metres(pixels) => {
            workers.rows(pixels, w, |y, row| metres_row(workers.wide, &q[y * w..(y + 1) * w], row));
        }
        Output::Inverse(pixels) => {
            workers.rows(pixels, w, |y, row| row.copy_from_slice(&q[y * w..(y + 1) * w]));
        }
    }
}

wide! {
fn units_row(q: &[f32], per_unit: f32, out: &mut [u16]) {
    for (out, q) in out.iter_mut().zip(q) {
        let units = per_unit / q + 0.5;
        // 65535 marks the end of the range and is not depth. A hole is infinite here.
        let fits = units >= 1.0 && units < f32::from(SATURATED);
        *out = if fits { units as i32 as u16 } else { 0 };
    }
}
}

wide! {
fn metres_row(q: &[f32], out: &mut [f32]) {
    for (out, q) in out.iter_mut().zip(q) {
        let metres = 1.0 / q;
        *out = if metres < f32::MAX { metres } else { 0.0 };
    }
}
}
