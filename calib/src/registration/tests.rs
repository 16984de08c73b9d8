//! Tests of registration: against models that are slow and plainly right.

use super::*;
use crate::simd::in_every_width;
use depthrig_bus::Distortion;
use glam::DVec2;
use proptest::prelude::*;

#[test]
fn a_wall_seen_from_beside() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let moved = Pose { translation_m: [0.105, 0.0, 0.0], ..Pose::IDENTITY };
    for method in [Method::Splat, Method::Triangles] {
        let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &moved, method).unwrap();
        assert_eq!((r.depth_size(), r.color_size()), ((64, 48), (64, 48)));
        let mut out = vec![7; 64 * 48];
        r.depth_to_color(&[1000; 64 * 48], 0.001, &mut out).unwrap();
        for (i, z) in out.iter().enumerate() {
            let (x, y) = (i % 64, i / 64);
            // A neighbourhood begins in the middle of its first pixel.
            let first = if method == Method::Triangles { 7 } else { 6 };
            assert_eq!(*z, if x < first { 0 } else { 1000 }, "{method:?} at {x}, {y}");
        }
    }
}

/// A pair of cameras and a picture of depth.
#[derive(Debug, Clone)]
struct Case {
    depth: Intrinsics,
    depth_size: (u32, u32),
    color: Intrinsics,
    color_size: (u32, u32),
    pose: Pose,
    unit_m: f64,
    pixels: Vec<u16>,
}

fn lens() -> impl Strategy<Value = (u32, [f64; 8])> {
    prop_oneof![
        Just((Distortion::None as u32, [0.0; 8])),
        Just((Distortion::BrownConrady as u32, [-0.12, 0.05, 0.002, -0.001, 0.01, 0.0, 0.0, 0.0])),
        Just((Distortion::InverseBrownConrady as u32, [-0.05, 0.06, 0.0007, 0.0002, -0.02, 0.0, 0.0, 0.0])),
        Just((Distortion::Rational as u32, [0.5, -0.2, 0.001, -0.0005, 0.01, 0.7, -0.1, 0.02])),
        Just((Distortion::KannalaBrandt4 as u32, [0.03, -0.01, 0.004, -0.0007, 0.0, 0.0, 0.0, 0.0])),
    ]
}

fn cases() -> impl Strategy<Value = Case> {
    let camera = |f: std::ops::Range<f64>| {
        (4u32..40, 3u32..30, f, lens(), -2.0f64..2.0).prop_map(|(w, h, f, (model, coeffs), off)| {
            let (cx, cy) = (f64::from(w) / 2.0 - 0.5 + off, f64::from(h) / 2.0 - 0.5 - off);
            (Intrinsics { coeffs, model, ..Intrinsics::pinhole(f, f * 1.01, cx, cy) }, (w, h))
        })
    };
    let turn = prop_oneof![Just(0.0), Just(1.0)];
    (camera(15.0..40.0), camera(10.0..90.0), prop::array::uniform6(-1.0f64..1.0), turn, any::<u64>())
        .prop_map(|((depth, depth_size), (color, color_size), p, upside_down, seed)| {
            let q = if upside_down > 0.0 { [0.0, 0.0, 1.0, 0.05] } else { [0.0, 0.0, 0.0, 1.0] };
            let pose = Pose {
                translation_m: [p[0] * 0.1, p[1] * 0.1, p[2] * 0.05],
                rotation_xyzw: [q[0] + p[3] * 0.03, q[1] + p[4] * 0.03, q[2] + p[5] * 0.03, q[3]],
            };
            // Surfaces with steps, noise, holes and a few saturated pixels.
            let mut state = seed | 1;
            let mut next = || {
                state ^= state << 13;
                state ^= state >> 7;
                state ^= state << 17;
                (state >> 32) as u32
            };
            let near = 300 + next() % 900;
            let (w, h) = depth_size;
            let pixels = (0..w * h)
                .map(|i| match next() % 16 {
                    0 => 0,
                    1 if next() % 8 == 0 => u16::MAX,
                    _ => (near + (i % w / 7 + i / w / 5) % 3 * 400 + next() % 7) as u16,
                })
                .collect();
            Case { depth, depth_size, color, color_size, pose, unit_m: 0.001, pixels }
        })
}

impl Case {
    fn registration(&self, method: Method) -> Registration {
        Registration::new(&self.depth, self.depth_size, &self.color, self.color_size, &self.pose, method)
            .unwrap()
    }

    fn run(&self, registration: &mut Registration) -> Vec<u16> {
        let mut out = vec![5; (self.color_size.0 * self.color_size.1) as usize];
        registration.depth_to_color(&self.pixels, self.unit_m, &mut out).unwrap();
        out
    }

