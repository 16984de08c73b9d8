//! The adjustment at one state: trajectory, cameras and the corners that they saw.

use super::arrow::Parts;
use super::spline::{Trajectory, moved};
use crate::Rigid;
use crate::adjustment::Corner;
use depthrig_calib::Camera;
use glam::DVec3;
use nalgebra::{DVector, Matrix6, Vector6};

/// Median of the length of a vector of two independent normal coordinates, in standard deviations: √(2 ln 2).
pub(super) const RAYLEIGH_MEDIAN: f64 = 1.177_410_022_515_474_7;
/// Distance of a corner that the lens cannot show, pixels.
const UNSEEN_PX: f64 = 100.0;

/// A camera of the adjustment.
#[derive(Debug, Clone)]
pub(super) struct FitCamera {
    pub lens: Camera,
    pub camera_from_rig: Rigid,
    /// Where it was calibrated to stand.
    pub calibrated: Rigid,
    /// Inverse covariance of that; without it the pose is not estimated.
    pub information: Option<Matrix6<f64>>,
    pub latency_s: f64,
    /// Whether its latency is estimated; that of the reference is zero.
    pub is_free: bool,
}

impl FitCamera {
    /// From where it was calibrated to where it is: rotation and translation about and along its axes.
    pub fn motion(&self) -> Vector6<f64> {
        let between = self.camera_from_rig.after(&self.calibrated.inverse());
        let rotation = between.rotation_vector();
        let place = between.translation;
        Vector6::new(rotation.x, rotation.y, rotation.z, place.x, place.y, place.z)
    }
}

/// An image that shows the board.
#[derive(Debug, Clone)]
pub(super) struct Frame {
    pub camera: usize,
    pub segment: usize,
    /// Its stamp, seconds.
    pub time_s: f64,
    pub corners: Vec<Corner>,
}

/// The adjustment at one state.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    pub trajectory: Trajectory,
    pub cameras: Vec<FitCamera>,
    pub frames: Vec<Frame>,
    /// Corners further from their places count linearly.
    pub huber_px: f64,
    /// Standard deviation of a corner's coordinate that the priors are weighed against.
    pub noise_px: f64,
}

impl Fit {
    /// Places of a camera's latency and of the six coordinates of its pose among the unknowns of the cameras.
    pub fn layout(&self, camera: usize) -> [Option<usize>; 7] {
        let start: usize = self.cameras[..camera].iter().map(unknowns).sum();
        let FitCamera { is_free, information, .. } = &self.cameras[camera];
        core::array::from_fn(|i| match i {
            0 => is_free.then_some(start),
            _ => information.as_ref().map(|_| start + usize::from(*is_free) + i - 1),
        })
    }

    /// Unknowns of all cameras.
    pub fn corner_unknowns(&self) -> usize {
        self.cameras.iter().map(unknowns).sum()
    }

    /// Distance of each corner of a frame from where the model puts it, pixels.
    pub fn residuals<'a>(&'a self, frame: &'a Frame) -> impl Iterator<Item = f64> + 'a {
        let camera = &self.cameras[frame.camera];
        let sample = self.trajectory.sample(frame.segment, frame.time_s - camera.latency_s);
        let camera_from_board = camera.camera_from_rig.after(&sample.rig_from_board);
        frame.corners.iter().map(move |corner| {
            let pixel = camera.lens.project(camera_from_board.transform(corner.point));
            pixel.map_or(UNSEEN_PX, |pixel| (pixel - corner.pixel).length())
        })
    }

    /// This state after a step.
    pub fn moved(&self, step: &Parts) -> Self {
        let mut next = self.clone();
        let vector = |v: &DVector<f64>, at: usize| DVec3::new(v[at], v[at + 1], v[at + 2]);
        for (i, control) in next.trajectory.controls.iter_mut().enumerate() {
            *control = moved(control, vector(&step.band, 6 * i), vector(&step.band, 6 * i + 3));
        }
        for index in 0..next.cameras.len() {
            let layout = self.layout(index);
            let camera = &mut next.cameras[index];
            if let Some(at) = layout[0] {
                camera.latency_s += step.corner[at];
            }
            if let Some(at) = layout[1] {
                let rotation = vector(&step.corner, at);
                let shift = vector(&step.corner, at + 3);
                camera.camera_from_rig = camera.camera_from_rig.moved(rotation, shift);
            }
        }
        next
    }

    /// Median distance of the corners of some frames, as the standard deviation of a coordinate, pixels.
    pub fn median_sigma_px<'a>(&'a self, frames: impl Iterator<Item = &'a Frame>) -> f64 {
        let mut all: Vec<f64> = frames.flat_map(|f| self.residuals(f)).collect();
        if all.is_empty() {
            return 0.0;
        }
        let middle = all.len() / 2;
        *all.select_nth_unstable_by(middle, f64::total_cmp).1 / RAYLEIGH_MEDIAN
    }
}

/// Unknowns of a camera.
fn unknowns(camera: &FitCamera) -> usize {
    usize::from(camera.is_free) + if camera.information.is_some() { 6 } else { 0 }
}
