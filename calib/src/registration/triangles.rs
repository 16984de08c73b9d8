//! Drawing every 2x2 neighbourhood of depth as two triangles; see [`super::Method::Triangles`].
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::lens::Lens32;
use super::target::{Target, key};
use super::warp::{Lane, Numbers, Warp, WithRow};
use crate::simd::for_every_processor;

/// A neighbourhood whose depths differ by more than this part of the least is the border of an object
/// (Azure Kinect SDK `src/transformation/rgbz.c`, `skip_interpolation_ratio`).
const MAX_JUMP: f32 = 0.046_934_42;
/// A neighbourhood that is drawn wider or higher than this is not one: it is all but in colour's pupil.
const MAX_SPAN: f32 = 128.0;

/// Where the pixels of a row are seen. A hole, and what colour's lens cannot show, is at NaN.
#[derive(Debug, Default)]
struct Seen {
    u: Vec<f32>,
    v: Vec<f32>,
    /// Depth along colour's axis, in units of depth.
    z: Vec<f32>,
}

impl Seen {
    fn new(width: usize) -> Self {
        Self { u: vec![0.0; width], v: vec![0.0; width], z: vec![0.0; width] }
    }

    fn fill(&mut self, warp: &Warp, depth: &[u16], unit: f32, row: usize) {
        warp.with_row(row, depth.len(), Middles { depth, unit, numbers: &warp.numbers, seen: self });
    }
}

struct Middles<'a> {
    depth: &'a [u16],
    unit: f32,
    numbers: &'a Numbers,
    seen: &'a mut Seen,
}

impl WithRow for Middles<'_> {
    fn run<Y: Lane, L: Lens32>(self, first: (&[f32], Y), _last: (&[f32], Y), lens: L) {
        let Seen { u, v, z } = self.seen;
        middles(self.depth, self.unit, first.0, first.1, lens, self.numbers, u, v, z);
    }
}

for_every_processor! {
    fn middles<Y: Lane, L: Lens32>(
        depth: &[u16], unit: f32, x: &[f32], y: Y, lens: L, numbers: &Numbers,
        u: &mut [f32], v: &mut [f32], z: &mut [f32],
    ) {
        let n = depth.len();
        let (x, y, numbers, per_unit) = (&x[..n], y.cut(n), *numbers, 1.0 / unit);
        let (u, v, z) = (&mut u[..n], &mut v[..n], &mut z[..n]);
        for i in 0..n {
            let p = numbers.project(f32::from(depth[i]) * unit, x[i], y.at(i), lens);
            let seen = (depth[i] != 0) & p.seen;
            u[i] = if seen { p.u } else { f32::NAN };
            v[i] = if seen { p.v } else { f32::NAN };
            z[i] = p.z * per_unit;
        }
    }
}

/// The rows that one thread works with.
#[derive(Debug)]
pub(super) struct TriangleRows {
    above: Seen,
    below: Seen,
}

/// A depth pixel as colour sees it.
#[derive(Debug, Clone, Copy)]
struct Vertex {
    u: f32,
    v: f32,
    z: f32,
}

impl Vertex {
    fn is_seen(self) -> bool {
        !self.u.is_nan()
    }

    fn middle(self, other: Self) -> Self {
        let half = |a: f32, b: f32| (a + b) * 0.5;
        Self { u: half(self.u, other.u), v: half(self.v, other.v), z: half(self.z, other.z) }
    }
}

impl TriangleRows {
    pub(super) fn new(depth_width: usize) -> Self {
        Self { above: Seen::new(depth_width), below: Seen::new(depth_width) }
    }

    /// Draws the neighbourhoods that begin in `rows`.
    pub(super) fn draw(
        &mut self,
        warp: &Warp,
        depth: &[u16],
        unit: f32,
        (width, height): (usize, usize),
        rows: core::ops::Range<usize>,
        target: &mut Target<'_>,
    ) {
        let of = |row: usize| &depth[row * width..(row + 1) * width];
        self.below.fill(warp, of(rows.start), unit, rows.start);
        for row in rows {
            if row + 1 == height {
                break;
            }
            core::mem::swap(&mut self.above, &mut self.below);
            self.below.fill(warp, of(row + 1), unit, row + 1);
            for x in 1..width {
                let at = |seen: &Seen, x: usize| Vertex { u: seen.u[x], v: seen.v[x], z: seen.z[x] };
                let (above, below) = (&self.above, &self.below);
                cell([at(above, x - 1), at(above, x), at(below, x), at(below, x - 1)], target);
            }
        }
    }

