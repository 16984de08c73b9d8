//! Poses of all cameras on the mount, from views of a board that several of them see at once.

use crate::Rigid;
use crate::adjustment::{AdjustedCamera, Corner, INTRINSIC_PARAMETERS, Problem, Sighting, Warp};
use crate::board_pose::{board_pose, nearest_rotation};
use crate::robust::{self, RobustSolution};
use depthrig_bus::Intrinsics;
use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DMat3, DVec3};

/// A camera of the mount.
#[derive(Debug, Clone, PartialEq)]
pub struct RigCamera {
    /// Its name, for messages.
    pub name: String,
    /// Its intrinsics: the start of those that are estimated.
    pub intrinsics: Intrinsics,
    /// Intrinsics that are estimated together with the poses.
    pub free_intrinsics: [bool; INTRINSIC_PARAMETERS],
}

/// The board at one moment: what each camera sees of it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RigView {
    /// Name of the view, for messages.
    pub name: String,
    /// Index of a camera, and its corners.
    pub seen: Vec<Seen>,
}

/// Corners that one camera sees.
#[derive(Debug, Clone, PartialEq)]
pub struct Seen {
    /// Index of the camera.
    pub camera: usize,
    /// Its corners.
    pub corners: Vec<Corner>,
}

/// The calibrated mount.
#[derive(Debug, Clone, PartialEq)]
pub struct RigResult {
    /// The cameras; the first one's pose is the identity: the rig's coordinates are its optical frame.
    pub cameras: Vec<AdjustedCamera>,
    /// The board's pose in each view.
    pub rig_from_board: Vec<Rigid>,
    /// The board's shape.
    pub warp: Warp,
    /// Residuals, covariance, corners left out.
    pub fit: RobustSolution,
    /// The sightings without the corners left out.
    pub sightings: Vec<Sighting>,
}

/// Settings of [`calibrate_rig`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigOptions {
    /// Estimate the board's shape.
    pub free_warp: bool,
    /// Leave out corners that are far from their places.
    pub reject_outliers: bool,
}

impl Default for RigOptions {
    fn default() -> Self {
        Self { free_warp: false, reject_outliers: true }
    }
}

/// Estimates the poses of all cameras, and whichever intrinsics are free, in one adjustment.
///
/// # Errors
/// [`ErrorKind::BadInput`] for cameras that no chain of common views joins (the message names the groups), and as
/// [`Problem::solve`].
pub fn calibrate_rig(cameras: &[RigCamera], views: &[RigView], options: &RigOptions) -> Result<RigResult> {
    let mut problem = start(cameras, views)?;
    problem.free_warp = options.free_warp;
    let fit = if options.reject_outliers {
        robust::solve(&mut problem)?
    } else {
        RobustSolution {
            solution: problem.solve(&crate::adjustment::Options::default())?,
            outliers: Vec::new(),
        }
    };
    Ok(RigResult {
        cameras: problem.cameras,
        rig_from_board: problem.rig_from_board,
        warp: problem.warp,
        fit,
        sightings: problem.sightings,
    })
}

/// The board's pose as one camera alone gives it.
struct Estimate {
    camera: usize,
    view: usize,
    corners: usize,
    camera_from_board: Rigid,
}

/// Poses to start from: along a maximum spanning tree of the pairs of cameras by the corners that they see together.
fn start(cameras: &[RigCamera], views: &[RigView]) -> Result<Problem> {
    let mut estimates = Vec::new();
    let mut sightings = Vec::new();
    for (view, of) in views.iter().enumerate() {
        for seen in &of.seen {
            let camera = &cameras[seen.camera];
            let pose = board_pose(&camera.intrinsics, &seen.corners).map_err(|e| {
                Error::new(e.kind(), format!("camera {}, view {}: {e}", camera.name, of.name))
            })?;
            estimates.push(Estimate {
                camera: seen.camera,
                view,
                corners: seen.corners.len(),
                camera_from_board: pose.camera_from_board,
            });
            sightings.push(Sighting { camera: seen.camera, view, corners: seen.corners.clone() });
        }
    }
    let camera_from_rig = join(cameras, &estimates)?;
    let mut rig_from_board = Vec::with_capacity(views.len());
    for (view, of) in views.iter().enumerate() {
        let best = estimates.iter().filter(|e| e.view == view).max_by_key(|e| e.corners);
        let best = best.ok_or_else(|| {
            Error::new(ErrorKind::BadInput, format!("no camera sees the board in view {}", of.name))
        })?;
        rig_from_board.push(camera_from_rig[best.camera].inverse().after(&best.camera_from_board));
    }
    Ok(Problem {
        cameras: cameras
            .iter()
            .zip(&camera_from_rig)
            .enumerate()
            .map(|(i, (camera, camera_from_rig))| AdjustedCamera {
                intrinsics: camera.intrinsics,
                camera_from_rig: *camera_from_rig,
                free_intrinsics: camera.free_intrinsics,
                free_pose: i > 0,
            })
            .collect(),
        rig_from_board,
        warp: Warp::default(),
        free_warp: false,
        sightings,
    })
}

