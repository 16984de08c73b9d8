//! Computes the area of colour that a row of depth covers: each pixel is a small piece of a plane, seen by colour.
//!
//! The plane goes through the pixel's point and follows its neighbours above, below, left and right as far as they lie on
//! the same surface, so that depth is right on the whole piece and pieces of one surface meet. The piece is projected to
//! first order around its middle.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]
#![allow(unsafe_code)] // a cast whose range is known

use super::lens::Lens32;
use super::target::{EMPTY, key};
use super::warp::{Edge, Lane, Numbers, Warp, WithRow};
use crate::simd::for_every_processor;

/// Neighbours that differ by more than this part of a pixel's depth lie on another surface
/// (Azure Kinect SDK `src/transformation/rgbz.c`, MIT, `skip_interpolation_ratio`).
const MAX_JUMP: f32 = 0.046_934_42;
/// How far beyond its projection, pixels of colour, a pixel is drawn inside a surface: noise moves neighbours apart.
const SLACK: f32 = 0.15;
/// The same where a neighbour is missing or lies on another surface: what librealsense's rule comes to.
const BORDER: f32 = 0.49;
/// A pixel that is wider or higher than this is not drawn: the point is all but in colour's pupil, and one such pixel
/// after another would take minutes.
const MAX_SPAN: i32 = 128;
/// The columns and rows of a pixel that is not seen.
pub(super) const NOWHERE: u32 = u32::MAX;

/// The areas that the pixels of a row cover.
#[derive(Debug)]
pub(super) struct Cover {
    /// First and last column of colour, in the upper and lower half.
    pub(super) columns: Vec<u32>,
    /// First and last row, likewise.
    pub(super) rows: Vec<u32>,
    /// The key of the depth along colour's axis: in the middle, of a pixel that covers one of colour's that there.
    pub(super) keys: Vec<u16>,
    /// Left alone for pixels that cover one of colour's.
    pub(super) planes: Planes,
    /// The row with one hole before and one behind it.
    here: Vec<u16>,
    /// A row of holes, above the first row and below the last.
    holes: Vec<u16>,
}

/// Depth along colour's axis as a linear function of colour's pixel, units.
#[derive(Debug)]
pub(super) struct Planes {
    /// Depth in the first column and row that the depth pixel covers.
    pub(super) z: Vec<f32>,
    /// Its change per column and per row.
    pub(super) by_u: Vec<f32>,
    pub(super) by_v: Vec<f32>,
}

impl Cover {
    pub(super) fn new(depth_width: usize) -> Self {
        let zeros = || vec![0.0; depth_width];
        Self {
            columns: vec![NOWHERE; depth_width],
            rows: vec![NOWHERE; depth_width],
            keys: vec![EMPTY; depth_width],
            planes: Planes { z: zeros(), by_u: zeros(), by_v: zeros() },
            here: vec![0; depth_width + 2],
            holes: vec![0; depth_width],
        }
    }

    /// Computes the areas that row `row` covers. With `is_point` each pixel covers one of colour's: colour is the
    /// coarser image.
    pub(super) fn find(&mut self, warp: &Warp, is_point: bool, depth: &[u16], unit: f32, row: usize) {
        let w = self.columns.len();
        let of = |row: usize| depth.get(row * w..(row + 1) * w);
        let Some(here) = of(row) else { return };
        self.here[1..=w].copy_from_slice(here);
        let above = row.checked_sub(1).and_then(of).unwrap_or(&self.holes);
        let below = of(row + 1).unwrap_or(&self.holes);
        let Planes { z, by_u, by_v } = &mut self.planes;
        let work = Finding {
            here: &self.here,
            above,
            below,
            unit,
            is_point,
            numbers: &warp.numbers,
            columns: &mut self.columns,
            rows: &mut self.rows,
            keys: &mut self.keys,
            planes: [z, by_u, by_v].map(Vec::as_mut_slice),
        };
        warp.with_row(row, work);
    }
}

/// The rule for the area that a depth pixel covers. A type and not a number: a loop for one of them is a tenth faster.
trait Shape {
    /// One pixel, where its middle is seen.
    const IS_POINT: bool;
}

struct Point;

impl Shape for Point {
    const IS_POINT: bool = true;
}

/// All pixels on which its piece of a plane is seen.
struct Area;

impl Shape for Area {
    const IS_POINT: bool = false;
}

struct Finding<'a> {
    here: &'a [u16],
    above: &'a [u16],
    below: &'a [u16],
    unit: f32,
    is_point: bool,
    numbers: &'a Numbers,
    columns: &'a mut [u32],
    rows: &'a mut [u32],
    keys: &'a mut [u16],
    planes: [&'a mut [f32]; 3],
}

