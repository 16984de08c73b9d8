//! The network's output to depth at the image's size.

use super::depth::units_per_metre;
use crate::Output;

/// One row of the network's output, converted.
#[derive(Debug)]
pub(super) struct Row {
    units: Vec<u16>,
    metres: Vec<f32>,
}

/// `v` where it is a number above 0, else 0.
fn positive(v: f32) -> f32 {
    if v > 0.0 && v < f32::INFINITY { v } else { 0.0 }
}

/// Converts inverse depth to metres; 0 where depth is missing or 1/m is so small that metres are infinite.
fn metres(inverse: f32) -> f32 {
    positive(1.0 / positive(inverse))
}

/// Units from metres, rounded; 0 where they do not fit. 65535 does not: readers take it for a hole.
fn units(metres: f32, per_metre: f64) -> u16 {
    let units = f64::from(metres) * per_metre + 0.5;
    if units < f64::from(u16::MAX) { units as u16 } else { 0 }
}

impl Row {
    pub(super) fn new(width: usize) -> Self {
        Self { units: vec![0; width], metres: vec![0.0; width] }
    }

    /// Writes the row and column of `y` that `rows` and `columns` name for each pixel of `out`.
    pub(super) fn write(&mut self, y: &[f32], rows: &[u32], columns: &[u32], out: &mut Output<'_>) {
        match out {
            Output::Units { pixels, unit_m } => {
                let per_metre = units_per_metre(*unit_m);
                spread(y, &mut self.units, rows, columns, pixels, |v| units(metres(v), per_metre));
            }
            Output::Metres(pixels) => spread(y, &mut self.metres, rows, columns, pixels, metres),
            Output::Inverse(pixels) => spread(y, &mut self.metres, rows, columns, pixels, positive),
        }
    }
}

/// Converts each row of `y` once, takes its columns once, and repeats what several rows of the image share.
fn spread<T: Copy>(
    y: &[f32],
    converted: &mut [T],
    rows: &[u32],
    columns: &[u32],
    out: &mut [T],
    convert: impl Fn(f32) -> T,
) {
    let width = columns.len();
    let net_width = converted.len();
    let mut last = None;
    for (i, row) in rows.iter().enumerate() {
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
