use super::*;
use proptest::prelude::*;

/// Entry `i` of the table: different at each size, and with `fx` unlike `fy`.
fn table() -> Coefficients {
    let mut t = Coefficients { baseline_mm: -50.125, ..Coefficients::default() };
    let mut set = |i: usize, fx, fy, ppx, ppy| t.rectified[i] = Pinhole { fx, fy, ppx, ppy };
    set(0, 960.0, 950.0, 970.5, 545.25); // 1920x1080
    set(1, 640.0, 641.0, 642.5, 361.5); // 1280x720
    set(3, 424.0, 424.5, 425.25, 241.75); // 848x480
    t
}

fn near(i: &Intrinsics, fx: f64, fy: f64, cx: f64, cy: f64) {
    for (is, must) in [(i.fx, fx), (i.fy, fy), (i.cx, cx), (i.cy, cy)] {
        assert!((is - must).abs() < 1e-6, "{i:?} instead of {fx} {fy} {cx} {cy}");
    }
}

#[test]
fn depth_by_each_of_the_rules() {
    let t = table();
    let at = |w, h| depth(&t, &[], w, h).unwrap();
    let (i, basis) = at(1280, 720);
    near(&i, 640.0, 641.0, 642.5, 361.5);
    assert_eq!((basis, i.distortion()), (Basis::Entry, Distortion::None));
    let (i, basis) = at(848, 100);
    near(&i, 424.0, 424.5, 425.25, 51.75);
    assert_eq!(basis, Basis::Window);
    let (i, basis) = at(256, 144);
    near(&i, 960.0, 950.0, 138.5, 77.25);
    assert_eq!(basis, Basis::Window);
    // 640x480 has zeros in this table, so it is scaled like a size that no table has.
    let (i, basis) = at(640, 480);
    near(&i, 320.0, 422.222_222_222, 323.5, 242.333_333_333);
    assert_eq!(basis, Basis::Scaled);
    near(&at(960, 1080).0, 480.0, 950.0, 485.25, 545.25);
}

#[test]
fn the_newer_list_comes_first() {
    let t = table();
    let item = |width, height, fx| RectifiedItem {
        width,
        height,
        pinhole: Pinhole { fx, fy: 2.0, ppx: 3.0, ppy: 4.0 },
    };
    let items = [item(640, 360, 7.0), item(1280, 720, 8.0), item(848, 480, 0.0)];
    near(&depth(&t, &items, 1280, 720).unwrap().0, 8.0, 2.0, 3.0, 4.0);
    near(&depth(&t, &items, 640, 360).unwrap().0, 7.0, 2.0, 3.0, 4.0);
    // An item of zeros is ignored.
    near(&depth(&t, &items, 848, 480).unwrap().0, 424.0, 424.5, 425.25, 241.75);
}

#[test]
fn an_uncalibrated_camera_is_refused() {
    let placeholder = Pinhole { fx: 1.5, fy: 1.5, ppx: 0.5, ppy: 0.5 };
    let mut t = table();
    t.rectified[1] = placeholder;
    let e = depth(&t, &[], 1280, 720).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Unsupported);
    assert!(e.to_string().contains("not calibrated") && e.to_string().contains("1280x720"), "{e}");
    assert!(depth(&t, &[], 848, 480).is_ok());
    t.rectified[0] = placeholder;
    assert!(depth(&t, &[], 256, 144).is_err());
    assert!(depth(&t, &[], 424, 240).is_err());
    for empty in [Pinhole::default(), Pinhole { fx: f32::NAN, ..placeholder }] {
        t.rectified[0] = empty;
        assert!(depth(&t, &[], 424, 240).is_err());
    }
    let items = [RectifiedItem { width: 424, height: 240, pinhole: placeholder }];
    assert!(depth(&t, &items, 424, 240).is_err());
    assert_eq!(depth(&table(), &[], 0, 480).unwrap_err().kind(), ErrorKind::BadInput);
    // The same focal length along both axes is the result of rectification, not a placeholder.
    let same = Pinhole { fx: 383.5, fy: 383.5, ppx: 320.25, ppy: 241.5 };
    t.rectified[2] = same;
    assert!(depth(&t, &[], 640, 480).is_ok());
}

fn rgb() -> RgbTable {
    let mut k = [0.0; 9];
    (k[0], k[2], k[4], k[5], k[8]) = (1.42, 0.02, 2.53, -0.03, 1.0);
    RgbTable {
        k,
        distortion: [0.1, -0.2, 0.001, -0.002, 0.05],
        calibrated: (1920, 1080),
        rectified_rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        rectified_translation_mm: [-14.8, 0.1, 0.2],
        ..RgbTable::default()
    }
}

