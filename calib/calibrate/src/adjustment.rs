//! Least-squares adjustment of cameras, board poses and the board's shape to observed corners ("bundle adjustment").
//!
//! Levenberg-Marquardt with analytic Jacobians. The board poses are eliminated by the Schur complement, so that a
//! step solves a system of the cameras' unknowns alone (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000).
//! The result has the covariance of everything that was estimated.

use crate::Rigid;
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DVec2, DVec3};

mod covariance;
mod evaluate;
mod information;
mod normal;
#[cfg(test)]
mod tests;

pub use covariance::Covariance;
use evaluate::Evaluation;
pub(crate) use information::{Information, Prior, log_determinant};
use normal::Normal;

/// `fx fy cx cy` and the eight coefficients in the order of [`Intrinsics::coeffs`].
pub const INTRINSIC_PARAMETERS: usize = 12;

/// A camera to adjust.
#[derive(Debug, Clone, PartialEq)]
pub struct AdjustedCamera {
    /// Its intrinsics; the distortion model stays.
    pub intrinsics: Intrinsics,
    /// Its pose: from the rig's coordinates to the camera's optical frame.
    pub camera_from_rig: Rigid,
    /// Intrinsics that are estimated, as in [`INTRINSIC_PARAMETERS`]; the others stay.
    pub free_intrinsics: [bool; INTRINSIC_PARAMETERS],
    /// Whether its pose is estimated. At least one camera's must not be: nothing else fixes the rig's coordinates.
    pub free_pose: bool,
}

impl AdjustedCamera {
    /// Every parameter of the distortion model free.
    pub fn all_free(model: Distortion) -> [bool; INTRINSIC_PARAMETERS] {
        let coefficients = crate::file::coefficients(model);
        core::array::from_fn(|i| i < 4 + coefficients)
    }
}

/// A corner of the board and the pixel where a camera sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// On the board, metres.
    pub point: DVec3,
    /// The centre of the top-left pixel is (0, 0).
    pub pixel: DVec2,
}

/// Corners that one camera sees in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct Sighting {
    /// Index of the camera.
    pub camera: usize,
    /// Index of the board's pose.
    pub view: usize,
    /// The corners that it sees.
    pub corners: Vec<Corner>,
}

/// How far the printed board is from flat, metres in its middle: `z = x_m (1 - x²) + y_m (1 - y²)` with `x` and `y` from -1
/// at one edge of the corners to 1 at the other (the model of mrcal, "board deformation").
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Warp {
    /// Bend along x.
    pub x_m: f64,
    /// Bend along y.
    pub y_m: f64,
}

/// An adjustment: its start before [`Problem::solve`], its result after.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// The cameras.
    pub cameras: Vec<AdjustedCamera>,
    /// The board's pose in each view: from the board's coordinates to the rig's.
    pub rig_from_board: Vec<Rigid>,
    /// The shape of the board.
    pub warp: Warp,
    /// Whether the shape is estimated.
    pub free_warp: bool,
    /// The corners that cameras saw.
    pub sightings: Vec<Sighting>,
}

/// When to stop, and how to treat bad corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// A corner further from its place than this counts linearly instead of by its square (Huber's loss), pixels.
    pub huber_px: Option<f64>,
    /// Steps at the most.
    pub max_steps: usize,
}

impl Default for Options {
    fn default() -> Self {
        Self { huber_px: None, max_steps: 100 }
    }
}

/// How an adjustment ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// Residual of each corner, as in [`Problem::sightings`]: where the model puts it minus where it was seen, pixels.
    pub residuals: Vec<Vec<DVec2>>,
    /// Root mean square of the residuals' lengths over all corners, pixels (as OpenCV reports it).
    pub rms_px: f64,
    /// Standard deviation of one coordinate of a corner, pixels: `sqrt(Σ r² / (measurements − unknowns))`.
    pub sigma_px: f64,
    /// Steps that were taken.
    pub steps: usize,
    /// Of all that was estimated, with [`Solution::sigma_px`].
    pub covariance: Covariance,
}

/// Relative decrease of the cost below which the adjustment has converged.
const CONVERGED: f64 = 1e-11;
/// Damping above which no step can help.
const MAX_DAMPING: f64 = 1e12;

