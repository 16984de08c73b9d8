//! How well the surfaces of two cameras agree.

use super::PointCloud;
use crate::{Camera, PoseExt, Result};
use depthrig_bus::{Intrinsics, Pose};
use glam::DVec3;

/// A depth image and where it was taken.
#[derive(Debug, Clone, Copy)]
pub struct DepthView<'a> {
    /// Depth along the axis, metres, row by row; 0 and what is not finite are holes.
    pub depth_m: &'a [f32],
    /// Columns and rows.
    pub size: (u32, u32),
    /// Intrinsics of the depth image.
    pub intrinsics: &'a Intrinsics,
    /// Pose of the depth camera on the mount.
    pub pose: &'a Pose,
}

/// Differences between the points of one camera and the depth of another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    /// Points that both see.
    pub points: usize,
    /// Median of measured depth minus the point's, metres: positive if the second camera sees the surface further away.
    pub median_m: f64,
    /// Median of its absolute value, metres.
    pub median_abs_m: f64,
}

/// Points of another camera that are further away from a surface than this are of another surface, metres.
const SAME_SURFACE_M: f64 = 0.05;
/// Points below which nothing is said.
const MIN_POINTS: usize = 100;

/// Compares points on the mount with a depth image of another camera. Points that are hidden from it, or that it sees another surface instead
/// of (more than 5 cm away), do not count. `None` if fewer than 100 points are left.
///
/// # Errors
/// As [`Camera::new`].
pub fn agreement(points: &PointCloud, other: &DepthView<'_>) -> Result<Option<Agreement>> {
    let camera = Camera::new(other.intrinsics)?;
    let camera_from_rig = other.pose.to_affine().inverse();
    let (width, height) = other.size;
    let mut differences = Vec::new();
    for point in &points.points {
        let at = camera_from_rig.transform_point3(DVec3::from(point.map(f64::from)));
        let Some(pixel) = camera.project(at) else { continue };
        let pixel = pixel.round();
        if pixel.x < 0.0 || pixel.y < 0.0 || pixel.x >= f64::from(width) || pixel.y >= f64::from(height) {
            continue;
        }
        let index = pixel.y as usize * width as usize + pixel.x as usize;
        let Some(depth) = other.depth_m.get(index).map(|d| f64::from(*d)) else { continue };
        let difference = depth - at.z;
        if depth > 0.0 && difference.abs() <= SAME_SURFACE_M {
            differences.push(difference);
        }
    }
    if differences.len() < MIN_POINTS {
        return Ok(None);
    }
    let median = |values: &mut Vec<f64>| {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let median_m = median(&mut differences);
    let mut absolute: Vec<f64> = differences.iter().map(|d| d.abs()).collect();
    Ok(Some(Agreement { points: differences.len(), median_m, median_abs_m: median(&mut absolute) }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Deprojection;

    const SIZE: (u32, u32) = (160, 120);

    /// Depth of the plane z = 1 m of the mount for a camera at `x`, whose depth is off by `bias_m`.
    fn wall(bias_m: f32) -> Vec<f32> {
        vec![1.0 + bias_m; (SIZE.0 * SIZE.1) as usize]
    }

    fn at(x: f64) -> Pose {
        Pose { translation_m: [x, 0.0, 0.0], ..Pose::IDENTITY }
    }

    #[test]
    fn a_wall_that_two_cameras_see_agrees_but_for_the_bias() {
        let k = Intrinsics::pinhole(140.0, 140.0, 79.5, 59.5);
        let mut cloud = PointCloud::default();
        Deprojection::new(&k, SIZE).unwrap().cloud_of_metres(&wall(0.0), None, &mut cloud).unwrap();
        cloud.transform(&at(0.0));
        let depth = wall(0.004);
        let other = DepthView { depth_m: &depth, size: SIZE, intrinsics: &k, pose: &at(0.2) };
        let found = agreement(&cloud, &other).unwrap().unwrap();
        assert!(
            (found.median_m - 0.004).abs() < 1e-6 && (found.median_abs_m - 0.004).abs() < 1e-6,
            "{found:?}"
        );
        // A fifth of the other camera's image lies beyond the first one's: 28 of 160 columns.
        assert_eq!(found.points, 132 * 120);
        // Something 20 cm in front of the wall is not the wall.
        let near = wall(-0.2);
        let hidden = DepthView { depth_m: &near, ..other };
        assert_eq!(agreement(&cloud, &hidden).unwrap(), None);
    }
}