    /// Paints some rows of depth with colour: each pixel gets what is around its middle.
    #[expect(clippy::too_many_arguments, reason = "two pictures with their sizes")]
    pub(super) fn paint(
        &mut self,
        warp: &Warp,
        depth: &[u16],
        unit: f32,
        (width, _): (usize, usize),
        rows: core::ops::Range<usize>,
        color: &[u8],
        (color_width, color_height): (usize, usize),
        out: &mut [u8],
    ) {
        let (last_x, last_y) = (color_width as f32 - 1.0, color_height as f32 - 1.0);
        for (row, out) in rows.zip(out.chunks_exact_mut(width * 3)) {
            let depth = &depth[row * width..(row + 1) * width];
            self.above.fill(warp, depth, unit, row);
            for (i, out) in out.chunks_exact_mut(3).enumerate() {
                let (u, v) = (self.above.u[i], self.above.v[i]);
                // NaN is outside.
                if !(u >= 0.0 && v >= 0.0 && u <= last_x && v <= last_y) {
                    out.fill(0);
                    continue;
                }
                let (x, y) = (u as usize, v as usize);
                let (a, b) = (u - x as f32, v - y as f32);
                let right = (x + 1).min(color_width - 1);
                let below = (y + 1).min(color_height - 1);
                for (c, out) in out.iter_mut().enumerate() {
                    let at = |x: usize, y: usize| f32::from(color[(y * color_width + x) * 3 + c]);
                    let top = at(x, y) * (1.0 - a) + at(right, y) * a;
                    let bottom = at(x, below) * (1.0 - a) + at(right, below) * a;
                    *out = (top * (1.0 - b) + bottom * b + 0.5) as u8;
                }
            }
        }
    }
}

/// Draws one neighbourhood, given clockwise from the top left. With one vertex missing it is the triangle of the others.
fn cell(vertices: [Vertex; 4], target: &mut Target<'_>) {
    let mut quad = vertices;
    let mut missing = 0;
    for (i, vertex) in vertices.iter().enumerate() {
        if !vertex.is_seen() {
            missing += 1;
            // On the edge between its neighbours; the two halves then lie along the other diagonal or this one.
            quad[i] = vertices[(i + 3) % 4].middle(vertices[(i + 1) % 4]);
        }
    }
    if missing > 1 {
        return;
    }
    // A vertex on the diagonal makes one half flat, so the cut goes through it.
    let turn = usize::from(!vertices[1].is_seen() || !vertices[3].is_seen());
    quad.rotate_left(turn);
    let near = quad.iter().fold(f32::INFINITY, |least, v| least.min(v.z));
    let far = quad.iter().fold(0.0f32, |most, v| most.max(v.z));
    if far - near > MAX_JUMP * near {
        return;
    }
    let (mut u0, mut u1, mut v0, mut v1) =
        (f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY);
    for p in &quad {
        (u0, u1) = (u0.min(p.u), u1.max(p.u));
        (v0, v1) = (v0.min(p.v), v1.max(p.v));
    }
    if u1 - u0 > MAX_SPAN || v1 - v0 > MAX_SPAN {
        return;
    }
    let clip = |at: f32, end: usize| at.ceil().clamp(0.0, end as f32) as usize;
    let (x0, x1) = (clip(u0, target.width), clip(u1, target.width));
    let (y0, y1) = (clip(v0, target.height), clip(v1, target.height));
    for y in y0..y1 {
        let row = &mut target.pixels[y * target.width..(y + 1) * target.width];
        for (x, pixel) in row.iter_mut().enumerate().take(x1).skip(x0) {
            if let Some(z) = inside(&quad, x as f32, y as f32) {
                // Depth beyond 16 bits is out of range: no pixel.
                if z < 65_535.5 {
                    *pixel = (*pixel).min(key((z + 0.5) as u16));
                }
            }
        }
    }
}

/// Twice the area of the triangle `a`, `b`, (x, y); its sign tells on which side of the line the point is.
fn area(a: Vertex, b: Vertex, x: f32, y: f32) -> f32 {
    (y - a.v) * (b.u - a.u) - (x - a.u) * (b.v - a.v)
}

/// Depth at a point of one of the two halves, cut from the first vertex to the third. Edges on the first side belong to
/// the neighbourhood and those on the other to the next one, so that each point is drawn once.
fn inside(quad: &[Vertex; 4], x: f32, y: f32) -> Option<f32> {
    let [first, second, third, fourth] = *quad;
    let between = area(first, third, x, y);
    let side = between >= 0.0;
    let corner = if side { fourth } else { second };
    let sign = if side { 1.0 } else { -1.0 };
    let to_first = area(corner, first, x, y);
    let to_third = area(third, corner, x, y);
    if to_first * sign < 0.0 || to_third * sign <= 0.0 {
        return None;
    }
    let sum = to_first + between + to_third;
    let z = (to_first * third.z + between * corner.z + to_third * first.z) / sum;
    (sum != 0.0).then_some(z)
}