impl Problem {
    /// Adjusts everything that is free.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] if the start does not see its corners, if there are fewer measurements than unknowns, or if
    /// some unknown does not change what is seen (its name is in the message).
    pub fn solve(&mut self, options: &Options) -> Result<Solution> {
        let measurements = 2 * self.sightings.iter().map(|s| s.corners.len()).sum::<usize>();
        let layout = Layout::new(self);
        let unknowns = layout.shared + 6 * self.rig_from_board.len();
        if measurements <= unknowns {
            return Err(bad(format!(
                "{measurements} coordinates of corners cannot determine {unknowns} unknowns; take more views"
            )));
        }
        let mut at = Evaluation::new(self, options.huber_px).ok_or_else(|| {
            bad("the start of the adjustment does not show every corner; check the board's size".to_owned())
        })?;
        let mut damping = 1e-4;
        let mut steps = 0;
        'steps: while steps < options.max_steps {
            let normal = Normal::new(self, &layout, options.huber_px);
            loop {
                if damping > MAX_DAMPING {
                    break 'steps;
                }
                let better = normal.step(damping).and_then(|step| {
                    let next = self.moved(&layout, &step);
                    Evaluation::new(&next, options.huber_px).filter(|e| e.cost <= at.cost).map(|e| (next, e))
                });
                if let Some((next, evaluation)) = better {
                    let decrease = at.cost - evaluation.cost;
                    *self = next;
                    at = evaluation;
                    steps += 1;
                    damping = (damping * 0.1).max(1e-12);
                    if decrease <= CONVERGED * at.cost {
                        break 'steps;
                    }
                    break;
                }
                damping *= 10.0;
            }
        }
        let squares: f64 = at.residuals.iter().flatten().map(|r| r.length_squared()).sum();
        let sigma_px = (squares / (measurements - unknowns) as f64).sqrt();
        let normal = Normal::new(self, &layout, options.huber_px);
        let covariance = Covariance::new(&normal, &layout, sigma_px)
            .ok_or_else(|| bad(Self::undetermined(&normal, &layout)))?;
        Ok(Solution {
            rms_px: (squares / (measurements / 2) as f64).sqrt(),
            residuals: at.residuals,
            sigma_px,
            steps,
            covariance,
        })
    }

    fn moved(&self, layout: &Layout, step: &normal::Step) -> Self {
        let mut next = self.clone();
        for (camera, at) in next.cameras.iter_mut().zip(&layout.cameras) {
            let free = (0..INTRINSIC_PARAMETERS).filter(|i| camera.free_intrinsics[*i]);
            for (k, parameter) in free.enumerate() {
                *intrinsic_mut(&mut camera.intrinsics, parameter) += step.shared[at.start + k];
            }
            if camera.free_pose {
                let by = |k: usize| step.shared[at.pose + k];
                camera.camera_from_rig = camera
                    .camera_from_rig
                    .moved(DVec3::new(by(0), by(1), by(2)), DVec3::new(by(3), by(4), by(5)));
            }
        }
        if self.free_warp {
            next.warp.x_m += step.shared[layout.warp];
            next.warp.y_m += step.shared[layout.warp + 1];
        }
        for (pose, by) in next.rig_from_board.iter_mut().zip(&step.views) {
            *pose = pose.moved(DVec3::new(by[0], by[1], by[2]), DVec3::new(by[3], by[4], by[5]));
        }
        next
    }

    fn undetermined(normal: &Normal, layout: &Layout) -> String {
        let unknown = normal.weakest().map_or_else(
            || "a board pose".to_owned(),
            |index| {
                for (i, at) in layout.cameras.iter().enumerate() {
                    if index >= at.pose && index < at.end {
                        return format!("the pose of camera {i}");
                    }
                    if index >= at.start && index < at.end {
                        return format!("an intrinsic parameter of camera {i}");
                    }
                }
                "the board's shape".to_owned()
            },
        );
        format!(
            "the views do not determine {unknown}; take views with the board tilted, near and far, and at the edges"
        )
    }
}

/// Where the unknowns that views share lie in a step.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Layout {
    pub(crate) cameras: Vec<CameraLayout>,
    pub(crate) warp: usize,
    pub(crate) shared: usize,
}

/// A camera's unknowns: free intrinsics from `start`, its pose from `pose` to `end`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CameraLayout {
    pub(crate) start: usize,
    pub(crate) pose: usize,
    pub(crate) end: usize,
}

impl Layout {
    pub(crate) fn new(problem: &Problem) -> Self {
        let mut end = 0;
        let mut cameras = Vec::with_capacity(problem.cameras.len());
        for camera in &problem.cameras {
            let start = end;
            let pose = start + camera.free_intrinsics.iter().filter(|f| **f).count();
            end = pose + if camera.free_pose { 6 } else { 0 };
            cameras.push(CameraLayout { start, pose, end });
        }
        let warp = end;
        let shared = end + if problem.free_warp { 2 } else { 0 };
        Self { cameras, warp, shared }
    }
}

/// The intrinsic parameter of this index, as in [`INTRINSIC_PARAMETERS`].
pub(crate) fn intrinsic_mut(k: &mut Intrinsics, index: usize) -> &mut f64 {
    match index {
        0 => &mut k.fx,
        1 => &mut k.fy,
        2 => &mut k.cx,
        3 => &mut k.cy,
        _ => &mut k.coeffs[index - 4],
    }
}

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}
