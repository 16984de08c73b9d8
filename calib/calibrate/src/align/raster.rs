//! Rendering of posed meshes into a depth buffer.

use super::mesh::Mesh;
use crate::Rigid;
use depthrig_calib::Camera;
use glam::{DMat3, DVec2, DVec3};

/// Nothing nearer than this is drawn, metres.
const NEAR_M: f64 = 0.01;
/// No triangle covers this pixel.
const NOTHING: u32 = u32::MAX;

/// A reduced image of a camera: pixels are `scale` times as large as the camera's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Camera pixels a pixel.
    pub scale: f64,
}

impl Grid {
    pub(super) fn new(width: u32, height: u32, scale: u32) -> Self {
        let of = |n: u32| (n.div_ceil(scale)) as usize;
        Self { width: of(width), height: of(height), scale: f64::from(scale) }
    }

    /// From the camera's pixel coordinates; the centre of the top-left pixel is (0, 0) in both.
    pub(super) fn in_grid(&self, pixel: DVec2) -> DVec2 {
        (pixel + 0.5) / self.scale - 0.5
    }

    pub(super) fn to_camera(self, pixel: DVec2) -> DVec2 {
        (pixel + 0.5) * self.scale - 0.5
    }
}

/// The image of an arm.
#[derive(Debug, Clone)]
pub(super) struct Render {
    pub grid: Grid,
    /// 1 / z of the nearest surface, 0 beside the arm.
    inverse_depth: Vec<f32>,
    /// The triangle at each pixel, counted through all links.
    triangle: Vec<u32>,
    /// Triangles before each link's first one.
    first_triangle: Vec<u32>,
}

impl Render {
    /// Draws the links. A triangle with a corner that the camera cannot project is left out.
    pub(super) fn new(
        camera: &Camera,
        grid: Grid,
        meshes: &[Mesh],
        camera_from_base: &Rigid,
        base_from_links: &[Rigid],
    ) -> Self {
        let mut this = Self {
            grid,
            inverse_depth: vec![0.0; grid.width * grid.height],
            triangle: vec![NOTHING; grid.width * grid.height],
            first_triangle: Vec::with_capacity(meshes.len()),
        };
        let mut drawn = 0;
        let mut projected: Vec<Corner> = Vec::new();
        for (mesh, pose) in meshes.iter().zip(base_from_links) {
            let pose = camera_from_base.after(pose);
            let rotation = DMat3::from_quat(pose.rotation);
            projected.clear();
            projected.extend(mesh.vertices().iter().map(|v| {
                let p = rotation * *v + pose.translation;
                match camera.project(p) {
                    Some(pixel) if p.z > NEAR_M => {
                        Corner { at: grid.in_grid(pixel), inverse_depth: 1.0 / p.z }
                    }
                    _ => Corner { at: DVec2::NAN, inverse_depth: 0.0 },
                }
            }));
            this.first_triangle.push(drawn);
            for (i, t) in mesh.triangles().iter().enumerate() {
                this.draw(t.map(|v| &projected[v as usize]), drawn + i as u32);
            }
            drawn += mesh.triangles().len() as u32;
        }
        this
    }

    /// Draws a triangle row by row, from one border to the other.
    fn draw(&mut self, corners: [&Corner; 3], index: u32) {
        if corners.iter().any(|c| c.inverse_depth == 0.0) {
            return;
        }
        let [a, b, c] = corners.map(|c| c.at);
        let low = a.min(b).min(c);
        let high = a.max(b).max(c);
        let x_from = ceil(low.x).max(0);
        let y_from = ceil(low.y).max(0);
        let x_to = floor(high.x).min(self.grid.width as i32 - 1);
        let y_to = floor(high.y).min(self.grid.height as i32 - 1);
        // Most triangles of a fine mesh lie between the middles of pixels.
        if x_to < x_from || y_to < y_from {
            return;
        }
        let area = (b - a).perp_dot(c - a);
        if area.abs() <= 1e-12 {
            return;
        }
        let scale = 1.0 / area;
        let borders = [Border::new(b, c, scale), Border::new(c, a, scale), Border::new(a, b, scale)];
        let along_x = borders.iter().zip(corners).map(|(b, c)| b.change.x * c.inverse_depth).sum::<f64>();
        for y in y_from..=y_to {
            let weights = borders.map(|b| b.at_row(f64::from(y)));
            let mut from = x_from;
            let mut to = x_to;
            for (border, weight) in borders.iter().zip(weights) {
                if border.change.x > 0.0 {
                    from = from.max(ceil(weight * border.crossing));
                } else if border.change.x < 0.0 {
                    to = to.min(floor(weight * border.crossing));
                } else if weight < 0.0 {
                    to = -1;
                }
            }
            if to < from {
                continue;
            }
            let at_zero = weights.iter().zip(corners).map(|(w, c)| w * c.inverse_depth).sum::<f64>();
            let row = y as usize * self.grid.width;
            let part = row + from as usize..row + to as usize + 1;
            let pixels = self.inverse_depth[part.clone()].iter_mut().zip(&mut self.triangle[part]);
            for (x, (nearest, triangle)) in (from..).zip(pixels) {
                let inverse_depth = (at_zero + along_x * f64::from(x)) as f32;
                if inverse_depth > *nearest {
                    *nearest = inverse_depth;
                    *triangle = index;
                }
            }
        }
    }

