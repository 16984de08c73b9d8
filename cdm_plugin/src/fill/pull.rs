//! From coarse to fine: holes take the depth of the coarse cells around them that look like them, and what has depth is
//! rid of noise.

use super::lanes::{Crew, wide};
use super::pyramid::Level;

/// The difference of colours (root of the sum of squares, of 255) at which a cell counts a quarter.
const COLOR: f32 = 18.0;
/// Weight of a cell however different it looks: where nothing looks alike, near ones still count.
const LEAST: f32 = 1e-2;
/// Relative spread of inverse depth beyond which coarse cells lie on two surfaces, of which one is chosen.
const SPREAD: f32 = 0.08;

/// Fills the holes of `fine` from `coarse`, which has none.
pub(super) fn fill(crew: &Crew, coarse: &Level, fine: &mut Level) {
    let (w, h) = (fine.w, fine.h);
    let color = &fine.color;
    crew.rows(&mut fine.q, w, |y, row| {
        fill_row(crew.wide, coarse, (y, h), &color[y * w..(y + 1) * w], row);
    });
}

/// How often what was filled is smoothed at each size.
const ROUNDS: usize = 2;
/// Relative difference of inverse depth up to which neighbours are smoothed together.
const SURFACE: f32 = 0.1;

/// Smooths what was filled, so that a large hole in a surface becomes a surface; what was measured stays. `spare` is as
/// large as the level at least.
pub(super) fn smooth(crew: &Crew, level: &mut Level, spare: &mut [f32]) {
    let (w, h) = (level.w, level.h);
    let spare = &mut spare[..w * h];
    for _ in 0..ROUNDS {
        let (q, share) = (&level.q, &level.share);
        crew.rows(spare, w, |y, row| {
            let (above, below) = (y.saturating_sub(1) * w, (y + 1).min(h - 1) * w);
            let at = |start: usize| &q[start..start + w];
            smooth_row(crew.wide, at(above), at(y * w), at(below), &share[y * w..(y + 1) * w], row);
        });
        level.q.copy_from_slice(spare);
    }
}

wide! {
fn smooth_row(above: &[f32], here: &[f32], below: &[f32], share: &[f32], out: &mut [f32]) {
    let w = here.len();
    let (above, below, share, out) = (&above[..w], &below[..w], &share[..w], &mut out[..w]);
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

/// The two coarse rows (or columns) nearest to a fine one, and the weight of the second.
#[inline(always)]
pub(super) const fn parents(i: usize, n_coarse: usize) -> (usize, usize) {
    let own = i / 2;
    let other = if i % 2 == 1 { own + 1 } else { own.wrapping_sub(1) };
    (own, if other >= n_coarse { own } else { other })
}

wide! {
fn fill_row(coarse: &Level, at: (usize, usize), color: &[u32], q: &mut [f32]) {
    let (y, _) = at;
    let (own, other) = parents(y, coarse.h);
    let rows = [own, other].map(|r| r * coarse.w);
    for x in 0..q.len() {
        if q[x] > 0.0 {
            continue;
        }
        let (left, right) = parents(x, coarse.w);
        let at = [rows[0] + left, rows[0] + right, rows[1] + left, rows[1] + right];
        let place = [9.0, 3.0, 3.0, 1.0];
        let mut values = [0.0f32; 4];
        let mut weights = [0.0f32; 4];
        for i in 0..4 {
            values[i] = coarse.q[at[i]];
            weights[i] = place[i] * likeness(color[x], coarse.color[at[i]]) * (coarse.share[at[i]] + 0.05);
        }
        q[x] = choose(values, weights);
    }
}
}

/// How alike two colours are, 1 for the same.
#[inline(always)]
fn likeness(a: u32, b: u32) -> f32 {
    let channel = |shift: u32| ((a >> shift) & 255) as i32 - ((b >> shift) & 255) as i32;
    let (r, g, b) = (channel(0), channel(8), channel(16));
    let square = (r * r + g * g + b * b) as f32;
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
    let (mut far, mut far_sum, mut near, mut near_sum) = (0.0f32, 0.0f32, 0.0f32, 0.0f32);
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