    /// Where colour sees a place of depth's picture that is `z` units away, in 64 bits.
    fn seen(&self, x: f64, y: f64, z: u16) -> Option<(DVec2, f64)> {
        let ray = Camera::new(&self.depth).unwrap().unproject(DVec2::new(x, y))?;
        let p = self.pose.to_affine().transform_point3(ray * f64::from(z) * self.unit_m);
        Some((Camera::new(&self.color).unwrap().project(p)?, p.z / self.unit_m))
    }

    /// The splat written down as its rule says, once with every edge moved outwards by `slack` pixels and once inwards:
    /// what is nearest in each colour pixel at the most and at the least.
    fn splat(&self, slack: f64) -> Vec<u16> {
        let (w, h) = (self.color_size.0 as i32, self.color_size.1 as i32);
        let mut out = vec![0u16; (w * h) as usize];
        let sizes = |(w, h): (u32, u32)| (w as usize, h as usize);
        let cameras = (Camera::new(&self.depth).unwrap(), Camera::new(&self.color).unwrap());
        let both = warp::spreads(&cameras.0, sizes(self.depth_size), &cameras.1, sizes(self.color_size));
        for (i, z) in self.pixels.iter().enumerate().filter(|(_, z)| **z > 0) {
            let (x, y) = (i % self.depth_size.0 as usize, i / self.depth_size.0 as usize);
            let at = |d: f64| self.seen(x as f64 + d, y as f64 + d, *z).map(|s| s.0);
            let Some(a) = at(-0.5) else { continue };
            let Some(b) = (if both { at(0.5) } else { Some(a) }) else { continue };
            let trunc = |v: f64| (v + 0.5).trunc() as i32;
            let (first, last) = (a.min(b) - slack, a.max(b) + slack);
            let (x0, y0, x1, y1) = (trunc(first.x), trunc(first.y), trunc(last.x), trunc(last.y));
            for y in y0.max(0)..=y1.min(h - 1) {
                for x in x0.max(0)..=x1.min(w - 1) {
                    let old = &mut out[(y * w + x) as usize];
                    *old = if *old == 0 { *z } else { (*old).min(*z) };
                }
            }
        }
        out
    }
}

/// Nothing is further than everything.
fn nearer_or_same(a: u16, b: u16) -> bool {
    a.wrapping_sub(1) <= b.wrapping_sub(1)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// 32 bits put an edge within a hundredth of a pixel, so the result lies between the two of the slow model; where
    /// these agree, which is nearly everywhere, it is the same.
    #[test]
    fn splatting_is_what_the_rule_says(case in cases()) {
        let out = case.run(&mut case.registration(Method::Splat));
        let (most, least) = (case.splat(0.002), case.splat(-0.002));
        let same = most.iter().zip(&least).filter(|(a, b)| a == b).count();
        prop_assert!(same * 10 >= most.len() * 8, "{same} of {} pixels are decided", most.len());
        for (i, z) in out.iter().enumerate() {
            prop_assert!(
                nearer_or_same(most[i], *z) && nearer_or_same(*z, least[i]),
                "{z} at {i}, not between {} and {}", most[i], least[i]
            );
        }
    }

    /// A triangle's pixel lies on the surface that depth has there: a ray of colour through the middle of the pixel meets
    /// four depth pixels around it with about this depth.
    #[test]
    fn triangles_interpolate_their_vertices(case in cases()) {
        let out = case.run(&mut case.registration(Method::Triangles));
        let (w, h) = (case.depth_size.0 as usize, case.depth_size.1 as usize);
        let seen: Vec<_> = case.pixels.iter().enumerate()
            .map(|(i, z)| if *z == 0 { None } else { case.seen((i % w) as f64, (i / w) as f64, *z) })
            .collect();
        for (i, z) in out.iter().enumerate().filter(|(_, z)| **z > 0) {
            let at = DVec2::new((i % case.color_size.0 as usize) as f64, (i / case.color_size.0 as usize) as f64);
            let drawn = (0..(w - 1) * (h - 1)).any(|cell| {
                let first = cell / (w - 1) * w + cell % (w - 1);
                let corners: Vec<_> = [0, 1, w, w + 1].iter().filter_map(|d| seen[first + d]).collect();
                if corners.len() < 3 {
                    return false;
                }
                let low = corners.iter().fold(DVec2::INFINITY, |a, c| a.min(c.0)) - 0.01;
                let high = corners.iter().fold(DVec2::NEG_INFINITY, |a, c| a.max(c.0)) + 0.01;
                let near = corners.iter().fold(f64::INFINITY, |a, c| a.min(c.1));
                let far = corners.iter().fold(0.0f64, |a, c| a.max(c.1));
                at.cmpge(low).all() && at.cmple(high).all() && far - near <= 0.0470 * near
                    && f64::from(*z) >= near - 0.6 && f64::from(*z) <= far + 0.6
            });
            prop_assert!(drawn, "{z} at {at}");
        }
    }

    #[test]
    fn every_form_and_number_of_threads_gives_the_same_bits(case in cases(), threads in 2usize..6) {
        for method in [Method::Splat, Method::Triangles] {
            let mut alone = case.registration(method);
            let want = case.run(&mut alone);
            let color: Vec<u8> = (0..case.color_size.0 * case.color_size.1 * 3).map(|i| (i % 251) as u8).collect();
            let painted = |r: &mut Registration| {
                let mut out = vec![9; case.pixels.len() * 3];
                r.color_to_depth(&case.pixels, case.unit_m, &color, &mut out).unwrap();
                out
            };
            let want_painted = painted(&mut alone);
            in_every_width(|width| {
                assert_eq!(case.run(&mut alone), want, "{method:?} {width:?}");
                assert_eq!(painted(&mut alone), want_painted, "{method:?} {width:?}");
            });
            let mut several = case.registration(method).with_threads(threads);
            prop_assert_eq!(case.run(&mut several), want);
            prop_assert_eq!(painted(&mut several), want_painted);
        }
    }
}

