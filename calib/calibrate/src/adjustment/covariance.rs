//! Covariance of what an adjustment estimated.

use super::normal::Normal;
use super::{INTRINSIC_PARAMETERS, Layout};
use nalgebra::{Cholesky, DMatrix, Dyn, Matrix6, OMatrix};

/// Covariance of all unknowns of a [`super::Problem`]: `σ² (Jᵀ J)⁻¹`, in which `σ` is that of a corner's coordinate.
///
/// It is right where residuals are independent, of one size, and small against the curvature of the projection.
#[derive(Debug, Clone, PartialEq)]
pub struct Covariance {
    layout: Layout,
    shared: DMatrix<f64>,
    views: Vec<ViewCovariance>,
    variance: f64,
}

/// The link of a board pose to the shared unknowns.
#[derive(Debug, Clone, PartialEq)]
struct ViewCovariance {
    inverse: Matrix6<f64>,
    back: OMatrix<f64, nalgebra::Const<6>, Dyn>,
}

impl Covariance {
    /// `None` if the observations do not determine all unknowns.
    pub(super) fn new(normal: &Normal, layout: &Layout, sigma_px: f64) -> Option<Self> {
        let reduced = normal.reduced(0.0)?;
        let variance = sigma_px * sigma_px;
        let shared = if reduced.matrix.is_empty() {
            reduced.matrix
        } else {
            // Scaled to a unit diagonal: parameters differ by ten orders of magnitude in size.
            let scale: Vec<f64> = reduced.matrix.diagonal().iter().map(|d| 1.0 / d.max(0.0).sqrt()).collect();
            if scale.iter().any(|s| !s.is_finite()) {
                return None;
            }
            let scaled = DMatrix::from_fn(layout.shared, layout.shared, |i, j| {
                reduced.matrix[(i, j)] * scale[i] * scale[j]
            });
            let inverse = Cholesky::new(scaled)?.inverse();
            DMatrix::from_fn(layout.shared, layout.shared, |i, j| {
                inverse[(i, j)] * scale[i] * scale[j] * variance
            })
        };
        if shared.iter().any(|c| !c.is_finite()) {
            return None;
        }
        let views =
            reduced.views.into_iter().map(|v| ViewCovariance { inverse: v.inverse, back: v.back }).collect();
        Some(Self { layout: layout.clone(), shared, views, variance })
    }

    /// Standard deviations of a camera's intrinsics as in [`INTRINSIC_PARAMETERS`]; 0 for those that were not estimated.
    pub fn intrinsic_sigmas(
        &self,
        camera: usize,
        free: &[bool; INTRINSIC_PARAMETERS],
    ) -> [f64; INTRINSIC_PARAMETERS] {
        let mut sigmas = [0.0; INTRINSIC_PARAMETERS];
        let mut at = self.layout.cameras[camera].start;
        for (sigma, free) in sigmas.iter_mut().zip(free) {
            if *free {
                *sigma = self.shared[(at, at)].sqrt();
                at += 1;
            }
        }
        sigmas
    }

    /// Covariance of a camera's pose as [`crate::Rigid::moved`] moves it: rotation (radians), then translation (metres), in the
    /// camera's frame. Zero for a pose that was not estimated.
    pub fn pose(&self, camera: usize) -> Matrix6<f64> {
        let at = self.layout.cameras[camera];
        if at.pose == at.end {
            return Matrix6::zeros();
        }
        Matrix6::from_fn(|i, j| self.shared[(at.pose + i, at.pose + j)])
    }

    /// Covariance of what changes by `shared` with the shared unknowns and by `views` with each board pose: two rows each.
    pub(crate) fn of_pixel(
        &self,
        shared: &OMatrix<f64, nalgebra::Const<2>, Dyn>,
        views: &[nalgebra::SMatrix<f64, 2, 6>],
    ) -> nalgebra::Matrix2<f64> {
        let mut direct = shared.clone();
        let mut own = nalgebra::Matrix2::zeros();
        for (by, view) in views.iter().zip(&self.views) {
            direct -= by * &view.back;
            own += by * view.inverse * by.transpose();
        }
        &direct * &self.shared * direct.transpose() + own * self.variance
    }

    pub(crate) const fn layout(&self) -> &Layout {
        &self.layout
    }
}
