//! Whether a calibrated mount is still as it was: which camera has moved, by how much, and how sure that is.

use crate::adjustment::{AdjustedCamera, INTRINSIC_PARAMETERS, Options, Problem, Sighting, Solution, Warp};
use crate::rig::RigView;
use crate::{Distance, Rigid, board_pose};
use depthrig_bus::Intrinsics;
use depthrig_calib::{Error, ErrorKind, Result};
use nalgebra::{Matrix6, Vector6};

/// A camera as it was calibrated.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownCamera {
    /// Its name, for messages.
    pub name: String,
    /// Its intrinsics.
    pub intrinsics: Intrinsics,
    /// Its pose.
    pub rig_from_camera: Rigid,
    /// Covariance of the pose, as [`crate::adjustment::Covariance::pose`] has it; zero for the reference.
    pub covariance: Matrix6<f64>,
}

/// A camera's pose now against the calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Index of the camera.
    pub camera: usize,
    /// How far it is from where it was calibrated.
    pub by: Distance,
    /// One standard deviation of that: the root of the sum over three axes.
    pub sigma: Distance,
    /// Square of the distance in standard deviations of six coordinates: 6 on average of a camera that did not move,
    /// above 24 in one of two thousand.
    pub chi_squared: f64,
}

impl Motion {
    /// Whether it is more than noise, and more than anybody minds.
    pub fn is_significant(&self) -> bool {
        self.chi_squared > SIGNIFICANT && (self.by.metres > MIN_METRES || self.by.radians > MIN_RADIANS)
    }
}

/// Chi-squared with six degrees of freedom is above this with a probability of 0.0005.
pub(crate) const SIGNIFICANT: f64 = 24.1;
/// Motions below these are within what temperature does to a mount.
pub(crate) const MIN_METRES: f64 = 0.5e-3;
pub(crate) const MIN_RADIANS: f64 = 0.000_9;

/// Result of [`check`].
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// Cameras that moved, the one that explains most first.
    pub moved: Vec<Motion>,
    /// The others that could be checked.
    pub unmoved: Vec<Motion>,
    /// Indices of cameras that saw the board with no other camera.
    pub unchecked: Vec<usize>,
    /// With two cameras either may be the one that moved.
    pub either: bool,
}

/// Compares views of the board with a calibration. A camera is moved in thought, one after the other, and the one that explains the views best is
/// taken, as long as its motion is significant.
///
/// # Errors
/// [`ErrorKind::BadInput`] if no view shows the board to two cameras at once, and as [`Problem::solve`].
pub fn check(cameras: &[KnownCamera], views: &[RigView]) -> Result<Checked> {
    let shared: Vec<&RigView> = views.iter().filter(|v| v.seen.len() > 1).collect();
    let sees = |camera: usize| shared.iter().any(|v| v.seen.iter().any(|s| s.camera == camera));
    let checked: Vec<usize> = (0..cameras.len()).filter(|c| sees(*c)).collect();
    let unchecked: Vec<usize> = (0..cameras.len()).filter(|c| !sees(*c)).collect();
    if checked.is_empty() {
        return Err(Error::new(
            ErrorKind::BadInput,
            "no view shows the board to two cameras at once; hold it where several cameras see it",
        ));
    }
    let start = problem(cameras, &shared)?;
    let mut free: Vec<usize> = Vec::new();
    let mut moved: Vec<Motion> = Vec::new();
    // One camera at least stays: it is what the others are compared with.
    while free.len() + 1 < checked.len() {
        let candidates = checked.iter().filter(|c| !free.contains(c));
        let mut best: Option<Trial> = None;
        for camera in candidates {
            let trial = Trial::new(&start, &free, *camera, cameras)?;
            if best.as_ref().is_none_or(|b| trial.rms_px < b.rms_px) {
                best = Some(trial);
            }
        }
        let Some(best) = best.filter(|b| b.motion.is_significant()) else { break };
        free.push(best.motion.camera);
        moved.push(best.motion);
    }
    let still = checked.iter().filter(|c| !free.contains(c));
    let trials: Result<Vec<Trial>> = still
        .filter(|_| free.len() + 1 < checked.len())
        .map(|camera| Trial::new(&start, &free, *camera, cameras))
        .collect();
    Ok(Checked {
        either: checked.len() == 2,
        unmoved: trials?.into_iter().map(|t| t.motion).collect(),
        moved,
        unchecked,
    })
}

