//! Point clouds: depth as points in space, and files of them.

use crate::error::check_len;
use crate::{Camera, Error, ErrorKind, PoseExt, Result};
use depthrig_bus::{Intrinsics, Pose};
use glam::DVec2;

mod agreement;
mod files;

pub use agreement::{Agreement, DepthView, agreement};
pub use files::{write_pcd, write_ply};

/// Turns depth into points. The rays are computed once; a frame into a cloud that was used before allocates nothing.
#[derive(Debug, Clone)]
pub struct Deprojection {
    size: (usize, usize),
    /// x and y of the ray of each pixel on the plane z = 1; NaN where the lens forms none.
    rays: Vec<[f32; 2]>,
}

/// Points in space, metres, with or without colour.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// x, y, z.
    pub points: Vec<[f32; 3]>,
    /// Red, green, blue of each point; empty without colour.
    pub colors: Vec<[u8; 3]>,
}

impl Deprojection {
    /// Prepares for one camera.
    ///
    /// # Errors
    /// As [`Camera::new`]; [`ErrorKind::BadInput`] for an empty image.
    pub fn new(intrinsics: &Intrinsics, (width, height): (u32, u32)) -> Result<Self> {
        if width == 0 || height == 0 {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("an image of {width}x{height} pixels has no points"),
            ));
        }
        let camera = Camera::new(intrinsics)?;
        let pixels =
            (0..height).flat_map(|y| (0..width).map(move |x| DVec2::new(f64::from(x), f64::from(y))));
        let rays = pixels
            .map(|pixel| camera.unproject(pixel).map_or([f32::NAN; 2], |ray| [ray.x as f32, ray.y as f32]))
            .collect();
        Ok(Self { size: (width as usize, height as usize), rays })
    }

    /// Width and height of the images.
    pub const fn size(&self) -> (usize, usize) {
        self.size
    }

    /// The points of a depth image in the camera's optical frame, in the order of the pixels; holes are left out.
    /// `color` is 8-bit RGB in the same view.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size.
    pub fn cloud(
        &self,
        depth: &[u16],
        unit_m: f64,
        color: Option<&[u8]>,
        out: &mut PointCloud,
    ) -> Result<()> {
        check_len("depth", depth.len(), self.size, 1)?;
        let unit = unit_m as f32;
        self.collect(depth.iter().map(|d| if *d == 0 { f32::NAN } else { f32::from(*d) * unit }), color, out)
    }

    /// The same for depth in metres; what is not finite and positive is a hole.
    ///
    /// # Errors
    /// As [`Deprojection::cloud`].
    pub fn cloud_of_metres(&self, depth: &[f32], color: Option<&[u8]>, out: &mut PointCloud) -> Result<()> {
        check_len("depth", depth.len(), self.size, 1)?;
        self.collect(depth.iter().copied(), color, out)
    }

    fn collect(
        &self,
        metres: impl Iterator<Item = f32>,
        color: Option<&[u8]>,
        out: &mut PointCloud,
    ) -> Result<()> {
        if let Some(color) = color {
            check_len("colour", color.len(), self.size, 3)?;
        }
        out.points.clear();
        out.colors.clear();
        out.points.reserve(self.rays.len());
        out.colors.reserve(if color.is_some() { self.rays.len() } else { 0 });
        for (i, (z, [x, y])) in metres.zip(&self.rays).enumerate() {
            if z > 0.0 && z.is_finite() && !x.is_nan() {
                out.points.push([x * z, y * z, z]);
                if let Some(c) = color {
                    out.colors.push([c[3 * i], c[3 * i + 1], c[3 * i + 2]]);
                }
            }
        }
        Ok(())
    }
}

impl PointCloud {
    /// Moves the points from the camera's frame into its parent's.
    pub fn transform(&mut self, parent_from_camera: &Pose) {
        let map = parent_from_camera.to_affine();
        for p in &mut self.points {
            let at = glam::DVec3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
            *p = map.transform_point3(at).as_vec3().to_array();
        }
    }
}

#[cfg(test)]
mod tests;
