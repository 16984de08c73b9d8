//! Depth frames of one place against the board's plane.

use crate::Rigid;
use crate::intrinsics::ImageSize;
use core::ops::Range;
use depthrig_bus::Intrinsics;
use depthrig_calib::{Camera, Error, ErrorKind, Result};
use glam::{DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};

/// Margin inside the outermost corners, of their extent: depth at the edge of anything mixes two surfaces.
const MARGIN: f64 = 0.05;
/// Pixels of the board below which nothing can be said.
const MIN_PIXELS: usize = 100;
/// Share of the largest and of the smallest residuals of a plane that are left out (RealSense Depth Quality Tool: 0.5 %).
const TRIM: f64 = 0.005;
/// Pixels whose depth has one error in common: the window of a stereo matcher, 8 by 8.
const WINDOW_PIXELS: f64 = 64.0;
/// From the median absolute deviation to the standard deviation of a normal distribution.
const MAD_TO_SIGMA: f64 = 1.482_602_218_505_602;

/// A pixel on the board.
#[derive(Debug, Clone, Copy)]
struct Cell {
    index: usize,
    /// x and y of its ray on the plane z = 1.
    ray: DVec2,
    /// Depth of the board's plane there, metres.
    truth_m: f64,
}

/// Compares depth frames with the board's plane.
#[derive(Debug, Clone)]
pub struct PlaneMeter {
    pixels: usize,
    cells: Vec<Cell>,
    tilt_deg: f64,
    errors: Vec<f64>,
    frames: usize,
    filled: usize,
    /// Of each cell: number of depths, their sum and the sum of their squares, as errors.
    over_time: Vec<[f64; 3]>,
    plane_squares: f64,
    inverse_squares: f64,
    planes: usize,
}

/// Depth of one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Mean depth of the board's plane, metres.
    pub truth_m: f64,
    /// Median of sensed depth minus the plane's, metres.
    pub error_m: f64,
    /// Standard deviation of that from the noise of depth alone, metres.
    pub noise_sigma_m: f64,
    /// Root mean square of the distance along the optical axis from the plane that fits the frame itself, metres.
    pub plane_rms_m: f64,
    /// The same of the inverse depth, 1/m; times focal length (pixels) and baseline (m) it is the sub-pixel RMS.
    pub inverse_rms_per_m: f64,
    /// Standard deviation of a pixel from frame to frame, metres; `None` for fewer than two frames.
    pub temporal_m: Option<f64>,
    /// Share of the board's pixels that have depth.
    pub fill: f64,
    /// Angle between the board's normal and the optical axis, degrees.
    pub tilt_deg: f64,
    /// Pixels of the board.
    pub pixels: usize,
    /// Frames.
    pub frames: usize,
}

impl Measured {
    /// Independent errors in it, for the choice of a model.
    pub fn windows(&self) -> f64 {
        windows(self.pixels as f64 * self.fill)
    }
}

fn windows(pixels: f64) -> f64 {
    (pixels / WINDOW_PIXELS).max(1.0)
}

