//! From a row of depth to where it is seen in colour, in 32-bit floats.
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::Method;
use super::lens::{InverseBrownConrady, KannalaBrandt, Lens32, Rational, Straight};
use crate::camera::{Camera, Lens};
use glam::{DAffine3, DVec2};

/// What is known of a pair of cameras before the first frame.
#[derive(Debug)]
pub(super) struct Warp {
    rays: Rays,
    lens: Lens,
    pub(super) numbers: Numbers,
    /// Whether a depth pixel covers more than one of colour.
    pub(super) spreads: bool,
}

/// The numbers of a pair of cameras.
#[derive(Debug, Clone, Copy)]
pub(super) struct Numbers {
    /// Rotation, row by row, and translation in metres.
    r: [[f32; 3]; 3],
    t: [f32; 3],
    /// fx, fy, cx, cy of colour.
    k: [f32; 4],
    /// Points further from colour's axis are not seen.
    max_radius2: f32,
    /// Width and height of colour.
    pub(super) size: [f32; 2],
}

/// A point in colour's picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Point {
    pub(super) u: f32,
    pub(super) v: f32,
    /// Depth along colour's axis, metres.
    pub(super) z: f32,
    /// Whether colour's lens can show it.
    pub(super) seen: bool,
}

impl Numbers {
    /// Where colour sees the point at depth `z` (metres) on the ray (x, y). The order of operations is that of
    /// librealsense's `get_texture_map_sse`, so that roundings agree.
    #[inline(always)]
    pub(super) fn project(&self, z: f32, x: f32, y: f32, lens: impl Lens32) -> Point {
        let ([rx, ry, rz], [tx, ty, tz], [fx, fy, cx, cy]) = (self.r, self.t, self.k);
        let (px, py) = (z * x, z * y);
        let qx = rx[0] * px + (rx[1] * py + (rx[2] * z + tx));
        let qy = ry[0] * px + (ry[1] * py + (ry[2] * z + ty));
        let qz = rz[0] * px + (rz[1] * py + (rz[2] * z + tz));
        let (a, b) = (qx / qz, qy / qz);
        let (dx, dy) = lens.shown(a, b);
        // NaN, of a ray that depth's lens does not form, is not in front either.
        let seen = (qz > 0.0) & (a * a + b * b <= self.max_radius2);
        Point { u: dx * fx + cx, v: dy * fy + cy, z: qz, seen }
    }
}

/// The rays of depth, scaled to z = 1: through the corners of its pixels for [`Method::Splat`] (one more column and row
/// than pixels, the first at −0.5), through their middles for [`Method::Triangles`].
#[derive(Debug)]
enum Rays {
    /// Without distortion x depends on the column and y on the row alone.
    Separate { x: Vec<f32>, y: Vec<f32> },
    /// Row by row; NaN where the lens forms no ray.
    Each { x: Vec<f32>, y: Vec<f32>, columns: usize },
}

/// What is done with the rays of a row and colour's lens.
pub(super) trait WithRow {
    /// `first` and `last` are the rays of the pixels' first and last corners.
    fn run<Y: Lane, L: Lens32>(self, first: (&[f32], Y), last: (&[f32], Y), lens: L);
}

impl Warp {
    pub(super) fn new(
        depth: &Camera,
        depth_size: (usize, usize),
        color: &Camera,
        color_size: (usize, usize),
        color_from_depth: &DAffine3,
        method: Method,
    ) -> Self {
        let m = color_from_depth.matrix3.transpose().as_mat3();
        let k = color.intrinsics();
        let radius = color.max_radius();
        let numbers = Numbers {
            r: [m.x_axis.to_array(), m.y_axis.to_array(), m.z_axis.to_array()],
            t: color_from_depth.translation.as_vec3().to_array(),
            k: [k.fx, k.fy, k.cx, k.cy].map(|n| n as f32),
            max_radius2: (radius * radius) as f32,
            size: [color_size.0 as f32, color_size.1 as f32],
        };
        let spreads = spreads(depth, depth_size, color, color_size);
        Self { rays: Rays::new(depth, depth_size, method), lens: *color.lens(), numbers, spreads }
    }

