//! How late each camera's frames are stamped, from a board that is waved before the mount.
//!
//! Stamps of one way, from the device to the host, are late by a constant that nothing in them shows. A board that moves does show it: the corners
//! that a camera sees are where the board was before its stamp. The board's motion is estimated as a continuous curve (a cubic B-spline of
//! poses; Furgale, Barfoot and Sibley, Continuous-Time Batch Estimation using Temporal Basis Functions, 2012) together with each
//! camera's latency, from the corners that all cameras see, whenever they see them. Intrinsics are held, poses within the covariance of
//! their calibration, so that its errors are part of the result's uncertainty.

use crate::Distance;
use crate::adjustment::Corner;
use crate::check::{KnownCamera, MIN_METRES, MIN_RADIANS, SIGNIFICANT};
use choose::{Chosen, fitted, most_px};
use depthrig_calib::{Error, ErrorKind, Result};
use start::Posed;

mod arrow;
mod choose;
mod fit;
mod so3;
mod spline;
mod start;
mod state;
mod terms;
#[cfg(test)]
mod tests;
mod total;

pub use total::{Subtracted, Total, totals};

/// An image that shows the board.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedFrame {
    /// Index of the camera.
    pub camera: usize,
    /// Its capture time, seconds since any moment that is the same for all.
    pub time_s: f64,
    /// Standard deviation of what the clock map may be off by, the constant latency apart, seconds.
    pub uncertainty_s: f64,
    /// The corners that it shows.
    pub corners: Vec<Corner>,
}

/// A camera's latency against the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraLatency {
    /// Index of the camera.
    pub camera: usize,
    /// How much later than the reference's its stamps are, seconds; 0 of the reference.
    pub latency_s: f64,
    /// One standard deviation, seconds; 0 of the reference.
    pub sigma_s: f64,
    /// Images that were used.
    pub frames: usize,
    /// Corners in them.
    pub corners: usize,
    /// Root mean square of the corners' speed in the image, pixels a second.
    pub speed_px_s: f64,
    /// Standard deviation of a corner's coordinate against the trajectory, pixels.
    pub sigma_px: f64,
    /// Distance of the camera from where it was calibrated to stand; `None` where the pose was held.
    pub displaced: Option<Displaced>,
}

/// Distance of a camera from where it was calibrated to stand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Displaced {
    /// How far.
    pub by: Distance,
    /// The square of that in standard deviations of six coordinates: 6 on average of a camera that did not move.
    pub chi_squared: f64,
}

impl CameraLatency {
    /// Whether the camera stands elsewhere than the calibration says, by the limits of [`crate::check`].
    pub fn has_moved(&self) -> bool {
        self.displaced.is_some_and(|d| {
            d.chi_squared > SIGNIFICANT && (d.by.metres > MIN_METRES || d.by.radians > MIN_RADIANS)
        })
    }
}

/// A camera whose latency was not found.
#[derive(Debug, Clone, PartialEq)]
pub struct Refused {
    /// Index of the camera.
    pub camera: usize,
    /// Why, and what to do.
    pub why: String,
}

/// Latencies of the cameras of a mount.
#[derive(Debug, Clone, PartialEq)]
pub struct Latencies {
    /// The cameras, in their order, the reference among them.
    pub found: Vec<CameraLatency>,
    /// Cameras without a result.
    pub refused: Vec<Refused>,
    /// Time between the knots of the trajectory, seconds.
    pub knot_s: f64,
    /// Time that the trajectory covers, seconds.
    pub covered_s: f64,
    /// Standard deviation of a corner's coordinate against the trajectory, pixels.
    pub sigma_px: f64,
    /// The same in single images, each with its own pose: what the trajectory could reach at best.
    pub single_px: f64,
}

/// Images that a camera needs.
const MIN_FRAMES: usize = 20;
/// A latency less certain than this is refused, seconds (one standard deviation).
const MAX_SIGMA_S: f64 = 0.3e-3;
/// Corners less certain than this in single images are blurred, pixels.
const MAX_SINGLE_PX: f64 = 1.0;