impl PlaneMeter {
    /// A meter of frames of `size` (width and height) with these intrinsics, of the board at `depth_from_board`; only the
    /// rectangle around `points` (on the board, metres) is measured, without its edge.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for intrinsics that nothing can be computed with, and when the camera sees too little of the board.
    pub fn new(
        intrinsics: &Intrinsics,
        size: ImageSize,
        depth_from_board: &Rigid,
        points: &[DVec3],
    ) -> Result<Self> {
        let camera = Camera::new(intrinsics)?;
        let lowest = points.iter().fold(DVec2::INFINITY, |a, p| a.min(p.truncate()));
        let highest = points.iter().fold(DVec2::NEG_INFINITY, |a, p| a.max(p.truncate()));
        let margin = (highest - lowest) * MARGIN;
        let lowest = lowest + margin;
        let highest = highest - margin;
        let normal = depth_from_board.rotation * DVec3::Z;
        let distance = normal.dot(depth_from_board.translation);
        let board_from_depth = depth_from_board.inverse();
        let corners = [lowest, DVec2::new(lowest.x, highest.y), highest, DVec2::new(highest.x, lowest.y)];
        let near = near(&camera, depth_from_board, corners, size);
        let mut cells = Vec::new();
        for y in near.rows {
            for x in near.columns.clone() {
                let Some(ray) = camera.unproject(DVec2::new(f64::from(x), f64::from(y))) else { continue };
                let truth_m = distance / normal.dot(ray);
                let at = board_from_depth.transform(ray * truth_m).truncate();
                if truth_m > 0.0 && at.cmpge(lowest).all() && at.cmple(highest).all() {
                    let index = y as usize * size.width as usize + x as usize;
                    cells.push(Cell { index, ray: ray.truncate(), truth_m });
                }
            }
        }
        if cells.len() < MIN_PIXELS {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "the depth image sees {} pixels of the board, {MIN_PIXELS} are needed; hold the board nearer and where depth sees it, too",
                    cells.len()
                ),
            ));
        }
        Ok(Self {
            pixels: size.width as usize * size.height as usize,
            over_time: vec![[0.0; 3]; cells.len()],
            cells,
            tilt_deg: normal.z.abs().min(1.0).acos().to_degrees(),
            errors: Vec::new(),
            frames: 0,
            filled: 0,
            plane_squares: 0.0,
            inverse_squares: 0.0,
            planes: 0,
        })
    }

    /// Compares a frame, metres row by row, 0 or NaN for no depth.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a frame of another size.
    pub fn add(&mut self, depth_m: &[f32]) -> Result<()> {
        if depth_m.len() != self.pixels {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!("a depth frame of {} pixels, {} are expected", depth_m.len(), self.pixels),
            ));
        }
        self.frames += 1;
        let mut sensed: Vec<(DVec2, f64)> = Vec::with_capacity(self.cells.len());
        for (cell, over_time) in self.cells.iter().zip(&mut self.over_time) {
            let z = f64::from(depth_m[cell.index]);
            if !(z > 0.0 && z.is_finite()) {
                continue;
            }
            let error = z - cell.truth_m;
            self.errors.push(error);
            over_time[0] += 1.0;
            over_time[1] += error;
            over_time[2] += error * error;
            sensed.push((cell.ray, z));
        }
        self.filled += sensed.len();
        if let Some(fit) = flatness(&sensed) {
            self.plane_squares += fit.depth_square;
            self.inverse_squares += fit.inverse_square;
            self.planes += 1;
        }
        Ok(())
    }

    /// The result.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when no frame has depth on the board.
    pub fn finish(mut self) -> Result<Measured> {
        let Some(error_m) = median(&mut self.errors) else {
            return Err(Error::new(ErrorKind::BadInput, "no pixel of the board has depth"));
        };
        let mut deviations: Vec<f64> = self.errors.iter().map(|e| (e - error_m).abs()).collect();
        let spread_m = median(&mut deviations).unwrap_or(0.0) * MAD_TO_SIGMA;
        let looked = self.cells.len() * self.frames;
        let fill = self.filled as f64 / looked.max(1) as f64;
        let truth_m = self.cells.iter().map(|c| c.truth_m).sum::<f64>() / self.cells.len() as f64;
        let planes = self.planes.max(1) as f64;
        Ok(Measured {
            truth_m,
            error_m,
            // The standard deviation of a median is √(π/2) times that of a mean. Errors that stay from frame to frame are not
            // averaged by more frames.
            noise_sigma_m: core::f64::consts::FRAC_PI_2.sqrt() * spread_m
                / windows(self.cells.len() as f64 * fill).sqrt(),
            plane_rms_m: (self.plane_squares / planes).sqrt(),
            inverse_rms_per_m: (self.inverse_squares / planes).sqrt(),
            temporal_m: temporal(&self.over_time),
            fill,
            tilt_deg: self.tilt_deg,
            pixels: self.cells.len(),
            frames: self.frames,
        })
    }
}

/// Part of the image.
struct Part {
    columns: Range<u32>,
    rows: Range<u32>,
}

