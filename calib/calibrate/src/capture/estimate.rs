//! A rough calibration of each group of cameras that common views join, and its uncertainty.

use super::CaptureCamera;
use super::poses::Points;
use crate::adjustment::{AdjustedCamera, Covariance, INTRINSIC_PARAMETERS, Information, Prior, Problem};
use crate::intrinsics::{self, ImageSize, IntrinsicsOptions, MIN_VIEWS};
use crate::rig::{RigCamera, RigOptions, RigView, Seen, calibrate_rig};
use crate::uncertainty::{Sample, projection_sigma};
use crate::{Rigid, board_pose};
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::Camera;
use glam::DVec2;

/// Standard deviation of a corner's coordinate that is assumed at least, pixels: residuals of few views flatter.
const LEAST_SIGMA_PX: f64 = 0.1;
/// Places of the map of uncertainty along x and y.
const COLUMNS: usize = 5;
const ROWS: usize = 4;

/// Cameras that common views join.
#[derive(Debug, Clone)]
pub(super) struct Group {
    /// Their indices; the first one's frame is the group's.
    pub(super) cameras: Vec<usize>,
    /// Their calibration, in this order, and the boards of the group's views.
    pub(super) problem: Problem,
    /// Information of the views.
    pub(super) information: Information,
    /// For each camera the views that show the board to it.
    pub(super) views_of: Vec<Vec<usize>>,
    /// For each camera the median distance of the board, metres.
    pub(super) distances_m: Vec<f64>,
}

/// Uncertainty of projection of one camera over its image, pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Uncertainty {
    /// Mean of the variance, pixels squared.
    pub(super) mean_square: f64,
    /// The largest standard deviation.
    pub(super) worst_px: f64,
}

/// Joins the cameras that see the board together; each list is sorted, cameras without a view are missing.
pub(super) fn groups_of(cameras: usize, views: &[RigView]) -> Vec<Vec<usize>> {
    let mut group: Vec<Option<usize>> = vec![None; cameras];
    for view in views {
        for seen in &view.seen {
            group[seen.camera].get_or_insert(seen.camera);
        }
        for seen in view.seen.iter().skip(1) {
            let new = group[view.seen[0].camera];
            let old = group[seen.camera];
            group.iter_mut().filter(|g| **g == old).for_each(|g| *g = new);
        }
    }
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for label in 0..cameras {
        let of: Vec<usize> = (0..cameras).filter(|c| group[*c] == Some(label)).collect();
        if !of.is_empty() {
            groups.push(of);
        }
    }
    groups
}

/// Intrinsics that the views of a camera give, else the factory's, else a guess.
pub(super) fn intrinsics_of(camera: &CaptureCamera, index: usize, views: &[RigView]) -> Intrinsics {
    let width = f64::from(camera.size.width);
    let guess = camera.factory.unwrap_or_else(|| {
        let middle = DVec2::new(width, f64::from(camera.size.height)) * 0.5;
        let k = Intrinsics::pinhole(0.9 * width, 0.9 * width, middle.x, middle.y);
        Intrinsics { model: Distortion::BrownConrady as u32, ..k }
    });
    let corners: Vec<_> =
        views.iter().flat_map(|v| &v.seen).filter(|s| s.camera == index).map(|s| s.corners.clone()).collect();
    // Few views fit anything; the guess is nearer to the truth then.
    if corners.len() < 2 * MIN_VIEWS {
        return guess;
    }
    let model = guess.distortion();
    let options = IntrinsicsOptions {
        model,
        free: Some(free_parameters(model)),
        start: camera.factory,
        ..IntrinsicsOptions::default()
    };
    let found = intrinsics::calibrate(camera.size, &corners, &options).ok();
    let found = found.map(|f| f.camera.intrinsics);
    let plausible = |k: &Intrinsics| {
        [k.fx, k.fy].iter().all(|f| (0.2..10.0).contains(&(f / width)))
            && (0.0..width).contains(&k.cx)
            && (0.0..f64::from(camera.size.height)).contains(&k.cy)
    };
    found.filter(plausible).unwrap_or(guess)
}

/// The parameters that views are planned for: those that `solve` always estimates.
fn free_parameters(model: Distortion) -> [bool; INTRINSIC_PARAMETERS] {
    let mut free = AdjustedCamera::all_free(model);
    match model {
        Distortion::BrownConrady | Distortion::InverseBrownConrady | Distortion::Rational => {
            free[8..].fill(false);
        }
        Distortion::KannalaBrandt4 => free[6..].fill(false),
        _ => {}
    }
    free
}

fn prior(size: ImageSize, k: &Intrinsics) -> Prior {
    let mut sigmas = [0.3; INTRINSIC_PARAMETERS];
    let width = f64::from(size.width);
    sigmas[..4].copy_from_slice(&[0.1 * k.fx, 0.1 * k.fy, 0.05 * width, 0.05 * width]);
    // The tangential coefficients of the Brown-Conrady family.
    if k.distortion() != Distortion::KannalaBrandt4 {
        sigmas[6..8].fill(0.01);
    }
    Prior { intrinsics: sigmas, rotation: 1.0, translation: 1.0 }
}

