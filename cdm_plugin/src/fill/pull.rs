//! From coarse to fine: holes take the depth of the coarse cells around them that look like them, and what has depth is
//! rid of noise.

use super::pyramid::Level;
use crate::workers::{Workers, wide};

/// The difference of colours (root of the sum of squares, of 255) at which a cell counts a quarter.
const COLOR: f32 = 18.0;
/// Weight of a cell however different it looks: where nothing looks alike, near ones still count.
const LEAST: f32 = 1e-2;
/// Relative spread of inverse depth beyond which coarse cells lie on two surfaces, of which one is chosen.
const SPREAD: f32 = 0.08;

/// Fills the holes of `fine` from `coarse`, which has none.
pub(super) fn fill(workers: &Workers, coarse: &Level, fine: &mut Level) {
    let w = fine.w;
    let color = &fine.color;
    workers.rows(&mut fine.q, w, |y, row| {
        fill_row(workers.wide, coarse, y, &color[y * w..(y + 1) * w], row);
    });
}

/// Number of smoothing passes at each size.
const ROUNDS: usize = 2;
/// Relative difference of inverse depth up to which neighbours are smoothed together.
const SURFACE: f32 = 0.1;

/// Smooths filled pixels, so that a large hole in a surface becomes a surface; measured pixels stay. `spare` is as
/// large as the level at least.
pub(super) fn smooth(workers: &Workers, level: &mut Level, spare: &mut [f32]) {
    let w = level.w;
    let h = level.h;
    let spare = &mut spare[..w * h];
    for _ in 0..ROUNDS {
        let q = &level.q;
        let share = &level.share;
        workers.rows(spare, w, |y, row| {
            let above = y.saturating_sub(1) * w;
            let below = (y + 1).min(h - 1) * w;
            let at = |start: usize| &q[start..start + w];
            smooth_row(workers.wide, at(above), at(y * w), at(below), &share[y * w..(y + 1) * w], row);
        });
        level.q.copy_from_slice(spare);
    }
}

wide! {
fn smooth_row(above: &[f32], here: &[f32], below: &[f32], share: &[f32], out: &mut [f32]) {
    let w = here.len();
    let above = &above[..w];
    let below = &below[..w];
    let share = &share[..w];
    let out = &mut out[..w];
    let mean = |left: f32, right: f32, x: usize| {
        let q = here[x];
        let weight = |other: f32| if (other - q).abs() < SURFACE * q { 1.0 } else { 0.0 };
        let weights = [weight(left), weight(right), weight(above[x]), weight(below[x])];
        let sum = (weights[0] * left + weights[1] * right) + (weights[2] * above[x] + weights[3] * below[x]);
        let n = (weights[0] + weights[1]) + (weights[2] + weights[3]);
        let smoothed = (q + sum) / (1.0 + n);
        if share[x] > 0.0 { q } else { smoothed }
    };
    out[0] = mean(here[0], here[1.min(w - 1)], 0);
    out[w - 1] = mean(here[w.saturating_sub(2)], here[w - 1], w - 1);
    for x in 1..w.saturating_sub(1) {
        out[x] = mean(here[x - 1], here[x + 1], x);
    }
}
}

/// The two coarse rows nearest to a fine one, nearer first.
#[inline(always)]
const fn parents(i: usize, n_coarse: usize) -> (usize, usize) {
    let own = i / 2;
    let other = if i % 2 == 1 { own + 1 } else { own.wrapping_sub(1) };
    (own, if other >= n_coarse { own } else { other })
}

/// Pixels that are worked on at once; even.
const CHUNK: usize = 32;
/// Coarse cells that they look at.
const CELLS: usize = CHUNK / 2 + 2;

