//! Where a camera sits beside a robot, from masks of its arm at known joint positions.
//!
//! The arm's meshes are drawn at the camera's assumed pose; the outline of the drawing is compared with the outline of the mask, both
//! ways, and the pose moves by least squares until they lie on each other. The drawing is made anew after each step, with small images
//! and coarse meshes first. No gradient of the drawing is needed: a point of an outline is a point of a surface, whose motion in the
//! image is known. (Contours as in Harris and Stennett, RAPID, 1990; the problem as in EasyHeC, Chen et al., 2023.)

use crate::Rigid;
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::DVec3;
use nalgebra::Matrix6;

mod distance;
mod equations;
mod kinematics;
mod mesh;
mod raster;
mod samples;
mod search;
mod shapes;
#[cfg(test)]
mod tests;

pub use kinematics::{Joint, JointKind, Kinematics, Limits, Mimic};
pub use mesh::Mesh;

/// The pixels of an image that show the arm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Whether each pixel shows the arm, row by row.
    pub inside: Vec<bool>,
}

/// Depth of the size of its mask.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    /// Metres along the optical axis, row by row; 0 where depth is missing.
    pub metres: Vec<f32>,
}

/// A view of the arm.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignView {
    /// Name of the view, for messages.
    pub name: String,
    /// Poses of the links in the robot's base, as many as there are meshes.
    pub base_from_links: Vec<Rigid>,
    /// The arm in the image.
    pub mask: Mask,
    /// Depth of the same image, if there is any.
    pub depth: Option<DepthImage>,
}

/// The result of [`align`].
#[derive(Debug, Clone, PartialEq)]
pub struct Alignment {
    /// The camera's pose in the robot's base, optical axes.
    pub base_from_camera: Rigid,
    /// Covariance of [`Alignment::base_from_camera`], about and along the camera's own axes: rotation (radians), then place (metres).
    pub covariance: Matrix6<f64>,
    /// How far the masks reach beyond the arm's outline, pixels; estimated with the pose.
    pub outset_px: f64,
    /// Standard deviation of the distance between outlines, from their median, pixels.
    pub outline_px: f64,
    /// The same of depth, metres; `None` without depth.
    pub depth_m: Option<f64>,
    /// Each view.
    pub views: Vec<AlignedView>,
}

/// How well a view fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedView {
    /// Pixels in both the mask and the drawing over pixels in either.
    pub overlap: f64,
    /// Median distance between the outlines, pixels.
    pub median_px: f64,
}

/// Views that [`align`] needs.
pub const MIN_VIEWS: usize = 3;
/// Masks of fewer pixels show nothing.
const MIN_MASK_PIXELS: usize = 100;
/// Links have to move by this much between views, metres.
const MIN_MOTION_M: f64 = 0.03;
/// Mean overlap below which the search has failed.
const MIN_OVERLAP: f64 = 0.55;
/// Mean overlap above which a pose that is not determined is due to the views.
const GOOD_OVERLAP: f64 = 0.8;
/// Standard deviations above which the views do not determine the pose.
const MAX_SIGMA_M: f64 = 0.05;
const MAX_SIGMA_RAD: f64 = 0.09;

/// Finds the camera's pose, from a start that is off by 10 cm and 15 degrees at the most. `meshes` are the links' surfaces, each in the
/// frame of its link.
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than [`MIN_VIEWS`] views, for masks of another size than `width` x `height` or that are empty, for an
/// arm that stands still, that the camera does not see from the start, or whose masks and drawings do not come to lie on each other.
pub fn align(
    intrinsics: &Intrinsics,
    width: u32,
    height: u32,
    meshes: &[Mesh],
    views: &[AlignView],
    start: &Rigid,
) -> Result<Alignment> {
    check(width, height, meshes, views)?;
    let camera = Camera::new(intrinsics)?;
    let problem = search::Problem::new(&camera, width, height, meshes, views);
    let found = problem.solve(&start.inverse())?;
    let overlap = found.views.iter().map(|v| v.overlap).sum::<f64>() / found.views.len() as f64;
    let sigma = |from: usize| (from..from + 3).map(|i| found.covariance[(i, i)]).sum::<f64>().sqrt();
    let sigma_rad = sigma(0);
    let sigma_m = sigma(3);
    let determined = sigma_m < MAX_SIGMA_M && sigma_rad < MAX_SIGMA_RAD;
    if overlap < MIN_OVERLAP || (overlap < GOOD_OVERLAP && !determined) {
        let worst = found.views.iter().zip(views).min_by(|a, b| a.0.overlap.total_cmp(&b.0.overlap));
        let name = worst.map_or("", |(_, view)| view.name.as_str());
        return bad(format!(
            "masks and arm do not come to lie on each other: they overlap by {:.0} % after the search, least in view {name}; check that \
             each mask belongs to its joint positions, that joint positions are radians, and that the start is within 10 cm and 15 degrees",
            overlap * 100.0
        ));
    }
    if !determined {
        return bad(format!(
            "the views determine the camera's place to {:.0} mm and {:.1} degrees only; add views with the arm stretched out in other \
             directions, and to and from the camera",
            sigma_m * 1e3,
            sigma_rad.to_degrees()
        ));
    }
    Ok(found)
}

