//! A print on paper, and how dark a pixel's part of it is.

use serde::{Deserialize, Serialize};

/// Texels per metre: a quarter of a millimetre each.
const TEXELS_PER_M: f64 = 4000.0;
/// Texels per side at the most; larger sheets have larger texels.
const MAX_TEXELS: f64 = 4096.0;

/// A print: black rectangles on white paper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sheet {
    /// Width and height, metres.
    pub size_m: [f64; 2],
    /// Black parts; they do not overlap.
    pub black: Vec<Black>,
}

/// A black rectangle, metres from the sheet's top-left corner.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Black {
    /// Left side.
    pub x_m: f64,
    /// Upper side.
    pub y_m: f64,
    /// Across.
    pub width_m: f64,
    /// Down.
    pub height_m: f64,
}

impl Default for Sheet {
    fn default() -> Self {
        Self { size_m: [0.297, 0.210], black: Vec::new() }
    }
}

impl Sheet {
    pub(super) fn problem(&self) -> Option<String> {
        if self.size_m.iter().all(|s| (0.01..=5.0).contains(s)) {
            return None;
        }
        let [width, height] = self.size_m;
        Some(format!("board.sheet is {width} x {height} m; its sides must be within 0.01 and 5 m"))
    }
}

/// A sheet as a table of sums, from which the ink in any rectangle follows exactly.
#[derive(Debug)]
pub(crate) struct Print {
    columns: usize,
    rows: usize,
    half_m: [f32; 2],
    per_m: [f32; 2],
    /// Ink above and left of each corner of a texel, in 255ths of a texel; one column and row more than texels.
    sums: Vec<u32>,
}

impl Print {
    pub(crate) fn new(sheet: &Sheet) -> Self {
        let texels = sheet.size_m.map(|s| (s * TEXELS_PER_M).min(MAX_TEXELS).round().max(1.0));
        let columns = texels[0] as usize;
        let rows = texels[1] as usize;
        let per_m = [0, 1].map(|i| texels[i] / sheet.size_m[i]);
        let mut ink = vec![0f32; columns * rows];
        for black in &sheet.black {
            let across = span(black.x_m * per_m[0], black.width_m * per_m[0], columns);
            let down = span(black.y_m * per_m[1], black.height_m * per_m[1], rows);
            for (y, part_y) in down {
                for (x, part_x) in &across {
                    ink[y * columns + x] += part_x * part_y;
                }
            }
        }
        let mut sums = vec![0u32; (columns + 1) * (rows + 1)];
        for y in 0..rows {
            let mut row = 0;
            for x in 0..columns {
                row += (ink[y * columns + x].min(1.0) * 255.0).round() as u32;
                sums[(y + 1) * (columns + 1) + x + 1] = sums[y * (columns + 1) + x + 1] + row;
            }
        }
        Self {
            columns,
            rows,
            half_m: sheet.size_m.map(|s| (s / 2.0) as f32),
            per_m: per_m.map(|p| p as f32),
            sums,
        }
    }

    /// The share of ink, 0..1, in a rectangle around `at` (metres from the sheet's middle); `None` off the sheet.
    pub(crate) fn ink(&self, at: [f32; 2], extent: [f32; 2]) -> Option<f32> {
        if at[0].abs() > self.half_m[0] || at[1].abs() > self.half_m[1] {
            return None;
        }
        let edge = |i: usize, side: f32| (at[i] + self.half_m[i] + side * extent[i]) * self.per_m[i];
        let low = [edge(0, -0.5).max(0.0), edge(1, -0.5).max(0.0)];
        let high = [edge(0, 0.5).min(self.columns as f32), edge(1, 0.5).min(self.rows as f32)];
        let area = f64::from((high[0] - low[0]) * (high[1] - low[1])).max(1e-9);
        let sum = self.sum(high[0], high[1]) - self.sum(low[0], high[1]) - self.sum(high[0], low[1])
            + self.sum(low[0], low[1]);
        Some((sum / (255.0 * area)).clamp(0.0, 1.0) as f32)
    }

    /// Ink above and left of a place; between corners it grows evenly, as inside a texel.
    fn sum(&self, x: f32, y: f32) -> f64 {
        let column = (x as usize).min(self.columns - 1);
        let row = (y as usize).min(self.rows - 1);
        let right = f64::from(x - column as f32);
        let down = f64::from(y - row as f32);
        let stride = self.columns + 1;
        let at = |dx: usize, dy: usize| f64::from(self.sums[(row + dy) * stride + column + dx]);
        let top = at(0, 0) + (at(1, 0) - at(0, 0)) * right;
        let bottom = at(0, 1) + (at(1, 1) - at(0, 1)) * right;
        top + (bottom - top) * down
    }
}

/// The texels that a black stretch covers, and how much of each.
fn span(start: f64, length: f64, count: usize) -> Vec<(usize, f32)> {
    let end = (start + length).min(count as f64);
    let start = start.max(0.0);
    (start as usize..count)
        .take_while(|i| (*i as f64) < end)
        .map(|i| (i, (end.min(i as f64 + 1.0) - start.max(i as f64)) as f32))
        .collect()
}
