//! Disparity to depth: `focal * baseline / disparity`, in whole units as a sensor gives it, or in metres.

use crate::error::check_len;
use crate::simd::for_every_processor;
use crate::{Error, ErrorKind, Result};

/// Units that 16 bits cannot hold.
const BEYOND: f32 = 70_000.0;

/// Depth in units of `unit_m` metres from disparity in pixels: `focal_px * baseline_m / disparity`, to the nearest unit.
/// 0, a hole, where disparity is NaN or not positive and where depth is outside `range_m` or the 16 bits.
///
/// Disparity is not smoothed on its way, so the levels of depth are those of the matcher: with `q` pixels between two
/// levels of disparity they are `z² * q / (focal_px * baseline_m)` metres apart at depth `z`, as in a sensor.
///
/// # Errors
/// [`ErrorKind::SizeMismatch`] when the lengths differ; [`ErrorKind::BadInput`] for a focal length, baseline or unit that
/// is not positive.
pub fn depth_from_disparity(
    disparity: &[f32],
    focal_px: f64,
    baseline_m: f64,
    unit_m: f64,
    range_m: (f64, f64),
    out: &mut [u16],
) -> Result<()> {
    check_len("depth", out.len(), (disparity.len(), 1), 1)?;
    check_geometry(focal_px, baseline_m)?;
    if !(unit_m > 0.0 && unit_m.is_finite()) {
        return Err(Error::new(
            ErrorKind::BadInput,
            format!("invalid depth unit {unit_m} m; 0.001 is a millimetre"),
        ));
    }
    let units = (focal_px * baseline_m / unit_m) as f32;
    let near = ((range_m.0 / unit_m) as f32).max(1.0);
    let far = (range_m.1 / unit_m).min(65_535.0) as f32;
    to_units(disparity, units, near, far, out);
    Ok(())
}

for_every_processor! {
    fn to_units(disparity: &[f32], units: f32, near: f32, far: f32, out: &mut [u16]) {
        for (z, d) in out.iter_mut().zip(disparity) {
            // NaN and 0 become the bound, which is too far. `round` would be a call for each pixel.
            let exact = (units / d).min(BEYOND);
            let whole = exact as i32;
            let depth = (whole + i32::from(exact - whole as f32 >= 0.5)) as f32;
            *z = if depth >= near && depth <= far { depth as u16 } else { 0 };
        }
    }
}

/// Depth in metres from disparity in pixels: `focal_px * baseline_m / disparity`; NaN for no disparity and where depth
/// is outside `range_m`.
///
/// # Errors
/// As [`depth_from_disparity`].
pub fn metres_from_disparity(
    disparity: &[f32],
    focal_px: f64,
    baseline_m: f64,
    range_m: (f64, f64),
    out: &mut [f32],
) -> Result<()> {
    check_len("depth", out.len(), (disparity.len(), 1), 1)?;
    check_geometry(focal_px, baseline_m)?;
    let product = (focal_px * baseline_m) as f32;
    let near = range_m.0 as f32;
    let far = range_m.1 as f32;
    for (z, d) in out.iter_mut().zip(disparity) {
        let depth = product / d;
        *z = if *d > 0.0 && depth >= near && depth <= far { depth } else { f32::NAN };
    }
    Ok(())
}

fn check_geometry(focal_px: f64, baseline_m: f64) -> Result<()> {
    let positive = |v: f64| v > 0.0 && v.is_finite();
    if positive(focal_px) && positive(baseline_m) {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::BadInput,
        format!(
            "a focal length of {focal_px} px and a baseline of {baseline_m} m give no depth; both are above 0 in a stereo camera"
        ),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn depth_is_focal_times_baseline_over_disparity() {
        let d = [12.0, 0.5, 0.0, f32::NAN, f32::INFINITY, -3.0, 700.0, 0.01];
        let mut z = [9; 8];
        depth_from_disparity(&d, 700.0, 0.12, 0.001, (0.15, 20.0), &mut z).unwrap();
        // 84 m·px: at 12 px 7 m; 0.5 px would be 168 m, 700 px 0.12 m, 0.01 px beyond 16 bits.
        assert_eq!(z, [7000, 0, 0, 0, 0, 0, 0, 0]);
        depth_from_disparity(&[100.0, 97.0], 700.0, 0.12, 0.0001, (0.0, f64::INFINITY), &mut z[..2]).unwrap();
        assert_eq!(z[..2], [8400, 8660]);
        let mut m = [0.0; 8];
        metres_from_disparity(&d, 700.0, 0.12, (0.15, 20.0), &mut m).unwrap();
        assert_eq!(m[0], 7.0);
        assert!(m[1..].iter().all(|z| z.is_nan()), "{m:?}");
    }

    proptest! {
        /// To the nearest unit, half a unit away from 0, as `round` does.
        #[test]
        fn depth_is_rounded(
            d in prop::collection::vec(prop_oneof![0.0005f32..300.0, prop::num::f32::ANY], 1..200),
            halves in prop::collection::vec(1u16..4000, 1..50),
        ) {
            let halves = halves.into_iter().map(|n| 84_000.0 / (f32::from(n) + 0.5));
            let d: Vec<_> = d.into_iter().chain(halves).collect();
            let mut z = vec![0; d.len()];
            crate::simd::in_every_width(|width| {
                depth_from_disparity(&d, 700.0, 0.12, 0.001, (0.0, 100.0), &mut z).unwrap();
                for (d, z) in d.iter().zip(&z) {
                    let depth = (84_000.0 / d).round();
                    let expected = if (1.0..=65_535.0).contains(&depth) { depth as u16 } else { 0 };
                    assert_eq!(*z, expected, "{d} px {width:?}");
                }
            });
        }
    }

    #[test]
    fn the_levels_of_the_matcher_stay() {
        // Sixteenths of a pixel around 20 px: f*B = 84 m·px gives levels 13 mm apart at 4.2 m.
        let d: Vec<f32> = (0..64).map(|i| 20.0 + (i / 4) as f32 / 16.0).collect();
        let mut z = vec![0; d.len()];
        depth_from_disparity(&d, 700.0, 0.12, 0.001, (0.0, 100.0), &mut z).unwrap();
        z.dedup();
        assert_eq!(z.len(), 16);
        assert!(z.windows(2).all(|w| (12..=14).contains(&(w[0] - w[1]))), "{z:?}");
    }

    #[test]
    fn what_is_no_camera_is_refused() {
        for (f, b, u) in
            [(0.0, 0.1, 0.001), (700.0, -0.1, 0.001), (700.0, f64::NAN, 0.001), (700.0, 0.1, 0.0)]
        {
            assert!(depth_from_disparity(&[1.0], f, b, u, (0.0, 9.0), &mut [0]).is_err());
        }
        assert!(depth_from_disparity(&[1.0], 700.0, 0.1, 0.001, (0.0, 9.0), &mut [0, 0]).is_err());
    }
}
