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
    let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &moved).unwrap();
    assert_eq!((r.depth_size(), r.color_size()), ((64, 48), (64, 48)));
    let mut out = vec![7; 64 * 48];
    r.depth_to_color(&[1000; 64 * 48], 0.001, &mut out).unwrap();
    for (i, z) in out.iter().enumerate() {
        assert_eq!(*z, if i % 64 < 6 { 0 } else { 1000 }, "at {}, {}", i % 64, i / 64);
    }
}

/// A pair of cameras and a depth image.
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
            let cx = f64::from(w) / 2.0 - 0.5 + off;
            let cy = f64::from(h) / 2.0 - 0.5 - off;
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

/// The same camera without its lens.
trait Straight {
    fn straight(&self) -> Self;
}

impl Straight for Intrinsics {
    fn straight(&self) -> Self {
        Self { model: Distortion::None as u32, coeffs: [0.0; 8], ..*self }
    }
}

impl Case {
    fn registration(&self) -> Registration {
        Registration::new(&self.depth, self.depth_size, &self.color, self.color_size, &self.pose).unwrap()
    }

    fn run(&self, registration: &mut Registration) -> Vec<u16> {
        let mut out = vec![5; (self.color_size.0 * self.color_size.1) as usize];
        registration.depth_to_color(&self.pixels, self.unit_m, &mut out).unwrap();
        out
    }

    /// Where colour sees a place of depth's image that is `z` units away, in 64 bits.
    fn seen(&self, x: f64, y: f64, z: u16) -> Option<(DVec2, f64)> {
        let ray = Camera::new(&self.depth).unwrap().unproject(DVec2::new(x, y))?;
        let p = self.pose.to_affine().transform_point3(ray * f64::from(z) * self.unit_m);
        Some((Camera::new(&self.color).unwrap().project(p)?, p.z / self.unit_m))
    }