impl WithRow for Finding<'_> {
    fn run<Y: Lane, L: Lens32>(self, top: Edge<'_, Y>, bottom: Edge<'_, Y>, lens: L) {
        if self.is_point {
            self.find(Point, top, bottom, lens);
        } else {
            self.find(Area, top, bottom, lens);
        }
    }
}

impl Finding<'_> {
    fn find<S: Shape, Y: Lane, L: Lens32>(self, shape: S, top: Edge<'_, Y>, bottom: Edge<'_, Y>, lens: L) {
        let Self { here, above, below, unit, is_point: _, numbers, columns, rows, keys, planes } = self;
        let [z, by_u, by_v] = planes;
        find(
            shape, here, above, below, unit, top.x, top.y, bottom.x, bottom.y, lens, numbers, columns, rows,
            keys, z, by_u, by_v,
        );
    }
}

for_every_processor! {
    fn find<S: Shape, Y: Lane, L: Lens32>(
        _shape: S, here: &[u16], above: &[u16], below: &[u16], unit: f32,
        x0: &[f32], y0: Y, x1: &[f32], y1: Y, lens: L, numbers: &Numbers,
        columns: &mut [u32], rows: &mut [u32], keys: &mut [u16],
        z: &mut [f32], by_u: &mut [f32], by_v: &mut [f32],
    ) {
        let n = columns.len();
        let left = &here[..n];
        let right = &here[2..n + 2];
        let here = &here[1..=n];
        let above = &above[..n];
        let below = &below[..n];
        // Corners: a is the first, c the one below it, d the last.
        let ax = &x0[..n];
        let cx = &x1[..n];
        let dx = &x1[1..=n];
        let ay = y0.cut(0..n);
        let cy = y1.cut(0..n);
        let dy = y1.cut(1..n + 1);
        let columns = &mut columns[..n];
        let rows = &mut rows[..n];
        let keys = &mut keys[..n];
        let z = &mut z[..n];
        let by_u = &mut by_u[..n];
        let by_v = &mut by_v[..n];
        let Numbers { r, t, k: [fx, fy, px, py], max_radius2, size: [width, height] } = *numbers;
        let per_unit = 1.0 / unit;
        let t = [t[0] * per_unit, t[1] * per_unit, t[2] * per_unit];
        let turn = |row: [f32; 3], x: f32, y: f32| row[0] * x + (row[1] * y + row[2]);
        // A change of the ray by (x, y) and of depth by z, where `ray` is turned already.
        let moved = |x: f32, y: f32, z: f32, ray: [f32; 3]| {
            let along = |k: usize| (r[k][0] * x + r[k][1] * y) + ray[k] * z;
            [along(0), along(1), along(2)]
        };
        for i in 0..n {
            let d = f32::from(here[i]);
            let limit = MAX_JUMP * d;
            let piece = piece(
                d, limit, f32::from(left[i]), f32::from(right[i]), f32::from(above[i]), f32::from(below[i]),
            );
            // The ray of the middle, and its change from column to column and from row to row.
            let rx = (ax[i] + dx[i]) * 0.5;
            let ry = (ay.at(i) + dy.at(i)) * 0.5;
            let rx_i = dx[i] - cx[i];
            let ry_i = dy.at(i) - cy.at(i);
            let rx_j = cx[i] - ax[i];
            let ry_j = cy.at(i) - ay.at(i);
            let ray = [turn(r[0], rx, ry), turn(r[1], rx, ry), turn(r[2], rx, ry)];
            let m = piece.depth;
            let q = [ray[0] * m + t[0], ray[1] * m + t[1], ray[2] * m + t[2]];
            let q_i = moved(rx_i * m, ry_i * m, piece.by_column, ray);
            let q_j = moved(rx_j * m, ry_j * m, piece.by_row, ray);
            let scale = 1.0 / q[2];
            let a = q[0] * scale;
            let b = q[1] * scale;
            let a_i = (q_i[0] - a * q_i[2]) * scale;
            let b_i = (q_i[1] - b * q_i[2]) * scale;
            let a_j = (q_j[0] - a * q_j[2]) * scale;
            let b_j = (q_j[1] - b * q_j[2]) * scale;
            let middle = lens.shown(a, b);
            let next = lens.beside(a, b, middle.0, middle.1, a_i, b_i);
            let under = lens.beside(a, b, middle.0, middle.1, a_j, b_j);
            let at_u = middle.0 * fx + px;
            let at_v = middle.1 * fy + py;
            let u_i = next.0 * fx;
            let v_i = next.1 * fy;
            let u_j = under.0 * fx;
            let v_j = under.1 * fy;
            let cross = u_i * v_j - u_j * v_i;
            let over = 1.0 / cross;
            let z_u = (q_i[2] * v_j - q_j[2] * v_i) * over;
            let z_v = (q_j[2] * u_i - q_i[2] * u_j) * over;
            // A piece that is seen edge-on has no gradient to trust.
            let steep = z_u.abs() + z_v.abs();
            let flat = if steep < MAX_JUMP * q[2] { 1.0 } else { 0.0 };
            let (z_u, z_v) = if flat > 0.0 { (z_u, z_v) } else { (0.0, 0.0) };
            let pixel = ((at_u + 0.5).floor(), (at_v + 0.5).floor());
            let there = q[2] + (z_u * (pixel.0 - at_u) + z_v * (pixel.1 - at_v));
            let (key, in_range) = key_of(if S::IS_POINT { there } else { q[2] });
            let seen = (here[i] != 0) & (q[2] > 0.0) & (a * a + b * b <= max_radius2) & in_range;
            let half_u = if S::IS_POINT { 0.0 } else { (u_i.abs() + u_j.abs()) * 0.5 + piece.slack };
            let half_v = if S::IS_POINT { 0.0 } else { (v_i.abs() + v_j.abs()) * 0.5 + piece.slack };
            let shift = if S::IS_POINT { 0.5 } else { 1.0 };
            let end = if S::IS_POINT { 0.5 } else { 0.0 };
            let across = span(at_u - half_u + shift, at_u + half_u + end, width);
            let down = span(at_v - half_v + shift, at_v + half_v + end, height);
            let seen = seen & across.1 & down.1;
            columns[i] = if seen { across.0 } else { NOWHERE };
            rows[i] = if seen { down.0 } else { NOWHERE };
            keys[i] = key;
            if !S::IS_POINT {
                let first_u = (across.0 >> 16) as f32;
                let first_v = (down.0 >> 16) as f32;
                z[i] = q[2] + (z_u * (first_u - at_u) + z_v * (first_v - at_v));
                by_u[i] = z_u;
                by_v[i] = z_v;
            }
        }
    }
}

