//! Finds small parts of the left image in the right one, rows included.
//!
//! Distinctive places of a small copy are searched for across rows and columns, those that look like others of their own
//! image or of the right one are left out, and what is left is followed to the full size and there to parts of a pixel
//! (Lucas and Kanade 1981, with brightness, contrast and the slopes of disparity as unknowns).

use super::super::Gray;
use core::ops::RangeInclusive;

/// Side of what is compared in the small copies, pixels. Eight bytes are one load.
const PATCH: usize = 8;
/// Side of the squares of the small copy of which each gives one place at most, pixels.
const CELL: usize = 12;
/// Half of the side of what is compared in the end.
const RADIUS: isize = 7;
const COUNT: usize = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as usize;
/// Least correlation of a match in the small copy. Images of rooms have 0.95.
const ALIKE: f64 = 0.7;
/// How much further from 1 the correlation of any other place must be, as a factor.
const DISTINCT: f64 = 2.0;
/// The same within the rows of the match, where a wrong disparity does no harm.
const DISTINCT_IN_ROW: f64 = 1.0;
/// Two that are this near to the same are the same: images without noise match entirely, in every place that repeats.
const LEAST_OFF: f64 = 0.01;
/// Least variance of grey along the worse direction, levels squared for each pixel.
const TEXTURE: f64 = 6.0;
/// Least share of the image's variance that the match in the end explains.
const EXPLAINED: f64 = 0.8;
/// A match whose rows are less certain than this is ignored, pixels.
const UNSURE_PX: f64 = 0.15;
/// How far the last step may end from where it began, pixels.
const STRAYED_PX: f64 = 2.5;
/// Steps of the last search; four are enough for what converges.
const STEPS: usize = 8;

/// Search range in the smallest copies.
#[derive(Debug, Clone, Copy)]
pub struct Reach {
    /// Disparities, some of them negative.
    pub near: isize,
    pub far: isize,
    /// Rows up and down.
    pub rows: isize,
}

type Patch = [i16; PATCH * PATCH];

/// A part with the sums that its correlation needs.
struct Part {
    pixels: Patch,
    sum: i32,
    /// Of the squares of the differences from the mean, times the number of pixels.
    spread: i64,
}

const N: i32 = (PATCH * PATCH) as i32;

/// The part whose middle is at a place, if all of it is in the image.
fn patch(image: &Gray<'_>, x: isize, y: isize) -> Option<Patch> {
    let half = PATCH as isize / 2;
    let x = usize::try_from(x - half).ok()?;
    let y = usize::try_from(y - half).ok()?;
    if x + PATCH > image.width || y + PATCH > image.height {
        return None;
    }
    let mut out = [0; PATCH * PATCH];
    for (i, out) in out.as_chunks_mut::<PATCH>().0.iter_mut().enumerate() {
        let row: &[u8; PATCH] = image.pixels[(y + i) * image.stride + x..].first_chunk()?;
        *out = row.map(i16::from);
    }
    Some(out)
}

impl Part {
    fn at(image: &Gray<'_>, x: isize, y: isize) -> Option<Self> {
        let pixels = patch(image, x, y)?;
        let sum = pixels.iter().map(|v| i32::from(*v)).sum();
        let squares: i32 = pixels.iter().map(|v| i32::from(*v) * i32::from(*v)).sum();
        Some(Self { pixels, sum, spread: i64::from(N * squares) - i64::from(sum) * i64::from(sum) })
    }

    /// How well another part fits whatever its brightness and contrast are: 1 for entirely, -1 at worst.
    fn correlation(&self, other: &Patch) -> f64 {
        let mut sum = 0_i32;
        let mut squares = 0_i32;
        let mut products = 0_i32;
        for (a, b) in self.pixels.iter().zip(other) {
            let a = i32::from(*a);
            let b = i32::from(*b);
            (sum, squares, products) = (sum + b, squares + b * b, products + a * b);
        }
        let spread = i64::from(N * squares) - i64::from(sum) * i64::from(sum);
        let both = i64::from(N * products) - i64::from(self.sum) * i64::from(sum);
        if spread <= 0 || self.spread <= 0 {
            return 0.0;
        }
        both as f64 / (self.spread as f64 * spread as f64).sqrt()
    }
}

/// Left or upper sides of the squares along a side of the small copy.
fn squares(side: usize) -> impl ExactSizeIterator<Item = usize> {
    let margin = PATCH / 2 + 1;
    (margin..side.saturating_sub(margin).max(margin)).step_by(CELL)
}

