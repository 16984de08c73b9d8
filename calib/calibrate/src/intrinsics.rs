//! Intrinsics of one camera from views of a board.

use crate::Rigid;
use crate::adjustment::{AdjustedCamera, Corner, INTRINSIC_PARAMETERS, Options, Problem, Sighting, Warp};
use crate::board_pose::board_pose;
use crate::homography::{Pair, focal_length, homography};
use crate::robust::{self, RobustSolution};
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DMat3, DVec2};

/// Size of an image, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Settings of [`calibrate`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntrinsicsOptions {
    /// The distortion model.
    pub model: Distortion,
    /// Which parameters are estimated; `None`: whichever predict views better
    /// that they were not fitted to.
    pub free: Option<[bool; INTRINSIC_PARAMETERS]>,
    /// Leave out corners that are far from their places.
    pub reject_outliers: bool,
    /// Intrinsics to start from; `None`: they are found.
    pub start: Option<Intrinsics>,
}

impl Default for IntrinsicsOptions {
    fn default() -> Self {
        Self { model: Distortion::BrownConrady, free: None, reject_outliers: true, start: None }
    }
}

/// Result of [`calibrate`].
#[derive(Debug, Clone, PartialEq)]
pub struct IntrinsicsResult {
    /// The camera; its pose is the identity.
    pub camera: AdjustedCamera,
    /// The board's pose in each view.
    pub camera_from_board: Vec<Rigid>,
    /// Residuals, covariance, corners left out.
    pub fit: RobustSolution,
}

impl IntrinsicsResult {
    /// Standard deviations of the intrinsics, as in [`INTRINSIC_PARAMETERS`].
    pub fn sigmas(&self) -> [f64; INTRINSIC_PARAMETERS] {
        self.fit.solution.covariance.intrinsic_sigmas(0, &self.camera.free_intrinsics)
    }
}

/// Views below which intrinsics are refused: two determine the focal length, and nothing checks them.
pub const MIN_VIEWS: usize = 3;

/// Estimates a camera's intrinsics from views of a board.
///
/// # Errors
/// [`ErrorKind::BadInput`] for fewer than [`MIN_VIEWS`] views, views that do not determine the focal length (all frontal), and as
/// [`Problem::solve`].
pub fn calibrate(
    size: ImageSize,
    views: &[Vec<Corner>],
    options: &IntrinsicsOptions,
) -> Result<IntrinsicsResult> {
    if views.len() < MIN_VIEWS {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!(
                "{} views of the board; intrinsics need {MIN_VIEWS} or more, with the board tilted in different directions",
                views.len()
            ),
        ));
    }
    let mut problem = match options.start {
        Some(start) => started(start, views)?,
        None => best_start(size, views, options.model)?,
    };
    problem.cameras[0].free_intrinsics = match options.free {
        Some(free) => free,
        None => choose_parameters(size, views, options, problem.cameras[0].intrinsics),
    };
    let fit = if options.reject_outliers {
        robust::solve(&mut problem)?
    } else {
        // A start far off is brought near by the robust loss.
        problem.solve(&Options { huber_px: Some(1.0), ..Options::default() })?;
        RobustSolution { solution: problem.solve(&Options::default())?, outliers: Vec::new() }
    };
    Ok(IntrinsicsResult {
        camera: problem.cameras[0].clone(),
        camera_from_board: problem.rig_from_board,
        fit,
    })
}

/// Chooses how many coefficients are estimated: all of the model, or without the highest radial ones, whichever predicts
/// views that it was not fitted to better.
fn choose_parameters(
    size: ImageSize,
    views: &[Vec<Corner>],
    options: &IntrinsicsOptions,
    start: Intrinsics,
) -> [bool; INTRINSIC_PARAMETERS] {
    let all = AdjustedCamera::all_free(options.model);
    let mut fewer = all;
    match options.model {
        // k3; k3 and the denominator.
        Distortion::BrownConrady | Distortion::InverseBrownConrady | Distortion::Rational => {
            fewer[8..].fill(false);
        }
        Distortion::KannalaBrandt4 => fewer[6..].fill(false),
        _ => return all,
    }
    let held_out = |free| {
        let options = IntrinsicsOptions { free: Some(free), start: Some(start), ..*options };
        held_out_rms(size, views, &options).unwrap_or(f64::INFINITY)
    };
    if held_out(all) < held_out(fewer) { all } else { fewer }
}

/// Parts into which views are divided for [`held_out_rms`].
const FOLDS: usize = 5;

/// Calibrates with each fifth of the views left out, and predicts those: of a view left out the board's pose alone is estimated. Returns
/// the median over views of the root mean square of the residuals' lengths, pixels; one bad view does not decide.
///
/// # Errors
/// As [`calibrate`].
pub fn held_out_rms(size: ImageSize, views: &[Vec<Corner>], options: &IntrinsicsOptions) -> Result<f64> {
    let folds = FOLDS.min(views.len());
    let mut pooled = Pooled::default();
    for fold in 0..folds {
        let part = |held: bool| -> Vec<Vec<Corner>> {
            views
                .iter()
                .enumerate()
                .filter(|(i, _)| (i % folds == fold) == held)
                .map(|(_, v)| v.clone())
                .collect()
        };
        let free = options.free.unwrap_or_else(|| AdjustedCamera::all_free(options.model));
        let found = calibrate(size, &part(false), &IntrinsicsOptions { free: Some(free), ..*options })?;
        pooled.add(&found.camera.intrinsics, &part(true));
    }
    pooled.rms()
}