#[test]
fn what_is_nearer_hides_what_is_further() {
    // Two boards at 0.5 m and 1 m; colour is 0.1 m to the right, so the near one moves twice as far.
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 2.5);
    let moved = Pose { translation_m: [-0.105, 0.0, 0.0], ..Pose::IDENTITY };
    let depth: Vec<u16> =
        (0..64 * 6).map(|i| if (40..50).contains(&(i % 64)) { 500 } else { 1000 }).collect();
    for method in [Method::Splat, Method::Triangles] {
        let mut out = vec![0; 64 * 6];
        Registration::new(&k, (64, 6), &k, (64, 6), &moved, method)
            .unwrap()
            .depth_to_color(&depth, 0.001, &mut out)
            .unwrap();
        let row = &out[64 * 2..64 * 3];
        assert!(row[29..36].iter().all(|z| *z == 500), "{method:?} {row:?}");
        assert!(row[1..26].iter().all(|z| *z == 1000), "{method:?} {row:?}");
        // Behind the near board there is a shadow that no triangle bridges.
        assert!(row[39..43].iter().all(|z| *z == 0), "{method:?} {row:?}");
    }
}

#[test]
fn a_hole_costs_a_triangle_no_more_than_its_half() {
    let k = Intrinsics::pinhole(40.0, 40.0, 3.5, 3.5);
    let mut depth = vec![1000; 64];
    depth[3 * 8 + 3] = 0;
    let fine = Intrinsics::pinhole(400.0, 400.0, 39.5, 39.5);
    let mut r = Registration::new(&k, (8, 8), &fine, (80, 80), &Pose::IDENTITY, Method::Triangles).unwrap();
    let mut out = vec![0; 6400];
    r.depth_to_color(&depth, 0.001, &mut out).unwrap();
    // The hole is at (34.5, 34.5) of colour; its four neighbourhoods are cut to the halves away from it.
    assert_eq!(out[34 * 80 + 34], 0);
    assert_eq!(out[31 * 80 + 31], 0);
    assert_eq!(out[28 * 80 + 28], 1000);
    assert_eq!(out[41 * 80 + 41], 1000);
    let holes = out
        .iter()
        .enumerate()
        .filter(|(i, z)| **z == 0 && (20..50).contains(&(i % 80)) && (20..50).contains(&(i / 80)));
    assert!((130..=250).contains(&holes.count()));
}

#[test]
fn a_camera_upside_down_sees_too() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let turned = Pose { rotation_xyzw: [0.0, 0.0, 1.0, 0.0], ..Pose::IDENTITY };
    let depth: Vec<u16> = (0..64 * 48).map(|i| 1000 + (i % 64) as u16).collect();
    for method in [Method::Splat, Method::Triangles] {
        let mut out = vec![0; 64 * 48];
        Registration::new(&k, (64, 48), &k, (64, 48), &turned, method)
            .unwrap()
            .depth_to_color(&depth, 0.001, &mut out)
            .unwrap();
        let middle = &out[64 * 24 + 2..64 * 25 - 2];
        for (i, z) in middle.iter().enumerate() {
            assert!((1063 - i as i32 - 2 - i32::from(*z)).abs() <= 2, "{method:?} {z} at {i}");
        }
    }
}