/// Places that a small copy gives at most.
pub fn most_places(width: usize, height: usize) -> usize {
    squares(width).len() * squares(height).len()
}

/// The most distinctive place of each square of the small copy: where grey changes most along the direction in which it
/// changes least (Shi and Tomasi 1994). `out` has room for [`most_places`].
pub fn places(image: &Gray<'_>, out: &mut Vec<(u16, u16)>) {
    out.clear();
    let half = PATCH as isize / 2;
    let w = image.width as isize;
    let h = image.height as isize;
    for top in squares(image.height).map(|at| at as isize) {
        for left in squares(image.width).map(|at| at as isize) {
            let mut best = (TEXTURE, None);
            for y in (top..(top + CELL as isize).min(h - half - 1)).step_by(2) {
                for x in (left..(left + CELL as isize).min(w - half - 1)).step_by(2) {
                    let texture = texture(image, x, y);
                    if texture > best.0 {
                        best = (texture, Some((x as u16, y as u16)));
                    }
                }
            }
            out.extend(best.1);
        }
    }
}

/// The lesser eigenvalue of the tensor of grey around a place that is one pixel or more inside, for each pixel.
fn texture(image: &Gray<'_>, x: isize, y: isize) -> f64 {
    let half = PATCH as isize / 2;
    let mut xx = 0_i32;
    let mut xy = 0_i32;
    let mut yy = 0_i32;
    for row in y - half..y + half {
        let at = |row: isize| &image.row(row as usize)[(x - half - 1) as usize..][..PATCH + 2];
        let above = at(row - 1);
        let here = at(row);
        let below = at(row + 1);
        for i in 1..=PATCH {
            let dx = i32::from(here[i + 1]) - i32::from(here[i - 1]);
            let dy = i32::from(below[i]) - i32::from(above[i]);
            (xx, xy, yy) = (xx + dx * dx, xy + dx * dy, yy + dy * dy);
        }
    }
    let [xx, xy, yy] = [xx, xy, yy].map(|s| f64::from(s) / (4.0 * f64::from(N)));
    let middle = f64::midpoint(xx, yy);
    middle - (middle * middle - (xx * yy - xy * xy)).max(0.0).sqrt()
}

/// The best of a search.
#[derive(Clone, Copy)]
struct Best {
    correlation: f64,
    /// How far it lies to the left, and down.
    left: isize,
    down: isize,
}

/// The best place in `image` for a part around `(x, y)`, and the best correlations of places that are not its
/// neighbours: in other rows, and in its own.
fn search(
    part: &Part,
    image: &Gray<'_>,
    (x, y): (isize, isize),
    columns: RangeInclusive<isize>,
    rows: isize,
    scores: &mut Vec<f32>,
) -> Option<(Best, [f64; 2])> {
    let wide = (columns.end() - columns.start() + 1) as usize;
    scores.clear();
    let mut best = Best { correlation: -1.0, left: 0, down: 0 };
    for down in -rows..=rows {
        for left in columns.clone() {
            let correlation = patch(image, x - left, y + down).map_or(-1.0, |other| part.correlation(&other));
            scores.push(correlation as f32);
            if correlation > best.correlation {
                best = Best { correlation, left, down };
            }
        }
    }
    if best.correlation < 0.0 || best.down.abs() == rows {
        return None;
    }
    let mut others = [-1.0_f64; 2];
    for (i, score) in scores.iter().enumerate() {
        let down = (i / wide) as isize - rows;
        let left = (i % wide) as isize + columns.start();
        let by_rows = (down - best.down).abs();
        let by_columns = (left - best.left).abs();
        if by_rows > 2 || by_columns > 2 {
            let kind = usize::from(by_rows <= 1);
            others[kind] = others[kind].max(f64::from(*score));
        }
    }
    Some((best, others))
}

