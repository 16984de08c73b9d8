//! From a row of depth to where it is seen in colour, in 32-bit floats.
//!
//! The loop is written once, for any number of lanes; it is compiled for the processors that have AVX2 and once more for
//! all. Nothing is fused or reordered, so both give the same bits.
#![allow(unsafe_code)] // calls of functions that are compiled for more than the oldest processor
#![allow(clippy::inline_always, reason = "what is not inlined is compiled for the oldest processor")]
#![allow(
    clippy::needless_bitwise_bool,
    reason = "a lazy operator is a branch, and branches keep loops from being vectors"
)]

use super::Method;
use crate::camera::{Camera, Lens};
use glam::{DAffine3, DVec2};

/// What is known of a pair of cameras before the first frame.
#[derive(Debug)]
pub(super) struct Warp {
    rays: Rays,
    /// Rotation, row by row, and translation in metres.
    r: [[f32; 3]; 3],
    t: [f32; 3],
    lens: Lens,
    /// fx, fy, cx, cy of colour.
    k: [f32; 4],
    /// Points further from colour's axis are not seen.
    max_radius2: f32,
    /// Width and height of colour.
    pub(super) size: [f32; 2],
    /// Whether a depth pixel covers more than one of colour.
    pub(super) spreads: bool,
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

/// Which ray of a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// The top left corner, or the middle.
    First,
    /// The bottom right corner.
    Last,
}

/// Where a row of pixels is seen. A hole, and what colour's lens cannot show, is at NaN.
#[derive(Debug, Default)]
pub(super) struct Seen {
    pub(super) u: Vec<f32>,
    pub(super) v: Vec<f32>,
    /// Depth along colour's axis, in units of depth.
    pub(super) z: Vec<f32>,
}

