//! The next view that would reduce the uncertainty of projection most.
//!
//! Candidate poses of the board before each camera are ranked by the determinant of what all views would then determine (D-optimality),
//! and the best of them by the uncertainty of projection that would be left over the images (I-optimality; Pukelsheim, Optimal
//! Design of Experiments, 1993; for calibration boards: Rojtberg and Kuijper, Efficient Pose Selection for Interactive Camera
//! Calibration, 2018).

use super::CaptureCamera;
use super::estimate::Group;
use super::poses::{Candidate, Points, sightings};
use crate::adjustment::{Problem, log_determinant};
use crate::intrinsics::ImageSize;
use crate::mount::Coverage;
use depthrig_calib::Camera;

/// Candidates whose uncertainty is computed.
const FINALISTS: usize = 8;

/// The view to take next.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Planned {
    /// Index of the camera before which the board is to be held.
    pub(super) camera: usize,
    /// Where.
    pub(super) candidate: Candidate,
    /// Cameras that would see it.
    pub(super) seen_by: Vec<usize>,
    /// Share of the summed variance of projection that it would take away.
    pub(super) gain: f64,
}

/// Purpose of the next view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Aim<'a> {
    /// Whatever reduces uncertainty.
    Certainty,
    /// Corners in parts of the image that have none.
    Coverage(&'a Coverage),
    /// Being seen by another camera, too.
    Shared,
}

/// A camera of the group before which the board is to be held, and to what end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Wanted<'a> {
    /// Index in the group.
    pub(super) camera: usize,
    /// The aim.
    pub(super) aim: Aim<'a>,
}

struct Ranked {
    camera: usize,
    candidate: Candidate,
    view: Problem,
    determinant: f64,
}

/// The best view before any of the wanted cameras of a group; `None` if nothing can be said.
pub(super) fn best(
    group: &Group,
    cameras: &[CaptureCamera],
    points: &Points,
    wanted: &[Wanted<'_>],
) -> Option<Planned> {
    let sizes: Vec<ImageSize> = group.cameras.iter().map(|c| cameras[*c].size).collect();
    let lenses: Result<Vec<Camera>, _> =
        group.problem.cameras.iter().map(|c| Camera::new(&c.intrinsics)).collect();
    let lenses = lenses.ok()?;
    let base = group.information.reduced()?;
    let mut ranked = Vec::new();
    for want in wanted {
        let rig_from_camera = group.problem.cameras[want.camera].camera_from_rig.inverse();
        for candidate in points.candidates(&lenses[want.camera], sizes[want.camera]) {
            let board = rig_from_camera.after(&candidate.camera_from_board);
            let seen = sightings(points, &group.problem.cameras, &lenses, &sizes, &board);
            let Some(own) = seen.iter().find(|s| s.camera == want.camera) else { continue };
            let fits = match want.aim {
                Aim::Certainty => true,
                Aim::Coverage(coverage) => {
                    let pixels = own.corners.iter().map(|c| c.pixel);
                    coverage.fills(&Coverage::new(sizes[want.camera], pixels))
                }
                Aim::Shared => seen.len() > 1,
            };
            if !fits {
                continue;
            }
            let view = Problem { rig_from_board: vec![board], sightings: seen, ..of_cameras(&group.problem) };
            let Some(more) = group.information.reduced_of(&view) else { continue };
            let Some(determinant) = log_determinant(&base + more) else { continue };
            ranked.push(Ranked { camera: want.camera, candidate, view, determinant });
        }
    }
    ranked.sort_by(|a, b| b.determinant.total_cmp(&a.determinant));
    let before = total(group, cameras, None)?;
    let mut best: Option<Planned> = None;
    for Ranked { camera, candidate, view, .. } in finalists(ranked, wanted) {
        let Some(after) = total(group, cameras, Some(&view)) else { continue };
        let gain = 1.0 - after / before;
        if best.as_ref().is_none_or(|b| gain > b.gain) {
            best = Some(Planned {
                camera: group.cameras[camera],
                seen_by: view.sightings.iter().map(|s| group.cameras[s.camera]).collect(),
                candidate,
                gain,
            });
        }
    }
    best
}

/// The cameras without any view.
fn of_cameras(problem: &Problem) -> Problem {
    Problem {
        cameras: problem.cameras.clone(),
        rig_from_board: Vec::new(),
        warp: problem.warp,
        free_warp: false,
        sightings: Vec::new(),
    }
}

/// The first ones overall, and the first one of each camera.
fn finalists(ranked: Vec<Ranked>, wanted: &[Wanted<'_>]) -> Vec<Ranked> {
    let firsts: Vec<usize> =
        wanted.iter().filter_map(|w| ranked.iter().position(|r| r.camera == w.camera)).collect();
    let keep = |i: usize| i < FINALISTS || firsts.contains(&i);
    ranked.into_iter().enumerate().filter(|(i, _)| keep(*i)).map(|(_, r)| r).collect()
}

/// Mean variance of projection summed over the group's cameras, pixels squared, with one view more.
fn total(group: &Group, cameras: &[CaptureCamera], more: Option<&Problem>) -> Option<f64> {
    let information = match more {
        Some(view) => &group.information.with(view),
        None => &group.information,
    };
    let covariance = information.covariance()?;
    let mut boards = group.problem.rig_from_board.clone();
    let next = boards.len();
    boards.extend(more.iter().flat_map(|m| &m.rig_from_board));
    let mut sum = 0.0;
    for (camera, index) in group.cameras.iter().enumerate() {
        let sees = more.is_some_and(|m| m.sightings.iter().any(|s| s.camera == camera));
        let size = cameras[*index].size;
        let found = group.uncertainty(camera, size, &covariance, &boards, sees.then_some(next))?;
        sum += found.mean_square;
    }
    Some(sum)
}
