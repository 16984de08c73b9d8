//! Position embeddings for inputs of any size.
//!
//! DINOv2 learnt one embedding for each place of a 37x37 grid; for another grid they are resized as PyTorch's
//! `interpolate(mode="bicubic", scale_factor=(n + 0.1) / 37)` does it (aten/src/ATen/native/UpSample.h, BSD-3-Clause): a = -0.75,
//! the border repeated, no smoothing, and coordinates by the *given* scale, which is not the ratio of the sizes.

use crate::arch::{Architecture, ENCODERS, PATCH};
use crate::{NetShape, PositionEmbeddings, Result, Weights};

/// Offset that DINOv2 adds to the size before the division.
const OFFSET: f64 = 0.1;

/// The position embeddings as they were learnt.
#[derive(Debug)]
pub struct Positions {
    grid: usize,
    width: usize,
    learnt: [Vec<f32>; 2],
}

impl Positions {
    /// Those of both encoders.
    ///
    /// # Errors
    /// [`crate::ErrorKind::BadModel`] when they are missing from `weights`, or not of the shape that `arch` says.
    pub fn read(arch: &Architecture, weights: &Weights) -> Result<Self> {
        let shape = [1, 1 + arch.grid * arch.grid, arch.width];
        let [rgb, depth] = ENCODERS.map(|encoder| weights.floats(&format!("{encoder}.pos_embed"), &shape));
        Ok(Self { grid: arch.grid, width: arch.width, learnt: [rgb?, depth?] })
    }

    /// For inputs of the size of `shape`; its batch has no effect.
    pub fn at(&self, shape: NetShape) -> PositionEmbeddings {
        let rows = shape.height / PATCH;
        let columns = shape.width / PATCH;
        let [rgb, depth] =
            self.learnt.each_ref().map(|learnt| resize(learnt, self.grid, self.width, rows, columns));
        PositionEmbeddings { rgb, depth }
    }
}

/// `learnt` is `[1 + grid * grid, channels]`, the class token's first; so is the result, for `rows` and `columns`.
pub(super) fn resize(learnt: &[f32], grid: usize, channels: usize, rows: usize, columns: usize) -> Vec<f32> {
    if rows == grid && columns == grid {
        return learnt.to_vec();
    }
    let (class, grid_values) = learnt.split_at(channels);
    let mut out = Vec::with_capacity((1 + rows * columns) * channels);
    out.extend_from_slice(class);
    let rows = taps(grid, rows);
    let columns = taps(grid, columns);
    let mut line = vec![0.0f32; grid * channels];
    for (row_sources, row_weights) in &rows {
        line.fill(0.0);
        for (source, w) in row_sources.iter().zip(row_weights) {
            add_scaled(&mut line, &grid_values[source * grid * channels..][..grid * channels], *w);
        }
        for (sources, weights) in &columns {
            let start = out.len();
            out.resize(start + channels, 0.0);
            for (source, w) in sources.iter().zip(weights) {
                add_scaled(&mut out[start..], &line[source * channels..][..channels], *w);
            }
        }
    }
    out
}

fn add_scaled(to: &mut [f32], from: &[f32], w: f32) {
    for (t, f) in to.iter_mut().zip(from) {
        *t += f * w;
    }
}

/// The four sources and weights of each of `to` places on an axis of `grid`.
fn taps(grid: usize, to: usize) -> Vec<([usize; 4], [f32; 4])> {
    let step = (1.0 / ((to as f64 + OFFSET) / grid as f64)) as f32;
    let last = grid as i64 - 1;
    (0..to)
        .map(|i| {
            let at = step * (i as f32 + 0.5) - 0.5;
            let floor = at.floor();
            let sources = [-1, 0, 1, 2].map(|k| (floor as i64 + k).clamp(0, last) as usize);
            (sources, super::cubic::weights(at - floor))
        })
        .collect()
}