impl Seen {
    pub(super) fn new(width: usize) -> Self {
        Self { u: vec![0.0; width], v: vec![0.0; width], z: vec![0.0; width] }
    }
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
        Self {
            rays: Rays::new(depth, depth_size, method),
            r: [m.x_axis.to_array(), m.y_axis.to_array(), m.z_axis.to_array()],
            t: color_from_depth.translation.as_vec3().to_array(),
            lens: *color.lens(),
            k: [k.fx, k.fy, k.cx, k.cy].map(|n| n as f32),
            max_radius2: (radius * radius) as f32,
            size: [color_size.0 as f32, color_size.1 as f32],
            spreads: spreads(depth, depth_size, color, color_size),
        }
    }

    /// Where the pixels `depth` of row `row` are seen.
    pub(super) fn row(&self, depth: &[u16], unit: f32, row: usize, place: Place, seen: &mut Seen) {
        let n = depth.len();
        let last = usize::from(place == Place::Last);
        let out = (&mut seen.u[..n], &mut seen.v[..n], &mut seen.z[..n]);
        match &self.rays {
            Rays::Separate { x, y } => {
                let rays = (&x[last..last + n], Same(y[row + last]));
                self.with_lens(depth, unit, rays.0, rays.1, out);
            }
            Rays::Each { x, y, columns } => {
                let from = (row + last) * columns + last;
                self.with_lens(depth, unit, &x[from..from + n], &y[from..from + n], out);
            }
        }
    }

    fn with_lens<Y: Lane>(&self, depth: &[u16], unit: f32, x: &[f32], y: Y, out: Out<'_>) {
        match self.lens {
            Lens::None => self.best(depth, unit, x, y, out, |x, y| (x, y)),
            Lens::Rational(c) => {
                let [k1, k2, p1, p2, k3, k4, k5, k6] = c.map(|c| c as f32);
                self.best(depth, unit, x, y, out, move |x, y| {
                    let r2 = x * x + y * y;
                    let top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                    let s = top / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)));
                    let xy = 2.0 * x * y;
                    (s * x + (p1 * xy + p2 * (r2 + 2.0 * x * x)), s * y + (p1 * (r2 + 2.0 * y * y) + p2 * xy))
                });
            }
            Lens::InverseBrownConrady(c) => {
                let [k1, k2, p1, p2, k3] = c.map(|c| c as f32);
                self.best(depth, unit, x, y, out, move |x, y| {
                    let r2 = x * x + y * y;
                    let s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                    let (x, y) = (x * s, y * s);
                    let xy = 2.0 * x * y;
                    (x + (p1 * xy + p2 * (r2 + 2.0 * x * x)), y + (p1 * (r2 + 2.0 * y * y) + p2 * xy))
                });
            }
            Lens::KannalaBrandt(c) => {
                let [k1, k2, k3, k4] = c.map(|c| c as f32);
                self.best(depth, unit, x, y, out, move |x, y| {
                    let r = (x * x + y * y).sqrt();
                    let theta = r.atan();
                    let t2 = theta * theta;
                    let shown = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                    let s = if r > 1e-6 { shown / r } else { 1.0 };
                    (s * x, s * y)
                });
            }
        }
    }

    /// The loop in the widest form that the processor has.
    fn best<Y: Lane>(
        &self,
        depth: &[u16],
        unit: f32,
        x: &[f32],
        y: Y,
        out: Out<'_>,
        lens: impl Fn(f32, f32) -> (f32, f32),
    ) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.avx2(depth, unit, x, y, out, lens) };
        }
        self.any(depth, unit, x, y, out, lens);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn avx2<Y: Lane>(
        &self,
        depth: &[u16],
        unit: f32,
        x: &[f32],
        y: Y,
        out: Out<'_>,
        lens: impl Fn(f32, f32) -> (f32, f32),
    ) {
        self.any(depth, unit, x, y, out, lens);
    }

    /// The order of operations is that of librealsense's `get_texture_map_sse`, so that roundings agree.
    #[inline(always)]
    fn any<Y: Lane>(
        &self,
        depth: &[u16],
        unit: f32,
        x: &[f32],
        y: Y,
        (u, v, depth_out): Out<'_>,
        lens: impl Fn(f32, f32) -> (f32, f32),
    ) {
        let n = depth.len();
        // One length for all, known to the compiler: no bounds are checked inside the loop.
        let (x, u, v, depth_out) = (&x[..n], &mut u[..n], &mut v[..n], &mut depth_out[..n]);
        let ([rx, ry, rz], [tx, ty, tz], [fx, fy, cx, cy]) = (self.r, self.t, self.k);
        let (max_radius2, per_unit) = (self.max_radius2, 1.0 / unit);
        for i in 0..n {
            let z = f32::from(depth[i]) * unit;
            let (px, py) = (z * x[i], z * y.at(i));
            let qx = rx[0] * px + (rx[1] * py + (rx[2] * z + tx));
            let qy = ry[0] * px + (ry[1] * py + (ry[2] * z + ty));
            let qz = rz[0] * px + (rz[1] * py + (rz[2] * z + tz));
            let (a, b) = (qx / qz, qy / qz);
            let (dx, dy) = lens(a, b);
            let seen = (depth[i] != 0) & (qz > 0.0) & (a * a + b * b <= max_radius2);
            u[i] = if seen { dx * fx + cx } else { f32::NAN };
            v[i] = if seen { dy * fy + cy } else { f32::NAN };
            depth_out[i] = qz * per_unit;
        }
    }
}

/// Whether librealsense would use both corners of a pixel: where colour has more pixels per angle than depth on one of
/// the axes (`align_depth_to_other_sse` and `rs2_fov`), and for two pairs of sizes.
fn spreads(depth: &Camera, depth_size: (usize, usize), color: &Camera, color_size: (usize, usize)) -> bool {
    let density = |camera: &Camera, (w, h): (usize, usize)| {
        let k = camera.intrinsics();
        let angle = |c: f64, f: f64, n: usize| ((c + 0.5) / f).atan() + ((n as f64 - c - 0.5) / f).atan();
        (w as f64 / angle(k.cx, k.fx, w), h as f64 / angle(k.cy, k.fy, h))
    };
    let (from, to) = (density(depth, depth_size), density(color, color_size));
    let is_special = matches!((depth_size, color_size), ((640, 240), (320, 180)) | ((640, 480), (640, 360)));
    from.0 < to.0 || from.1 < to.1 || is_special
}

type Out<'a> = (&'a mut [f32], &'a mut [f32], &'a mut [f32]);

/// A number per pixel.
trait Lane: Copy {
    fn at(self, i: usize) -> f32;
}

/// The same number for every pixel.
#[derive(Clone, Copy)]
struct Same(f32);

impl Lane for Same {
    #[inline(always)]
    fn at(self, _: usize) -> f32 {
        self.0
    }
}

impl Lane for &[f32] {
    #[inline(always)]
    fn at(self, i: usize) -> f32 {
        self[i]
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
