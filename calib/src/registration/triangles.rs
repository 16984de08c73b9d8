//! Drawing every 2x2 neighbourhood of depth as two triangles; see [`super::Method::Triangles`].
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::lens::Lens32;
use super::target::{EMPTY, Target, key};
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

/// How far outside of its edges, pixels, a half is drawn: neighbours then leave no gap where a pixel lies on an edge
/// exactly or rounding puts it there.
const EDGE: f32 = 1e-3;

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
            let (above, below) = (&self.above, &self.below);
            cells(&above.u, &above.v, &above.z, &below.u, &below.v, &below.z, target.pixels, target.width);
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

for_every_processor! {
    /// Draws the neighbourhoods between two rows.
    fn cells(
        u0: &[f32], v0: &[f32], z0: &[f32], u1: &[f32], v1: &[f32], z1: &[f32], pixels: &mut [u16], width: usize,
    ) {
        let n = u0.len();
        let (v0, z0, u1, v1, z1) = (&v0[..n], &z0[..n], &u1[..n], &v1[..n], &z1[..n]);
        let height = pixels.len() / width;
        for x in 1..n {
            let above = |x: usize| Vertex { u: u0[x], v: v0[x], z: z0[x] };
            let below = |x: usize| Vertex { u: u1[x], v: v1[x], z: z1[x] };
            cell([above(x - 1), above(x), below(x), below(x - 1)], pixels, (width, height));
        }
    }
}

/// Draws one neighbourhood, given clockwise from the top left. With one vertex missing it is the triangle of the others.
#[inline(always)]
fn cell(vertices: [Vertex; 4], pixels: &mut [u16], (width, height): (usize, usize)) {
    let mut quad = vertices;
    if !vertices.iter().all(|v| v.is_seen()) && !mend(&mut quad) {
        return;
    }
    let [a, b, c, d] = quad;
    let (near, far) = (a.z.min(b.z).min(c.z).min(d.z), a.z.max(b.z).max(c.z).max(d.z));
    if far - near > MAX_JUMP * near {
        return;
    }
    let (u0, u1) = (a.u.min(b.u).min(c.u).min(d.u), a.u.max(b.u).max(c.u).max(d.u));
    let (v0, v1) = (a.v.min(b.v).min(c.v).min(d.v), a.v.max(b.v).max(c.v).max(d.v));
    if u1 - u0 > MAX_SPAN || v1 - v0 > MAX_SPAN {
        return;
    }
    let clip = |at: f32, end: usize| at.clamp(0.0, end as f32) as usize;
    let (x0, x1) = (clip((u0 - EDGE).ceil(), width), clip((u1 + EDGE).floor() + 1.0, width));
    let (y0, y1) = (clip((v0 - EDGE).ceil(), height), clip((v1 + EDGE).floor() + 1.0, height));
    for y in y0..y1 {
        // A box of which nothing is left in the picture ends before it begins.
        let Some(row) = pixels.get_mut(y * width + x0..y * width + x1) else { return };
        for (i, pixel) in row.iter_mut().enumerate() {
            *pixel = (*pixel).min(inside(&quad, (near, far), (x0 + i) as f32, y as f32));
        }
    }
}

/// Puts a vertex for the one that is missing; `false` when more are.
fn mend(quad: &mut [Vertex; 4]) -> bool {
    let vertices = *quad;
    let mut missing = 0;
    for (i, vertex) in vertices.iter().enumerate() {
        if !vertex.is_seen() {
            missing += 1;
            quad[i] = vertices[(i + 3) % 4].middle(vertices[(i + 1) % 4]);
        }
    }
    // It lies on one diagonal, and makes one half flat unless the cut goes through it.
    if !vertices[1].is_seen() || !vertices[3].is_seen() {
        quad.rotate_left(1);
    }
    missing == 1
}

/// Twice the area of the triangle `a`, `b`, (x, y); its sign tells on which side of the line the point is.
#[inline(always)]
fn area(a: Vertex, b: Vertex, x: f32, y: f32) -> f32 {
    (y - a.v) * (b.u - a.u) - (x - a.u) * (b.v - a.v)
}

/// The key of the depth at a point of one of the two halves, cut from the first vertex to the third; [`EMPTY`] outside.
#[inline(always)]
fn inside(quad: &[Vertex; 4], (near, far): (f32, f32), x: f32, y: f32) -> u16 {
    let [first, second, third, fourth] = *quad;
    let between = area(first, third, x, y);
    let side = between >= 0.0;
    let corner = Vertex {
        u: if side { fourth.u } else { second.u },
        v: if side { fourth.v } else { second.v },
        z: if side { fourth.z } else { second.z },
    };
    let sign = if side { 1.0 } else { -1.0 };
    let to_first = area(corner, first, x, y);
    let to_third = area(third, corner, x, y);
    let sum = to_first + between + to_third;
    let z = (to_first * third.z + between * corner.z + to_third * first.z) / sum;
    let inside = (to_first * sign >= -EDGE) & (to_third * sign >= -EDGE) & (sum != 0.0);
    // A half that is nearly flat has no weights to trust.
    let z = if z > near { z } else { near };
    let z = if z < far { z } else { far };
    // Depth beyond 16 bits is out of range: no pixel.
    if inside & (z < 65_535.5) { key((z + 0.5) as u16) } else { EMPTY }
}
