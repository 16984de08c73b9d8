//! From a row of depth to where it is seen in colour, in 32-bit floats.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::lens::{InverseBrownConrady, KannalaBrandt, Lens32, Rational, Straight};
use crate::camera::{Camera, Lens};
use core::ops::Range;
use glam::{DAffine3, DVec2};

/// A pair of cameras: rays through the corners of depth's pixels, and the projection into colour.
#[derive(Debug)]
pub(super) struct Warp {
    rays: Rays,
    lens: Lens,
    pub(super) numbers: Numbers,
}

/// Projection from one camera's frame into the other camera, without the lens.
#[derive(Debug, Clone, Copy)]
pub(super) struct Numbers {
    /// Rotation, row by row.
    pub(super) r: [[f32; 3]; 3],
    /// Translation in metres.
    pub(super) t: [f32; 3],
    /// fx, fy, cx, cy of the camera that is projected into.
    pub(super) k: [f32; 4],
    /// Points further from its axis are not seen.
    pub(super) max_radius2: f32,
    /// Its width and height.
    pub(super) size: [f32; 2],
}

/// A point in colour's image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    pub(super) u: f32,
    pub(super) v: f32,
    /// Whether colour's lens can show it.
    pub(super) seen: bool,
}

impl Numbers {
    /// `pose` maps points into the frame of `camera`.
    pub(super) fn new(pose: &DAffine3, camera: &Camera, (w, h): (usize, usize)) -> Self {
        let m = pose.matrix3.transpose().as_mat3();
        let k = camera.intrinsics();
        let radius = camera.max_radius();
        Self {
            r: [m.x_axis.to_array(), m.y_axis.to_array(), m.z_axis.to_array()],
            t: pose.translation.as_vec3().to_array(),
            k: [k.fx, k.fy, k.cx, k.cy].map(|n| n as f32),
            max_radius2: (radius * radius) as f32,
            size: [w as f32, h as f32],
        }
    }

    /// Where the point at depth `z` (metres) on the ray (x, y) is seen. The order of operations is that of
    /// librealsense's `get_texture_map_sse`, so that roundings agree.
    #[inline(always)]
    pub(super) fn project(&self, z: f32, x: f32, y: f32, lens: impl Lens32) -> Point {
        let [rx, ry, rz] = self.r;
        let [tx, ty, tz] = self.t;
        let [fx, fy, cx, cy] = self.k;
        let px = z * x;
        let py = z * y;
        let qx = rx[0] * px + (rx[1] * py + (rx[2] * z + tx));
        let qy = ry[0] * px + (ry[1] * py + (ry[2] * z + ty));
        let qz = rz[0] * px + (rz[1] * py + (rz[2] * z + tz));
        let a = qx / qz;
        let b = qy / qz;
        let (dx, dy) = lens.shown(a, b);
        // NaN, of a ray that depth's lens does not form, is not in front either.
        let seen = (qz > 0.0) & (a * a + b * b <= self.max_radius2);
        Point { u: dx * fx + cx, v: dy * fy + cy, seen }
    }
}

/// The rays through the corners of depth's pixels, scaled to z = 1: one more column and row than pixels, the first at
/// −0.5.
#[derive(Debug)]
enum Rays {
    /// Without distortion x depends on the column and y on the row alone.
    Separate { x: Vec<f32>, y: Vec<f32> },
    /// Row by row; NaN where the lens forms no ray.
    Each { x: Vec<f32>, y: Vec<f32>, columns: usize },
}

/// The rays along one edge of a row of pixels: one more than pixels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Edge<'a, Y> {
    pub(super) x: &'a [f32],
    pub(super) y: Y,
}

/// A computation on the rays of a row of pixels and on colour's lens.
pub(super) trait WithRow {
    /// `top` and `bottom` are the edges above and below the pixels.
    fn run<Y: Lane, L: Lens32>(self, top: Edge<'_, Y>, bottom: Edge<'_, Y>, lens: L);
}

