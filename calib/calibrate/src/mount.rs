//! The whole calibration of a mount: intrinsics, poses, and what they are worth.

use crate::adjustment::{AdjustedCamera, Corner, INTRINSIC_PARAMETERS};
use crate::difference::{ProjectionDifference, projection_difference};
use crate::intrinsics::{self, ImageSize, IntrinsicsOptions, MIN_VIEWS};
use crate::rig::{RigCamera, RigOptions, RigResult, RigView, Seen, calibrate_rig};
use crate::uncertainty::{Sample, projection_sigma};
use crate::{Distance, Rigid, board_pose};
use depthrig_bus::{Distortion, Intrinsics};
use depthrig_calib::{Error, ErrorKind, Result};
use glam::DVec2;
use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

mod advice;
mod coverage;
#[cfg(test)]
mod tests;

pub(crate) use advice::{FEW_SHARED, FEW_VIEWS};
pub use coverage::Coverage;
pub(crate) use coverage::NAMES;

/// A camera to calibrate.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInput {
    /// Its name.
    pub name: String,
    /// Size of its images.
    pub size: ImageSize,
    /// The intrinsics that it was delivered with, if known.
    pub factory: Option<Intrinsics>,
    /// The distortion model to calibrate; with `factory` its model.
    pub model: Distortion,
}

/// Settings of [`calibrate_mount`].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MountOptions {
    /// Estimate how far the printed board is from flat.
    pub board_warp: bool,
    /// Keep the factory's intrinsics even where others are better.
    pub keep_factory: bool,
}

/// Origin of a camera's intrinsics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// Calibrated from these views.
    Calibrated,
    /// Delivered with the camera, and better on views that the calibration was not fitted to.
    Factory,
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraResult {
    /// Its name.
    pub name: String,
    /// Size of its images.
    pub size: ImageSize,
    /// Its intrinsics.
    pub intrinsics: Intrinsics,
    /// Standard deviations as in [`INTRINSIC_PARAMETERS`]; 0 for parameters that were not estimated.
    pub sigmas: [f64; INTRINSIC_PARAMETERS],
    /// Where they come from.
    pub source: Source,
    /// Residual of views that intrinsics were not fitted to, pixels: of the calibration, if there is one.
    pub held_out_px: Option<f64>,
    /// The same of the factory's intrinsics, if known.
    pub factory_px: Option<f64>,
    /// Its pose on the mount: from its optical frame to the rig's coordinates.
    pub rig_from_camera: Rigid,
    /// Standard deviation of its place, metres, and of its direction, radians: the root of the sum over three axes.
    pub pose_sigma: Distance,
    /// Its whole covariance, as [`crate::adjustment::Covariance::pose`] has it.
    pub pose_covariance: Matrix6<f64>,
    /// Views that show the board.
    pub views: usize,
    /// Corners that were used.
    pub corners: usize,
    /// Corners that were left out.
    pub outliers: usize,
    /// Root mean square of the residuals' lengths, pixels.
    pub rms_px: f64,
    /// Where in the image corners were seen.
    pub coverage: Coverage,
    /// Uncertainty of projection over the image.
    pub uncertainty: UncertaintyMap,
    /// The calibration of one half of the views against that of the other.
    pub cross_validation: Option<CrossValidation>,
}

/// Uncertainty of projection at places of a grid, the corners of the image among them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UncertaintyMap {
    /// Distance of the points that are projected: the median of the boards'.
    pub distance_m: f64,
    /// Places along x.
    pub columns: usize,
    /// Standard deviation in the worst direction, pixels, row by row; NaN where the lens shows nothing.
    pub sigma_px: Vec<f64>,
}

impl UncertaintyMap {
    /// In the middle of the image.
    pub fn middle_px(&self) -> f64 {
        let rows = self.sigma_px.len() / self.columns.max(1);
        self.sigma_px.get(rows / 2 * self.columns + self.columns / 2).copied().unwrap_or(f64::NAN)
    }

    /// The largest.
    pub fn worst_px(&self) -> f64 {
        self.sigma_px.iter().copied().filter(|s| s.is_finite()).fold(0.0, f64::max)
    }
}

/// How far two calibrations from different views are apart.
#[derive(Debug, Clone, PartialEq)]
pub struct CrossValidation {
    /// In projection; `None` if the intrinsics were not estimated.
    pub projection: Option<ProjectionDifference>,
    /// In pose; `None` for the reference camera.
    pub pose: Option<Distance>,
}