    /// Whether a link covers each pixel.
    pub(super) fn mask(&self) -> Vec<bool> {
        self.inverse_depth.iter().map(|d| *d > 0.0).collect()
    }

    /// Depth of the surface at a pixel, metres along the optical axis.
    pub(super) fn depth(&self, x: usize, y: usize) -> Option<f64> {
        let inverse = self.inverse_depth[y * self.grid.width + x];
        (inverse > 0.0).then(|| 1.0 / f64::from(inverse))
    }

    /// The triangle at a pixel.
    pub(super) fn triangle(&self, x: usize, y: usize) -> Option<Drawn> {
        let index = self.triangle[y * self.grid.width + x];
        if index == NOTHING {
            return None;
        }
        let link = self.first_triangle.partition_point(|first| *first <= index) - 1;
        Some(Drawn { link, triangle: (index - self.first_triangle[link]) as usize })
    }
}

/// A triangle of a link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Drawn {
    pub link: usize,
    pub triangle: usize,
}

#[derive(Clone, Copy)]
struct Corner {
    at: DVec2,
    inverse_depth: f64,
}

/// The line through two corners of a triangle: the weight of the third one, which is negative beyond it.
#[derive(Clone, Copy)]
struct Border {
    /// Weight at pixel (0, 0).
    at_zero: f64,
    /// Its change along x and y.
    change: DVec2,
    /// Times the weight at the start of a row: where the row crosses the line.
    crossing: f64,
}

impl Border {
    fn new(from: DVec2, to: DVec2, scale: f64) -> Self {
        let change = DVec2::new(from.y - to.y, to.x - from.x) * scale;
        Self { at_zero: from.perp_dot(to) * scale, change, crossing: -1.0 / change.x }
    }

    fn at_row(&self, y: f64) -> f64 {
        self.at_zero + self.change.y * y
    }
}

/// The next whole number; without an instruction of its own on old processors `f64::ceil` is a call.
fn ceil(v: f64) -> i32 {
    let whole = v as i32;
    whole.saturating_add(i32::from(f64::from(whole) < v))
}

fn floor(v: f64) -> i32 {
    let whole = v as i32;
    whole.saturating_sub(i32::from(f64::from(whole) > v))
}

/// The normal of a triangle in the frame of its link; `None` without area.
pub(super) fn normal(mesh: &Mesh, triangle: usize) -> Option<DVec3> {
    let [a, b, c] = mesh.triangles()[triangle].map(|i| mesh.vertices()[i as usize]);
    (b - a).cross(c - a).try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::Intrinsics;
    use glam::DQuat;

    /// Nearest triangle at a pixel, each tried by itself.
    fn nearest(grid: Grid, corners: &[Option<(DVec2, f64)>], triangles: &[[u32; 3]], p: DVec2) -> f64 {
        let mut best = 0.0_f64;
        for t in triangles {
            let all: Option<Vec<(DVec2, f64)>> = t.iter().map(|i| corners[*i as usize]).collect();
            let Some([a, b, c]) = all.as_deref().map(|all| [all[0], all[1], all[2]]) else { continue };
            let p = grid.in_grid(p);
            let area = (b.0 - a.0).perp_dot(c.0 - a.0);
            let weights = [
                (b.0 - p).perp_dot(c.0 - p) / area,
                (c.0 - p).perp_dot(a.0 - p) / area,
                (a.0 - p).perp_dot(b.0 - p) / area,
            ];
            if weights.iter().all(|w| *w >= 0.0) {
                best = best.max(weights[0] * a.1 + weights[1] * b.1 + weights[2] * c.1);
            }
        }
        best
    }

    #[test]
    fn drawings_are_those_of_a_trial_of_every_triangle_at_every_pixel() {
        let mut state = 7_u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        };
        let camera = Camera::new(&Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5)).unwrap();
        let (mut drawn, mut differ) = (0, 0);
        for size in [0.02, 0.2, 2.0] {
            let vertices: Vec<DVec3> = (0..300)
                .map(|_| {
                    let corner = DVec3::new(random(), random(), random());
                    // Some of the largest are behind the camera, or beside the image.
                    corner * size + DVec3::new(0.0, 0.0, 1.2)
                })
                .collect();
            let triangles: Vec<[u32; 3]> = (0..100).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
            let mesh = Mesh::new(vertices.clone(), triangles.clone()).unwrap();
            let nowhere = Rigid { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
            for scale in [1, 2] {
                let grid = Grid::new(64, 48, scale);
                let render = Render::new(&camera, grid, std::slice::from_ref(&mesh), &nowhere, &[nowhere]);
                let corners: Vec<Option<(DVec2, f64)>> = vertices
                    .iter()
                    .map(|v| {
                        camera.project(*v).filter(|_| v.z > NEAR_M).map(|p| (grid.in_grid(p), 1.0 / v.z))
                    })
                    .collect();
                for y in 0..grid.height {
                    for x in 0..grid.width {
                        let pixel = grid.to_camera(DVec2::new(x as f64, y as f64));
                        let expected = nearest(grid, &corners, &triangles, pixel);
                        let found = render.depth(x, y).map_or(0.0, f64::recip);
                        drawn += usize::from(expected > 0.0);
                        // A border may run through the middle of a pixel.
                        differ += usize::from((expected - found).abs() > 1e-5 * expected);
                    }
                }
            }
        }
        assert!(drawn > 2000 && differ <= 2, "{differ} of {drawn} pixels differ");
    }
}
