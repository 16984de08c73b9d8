//! The adjustment with as many knots as the board's motion asks for.

use super::bad;
use super::fit::Ended;
use super::spline::{ORDER, Segment, Trajectory};
use super::start::{Posed, Way};
use super::state::{Fit, FitCamera, Frame};
use crate::check::KnownCamera;
use depthrig_calib::{Camera, Error, Result};
use nalgebra::Matrix6;

/// How much worse than single images the trajectory may fit.
const MAX_MISFIT: f64 = 4.0;
/// Residuals of the trajectory that are accepted whatever single images have, pixels.
const GOOD_PX: f64 = 0.5;
/// A longer pause ends a segment of the trajectory, seconds.
const PAUSE_S: f64 = 0.5;
/// Shorter segments are left out, seconds.
const MIN_SEGMENT_S: f64 = 1.0;
/// Times between knots that are tried, seconds: 0.1 follows a hand, 0.05 a hurried one.
const KNOTS_S: [f64; 5] = [0.4, 0.2, 0.1, 0.05, 0.025];
/// The first one that is tried where there are frames enough.
const FIRST_KNOT: usize = 1;
/// Distinct moments that a knot needs.
const MOMENTS_PER_KNOT: f64 = 1.25;
/// A residual above this many standard deviations counts linearly.
const HUBER_SIGMAS: f64 = 3.0;
/// Least standard deviation of a corner's coordinate that is believed, pixels.
const MIN_NOISE_PX: f64 = 0.02;

/// Largest residual that is accepted.
pub(super) fn most_px(single_px: f64) -> f64 {
    (MAX_MISFIT * single_px).max(GOOD_PX)
}

/// The adjustment that was chosen.
pub(super) struct Chosen {
    pub fit: Fit,
    pub ended: Ended,
}

/// Fits trajectories of ever more knots, as long as that is better by the Bayesian information criterion (Schwarz, 1978).
pub(super) fn fitted(
    cameras: &[KnownCamera],
    reference: usize,
    posed: &[Posed],
    single_px: f64,
) -> Result<Chosen> {
    let noise_px = single_px.max(MIN_NOISE_PX);
    let way = Way::new(posed)?;
    let possible = KNOTS_S.iter().take_while(|k| moments_per_knot(posed, **k) >= MOMENTS_PER_KNOT).count();
    let first = FIRST_KNOT.min(possible.max(1) - 1);
    let mut best: Option<(f64, Chosen)> = None;
    for knot_s in &KNOTS_S[first..possible.max(1)] {
        let mut fit = begin(cameras, reference, posed, &way, *knot_s, noise_px)?;
        if let Some((_, before)) = &best {
            continue_from(&mut fit, &before.fit);
        }
        // Of a bad start most corners are far away; these steps bring it near.
        fit.huber_px = 10.0 * noise_px;
        fit.solve()?;
        fit.huber_px = HUBER_SIGMAS * noise_px;
        let ended = fit.solve()?;
        let n = ended.measurements as f64;
        let criterion = n * (ended.cost / n).ln() + ended.unknowns as f64 * n.ln();
        if best.as_ref().is_some_and(|(least, _)| criterion >= *least) {
            break;
        }
        best = Some((criterion, Chosen { fit, ended }));
    }
    let Some((_, chosen)) = best else { return Err(bad("no trajectory was fitted".to_owned())) };
    let sigma_px = chosen.fit.median_sigma_px(chosen.fit.frames.iter());
    if sigma_px > most_px(single_px) {
        let knot_s = chosen.fit.trajectory.knot_s;
        let is_finest = KNOTS_S.iter().position(|k| *k == knot_s) == Some(possible.max(1) - 1);
        return Err(bad(if is_finest && possible < KNOTS_S.len() {
            format!(
                "the board moves faster than the frames can follow ({sigma_px:.1} px off its smooth motion, {noise_px:.2} px in single images); record \
                 more sets a second ([sets] rate_hz = 30), or wave more slowly"
            )
        } else {
            format!(
                "no smooth motion of the board explains what the cameras see ({sigma_px:.1} px off, {noise_px:.2} px in single images); a camera does not \
                 stand where it was calibrated (`depthrig calibrate check`), or stamps jump"
            )
        }));
    }
    Ok(chosen)
}