/// A view, and what each camera made of it.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewResult {
    /// Its name.
    pub name: String,
    /// Index of a camera, its residual (root mean square, pixels) and corners left out.
    pub seen: Vec<ViewResidual>,
    /// The board's pose.
    pub rig_from_board: Rigid,
}

/// Fit of one camera to a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewResidual {
    /// Index of the camera.
    pub camera: usize,
    /// Root mean square of the residuals' lengths, pixels.
    pub rms_px: f64,
    /// Corners that were used.
    pub corners: usize,
    /// Corners that were left out.
    pub outliers: usize,
}

/// The calibrated mount.
#[derive(Debug, Clone, PartialEq)]
pub struct MountResult {
    /// The cameras; the first one is the reference, whose optical frame is the rig's.
    pub cameras: Vec<CameraResult>,
    /// The views.
    pub views: Vec<ViewResult>,
    /// How far the board is from flat, if that was estimated.
    pub warp: Option<crate::adjustment::Warp>,
    /// Root mean square of all residuals' lengths, pixels.
    pub rms_px: f64,
    /// Standard deviation of one coordinate of a corner, pixels.
    pub sigma_px: f64,
    /// Doubts, and advice for the next time.
    pub advice: Vec<String>,
}

/// Calibrates intrinsics of each camera and the poses of all.
///
/// # Errors
/// [`ErrorKind::BadInput`] naming the camera: too few views, views that do not determine its intrinsics, or cameras that no view joins.
pub fn calibrate_mount(
    cameras: &[CameraInput],
    views: &[RigView],
    options: MountOptions,
) -> Result<MountResult> {
    let chosen: Result<Vec<Chosen>> =
        cameras.iter().enumerate().map(|(i, camera)| choose(i, camera, views, options)).collect();
    let chosen = chosen?;
    let found = adjust(cameras, &chosen, views, options)?;
    let halves = halves(cameras, &chosen, views, options);
    let mut results = Vec::with_capacity(cameras.len());
    for (i, camera) in cameras.iter().enumerate() {
        results.push(camera_result(i, camera, &chosen[i], views, &found, halves.as_ref())?);
    }
    let mut result = MountResult {
        views: view_results(views, &found),
        warp: options.board_warp.then_some(found.warp),
        rms_px: found.fit.solution.rms_px,
        sigma_px: found.fit.solution.sigma_px,
        cameras: results,
        advice: Vec::new(),
    };
    result.advice = advice::advice(&result);
    Ok(result)
}

/// The residuals of new intrinsics must be less than this share of the factory's to replace them: with some thousand corners chance makes
/// differences of a percent, and the factory looked at the whole image.
const CLEARLY_LESS: f64 = 0.97;

/// Intrinsics to go on with.
struct Chosen {
    intrinsics: Intrinsics,
    free: [bool; INTRINSIC_PARAMETERS],
    source: Source,
    held_out_px: Option<f64>,
    factory_px: Option<f64>,
}

fn corners_of(camera: usize, views: &[RigView]) -> Vec<Vec<Corner>> {
    views.iter().flat_map(|v| &v.seen).filter(|s| s.camera == camera).map(|s| s.corners.clone()).collect()
}

fn choose(index: usize, camera: &CameraInput, views: &[RigView], options: MountOptions) -> Result<Chosen> {
    let of_camera = corners_of(index, views);
    let named = |e: Error| Error::new(e.kind(), format!("camera {}: {e}", camera.name));
    let factory_px = camera.factory.as_ref().and_then(|f| intrinsics::residual_rms(f, &of_camera).ok());
    let keep = |factory: Intrinsics, held_out_px| Chosen {
        intrinsics: factory,
        free: [false; INTRINSIC_PARAMETERS],
        source: Source::Factory,
        held_out_px,
        factory_px,
    };
    if let Some(factory) = camera.factory
        && (options.keep_factory || of_camera.len() < MIN_VIEWS)
    {
        return Ok(keep(factory, None));
    }
    let model = camera.factory.map_or(camera.model, |f| f.distortion());
    let settings = IntrinsicsOptions { model, ..IntrinsicsOptions::default() };
    let found = match intrinsics::calibrate(camera.size, &of_camera, &settings) {
        Ok(found) => found,
        // Views that are too alike for intrinsics may do for a pose.
        Err(e) => return camera.factory.map(|f| keep(f, None)).ok_or_else(|| named(e)),
    };
    let free = found.camera.free_intrinsics;
    let again = IntrinsicsOptions { free: Some(free), start: Some(found.camera.intrinsics), ..settings };
    let held_out_px = intrinsics::held_out_rms(camera.size, &of_camera, &again).ok();
    if let (Some(factory), Some(theirs), Some(ours)) = (camera.factory, factory_px, held_out_px)
        && theirs * CLEARLY_LESS <= ours
    {
        return Ok(keep(factory, Some(ours)));
    }
    Ok(Chosen {
        intrinsics: found.camera.intrinsics,
        free,
        source: Source::Calibrated,
        held_out_px,
        factory_px,
    })
}