/// A depth pixel with its surface.
#[derive(Clone, Copy)]
struct Piece {
    /// Depth in the middle.
    depth: f32,
    /// Its change from column to column and from row to row.
    by_column: f32,
    by_row: f32,
    /// How far beyond its projection the pixel is drawn.
    slack: f32,
}

/// The surface of a pixel of depth `d` through those neighbours that differ by `limit` at the most.
#[inline(always)]
fn piece(d: f32, limit: f32, left: f32, right: f32, above: f32, below: f32) -> Piece {
    // False for holes.
    let fits = |other: f32| (other - d).abs() <= limit;
    let has_left = fits(left);
    let has_right = fits(right);
    let has_above = fits(above);
    let has_below = fits(below);
    let step = |has: bool, difference: f32| if has { difference } else { 0.0 };
    let weight = |one: bool, other: bool| if one & other { 0.5 } else { 1.0 };
    let by_column = (step(has_left, d - left) + step(has_right, right - d)) * weight(has_left, has_right);
    let by_row = (step(has_above, d - above) + step(has_below, below - d)) * weight(has_above, has_below);
    let all = has_left & has_right & has_above & has_below;
    // Inside a surface the mean of the five lies on its plane, with less than half of the noise.
    let depth = if all { (d + (left + right + (above + below))) * 0.2 } else { d };
    Piece { depth, by_column, by_row, slack: if all { SLACK } else { BORDER } }
}

/// The whole numbers from `first` − 1, rounded up, to `last`, cut to the image.
#[inline(always)]
fn span(first: f32, last: f32, end: f32) -> (u32, bool) {
    let cut = |at: f32| {
        // NaN becomes −1.
        let at = if at > -1.0 { at } else { -1.0 };
        if at < end { at } else { end }
    };
    // Halves below 0 belong to no pixel; truncation would put them on the first one.
    let first = whole(cut(first));
    let last_whole = whole(cut(last));
    let inside =
        (last >= 0.0) & (first < whole(end)) & (first <= last_whole) & (last_whole - first <= MAX_SPAN);
    let last_inside = last_whole.min(whole(end) - 1);
    ((first.max(0) << 16 | last_inside.max(0)) as u32, inside)
}

/// The key of `z` units, and whether 16 bits hold it.
#[inline(always)]
pub(super) fn key_of(z: f32) -> (u16, bool) {
    let z = z + 0.5;
    // NaN is out of range too.
    let in_range = (1.0..65_536.0).contains(&z);
    (key(whole(if in_range { z } else { 1.0 }) as u16), in_range)
}

/// The whole part of a number between −1 and 2³⁰.
#[inline(always)]
pub(super) fn whole(at: f32) -> i32 {
    // SAFETY: the number is no NaN and is far within 32 bits.
    unsafe { at.to_int_unchecked() }
}
