//! Where the adjustment starts: the board's pose in each image, and latencies by comparing the ways of the board that two cameras saw.

use super::state::RAYLEIGH_MEDIAN;
use super::{TimedFrame, bad};
use crate::adjustment::Corner;
use crate::check::KnownCamera;
use crate::{BoardPose, Rigid, board_pose};
use depthrig_calib::{Camera, Result};
use glam::{DQuat, DVec3};

/// Corners that an image needs.
const MIN_CORNERS: usize = 8;
/// A corner further from its place in its own image than this many standard deviations is not where it was said to be.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Least standard deviation that outliers are measured by, pixels.
const MIN_NOISE_PX: f64 = 0.05;
/// Latencies are looked for within this time before and after the reference, in these steps, seconds.
const SEARCHED_S: f64 = 0.3;
const SEARCH_STEP_S: f64 = 0.01;
/// Moments between two poses further apart than this are not compared, seconds.
const COMPARED_S: f64 = 0.3;
/// A larger distance counts no more, metres.
const FAR_M: f64 = 0.1;

/// An image with the board's pose.
#[derive(Debug, Clone)]
pub(super) struct Posed {
    pub camera: usize,
    /// Its stamp less the latency found so far, seconds.
    pub time_s: f64,
    pub stamp_s: f64,
    pub corners: Vec<Corner>,
    pub rig_from_board: Rigid,
    /// Standard deviation of a corner's coordinate in this image alone, pixels.
    pub noise_px: f64,
    /// Whether this image alone says which way the board is tilted.
    pub is_decided: bool,
}

/// Estimates the pose of the board in an image and leaves out corners that do not fit it; `None` where that fails.
pub(super) fn pose(camera: &KnownCamera, frame: &TimedFrame) -> Option<Posed> {
    if frame.corners.len() < MIN_CORNERS || !frame.time_s.is_finite() {
        return None;
    }
    let lens = Camera::new(&camera.intrinsics).ok()?;
    let mut corners = frame.corners.clone();
    let mut found = board_pose(&camera.intrinsics, &corners).ok()?;
    let mut lengths: Vec<f64> = distances(&lens, &found.camera_from_board, &corners);
    let middle = lengths.len() / 2;
    let median = *lengths.select_nth_unstable_by(middle, f64::total_cmp).1 / RAYLEIGH_MEDIAN;
    let limit = OUTLIER_SIGMAS * median.max(MIN_NOISE_PX);
    let fits: Vec<bool> =
        distances(&lens, &found.camera_from_board, &corners).iter().map(|d| *d <= limit).collect();
    if fits.contains(&false) {
        let mut fits = fits.into_iter();
        corners.retain(|_| fits.next().unwrap_or(true));
        if corners.len() < MIN_CORNERS {
            return None;
        }
        found = board_pose(&camera.intrinsics, &corners).ok()?;
    }
    // Six coordinates of the pose were fitted to them.
    let measurements = 2.0 * corners.len() as f64;
    let noise_px = found.rms_px * (corners.len() as f64 / (measurements - 6.0)).sqrt();
    Some(Posed {
        camera: frame.camera,
        time_s: frame.time_s,
        stamp_s: frame.time_s,
        corners,
        rig_from_board: camera.rig_from_camera.after(&found.camera_from_board),
        noise_px,
        is_decided: is_decided(&found),
    })
}

/// Whether the other tilt fits clearly worse, or both searches ended at one pose.
fn is_decided(found: &BoardPose) -> bool {
    let BoardPose { rms_px, other_rms_px, .. } = *found;
    other_rms_px > 1.5 * rms_px || other_rms_px < (1.0 + 1e-3) * rms_px
}

fn distances(lens: &Camera, camera_from_board: &Rigid, corners: &[Corner]) -> Vec<f64> {
    corners
        .iter()
        .map(|c| {
            let pixel = lens.project(camera_from_board.transform(c.point));
            pixel.map_or(f64::INFINITY, |pixel| (pixel - c.pixel).length())
        })
        .collect()
}

/// A place of the board at a time.
#[derive(Debug, Clone, Copy)]
struct Place {
    time_s: f64,
    at: DVec3,
}