/// By hand from the rules, with the table's numbers as 32-bit floats.
#[test]
fn colour_at_three_shapes() {
    let fx = f64::from(1.42f32);
    let px = f64::from(0.02f32);
    let fy = f64::from(2.53f32);
    let py = f64::from(-0.03f32);
    let t = rgb();
    // 16:9, as it was calibrated.
    let i = color(&t, 1280, 720).unwrap();
    near(&i, fx * 640.0, fy * 360.0, (1.0 + px) * 640.0, (1.0 + py) * 360.0);
    assert_eq!(i.distortion(), Distortion::InverseBrownConrady);
    for (is, must) in i.coeffs.iter().zip([0.1f32, -0.2, 0.001, -0.002, 0.05, 0.0, 0.0, 0.0]) {
        assert_eq!(*is, f64::from(must));
    }
    // 4:3 is narrower: a/c = (3/4)/(9/16) = 4/3 along x.
    near(
        &color(&t, 640, 480).unwrap(),
        fx * 4.0 / 3.0 * 320.0,
        fy * 240.0,
        (1.0 + px * 4.0 / 3.0) * 320.0,
        (1.0 + py) * 240.0,
    );
    // 3:1 is wider: c/a = (9/16)/(1/3) = 27/16 along y.
    near(
        &color(&t, 960, 320).unwrap(),
        fx * 480.0,
        fy * 27.0 / 16.0 * 160.0,
        (1.0 + px) * 480.0,
        (1.0 + py * 27.0 / 16.0) * 160.0,
    );
    // Without a size of calibration it is taken for 16:9.
    let unknown = RgbTable { calibrated: (0, 0), ..rgb() };
    assert_eq!(color(&unknown, 640, 480).unwrap(), color(&t, 640, 480).unwrap());
    // A sensor of 16:10 (D455).
    let d455 = RgbTable { calibrated: (1280, 800), ..rgb() };
    near(
        &color(&d455, 1280, 720).unwrap(),
        fx * 640.0,
        fy * (10.0 / 16.0) / (9.0 / 16.0) * 360.0,
        (1.0 + px) * 640.0,
        (1.0 + py * 10.0 / 9.0) * 360.0,
    );
}

#[test]
fn colour_of_a_d405() {
    let fx = f64::from(1.42f32);
    let px = f64::from(0.02f32);
    let fy = f64::from(2.53f32);
    let py = f64::from(-0.03f32);
    let t = RgbTable { calibrated: (1280, 720), ..rgb() };
    let at = |w, h| d405_color(&t, w, h).unwrap();
    near(&at(1280, 720), fx * 640.0, fy * 360.0, (1.0 + px) * 640.0, (1.0 + py) * 360.0);
    // The sensor's 1280x800: 720/800 along y, then scaled by 770/1280, cut by 1.25/2 rows and 130/2 columns.
    let s = 770.0 / 1280.0;
    near(
        &at(640, 480),
        fx * 640.0 * s,
        fy * 0.9 * 400.0 * s,
        (1.0 + px) * 640.0 * s - 65.0,
        (1.0 + py * 0.9) * 400.0 * s - 0.625,
    );
    // 480x270 is 0.375 of it, with nothing cut; 848x480 is scaled by 2/3 along y, and wider than 848 by 16/3.
    near(&at(480, 270), fx * 240.0, fy * 135.0, (1.0 + px) * 240.0, (1.0 + py) * 135.0);
    near(
        &at(848, 480),
        fx * 640.0 * 2.0 / 3.0,
        fy * 240.0,
        (1.0 + px) * 640.0 * 2.0 / 3.0 - 8.0 / 3.0,
        (1.0 + py) * 240.0,
    );
    assert_eq!(at(640, 480).distortion(), Distortion::InverseBrownConrady);
    let unknown = RgbTable { calibrated: (0, 0), ..rgb() };
    assert!(d405_color(&unknown, 1280, 720).is_ok());
    assert_eq!(d405_color(&unknown, 848, 480).unwrap_err().kind(), ErrorKind::Unsupported);
}

#[test]
fn colour_without_numbers_is_refused() {
    assert_eq!(color(&RgbTable::default(), 640, 480).unwrap_err().kind(), ErrorKind::Unsupported);
    let mut t = rgb();
    t.distortion[2] = f32::INFINITY;
    assert!(color(&t, 640, 480).is_err() && d405_color(&t, 640, 480).is_err());
    assert_eq!(color(&rgb(), 640, 0).unwrap_err().kind(), ErrorKind::BadInput);
}

/// 30° about z, row after row.
fn turned() -> RgbTable {
    let s = 0.5f32;
    let c = 0.75f32.sqrt();
    RgbTable { rectified_rotation: [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0], ..rgb() }
}