/// Where the part around a place of the left image is in the right one, in whole pixels to the left and down; `None`
/// where that is ambiguous.
pub fn coarse(
    [left, right]: [&Gray<'_>; 2],
    at: (isize, isize),
    reach: Reach,
    scores: &mut Vec<f32>,
) -> Option<(isize, isize)> {
    let part = Part::at(left, at.0, at.1)?;
    let (best, [elsewhere, in_row]) = search(&part, right, at, reach.near..=reach.far, reach.rows, scores)?;
    let off = (1.0 - best.correlation).max(LEAST_OFF);
    if best.correlation < ALIKE || 1.0 - elsewhere < DISTINCT * off || 1.0 - in_row < DISTINCT_IN_ROW * off {
        return None;
    }
    // A part that its own image has twice may match the wrong one, with the right one out of reach.
    let (_, [elsewhere, _]) = search(&part, left, at, -reach.far..=reach.far, reach.rows, scores)?;
    (1.0 - elsewhere > DISTINCT * off).then_some((best.left, best.down))
}

/// The same, one size up, for what was found one size down.
pub fn follow(
    [left, right]: [&Gray<'_>; 2],
    at: (isize, isize),
    (x, down): (isize, isize),
) -> Option<(isize, isize)> {
    let part = Part::at(left, at.0, at.1)?;
    let mut best = (-1.0, None);
    for down in 2 * down - 2..=2 * down + 2 {
        for x in 2 * x - 2..=2 * x + 2 {
            let correlation = part.correlation(&patch(right, at.0 - x, at.1 + down)?);
            if correlation > best.0 {
                best = (correlation, Some((x, down)));
            }
        }
    }
    best.1
}

/// Unknowns of the last step: contrast, brightness, columns, their slopes along both, and rows.
const UNKNOWNS: usize = 6;
type Square = [[f64; UNKNOWNS]; UNKNOWNS];

/// The inverse of a positive definite matrix (Gauss and Jordan without pivots); `None` when it is not.
fn inverse(mut a: Square) -> Option<Square> {
    let mut out = [[0.0; UNKNOWNS]; UNKNOWNS];
    for (i, row) in out.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    let least = 1e-9 * (0..UNKNOWNS).map(|i| a[i][i]).fold(0.0, f64::max);
    for i in 0..UNKNOWNS {
        let pivot = a[i][i];
        if pivot.is_nan() || pivot <= least {
            return None;
        }
        for k in 0..UNKNOWNS {
            a[i][k] /= pivot;
            out[i][k] /= pivot;
        }
        let from = a[i];
        let into = out[i];
        for j in (0..UNKNOWNS).filter(|j| *j != i) {
            let factor = a[j][i];
            for k in 0..UNKNOWNS {
                a[j][k] -= factor * from[k];
                out[j][k] -= factor * into[k];
            }
        }
    }
    Some(out)
}

/// How many rows lower the part around a place lies in the right image, to parts of a pixel, beginning at what was found in
/// whole ones; `None` where the image does not say.
pub fn fine(
    [left, right]: [&Gray<'_>; 2],
    (x, y): (isize, isize),
    (columns, down): (isize, isize),
) -> Option<f64> {
    let inside = |p: &Gray<'_>, x: isize, y: isize, by: isize| {
        x >= by && y >= by && x + by < p.width as isize && y + by < p.height as isize
    };
    if !inside(left, x, y, RADIUS + 1) {
        return None;
    }
    let grey = |p: &Gray<'_>, x: isize, y: isize| f64::from(p.row(y as usize)[x as usize]);
    // The effect of each unknown on each pixel, to first order.
    let mut columns_of = [[0.0; UNKNOWNS]; COUNT];
    let mut normal = [[0.0; UNKNOWNS]; UNKNOWNS];
    let places = || (-RADIUS..=RADIUS).flat_map(|v| (-RADIUS..=RADIUS).map(move |u| (u, v)));
    let mean = places().map(|(u, v)| grey(left, x + u, y + v)).sum::<f64>() / COUNT as f64;
    for ((u, v), row) in places().zip(&mut columns_of) {
        let px = x + u;
        let py = y + v;
        let gx = 0.5 * (grey(left, px + 1, py) - grey(left, px - 1, py));
        let gy = 0.5 * (grey(left, px, py + 1) - grey(left, px, py - 1));
        let [su, sv] = [u, v].map(|n| n as f64 / RADIUS as f64);
        *row = [grey(left, px, py) - mean, 1.0, gx, gx * su, gx * sv, gy];
        for (i, line) in normal.iter_mut().enumerate() {
            for (k, to) in line.iter_mut().enumerate() {
                *to += row[i] * row[k];
            }
        }
    }
    let inverse = inverse(normal)?;
    // Columns to the right, their slopes along both directions, and rows down.
    let mut at = [-(columns as f64), 0.0, 0.0, down as f64];
    let begin = at;
    for _ in 0..STEPS {
        let mut sums = [0.0; UNKNOWNS];
        let mut total = 0.0;
        let mut squares = 0.0;
        for ((u, v), row) in places().zip(&columns_of) {
            let [su, sv] = [u, v].map(|n| n as f64 / RADIUS as f64);
            let px = (x + u) as f64 + at[0] + at[1] * su + at[2] * sv;
            let py = (y + v) as f64 + at[3];
            let ix = px.floor();
            let iy = py.floor();
            let fx = px - ix;
            let fy = py - iy;
            let ix = ix as isize;
            let iy = iy as isize;
            if !inside(right, ix, iy, 0) || !inside(right, ix + 1, iy + 1, 0) {
                return None;
            }
            let line = |y| grey(right, ix, y) * (1.0 - fx) + grey(right, ix + 1, y) * fx;
            let value = line(iy) * (1.0 - fy) + line(iy + 1) * fy;
            for (sum, c) in sums.iter_mut().zip(row) {
                *sum += c * value;
            }
            (total, squares) = (total + value, squares + value * value);
        }
        let solution: [f64; UNKNOWNS] =
            core::array::from_fn(|i| inverse[i].iter().zip(&sums).map(|(a, b)| a * b).sum());
        let contrast = solution[0];
        if !(0.3..=3.0).contains(&contrast) {
            return None;
        }
        let mut moved = 0.0_f64;
        for (at, q) in at.iter_mut().zip(&solution[2..]) {
            *at -= q / contrast;
            moved = moved.max((q / contrast).abs());
        }
        let strayed = (at[0] - begin[0]).abs().max((at[3] - begin[3]).abs());
        if strayed > STRAYED_PX || at[1].abs().max(at[2].abs()) > 0.5 * RADIUS as f64 {
            return None;
        }
        if moved < 0.01 {
            let spread = squares - total * total / COUNT as f64;
            let explained: f64 = solution.iter().zip(&sums).map(|(a, b)| a * b).sum();
            let left_over = (squares - explained).max(0.0);
            let noise = left_over / (COUNT - UNKNOWNS) as f64;
            let unsure = (noise * inverse[5][5]).sqrt() / contrast;
            return (left_over < (1.0 - EXPLAINED) * spread && unsure < UNSURE_PX).then_some(at[3]);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 96;

    fn image(seed: u32) -> Vec<u8> {
        let mix = |i: u32| (i ^ seed.wrapping_mul(0x9E37_79B9)).wrapping_mul(2_654_435_761);
        (0..(SIDE * SIDE) as u32).map(|i| (mix(mix(i) >> 7) >> 24) as u8).collect()
    }

    /// Copies the 12x12 pixels around column `x` and row `y` of `from` to those around `to_x` and `to_y` of `to`.
    fn put(from: &[u8], x: usize, y: usize, to: &mut [u8], to_x: usize, to_y: usize) {
        for row in 0..12 {
            let line = (y - 6 + row) * SIDE + x - 6;
            to[(to_y - 6 + row) * SIDE + to_x - 6..][..12].copy_from_slice(&from[line..line + 12]);
        }
    }

    fn found(left: &[u8], right: &[u8]) -> Option<(isize, isize)> {
        let [left, right] = [left, right].map(|p| Gray::packed(p, SIDE, SIDE));
        coarse([&left, &right], (60, 48), Reach { near: -4, far: 30, rows: 5 }, &mut Vec::new())
    }

    #[test]
    fn what_there_is_twice_is_not_taken() {
        let left = image(1);
        let nothing = image(2);
        let mut right = nothing.clone();
        put(&left, 60, 48, &mut right, 46, 46);
        assert_eq!(found(&left, &right), Some((14, -2)));
        assert_eq!(found(&left, &nothing), None);
        let mut twice = right.clone();
        put(&left, 60, 48, &mut twice, 74 - 14, 51);
        assert_eq!(found(&left, &twice), None, "the right image has it twice");
        let mut own = left.clone();
        put(&left, 60, 48, &mut own, 80, 45);
        assert_eq!(found(&own, &right), None, "the left image has it twice");
    }

    /// Half of another image over the right one: it may still be the best place, and says little of where that is.
    #[test]
    fn what_is_half_something_else_is_not_measured() {
        let left = image(1);
        let other = image(5);
        let mixed: Vec<u8> = left.iter().zip(&other).map(|(a, b)| a.midpoint(*b)).collect();
        let fine = |right: &[u8]| {
            let [left, right] = [&left[..], right].map(|p| Gray::packed(p, SIDE, SIDE));
            fine([&left, &right], (48, 48), (0, 0))
        };
        assert!(fine(&left).is_some_and(|rows| rows.abs() < 1e-6));
        assert_eq!(fine(&mixed), None);
    }
}