/// Estimates the latency of each camera against that of `reference`.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the reference saw too little, no other camera can be compared with it, corners are blurred, or the motion is too fast for the
/// frames; the message says what to do.
pub fn estimate(cameras: &[KnownCamera], reference: usize, frames: &[TimedFrame]) -> Result<Latencies> {
    if reference >= cameras.len() || frames.iter().any(|f| f.camera >= cameras.len()) {
        return Err(bad(format!("there are {} cameras", cameras.len())));
    }
    // Times near zero keep all their digits.
    let since_s = frames.iter().map(|f| f.time_s).fold(f64::INFINITY, f64::min);
    let mut posed: Vec<Posed> = frames
        .iter()
        .filter_map(|f| {
            start::pose(&cameras[f.camera], &TimedFrame { time_s: f.time_s - since_s, ..f.clone() })
        })
        .collect();
    let mut refused = Vec::new();
    let seen: Vec<usize> =
        (0..cameras.len()).map(|c| posed.iter().filter(|f| f.camera == c).count()).collect();
    let few = |camera: usize| {
        format!(
            "{} of its images show the board well enough, {MIN_FRAMES} are needed; wave the board where this camera sees it, more slowly if its images \
             are blurred",
            seen[camera]
        )
    };
    if seen[reference] < MIN_FRAMES {
        return Err(bad(format!("reference camera {}: {}", cameras[reference].name, few(reference))));
    }
    for camera in (0..cameras.len()).filter(|c| seen[*c] < MIN_FRAMES) {
        refused.push(Refused { camera, why: few(camera) });
    }
    posed.retain(|f| seen[f.camera] >= MIN_FRAMES);
    let single_px = median(posed.iter().map(|f| f.noise_px));
    if single_px > MAX_SINGLE_PX {
        return Err(bad(format!(
            "corners are off by {single_px:.1} px in single images; if they are blurred, wave the board more slowly or expose for less time, else the \
             intrinsics or the board's description are wrong (`depthrig calibrate solve`)"
        )));
    }
    let aligned = start::align(&mut posed, cameras.len(), reference, MIN_FRAMES);
    let apart = (0..cameras.len()).filter(|c| seen[*c] >= MIN_FRAMES && !aligned[*c]);
    refused.extend(apart.map(|camera| Refused {
        camera,
        why: format!(
            "shares no moment with {}, nor with a camera that does; wave the board where both see it at once",
            cameras[reference].name
        ),
    }));
    posed.retain(|f| aligned[f.camera]);
    posed.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    if posed.iter().all(|f| f.camera == reference) {
        return Err(none(cameras, &refused));
    }
    let best = fitted(cameras, reference, &posed, single_px)?;
    let result = results(cameras, frames, &best)?;
    let mut found = Vec::new();
    for latency in result {
        match misfit(&latency, single_px).or_else(|| imprecise(&latency)) {
            Some(why) if latency.camera != reference => refused.push(Refused { camera: latency.camera, why }),
            _ => found.push(latency),
        }
    }
    if found.len() < 2 {
        return Err(none(cameras, &refused));
    }
    refused.sort_by_key(|r| r.camera);
    let knot_s = best.fit.trajectory.knot_s;
    let spans: usize = best.fit.trajectory.segments.iter().map(|s| s.spans).sum();
    Ok(Latencies {
        found,
        refused,
        knot_s,
        covered_s: spans as f64 * knot_s,
        sigma_px: best.fit.median_sigma_px(best.fit.frames.iter()),
        single_px,
    })
}

/// Results of each camera that took part.
fn results(cameras: &[KnownCamera], frames: &[TimedFrame], chosen: &Chosen) -> Result<Vec<CameraLatency>> {
    let Chosen { fit, ended } = chosen;
    let precision = fit.precision(ended)?;
    let clock_s: Vec<f64> = (0..cameras.len())
        .map(|c| median(frames.iter().filter(|f| f.camera == c).map(|f| f.uncertainty_s)))
        .collect();
    let reference = fit.cameras.iter().position(|c| !c.is_free).unwrap_or(0);
    let found = (0..cameras.len()).filter_map(|camera| {
        let own = || fit.frames.iter().filter(move |f| f.camera == camera);
        let frames = own().count();
        if frames == 0 {
            return None;
        }
        let state = &fit.cameras[camera];
        let motion = state.motion();
        let sigma_s = precision[camera].sigma_s.hypot(clock_s[camera]).hypot(clock_s[reference]);
        Some(CameraLatency {
            camera,
            latency_s: state.latency_s,
            sigma_s: if state.is_free { sigma_s } else { 0.0 },
            frames,
            corners: own().map(|f| f.corners.len()).sum(),
            speed_px_s: precision[camera].speed_px_s,
            sigma_px: fit.median_sigma_px(own()),
            displaced: state.information.map(|information| Displaced {
                by: state.camera_from_rig.inverse().distance(&state.calibrated.inverse()),
                chi_squared: motion.dot(&(information * motion)),
            }),
        })
    });
    Ok(found.collect())
}

/// Why a camera does not fit the motion that the others saw.
fn misfit(latency: &CameraLatency, single_px: f64) -> Option<String> {
    (latency.sigma_px > most_px(single_px)).then(|| {
        format!(
            "it sees the board {:.1} px off the motion that the others see; it does not stand where it was calibrated (`depthrig calibrate check`), or \
             its stamps jump",
            latency.sigma_px
        )
    })
}

/// Why a latency is not certain enough.
fn imprecise(latency: &CameraLatency) -> Option<String> {
    let is_certain = latency.sigma_s <= MAX_SIGMA_S;
    (!is_certain).then(|| {
        format!(
            "its latency is known to ± {:.1} ms only: in its {} images the board moves by {:.0} px a second; wave it faster, to and fro in all \
             directions, and for longer",
            latency.sigma_s * 1e3,
            latency.frames,
            latency.speed_px_s
        )
    })
}

/// No camera can be compared.
fn none(cameras: &[KnownCamera], refused: &[Refused]) -> Error {
    let why: Vec<String> =
        refused.iter().map(|r| format!("camera {}: {}", cameras[r.camera].name, r.why)).collect();
    bad(if why.is_empty() { "only the reference camera saw the board".to_owned() } else { why.join("\n") })
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

fn bad(message: String) -> Error {
    Error::new(ErrorKind::BadInput, message)
}
