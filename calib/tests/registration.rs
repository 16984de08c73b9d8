//! Registered depth against geometry: scenes whose depth is known on every ray, and cameras turned against each other.
#![allow(clippy::unwrap_used)]

use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_calib::{Camera, PoseExt, Registration};
use glam::{DQuat, DVec2, DVec3};

/// How far depth sees along its axis.
const MAX_RANGE_M: f64 = 6.0;

/// The scene, in colour's optical frame, metres.
#[derive(Debug, Clone, Copy)]
enum Scene {
    /// Every point `p` with `normal · p = distance`.
    Plane { normal: DVec3, distance: f64 },
    /// A sphere in front of a wall that is square to colour's axis.
    Sphere { centre: DVec3, radius: f64, wall: f64 },
    /// The nearer of two planes that meet in an edge towards the camera.
    Edge { left: DVec3, right: DVec3, distance: f64 },
    /// The farther of two such planes: the corner of a room.
    Corner { left: DVec3, right: DVec3, distance: f64 },
}

impl Scene {
    /// The largest angle between a plane of the scene and one square to `axis`, degrees.
    fn slope(&self, axis: DVec3) -> f64 {
        let slope = |normal: DVec3| normal.dot(axis).clamp(-1.0, 1.0).acos().to_degrees();
        match *self {
            Self::Plane { normal, .. } => slope(normal),
            Self::Sphere { .. } => slope(DVec3::Z),
            Self::Edge { left, right, .. } | Self::Corner { left, right, .. } => {
                slope(left).max(slope(right))
            }
        }
    }

    /// How far along `direction` from `origin` the scene is met; infinite where it is not.
    fn meet(&self, origin: DVec3, direction: DVec3) -> f64 {
        let plane = |normal: DVec3, distance: f64| {
            let s = (distance - normal.dot(origin)) / normal.dot(direction);
            if s > 0.0 { s } else { f64::INFINITY }
        };
        match *self {
            Self::Plane { normal, distance } => plane(normal, distance),
            Self::Sphere { centre, radius, wall } => {
                let to = origin - centre;
                let a = direction.length_squared();
                let b = to.dot(direction);
                let root = (b * b - a * (to.length_squared() - radius * radius)).sqrt();
                let s = (-b - root) / a;
                if s > 0.0 { s } else { plane(DVec3::Z, wall) }
            }
            // Both normals point away from the camera: of a body's faces the one met last is its surface.
            Self::Edge { left, right, distance } => plane(left, distance).max(plane(right, distance)),
            Self::Corner { left, right, distance } => plane(left, distance).min(plane(right, distance)),
        }
    }
}

/// The normal of a plane that is turned away from facing the camera by `slope` degrees, towards `direction` degrees.
fn sloped(slope: f64, direction: f64) -> DVec3 {
    let slope = slope.to_radians();
    let direction = direction.to_radians();
    DVec3::new(slope.sin() * direction.cos(), slope.sin() * direction.sin(), slope.cos())
}

fn scenes(z: f64) -> Vec<(String, Scene)> {
    let mut scenes = Vec::new();
    for (slope, direction) in [(0.0, 0.0), (30.0, 90.0), (45.0, 200.0), (60.0, 0.0), (60.0, 115.0)] {
        let normal = sloped(slope, direction);
        scenes.push((
            format!("plane, {slope} degrees"),
            Scene::Plane { normal, distance: normal.dot(DVec3::new(0.0, 0.0, z)) },
        ));
    }
    let centre = DVec3::new(0.05 * z, -0.02 * z, z);
    scenes.push(("sphere".into(), Scene::Sphere { centre, radius: 0.25 * z, wall: 1.4 * z }));
    let left = sloped(40.0, 170.0);
    let right = sloped(50.0, -10.0);
    let distance = left.dot(DVec3::new(0.0, 0.0, z)).min(right.dot(DVec3::new(0.0, 0.0, z)));
    scenes.push(("edge".into(), Scene::Edge { left, right, distance }));
    scenes.push(("corner".into(), Scene::Corner { left, right, distance }));
    scenes
}