#[test]
fn colour_in_depth_is_the_transpose_and_minus_the_translation() {
    let pose = color_in_depth(&turned()).unwrap();
    let s = 0.5;
    let c = f64::from(0.75f32.sqrt());
    let t = [f64::from(-14.8f32) * -0.001, f64::from(0.1f32) * -0.001, f64::from(0.2f32) * -0.001];
    assert!((t[0] - 0.0148).abs() < 1e-8, "colour is to the right of depth");
    // p_depth = Mᵀ p + t, written out.
    let p = [0.3, -0.2, 1.5];
    let must = [c * p[0] + s * p[1] + t[0], -s * p[0] + c * p[1] + t[1], p[2] + t[2]];
    let is = pose.transform_point(DVec3::from_array(p)).to_array();
    for (a, b) in is.iter().zip(must) {
        assert!((a - b).abs() < 1e-7, "{is:?} {must:?}");
    }
    // p_color = M (p_depth - t).
    let back = pose.inverse().transform_point(DVec3::from_array(must)).to_array();
    for (a, b) in back.iter().zip(p) {
        assert!((a - b).abs() < 1e-7, "{back:?}");
    }
    for (a, b) in color_in_depth(&rgb()).unwrap().translation_m.iter().zip(t) {
        assert!((a - b).abs() < 1e-12);
    }
}

#[test]
fn what_is_no_rotation_is_refused() {
    let mut tables = [turned(), turned(), turned(), turned(), turned()];
    tables[0].rectified_rotation[0] += 0.01;
    tables[1].rectified_rotation = [0.0; 9];
    tables[2].rectified_rotation[4] = f32::NAN;
    tables[3].rectified_rotation[8] = -1.0; // a mirror
    tables[4].rectified_translation_mm[1] = 1500.0;
    for (n, t) in tables.iter().enumerate() {
        assert_eq!(color_in_depth(t).unwrap_err().kind(), ErrorKind::Protocol, "{n}");
    }
    let mut slightly = turned();
    slightly.rectified_rotation[0] += 1e-5;
    assert!(color_in_depth(&slightly).is_ok());
}

#[test]
fn the_right_imager_is_to_the_right() {
    let pose = right_in_depth(&table()).unwrap();
    assert_eq!(pose.rotation_xyzw, [0.0, 0.0, 0.0, 1.0]);
    assert!((pose.translation_m[0] - 0.050_125).abs() < 1e-9, "{pose:?}");
    for wrong in [0.0, f32::NAN, -2000.0] {
        let t = Coefficients { baseline_mm: wrong, ..table() };
        assert!(right_in_depth(&t).is_err(), "{wrong}");
    }
}

proptest! {
    /// Halving the size of an image halves its intrinsics, by every rule that scales.
    #[test]
    fn colour_scales_with_the_image(w in 64u32..2000, h in 64u32..2000, fx in 0.5f32..3.0, py in -0.2f32..0.2) {
        let mut t = rgb();
        (t.k[0], t.k[5]) = (fx, py);
        let small = color(&t, w, h).unwrap();
        let large = color(&t, 2 * w, 2 * h).unwrap();
        near(&large, small.fx * 2.0, small.fy * 2.0, small.cx * 2.0, small.cy * 2.0);
        if (w, h) != (640, 480) && (w * 2, h * 2) != (640, 480) && (w, h) != (1280, 720) {
            let small = d405_color(&t, w, h).unwrap();
            let large = d405_color(&t, 2 * w, 2 * h).unwrap();
            near(&large, small.fx * 2.0, small.fy * 2.0, small.cx * 2.0, small.cy * 2.0);
        }
    }

    #[test]
    fn any_floats(bits in prop::array::uniform32(any::<u32>()), w in any::<u32>(), h in any::<u32>()) {
        let mut values = bits.into_iter().map(f32::from_bits).cycle();
        let mut next = || values.next().unwrap_or(0.0);
        let mut c = Coefficients { baseline_mm: next(), ..Coefficients::default() };
        for p in &mut c.rectified {
            *p = Pinhole { fx: next(), fy: next(), ppx: next(), ppy: next() };
        }
        let t = RgbTable {
            k: core::array::from_fn(|_| next()),
            rectified_rotation: core::array::from_fn(|_| next()),
            rectified_translation_mm: core::array::from_fn(|_| next()),
            calibrated: (w as u16, h as u16),
            ..RgbTable::default()
        };
        let _ = (depth(&c, &[], w, h), color(&t, w, h), d405_color(&t, w, h), right_in_depth(&c));
        if let Ok(pose) = color_in_depth(&t) {
            prop_assert!(pose.translation_m.iter().chain(&pose.rotation_xyzw).all(|v| v.is_finite()));
        }
    }
}
