//! Tests of the camera models: by hand, against other libraries, and against themselves.

use super::*;
use proptest::prelude::*;

fn with(model: Distortion, coeffs: [f64; 8]) -> Intrinsics {
    Intrinsics { coeffs, model: model as u32, ..Intrinsics::pinhole(600.0, 610.0, 320.5, 239.0) }
}

/// A lens of the Azure Kinect's wide mode: 120° across.
fn wide() -> Intrinsics {
    let c = [1.147, 0.2557, 2.5e-5, 7.5e-5, 0.00358, 1.4849, 0.5187, 0.0451];
    Intrinsics {
        coeffs: c,
        model: Distortion::Rational as u32,
        ..Intrinsics::pinhole(504.0, 504.0, 512.0, 512.0)
    }
}

/// Lenses as cameras have them, and some that no camera has, with tangential terms.
fn lenses() -> impl Strategy<Value = Intrinsics> {
    let small = || prop::array::uniform8(-1.0f64..1.0);
    let scaled = |c: [f64; 8], by: [f64; 8]| core::array::from_fn(|i| c[i] * by[i]);
    let brown = [0.35, 0.2, 0.003, 0.003, 0.1, 0.0, 0.0, 0.0];
    prop_oneof![
        small().prop_map(move |c| with(Distortion::BrownConrady, scaled(c, brown))),
        small().prop_map(move |c| with(Distortion::InverseBrownConrady, scaled(c, brown))),
        small().prop_map(move |c| with(
            Distortion::Rational,
            scaled(c, [0.4, 0.2, 0.002, 0.002, 0.05, 0.4, 0.2, 0.05])
        )),
        small().prop_map(move |c| with(
            Distortion::KannalaBrandt4,
            scaled(c, [0.1, 0.05, 0.02, 0.01, 0.0, 0.0, 0.0, 0.0])
        )),
        Just(wide()),
        Just(with(Distortion::None, [0.0; 8])),
    ]
}

#[test]
fn pinhole_by_hand() {
    let k = with(Distortion::None, [0.0; 8]);
    assert_eq!(k.project(DVec3::new(0.2, -0.1, 2.0)).unwrap(), DVec2::new(380.5, 208.5));
    assert_eq!(k.unproject(DVec2::new(380.5, 208.5)).unwrap(), DVec3::new(0.1, -0.05, 1.0));
    assert_eq!(k.project(DVec3::new(0.2, -0.1, 0.0)), None);
    assert_eq!(Intrinsics::default().project(DVec3::Z), None);
    assert_eq!(Camera::new(&k).unwrap().max_radius(), f64::INFINITY);
}

#[test]
fn brown_conrady_by_hand() {
    let k = with(Distortion::BrownConrady, [-0.28, 0.025, 0.001_2, -0.000_136, 0.16, 0.0, 0.0, 0.0]);
    let px = k.project(DVec3::new(0.3, -0.2, 1.0)).unwrap();
    // By the formula on paper: r² = 0.13, s = 1 − 0.0364 + 0.0004225 + 0.00035152 = 0.96437402.
    let x = 0.964_374_02 * 0.3 + 2.0 * 0.0012 * 0.3 * -0.2 - 0.000_136 * (0.13 + 2.0 * 0.09);
    let y = 0.964_374_02 * -0.2 + 0.0012 * (0.13 + 2.0 * 0.04) - 2.0 * 0.000_136 * 0.3 * -0.2;
    assert!((px - DVec2::new(600.0 * x + 320.5, 610.0 * y + 239.0)).length() < 1e-6, "{px}");
}