struct Rig {
    name: &'static str,
    depth: Intrinsics,
    depth_size: (u32, u32),
    color: Intrinsics,
    color_size: (u32, u32),
    translation_m: [f64; 3],
}

/// Of colour's pixels each so-many-th is looked at.
const LOOK: usize = 13;

/// A rig with the rays of depth's pixels and of those of colour that are looked at.
struct Rays {
    rig: Rig,
    depth: Vec<Option<DVec3>>,
    color: Vec<Option<DVec3>>,
}

impl Rays {
    fn new(rig: Rig) -> Self {
        let rays = |k: &Intrinsics, (w, h): (u32, u32), step: usize| {
            let camera = Camera::new(k).unwrap();
            (0..w * h)
                .step_by(step)
                .map(|i| camera.unproject(DVec2::new(f64::from(i % w), f64::from(i / w))))
                .collect::<Vec<_>>()
        };
        Self {
            depth: rays(&rig.depth, rig.depth_size, 1),
            color: rays(&rig.color, rig.color_size, LOOK),
            rig,
        }
    }
}

/// Typical calibrations; the L515 at half of its sizes, where colour is the coarser image.
fn rigs() -> [Rig; 4] {
    let camera = |w: f64, h: f64, f: f64, off: f64| {
        Intrinsics::pinhole(f, f * 0.999, w / 2.0 - 0.5 + off, h / 2.0 - 0.5 - off)
    };
    let rational =
        |k: Intrinsics, coeffs: [f64; 8]| Intrinsics { coeffs, model: Distortion::Rational as u32, ..k };
    let inverse = Intrinsics {
        coeffs: [-0.055, 0.064, 0.0007, 0.0002, -0.02, 0.0, 0.0, 0.0],
        model: Distortion::InverseBrownConrady as u32,
        ..camera(1280.0, 720.0, 643.2, 2.0)
    };
    [
        Rig {
            name: "D435, 848x480 to 1280x720",
            depth: camera(848.0, 480.0, 424.9, 1.0),
            depth_size: (848, 480),
            color: camera(1280.0, 720.0, 911.8, -2.0),
            color_size: (1280, 720),
            translation_m: [0.014_75, 0.000_13, 0.000_27],
        },
        Rig {
            name: "D455 with a lens, 640x480 to 1280x720",
            depth: camera(640.0, 480.0, 386.1, 0.7),
            depth_size: (640, 480),
            color: inverse,
            color_size: (1280, 720),
            translation_m: [-0.059_23, -0.000_11, 0.000_41],
        },
        Rig {
            name: "Kinect NFOV binned to 1920x1080",
            depth: rational(
                camera(320.0, 288.0, 252.0, -0.8),
                [0.44, -0.06, 0.0001, -0.0001, 0.004, 0.78, 0.03, 0.02],
            ),
            depth_size: (320, 288),
            color: rational(
                camera(1920.0, 1080.0, 912.4, 3.0),
                [0.55, -2.6, 0.0006, -0.0002, 1.53, 0.43, -2.4, 1.46],
            ),
            color_size: (1920, 1080),
            translation_m: [-0.032, -0.002, 0.0038],
        },
        Rig {
            name: "L515, 1024x768 to 960x540",
            depth: camera(512.0, 384.0, 366.0, 1.2),
            depth_size: (512, 384),
            color: camera(480.0, 270.0, 339.6, 0.5),
            color_size: (480, 270),
            translation_m: [0.000_2, 0.014, -0.004_7],
        },
    ]
}

struct Result {
    /// Median distance from the truth along colour's axis, metres.
    median_m: f64,
    /// Of the pixels of colour whose point depth sees too, the part that has depth.
    covered: f64,
    seen: usize,
}