/// Aligns the stamps of the cameras with those of the reference, to 10 ms, and returns which cameras could be: those that saw the board at the same
/// moments as the reference, or as a camera that did.
pub(super) fn align(frames: &mut [Posed], cameras: usize, reference: usize, min_frames: usize) -> Vec<bool> {
    let middle = middle(frames);
    let place = |f: &Posed| Place { time_s: f.time_s, at: f.rig_from_board.transform(middle) };
    let mut aligned = vec![false; cameras];
    aligned[reference] = true;
    loop {
        let mut known: Vec<Place> =
            frames.iter().filter(|f| aligned[f.camera] && f.is_decided).map(place).collect();
        known.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        let open = (0..cameras).filter(|c| !aligned[*c]);
        let best = open
            .filter_map(|camera| {
                let own: Vec<Place> =
                    frames.iter().filter(|f| f.camera == camera && f.is_decided).map(place).collect();
                Offset::of(&known, &own, min_frames).map(|offset| (camera, offset))
            })
            .max_by_key(|(_, offset)| offset.compared);
        let Some((camera, offset)) = best else { return aligned };
        aligned[camera] = true;
        for frame in frames.iter_mut().filter(|f| f.camera == camera) {
            frame.time_s = frame.stamp_s - offset.latency_s;
        }
    }
}

/// The middle of the corners that were seen, in the board's coordinates.
fn middle(frames: &[Posed]) -> DVec3 {
    let mut low = DVec3::INFINITY;
    let mut high = DVec3::NEG_INFINITY;
    for corner in frames.iter().flat_map(|f| &f.corners) {
        low = low.min(corner.point);
        high = high.max(corner.point);
    }
    (low + high) * 0.5
}

/// How late the places of one camera are against those of others.
struct Offset {
    latency_s: f64,
    /// Places that were compared.
    compared: usize,
}

impl Offset {
    fn of(known: &[Place], own: &[Place], min_frames: usize) -> Option<Self> {
        let steps = (SEARCHED_S / SEARCH_STEP_S).round() as i32;
        let mut best: Option<(f64, Self)> = None;
        // From the middle outwards, so that of equal ones the smallest is taken.
        for step in (0..=steps).flat_map(|s| [s, -s]) {
            let latency_s = f64::from(step) * SEARCH_STEP_S;
            let distances = own.iter().filter_map(|place| {
                let there = at_time(known, place.time_s - latency_s)?;
                Some((place.at - there).length().min(FAR_M))
            });
            let mut compared = 0;
            let mut sum = 0.0;
            for distance in distances {
                compared += 1;
                sum += distance;
            }
            let mean = sum / f64::from(compared);
            if compared as usize >= min_frames && best.as_ref().is_none_or(|(least, _)| mean < *least) {
                best = Some((mean, Self { latency_s, compared: compared as usize }));
            }
        }
        best.map(|(_, offset)| offset)
    }
}

/// The place at a time, between two that were seen.
fn at_time(places: &[Place], time_s: f64) -> Option<DVec3> {
    let after = places.partition_point(|p| p.time_s < time_s);
    let before = places.get(after.checked_sub(1)?)?;
    let after = places.get(after)?;
    let span = after.time_s - before.time_s;
    if span > COMPARED_S {
        return None;
    }
    let part = if span > 0.0 { (time_s - before.time_s) / span } else { 0.0 };
    Some(before.at.lerp(after.at, part))
}

/// The board's way as single images show it, for the start of the trajectory: poses in the order of time.
pub(super) struct Way(Vec<(f64, Rigid)>);

impl Way {
    /// # Errors
    /// When no image decides how the board is tilted.
    pub fn new(frames: &[Posed]) -> Result<Self> {
        let mut poses: Vec<(f64, Rigid)> =
            frames.iter().filter(|f| f.is_decided).map(|f| (f.time_s, f.rig_from_board)).collect();
        if poses.is_empty() {
            return Err(bad(
                "no image shows which way the board is tilted; wave it nearer to the cameras, and tilt it"
                    .to_owned(),
            ));
        }
        poses.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(Self(poses))
    }

    /// The pose at a time; before the first and after the last image theirs.
    pub fn at(&self, time_s: f64) -> Rigid {
        let index = self.0.partition_point(|p| p.0 < time_s);
        let (Some((from_s, from)), Some((to_s, to))) = (self.0.get(index.wrapping_sub(1)), self.0.get(index))
        else {
            return self.0[index.min(self.0.len() - 1)].1;
        };
        let part = if to_s > from_s { (time_s - from_s) / (to_s - from_s) } else { 0.0 };
        Rigid {
            rotation: nearest(from.rotation, to.rotation, part),
            translation: from.translation.lerp(to.translation, part),
        }
    }
}

fn nearest(from: DQuat, to: DQuat, part: f64) -> DQuat {
    from.slerp(to, part).normalize()
}
