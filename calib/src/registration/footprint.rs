//! Decides once for a pair of cameras whether a depth pixel covers more than one colour pixel.

use crate::Camera;
use glam::{DAffine3, DVec2};

/// Pixels that are tried along each side.
const TRIED: usize = 5;
/// So many pixels of colour may lie between two of depth where each draws a single one: beyond, some stay empty.
const LARGEST: f64 = 1.005;

/// Whether colour is the coarser image everywhere, so that a depth pixel covers one of its pixels. Distances are those of
/// far points.
pub(super) fn is_point(
    depth: &Camera,
    (w, h): (usize, usize),
    color: &Camera,
    color_from_depth: &DAffine3,
) -> bool {
    let place = |i: usize, n: usize| (n - 1) as f64 * i as f64 / (TRIED - 1) as f64;
    (0..TRIED * TRIED).all(|i| {
        let pixel = DVec2::new(place(i % TRIED, w), place(i / TRIED, h));
        let seen = |dx: f64, dy: f64| {
            let ray = depth.unproject(pixel + DVec2::new(dx, dy))?;
            color.project(color_from_depth.matrix3 * ray)
        };
        let (Some(at), Some(next), Some(under)) = (seen(0.0, 0.0), seen(1.0, 0.0), seen(0.0, 1.0)) else {
            return true;
        };
        ((next - at).abs() + (under - at).abs()).max_element() <= LARGEST
    })
}
