//! The shared orientation and the shared pinhole of two cameras, step by step as `OpenCV`'s `cvStereoRectify` finds
//! them.

use super::bad;
use crate::{Camera, Result};
use depthrig_bus::{Distortion, Intrinsics};
use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};

/// Common intrinsics of both rectified views, and the rotation of each camera into its view.
pub(super) struct Rectified {
    pub(super) intrinsics: Intrinsics,
    pub(super) baseline_m: f64,
    /// From directions of the camera to those of its view, left first.
    pub(super) rotations: [DMat3; 2],
}

/// One camera, and the rotation into its view.
struct Turned<'a> {
    lens: &'a Intrinsics,
    rotation: DMat3,
}

/// Points along each side of the grid that finds the visible area; `icvGetRectangles` has as many.
const GRID: u32 = 9;
/// Steps of the inverse of the lens; `cvUndistortPoints` does as many. More would be more exact, and differ from other
/// rectifications.
const INVERSE_STEPS: usize = 5;
/// Longest side of an image; tables of larger ones would fill the memory.
const MAX_SIDE: u32 = 16_384;

pub(super) fn rectify(
    left: &Intrinsics,
    right: &Intrinsics,
    right_from_left: &DAffine3,
    (width, height): (u32, u32),
) -> Result<Rectified> {
    if !(2..=MAX_SIDE).contains(&width) || !(2..=MAX_SIDE).contains(&height) {
        return Err(bad(format!(
            "invalid stereo image size {width}x{height}; sides must be in 2..={MAX_SIDE}"
        )));
    }
    let t = right_from_left.translation;
    // Half of the turn for each camera.
    let between = DQuat::from_mat3(&right_from_left.matrix3).normalize();
    let half = DQuat::from_scaled_axis(between.to_scaled_axis() * -0.5);
    let t_half = half * t;
    check_arrangement(t_half)?;
    // Then the shortest turn that brings the line between the centres onto the rows.
    let row = DVec3::new(t_half.x.signum(), 0.0, 0.0);
    let axis = t_half.cross(row);
    let length = axis.length();
    let level = if length > 0.0 {
        DQuat::from_scaled_axis(axis * ((t_half.x.abs() / t_half.length()).acos() / length))
    } else {
        DQuat::IDENTITY
    };
    let rotations = [DMat3::from_quat(level * half.inverse()), DMat3::from_quat(level * half)];
    let cameras =
        [Turned { lens: left, rotation: rotations[0] }, Turned { lens: right, rotation: rotations[1] }];
    // The rows must have the same scale in both views, hence the focal length is that of the columns' direction.
    let focal = f64::midpoint(left.fy, right.fy);
    let center = center(&cameras, focal, width, height)?;
    let scale = magnification(&cameras, focal, center, width, height)?;
    let focal = focal * scale;
    if !(focal.is_finite() && focal > 0.0) {
        return Err(bad("nothing is left of the images after rectification; are the lenses' numbers right?"));
    }
    Ok(Rectified {
        intrinsics: Intrinsics::pinhole(focal, focal, center.x, center.y),
        baseline_m: t.length(),
        rotations,
    })
}

/// Refuses cameras that are not side by side. `t` is the left camera's centre in the right one's frame, after both were
/// turned to one orientation.
fn check_arrangement(t: DVec3) -> Result<()> {
    if !t.is_finite() || t.length() < 1e-4 {
        let mm = t.length() * 1e3;
        return Err(bad(format!(
            "invalid baseline: the cameras are {mm:.3} mm apart; is the pose in metres, and of the right camera?"
        )));
    }
    if t.x.abs() <= t.y.abs() {
        return Err(bad(
            "the cameras are above each other and not side by side; turn the images, or correct the pose",
        ));
    }
    if t.x > 0.0 {
        return Err(bad(format!(
            "left and right are swapped: the right camera is {:.1} mm to the left of the left one. Exchange the two \
             streams' names, or give the pose of the right camera in the left one with a positive x",
            t.x * 1e3
        )));
    }
    Ok(())
}