/// A computation on a lens.
pub(super) trait WithLens {
    fn run<L: Lens32>(self, lens: L);
}

/// Runs `work` with `lens` in 32-bit floats.
pub(super) fn with_lens(lens: &Lens, work: impl WithLens) {
    match *lens {
        Lens::None => work.run(Straight),
        Lens::Rational(c) => work.run(Rational(c.map(|c| c as f32))),
        Lens::InverseBrownConrady(c) => work.run(InverseBrownConrady(c.map(|c| c as f32))),
        Lens::KannalaBrandt(c) => work.run(KannalaBrandt(c.map(|c| c as f32))),
    }
}

/// A row whose lens is not known yet.
struct Row<'a, Y, W> {
    top: Edge<'a, Y>,
    bottom: Edge<'a, Y>,
    work: W,
}

impl<Y: Lane, W: WithRow> WithLens for Row<'_, Y, W> {
    fn run<L: Lens32>(self, lens: L) {
        self.work.run(self.top, self.bottom, lens);
    }
}

impl Warp {
    pub(super) fn new(
        depth: &Camera,
        depth_size: (usize, usize),
        color: &Camera,
        color_size: (usize, usize),
        color_from_depth: &DAffine3,
    ) -> Self {
        let numbers = Numbers::new(color_from_depth, color, color_size);
        Self { rays: Rays::new(depth, depth_size), lens: *color.lens(), numbers }
    }

    /// Runs `work` for a row of pixels.
    pub(super) fn with_row(&self, row: usize, work: impl WithRow) {
        match &self.rays {
            Rays::Separate { x, y } => {
                let edge = |row: usize| Edge { x: x.as_slice(), y: Same(y[row]) };
                with_lens(&self.lens, Row { top: edge(row), bottom: edge(row + 1), work });
            }
            Rays::Each { x, y, columns } => {
                let edge = |row: usize| {
                    let at = row * columns..(row + 1) * columns;
                    Edge { x: &x[at.clone()], y: &y[at] }
                };
                with_lens(&self.lens, Row { top: edge(row), bottom: edge(row + 1), work });
            }
        }
    }
}

/// A number per pixel.
pub(super) trait Lane: Copy {
    fn at(self, i: usize) -> f32;
    fn cut(self, range: Range<usize>) -> Self;
}

/// The same number for every pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Same(pub(super) f32);

impl Lane for Same {
    #[inline(always)]
    fn at(self, _: usize) -> f32 {
        self.0
    }

    #[inline(always)]
    fn cut(self, _: Range<usize>) -> Self {
        self
    }
}

impl Lane for &[f32] {
    #[inline(always)]
    fn at(self, i: usize) -> f32 {
        self[i]
    }

    #[inline(always)]
    fn cut(self, range: Range<usize>) -> Self {
        &self[range]
    }
}

impl Rays {
    fn new(depth: &Camera, (w, h): (usize, usize)) -> Self {
        let columns = w + 1;
        let rows = h + 1;
        let k = depth.intrinsics();
        if matches!(depth.lens(), Lens::None) {
            // Subtracted and divided in 32 bits, as librealsense does.
            let axis =
                |n: usize, c: f64, f: f64| (0..n).map(|i| (i as f32 - 0.5 - c as f32) / f as f32).collect();
            return Self::Separate { x: axis(columns, k.cx, k.fx), y: axis(rows, k.cy, k.fy) };
        }
        let mut xs = Vec::with_capacity(columns * rows);
        let mut ys = Vec::with_capacity(columns * rows);
        for y in 0..rows {
            for x in 0..columns {
                let ray = depth.unproject(DVec2::new(x as f64 - 0.5, y as f64 - 0.5));
                xs.push(ray.map_or(f32::NAN, |r| r.x as f32));
                ys.push(ray.map_or(f32::NAN, |r| r.y as f32));
            }
        }
        Self::Each { x: xs, y: ys, columns }
    }
}