    /// The pieces that cover each pixel of colour, written down as their rule says, with every edge moved outwards by
    /// `slack` pixels: depth there and in the middle of the piece.
    fn pieces(&self, slack: f64) -> Vec<Vec<(f64, f64)>> {
        let w = self.color_size.0 as i64;
        let h = self.color_size.1 as i64;
        let mut out = vec![Vec::new(); (w * h) as usize];
        let depth_camera = Camera::new(&self.depth).unwrap();
        let color_camera = Camera::new(&self.color).unwrap();
        let dw = self.depth_size.0 as i64;
        let dh = self.depth_size.1 as i64;
        let pose = self.pose.to_affine();
        let is_point = footprint::is_point(&depth_camera, (dw as usize, dh as usize), &color_camera, &pose);
        for i in 0..dw * dh {
            let x = i % dw;
            let y = i / dw;
            let at = |dx: i64, dy: i64| {
                let inside = (0..dw).contains(&(x + dx)) && (0..dh).contains(&(y + dy));
                if inside { f64::from(self.pixels[((y + dy) * dw + x + dx) as usize]) } else { 0.0 }
            };
            let d = at(0, 0);
            if d == 0.0 {
                continue;
            }
            let near = |dx, dy| Some(at(dx, dy)).filter(|z| (z - d).abs() <= 0.046_934_42 * d);
            let left = near(-1, 0);
            let right = near(1, 0);
            let above = near(0, -1);
            let below = near(0, 1);
            let slope = |before: Option<f64>, after: Option<f64>| match (before, after) {
                (Some(a), Some(b)) => (b - a) / 2.0,
                (Some(a), None) => d - a,
                (None, Some(b)) => b - d,
                (None, None) => 0.0,
            };
            let by_column = slope(left, right);
            let by_row = slope(above, below);
            let all = [left, right, above, below].into_iter().sum::<Option<f64>>();
            let middle = all.map_or(d, |sum| (sum + d) / 5.0);
            // Derivatives by small steps.
            let seen = |dx: f64, dy: f64| {
                let ray = depth_camera.unproject(DVec2::new(x as f64 + dx, y as f64 + dy))?;
                let z = middle + by_column * dx + by_row * dy;
                let p = pose.transform_point3(ray * z * self.unit_m);
                Some((color_camera.project(p)?, p.z / self.unit_m))
            };
            let step = 1e-4;
            let is_formed =
                [(0.5, 0.5), (-0.5, -0.5), (-0.5, 0.5)].iter().all(|(dx, dy)| seen(*dx, *dy).is_some());
            let around = (seen(0.0, 0.0), seen(step, 0.0), seen(0.0, step));
            let (Some((at, z)), Some(next), Some(under), true) = (around.0, around.1, around.2, is_formed)
            else {
                continue;
            };
            let to_next = (next.0 - at) / step;
            let to_under = (under.0 - at) / step;
            let z_next = (next.1 - z) / step;
            let z_under = (under.1 - z) / step;
            let cross = to_next.perp_dot(to_under);
            let mut by_u = (z_next * to_under.y - z_under * to_next.y) / cross;
            let mut by_v = (z_under * to_next.x - z_next * to_under.x) / cross;
            if by_u.abs() + by_v.abs() >= 0.046_934_42 * z {
                (by_u, by_v) = (0.0, 0.0);
            }
            let beyond = if all.is_some() { 0.15 } else { 0.49 };
            let half = (to_next.abs() + to_under.abs()) / 2.0 + beyond + slack;
            let half = if is_point { DVec2::splat(0.5 + slack) } else { half };
            let first = (at - half).ceil();
            let last = (at + half).floor();
            let in_range = |z: f64| (0.5 - slack..65_535.5 + slack.signum()).contains(&z);
            if (last - first).max_element() > 128.0 || !is_point && !in_range(z) {
                continue;
            }
            for v in (first.y as i64).max(0)..=(last.y as i64).min(h - 1) {
                for u in (first.x as i64).max(0)..=(last.x as i64).min(w - 1) {
                    let here = z + by_u * (u as f64 - at.x) + by_v * (v as f64 - at.y);
                    if !is_point || in_range(here) {
                        out[(v * w + u) as usize].push((here, z));
                    }
                }
            }
        }
        out
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// 32 bits put an edge within a few hundredths of a pixel, so that a pixel between the two of the slow model may have
    /// depth or not; others have that of a piece that covers them, and no piece that surely covers them is nearer. With
    /// lenses as short as these, pieces are no parallelograms: `tests/registration.rs` has real ones.
    #[test]
    fn depth_is_that_of_the_nearest_piece(case in cases()) {
        let case = Case { depth: case.depth.straight(), color: case.color.straight(), ..case };
        let out = case.run(&mut case.registration());
        let most = case.pieces(0.03);
        let least = case.pieces(-0.03);
        for (i, z) in out.iter().enumerate() {
            if *z == 0 {
                // Depth beyond 16 bits is out of range.
                let is_far = |(here, _): &(f64, f64)| *here > 65_534.0;
                prop_assert!(least[i].iter().all(is_far), "nothing at {i}: {:?}", least[i]);
                continue;
            }
            let z = f64::from(*z);
            // A piece that is all but seen edge-on may count as one or not.
            let is_of = |(here, middle): &(f64, f64)| {
                (z - here).abs() <= 1.5 + 0.02 * (here - middle).abs() || (z - middle).abs() <= 1.0
                    && (here - middle).abs() > 0.03 * middle || z == 65_535.0 && *here > 65_534.0
            };
            prop_assert!(most[i].iter().any(is_of), "{z} at {i}: {:?}", most[i]);
            let nearest = least[i].iter().map(|(here, middle)| here.max(*middle)).fold(f64::INFINITY, f64::min);
            prop_assert!(z <= nearest * 1.05 + 1.5, "{z} at {i}: {:?}", least[i]);
        }
    }

    #[test]
    fn every_form_and_number_of_threads_gives_the_same_bits(case in cases(), threads in 2usize..6) {
        let mut alone = case.registration();
        let want = case.run(&mut alone);
        let color: Vec<u8> = (0..case.color_size.0 * case.color_size.1 * 3).map(|i| (i % 251) as u8).collect();
        let painted = |r: &mut Registration| {
            let mut out = vec![9; case.pixels.len() * 3];
            r.color_to_depth(&case.pixels, case.unit_m, &color, &mut out).unwrap();
            out
        };
        let want_painted = painted(&mut alone);
        in_every_width(|width| {
            assert_eq!(case.run(&mut alone), want, "{width:?}");
            assert_eq!(painted(&mut alone), want_painted, "{width:?}");
        });
        let mut several = case.registration().with_threads(threads);
        prop_assert_eq!(case.run(&mut several), want);
        prop_assert_eq!(painted(&mut several), want_painted);
    }

    /// Colour in depth's view is the mean of the four pixels around the middle in proportion.
    #[test]
    fn painting_mixes_the_four_pixels_around(case in cases()) {
        let case = Case { depth: case.depth.straight(), ..case };
        let w = case.color_size.0 as usize;
        let h = case.color_size.1 as usize;
        let value = |x: usize, y: usize| ((x * 7 + y * 5) % 200) as u8;
        let color: Vec<u8> = (0..w * h).flat_map(|i| [value(i % w, i / w), 9, 200]).collect();
        let mut out = vec![1; case.pixels.len() * 3];
        case.registration().color_to_depth(&case.pixels, case.unit_m, &color, &mut out).unwrap();
        for (i, z) in case.pixels.iter().enumerate() {
            let got = &out[3 * i..3 * i + 3];
            let width = case.depth_size.0 as usize;
            let seen = if *z == 0 { None } else { case.seen((i % width) as f64, (i / width) as f64, *z) };
            let Some((at, _)) = seen else {
                // The ray of a middle and the middle of two rays differ where the lens ends.
                prop_assert!(*z != 0 || got == [0; 3], "{got:?} for a hole");
                continue;
            };
            let right = w as f64 - 1.0;
            let bottom = h as f64 - 1.0;
            if at.x < -0.75 || at.y < -0.75 || at.x > right + 0.75 || at.y > bottom + 0.75 {
                prop_assert_eq!(got, [0; 3], "outside at {}", at);
            } else if at.x > -0.25 && at.y > -0.25 && at.x < right + 0.25 && at.y < bottom + 0.25 {
                let at = at.clamp(DVec2::ZERO, DVec2::new(right, bottom));
                let x = at.x as usize;
                let y = at.y as usize;
                let near = |dx: usize, dy: usize| f64::from(value((x + dx).min(w - 1), (y + dy).min(h - 1)));
                let a = at.x.fract();
                let b = at.y.fract();
                let want = (near(0, 0) * (1.0 - a) + near(1, 0) * a) * (1.0 - b)
                    + (near(0, 1) * (1.0 - a) + near(1, 1) * a) * b;
                let range = [near(0, 0), near(1, 0), near(0, 1), near(1, 1)];
                let spread = range.iter().fold(0.0f64, |m, v| m.max((v - want).abs()));
                prop_assert!((f64::from(got[0]) - want).abs() <= 1.0 + 0.1 * spread, "{got:?} for {want} at {at}");
                prop_assert_eq!(&got[1..], [9, 200]);
            }
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
    let mut out = vec![0; 64 * 6];
    Registration::new(&k, (64, 6), &k, (64, 6), &moved)
        .unwrap()
        .depth_to_color(&depth, 0.001, &mut out)
        .unwrap();
    let row = &out[64 * 2..64 * 3];
    assert!(row[29..36].iter().all(|z| *z == 500), "{row:?}");
    assert!(row[1..26].iter().all(|z| *z == 1000), "{row:?}");
    // Behind the near board there is a shadow that nothing bridges.
    assert!(row[39..43].iter().all(|z| *z == 0), "{row:?}");
}

#[test]
fn a_hole_stays_a_hole_and_its_border_the_surface() {
    let k = Intrinsics::pinhole(40.0, 40.0, 3.5, 3.5);
    let fine = Intrinsics::pinhole(400.0, 400.0, 39.5, 39.5);
    let mut depth: Vec<u16> = (0..64).map(|i| 1000 + 10 * (i % 8)).collect();
    depth[3 * 8 + 3] = 0;
    let mut r = Registration::new(&k, (8, 8), &fine, (80, 80), &Pose::IDENTITY).unwrap();
    let mut out = vec![0; 6400];
    r.depth_to_color(&depth, 0.001, &mut out).unwrap();
    // The hole is at (34.5, 34.5) of colour and 10 pixels wide, of which the neighbours draw one.
    assert_eq!(out[34 * 80 + 34], 0);
    let is_hole = |i: usize| (30..40).contains(&(i % 80)) && (30..40).contains(&(i / 80));
    for (i, z) in out.iter().enumerate() {
        // Depth grows by one from pixel to pixel of colour, also beside the hole, where one of four pixels is missing.
        let surface = 1000.0 + (i % 80) as f64 - 4.5;
        assert!(
            *z == 0 && is_hole(i) || (f64::from(*z) - surface).abs() <= 1.0,
            "{z} at {}, {}",
            i % 80,
            i / 80
        );
    }
    assert!((64..=100).contains(&out.iter().filter(|z| **z == 0).count()));
}

#[test]
fn a_camera_upside_down_sees_too() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let turned = Pose { rotation_xyzw: [0.0, 0.0, 1.0, 0.0], ..Pose::IDENTITY };
    let depth: Vec<u16> = (0..64 * 48).map(|i| 1000 + (i % 64) as u16).collect();
    let mut out = vec![0; 64 * 48];
    Registration::new(&k, (64, 48), &k, (64, 48), &turned)
        .unwrap()
        .depth_to_color(&depth, 0.001, &mut out)
        .unwrap();
    for (i, z) in out.iter().enumerate() {
        assert_eq!(*z, 1063 - (i % 64) as u16, "at {}, {}", i % 64, i / 64);
    }
}

#[test]
fn points_in_colours_pupil_cost_nothing() {
    // Colour is 0.5 m in front of depth: a wall at 0.5003 m would fill its whole image with each pixel.
    let k = Intrinsics::pinhole(600.0, 600.0, 319.5, 239.5);
    let finer = Intrinsics::pinhole(610.0, 610.0, 319.5, 239.5);
    let ahead = Pose { translation_m: [0.0, 0.0, -0.5], ..Pose::IDENTITY };
    let mut r = Registration::new(&k, (640, 480), &finer, (640, 480), &ahead).unwrap();
    let mut out = vec![1; 640 * 480];
    r.depth_to_color(&vec![5003; 640 * 480], 0.0001, &mut out).unwrap();
    assert!(out.iter().all(|z| *z == 0));
    // Behind colour there is nothing.
    r.depth_to_color(&vec![4000; 640 * 480], 0.0001, &mut out).unwrap();
    assert!(out.iter().all(|z| *z == 0));
}

#[test]
fn all_holes_and_all_saturated() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &Pose::IDENTITY).unwrap();
    let mut out = vec![1; 64 * 48];
    r.depth_to_color(&[0; 64 * 48], 0.001, &mut out).unwrap();
    assert!(out.iter().all(|z| *z == 0));
    r.depth_to_color(&[u16::MAX; 64 * 48], 0.001, &mut out).unwrap();
    assert_eq!(out[64 * 24 + 32], u16::MAX);
}

#[test]
fn images_of_one_row_or_column_are_registered() {
    let k = Intrinsics::pinhole(60.0, 60.0, 0.0, 0.0);
    for size in [(1, 1), (1, 5), (5, 1), (2, 2)] {
        let n = (size.0 * size.1) as usize;
        let mut out = vec![0; n];
        let mut r = Registration::new(&k, size, &k, size, &Pose::IDENTITY).unwrap();
        r.depth_to_color(&vec![700; n], 0.001, &mut out).unwrap();
        assert_eq!(out, vec![700; n], "{size:?}");
    }
}

#[test]
fn what_cannot_be_registered_is_refused() {
    let k = Intrinsics::pinhole(60.0, 60.0, 31.5, 23.5);
    let new = |d: &Intrinsics, size, c: &Intrinsics, pose: &Pose| {
        Registration::new(d, size, c, (64, 48), pose).map(|_| ()).unwrap_err()
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
    let mut r = Registration::new(&k, (64, 48), &k, (64, 48), &Pose::IDENTITY).unwrap();
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
    let size = (64, 48);
    let here = Pose::IDENTITY;
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