/// Residuals of given intrinsics, of which nothing is estimated but the board's poses: the median over views, as
/// [`held_out_rms`], pixels.
///
/// # Errors
/// [`ErrorKind::BadInput`] if they show no view.
pub fn residual_rms(intrinsics: &Intrinsics, views: &[Vec<Corner>]) -> Result<f64> {
    let mut pooled = Pooled::default();
    pooled.add(intrinsics, views);
    pooled.rms()
}

/// The median over views of their root mean square residual: one bad view does not decide.
#[derive(Default)]
struct Pooled {
    of_views: Vec<f64>,
}

impl Pooled {
    fn add(&mut self, intrinsics: &Intrinsics, views: &[Vec<Corner>]) {
        self.of_views
            .extend(views.iter().map(|v| board_pose(intrinsics, v).map_or(f64::INFINITY, |p| p.rms_px)));
    }

    fn rms(mut self) -> Result<f64> {
        self.of_views.sort_by(f64::total_cmp);
        let middle = self.of_views.len() / 2;
        self.of_views
            .get(middle)
            .copied()
            .filter(|m| m.is_finite())
            .ok_or_else(|| Error::new(ErrorKind::BadInput, "the intrinsics do not show the views"))
    }
}

/// Focal lengths to start from, of the image's width, where homographies do not give one that leads to a better fit.
const STARTS: [f64; 3] = [0.5, 0.9, 1.6];

/// The best of several starts, each adjusted with the focal length and the board's poses free.
fn best_start(size: ImageSize, views: &[Vec<Corner>], model: Distortion) -> Result<Problem> {
    let centre = DVec2::new(f64::from(size.width) - 1.0, f64::from(size.height) - 1.0) * 0.5;
    let width = f64::from(size.width);
    let homographies: Result<Vec<DMat3>> = views.iter().map(|v| homography(&pairs(v))).collect();
    let from_views =
        focal_length(&homographies?, centre).filter(|f| (0.2 * width..=10.0 * width).contains(f));
    let mut best: Option<Start> = None;
    let mut failure = None;
    for f in from_views.into_iter().chain(STARTS.map(|s| s * width)) {
        let start = Intrinsics { model: model as u32, ..Intrinsics::pinhole(f, f, centre.x, centre.y) };
        match fitted(start, views) {
            Ok(found) => {
                let good = found.rms_px < GOOD_START_PX;
                if best.as_ref().is_none_or(|b| found.rms_px < b.rms_px) {
                    best = Some(found);
                }
                if good {
                    break;
                }
            }
            Err(e) => failure = Some(e),
        }
    }
    match (best, failure) {
        (Some(found), _) => Ok(found.problem),
        (None, Some(e)) => Err(e),
        (None, None) => Err(Error::new(ErrorKind::BadInput, "no focal length to start from")),
    }
}

/// A start with residuals below this needs no other one beside it, pixels.
const GOOD_START_PX: f64 = 3.0;

/// A start and how well it explains the corners.
struct Start {
    problem: Problem,
    rms_px: f64,
}

/// The boards' poses for given intrinsics.
fn started(start: Intrinsics, views: &[Vec<Corner>]) -> Result<Problem> {
    let poses: Result<Vec<Rigid>> =
        views.iter().map(|v| board_pose(&start, v).map(|p| p.camera_from_board)).collect();
    Ok(Problem {
        cameras: vec![AdjustedCamera {
            intrinsics: start,
            camera_from_rig: Rigid::IDENTITY,
            free_intrinsics: [false; INTRINSIC_PARAMETERS],
            free_pose: false,
        }],
        rig_from_board: poses?,
        warp: Warp::default(),
        free_warp: false,
        sightings: views
            .iter()
            .enumerate()
            .map(|(view, corners)| Sighting { camera: 0, view, corners: corners.clone() })
            .collect(),
    })
}

/// Adjusts the focal length and the first radial coefficient: with a fisheye lens the focal length alone leads nowhere.
fn fitted(start: Intrinsics, views: &[Vec<Corner>]) -> Result<Start> {
    let mut problem = started(start, views)?;
    let free = &mut problem.cameras[0].free_intrinsics;
    free[..2].fill(true);
    free[4] = start.distortion() != Distortion::None;
    let solution = problem.solve(&Options { huber_px: Some(2.0), max_steps: 20 })?;
    Ok(Start { rms_px: solution.rms_px, problem })
}

fn pairs(view: &[Corner]) -> Vec<Pair> {
    view.iter().map(|c| Pair { plane: c.point.truncate(), image: c.pixel }).collect()
}
