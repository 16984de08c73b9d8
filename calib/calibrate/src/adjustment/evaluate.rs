//! Residuals and cost of a state.

use super::{Problem, Warp};
use depthrig_calib::Camera;
use glam::{DVec2, DVec3};

/// Residuals and their cost.
pub(super) struct Evaluation {
    pub(super) residuals: Vec<Vec<DVec2>>,
    pub(super) cost: f64,
}

impl Evaluation {
    /// `None` if some corner is not in the view of its camera.
    pub(super) fn new(problem: &Problem, huber_px: Option<f64>) -> Option<Self> {
        let cameras: Option<Vec<_>> =
            problem.cameras.iter().map(|c| Camera::new(&c.intrinsics).ok()).collect();
        let cameras = cameras?;
        let shape = Shape::new(problem);
        let mut cost = 0.0;
        let mut residuals = Vec::with_capacity(problem.sightings.len());
        for sighting in &problem.sightings {
            let camera_from_board = problem.cameras[sighting.camera]
                .camera_from_rig
                .after(&problem.rig_from_board[sighting.view])
                .affine();
            let mut of_sighting = Vec::with_capacity(sighting.corners.len());
            for corner in &sighting.corners {
                let point = shape.bent(corner.point, problem.warp);
                let pixel = cameras[sighting.camera].project(camera_from_board.transform_point3(point))?;
                let residual = pixel - corner.pixel;
                cost += loss(residual, huber_px);
                of_sighting.push(residual);
            }
            residuals.push(of_sighting);
        }
        cost.is_finite().then_some(Self { residuals, cost })
    }
}

/// Huber's loss of a residual: its square up to the threshold, linear beyond it.
fn loss(residual: DVec2, huber_px: Option<f64>) -> f64 {
    let square = residual.length_squared();
    match huber_px {
        Some(k) if square > k * k => 2.0 * k * square.sqrt() - k * k,
        _ => square,
    }
}

/// The weight with which least squares has the slope of [`loss`].
pub(super) fn weight(residual: DVec2, huber_px: Option<f64>) -> f64 {
    let length = residual.length();
    match huber_px {
        Some(k) if length > k => k / length,
        _ => 1.0,
    }
}

/// Extent of the corners, in whose units a board is bent.
pub(super) struct Shape {
    middle: DVec2,
    half: DVec2,
}

impl Shape {
    pub(super) fn new(problem: &Problem) -> Self {
        let points = problem.sightings.iter().flat_map(|s| &s.corners).map(|c| c.point.truncate());
        let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        for p in points {
            low = low.min(p);
            high = high.max(p);
        }
        Self { middle: (low + high) * 0.5, half: ((high - low) * 0.5).max(DVec2::splat(1e-9)) }
    }

    /// Change of a point's z with the two parameters of [`Warp`].
    pub(super) fn by_warp(&self, point: DVec3) -> DVec2 {
        let at = (point.truncate() - self.middle) / self.half;
        DVec2::ONE - at * at
    }

    pub(super) fn bent(&self, point: DVec3, warp: Warp) -> DVec3 {
        point + DVec3::Z * self.by_warp(point).dot(DVec2::new(warp.x_m, warp.y_m))
    }
}