wide! {
/// Pixels are worked on in chunks without a condition in them, so that processors do eight at a time.
fn fill_row(coarse: &Level, y: usize, color: &[u32], q: &mut [f32]) {
    let (own, other) = parents(y, coarse.h);
    for (i, (q, color)) in q.chunks_mut(CHUNK).zip(color.chunks(CHUNK)).enumerate() {
        if q.iter().all(|q| *q > 0.0) {
            continue;
        }
        let mut colors = [0u32; CHUNK];
        colors[..color.len()].copy_from_slice(color);
        let mut values = [[0.0f32; CHUNK]; 4];
        let mut weights = [[0.0f32; CHUNK]; 4];
        for (k, (row, near)) in [(own, 0.75), (other, 0.25)].into_iter().enumerate() {
            let start = row * coarse.w;
            let (cell_q, cell_share, cell_color) = cells(coarse, start, i * CHUNK / 2);
            for m in 0..CHUNK / 2 {
                // Of two pixels in one cell, the left one looks to the left as well, the right one to the right.
                for (side, other) in [(0, m), (1, m + 2)] {
                    let x = 2 * m + side;
                    values[2 * k][x] = cell_q[m + 1];
                    values[2 * k + 1][x] = cell_q[other];
                    let share = [cell_share[m + 1] + 0.05, cell_share[other] + 0.05];
                    weights[2 * k][x] = near * 0.75 * share[0] * likeness(colors[x], cell_color[m + 1]);
                    weights[2 * k + 1][x] = near * 0.25 * share[1] * likeness(colors[x], cell_color[other]);
                }
            }
        }
        let mut chosen = [0.0f32; CHUNK];
        for x in 0..CHUNK {
            let of = |a: &[[f32; CHUNK]; 4]| [a[0][x], a[1][x], a[2][x], a[3][x]];
            chosen[x] = choose(of(&values), of(&weights));
        }
        for (q, chosen) in q.iter_mut().zip(chosen) {
            *q = if *q > 0.0 { *q } else { chosen };
        }
    }
}
}

/// The cells of a coarse row from the one before `first` on; beyond the ends it is the last one.
#[inline(always)]
fn cells(coarse: &Level, start: usize, first: usize) -> ([f32; CELLS], [f32; CELLS], [u32; CELLS]) {
    let row = start..start + coarse.w;
    let q = &coarse.q[row.clone()];
    let share = &coarse.share[row.clone()];
    let color = &coarse.color[row];
    let mut out = ([0.0; CELLS], [0.0; CELLS], [0; CELLS]);
    for m in 0..CELLS {
        let at = (first + m).saturating_sub(1).min(coarse.w - 1);
        (out.0[m], out.1[m], out.2[m]) = (q[at], share[at], color[at]);
    }
    out
}

/// How alike two colours are, 1 for the same.
#[inline(always)]
fn likeness(a: u32, b: u32) -> f32 {
    let channel = |shift: u32| ((a >> shift) & 255) as i32 as f32 - ((b >> shift) & 255) as i32 as f32;
    let r = channel(0);
    let g = channel(8);
    let b = channel(16);
    let square = (r * r + g * g) + b * b;
    let near = 1.0 / (1.0 + square * (1.0 / (COLOR * COLOR)));
    near * near + LEAST
}

/// The weighted mean of values on one surface; of two surfaces that of the one that weighs more, the farther one when
/// they weigh about the same.
#[inline(always)]
fn choose(values: [f32; 4], weights: [f32; 4]) -> f32 {
    let low = values[0].min(values[1]).min(values[2].min(values[3]));
    let high = values[0].max(values[1]).max(values[2].max(values[3]));
    let middle = 0.5 * (low + high);
    let is_split = high - low > SPREAD * low;
    let mut far = 0.0f32;
    let mut far_sum = 0.0f32;
    let mut near = 0.0f32;
    let mut near_sum = 0.0f32;
    for i in 0..4 {
        let is_near = values[i] > middle;
        let (n, f) = if is_near { (weights[i], 0.0) } else { (0.0, weights[i]) };
        near += n;
        far += f;
        near_sum += n * values[i];
        far_sum += f * values[i];
    }
    let both = (near_sum + far_sum) / (near + far);
    let one = if near > 1.5 * far { near_sum / near } else { far_sum / far };
    if is_split { one } else { both }
}