    /// Runs `work` for the `n` pixels of a row.
    pub(super) fn with_row(&self, row: usize, n: usize, work: impl WithRow) {
        match &self.rays {
            Rays::Separate { x, y } => {
                // Middles have no last corner.
                let (next_x, next_y) = (x.len() - n, (row + 1).min(y.len() - 1));
                let (first, last) = ((&x[..n], Same(y[row])), (&x[next_x..], Same(y[next_y])));
                self.with_lens(first, last, work);
            }
            Rays::Each { x, y, columns } => {
                let first = row * columns..row * columns + n;
                let last = (row + 1) * columns + columns - n..(row + 2) * columns;
                let last = if last.end > x.len() { first.clone() } else { last };
                self.with_lens((&x[first.clone()], &y[first]), (&x[last.clone()], &y[last]), work);
            }
        }
    }

    fn with_lens<Y: Lane>(&self, first: (&[f32], Y), last: (&[f32], Y), work: impl WithRow) {
        match self.lens {
            Lens::None => work.run(first, last, Straight),
            Lens::Rational(c) => work.run(first, last, Rational(c.map(|c| c as f32))),
            Lens::InverseBrownConrady(c) => work.run(first, last, InverseBrownConrady(c.map(|c| c as f32))),
            Lens::KannalaBrandt(c) => work.run(first, last, KannalaBrandt(c.map(|c| c as f32))),
        }
    }
}

/// Whether librealsense would use both corners of a pixel: where colour has more pixels per angle than depth on one of
/// the axes (`align_depth_to_other_sse` and `rs2_fov`), and for two pairs of sizes.
pub(super) fn spreads(
    depth: &Camera,
    depth_size: (usize, usize),
    color: &Camera,
    color_size: (usize, usize),
) -> bool {
    let density = |camera: &Camera, (w, h): (usize, usize)| {
        let k = camera.intrinsics();
        let angle = |c: f64, f: f64, n: usize| ((c + 0.5) / f).atan() + ((n as f64 - c - 0.5) / f).atan();
        (w as f64 / angle(k.cx, k.fx, w), h as f64 / angle(k.cy, k.fy, h))
    };
    let (from, to) = (density(depth, depth_size), density(color, color_size));
    let is_special = matches!((depth_size, color_size), ((640, 240), (320, 180)) | ((640, 480), (640, 360)));
    from.0 < to.0 || from.1 < to.1 || is_special
}

/// A number per pixel.
pub(super) trait Lane: Copy {
    fn at(self, i: usize) -> f32;
    fn cut(self, n: usize) -> Self;
}

/// The same number for every pixel.
#[derive(Clone, Copy)]
pub(super) struct Same(f32);

impl Lane for Same {
    #[inline(always)]
    fn at(self, _: usize) -> f32 {
        self.0
    }

    #[inline(always)]
    fn cut(self, _: usize) -> Self {
        self
    }
}

impl Lane for &[f32] {
    #[inline(always)]
    fn at(self, i: usize) -> f32 {
        self[i]
    }

    #[inline(always)]
    fn cut(self, n: usize) -> Self {
        &self[..n]
    }
}

impl Rays {
    fn new(depth: &Camera, (w, h): (usize, usize), method: Method) -> Self {
        let (columns, rows, first) = match method {
            Method::Splat => (w + 1, h + 1, -0.5),
            Method::Triangles => (w, h, 0.0),
        };
        let k = depth.intrinsics();
        if matches!(depth.lens(), Lens::None) {
            // Subtracted and divided in 32 bits, as librealsense does.
            let axis = |n: usize, c: f64, f: f64| {
                (0..n).map(|i| (i as f32 + first as f32 - c as f32) / f as f32).collect()
            };
            return Self::Separate { x: axis(columns, k.cx, k.fx), y: axis(rows, k.cy, k.fy) };
        }
        let mut xs = Vec::with_capacity(columns * rows);
        let mut ys = Vec::with_capacity(columns * rows);
        for y in 0..rows {
            for x in 0..columns {
                let ray = depth.unproject(DVec2::new(x as f64 + first, y as f64 + first));
                xs.push(ray.map_or(f32::NAN, |r| r.x as f32));
                ys.push(ray.map_or(f32::NAN, |r| r.y as f32));
            }
        }
        Self::Each { x: xs, y: ys, columns }
    }
}
