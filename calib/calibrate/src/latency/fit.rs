//! The adjustment: trajectory, latencies and, within what their calibration leaves open, the cameras' poses.

use super::arrow::{Arrow, Factors, Parts};
use super::state::Fit;
use super::terms::{SPLINE, Terms, add_priors, loss, prior_cost};
use depthrig_calib::{Error, ErrorKind, Result};
use nalgebra::{DMatrix, DVector};

/// Relative decrease of the cost below which the adjustment has converged.
const CONVERGED: f64 = 1e-9;
const MAX_DAMPING: f64 = 1e10;
const MAX_STEPS: usize = 60;
/// How the adjustment ended.
#[derive(Debug, Clone)]
pub(super) struct Ended {
    pub cost: f64,
    /// Standard deviation of a corner's coordinate as the residuals show it, pixels.
    pub sigma_px: f64,
    /// Coordinates of corners.
    pub measurements: usize,
    pub unknowns: usize,
}

/// Standard deviation and speed of a camera.
#[derive(Debug, Clone, Copy)]
pub(super) struct Precision {
    pub sigma_s: f64,
    /// Root mean square of the corners' speed in the image, pixels a second.
    pub speed_px_s: f64,
}

impl Fit {
    /// Cost to minimise: Huber's loss of the residuals, and the priors.
    pub fn cost(&self) -> f64 {
        let corners = self.frames.iter().flat_map(|f| self.residuals(f)).map(|r| loss(r, self.huber_px));
        corners.sum::<f64>() + prior_cost(self)
    }

    /// The normal equations, and half the slope of the cost.
    pub fn system(&self) -> (Arrow, Parts) {
        let band = 6 * self.trajectory.controls.len();
        let corner = self.corner_unknowns();
        let mut system = Arrow::zeros(band, corner);
        let mut slope = Parts { band: DVector::zeros(band), corner: DVector::zeros(corner) };
        let layouts: Vec<_> = (0..self.cameras.len()).map(|c| self.layout(c)).collect();
        for frame in &self.frames {
            Terms::new(self, frame).add(&layouts[frame.camera], &mut system, &mut slope);
        }
        add_priors(self, &mut system, &mut slope);
        (system, slope)
    }

    /// Minimises the cost (Levenberg and Marquardt).
    pub fn solve(&mut self) -> Result<Ended> {
        let measurements = 2 * self.frames.iter().map(|f| f.corners.len()).sum::<usize>();
        let unknowns = 6 * self.trajectory.controls.len() + self.corner_unknowns();
        if measurements <= unknowns {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "{measurements} coordinates of corners cannot determine {unknowns} unknowns; record longer, with more of the board in view"
                ),
            ));
        }
        let mut cost = self.cost();
        let mut damping = 1e-4;
        'steps: for _ in 0..MAX_STEPS {
            let (system, slope) = self.system();
            let downhill = Parts { band: -slope.band, corner: -slope.corner };
            loop {
                if damping > MAX_DAMPING {
                    break 'steps;
                }
                let next = system.factors(damping).map(|f| self.moved(&f.solve(&downhill)));
                let better = next.map(|next| (next.cost(), next)).filter(|(c, _)| *c <= cost);
                let Some((lower, next)) = better else {
                    damping *= 10.0;
                    continue;
                };
                let decrease = cost - lower;
                *self = next;
                cost = lower;
                damping = (damping * 0.1).max(1e-12);
                if decrease <= CONVERGED * cost {
                    break 'steps;
                }
                break;
            }
        }
        let sigma_px = (cost / (measurements - unknowns) as f64).sqrt();
        Ok(Ended { cost, sigma_px, measurements, unknowns })
    }

    /// Precision of the latencies, one for each camera: the larger of what independent noise of the corners leaves, and what the scatter of whole
    /// frames shows. The latter (the "sandwich" of White, 1980, with a frame as a cluster) includes that the board does not move as a
    /// spline, and errors that a frame's corners have in common.
    pub fn precision(&self, ended: &Ended) -> Result<Vec<Precision>> {
        let (system, _) = self.system();
        let factors = system.factors(0.0).ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                "the corners do not determine the board's motion; wave the board where the cameras see most of it",
            )
        })?;
        let inverse = factors.corner_inverse();
        let scatter = self.scatter(&factors);
        let sandwich = &inverse * scatter * &inverse;
        let noise = ended.sigma_px.max(self.noise_px).powi(2);
        Ok((0..self.cameras.len())
            .map(|camera| {
                let of_camera = || self.frames.iter().filter(move |f| f.camera == camera);
                let corners = of_camera().map(|f| f.corners.len()).sum::<usize>().max(1);
                let square: f64 = of_camera().map(|f| Terms::new(self, f).speed_square).sum();
                let variance = self.layout(camera)[0]
                    .map_or(0.0, |at| (noise * inverse[(at, at)]).max(sandwich[(at, at)]));
                Precision { sigma_s: variance.sqrt(), speed_px_s: (square / corners as f64).sqrt() }
            })
            .collect())
    }

    /// Sum over frames of the outer product of each one's pull on the cameras' unknowns, and of what the poses' calibration leaves open.
    fn scatter(&self, factors: &Factors) -> DMatrix<f64> {
        let count = self.corner_unknowns();
        let mut sum = DMatrix::zeros(count, count);
        for frame in &self.frames {
            let terms = Terms::new(self, frame);
            let influence = factors.influence.rows(6 * terms.first, SPLINE);
            let mut pull = -(influence.transpose() * terms.slope.fixed_rows::<SPLINE>(0));
            for (i, at) in self.layout(frame.camera).into_iter().enumerate() {
                if let Some(at) = at {
                    pull[at] += terms.slope[SPLINE + i];
                }
            }
            sum.ger(1.0, &pull, &pull, 1.0);
        }
        // A frame's pose has six coordinates; the trajectory follows some of its errors.
        let coordinates = 6 * self.frames.len();
        let unknowns = 6 * self.trajectory.controls.len() + count;
        let left = coordinates.saturating_sub(unknowns).max(coordinates / 5).max(1);
        sum *= coordinates as f64 / left as f64;
        for (index, camera) in self.cameras.iter().enumerate() {
            let (Some(information), Some(at)) = (&camera.information, self.layout(index)[1]) else {
                continue;
            };
            for i in 0..6 {
                for j in 0..6 {
                    sum[(at + i, at + j)] += information[(i, j)] * self.noise_px.powi(4);
                }
            }
        }
        sum
    }
}