/// `tests/lenses.csv` has the results of OpenCV and librealsense; `tests/reference_lenses.py` wrote it.
#[test]
fn other_libraries_see_the_same() {
    let mut rows = 0;
    for line in include_str!("../../tests/lenses.csv").lines() {
        let mut words = line.split(',');
        let library = words.next().unwrap();
        let model = words.next().unwrap();
        let n: Vec<f64> = words.map(|w| w.parse().unwrap()).collect();
        let model = match model {
            "brown_conrady" => Distortion::BrownConrady,
            "inverse_brown_conrady" => Distortion::InverseBrownConrady,
            "kannala_brandt4" => Distortion::KannalaBrandt4,
            "rational" => Distortion::Rational,
            other => panic!("{other}"),
        };
        let coeffs = n[4..12].try_into().unwrap();
        let k = Intrinsics { coeffs, model: model as u32, ..Intrinsics::pinhole(n[0], n[1], n[2], n[3]) };
        let point = DVec3::new(n[12], n[13], n[14]);
        let pixel = DVec2::new(n[15], n[16]);
        let off = (k.project(point).unwrap() - pixel).length();
        let within = if library == "opencv" { 1e-9 } else { 3e-4 };
        assert!(off < within, "{line}: {off}");
        let ray = k.unproject(pixel).unwrap() * point.z;
        assert!((ray - point).length() < within * 1e-2 * point.z, "{line}: {ray}");
        rows += 1;
    }
    assert_eq!(rows, 72);
}

/// A pixel of 1280x960 around the principal point.
fn pixels() -> impl Strategy<Value = DVec2> {
    (-320.0f64..960.0, -240.0f64..720.0).prop_map(|(u, v)| DVec2::new(u, v))
}

fn differences(f: impl Fn(f64) -> Option<DVec2>) -> Option<DVec2> {
    // Of the fourth order: right to about 1e-8 with this step.
    let h = 1e-3;
    let a = f(h)? - f(-h)?;
    let b = f(2.0 * h)? - f(-2.0 * h)?;
    Some((8.0 * a - b) / (12.0 * h))
}

/// The radius of this one ends at a pole, where what is shown goes to infinity.
#[test]
fn a_point_comes_back_from_beside_a_pole() {
    let rational = [
        0.095_178_666_268_142_54,
        0.0,
        0.0,
        0.0,
        0.038_650_026_012_146_725,
        -0.263_642_456_444_254_3,
        0.087_952_951_089_679_15,
        -0.026_241_839_974_975_808,
    ];
    let k = Intrinsics {
        coeffs: rational,
        model: Distortion::Rational as u32,
        ..Intrinsics::pinhole(600.0, 610.0, 320.5, 239.0)
    };
    let camera = Camera::new(&k).unwrap();
    for i in 1..970 {
        let p = DVec3::new(camera.max_radius() * f64::from(i) / 1000.0, 0.0, 1.0);
        let there = camera.unproject(camera.project(p).unwrap());
        assert!(there.is_some_and(|t| (t - p).length() < 1e-9), "{there:?}, not {p}");
    }
}