/// Registers what `rig` sees of `scene`, turned by `rotation`, and compares it with what colour's rays meet.
fn measure(
    rays: &Rays,
    scene: &Scene,
    rotation: DQuat,
    unit_m: f64,
    noise: impl Fn(usize, f64) -> f64,
) -> Result {
    let rig = &rays.rig;
    let q = rotation;
    let pose = Pose { translation_m: rig.translation_m, rotation_xyzw: [q.x, q.y, q.z, q.w] };
    let color_from_depth = pose.to_affine();
    let depth_from_color = color_from_depth.inverse();
    let depth_camera = Camera::new(&rig.depth).unwrap();
    let (w, h) = rig.depth_size;
    let depth: Vec<u16> = rays
        .depth
        .iter()
        .enumerate()
        .map(|(i, ray)| {
            let Some(ray) = *ray else { return 0 };
            let z = scene.meet(color_from_depth.translation, color_from_depth.matrix3 * ray);
            if z < MAX_RANGE_M { (noise(i, z) / unit_m).round() as u16 } else { 0 }
        })
        .collect();
    let mut out = vec![0; (rig.color_size.0 * rig.color_size.1) as usize];
    Registration::new(&rig.depth, rig.depth_size, &rig.color, rig.color_size, &pose)
        .unwrap()
        .depth_to_color(&depth, unit_m, &mut out)
        .unwrap();
    let mut errors = Vec::new();
    let mut seen = 0;
    for (got, ray) in out.iter().step_by(LOOK).zip(&rays.color) {
        let Some(ray) = *ray else { continue };
        let z = scene.meet(DVec3::ZERO, ray);
        let there = Some(depth_from_color.transform_point3(ray * z)).filter(|p| p.is_finite());
        // Beyond its range depth is silent.
        let there = there.filter(|p| p.z < MAX_RANGE_M - 0.3);
        let Some(there) = there.and_then(|p| depth_camera.project(p)) else { continue };
        let inside =
            there.min_element() > 1.0 && there.x < f64::from(w) - 2.0 && there.y < f64::from(h) - 2.0;
        if !inside {
            continue;
        }
        seen += 1;
        if *got > 0 {
            errors.push((f64::from(*got) * unit_m - z).abs());
        }
    }
    let covered = errors.len() as f64 / seen.max(1) as f64;
    let median_m = if errors.is_empty() {
        f64::INFINITY
    } else {
        let middle = errors.len() / 2;
        *errors.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    Result { median_m, covered, seen }
}

fn turned(axis: DVec3, degrees: f64) -> DQuat {
    DQuat::from_axis_angle(axis.normalize(), degrees.to_radians())
}

/// Rotations of depth against colour: none, as factories make them, a Kinect's, up to 30 degrees about every axis, a
/// roll beyond, and upside down.
fn rotations() -> Vec<(String, DQuat)> {
    let mut all = vec![("none".to_owned(), DQuat::IDENTITY)];
    for (axis, degrees) in [
        (DVec3::new(3.1, -1.9, 4.2), 0.32),
        (DVec3::X, 6.0),
        (DVec3::X, 30.0),
        (DVec3::X, -15.0),
        (DVec3::Y, 30.0),
        (DVec3::Y, -30.0),
        (DVec3::Z, 30.0),
        (DVec3::Z, -45.0),
        (DVec3::Z, 90.0),
        (DVec3::new(1.0, -1.0, 1.0), 30.0),
        (DVec3::new(0.02, 0.01, 1.0), 180.0),
    ] {
        all.push((format!("{degrees} degrees about {axis}"), turned(axis, degrees)));
    }
    all
}

#[test]
fn registered_depth_lies_along_the_axis_of_colour() {
    let mut worst = (0.0, String::new());
    let mut least = (1.0, String::new());
    for (r, rig) in rigs().into_iter().map(Rays::new).enumerate() {
        for (q, (rotation_name, rotation)) in rotations().into_iter().enumerate() {
            for (k, (z, unit_m)) in
                [(0.3, 0.001), (0.3, 0.0001), (1.0, 0.001), (3.0, 0.001)].into_iter().enumerate()
            {
                // A third of the scenes, others for each rig, rotation and distance.
                for (name, scene) in scenes(z).into_iter().skip((r + q + k) % 3).step_by(3) {
                    // No camera measures a wall that it looks along.
                    if scene.slope(rotation * DVec3::Z) > 70.0 {
                        continue;
                    }
                    let got = measure(&rig, &scene, rotation, unit_m, |_, z| z);
                    if got.seen < 200 {
                        continue;
                    }
                    let what = format!("{}, {rotation_name}: {name} at {z} m, unit {unit_m} m", rig.rig.name);
                    // Where depth rises by about a whole number of millimetres a pixel, neighbours are rounded alike:
                    // then rounding depth and the result alone makes 0.293 mm. A roll of 45 degrees makes pieces
                    // overlap most, and of rounded depths the least is drawn.
                    let allowed_m = match unit_m {
                        0.001 if rotation_name.starts_with("-45") => 0.00035,
                        0.001 => 0.000_305,
                        _ => 0.0001,
                    };
                    assert!(got.median_m <= allowed_m, "median {} m: {what}", got.median_m);
                    if got.median_m > worst.0 {
                        worst = (got.median_m, what.clone());
                    }
                    if got.covered < least.0 {
                        least = (got.covered, what);
                    }
                }
            }
        }
    }
    println!("worst median {:.3} mm: {}; least coverage {:.4}: {}", worst.0 * 1e3, worst.1, least.0, least.1);
    // Colour may see points that a sphere hides from depth.
    assert!(least.0 >= 0.95, "{} covered: {}", least.0, least.1);
}

/// A splat as librealsense does it: how many pixels of colour have depth.
fn splat(rig: &Rig, pose: &Pose, depth: &[u16], unit_m: f64) -> usize {
    let depth_camera = Camera::new(&rig.depth).unwrap();
    let color_camera = Camera::new(&rig.color).unwrap();
    let color_from_depth = pose.to_affine();
    let w = rig.color_size.0 as i32;
    let h = rig.color_size.1 as i32;
    let mut drawn = vec![false; (w * h) as usize];
    for (i, d) in depth.iter().enumerate().filter(|(_, d)| **d > 0) {
        let x = i % rig.depth_size.0 as usize;
        let y = i / rig.depth_size.0 as usize;
        let corner = |off: f64| {
            let ray = depth_camera.unproject(DVec2::new(x as f64 + off, y as f64 + off))?;
            color_camera.project(color_from_depth.transform_point3(ray * f64::from(*d) * unit_m))
        };
        let (Some(a), Some(b)) = (corner(-0.5), corner(0.5)) else { continue };
        let first = (a.min(b) + 0.5).floor();
        let last = (a.max(b) + 0.5).floor();
        for v in (first.y as i32).max(0)..=(last.y as i32).min(h - 1) {
            for u in (first.x as i32).max(0)..=(last.x as i32).min(w - 1) {
                drawn[(v * w + u) as usize] = true;
            }
        }
    }
    drawn.iter().filter(|d| **d).count()
}

/// Noise far beyond what a surface may jump, and a twelfth of all pixels missing.
#[test]
fn noise_makes_no_more_holes_than_splatting_does() {
    let pose = Pose {
        translation_m: [0.014_75, 0.000_13, 0.000_27],
        rotation_xyzw: [0.0015, -0.001, 0.002, 0.999_996],
    };
    for rig in rigs().into_iter().take(2) {
        for noise in [0.002, 0.02, 0.1] {
            let mut state = 7_u64;
            let mut next = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 40) as f64 / (1u64 << 24) as f64
            };
            let (w, h) = rig.depth_size;
            let depth: Vec<u16> = (0..w * h)
                .map(|i| {
                    let z = 1200.0 + f64::from(i % w) * 0.4;
                    // The sum of some has about the shape of a sensor's.
                    let off = (0..4).map(|_| next() - 0.5).sum::<f64>() * 1.73;
                    if next() < 1.0 / 12.0 { 0 } else { (z * (1.0 + noise * off)) as u16 }
                })
                .collect();
            let mut out = vec![0; (rig.color_size.0 * rig.color_size.1) as usize];
            Registration::new(&rig.depth, rig.depth_size, &rig.color, rig.color_size, &pose)
                .unwrap()
                .depth_to_color(&depth, 0.001, &mut out)
                .unwrap();
            let ours = out.iter().filter(|z| **z > 0).count();
            let theirs = splat(&rig, &pose, &depth, 0.001);
            println!("{}, noise {noise}: {ours} of {theirs}", rig.name);
            assert!(ours as f64 >= 0.99 * theirs as f64, "{}, noise {noise}: {ours} of {theirs}", rig.name);
        }
    }
}
