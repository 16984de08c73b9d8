//! The homography between a plane and an image, and what follows from several of them.

use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{SMatrix, SVector};

/// A point of the plane and of the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    /// On the plane.
    pub plane: DVec2,
    /// In the image.
    pub image: DVec2,
}

/// The homography with `image ~ H (plane, 1)`, of unit norm: direct linear transform on normalised points
/// (Hartley and Zisserman, Multiple View Geometry, algorithm 4.2).
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than four points or for points on one line.
pub fn homography(pairs: &[Pair]) -> Result<DMat3> {
    if pairs.len() < 4 {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("{} points; a homography needs four that are not on one line", pairs.len()),
        ));
    }
    let plane = Normaliser::new(pairs.iter().map(|p| p.plane));
    let image = Normaliser::new(pairs.iter().map(|p| p.image));
    let mut square = SMatrix::<f64, 9, 9>::zeros();
    for pair in pairs {
        let p = plane.apply(pair.plane);
        let q = image.apply(pair.image);
        let x = SVector::<f64, 9>::from([p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x]);
        let y = SVector::<f64, 9>::from([0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y]);
        square += x * x.transpose() + y * y.transpose();
    }
    let eigen = square.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    if eigen.eigenvalues[order[1]] < 1e-9 * eigen.eigenvalues[order[8]] {
        return Err(Error::new(
            ErrorKind::BadInput,
            "the points lie on one line; a homography needs a plane",
        ));
    }
    let h: Vec<f64> = eigen.eigenvectors.column(order[0]).iter().copied().collect();
    let normalised = DMat3::from_cols_array(&[h[0], h[3], h[6], h[1], h[4], h[7], h[2], h[5], h[8]]);
    let whole = image.matrix().inverse() * normalised * plane.matrix();
    let norm = whole.to_cols_array().iter().map(|c| c * c).sum::<f64>().sqrt();
    let sign = if whole.z_axis.z < 0.0 { -1.0 } else { 1.0 };
    Ok(whole * (sign / norm))
}

/// `H (p, 1)`, divided.
pub fn apply(h: &DMat3, p: DVec2) -> DVec2 {
    let q = *h * p.extend(1.0);
    q.truncate() / q.z
}

/// The focal length, pixels, that several views of a plane imply for square pixels and this principal point (Zhang, A Flexible New
/// Technique for Camera Calibration, 2000, with the image of the absolute conic of one unknown). `None` if the
/// views do not determine one, as when every view is frontal.
pub fn focal_length(homographies: &[DMat3], principal_point: DVec2) -> Option<f64> {
    let mut top = 0.0;
    let mut bottom = 0.0;
    for h in homographies {
        let centred = DMat3::from_cols(DVec3::X, DVec3::Y, (-principal_point).extend(1.0)) * *h;
        let norm = centred.x_axis.length() * centred.y_axis.length();
        let a = centred.x_axis / norm.sqrt();
        let b = centred.y_axis / norm.sqrt();
        // With w = 1 / f²: (a_x b_x + a_y b_y) w + a_z b_z = 0, and the same length of both columns.
        let rows = [
            (a.x * b.x + a.y * b.y, -a.z * b.z),
            (a.x * a.x + a.y * a.y - b.x * b.x - b.y * b.y, b.z * b.z - a.z * a.z),
        ];
        for (factor, right) in rows {
            top += factor * right;
            bottom += factor * factor;
        }
    }
    let inverse_square = top / bottom;
    (inverse_square.is_finite() && inverse_square > 0.0).then(|| inverse_square.sqrt().recip())
}

/// Moves points to their middle and scales them to a mean distance of √2.
struct Normaliser {
    middle: DVec2,
    scale: f64,
}

impl Normaliser {
    fn new(points: impl Iterator<Item = DVec2> + Clone) -> Self {
        let n = points.clone().count().max(1) as f64;
        let middle = points.clone().sum::<DVec2>() / n;
        let mean = points.map(|p| (p - middle).length()).sum::<f64>() / n;
        Self { middle, scale: core::f64::consts::SQRT_2 / mean.max(f64::MIN_POSITIVE) }
    }

    fn apply(&self, p: DVec2) -> DVec2 {
        (p - self.middle) * self.scale
    }

    fn matrix(&self) -> DMat3 {
        DMat3::from_cols(
            DVec3::X * self.scale,
            DVec3::Y * self.scale,
            (-self.middle * self.scale).extend(1.0),
        )
    }
}