proptest! {
    #[test]
    fn a_pixel_comes_back(k in lenses(), pixel in pixels()) {
        let camera = Camera::new(&k).unwrap();
        if let Some(ray) = camera.unproject(pixel) {
            prop_assert!(ray.truncate().length() <= camera.max_radius());
            let back = camera.project(ray).unwrap();
            prop_assert!((back - pixel).length() < 1e-9, "{} of {pixel}", (back - pixel).length());
        }
    }

    /// Within the monotone radius everything that is projected is found again, where tangential terms do not fold.
    #[test]
    fn a_point_comes_back(k in lenses(), angle in 0.0f64..6.3, part in 0.0f64..0.97, z in 0.05f64..20.0) {
        let camera = Camera::new(&k).unwrap();
        let r = part * camera.max_radius().min(1.5);
        let at = DVec2::new(r * angle.cos(), r * angle.sin());
        let p = at.extend(1.0) * z;
        let pixel = camera.project(p).unwrap();
        if let Some(there) = camera.unproject(pixel) {
            prop_assert!((camera.project(there).unwrap() - pixel).length() < 1e-9);
        }
        // The interior, where the lens is far from folding.
        if part < 0.8 {
            let there = camera.unproject(pixel);
            prop_assert!(there.is_some_and(|t| (t * z - p).length() < 1e-9 * z), "{there:?}, not {}", p / z);
        }
    }

    #[test]
    fn derivatives_are_those_of_differences(
        k in lenses(), x in -0.5f64..0.5, y in -0.4f64..0.4, z in 0.5f64..4.0,
    ) {
        let camera = Camera::new(&k).unwrap();
        let p = DVec3::new(x, y, 1.0) * z;
        let Some(j) = camera.project_with_jacobian(p) else { return Ok(()) };
        prop_assert_eq!(Some(j.pixel), camera.project(p));
        let close = |have: DVec2, want: Option<DVec2>| want.is_none_or(|w| (have - w).length() < 1e-5 * (1.0 + w.length()));
        for (axis, step) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().enumerate() {
            let have = DVec2::new(j.d_point[0][axis], j.d_point[1][axis]);
            prop_assert!(close(have, differences(|h| camera.project(p + step * h))), "axis {axis}");
        }
        for i in 0..12 {
            let moved = |h: f64| {
                let mut k = k;
                match i {
                    0 => k.fx += h,
                    1 => k.fy += h,
                    2 => k.cx += h,
                    3 => k.cy += h,
                    _ => k.coeffs[i - 4] += h,
                }
                Camera::new(&k).ok()?.project(p)
            };
            // A pinhole has no coefficients, and coefficients beyond a model's own are ignored.
            let have = DVec2::new(j.d_params[0][i], j.d_params[1][i]);
            prop_assert!(close(have, differences(moved)), "parameter {i}: {have}, {:?}", differences(moved));
        }
    }

    #[test]
    fn rays_turn_as_differences_say(k in lenses(), pixel in pixels()) {
        let camera = Camera::new(&k).unwrap();
        let Some(ray) = camera.unproject_with_jacobian(pixel) else { return Ok(()) };
        // Near the fold a step of a pixel is no small step.
        if ray.direction.truncate().length() > 0.8 * camera.max_radius() {
            return Ok(());
        }
        for (column, step) in [(ray.d_pixel.x_axis, DVec2::X), (ray.d_pixel.y_axis, DVec2::Y)] {
            let want = differences(|h| camera.unproject(pixel + step * h).map(DVec3::truncate));
            prop_assert!(want.is_none_or(|w| (column - w).length() < 1e-5 * w.length()), "{column}, {want:?}");
        }
    }

    /// No radius below the monotone one shows a smaller radius than a smaller one, and just beyond it one does.
    #[test]
    fn the_radius_is_where_the_lens_folds(k in lenses()) {
        let camera = Camera::new(&k).unwrap();
        let end = camera.max_radius().min(60.0);
        let mut last = 0.0;
        for i in 1..=2000 {
            let (shown, _) = camera.lens().radial(end * f64::from(i) / 2000.0 * (1.0 - 1e-9));
            prop_assert!(shown >= last - 1e-12, "{shown} after {last}");
            last = shown;
        }
        if camera.max_radius() < 60.0 {
            // It falls, or has passed a pole.
            let (shown, slope) = camera.lens().radial(camera.max_radius() * 1.001);
            prop_assert!(slope < 0.0 || shown < last, "{slope}");
        }
    }
}

#[test]
fn beyond_the_image_circle_there_is_no_ray() {
    // A barrel so strong that the image folds back at r = 0.91 on the plane z = 1: 1 − 1.2 r² = 0.
    let k = with(Distortion::BrownConrady, [-0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let camera = Camera::new(&k).unwrap();
    assert!((camera.max_radius() - (1.0f64 / 1.2).sqrt()).abs() < 1e-12);
    assert_eq!(k.unproject(DVec2::new(320.5 + 600.0, 239.0)), None);
    assert!(k.unproject(DVec2::new(320.5 + 300.0, 239.0)).is_some());
    assert!(k.project(DVec3::new(0.9, 0.0, 1.0)).is_some());
    assert_eq!(k.project(DVec3::new(0.92, 0.0, 1.0)), None);
    assert_eq!(camera.with_max_radius(0.5).project(DVec3::new(0.51, 0.0, 1.0)), None);
    assert_eq!(camera.with_max_radius(0.5).unproject(DVec2::new(320.5 + 300.0, 239.0)), None);
}

#[test]
fn numbers_that_are_no_camera() {
    let kind = |k: Intrinsics| Camera::new(&k).unwrap_err().kind();
    assert_eq!(kind(Intrinsics::default()), ErrorKind::NoCalibration);
    assert_eq!(kind(Intrinsics { fy: 0.0, ..with(Distortion::None, [0.0; 8]) }), ErrorKind::BadInput);
    assert_eq!(kind(with(Distortion::Rational, [f64::NAN; 8])), ErrorKind::BadInput);
    assert_eq!(kind(Intrinsics { model: 77, ..with(Distortion::None, [0.0; 8]) }), ErrorKind::NoCalibration);
}