/// Each camera's pose in the first one's frame.
fn join(cameras: &[RigCamera], estimates: &[Estimate]) -> Result<Vec<Rigid>> {
    let n = cameras.len();
    let mut poses: Vec<Option<Rigid>> = vec![None; n];
    if let Some(first) = poses.first_mut() {
        *first = Some(Rigid::IDENTITY);
    }
    // Prim's algorithm; with seven cameras nothing better is needed.
    loop {
        let mut best: Option<Link> = None;
        for known in (0..n).filter(|i| poses[*i].is_some()) {
            for unknown in (0..n).filter(|i| poses[*i].is_none()) {
                let weight = common_corners(estimates, known, unknown);
                if weight > best.as_ref().map_or(0, |b| b.weight) {
                    best = Some(Link { known, unknown, weight });
                }
            }
        }
        let Some(link) = best else { break };
        let between = relative_pose(estimates, link.unknown, link.known);
        poses[link.unknown] = poses[link.known].zip(between).map(|(known, b)| b.after(&known));
    }
    let found: Vec<Rigid> = poses.iter().flatten().copied().collect();
    if found.len() == n { Ok(found) } else { Err(disconnected(cameras, estimates)) }
}

struct Link {
    known: usize,
    unknown: usize,
    weight: usize,
}

/// Views that two cameras share, as pairs of their estimates.
fn common(estimates: &[Estimate], a: usize, b: usize) -> impl Iterator<Item = (&Estimate, &Estimate)> {
    estimates.iter().filter(move |e| e.camera == a).filter_map(move |of_a| {
        estimates.iter().find(|e| e.camera == b && e.view == of_a.view).map(|of_b| (of_a, of_b))
    })
}

fn common_corners(estimates: &[Estimate], a: usize, b: usize) -> usize {
    common(estimates, a, b).map(|(of_a, of_b)| of_a.corners.min(of_b.corners)).sum()
}

/// The pose of camera `b` in camera `a`: the rotation nearest to all that views give, and the median translation after the views
/// whose rotation is far from the median are left out.
fn relative_pose(estimates: &[Estimate], a: usize, b: usize) -> Option<Rigid> {
    let mut each: Vec<Rigid> = common(estimates, a, b)
        .map(|(of_a, of_b)| of_a.camera_from_board.after(&of_b.camera_from_board.inverse()))
        .collect();
    // The one whose summed distance from the others is least; a view with the wrong one of two poses is far from it.
    let far = |p: &Rigid| each.iter().map(|q| p.distance(q).radians).sum::<f64>();
    let middle = *each.iter().min_by(|p, q| far(p).total_cmp(&far(q)))?;
    let mut angles: Vec<f64> = each.iter().map(|p| p.distance(&middle).radians).collect();
    angles.sort_by(f64::total_cmp);
    let limit = 3.0 * angles[angles.len() / 2] + 1e-3;
    each.retain(|p| p.distance(&middle).radians <= limit);
    let sum = each.iter().fold(DMat3::ZERO, |sum, p| sum + DMat3::from_quat(p.rotation));
    let rotation = nearest_rotation(sum)?;
    let median = |axis: fn(&DVec3) -> f64| {
        let mut values: Vec<f64> = each.iter().map(|p| axis(&p.translation)).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    Some(Rigid::from_matrix(rotation, DVec3::new(median(|t| t.x), median(|t| t.y), median(|t| t.z))))
}

fn disconnected(cameras: &[RigCamera], estimates: &[Estimate]) -> Error {
    let n = cameras.len();
    let mut group: Vec<usize> = (0..n).collect();
    for a in 0..n {
        for b in 0..a {
            if common_corners(estimates, a, b) > 0 && group[a] != group[b] {
                let old = group[a];
                let new = group[b];
                group.iter_mut().filter(|g| **g == old).for_each(|g| *g = new);
            }
        }
    }
    let mut groups: Vec<String> = Vec::new();
    for g in 0..n {
        let names: Vec<&str> = (0..n).filter(|i| group[*i] == g).map(|i| cameras[i].name.as_str()).collect();
        if !names.is_empty() {
            groups.push(format!("[{}]", names.join(", ")));
        }
    }
    Error::new(
        ErrorKind::BadInput,
        format!(
            "no view of the board joins these groups of cameras: {}; take views in which the board is seen by cameras of \
             two groups at once",
            groups.join(" and ")
        ),
    )
}