impl Group {
    /// Calibrates a group roughly; `None` if its views do not allow that yet.
    pub(super) fn new(
        members: &[usize],
        cameras: &[CaptureCamera],
        intrinsics: &[Intrinsics],
        views: &[RigView],
    ) -> Option<Self> {
        let local = |camera: usize| members.iter().position(|m| *m == camera);
        let views: Vec<RigView> = views
            .iter()
            .map(|view| RigView {
                name: view.name.clone(),
                seen: (view.seen.iter())
                    .filter_map(|s| Some(Seen { camera: local(s.camera)?, corners: s.corners.clone() }))
                    .collect(),
            })
            .filter(|view| !view.seen.is_empty())
            .collect();
        let of_rig: Vec<RigCamera> = members
            .iter()
            .map(|m| RigCamera {
                name: cameras[*m].name.clone(),
                intrinsics: intrinsics[*m],
                free_intrinsics: [false; INTRINSIC_PARAMETERS],
            })
            .collect();
        let options = RigOptions { free_warp: false, reject_outliers: views.len() > 2 };
        let found = calibrate_rig(&of_rig, &views, &options).ok()?;
        let mut problem = Problem {
            cameras: found.cameras,
            rig_from_board: found.rig_from_board,
            warp: found.warp,
            free_warp: false,
            sightings: found.sightings,
        };
        for camera in &mut problem.cameras {
            camera.free_intrinsics = free_parameters(camera.intrinsics.distortion());
        }
        let priors: Vec<Prior> = members.iter().map(|m| prior(cameras[*m].size, &intrinsics[*m])).collect();
        let sigma_px = found.fit.solution.sigma_px.clamp(LEAST_SIGMA_PX, 1.0);
        let information = Information::new(&problem, &priors, sigma_px);
        let views_of: Vec<Vec<usize>> = (0..members.len())
            .map(|c| problem.sightings.iter().filter(|s| s.camera == c).map(|s| s.view).collect())
            .collect();
        let distances_m = (0..members.len()).map(|c| median_distance(&problem, c)).collect();
        Some(Self { cameras: members.to_vec(), problem, information, views_of, distances_m })
    }

    /// A group of one camera that has seen nothing yet, for its first view.
    pub(super) fn unseen(
        index: usize,
        camera: &CaptureCamera,
        k: &Intrinsics,
        points: &Points,
    ) -> Option<Self> {
        let lens = Camera::new(k).ok()?;
        let first = points.candidates(&lens, camera.size).into_iter().nth(22)?;
        let problem = Problem {
            cameras: vec![AdjustedCamera {
                intrinsics: *k,
                camera_from_rig: Rigid::IDENTITY,
                free_intrinsics: free_parameters(k.distortion()),
                free_pose: false,
            }],
            rig_from_board: Vec::new(),
            warp: crate::adjustment::Warp::default(),
            free_warp: false,
            sightings: Vec::new(),
        };
        let information = Information::new(&problem, &[prior(camera.size, k)], LEAST_SIGMA_PX);
        Some(Self {
            cameras: vec![index],
            problem,
            information,
            views_of: vec![Vec::new()],
            distances_m: vec![first.distance_m],
        })
    }

    /// Uncertainty of each camera with this covariance, and with these views more of each.
    pub(super) fn uncertainty(
        &self,
        camera: usize,
        size: ImageSize,
        covariance: &Covariance,
        boards: &[Rigid],
        more: Option<usize>,
    ) -> Option<Uncertainty> {
        let mut views = self.views_of[camera].clone();
        views.extend(more);
        let mut sum = 0.0;
        let mut count = 0_u32;
        let mut worst = 0.0_f64;
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let place =
                    |i: usize, n: usize, side: u32| i as f64 / (n - 1) as f64 * (f64::from(side) - 1.0);
                let pixel = DVec2::new(place(column, COLUMNS, size.width), place(row, ROWS, size.height));
                let at = Sample { pixel, distance_m: self.distances_m[camera] };
                let of = &self.problem.cameras[camera];
                let sigma = projection_sigma(of, camera, boards, &views, covariance, at).ok()?;
                let Some(sigma) = sigma.filter(|s| s.is_finite()) else { continue };
                sum += sigma * sigma;
                worst = worst.max(sigma);
                count += 1;
            }
        }
        (count > 0).then(|| Uncertainty { mean_square: sum / f64::from(count), worst_px: worst })
    }
}

fn median_distance(problem: &Problem, camera: usize) -> f64 {
    let mut distances: Vec<f64> = problem
        .sightings
        .iter()
        .filter(|s| s.camera == camera)
        .flat_map(|s| {
            let pose = problem.cameras[camera].camera_from_rig.after(&problem.rig_from_board[s.view]);
            s.corners.iter().map(move |c| pose.transform(c.point).length())
        })
        .collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() / 2).copied().unwrap_or(1.0)
}

/// The distance of the board from a camera that sees it now, metres.
pub(super) fn distance_now(k: &Intrinsics, seen: &Seen) -> Option<f64> {
    let pose = board_pose(k, &seen.corners).ok()?.camera_from_board;
    let n = seen.corners.len().max(1) as f64;
    Some(seen.corners.iter().map(|c| pose.transform(c.point).length()).sum::<f64>() / n)
}
