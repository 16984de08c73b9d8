//! Limits the distance from measured pixels over which holes are filled: beyond, depth is unknown.
//!
//! Distances are measured between the cells of 4x4 pixels of the third pyramid level, with 3 to a neighbour and 4 across
//! a corner, which is within a twelfth of the straight way.

use super::pyramid::Level;

/// Pixels along a side of a cell.
pub(super) const CELL: usize = 4;
/// Steps to a neighbour.
const SIDE: u16 = 3;
/// Steps across a corner.
const CORNER: u16 = 4;

/// Finds pixels out of reach; keeps its buffers from image to image.
#[derive(Debug, Default)]
pub(super) struct Reach {
    /// Steps from each cell to the next one with depth.
    steps: Vec<u16>,
}

impl Reach {
    /// Makes room for cells of `w` by `h`.
    pub(super) fn resize(&mut self, w: usize, h: usize) {
        self.steps.resize(w * h, 0);
    }

    /// Measures the way from every cell to the nearest with depth.
    pub(super) fn measure(&mut self, cells: &Level) {
        let w = cells.w;
        let h = cells.h;
        let steps = &mut self.steps[..w * h];
        for (steps, share) in steps.iter_mut().zip(&cells.share) {
            *steps = if *share > 0.0 { 0 } else { u16::MAX };
        }
        for y in 0..h {
            for x in 0..w {
                let mut least = steps[y * w + x];
                let mut by = |at: usize, way: u16| least = least.min(steps[at].saturating_add(way));
                if x > 0 {
                    by(y * w + x - 1, SIDE);
                }
                if y > 0 {
                    by((y - 1) * w + x, SIDE);
                    by((y - 1) * w + x.saturating_sub(1), CORNER);
                    by((y - 1) * w + (x + 1).min(w - 1), CORNER);
                }
                steps[y * w + x] = least;
            }
        }
        for y in (0..h).rev() {
            for x in (0..w).rev() {
                let mut least = steps[y * w + x];
                let mut by = |at: usize, way: u16| least = least.min(steps[at].saturating_add(way));
                if x + 1 < w {
                    by(y * w + x + 1, SIDE);
                }
                if y + 1 < h {
                    by((y + 1) * w + x, SIDE);
                    by((y + 1) * w + x.saturating_sub(1), CORNER);
                    by((y + 1) * w + (x + 1).min(w - 1), CORNER);
                }
                steps[y * w + x] = least;
            }
        }
    }

    /// Empties the cells of `q`, an image of `w` columns, that lie more than `pixels` from depth.
    pub(super) fn forget(&self, q: &mut [f32], w: usize, pixels: usize) {
        let cells = w.div_ceil(CELL);
        let limit = pixels * usize::from(SIDE) / CELL;
        for (y, row) in q.chunks_exact_mut(w).enumerate() {
            let steps = &self.steps[y / CELL * cells..][..cells];
            for (q, steps) in row.chunks_mut(CELL).zip(steps) {
                if usize::from(*steps) > limit {
                    q.fill(0.0);
                }
            }
        }
    }
}
