//! The network's output to depth at the image's size.

use super::depth::units_per_metre;
use crate::Output;
use crate::workers::{Workers, wide};

/// One row of the network's output, converted.
#[derive(Debug)]
pub(super) struct Row {
    units: Vec<u16>,
    metres: Vec<f32>,
}

/// `v` where it is a number above 0, else 0.
#[inline(always)]
fn positive(v: f32) -> f32 {
    if v > 0.0 && v < f32::INFINITY { v } else { 0.0 }
}

/// Converts inverse depth to metres; 0 where depth is missing or 1/m is so small that metres are infinite.
#[inline(always)]
fn metres(inverse: f32) -> f32 {
    positive(1.0 / positive(inverse))
}

/// Units from metres, rounded; 0 where they do not fit. 65535 does not: readers take it for a hole.
#[inline(always)]
fn units(metres: f32, per_metre: f64) -> u16 {
    let units = f64::from(metres) * per_metre + 0.5;
    if units < f64::from(u16::MAX) { units as u16 } else { 0 }
}

impl Row {
    pub(super) fn new(width: usize) -> Self {
        Self { units: vec![0; width], metres: vec![0.0; width] }
    }
}

/// The network's output and its place in the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Source<'a> {
    /// The output.
    pub y: &'a [f32],
    /// For each row and column of the image, that of `y`.
    pub rows: &'a [u32],
    pub columns: &'a [u32],
}

impl Source<'_> {
    /// Writes the image `out` in bands of rows, each with one of `scratch`.
    pub(super) fn write<B: AsMut<Row> + Send>(
        &self,
        workers: &Workers,
        scratch: &mut [B],
        out: &mut Output<'_>,
    ) {
        let width = self.columns.len();
        let wide = workers.wide;
        let from = |first: usize| Self { rows: &self.rows[first..], ..*self };
        match out {
            Output::Units { pixels, unit_m } => {
                let per_metre = units_per_metre(*unit_m);
                workers.bands(scratch, [pixels], width, |first, band, [out]| {
                    to_units(wide, from(first), &mut band.as_mut().units, out, per_metre);
                });
            }
            Output::Metres(pixels) => workers.bands(scratch, [pixels], width, |first, band, [out]| {
                to_metres(wide, from(first), &mut band.as_mut().metres, out);
            }),
            Output::Inverse(pixels) => workers.bands(scratch, [pixels], width, |first, band, [out]| {
                to_inverse(wide, from(first), &mut band.as_mut().metres, out);
            }),
        }
    }
}

wide! {
    fn to_units(source: Source<'_>, converted: &mut [u16], out: &mut [u16], per_metre: f64) {
        spread(source, converted, out, |v| units(metres(v), per_metre));
    }
}

wide! {
    fn to_metres(source: Source<'_>, converted: &mut [f32], out: &mut [f32]) {
        spread(source, converted, out, metres);
    }
}

wide! {
    fn to_inverse(source: Source<'_>, converted: &mut [f32], out: &mut [f32]) {
        spread(source, converted, out, positive);
    }
}

/// Converts each row of `y` once, takes its columns once, and repeats what several rows of the image share.
#[inline(always)]
fn spread<T: Copy>(source: Source<'_>, converted: &mut [T], out: &mut [T], convert: impl Fn(f32) -> T) {
    let Source { y, rows, columns } = source;
    let width = columns.len();
    let net_width = converted.len();
    let mut last = None;
    for (i, row) in rows.iter().enumerate().take(out.len() / width) {
        if last == Some(*row) {
            out.copy_within((i - 1) * width..i * width, i * width);
            continue;
        }
        last = Some(*row);
        let source = &y[*row as usize * net_width..][..net_width];
        for (c, v) in converted.iter_mut().zip(source) {
            *c = convert(*v);
        }
        for (o, column) in out[i * width..][..width].iter_mut().zip(columns) {
            *o = converted[*column as usize];
        }
    }
}