fn adjust(
    cameras: &[CameraInput],
    chosen: &[Chosen],
    views: &[RigView],
    options: MountOptions,
) -> Result<RigResult> {
    let cameras: Vec<RigCamera> = cameras
        .iter()
        .zip(chosen)
        .map(|(camera, chosen)| RigCamera {
            name: camera.name.clone(),
            intrinsics: chosen.intrinsics,
            free_intrinsics: chosen.free,
        })
        .collect();
    calibrate_rig(&cameras, views, &RigOptions { free_warp: options.board_warp, reject_outliers: true })
}

/// Calibrations of the even views and of the odd ones.
struct Halves {
    even: RigResult,
    odd: RigResult,
}

fn halves(
    cameras: &[CameraInput],
    chosen: &[Chosen],
    views: &[RigView],
    options: MountOptions,
) -> Option<Halves> {
    // Every other view of each set of cameras: views of one camera must not all fall into one half.
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by_key(|i| views[*i].seen.iter().map(|s| s.camera).collect::<Vec<_>>());
    let half = |parity: usize| {
        let of: Vec<RigView> = order.iter().skip(parity).step_by(2).map(|i| views[*i].clone()).collect();
        adjust(cameras, chosen, &of, options).ok()
    };
    Some(Halves { even: half(0)?, odd: half(1)? })
}

/// Places of the map of uncertainty along x and y.
const MAP_COLUMNS: usize = 20;
const MAP_ROWS: usize = 15;

fn camera_result(
    index: usize,
    camera: &CameraInput,
    chosen: &Chosen,
    views: &[RigView],
    found: &RigResult,
    halves: Option<&Halves>,
) -> Result<CameraResult> {
    let adjusted = &found.cameras[index];
    let covariance = &found.fit.solution.covariance;
    let own: Vec<usize> = sightings_of(index, found).collect();
    let in_views: Vec<usize> = own.iter().map(|s| found.sightings[*s].view).collect();
    let mut distances: Vec<f64> = own
        .iter()
        .map(|s| {
            let sighting = &found.sightings[*s];
            let pose = adjusted.camera_from_rig.after(&found.rig_from_board[sighting.view]);
            let n = sighting.corners.len().max(1) as f64;
            sighting.corners.iter().map(|c| pose.transform(c.point).length()).sum::<f64>() / n
        })
        .collect();
    distances.sort_by(f64::total_cmp);
    let distance_m = distances.get(distances.len() / 2).copied().unwrap_or(1.0);
    let mut sigma_px = Vec::with_capacity(MAP_COLUMNS * MAP_ROWS);
    for row in 0..MAP_ROWS {
        for column in 0..MAP_COLUMNS {
            let place = |i: usize, n: usize, side: u32| i as f64 / (n - 1) as f64 * (f64::from(side) - 1.0);
            let pixel = DVec2::new(
                place(column, MAP_COLUMNS, camera.size.width),
                place(row, MAP_ROWS, camera.size.height),
            );
            let at = Sample { pixel, distance_m };
            let sigma = projection_sigma(adjusted, index, &found.rig_from_board, &in_views, covariance, at)?;
            sigma_px.push(sigma.unwrap_or(f64::NAN));
        }
    }
    let residuals = own.iter().flat_map(|s| &found.fit.solution.residuals[*s]);
    let squares: f64 = residuals.map(|r| r.length_squared()).sum();
    let corners: usize = own.iter().map(|s| found.sightings[*s].corners.len()).sum();
    let pose = covariance.pose(index);
    let root = |from: usize| (from..from + 3).map(|i| pose[(i, i)]).sum::<f64>().sqrt();
    let seen = corners_of(index, views);
    Ok(CameraResult {
        name: camera.name.clone(),
        size: camera.size,
        intrinsics: adjusted.intrinsics,
        sigmas: covariance.intrinsic_sigmas(index, &adjusted.free_intrinsics),
        source: chosen.source,
        held_out_px: chosen.held_out_px,
        factory_px: chosen.factory_px,
        rig_from_camera: adjusted.camera_from_rig.inverse(),
        pose_sigma: Distance { metres: root(3), radians: root(0) },
        pose_covariance: pose,
        views: own.len(),
        corners,
        outliers: found.fit.outliers.iter().filter(|o| own.contains(&o.sighting)).count(),
        rms_px: (squares / corners.max(1) as f64).sqrt(),
        coverage: Coverage::new(camera.size, seen.iter().flatten().map(|c| c.pixel)),
        uncertainty: UncertaintyMap { distance_m, columns: MAP_COLUMNS, sigma_px },
        cross_validation: halves.map(|h| cross_validation(index, camera.size, adjusted, h)).transpose()?,
    })
}