#[test]
fn points_in_colours_pupil_cost_nothing() {
    // Colour is 0.5 m in front of depth: a wall at 0.5003 m would fill its whole picture with each pixel.
    let k = Intrinsics::pinhole(600.0, 600.0, 319.5, 239.5);
    let finer = Intrinsics::pinhole(610.0, 610.0, 319.5, 239.5);
    let ahead = Pose { translation_m: [0.0, 0.0, -0.5], ..Pose::IDENTITY };
    for method in [Method::Splat, Method::Triangles] {
        let mut r = Registration::new(&k, (640, 480), &finer, (640, 480), &ahead, method).unwrap();
        let mut out = vec![1; 640 * 480];
        r.depth_to_color(&vec![5003; 640 * 480], 0.0001, &mut out).unwrap();
        assert!(out.iter().all(|z| *z == 0), "{method:?}");
        // Behind colour there is nothing.
        r.depth_to_color(&vec![4000; 640 * 480], 0.0001, &mut out).unwrap();
        assert!(out.iter().all(|z| *z == 0), "{method:?}");
    }
}

#[test]
fn all_holes_and_all_saturated() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    for method in [Method::Splat, Method::Triangles] {
        let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &Pose::IDENTITY, method).unwrap();
        let mut out = vec![1; 64 * 48];
        r.depth_to_color(&[0; 64 * 48], 0.001, &mut out).unwrap();
        assert!(out.iter().all(|z| *z == 0));
        r.depth_to_color(&[u16::MAX; 64 * 48], 0.001, &mut out).unwrap();
        assert_eq!(out[64 * 24 + 32], u16::MAX, "{method:?}");
    }
}

#[test]
fn what_cannot_be_registered_is_refused() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let new = |d: &Intrinsics, size, c: &Intrinsics, pose: &Pose| {
        Registration::new(d, size, c, (64, 48), pose, Method::Splat).map(|_| ()).unwrap_err()
    };
    let none = Intrinsics::default();
    let e = new(&none, (64, 48), &k, &Pose::IDENTITY);
    assert_eq!(e.kind(), ErrorKind::NoCalibration);
    assert!(e.to_string().contains("depth"), "{e}");
    assert!(new(&k, (64, 48), &none, &Pose::IDENTITY).to_string().contains("colour"));
    assert_eq!(new(&k, (0, 48), &k, &Pose::IDENTITY).kind(), ErrorKind::BadInput);
    assert_eq!(new(&k, (64, 20_000), &k, &Pose::IDENTITY).kind(), ErrorKind::BadInput);
    let nan = Pose { translation_m: [f64::NAN; 3], ..Pose::IDENTITY };
    assert_eq!(new(&k, (64, 48), &k, &nan).kind(), ErrorKind::BadInput);
    let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &Pose::IDENTITY, Method::Splat).unwrap();
    let mut out = vec![0; 64 * 48];
    assert_eq!(r.depth_to_color(&[0; 3], 0.001, &mut out).unwrap_err().kind(), ErrorKind::SizeMismatch);
    assert_eq!(
        r.depth_to_color(&[0; 64 * 48], 0.001, &mut [0; 2]).unwrap_err().kind(),
        ErrorKind::SizeMismatch
    );
    for unit in [0.0, -0.001, f64::NAN, f64::INFINITY] {
        assert_eq!(r.depth_to_color(&[0; 64 * 48], unit, &mut out).unwrap_err().kind(), ErrorKind::BadInput);
    }
}

#[test]
fn the_same_view_needs_no_registration() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let (size, here) = ((64, 48), Pose::IDENTITY);
    let turned = Pose { rotation_xyzw: [0.0, 0.001, 0.0, 1.0], ..here };
    let moved = Pose { translation_m: [0.0, 0.0001, 0.0], ..here };
    let other = Intrinsics { cx: 31.6, ..k };
    let zero = Intrinsics { model: Distortion::BrownConrady as u32, ..k };
    assert!(same_view((&k, size, &turned), (&k, size, &turned)));
    assert!(same_view((&k, size, &here), (&zero, size, &here)));
    for (k2, size2, pose2) in
        [(&other, size, &here), (&k, (64, 47), &here), (&k, size, &turned), (&k, size, &moved)]
    {
        assert!(!same_view((&k, size, &here), (k2, size2, pose2)));
    }
    assert!(!same_view((&Intrinsics::default(), size, &here), (&Intrinsics::default(), size, &here)));
}
