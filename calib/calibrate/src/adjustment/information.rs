//! Information that views give about the unknowns: the normal equations at a state, to which a view can be added without solving anything.

use super::normal::Normal;
use super::{Covariance, INTRINSIC_PARAMETERS, Layout, Problem};
use nalgebra::{Cholesky, DMatrix};

/// Knowledge of a camera before any view, standard deviations. It keeps few views from determining nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Prior {
    /// Of each intrinsic parameter, as in [`INTRINSIC_PARAMETERS`].
    pub(crate) intrinsics: [f64; INTRINSIC_PARAMETERS],
    /// Of a pose's rotation, radians.
    pub(crate) rotation: f64,
    /// Of a pose's translation, metres.
    pub(crate) translation: f64,
}

/// Normal equations of views, and of a prior.
#[derive(Debug, Clone)]
pub(crate) struct Information {
    normal: Normal,
    layout: Layout,
    sigma_px: f64,
}

impl Information {
    /// At the state of `problem`, for corners of this standard deviation, with a prior for each camera.
    pub(crate) fn new(problem: &Problem, priors: &[Prior], sigma_px: f64) -> Self {
        let layout = Layout::new(problem);
        let mut normal = Normal::new(problem, &layout, None);
        let mut add = |at: usize, sigma: f64| normal.shared[(at, at)] += (sigma_px / sigma).powi(2);
        for ((camera, place), prior) in problem.cameras.iter().zip(&layout.cameras).zip(priors) {
            let free = (0..INTRINSIC_PARAMETERS).filter(|i| camera.free_intrinsics[*i]);
            for (k, parameter) in free.enumerate() {
                add(place.start + k, prior.intrinsics[parameter]);
            }
            for (k, at) in (place.pose..place.end).enumerate() {
                add(at, if k < 3 { prior.rotation } else { prior.translation });
            }
        }
        Self { normal, layout, sigma_px }
    }

    /// With the views of `problem`, which has the same cameras, in addition.
    pub(crate) fn with(&self, problem: &Problem) -> Self {
        let more = Normal::new(problem, &self.layout, None);
        let mut normal = self.normal.clone();
        normal.shared += more.shared;
        normal.views.extend(more.views);
        Self { normal, layout: self.layout.clone(), sigma_px: self.sigma_px }
    }

    /// Covariance of everything; `None` if the numbers are singular.
    pub(crate) fn covariance(&self) -> Option<Covariance> {
        Covariance::new(&self.normal, &self.layout, self.sigma_px)
    }

    /// The matrix of the unknowns that views share, without the board poses. Those of views add up.
    pub(crate) fn reduced(&self) -> Option<DMatrix<f64>> {
        Some(self.normal.reduced(0.0)?.matrix)
    }

    /// The same of the views of `problem` alone.
    pub(crate) fn reduced_of(&self, problem: &Problem) -> Option<DMatrix<f64>> {
        Some(Normal::new(problem, &self.layout, None).reduced(0.0)?.matrix)
    }
}

/// Logarithm of a positive definite matrix's determinant; `None` of another one.
pub(crate) fn log_determinant(matrix: DMatrix<f64>) -> Option<f64> {
    let factor = Cholesky::new(matrix)?;
    let sum: f64 = factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum();
    sum.is_finite().then_some(2.0 * sum)
}
