//! How differently two calibrations of one camera project: the test that residuals cannot give.

use crate::Rigid;
use crate::intrinsics::ImageSize;
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Result};
use glam::{DMat3, DQuat, DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};

/// Difference of two projections over the image, after the best rotation of one camera onto the other.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectionDifference {
    /// Mean over the image, pixels.
    pub mean_px: f64,
    /// Largest in the image, pixels.
    pub max_px: f64,
    /// The rotation: two calibrations differ by one because the board's poses absorb it.
    pub rotation: Rigid,
    /// Difference at each place of the grid, row by row, pixels; NaN where one lens shows nothing.
    pub grid_px: Vec<f64>,
    /// Places of the grid along x.
    pub columns: usize,
}

/// Places of the grid along the longer side.
const PLACES: usize = 40;

/// Compares two calibrations of a camera at points infinitely far away (the "projection diff" of mrcal).
///
/// # Errors
/// As [`Camera::new`].
pub fn projection_difference(
    a: &Intrinsics,
    b: &Intrinsics,
    size: ImageSize,
) -> Result<ProjectionDifference> {
    let one = Camera::new(a)?;
    let two = Camera::new(b)?;
    let longer = f64::from(size.width.max(size.height));
    let count = |side: u32| ((PLACES as f64 * f64::from(side) / longer).round() as usize).max(2);
    let columns = count(size.width);
    let rows = count(size.height);
    let place = |i: usize, n: usize, side: u32| i as f64 * (f64::from(side) - 1.0) / (n - 1) as f64;
    let rays: Vec<Option<DVec3>> = (0..rows * columns)
        .map(|i| {
            let pixel =
                DVec2::new(place(i % columns, columns, size.width), place(i / columns, rows, size.height));
            one.unproject(pixel).map(DVec3::normalize)
        })
        .collect();
    let pixels: Vec<Option<DVec2>> = rays.iter().map(|ray| one.project((*ray)?)).collect();
    let mut rotation = DQuat::IDENTITY;
    for _ in 0..20 {
        let Some(step) = rotation_step(&two, &rays, &pixels, rotation) else { break };
        rotation = (DQuat::from_scaled_axis(step) * rotation).normalize();
        if step.length() < 1e-12 {
            break;
        }
    }
    let grid_px: Vec<f64> = rays
        .iter()
        .zip(&pixels)
        .map(|(ray, pixel)| {
            let shown = ray.and_then(|r| two.project(rotation * r));
            shown.zip(*pixel).map_or(f64::NAN, |(a, b)| (a - b).length())
        })
        .collect();
    let shown: Vec<f64> = grid_px.iter().copied().filter(|d| d.is_finite()).collect();
    Ok(ProjectionDifference {
        mean_px: shown.iter().sum::<f64>() / shown.len().max(1) as f64,
        max_px: shown.iter().copied().fold(0.0, f64::max),
        rotation: Rigid { rotation, translation: DVec3::ZERO },
        grid_px,
        columns,
    })
}

/// A Gauss-Newton step of the rotation.
fn rotation_step(
    camera: &Camera,
    rays: &[Option<DVec3>],
    pixels: &[Option<DVec2>],
    rotation: DQuat,
) -> Option<DVec3> {
    let mut square = Matrix3::zeros();
    let mut right = Vector3::zeros();
    let matrix = DMat3::from_quat(rotation);
    for (ray, pixel) in rays.iter().zip(pixels) {
        let Some((ray, pixel)) = ray.zip(*pixel) else { continue };
        let at = matrix * ray;
        let Some(projection) = camera.project_with_jacobian(at) else { continue };
        let residual = projection.pixel - pixel;
        for axis in 0..2 {
            let by = at.cross(projection.d_point[axis]);
            let by = Vector3::new(by.x, by.y, by.z);
            square += by * by.transpose();
            right -= by * residual[axis];
        }
    }
    let step = square.cholesky()?.solve(&right);
    Some(DVec3::new(step.x, step.y, step.z))
}