/// The views with every camera where it was calibrated.
fn problem(cameras: &[KnownCamera], views: &[&RigView]) -> Result<Problem> {
    let mut sightings = Vec::new();
    let mut rig_from_board = Vec::with_capacity(views.len());
    for (view, of) in views.iter().enumerate() {
        let best = of.seen.iter().max_by_key(|s| s.corners.len());
        let best = best.ok_or_else(|| Error::new(ErrorKind::BadInput, "a view without the board"))?;
        let camera = &cameras[best.camera];
        let pose = board_pose(&camera.intrinsics, &best.corners)
            .map_err(|e| Error::new(e.kind(), format!("camera {}, view {}: {e}", camera.name, of.name)))?;
        rig_from_board.push(camera.rig_from_camera.after(&pose.camera_from_board));
        sightings.extend(of.seen.iter().map(|seen| Sighting {
            camera: seen.camera,
            view,
            corners: seen.corners.clone(),
        }));
    }
    Ok(Problem {
        cameras: cameras
            .iter()
            .map(|camera| AdjustedCamera {
                intrinsics: camera.intrinsics,
                camera_from_rig: camera.rig_from_camera.inverse(),
                free_intrinsics: [false; INTRINSIC_PARAMETERS],
                free_pose: false,
            })
            .collect(),
        rig_from_board,
        warp: Warp::default(),
        free_warp: false,
        sightings,
    })
}

/// The views with some cameras free to move.
struct Trial {
    motion: Motion,
    rms_px: f64,
}

impl Trial {
    fn new(start: &Problem, free: &[usize], camera: usize, cameras: &[KnownCamera]) -> Result<Self> {
        let mut problem = start.clone();
        for c in free.iter().chain([&camera]) {
            problem.cameras[*c].free_pose = true;
        }
        // A camera that moved a lot would pull the boards with it at first.
        problem.solve(&Options { huber_px: Some(1.0), ..Options::default() })?;
        let solution = problem.solve(&Options::default())?;
        let motion = motion(&problem, &solution, camera, cameras);
        Ok(Self { motion, rms_px: solution.rms_px })
    }
}

fn motion(problem: &Problem, solution: &Solution, camera: usize, cameras: &[KnownCamera]) -> Motion {
    let now = problem.cameras[camera].camera_from_rig;
    let then = cameras[camera].rig_from_camera.inverse();
    let between = now.after(&then.inverse());
    let r = between.rotation_vector();
    let t = between.translation;
    let moved = Vector6::new(r.x, r.y, r.z, t.x, t.y, t.z);
    let covariance = solution.covariance.pose(camera) + calibrated(camera, cameras);
    let chi_squared = covariance.try_inverse().map_or(0.0, |inverse| moved.dot(&(inverse * moved)));
    let root = |from: usize| (from..from + 3).map(|i| covariance[(i, i)]).sum::<f64>().sqrt();
    Motion {
        camera,
        by: Distance { metres: now.inverse().distance(&then.inverse()).metres, radians: r.length() },
        sigma: Distance { metres: root(3), radians: root(0) },
        chi_squared,
    }
}

/// Covariance of a calibrated pose against the other cameras: of the reference, which has none of its own, the mean of theirs.
fn calibrated(camera: usize, cameras: &[KnownCamera]) -> Matrix6<f64> {
    let own = cameras[camera].covariance;
    if own != Matrix6::zeros() {
        return own;
    }
    let others = cameras.iter().map(|c| c.covariance).filter(|c| *c != Matrix6::zeros());
    let count = others.clone().count().max(1) as f64;
    others.sum::<Matrix6<f64>>() / count
}