/// Distinct moments at which some camera saw the board, for each knot.
fn moments_per_knot(posed: &[Posed], knot_s: f64) -> f64 {
    let mut last_s = f64::NEG_INFINITY;
    let mut moments = 0;
    let mut covered_s = knot_s;
    for frame in posed {
        let pause_s = frame.time_s - last_s;
        if pause_s > 0.25 * knot_s {
            moments += 1;
            covered_s += if pause_s < PAUSE_S { pause_s } else { 0.0 };
            last_s = frame.time_s;
        }
    }
    f64::from(moments) * knot_s / covered_s
}

/// The adjustment at its start.
fn begin(
    cameras: &[KnownCamera],
    reference: usize,
    posed: &[Posed],
    way: &Way,
    knot_s: f64,
    noise_px: f64,
) -> Result<Fit> {
    let mut trajectory = Trajectory { knot_s, segments: Vec::new(), controls: Vec::new() };
    let mut frames = Vec::new();
    let mut from = 0;
    for at in 1..=posed.len() {
        let ends = at == posed.len() || posed[at].time_s - posed[at - 1].time_s > PAUSE_S;
        if !ends {
            continue;
        }
        let part = &posed[from..at];
        from = at;
        let (Some(first), Some(last)) = (part.first(), part.last()) else { continue };
        let length_s = last.time_s - first.time_s;
        if length_s < MIN_SEGMENT_S {
            continue;
        }
        let spans = (length_s / knot_s).ceil().max(1.0) as usize;
        let segment = Segment {
            start_s: first.time_s - 0.5 * (spans as f64 * knot_s - length_s),
            first: trajectory.controls.len(),
            spans,
        };
        let index = trajectory.segments.len();
        let controls = (0..spans + ORDER - 1).map(|i| way.at(trajectory.control_time_s(&segment, i)));
        let controls: Vec<_> = controls.collect();
        trajectory.controls.extend(controls);
        trajectory.segments.push(segment);
        frames.extend(part.iter().map(|f| Frame {
            camera: f.camera,
            segment: index,
            time_s: f.stamp_s,
            corners: f.corners.clone(),
        }));
    }
    if frames.is_empty() {
        return Err(bad(format!(
            "the board is never seen for {MIN_SEGMENT_S} s without a pause; keep it in view while waving it"
        )));
    }
    let latency_s =
        |camera: usize| posed.iter().find(|f| f.camera == camera).map_or(0.0, |f| f.stamp_s - f.time_s);
    let is_seen = |camera: usize| frames.iter().any(|f| f.camera == camera);
    let adjusted: Result<Vec<FitCamera>> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| {
            let camera_from_rig = camera.rig_from_camera.inverse();
            let is_free = index != reference && is_seen(index);
            Ok(FitCamera {
                lens: Camera::new(&camera.intrinsics)
                    .map_err(|e| Error::new(e.kind(), format!("camera {}: {e}", camera.name)))?,
                camera_from_rig,
                calibrated: camera_from_rig,
                information: information(&camera.covariance).filter(|_| is_free),
                latency_s: latency_s(index),
                is_free,
            })
        })
        .collect();
    Ok(Fit { trajectory, cameras: adjusted?, frames, huber_px: noise_px, noise_px })
}

/// The inverse of a covariance; `None` where it is zero or not positive.
fn information(covariance: &Matrix6<f64>) -> Option<Matrix6<f64>> {
    covariance.cholesky().map(|c| c.inverse()).filter(|i| i.iter().all(|v| v.is_finite()))
}

/// Starts a trajectory of more knots where one of fewer ended.
fn continue_from(fit: &mut Fit, before: &Fit) {
    for segment in 0..fit.trajectory.segments.len() {
        let of = fit.trajectory.segments[segment];
        for i in 0..of.spans + ORDER - 1 {
            let time_s = fit.trajectory.control_time_s(&of, i);
            fit.trajectory.controls[of.first + i] = before.trajectory.sample(segment, time_s).rig_from_board;
        }
    }
    for (camera, was) in fit.cameras.iter_mut().zip(&before.cameras) {
        camera.latency_s = was.latency_s;
        camera.camera_from_rig = was.camera_from_rig;
    }
}
