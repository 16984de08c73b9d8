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
                this.draw(&t.map(|v| projected[v as usize]), drawn + i as u32);
            }
            drawn += mesh.triangles().len() as u32;
        }
        this
    }

    fn draw(&mut self, corners: &[Corner; 3], index: u32) {
        let [a, b, c] = corners.map(|c| c.at);
        let low = a.min(b).min(c);
        let high = a.max(b).max(c);
        let area = (b - a).perp_dot(c - a);
        if area.abs() <= 1e-12 || a.is_nan() || b.is_nan() || c.is_nan() {
            return;
        }
        let x_from = low.x.ceil().max(0.0) as usize;
        let y_from = low.y.ceil().max(0.0) as usize;
        let x_to = high.x.floor().min(self.grid.width as f64 - 1.0);
        let y_to = high.y.floor().min(self.grid.height as f64 - 1.0);
        if x_to < x_from as f64 || y_to < y_from as f64 {
            return;
        }
        let scale = 1.0 / area;
        for y in y_from..=y_to as usize {
            for x in x_from..=x_to as usize {
                let p = DVec2::new(x as f64, y as f64);
                let wa = (b - p).perp_dot(c - p) * scale;
                let wb = (c - p).perp_dot(a - p) * scale;
                let wc = 1.0 - wa - wb;
                if wa < 0.0 || wb < 0.0 || wc < 0.0 {
                    continue;
                }
                let inverse_depth = (wa * corners[0].inverse_depth
                    + wb * corners[1].inverse_depth
                    + wc * corners[2].inverse_depth) as f32;
                let at = y * self.grid.width + x;
                if inverse_depth > self.inverse_depth[at] {
                    self.inverse_depth[at] = inverse_depth;
                    self.triangle[at] = index;
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

/// The normal of a triangle in the frame of its link; `None` without area.
pub(super) fn normal(mesh: &Mesh, triangle: usize) -> Option<DVec3> {
    let [a, b, c] = mesh.triangles()[triangle].map(|i| mesh.vertices()[i as usize]);
    (b - a).cross(c - a).try_normalize()
}