/// The pixels at which a camera at `base_from_camera` shows the arm.
///
/// # Errors
/// As [`Camera::new`].
pub fn drawing(
    intrinsics: &Intrinsics,
    width: u32,
    height: u32,
    meshes: &[Mesh],
    base_from_links: &[Rigid],
    base_from_camera: &Rigid,
) -> Result<Mask> {
    let camera = Camera::new(intrinsics)?;
    let grid = raster::Grid::new(width, height, 1);
    let render = raster::Render::new(&camera, grid, meshes, &base_from_camera.inverse(), base_from_links);
    Ok(Mask { width, height, inside: render.mask() })
}

fn check(width: u32, height: u32, meshes: &[Mesh], views: &[AlignView]) -> Result<()> {
    if views.len() < MIN_VIEWS {
        return bad(format!(
            "{} views of the arm; alignment needs {MIN_VIEWS} or more in different positions, and gains by eight",
            views.len()
        ));
    }
    if meshes.iter().all(|m| m.triangles().is_empty()) {
        return bad("the robot has no visible surface; its links need meshes".to_owned());
    }
    let pixels = width as usize * height as usize;
    for view in views {
        let mask = &view.mask;
        if (mask.width, mask.height) != (width, height) || mask.inside.len() != pixels {
            return bad(format!(
                "view {}: the mask is {}x{}, the intrinsics are for {width}x{height}; use masks of the camera's images as they are",
                view.name, mask.width, mask.height
            ));
        }
        if view.depth.as_ref().is_some_and(|d| d.metres.len() != pixels) {
            return bad(format!("view {}: depth is not {width}x{height} like its mask", view.name));
        }
        let inside = mask.inside.iter().filter(|m| **m).count();
        if inside < MIN_MASK_PIXELS {
            return bad(format!(
                "view {}: the mask has {inside} pixels of the arm; leave the view out, or draw its mask",
                view.name
            ));
        }
        if inside == pixels {
            return bad(format!(
                "view {}: every pixel of the mask is the arm; it needs 0 where the arm is not",
                view.name
            ));
        }
        if view.base_from_links.len() != meshes.len() {
            return bad(format!(
                "view {}: {} poses for {} links",
                view.name,
                view.base_from_links.len(),
                meshes.len()
            ));
        }
    }
    let moved = motion(meshes, views);
    if moved < MIN_MOTION_M {
        return bad(format!(
            "the arm moves by {:.0} mm between the views at the most; take views with the arm in positions that differ by 20 cm and more",
            moved * 1e3
        ));
    }
    Ok(())
}

/// The longest way of a link's middle from the first view to another one, metres.
fn motion(meshes: &[Mesh], views: &[AlignView]) -> f64 {
    let mut longest = 0.0_f64;
    for (link, mesh) in meshes.iter().enumerate().filter(|(_, m)| !m.vertices().is_empty()) {
        let middle = mesh.vertices().iter().sum::<DVec3>() / mesh.vertices().len() as f64;
        let first = views[0].base_from_links[link].transform(middle);
        for view in &views[1..] {
            longest = longest.max(view.base_from_links[link].transform(middle).distance(first));
        }
    }
    longest
}

fn bad<T>(what: String) -> Result<T> {
    Err(Error::new(ErrorKind::BadInput, what))
}