/// The centre of the area that both cameras see, so that it lies in the centre of the images.
fn center(cameras: &[Turned<'_>; 2], focal: f64, width: u32, height: u32) -> Result<DVec2> {
    let w = f64::from(width);
    let h = f64::from(height);
    let mut center = DVec2::ZERO;
    for Turned { lens, rotation } in cameras {
        let mut mean = DVec2::ZERO;
        for (x, y) in [(0.0, 0.0), (w - 1.0, 0.0), (0.0, h - 1.0), (w - 1.0, h - 1.0)] {
            mean += project(*rotation, undistort(lens, DVec2::new(x, y))?) * focal / 4.0;
        }
        center += (DVec2::new((w - 1.0) / 2.0, (h - 1.0) / 2.0) - mean) / 2.0;
    }
    Ok(center)
}

/// How much the views must be magnified until each of their pixels is seen (`alpha = 0`).
fn magnification(
    cameras: &[Turned<'_>; 2],
    focal: f64,
    center: DVec2,
    width: u32,
    height: u32,
) -> Result<f64> {
    let w = f64::from(width);
    let h = f64::from(height);
    let step = f64::from(GRID - 1);
    let mut scale = f64::NEG_INFINITY;
    for Turned { lens, rotation } in cameras {
        // The largest upright rectangle that the bent border leaves free.
        let mut low = DVec2::NEG_INFINITY;
        let mut high = DVec2::INFINITY;
        for (i, j) in (0..GRID).flat_map(|j| (0..GRID).map(move |i| (i, j))) {
            let at = DVec2::new(f64::from(i) * (w - 1.0) / step, f64::from(j) * (h - 1.0) / step);
            let p = project(*rotation, undistort(lens, at)?) * focal + center;
            if i == 0 {
                low.x = low.x.max(p.x);
            }
            if i == GRID - 1 {
                high.x = high.x.min(p.x);
            }
            if j == 0 {
                low.y = low.y.max(p.y);
            }
            if j == GRID - 1 {
                high.y = high.y.min(p.y);
            }
        }
        let room = [
            center.x / (center.x - low.x),
            center.y / (center.y - low.y),
            (w - 1.0 - center.x) / (high.x - center.x),
            (h - 1.0 - center.y) / (high.y - center.y),
        ];
        scale = room.into_iter().fold(scale, f64::max);
    }
    Ok(scale)
}

/// The point on the plane z = 1 after `rotation`.
fn project(rotation: DMat3, at: DVec2) -> DVec2 {
    let p = rotation * at.extend(1.0);
    p.truncate() / p.z
}

/// The point on the plane z = 1 that the camera shows at `pixel`.
fn undistort(lens: &Intrinsics, pixel: DVec2) -> Result<DVec2> {
    let shown = DVec2::new((pixel.x - lens.cx) / lens.fx, (pixel.y - lens.cy) / lens.fy);
    let k = match lens.distortion() {
        Distortion::None => return Ok(shown),
        Distortion::BrownConrady => {
            let [k1, k2, p1, p2, k3, ..] = lens.coeffs;
            [k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
        }
        Distortion::Rational => lens.coeffs,
        // Models that `OpenCV` does not have here.
        _ => {
            let ray = Camera::new(lens)?.unproject(pixel);
            return ray
                .map(DVec3::truncate)
                .ok_or_else(|| bad("the lens shows no point at the image's edge"));
        }
    };
    let mut at = shown;
    for _ in 0..INVERSE_STEPS {
        let r2 = at.length_squared();
        let scale =
            (1.0 + ((k[7] * r2 + k[6]) * r2 + k[5]) * r2) / (1.0 + ((k[4] * r2 + k[1]) * r2 + k[0]) * r2);
        if scale < 0.0 {
            return Ok(shown);
        }
        let aside = DVec2::new(
            2.0 * k[2] * at.x * at.y + k[3] * (r2 + 2.0 * at.x * at.x),
            k[2] * (r2 + 2.0 * at.y * at.y) + 2.0 * k[3] * at.x * at.y,
        );
        at = (shown - aside) * scale;
    }
    Ok(at)
}