fn cross_validation(
    index: usize,
    size: ImageSize,
    adjusted: &AdjustedCamera,
    halves: &Halves,
) -> Result<CrossValidation> {
    let even = &halves.even.cameras[index];
    let odd = &halves.odd.cameras[index];
    let estimated = adjusted.free_intrinsics.contains(&true);
    Ok(CrossValidation {
        projection: estimated
            .then(|| projection_difference(&even.intrinsics, &odd.intrinsics, size))
            .transpose()?,
        pose: (index > 0).then(|| even.camera_from_rig.inverse().distance(&odd.camera_from_rig.inverse())),
    })
}

fn sightings_of(camera: usize, found: &RigResult) -> impl Iterator<Item = usize> {
    found.sightings.iter().enumerate().filter(move |(_, s)| s.camera == camera).map(|(i, _)| i)
}

fn view_results(views: &[RigView], found: &RigResult) -> Vec<ViewResult> {
    views
        .iter()
        .enumerate()
        .map(|(view, of)| ViewResult {
            name: of.name.clone(),
            rig_from_board: found.rig_from_board[view],
            seen: (found.sightings.iter().enumerate())
                .filter(|(_, s)| s.view == view)
                .map(|(i, s)| {
                    let residuals = &found.fit.solution.residuals[i];
                    let squares: f64 = residuals.iter().map(|r| r.length_squared()).sum();
                    ViewResidual {
                        camera: s.camera,
                        rms_px: (squares / residuals.len().max(1) as f64).sqrt(),
                        corners: residuals.len(),
                        outliers: found.fit.outliers.iter().filter(|o| o.sighting == i).count(),
                    }
                })
                .collect(),
        })
        .collect()
}

/// A view that is refused, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct Refused {
    /// Name of the view.
    pub view: String,
    /// Index of the camera.
    pub camera: usize,
    /// The reason.
    pub why: String,
}

/// Corners below which a sighting is not used.
pub const MIN_CORNERS: usize = 6;

/// Leaves out what no adjustment can use: too few corners, corners on one line, a board seen from behind.
///
/// # Errors
/// [`ErrorKind::BadInput`] if nothing is left.
pub fn usable(cameras: &[CameraInput], views: Vec<RigView>) -> Result<Usable> {
    let mut refused = Vec::new();
    let mut kept = Vec::with_capacity(views.len());
    for view in views {
        let mut seen = Vec::with_capacity(view.seen.len());
        for sighting in view.seen {
            match doubt(&cameras[sighting.camera], &sighting) {
                Some(why) => refused.push(Refused { view: view.name.clone(), camera: sighting.camera, why }),
                None => seen.push(sighting),
            }
        }
        if !seen.is_empty() {
            kept.push(RigView { name: view.name, seen });
        }
    }
    if kept.is_empty() {
        return Err(Error::new(
            ErrorKind::BadInput,
            "no view shows the board; check that board.toml describes the board in the images",
        ));
    }
    Ok(Usable { views: kept, refused })
}

/// Result of [`usable`].
#[derive(Debug, Clone, PartialEq)]
pub struct Usable {
    /// Views to calibrate from.
    pub views: Vec<RigView>,
    /// Sightings that were left out.
    pub refused: Vec<Refused>,
}

fn doubt(camera: &CameraInput, seen: &Seen) -> Option<String> {
    if seen.corners.len() < MIN_CORNERS {
        return Some(format!("only {} corners are seen, {MIN_CORNERS} are needed", seen.corners.len()));
    }
    let width = f64::from(camera.size.width);
    let guess = camera.factory.unwrap_or_else(|| {
        Intrinsics::pinhole(0.9 * width, 0.9 * width, 0.5 * width, 0.5 * f64::from(camera.size.height))
    });
    board_pose(&guess, &seen.corners).err().map(|e| e.to_string())
}