/// The part that the board may be in.
fn near(camera: &Camera, depth_from_board: &Rigid, corners: [DVec2; 4], size: ImageSize) -> Part {
    let seen: Option<Vec<DVec2>> =
        corners.iter().map(|c| camera.project(depth_from_board.transform(c.extend(0.0)))).collect();
    let Some(seen) = seen else { return Part { columns: 0..size.width, rows: 0..size.height } };
    let lowest = seen.iter().fold(DVec2::INFINITY, |a, p| a.min(*p));
    let highest = seen.iter().fold(DVec2::NEG_INFINITY, |a, p| a.max(*p));
    // A lens bends the board's edges, by less than half of its extent.
    let slack = (highest - lowest) * 0.5 + 4.0;
    let end = DVec2::new(f64::from(size.width), f64::from(size.height));
    let from = (lowest - slack).clamp(DVec2::ZERO, end);
    let to = (highest + slack).clamp(DVec2::ZERO, end);
    Part { columns: from.x as u32..to.x as u32, rows: from.y as u32..to.y as u32 }
}

/// Mean squares of a frame's residuals from its own plane.
struct Flatness {
    depth_square: f64,
    inverse_square: f64,
}

/// Fits a plane to rays and depths. The inverse depth of a plane is linear in the ray's x and y, and a stereo camera's noise is
/// the same everywhere in inverse depth.
fn flatness(sensed: &[(DVec2, f64)]) -> Option<Flatness> {
    let mut kept: Vec<(DVec2, f64)> = sensed.to_vec();
    let mut plane = inverse_plane(&kept)?;
    let residual = |plane: &Vector3<f64>, (ray, z): &(DVec2, f64)| {
        1.0 / z - (plane.x * ray.x + plane.y * ray.y + plane.z)
    };
    for _ in 0..2 {
        kept = sensed.to_vec();
        let trim = (kept.len() as f64 * TRIM) as usize;
        if trim > 0 {
            let end = kept.len() - trim;
            let by_residual =
                |a: &(DVec2, f64), b: &(DVec2, f64)| residual(&plane, a).total_cmp(&residual(&plane, b));
            kept.select_nth_unstable_by(end, by_residual);
            kept.truncate(end);
            kept.select_nth_unstable_by(trim, by_residual);
            kept.drain(..trim);
        }
        plane = inverse_plane(&kept)?;
    }
    let mut depth_square = 0.0;
    let mut inverse_square = 0.0;
    for at in &kept {
        let inverse = residual(&plane, at);
        let z_plane = 1.0 / (1.0 / at.1 - inverse);
        inverse_square += inverse * inverse;
        depth_square += (at.1 - z_plane).powi(2);
    }
    let count = kept.len() as f64;
    Some(Flatness { depth_square: depth_square / count, inverse_square: inverse_square / count })
}

fn inverse_plane(sensed: &[(DVec2, f64)]) -> Option<Vector3<f64>> {
    if sensed.len() < MIN_PIXELS / 2 {
        return None;
    }
    let mut normal = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (ray, z) in sensed {
        let row = Vector3::new(ray.x, ray.y, 1.0);
        normal += row * row.transpose();
        right += row / *z;
    }
    normal.cholesky().map(|c| c.solve(&right))
}

/// Root of the mean variance of the pixels.
fn temporal(over_time: &[[f64; 3]]) -> Option<f64> {
    let mut squares = 0.0;
    let mut free = 0.0;
    for [count, sum, square] in over_time {
        if *count > 1.0 {
            squares += (square - sum * sum / count).max(0.0);
            free += count - 1.0;
        }
    }
    (free > 0.0).then(|| (squares / free).sqrt())
}

/// The median; reorders `values`.
pub(super) fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    let (below, at, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    let at = *at;
    if below.len() == middle && values.len() % 2 == 1 {
        return Some(at);
    }
    let before = values[..middle].iter().copied().fold(f64::NEG_INFINITY, f64::max);
    Some(f64::midpoint(before, at))
}
