//! Tests of the camera models.

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

#[test]
fn pinhole_by_hand() {
    let k = with(Distortion::None, [0.0; 8]);
    assert_eq!(k.project(DVec3::new(0.2, -0.1, 2.0)).unwrap(), DVec2::new(380.5, 208.5));
    assert_eq!(k.unproject(DVec2::new(380.5, 208.5)).unwrap(), DVec3::new(0.1, -0.05, 1.0));
    assert_eq!(k.project(DVec3::new(0.2, -0.1, 0.0)), None);
    assert_eq!(Intrinsics::default().project(DVec3::Z), None);
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

proptest! {
    #[test]
    fn there_and_back(x in -1.2f64..1.2, y in -1.2f64..1.2, z in 0.1f64..8.0) {
        let p = DVec3::new(x, y, 1.0) * z;
        let px = wide().project(p).unwrap();
        prop_assert!((wide().unproject(px).unwrap() * z - p).length() < 1e-6 * z);
        let k = with(Distortion::BrownConrady, [-0.05, 0.01, 0.001, -0.0005, 0.0, 0.0, 0.0, 0.0]);
        prop_assert!((k.unproject(k.project(p).unwrap()).unwrap() * z - p).length() < 1e-6 * z);
    }
}

#[test]
fn beyond_the_image_circle_there_is_no_ray() {
    // A barrel so strong that the picture folds back at r = 0.91 on the plane z = 1.
    let k = with(Distortion::BrownConrady, [-0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(k.unproject(DVec2::new(320.5 + 600.0, 239.0)), None);
    assert!(k.unproject(DVec2::new(320.5 + 300.0, 239.0)).is_some());
}
